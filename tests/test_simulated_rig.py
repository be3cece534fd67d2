"""The simulated rig: its physics against the model, its limits against whoever commands it."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.optimize import newton

from tuning.loop import LoopFacts, RigModel
from tuning.rule import scheduled_stiffness, scheduling_rule
from twin.control.schedule import Acknowledgement, Command, Gains, GainSchedule
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.plant.linear import linear_model
from twin.rig.programme import Programme, Sweep
from twin.rig.simulated import SimulatedRig

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
BLOCK = 5_000
GRID_HZ = tuple(np.linspace(45.0, 55.0, 21).tolist())
THESIS_DAMPING = DampingTable(
    frequency_hz=GRID_HZ, ns_m=tuple(9.58 * f - 0.103 * f**2 - 208.0 for f in GRID_HZ)
)
TABLE, ABSORBER, VCM_A, VCM_V, SHAKER_A, SHAKER_V, REFERENCE = range(7)
FACTS = LoopFacts(RATE_HZ, 1)  # with the hold's half sample: 30 µs


@pytest.fixture(scope="module")
def rig() -> Plant:
    """The rig without sensor noise, but for what keeps its densities positive."""
    plant = load_plant("rig")
    sensors = tuple(s.model_copy(update={"noise_density": 1e-12}) for s in plant.sensor)
    return plant.model_copy(update={"sensor": sensors})


def with_thesis_damping(plant: Plant) -> Plant:
    return plant.with_damping("absorber", THESIS_DAMPING)


def constant_cutoffs(beta: float, low_hz: float, high_hz: float) -> GainSchedule:
    """Thesis Test 1: tuned at 50 Hz, one velocity gain, cutoffs fixed."""
    body = load_plant("rig").body[1]
    tuned = math.sqrt(body.stiffness_n_m / body.mass_kg) / math.tau
    n = len(GRID_HZ)
    return GainSchedule(
        frequency_hz=GRID_HZ,
        alpha_kg=(0.0,) * n,
        beta_ns_m=(beta,) * n,
        gamma_n_m=tuple(scheduled_stiffness(body.mass_kg, tuned, f) for f in GRID_HZ),
        low_pass_hz=(low_hz,) * n,
        high_pass_hz=(high_hz,) * n,
        on_from_hz=45.0,
        on_to_hz=55.0,
    )


TEST_1 = constant_cutoffs(-14.0, 200.0, 1.0)
TEST_3 = scheduling_rule(with_thesis_damping(load_plant("rig")), GRID_HZ)


def programme(
    plant: Plant, schedule: GainSchedule, hz: float, duration_s: float, **changes: object
) -> Programme:
    volts = changes.pop("amplitude_v", 4.0)
    entries: dict[str, object] = {
        "plant": plant,
        "true_damping": THESIS_DAMPING,
        "sweep": Sweep(from_hz=hz, to_hz=hz, duration_s=duration_s, amplitude_v=volts),  # type: ignore[arg-type]
        "schedule": schedule,
        "disturbance_density_n": 0.0,
    }
    return Programme(**(entries | changes))  # type: ignore[arg-type]


def run(rig: SimulatedRig) -> Array:
    blocks = []
    while not rig.finished:
        blocks.append(rig.next_block()[0])
    return np.concatenate(blocks).astype(np.float64)


def phasors(y: Array, hz: float) -> NDArray[np.complex128]:
    """Peak phasors of the last second, against the shaker's sine."""
    n = 50_000
    t = (np.arange(len(y)) / RATE_HZ)[-n:]
    return np.asarray(2.0 * np.mean(y[-n:] * np.exp(-2j * np.pi * hz * t)[:, None], axis=0)) * 1j


# --- physics ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hz", [40.0, 47.0, 55.0])
def test_without_control_the_rig_settles_to_the_response_of_its_plant(rig: Plant, hz: float) -> None:
    simulated = SimulatedRig(programme(rig, TEST_3, hz, 4.0))
    simulated.control_enabled = False
    y = run(simulated)
    model = linear_model(with_thesis_damping(rig), frequency_hz=hz)
    expected = model.response(hz)[0][:, model.inputs.index("shaker")] * 4.0
    got = phasors(y, hz)
    for column, name in enumerate(model.outputs):
        assert abs(got[column] - expected[column]) < 2e-4 * max(abs(expected[column]), 1e-3), name
    assert not y[:, REFERENCE].any()


