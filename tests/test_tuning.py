"""The tuner: its limit, its gains and its proposals against brute force, other libraries and the simulated rig."""

import math
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize

from tuning.gains import GainProgram
from tuning.limit import CoilLimits, LimitProblem, least_motion_closed_form
from tuning.loop import LoopFacts, Margins, RigModel, margin_grid, margins
from tuning.retune import Retuner, TuningGoal, predict
from tuning.rule import paired_low_pass_hz, scheduled_stiffness, scheduling_rule
from tuning.types import OperatingPoint
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import DampingTable, Plant
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.plant.linear import linear_model, natural_frequencies_hz
from twin.rig.programme import Programme, Sweep
from twin.rig.simulated import SimulatedRig

Array = NDArray[np.float64]
Pair = tuple[complex, complex]
RATE_HZ = 50_000.0
FACTS = LoopFacts(RATE_HZ, 1)
VOLTS = 4.0
GRID_HZ = tuple(np.linspace(45.0, 55.0, 21).tolist())
THESIS_DAMPING = DampingTable(
    frequency_hz=GRID_HZ, ns_m=tuple(9.58 * f - 0.103 * f**2 - 208.0 for f in GRID_HZ)
)
RIG = load_plant("rig").with_damping("absorber", THESIS_DAMPING)
TEST_3 = scheduling_rule(RIG, GRID_HZ)
FREE = CoilLimits(1e9, 1e6, 1e3, 2.7)


def pairs(plant: Plant, hz: float, amplitude: float) -> tuple[Pair, Pair, Pair]:
    """(Per ampere, without) of motion, current and stroke."""
    r = RigModel(plant, FACTS, hz).response(hz)[0]
    motion, stroke, _, current = ((complex(row[0]), complex(row[1]) * amplitude) for row in r)
    return motion, current, stroke


# --- the physical limit -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def limit() -> LimitProblem:
    return LimitProblem()


@pytest.mark.parametrize(
    ("hz", "watt", "um"), [(47.0, 25.0, 28.19), (53.0, 25.0, 50.776), (47.0, 50.0, 2.4425), (47.0, 52.9, 0.0)]
)
def test_engine_with_coil_can_be_no_quieter_than_its_power_allows(
    limit: LimitProblem, hz: float, watt: float, um: float
) -> None:
    motion, current, stroke = pairs(load_plant("engine_vcm"), hz, 1000.0)
    found = limit.solve(motion, current, stroke, CoilLimits(watt, 1e3, 1.0, 3.0))
    assert found.displacement_m * 1e6 == pytest.approx(um, rel=1e-3, abs=1e-3)


def test_least_power_that_stills_the_engine_at_47_hz_is_52_8_w() -> None:
    motion, current, _ = pairs(load_plant("engine_vcm"), 47.0, 1000.0)
    stilling = current[0] * (-motion[1] / motion[0]) + current[1]
    assert 1.5 * abs(stilling) ** 2 == pytest.approx(52.8, abs=0.05)


@settings(deadline=None, max_examples=40)
@given(
    hz=st.floats(44.0, 57.0), watt=st.floats(0.01, 20.0), amps=st.floats(0.1, 5.0), volts=st.floats(0.2, 8.0)
)
def test_cone_program_is_the_closed_form_while_only_current_binds(
    hz: float, watt: float, amps: float, volts: float
) -> None:
    motion, current, stroke = pairs(RIG, hz, volts)
    bound = min(amps, math.sqrt(2.0 * watt / 2.7))
    if abs(current[1]) > 0.9 * bound:
        return  # the back-EMF alone drives most of the allowed current: next to infeasible
    found = LIMIT.solve(motion, current, stroke, CoilLimits(watt, amps, 1.0, 2.7))
    expected = least_motion_closed_form(motion, current, bound)
    assert found.displacement_m == pytest.approx(expected, rel=1e-5, abs=2e-10)
    assert abs(current[0] * found.reference_a + current[1]) <= bound * (1.0 + 1e-12)


LIMIT = LimitProblem()