def test_zero_phase_cutoffs_quiet_the_table_by_94_percent_across_the_band(rig: Plant) -> None:
    # thesis Test 3, against the rig without control and the same c2(f)
    left = []
    for hz in (45.0, 47.0, 49.0, 51.0, 53.0, 55.0):
        runs = []
        for control in (True, False):
            simulated = SimulatedRig(programme(rig, TEST_3, hz, 3.0))
            simulated.control_enabled = control
            runs.append(abs(phasors(run(simulated), hz)[TABLE]))
            assert not simulated.tripped
        left.append(runs[0] / runs[1])
    assert 1.0 - np.mean(left) == pytest.approx(0.94, abs=0.01)
    assert 1.0 - max(left) > 0.84


def slowest_pole(plant: Plant, gains: Gains, damping: float, delay_s: float) -> complex:
    """Least damped pole near the absorber's mode with analogue filters and the delay as e^(-s tau)."""
    model = linear_model(plant, damping_ns_m={"absorber": damping})
    row, column = model.A[2] - model.A[3], model.B[:, model.inputs.index("vcm")]
    feed = (model.B[2] - model.B[3])[model.inputs.index("vcm")]
    low, high = math.tau * gains.low_pass_hz, math.tau * gains.high_pass_hz

    def one_minus_loop(s: complex) -> complex:
        acceleration = row @ np.linalg.solve(s * np.eye(len(model.A)) - model.A, column) + feed
        low_pass = low**2 / (s**2 + math.sqrt(2.0) * low * s + low**2)
        integrate = s / (s**2 + math.sqrt(2.0) * high * s + high**2)
        law = gains.alpha_kg + gains.beta_ns_m * integrate + gains.gamma_n_m * integrate**2
        return complex(1.0 - acceleration * low_pass * law / 8.0 * np.exp(-s * delay_s))

    return complex(newton(one_minus_loop, 1.0 + 2j * np.pi * 57.0, tol=1e-10, maxiter=200))


@pytest.mark.parametrize("hz", [51.0, 52.0, 53.0, 55.0])
def test_sampled_loop_decays_as_the_analogue_one_with_30_microseconds_of_delay(rig: Plant, hz: float) -> None:
    decay = RigModel(with_thesis_damping(rig), FACTS, hz).decay_rate_1_s(TEST_1.at(hz))
    pole = slowest_pole(rig, TEST_1.at(hz), THESIS_DAMPING.at(hz), 1.5 / RATE_HZ)
    assert 50.0 < pole.imag / math.tau < 62.0
    assert decay == pytest.approx(pole.real, abs=0.02)


def test_fixed_200_hz_low_pass_destabilises_the_absorber_above_51_hz(rig: Plant) -> None:
    # thesis Test 1
    model = {
        hz: RigModel(with_thesis_damping(rig), FACTS, hz) for hz in (45.0, 48.0, 50.0, 51.0, 52.0, 53.0, 55.0)
    }
    decay = {hz: m.decay_rate_1_s(TEST_1.at(hz)) for hz, m in model.items()}
    assert all(decay[hz] < -2.0 for hz in (45.0, 48.0, 50.0, 51.0))
    assert decay[52.0] > 0.5
    assert decay[55.0] > 10.0
    assert all(m.decay_rate_1_s(TEST_3.at(hz)) < -4.0 for hz, m in model.items())


def test_instability_above_51_hz_drives_the_current_into_its_clamp_and_stays_there(rig: Plant) -> None:
    below, above = (run(SimulatedRig(programme(rig, TEST_1, hz, 4.0))) for hz in (51.0, 53.0))
    assert np.max(np.abs(below[-50_000:, REFERENCE])) < 0.7
    last = np.abs(above[-50_000:, REFERENCE])
    assert np.max(last) == 2.0
    assert np.mean(last == 2.0) > 0.2