@pytest.mark.parametrize("hz", [46.0, 52.0, 55.0])
@pytest.mark.parametrize("share", [0.6, 0.9, 1.2])
def test_with_stroke_and_current_bound_no_reference_on_a_fine_grid_does_better(
    limit: LimitProblem, hz: float, share: float
) -> None:
    motion, current, stroke = pairs(RIG, hz, VOLTS)
    still = -motion[1] / motion[0]
    allowed = CoilLimits(1e3, 0.8 * abs(still), share * abs(stroke[0] * still + stroke[1]), 2.7)
    radius = np.linspace(0.0, 1.2 * allowed.current_peak_a, 400)
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    r = (radius[:, None] * np.exp(1j * angle)).ravel()
    inside = (np.abs(current[0] * r + current[1]) <= allowed.current_peak_a) & (
        np.abs(stroke[0] * r + stroke[1]) <= allowed.stroke_m
    )
    if not inside.any():
        with pytest.raises(RunError, match="no current keeps the limits"):
            limit.solve(motion, current, stroke, allowed)
        return
    least = float(np.min(np.abs(motion[0] * r + motion[1])[inside]))
    found = limit.solve(motion, current, stroke, allowed)
    assert found.displacement_m <= least * (1.0 + 1e-6)
    assert found.displacement_m >= 0.97 * least - 1e-8  # what the grid's steps may miss
    assert abs(stroke[0] * found.reference_a + stroke[1]) <= allowed.stroke_m * (1.0 + 1e-6)


def test_price_of_a_limit_is_what_one_more_unit_of_it_buys(limit: LimitProblem) -> None:
    motion, current, stroke = pairs(RIG, 46.0, VOLTS)
    still = -motion[1] / motion[0]
    amps, travel = 0.5 * abs(still), 0.5 * (abs(stroke[1]) + abs(stroke[0] * still + stroke[1]))
    cases = {
        "power": CoilLimits(0.5 * 2.7 * amps**2, 1e3, 1.0, 2.7),
        "current": CoilLimits(1e6, amps, 1.0, 2.7),
        "stroke": CoilLimits(1e6, 1e3, travel, 2.7),
    }
    fields = {"power": "joule_mean_w", "current": "current_peak_a", "stroke": "stroke_m"}
    for name, allowed in cases.items():
        found = limit.solve(motion, current, stroke, allowed)
        assert [a.name for a in found.active] == [name]
        value = getattr(allowed, fields[name])
        ends = [
            limit.solve(motion, current, stroke, replace(allowed, **{fields[name]: value * (1.0 + d)}))
            for d in (-1e-3, 1e-3)
        ]
        slope = (ends[0].displacement_m - ends[1].displacement_m) / (2e-3 * value)
        assert found.active[0].price == pytest.approx(slope, rel=1e-3)


def test_limit_that_nothing_binds_has_no_price_and_stills_the_table(limit: LimitProblem) -> None:
    motion, current, stroke = pairs(RIG, 50.0, VOLTS)
    found = limit.solve(motion, current, stroke, CoilLimits(33.0, 2.0, 0.0095, 2.7))
    assert found.active == ()
    assert found.displacement_m < 1e-3 * abs(motion[1])


def test_excitation_that_alone_breaks_the_stroke_has_no_solution(limit: LimitProblem) -> None:
    motion, current, stroke = pairs(RIG, 50.0, VOLTS)
    with pytest.raises(RunError, match="no current keeps the limits"):
        limit.solve(motion, current, stroke, CoilLimits(33.0, 1e-4, 1e-6, 2.7))


# --- the sampled loop ---------------------------------------------------------------------------------------


def sampled_by_python_control(plant: Plant, hz: float) -> tuple[control.StateSpace, control.StateSpace]:
    """Plant from coil reference (held) and from shaker voltage (joined) to table, stroke, acceleration, current."""
    model = linear_model(plant, frequency_hz=hz)
    names = model.states
    C = np.zeros((4, len(names)))
    C[0, names.index("x_table")] = 1.0
    C[1, names.index("x_table")], C[1, names.index("x_absorber")] = 1.0, -1.0
    C[2] = model.A[names.index("v_table")] - model.A[names.index("v_absorber")]
    C[3, names.index("i_vcm")] = 1.0
    D = np.zeros((4, 2))
    D[2] = model.B[names.index("v_table")] - model.B[names.index("v_absorber")]
    coil, shaker = (
        control.sample_system(control.ss(model.A, model.B[:, [j]], C, D[:, [j]]), 1.0 / RATE_HZ, method)
        for j, method in ((0, "zoh"), (1, "foh"))
    )
    return coil, shaker


@pytest.mark.parametrize("hz", [45.0, 50.0, 55.0])
def test_response_of_the_sampled_rig_is_python_controls(hz: float) -> None:
    f = np.array([2.0, 11.0, 45.0, 54.9, 300.0])
    got = RigModel(RIG, FACTS, hz).response(f)
    for column, system in enumerate(sampled_by_python_control(RIG, hz)):
        expected = np.array([np.squeeze(system(np.exp(2j * np.pi * x / RATE_HZ))) for x in f])
        np.testing.assert_allclose(got[:, :, column], expected, rtol=2e-6)


def open_loop(hz: float, gains: Gains, f: Array) -> NDArray[np.complex128]:
    """Loop gain from python-control's pieces: sampled plant, trapezoidal filters, one sample of delay."""
    plant, _ = sampled_by_python_control(RIG, hz)
    z = control.tf([1.0, 0.0], [1.0], 1.0 / RATE_HZ)
    s = 2.0 * RATE_HZ * (z - 1) / (z + 1)

    def warped(cutoff_hz: float) -> float:
        return 2.0 * RATE_HZ * math.tan(math.pi * cutoff_hz / RATE_HZ)

    low, high = warped(gains.low_pass_hz), warped(gains.high_pass_hz)
    low_pass = low**2 / (s**2 + math.sqrt(2.0) * low * s + low**2)
    integrate = s / (s**2 + math.sqrt(2.0) * high * s + high**2)
    at = np.exp(2j * np.pi * f / RATE_HZ)
    once = integrate(at)
    law = low_pass(at) * (gains.alpha_kg + gains.beta_ns_m * once + gains.gamma_n_m * once**2)
    return np.asarray(-plant[2, 0](at) * law / at / 8.0)


CASES = [(47.0, TEST_3.at(47.0)), (53.0, TEST_3.at(53.0)), (50.0, Gains(0.05, -9.0, 800.0, 400.0, 2.0))]


@pytest.mark.parametrize(("hz", "gains"), CASES)
def test_margins_are_those_of_python_control_on_a_loop_built_from_its_own_pieces(
    hz: float, gains: Gains
) -> None:
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(RIG), 4000)
    model = RigModel(RIG, FACTS, hz)
    assert model.decay_rate_1_s(gains) < 0.0
    found = margins(model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid, gains)
    f = np.unique(np.concatenate([np.geomspace(0.3, 5000.0, 3000), np.linspace(40.0, 75.0, 5000)]))
    response = open_loop(hz, gains, f)
    loop = control.frd(response, 2 * np.pi * f)
    assert found.modulus == pytest.approx(np.min(np.abs(1.0 + response)), rel=2e-3)
    # Every crossing of |L| = 1 with its phase margin; the least delay is the least of margin over frequency.
    _, phase, _, _, crossing, _ = control.stability_margins(loop, returnall=True)
    delays = [math.radians(p % 360.0) / w for p, w in zip(phase, crossing, strict=True)]
    if found.delay_s is None:
        assert min(delays, default=math.inf) > 8e-3
    else:
        assert found.delay_s == pytest.approx(min(delays), rel=5e-3)


@pytest.mark.parametrize(("hz", "gains"), [CASES[1], (54.0, TEST_3.at(54.0)), (55.0, TEST_3.at(55.0))])
def test_delay_margin_is_where_the_sampled_poles_leave_the_circle(hz: float, gains: Gains) -> None:
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(RIG), 400)
    terms = RigModel(RIG, FACTS, hz).loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz)
    found = margins(terms, grid, gains).delay_s
    assert found is not None
    samples = found * RATE_HZ
    decays = {
        n: RigModel(RIG, LoopFacts(RATE_HZ, 1 + n), hz).decay_rate_1_s(gains)
        for n in (math.floor(samples), math.ceil(samples))
    }
    assert decays[math.floor(samples)] < 0.0 < decays[math.ceil(samples)]


@pytest.mark.parametrize("hz", [47.0, 50.0, 52.0])
def test_loop_without_a_delay_margin_is_stable_with_any_delay_to_8_ms(hz: float) -> None:
    gains = TEST_3.at(hz)
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(RIG), 400)
    terms = RigModel(RIG, FACTS, hz).loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz)
    assert margins(terms, grid, gains).delay_s is None
    for n in (10, 40, 80, 160, 240, 399):
        assert RigModel(RIG, LoopFacts(RATE_HZ, 1 + n), hz).decay_rate_1_s(gains) < 0.0