@pytest.mark.parametrize("hz", [48.0, 53.0])
def test_what_the_coils_put_in_is_heat_and_what_the_dampers_take_out(rig: Plant, hz: float) -> None:
    y = run(SimulatedRig(programme(rig, TEST_3, hz, 6.0)))
    p = phasors(y, hz)
    v1, v2 = p[TABLE] / (2j * np.pi * hz), p[ABSORBER] / (2j * np.pi * hz)

    def mean_power(effort: complex, flow: complex) -> float:
        return 0.5 * (effort * np.conj(flow)).real

    by_coil, by_shaker = mean_power(8.0 * p[VCM_A], v2 - v1), mean_power(11.1 * p[SHAKER_A], v1)
    # Electrical in = Joule + mechanical out; the coil's voltage jumps within each sample, the shaker's does not.
    late = y[-50_000:]
    shaker_in = float(np.mean(late[:, SHAKER_A] * late[:, SHAKER_V]))
    assert shaker_in == pytest.approx(1.2 * np.mean(late[:, SHAKER_A] ** 2) + by_shaker, rel=1e-4)
    coil_in = float(np.mean(late[:, VCM_A] * late[:, VCM_V]))
    assert coil_in == pytest.approx(2.7 * np.mean(late[:, VCM_A] ** 2) + by_coil, rel=4e-3)
    lost = 0.5 * (5.0 * abs(v1) ** 2 + THESIS_DAMPING.at(hz) * abs(v2 - v1) ** 2)
    assert by_coil + by_shaker == pytest.approx(lost, rel=2e-3)


# --- what it may be told, and what it refuses ---------------------------------------------------------------


wild = st.floats(-1e6, 1e6)


@settings(deadline=None, max_examples=20)
@given(
    alpha=wild,
    beta=wild,
    gamma=st.floats(-1e9, 1e9),
    low=st.floats(1.0, 20_000.0),
    high=st.floats(0.1, 100.0),
)
def test_no_gains_whatever_pass_the_current_clamp(
    alpha: float, beta: float, gamma: float, low: float, high: float
) -> None:
    schedule = GainSchedule(
        frequency_hz=(45.0, 55.0),
        alpha_kg=(alpha,) * 2,
        beta_ns_m=(beta,) * 2,
        gamma_n_m=(gamma,) * 2,
        low_pass_hz=(low,) * 2,
        high_pass_hz=(high,) * 2,
        on_from_hz=45.0,
        on_to_hz=55.0,
    )
    y = run(SimulatedRig(programme(load_plant("rig"), schedule, 50.0, 0.5)))
    assert np.max(np.abs(y[:, REFERENCE])) <= 2.0
    assert np.all(np.isfinite(y))


def test_gains_too_large_for_arithmetic_leave_the_current_finite_and_clamped() -> None:
    # inf - inf is no number; what is no number must not reach the converter.
    schedule = GainSchedule(
        frequency_hz=(45.0, 55.0),
        alpha_kg=(1e308,) * 2,
        beta_ns_m=(-1e308,) * 2,
        gamma_n_m=(1e308,) * 2,
        low_pass_hz=(1000.0,) * 2,
        high_pass_hz=(20.0,) * 2,
        on_from_hz=45.0,
        on_to_hz=55.0,
    )
    y = run(SimulatedRig(programme(load_plant("rig"), schedule, 50.0, 0.5, amplitude_v=400.0)))
    assert np.all(np.isfinite(y))
    assert np.max(np.abs(y[:, REFERENCE])) <= 2.0


def limited(plant: Plant, **limits: float) -> Plant:
    return plant.model_copy(update={"limits": plant.limits | limits})


def test_stroke_beyond_its_limit_switches_control_off_until_it_is_switched_on_again(rig: Plant) -> None:
    plant = limited(rig, stroke_m=1e-3)
    simulated = SimulatedRig(programme(plant, TEST_3, 45.0, 3.0, amplitude_v=6.0))
    while not (simulated.tripped or simulated.finished):
        _, on, _ = simulated.next_block()
        assert on
    assert simulated.tripped.startswith("stroke ")
    assert simulated.tripped.endswith("passed the limit 1.00 mm")
    tripped_at = simulated.next_sample
    values, on, _ = simulated.next_block()
    assert not on
    assert not values[1:, REFERENCE].any()  # the first sample was computed before
    # Whatever else is ordered, only switching control on again does.
    simulated.accept(Command(command_id=1, apply_at_sample=0, schedule=TEST_3))
    assert not simulated.next_block()[1]
    simulated.accept(Command(command_id=2, apply_at_sample=0, control_enabled=True))
    assert simulated.next_block()[1]
    assert simulated.next_sample == tripped_at + 3 * BLOCK