def unlimited(plant: Plant) -> Plant:
    """Without sensor noise to speak of, and with limits that nothing reaches."""
    sensors = tuple(s.model_copy(update={"noise_density": 1e-14, "range": None}) for s in plant.sensor)
    limits = {"vcm_current_a": 1e6, "vcm_power_w": 1e12, "stroke_m": 1e3}
    return plant.model_copy(update={"sensor": sensors, "limits": limits})


def constant(gains: Gains, hz: float) -> GainSchedule:
    return GainSchedule(
        frequency_hz=(hz,),
        alpha_kg=(gains.alpha_kg,),
        beta_ns_m=(gains.beta_ns_m,),
        gamma_n_m=(gains.gamma_n_m,),
        low_pass_hz=(gains.low_pass_hz,),
        high_pass_hz=(gains.high_pass_hz,),
        on_from_hz=hz,
        on_to_hz=hz,
    )


def simulate(
    plant: Plant, gains: Gains, hz: float, duration_s: float, volts: float
) -> tuple[Array, SimulatedRig]:
    damping = plant.body[1].damping_at(hz)
    rig = SimulatedRig(
        Programme(
            plant=plant,
            true_damping=DampingTable(frequency_hz=(hz, hz + 1.0), ns_m=(damping, damping)),
            sweep=Sweep(from_hz=hz, to_hz=hz, duration_s=duration_s, amplitude_v=volts),
            schedule=constant(gains, hz),
            disturbance_density_n=0.0,
        )
    )
    blocks = []
    while not rig.finished:
        blocks.append(rig.next_block()[0])
    return np.concatenate(blocks).astype(np.float64), rig


def phasors(y: Array, hz: float) -> NDArray[np.complex128]:
    n = 50_000
    t = (np.arange(len(y)) / RATE_HZ)[-n:]
    return np.asarray(2.0 * np.mean(y[-n:] * np.exp(-2j * np.pi * hz * t)[:, None], axis=0))


@pytest.mark.parametrize(
    ("hz", "beta", "cutoffs"),
    [(53.0, -14.0, (200.0, 1.0)), (55.0, -14.0, (200.0, 1.0)), (51.0, -20.0, (1000.0, 2.5))],
)
def test_unstable_loop_of_the_model_grows_in_the_simulation_at_its_rate(
    hz: float, beta: float, cutoffs: tuple[float, float]
) -> None:
    gains = Gains(0.0, beta, scheduled_stiffness(0.4125, 50.0, hz), *cutoffs)
    rate = RigModel(RIG, FACTS, hz).decay_rate_1_s(gains)
    assert rate > 1.0
    duration = 1.0 + math.ceil(100.0 / rate) / 10.0
    y, rig = simulate(unlimited(RIG), gains, hz, duration, 1e-6)
    assert not rig.tripped
    n, half = 20_000, len(y) // 2
    sizes = [float(np.sqrt(np.mean(y[end - n : end, 1] ** 2))) for end in (half, len(y))]
    growth = math.log(sizes[1] / sizes[0]) / ((len(y) - half) / RATE_HZ)
    assert growth == pytest.approx(rate, rel=0.02)


def test_stable_loop_of_the_model_decays_in_the_simulation_at_its_rate() -> None:
    hz = 50.0
    gains = TEST_3.at(hz)
    rate = RigModel(RIG, FACTS, hz).decay_rate_1_s(gains)
    y, _ = simulate(unlimited(RIG), gains, hz, 5.0, 1.0)
    settled = phasors(y, hz)[0]
    t = np.arange(len(y)) / RATE_HZ
    left = y[:, 0] - (settled * np.exp(2j * np.pi * hz * t)).real
    # The slowest mode is left alone after the quicker ones have gone.
    sizes = [float(np.sqrt(np.mean(left[(t > a) & (t <= a + 0.4)] ** 2))) for a in (0.8, 1.6)]
    assert math.log(sizes[1] / sizes[0]) / 0.8 == pytest.approx(rate, rel=0.1)


@pytest.mark.parametrize(
    ("hz", "gains"),
    [*CASES, (48.0, Gains(0.0, -5.0, -1500.0, 300.0, 1.0)), (55.0, Gains(-0.02, -4.0, 5000.0, 800.0, 3.0))],
)
def test_prediction_is_what_the_simulated_rig_settles_to(hz: float, gains: Gains) -> None:
    model = RigModel(RIG, FACTS, hz)
    decay = model.decay_rate_1_s(gains)
    assert decay < -1.0
    y, _ = simulate(unlimited(RIG), gains, hz, 1.0 + math.ceil(9.0 / -decay), VOLTS)
    predicted = predict(model, gains, hz, VOLTS)
    p = phasors(y, hz)
    w = 2 * np.pi * hz
    assert predicted.displacement_m == pytest.approx(abs(p[0]) / w**2, rel=0.01)
    assert predicted.stroke_m == pytest.approx(abs(p[0] - p[1]) / w**2, rel=0.01)
    assert predicted.current_peak_a == pytest.approx(abs(p[2]), rel=0.01)
    late = y[-50_000:]
    assert predicted.powers.joule_mean_w == pytest.approx(2.7 * np.mean(late[:, 2] ** 2), rel=0.01)
    assert predicted.powers.joule_peak_w == pytest.approx(2.0 * predicted.powers.joule_mean_w)
    mechanical = 0.5 * (8.0 * p[2] * np.conj((p[1] - p[0]) / (1j * w))).real
    electrical = 2.7 * np.mean(late[:, 2] ** 2) + mechanical
    assert predicted.powers.electrical_mean_w == pytest.approx(electrical, rel=0.02)


def test_absolute_feedback_measures_the_absorber_alone() -> None:
    f = np.array([45.0, 52.0])
    relative, absolute = (
        RigModel(RIG, LoopFacts(RATE_HZ, 1, relative=kind), 50.0).response(f) for kind in (True, False)
    )
    w2 = (2 * np.pi * f)[:, None] ** 2
    table = -w2 * relative[:, 0]
    np.testing.assert_allclose(absolute[:, 2], relative[:, 2] - table, rtol=1e-4)
    np.testing.assert_array_equal(absolute[:, [0, 1, 3]], relative[:, [0, 1, 3]])


@pytest.mark.parametrize(
    ("name", "words"), [("rig_no_vcm", "has no voice coil"), ("engine", "has no voice coil")]
)
def test_plant_without_a_coil_has_no_loop(name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        RigModel(load_plant(name), FACTS, 50.0)


# --- gains: the quadratic program -----------------------------------------------------------------------------


def question(
    hz: float, volts: float = VOLTS
) -> tuple[NDArray[np.complex128], complex, NDArray[np.complex128], Array]:
    """Fit, target and loop of one frequency, for the unlimited wish."""
    gains = TEST_3.at(hz)
    model = RigModel(RIG, FACTS, hz)
    response = model.response(hz)[0]
    wish = LIMIT.solve(*pairs(RIG, hz, volts), FREE).reference_a
    acceleration = response[2, 0] * wish + response[2, 1] * volts
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(RIG), 60)
    fit = model.paths(hz, gains.low_pass_hz, gains.high_pass_hz)[0] * acceleration
    return fit, wish, model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid


SCALE = np.array([0.4125, 0.4125 * 314.2, 40714.0])
BOUNDS = np.array([[-0.5, 1.0], [-1.0, 1.0], [-0.8, 2.0]]) * SCALE[:, None]


@pytest.mark.parametrize("hz", [46.0, 50.0, 54.0])
def test_without_a_margin_the_gains_reach_the_wish_exactly(hz: float) -> None:
    fit, wish, terms, _ = question(hz)
    gains = GainProgram(len(terms), SCALE, BOUNDS).solve(fit, wish, terms, 0.0, np.zeros(3))
    assert abs(fit @ gains - wish) / abs(wish) < 2e-3