def test_mean_coil_power_beyond_its_limit_switches_control_off(rig: Plant) -> None:
    # At 45 Hz the coil carries 1.8 A peak: 4.4 W.
    simulated = SimulatedRig(programme(limited(rig, vcm_power_w=2.0), TEST_3, 45.0, 3.0))
    run(simulated)
    assert simulated.tripped.startswith("vcm power ")
    assert "passed the limit 2.0 W" in simulated.tripped
    enough = SimulatedRig(programme(limited(rig, vcm_power_w=6.0), TEST_3, 45.0, 3.0))
    run(enough)
    assert not enough.tripped


@pytest.mark.parametrize("key", ["vcm_current_a", "vcm_power_w", "stroke_m"])
def test_rig_whose_plant_states_no_limit_is_not_driven(key: str) -> None:
    plant = load_plant("rig")
    plant = plant.model_copy(update={"limits": {k: v for k, v in plant.limits.items() if k != key}})
    with pytest.raises(ValidationError, match=rf"limits\.{key} \[\w+\] is missing"):
        programme(plant, TEST_3, 50.0, 1.0)


def test_plant_without_a_current_loop_is_no_rig() -> None:
    with pytest.raises(ValidationError, match="with a current loop"):
        programme(load_plant("rig_no_vcm"), TEST_3, 50.0, 1.0)


# --- commands -----------------------------------------------------------------------------------------------


def test_command_takes_effect_at_the_first_sample_of_its_block_and_not_before(rig: Plant) -> None:
    order = Command(command_id=1, apply_at_sample=3 * BLOCK, control_enabled=False)
    plain, ordered = (SimulatedRig(programme(rig, TEST_3, 47.0, 0.6)) for _ in range(2))
    ordered.accept(order)
    for k in range(6):
        expected, _, _ = plain.next_block()
        values, on, answers = ordered.next_block()
        assert on == (k < 3)
        if k < 3:
            assert values.tobytes() == expected.tobytes()
            assert answers == []
        elif k == 3:
            assert answers == [Acknowledgement(command_id=1, accepted=True, applied_at_sample=3 * BLOCK)]
            # What the converter holds at the block's first sample was computed one sample before.
            assert values[0].tobytes() == expected[0].tobytes()
            assert expected[1:, REFERENCE].any()
            assert not values[1:, REFERENCE].any()


def test_command_between_two_boundaries_waits_for_the_next(rig: Plant) -> None:
    simulated = SimulatedRig(programme(rig, TEST_3, 47.0, 0.5))
    simulated.accept(Command(command_id=1, apply_at_sample=BLOCK + 1, control_enabled=False))
    _, on, answers = simulated.next_block()
    assert (on, answers) == (True, [])
    _, on, answers = simulated.next_block()
    assert (on, answers) == (True, [])
    _, on, answers = simulated.next_block()
    assert not on
    assert answers[0].applied_at_sample == 2 * BLOCK
    assert answers[0].reason == f"{BLOCK - 1} samples late"


def test_late_command_acts_at_the_next_block_and_says_so(rig: Plant) -> None:
    simulated = SimulatedRig(programme(rig, TEST_3, 47.0, 0.5))
    simulated.next_block()
    simulated.next_block()
    simulated.accept(Command(command_id=7, apply_at_sample=100, schedule=TEST_1))
    _, _, answers = simulated.next_block()
    assert answers == [
        Acknowledgement(
            command_id=7, accepted=True, applied_at_sample=2 * BLOCK, reason=f"{2 * BLOCK - 100} samples late"
        )
    ]
    assert simulated.schedule == TEST_1


def test_of_two_commands_for_one_block_the_later_numbered_wins(rig: Plant) -> None:
    simulated = SimulatedRig(programme(rig, TEST_3, 47.0, 0.5))
    simulated.accept(Command(command_id=1, apply_at_sample=0, schedule=TEST_1))
    simulated.accept(Command(command_id=2, apply_at_sample=0, schedule=TEST_3))
    _, _, answers = simulated.next_block()
    assert [a.command_id for a in answers] == [1, 2]
    assert simulated.schedule == TEST_3