@pytest.mark.parametrize("hz", [46.0, 50.0, 53.0, 55.0])
@pytest.mark.parametrize("margin", [0.1, 0.3, 0.5])
def test_with_a_margin_the_gains_keep_it_and_brute_force_finds_little_better(
    hz: float, margin: float
) -> None:
    fit, wish, terms, _ = question(hz)
    gains = GainProgram(len(terms), SCALE, BOUNDS).solve(fit, wish, terms, margin, np.zeros(3))
    assert np.min(np.abs(1.0 + terms @ gains)) >= margin - 0.01
    assert np.all(gains >= BOUNDS[:, 0] - 1e-3 * SCALE)
    assert np.all(gains <= BOUNDS[:, 1] + 1e-3 * SCALE)

    def miss(y: Array) -> float:
        return float(abs(fit @ (y * SCALE) - wish) / abs(wish))

    best = math.inf
    for seed in range(6):
        start = gains / SCALE if seed == 0 else 0.2 * np.random.default_rng(seed).standard_normal(3)
        found = minimize(
            lambda y: miss(y) ** 2, start, method="SLSQP", bounds=BOUNDS / SCALE[:, None],
            constraints={"type": "ineq", "fun": lambda y: np.abs(1.0 + terms @ (y * SCALE)) ** 2 - margin**2},
            options={"maxiter": 300, "ftol": 1e-10},
        )  # fmt: skip
        y = found.x
        stays = np.min(np.abs(1.0 + terms @ (y * SCALE))) >= margin - 1e-4
        # Gains on the far side of -1 keep the distance too, but encircle it.
        if stays and RigModel(RIG, FACTS, hz).decay_rate_1_s(_gains(y * SCALE, hz)) < 0.0:
            best = min(best, miss(y))
    assert miss(gains / SCALE) <= best + 0.05


def _gains(numbers: Array, hz: float) -> Gains:
    return replace(
        TEST_3.at(hz), alpha_kg=float(numbers[0]), beta_ns_m=float(numbers[1]), gamma_n_m=float(numbers[2])
    )


def test_answer_does_not_depend_on_what_was_asked_before() -> None:
    first, second = question(47.0), question(53.0)
    program = GainProgram(len(first[2]), SCALE, BOUNDS)
    a = program.solve(first[0], first[1], first[2], 0.3, np.zeros(3))
    b = program.solve(second[0], second[1], second[2], 0.3, np.zeros(3))
    again = program.solve(first[0], first[1], first[2], 0.3, np.zeros(3))
    assert a.tobytes() == again.tobytes()
    assert a.tobytes() != b.tobytes()
    fresh = GainProgram(len(first[2]), SCALE, BOUNDS).solve(second[0], second[1], second[2], 0.3, np.zeros(3))
    assert b.tobytes() == fresh.tobytes()


def test_nothing_wished_for_needs_no_gains() -> None:
    fit, _, terms, _ = question(50.0)
    assert not GainProgram(len(terms), SCALE, BOUNDS).solve(fit, 0.0, terms, 0.3, np.zeros(3)).any()


def test_margin_that_no_gains_can_keep_is_said() -> None:
    fit, wish, terms, _ = question(50.0)
    with pytest.raises(RunError, match="no gains keep the margin"):
        GainProgram(len(terms), SCALE, BOUNDS).solve(fit, wish, terms, 5.0, np.zeros(3))


# --- proposals ------------------------------------------------------------------------------------------------


def verify(plant: Plant, point: OperatingPoint, goal: TuningGoal, volts: float, std: float) -> None:
    """Everything a proposed point claims, again: on a finer grid, on other models, by simulation."""
    hz, gains = point.frequency_hz, point.gains
    damping = plant.body[1].damping_at(hz)
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(plant), 2000)
    for c in (damping, max(0.0, damping - 2.0 * std), damping + 2.0 * std):
        model = RigModel(plant, FACTS, hz, c)
        assert np.abs(model.closed_loop(gains).poles()).max() < 1.0
        L = model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz) @ np.array(gains.as_tuple()[:3])
        assert np.min(np.abs(1.0 + L)) >= 0.92 * goal.modulus_margin
    for f in (hz - goal.drift_hz, hz, hz + goal.drift_hz):
        p = predict(RigModel(plant, FACTS, hz), gains, f, volts)
        spent = p.powers.joule_peak_w if goal.budget_kind == "joule_peak" else p.powers.joule_mean_w
        assert spent <= goal.budget_w * 1.002
        assert p.current_peak_a <= plant.limits["vcm_current_a"] * 1.002
        assert p.stroke_m <= plant.limits["stroke_m"] * 1.002
    assert point.predicted_displacement_m >= point.limit_displacement_m - 1e-8


@pytest.mark.parametrize(
    ("hz", "goal"),
    [
        (46.0, TuningGoal(budget_w=4.0)),
        (50.0, TuningGoal(budget_w=0.1)),
        (53.0, TuningGoal(budget_w=0.3, budget_kind="joule_peak")),
        (54.0, TuningGoal(budget_w=4.0, modulus_margin=0.4)),
    ],
)
def test_every_proposed_point_keeps_its_word_when_checked_again(hz: float, goal: TuningGoal) -> None:
    proposal = Retuner(RIG, FACTS, goal).propose(123, RIG, 0.2, hz, VOLTS, TEST_3)
    assert proposal.feasible
    assert proposal.made_at_sample == 123
    assert proposal.model_id == RIG.fingerprint
    assert len(proposal.points) == 5
    for row, point in proposal.points:
        assert GRID_HZ[row] == point.frequency_hz
        assert abs(point.frequency_hz - hz) <= goal.reach_hz
        assert (point.gains.low_pass_hz, point.gains.high_pass_hz) == TEST_3.at(
            point.frequency_hz
        ).as_tuple()[3:]
        verify(RIG, point, goal, VOLTS, 0.2)


def test_proposed_point_does_on_the_rig_what_it_promises() -> None:
    goal = TuningGoal(budget_w=0.5, reach_hz=0.1)
    ((_, point),) = Retuner(RIG, FACTS, goal).propose(0, RIG, 0.1, 47.0, VOLTS, TEST_3).points
    y, rig = simulate(unlimited(RIG), point.gains, 47.0, 8.0, VOLTS)
    assert not rig.tripped
    p = phasors(y, 47.0)
    assert abs(p[0]) / (2 * np.pi * 47.0) ** 2 == pytest.approx(
        point.predicted_displacement_m, rel=0.02, abs=2e-8
    )
    assert 2.7 * np.mean(y[-50_000:, 2] ** 2) == pytest.approx(point.powers.joule_mean_w, rel=0.01)
    assert point.powers.joule_mean_w <= 0.5
    assert point.limit_displacement_m <= point.predicted_displacement_m < point.passive_displacement_m
    assert [a.name for a in point.active_limits] == ["power"]


def test_more_power_buys_a_quieter_table_and_a_larger_margin_a_louder_one() -> None:
    def left(budget: float, margin: float) -> float:
        goal = TuningGoal(budget_w=budget, modulus_margin=margin, reach_hz=0.1)
        ((_, point),) = Retuner(RIG, FACTS, goal).propose(0, RIG, 0.05, 54.0, VOLTS, TEST_3).points
        return point.predicted_displacement_m

    assert left(0.05, 0.15) > left(0.2, 0.15) > left(4.0, 0.15)
    assert left(4.0, 0.5) > left(4.0, 0.15)


@settings(deadline=None, max_examples=12)
@given(
    table=st.floats(0.9, 1.1),
    absorber=st.floats(0.95, 1.05),
    spring=st.floats(0.95, 1.05),
    damping=st.floats(1.0, 30.0),
    std=st.floats(0.0, 2.0),
    hz=st.floats(45.5, 54.5),
    budget=st.floats(0.05, 8.0),
    volts=st.floats(0.5, 6.0),
    margin=st.sampled_from([0.1, 0.15, 0.3]),
)
def test_no_proposal_on_any_rig_like_plant_is_unstable_or_over_its_budget(
    table: float, absorber: float, spring: float, damping: float, std: float, hz: float, budget: float,
    volts: float, margin: float,
) -> None:  # fmt: skip
    rig = load_plant("rig")
    bodies = (
        rig.body[0].model_copy(update={"mass_kg": rig.body[0].mass_kg * table}),
        rig.body[1].model_copy(
            update={
                "mass_kg": rig.body[1].mass_kg * absorber,
                "stiffness_n_m": rig.body[1].stiffness_n_m * spring,
                "damping_ns_m": damping,
            }
        ),
    )
    plant = rig.model_copy(update={"body": bodies})
    goal = TuningGoal(budget_w=budget, modulus_margin=margin, reach_hz=0.3)
    proposal = Retuner(plant, FACTS, goal).propose(0, plant, std, hz, volts, TEST_3)
    assert proposal.feasible == bool(proposal.points)
    assert proposal.points or proposal.reason
    for _, point in proposal.points:
        verify(plant, point, goal, volts, std)