def test_control_acts_only_within_the_band_of_its_schedule(rig: Plant) -> None:
    sweep = Sweep(from_hz=44.0, to_hz=56.0, duration_s=2.4, amplitude_v=1.0)
    simulated = SimulatedRig(programme(rig, TEST_3, 50.0, 2.4, sweep=sweep))
    acted = []
    while not simulated.finished:
        middle = simulated.frequency_at(simulated.next_sample + BLOCK // 2)
        acted.append((middle, simulated.next_block()[1]))
    assert [on for _, on in acted] == [45.0 <= hz <= 55.0 for hz, _ in acted]
    assert {on for _, on in acted} == {True, False}


# --- repeatability ------------------------------------------------------------------------------------------


def test_same_seed_gives_the_same_bits_and_another_seed_other_noise_on_the_same_motion() -> None:
    plant = load_plant("rig")

    def bits(seed: int) -> Array:
        sweep = Sweep(from_hz=40.0, to_hz=60.0, duration_s=1.0, amplitude_v=4.0)
        return run(
            SimulatedRig(
                programme(plant, TEST_3, 50.0, 1.0, sweep=sweep, seed=seed, disturbance_density_n=0.01)
            )
        )

    one, again, other = bits(1), bits(1), bits(2)
    assert one.tobytes() == again.tobytes()
    assert one.tobytes() != other.tobytes()
    difference = (one - other)[:, ABSORBER]
    assert 0.1 < np.std(difference) < 1.0  # sqrt(2) times 0.16 m/s² of sensor noise and a little motion


def test_sensor_noise_has_the_density_of_its_sensor() -> None:
    plant = load_plant("rig")
    simulated = SimulatedRig(programme(plant, TEST_3, 50.0, 2.0, amplitude_v=1e-12))
    simulated.control_enabled = False
    y = run(simulated)
    for column, sensor in enumerate(plant.sensor):
        # 100,000 samples: the variance is known to 0.45 %, six sigma.
        assert np.var(y[:, column]) == pytest.approx(sensor.noise_density**2 * RATE_HZ / 2.0, rel=0.03)


def test_ground_noise_shakes_the_table_with_its_density(rig: Plant) -> None:
    # White force of density 1: the absorber's acceleration has the variance of |a/F|² over all frequencies. No
    # force acts on the absorber directly, so that its response falls off and the integral ends.
    sweep = Sweep(from_hz=50.0, to_hz=50.0, duration_s=20.0, amplitude_v=1e-12)
    simulated = SimulatedRig(
        programme(rig, TEST_3, 50.0, 20.0, sweep=sweep, disturbance_density_n=1.0, seed=3)
    )
    simulated.control_enabled = False
    y = run(simulated)[:, ABSORBER]
    model = linear_model(with_thesis_damping(rig), frequency_hz=50.0)
    f = np.linspace(0.05, 2000.0, 400_000)
    n = len(model.states)
    kick = np.zeros((n, 1))
    kick[model.states.index("v_table")] = 1.0 / rig.body[0].mass_kg
    rows = model.C[[ABSORBER]]
    values, vectors = np.linalg.eig(model.A)
    left, right = rows @ vectors, np.linalg.solve(vectors, kick.astype(complex))
    response = ((left.T * right)[:, 0] / (2j * np.pi * f[:, None] - values)).sum(axis=1)
    expected = float(np.trapezoid(np.abs(response) ** 2, f))
    assert np.var(y[50_000:]) == pytest.approx(expected, rel=0.25)


def test_converter_end_of_range_bounds_what_is_measured(rig: Plant) -> None:
    sensors = tuple(
        s.model_copy(update={"range": 5.0}) if s.name == "absorber_acceleration" else s for s in rig.sensor
    )
    plant = rig.model_copy(update={"sensor": sensors})
    y = run(SimulatedRig(programme(plant, TEST_3, 50.0, 1.0)))
    assert np.max(np.abs(y[:, ABSORBER])) == 5.0


def test_absolute_feedback_takes_the_absorbers_accelerometer_for_the_difference(rig: Plant) -> None:
    # thesis Test 4: with the table nearly still the two differ by the table's acceleration alone
    relative, absolute = (
        run(SimulatedRig(programme(rig, TEST_3, 50.0, 3.0, measurement=kind)))
        for kind in ("relative", "absolute")
    )  # fmt: skip
    model = RigModel(with_thesis_damping(rig), LoopFacts(RATE_HZ, 1, relative=False), 50.0)
    assert model.decay_rate_1_s(TEST_3.at(50.0)) < 0.0
    assert np.max(np.abs(absolute[-50_000:, REFERENCE] - relative[-50_000:, REFERENCE])) > 1e-3
    got = abs(phasors(absolute, 50.0)[TABLE])
    passive = abs(model.response(50.0)[0, 0, 1]) * 4.0 * (math.tau * 50.0) ** 2
    assert got < 0.3 * passive