def test_same_question_twice_is_answered_with_identical_numbers() -> None:
    retuner = Retuner(RIG, FACTS, TuningGoal())
    first = retuner.propose(0, RIG, 0.2, 47.0, VOLTS, TEST_3)
    retuner.propose(0, RIG, 0.2, 53.0, VOLTS, TEST_3)
    assert retuner.propose(0, RIG, 0.2, 47.0, VOLTS, TEST_3) == first
    assert Retuner(RIG, FACTS, TuningGoal()).propose(0, RIG, 0.2, 47.0, VOLTS, TEST_3) == first


def test_damping_that_moved_is_a_new_question() -> None:
    retuner = Retuner(RIG, FACTS, TuningGoal(reach_hz=0.1))
    ((_, before),) = retuner.propose(0, RIG, 0.1, 47.0, VOLTS, TEST_3).points
    moved = RIG.with_damping("absorber", THESIS_DAMPING.at(47.0) + 2.0)
    ((_, after),) = retuner.propose(0, moved, 0.1, 47.0, VOLTS, TEST_3).points
    stale = predict(RigModel(moved, FACTS, 47.0), before.gains, 47.0, VOLTS).displacement_m
    assert after.predicted_displacement_m < 0.6 * stale


def test_excitation_off_the_table_changes_nothing_and_says_why() -> None:
    proposal = Retuner(RIG, FACTS, TuningGoal()).propose(0, RIG, 0.1, 41.0, VOLTS, TEST_3)
    assert not proposal.feasible
    assert proposal.points == ()
    assert "no point of the table lies within 1 Hz of 41.00 Hz" in proposal.reason


def test_budget_that_nothing_can_meet_is_refused_with_the_reason() -> None:
    # Damping known to 30 Ns/m only: no gains are stable over all of it with that margin.
    goal = TuningGoal(budget_w=4.0, modulus_margin=0.6, slowest_decay_1_s=50.0, reach_hz=0.1)
    proposal = Retuner(RIG, FACTS, goal).propose(0, RIG, 0.1, 54.0, VOLTS, TEST_3)
    assert not proposal.feasible
    assert "54 Hz: slowest pole at" in proposal.reason
    assert "wanted below -50 1/s" in proposal.reason


@pytest.mark.parametrize("key", ["vcm_current_a", "stroke_m"])
def test_plant_without_limits_gets_no_proposals(key: str) -> None:
    plant = RIG.model_copy(update={"limits": {k: v for k, v in RIG.limits.items() if k != key}})
    with pytest.raises(InputError, match=rf"limits\.{key} \[\w\] is missing"):
        Retuner(plant, FACTS, TuningGoal())


def test_plant_without_a_coil_and_budget_of_nothing_are_refused() -> None:
    with pytest.raises(InputError, match="has no voice coil on an absorber"):
        Retuner(load_plant("rig_no_vcm"), FACTS, TuningGoal())
    for budget in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="budget_w must be greater than 0 W"):
            Retuner(RIG, FACTS, TuningGoal(budget_w=budget))


# --- the thesis's rule ------------------------------------------------------------------------------------------


def test_scheduling_rule_moves_the_absorbers_resonance_to_the_excitation() -> None:
    body = RIG.body[1]
    for hz in GRID_HZ:
        gains = TEST_3.at(hz)
        moved = math.sqrt((body.stiffness_n_m + gains.gamma_n_m) / body.mass_kg) / math.tau
        assert moved == pytest.approx(hz, rel=1e-9)
        assert gains.beta_ns_m == pytest.approx(-THESIS_DAMPING.at(hz))
        assert gains.low_pass_hz == paired_low_pass_hz(hz, 2.5) == pytest.approx(hz**2 / 2.5)
    assert scheduling_rule(RIG, [50.0], low_pass_hz=200.0).at(50.0).low_pass_hz == 200.0
    with pytest.raises(ValueError, match="needs an absorber"):
        scheduling_rule(load_plant("shaker_v721"), [50.0])


def test_margins_of_no_loop_are_one_and_any_delay() -> None:
    grid = margin_grid(RATE_HZ, [11.0, 55.0], 50)
    none = margins(np.ones((len(grid), 3), complex), grid, Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    assert none == Margins(1.0, None)
