"""Time simulation: against an adaptive integrator, an independent sampled loop, and the analysis in frequency."""

import json
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from tuning.rule import scheduling_rule
from twin.control.analysis import analyse_point, choose_law
from twin.control.chain import chain_response
from twin.control.continuous import SIGNALS, Loop, build_loop
from twin.control.filters import Cutoffs
from twin.control.laws import Law
from twin.control.response import loop_response
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import DampingTable, ForceActuator, Plant, VoiceCoil
from twin.plant.discrete import discretise
from twin.plant.files import load_plant
from twin.plant.linear import linear_model
from twin.rig.embedded import EmbeddedRig
from twin.rig.excitation import Shuttle, Span, Step, Steps, Sweep, Tone, exciter
from twin.rig.programme import Programme, with_accelerometers
from twin.rig.simulated import SimulatedRig

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
RATE_HZ = 50_000.0
BAND_HZ = (45.0, 47.0, 50.0, 53.0, 55.0)


def quiet(plant: Plant) -> Plant:
    """The plant without sensor noise, but for what keeps its densities positive."""
    sensors = tuple(s.model_copy(update={"noise_density": 1e-30}) for s in plant.sensor)
    return plant.model_copy(update={"sensor": sensors})


@pytest.fixture(scope="module")
def rig() -> Plant:
    return quiet(load_plant("rig"))


@pytest.fixture(scope="module")
def engine() -> Plant:
    """The engine of thesis Table 8-2 with what a run needs: accelerometers and limits."""
    plant = quiet(with_accelerometers(load_plant("engine_vcm"), 1e-3))
    limits = {"vcm_current_a": 100.0, "vcm_power_w": 1e4, "stroke_m": 0.05}
    return plant.model_copy(update={"limits": plant.limits | limits})


def flat(gains: Gains) -> GainSchedule:
    """The same gains at every frequency."""
    a, b, c, low, high = ((value,) * 2 for value in gains.as_tuple())
    return GainSchedule(
        frequency_hz=(40.0, 60.0), alpha_kg=a, beta_ns_m=b, gamma_n_m=c, low_pass_hz=low, high_pass_hz=high,
        on_from_hz=40.0, on_to_hz=60.0,
    )  # fmt: skip


def programme(
    plant: Plant, excitation: Sweep | Steps | Tone, schedule: GainSchedule, **changes: object
) -> Programme:
    absorber = plant.absorber
    assert absorber is not None
    damping = absorber.damping_at(50.0)
    entries: dict[str, object] = {
        "plant": plant,
        "true_damping": DampingTable(frequency_hz=(40.0, 60.0), ns_m=(damping,) * 2),
        "sweep": excitation,
        "schedule": schedule,
        "disturbance_density_n": 0.0,
    }
    return Programme(**(entries | changes))  # type: ignore[arg-type]


def run(rig: SimulatedRig) -> tuple[Array, Array]:
    """States and inputs at every sample from 0 on, as they really were."""
    states, inputs = [], []
    while not rig.finished:
        rig.next_block()
        for truth in rig.truth:
            states.append(truth.states[1:])
            inputs.append(truth.inputs[1:])
    return np.concatenate(states), np.concatenate(inputs)


def phasors(signals: Array, hz: float, end: int, n: int = 50_000, rate_hz: float = RATE_HZ) -> ComplexArray:
    """Phasors of a sine in the ``n`` samples before ``end``, whole periods; a sine of phase 0 gives 1."""
    t = np.arange(end - n, end) / rate_hz
    turn = np.exp(-2j * np.pi * hz * t)[:, None]
    return np.asarray(2j * np.mean(signals[end - n : end] * turn, axis=0))


def sampled_steady_state(plant: Plant, gains: Gains, hz: float, delay: int, amplitude: float) -> ComplexArray:
    """Phasors of the states that the sampled loop settles to, from z-transforms alone."""
    coil = plant.voice_coil
    assert coil is not None
    coil_at = plant.actuator.index(coil)
    model = linear_model(plant, frequency_hz=hz)
    d = discretise(model, RATE_HZ, ["zoh" if j == coil_at else "foh" for j in range(2)])
    z = np.exp(2j * np.pi * hz / RATE_HZ)
    to_states = np.linalg.solve(z * np.eye(len(d.F)) - d.F, d.B0 + z * d.B1)
    row = {name: k for k, name in enumerate(model.outputs)}
    first, second = coil.between or ("", "")
    pick = np.zeros(len(row))
    pick[row[f"{first}_acceleration"]], pick[row[f"{second}_acceleration"]] = 1.0, -1.0
    to_seen = pick @ (d.C @ to_states + d.D)
    chain = chain_response(hz, gains.low_pass_hz, gains.high_pass_hz, RATE_HZ)[0]
    law = chain @ [gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m] / coil.force_constant_n_a * z**-delay
    excited = 1 - coil_at
    reference = law * to_seen[excited] * amplitude / (1.0 - law * to_seen[coil_at])
    return np.asarray(to_states[:, coil_at] * reference + to_states[:, excited] * amplitude)


# --- exact for what is applied ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rig", "engine"])
def test_open_loop_run_follows_an_adaptive_integrator(name: str, request: pytest.FixtureRequest) -> None:
    plant: Plant = request.getfixturevalue(name)
    amplitude = {"amplitude_v": 4.0} if name == "rig" else {"amplitude_n": 1000.0}
    sweep = Sweep(from_hz=45.0, to_hz=55.0, duration_s=0.02, **amplitude)  # type: ignore[arg-type]
    schedule = flat(Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    simulated = SimulatedRig(programme(plant, sweep, schedule, block_samples=250), keep_truth=True)
    simulated.control_enabled = False
    states, inputs = run(simulated)
    model = linear_model(plant, frequency_hz=50.0)
    at = plant.actuator.index(exciter(plant, sweep))
    assert not inputs[:, 1 - at].any()
    drive, B = inputs[:, at], model.B[:, at]
    t = np.arange(len(drive)) / RATE_HZ
    np.testing.assert_allclose(
        drive, sweep.amplitude * np.sin(2.0 * np.pi * (45.0 * t + 250.0 * t * t)), atol=1e-11
    )
    size = np.abs(states).max(axis=0)
    expected, x = np.zeros_like(states), np.zeros(len(B))
    for k in range(1, len(drive)):

        def slope(s: float, w: Array, k: int = k) -> Array:
            return np.asarray(model.A @ w + B * (drive[k - 1] + (drive[k] - drive[k - 1]) * s * RATE_HZ))

        x = solve_ivp(slope, (0.0, 1.0 / RATE_HZ), x, method="DOP853", rtol=1e-12, atol=1e-14 * size).y[:, -1]
        expected[k] = x
    np.testing.assert_allclose((states - expected) / size, 0.0, atol=1e-11)


def plain_loop(run_: Programme, n: int) -> tuple[Array, Array]:
    """States and current references of a run, sample by sample, written without any of the code under test."""
    plant, dt = run_.true_plant, 1.0 / run_.sample_rate_hz
    coil, g = plant.voice_coil, run_.schedule.at(50.0)
    assert coil is not None
    model = linear_model(plant, frequency_hz=50.0)
    size = len(model.A)
    coil_at = plant.actuator.index(coil)
    other = 1 - coil_at
    # x, held reference, excitation, its slope: one matrix exponential per sample period
    big = np.zeros((size + 3, size + 3))
    big[:size, :size] = model.A
    big[:size, size], big[:size, size + 1] = model.B[:, coil_at], model.B[:, other]
    big[size + 1, size + 2] = 1.0
    phi = expm(big * dt)

    def section(hz: float) -> tuple[Array, Array, Array, Array]:
        """Trapezoidal rule on the prewarped analogue section, in controller form."""
        w = 2.0 / dt * math.tan(math.pi * hz * dt)
        a, b = np.array([[0.0, 1.0], [-w * w, -math.sqrt(2.0) * w]]), np.array([0.0, 1.0])
        left = np.linalg.inv(np.eye(2) - 0.5 * dt * a)
        return (
            left @ (np.eye(2) + 0.5 * dt * a),
            left @ b * 0.5 * dt,
            np.array([w * w, 0.0]),
            np.array([0, 1]),
        )

    low, high = section(g.low_pass_hz), section(g.high_pass_hz)
    memory = [(np.zeros(2), 0.0) for _ in range(3)]

    def through(k: int, parts: tuple[Array, ...], out: Array, value: float) -> float:
        state, before = memory[k]
        state = parts[0] @ state + parts[1] * (before + value)
        memory[k] = (state, value)
        return float(out @ state)

    names = {name: k for k, name in enumerate(model.outputs)}
    seen = [names[f"{place}_acceleration"] for place in coil.between or ()]
    limit = plant.limits["vcm_current_a"]
    x, held, drive_before = np.zeros(size), 0.0, 0.0
    waiting = [0.0] * run_.loop_delay_samples
    states, references = np.zeros((n, size)), np.zeros(n)
    for k in range(n):
        f0, f1, duration = run_.sweep.from_hz, run_.sweep.to_hz, run_.sweep.duration_s  # type: ignore[union-attr]
        t = k * dt
        drive = run_.sweep.amplitude * math.sin(math.tau * (f0 * t + 0.5 * (f1 - f0) / duration * t * t))
        whole = np.concatenate([x, [held, drive_before, (drive - drive_before) / dt]])
        x, held, drive_before = (phi @ whole)[:size], waiting.pop(0), drive
        u = np.zeros(2)
        u[coil_at], u[other] = held, drive
        shown = []
        for row in seen:
            reach = plant.sensor[row].range or math.inf
            shown.append(min(max(model.C[row] @ x + model.D[row] @ u, -reach), reach))
        a = through(0, low[:2], low[2], shown[0] - shown[1])
        v = through(1, high[:2], high[3], a)
        s = through(2, high[:2], high[3], v)
        # Gains are those of the frequency at the block's ends, joined by a straight line.
        block, at = divmod(k, run_.block_samples)
        asked = 0.0
        table = (run_.schedule.alpha_kg, run_.schedule.beta_ns_m, run_.schedule.gamma_n_m)
        for column, motion in zip(table, (a, v, s), strict=True):
            begin, end = (
                np.interp(f0 + (f1 - f0) * j * run_.block_samples * dt / duration, (40.0, 60.0), column)
                for j in (block, block + 1)
            )
            asked += (begin + (end - begin) * at / run_.block_samples) * motion / coil.force_constant_n_a
        waiting.append(min(max(asked, -limit), limit))
        states[k], references[k] = x, held
    return states, references


@pytest.mark.parametrize("delay", [1, 4])
def test_controlled_run_equals_a_plain_sample_by_sample_loop(rig: Plant, delay: int) -> None:
    # Gains on all three motions, a clamp that is reached and a converter that ends too early.
    sensors = tuple(
        s.model_copy(update={"range": 20.0}) if s.name == "absorber_acceleration" else s for s in rig.sensor
    )
    plant = rig.model_copy(update={"sensor": sensors, "limits": rig.limits | {"vcm_current_a": 0.15}})
    schedule = flat(Gains(0.02, -7.0, -4000.0, 900.0, 2.5)).model_copy(
        update={"alpha_kg": (0.0, 0.04), "beta_ns_m": (-3.0, -11.0), "gamma_n_m": (-8000.0, 500.0)}
    )
    sweep = Sweep(from_hz=42.0, to_hz=58.0, duration_s=0.08, amplitude_v=4.0)
    run_ = programme(plant, sweep, schedule, block_samples=500, loop_delay_samples=delay)
    simulated = SimulatedRig(run_, keep_truth=True)
    states, inputs = run(simulated)
    expected, references = plain_loop(run_, len(states))
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose((states - expected) / size, 0.0, atol=1e-11)
    np.testing.assert_allclose(inputs[:, 0], references, atol=1e-11)
    assert not simulated.tripped
    assert np.mean(np.abs(references) == 0.15) > 0.05
    assert np.abs(references).min() < 0.15
    model = linear_model(plant, frequency_hz=50.0)
    row = model.outputs.index("absorber_acceleration")
    assert np.abs(states @ model.C[row] + inputs @ model.D[row]).max() > 20.0


# --- where it settles -----------------------------------------------------------------------------------------


def test_engine_settles_to_what_the_analysis_says_of_filters_and_delay(engine: Plant) -> None:
    hz, amplitude, cutoffs = 47.0, 1000.0, Cutoffs(2000.0, 0.5)
    schedule = scheduling_rule(engine, BAND_HZ, high_pass_hz=0.5, low_pass_hz=2000.0)
    tone = Tone(frequency_hz=hz, duration_s=25.0, amplitude_n=amplitude)
    simulated = SimulatedRig(programme(engine, tone, schedule), keep_truth=True)
    states, _ = run(simulated)
    assert not simulated.tripped
    got = phasors(states, hz, len(states))
    # Exactly: plant and hold, sampled filters, one sample of delay.
    expected = sampled_steady_state(engine, schedule.at(hz), hz, 1, amplitude)
    np.testing.assert_allclose(got, expected, rtol=1e-7)
    # In continuous time the sampled filters count as analogue ones, and the hold as half a sample of delay.
    law = choose_law(engine, "gain_scheduling", hz)
    point = analyse_point(engine, law, hz, excitation=amplitude, delay_s=1.5 / RATE_HZ, filters=cutoffs)
    assert abs(got[-1]) == pytest.approx(point.current_a, rel=1e-6)
    assert abs(got[0]) == pytest.approx(point.primary_displacement_m, rel=0.02)
    assert abs(got[0] - got[1]) == pytest.approx(point.stroke_m, rel=1e-4)
    # What is left of the case is damping that the filters' phase brings in: they cost 1.3 µm of the ideal 2.785.
    assert abs(got[-1]) == pytest.approx(5.780, abs=5e-4)
    assert abs(got[0]) == pytest.approx(4.07e-6, abs=0.01e-6)


@pytest.mark.parametrize(
    ("force_n", "case_um", "current_a"), [(1000.0, 2.785, 5.780), (3000.0, 8.355, 17.34)]
)
def test_engine_under_the_ideal_law_settles_at_the_figures_of_chapter_8(
    force_n: float, case_um: float, current_a: float
) -> None:
    plant, hz, rate = load_plant("engine_vcm"), 47.0, 20_000.0
    law = choose_law(plant, "gain_scheduling", hz)
    t = np.arange(int(45.0 * rate)) / rate
    signals = loop_response(build_loop(plant, law), force_n * np.sin(2.0 * np.pi * hz * t), rate)
    got = np.abs(phasors(signals, hz, len(t), 20_000, rate))
    assert got[0] * 1e6 == pytest.approx(case_um, abs=5e-4 * force_n / 1000.0)
    assert got[3] == pytest.approx(current_a, abs=1e-3 * force_n / 1000.0)
    # Joined by straight lines, the samples of a sine are a sine that is smaller by sinc².
    point = analyse_point(plant, law, hz, excitation=force_n * np.sinc(hz / rate) ** 2)
    assert got[0] == pytest.approx(point.primary_displacement_m, rel=1e-7)
    assert got[1:] == pytest.approx(
        [point.stroke_m, point.actuator_force_n, point.current_a, point.voltage_v], rel=1e-8
    )


@pytest.mark.parametrize("controller", ["passive", "gain_scheduling", "lq"])
@pytest.mark.parametrize("name", ["engine", "engine_vcm", "rig"])
def test_every_analysed_loop_settles_to_its_analysis(name: str, controller: str) -> None:
    plant, hz, rate = load_plant(name), 49.0, 20_000.0
    if name == "rig":
        plant = plant.model_copy(update={"actuator": plant.actuator[:1]})
    law = choose_law(plant, controller, hz)  # type: ignore[arg-type]
    loop = build_loop(plant, law, frequency_hz=hz)
    slowest = -float(loop.closed_poles.real.max())
    assert slowest > 0.0
    n = math.ceil((20.0 / slowest + 1.0) * rate)
    signals = loop_response(loop, np.sin(2.0 * np.pi * hz * np.arange(n) / rate), rate)
    got = phasors(signals, hz, n, 20_000, rate)
    expected = loop.steady(hz) * np.sinc(hz / rate) ** 2
    known = ~np.isnan(expected)
    assert np.array_equal(np.isnan(got), ~known)
    np.testing.assert_allclose(got[:2], expected[:2], rtol=1e-6, atol=1e-8 * abs(expected[1]))
    # With Table 6-2's weights the loop has poles up to 2.4e6 1/s: its force answers to the corners of joined lines.
    rest = (
        {"rtol": 0.03} if controller == "lq" else {"rtol": 1e-5, "atol": 1e-9 * np.abs(expected[known]).max()}
    )
    np.testing.assert_allclose(got[2:][known[2:]], expected[2:][known[2:]], **rest)


@pytest.mark.parametrize("filters", [Cutoffs(500.0, 2.0), None], ids=["filters", "ideal"])
@pytest.mark.parametrize("name", ["engine", "engine_vcm"])
def test_loop_response_follows_an_adaptive_integrator_from_any_start(
    name: str, filters: Cutoffs | None
) -> None:
    # Acceleration measured directly answers to the force at once: through the ideal actuator to its own force too.
    loop = build_loop(load_plant(name), Law(0.3, -2.0, -9e4), filters=filters)
    assert (loop.h != 0.0) == (filters is None)
    assert (loop.d != 0.0) == (filters is None and name == "engine")
    rng = np.random.default_rng(2)
    force, rate = 1000.0 * rng.normal(size=60), 10_000.0
    start = 1e-4 * rng.normal(size=len(loop.A))

    def asked(w: Array, pushed: float) -> float:
        return float((loop.c @ w + loop.h * pushed) / (1.0 - loop.d))

    got = loop_response(loop, force, rate, start)
    x, expected = start, [loop.rows @ start + loop.feed * asked(start, force[0])]
    for k in range(59):

        def slope(s: float, w: Array, k: int = k) -> Array:
            pushed = force[k] + (force[k + 1] - force[k]) * s * rate
            return np.asarray(loop.A @ w + loop.b * asked(w, pushed) + loop.e * pushed)

        x = solve_ivp(slope, (0.0, 1.0 / rate), x, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
        expected.append(loop.rows @ x + loop.feed * asked(x, force[k + 1]))
    size = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(got / size, expected / size, atol=1e-9)
    assert got.shape == (60, len(SIGNALS))


def test_law_that_answers_itself_at_once_has_no_motion() -> None:
    plant = load_plant("engine")
    loop = build_loop(plant, Law())
    broken = Loop(
        loop.A, loop.b, loop.c, 1.0, loop.e, loop.h, loop.rows, loop.feed, loop.mechanical_states, None
    )
    with pytest.raises(ValueError, match="no solution"):
        loop_response(broken, np.zeros(3), 1e3)
    assert loop_response(loop, [], 1e3).shape == (0, 5)


GRID_HZ = (47.0, 50.0, 53.0)


@pytest.mark.parametrize(
    ("name", "lengths", "high_pass_hz", "motion", "current_a"),
    [("rig", (8.0, 8.01, 8.003), 2.5, 1e-8, 1e-8), ("engine", (12.0, 18.01, 18.003), 0.5, 5e-3, 1e-4)],
)
def test_after_each_step_of_the_grid_the_loop_settles_where_that_frequency_has_it(
    name: str,
    lengths: tuple[float, ...],
    high_pass_hz: float,
    motion: float,
    current_a: float,
    request: pytest.FixtureRequest,
) -> None:
    plant: Plant = request.getfixturevalue(name)
    schedule = scheduling_rule(plant, GRID_HZ, high_pass_hz=high_pass_hz)
    amplitude = {"amplitude_v": 4.0} if name == "rig" else {"amplitude_n": 1000.0}
    if name == "engine":  # paired cutoffs leave it unstable at 47 Hz: there it takes a lag, at 53 Hz none
        schedule = schedule.model_copy(update={"low_pass_hz": (2_000.0, 5_000.0, 10_000.0)})
    steps = Steps(
        steps=tuple(Step(frequency_hz=f, duration_s=s) for f, s in zip(GRID_HZ, lengths, strict=True)),
        **amplitude,  # type: ignore[arg-type]
    )
    simulated = SimulatedRig(programme(plant, steps, schedule), keep_truth=True)
    states, inputs = run(simulated)
    assert not simulated.tripped
    driven = plant.actuator.index(exciter(plant, steps))
    coil = plant.voice_coil
    assert coil is not None
    column = linear_model(plant).states.index(f"i_{coil.name}")
    for end, hz in zip(np.cumsum(lengths), GRID_HZ, strict=True):
        last = min(round(end * RATE_HZ), len(states))
        drive = phasors(inputs[:, [driven]], hz, last)[0]
        assert abs(drive) == pytest.approx(steps.amplitude, rel=1e-9)
        got = phasors(states, hz, last) / drive * steps.amplitude  # against the excitation's own phase
        expected = sampled_steady_state(plant, schedule.at(hz), hz, 1, steps.amplitude)
        assert abs(got[0] - expected[0]) < motion * abs(expected[0])
        assert abs(got[column] - expected[column]) < current_a


def test_stroke_passed_before_a_jump_trips_the_guard_though_it_is_small_again_after(rig: Plant) -> None:
    steps = Steps(
        steps=tuple(Step(frequency_hz=f, duration_s=s) for f, s in ((50.0, 0.5), (400.0, 0.3), (400.0, 0.2))),
        amplitude_v=4.0,
    )
    simulated = SimulatedRig(
        programme(rig, steps, scheduling_rule(rig, BAND_HZ), block_samples=50_000), keep_truth=True
    )
    simulated.next_block()
    strokes = [np.abs(t.states[:, 0] - t.states[:, 1]).max() for t in simulated.truth]
    assert len(strokes) == 3
    assert strokes[2] < 0.2 * strokes[0]
    tight = rig.model_copy(update={"limits": rig.limits | {"stroke_m": 0.5 * strokes[0]}})
    tripped = SimulatedRig(programme(tight, steps, scheduling_rule(rig, BAND_HZ), block_samples=50_000))
    tripped.next_block()
    assert tripped.tripped.startswith("stroke ")


# --- how a run is cut does not matter -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "excitation",
    [
        Sweep(from_hz=45.0, to_hz=55.0, duration_s=1.0, amplitude_v=4.0),
        Tone(frequency_hz=49.0, duration_s=1.0, amplitude_v=4.0),
        Steps(
            steps=(
                Step(frequency_hz=47.0, duration_s=0.4203),
                Step(frequency_hz=50.0, duration_s=0.3),
                Step(frequency_hz=53.0, duration_s=0.2797),
            ),
            amplitude_v=4.0,
        ),
    ],
    ids=["sweep", "tone", "steps"],
)
def test_blocks_of_500_and_of_5000_samples_give_the_same_bits(excitation: Sweep | Steps | Tone) -> None:
    plant = load_plant("rig")  # with its sensor noise
    schedule = flat(Gains(0.01, -5.0, -3000.0, 1000.0, 2.5))
    if isinstance(excitation, Steps):  # each step has one frequency: the gains may follow it
        schedule = scheduling_rule(plant, BAND_HZ)
    runs = []
    for block in (500, 5_000):
        simulated = SimulatedRig(programme(plant, excitation, schedule, block_samples=block, seed=3))
        values = []
        while not simulated.finished:
            values.append(simulated.next_block()[0])
        runs.append(np.concatenate(values))
    assert runs[0].shape == (50_000, 7)
    assert runs[0].tobytes() == runs[1].tobytes()
    assert np.abs(runs[0][:, -1]).max() > 0.05


def test_control_leaves_the_moment_the_grid_steps_out_of_its_band(rig: Plant) -> None:
    steps = Steps(
        steps=(
            Step(frequency_hz=50.0, duration_s=0.25),
            Step(frequency_hz=58.0, duration_s=0.15),
            Step(frequency_hz=54.0, duration_s=0.2),
        ),
        amplitude_v=4.0,
    )
    schedule = scheduling_rule(rig, BAND_HZ)
    simulated = SimulatedRig(programme(rig, steps, schedule), keep_truth=True)
    acted, references = [], []
    while not simulated.finished:
        acted.append(simulated.next_block()[1])
        references.append(np.concatenate([t.inputs[1:, 0] for t in simulated.truth]))
    assert acted == [True, True, False, False, True, True]
    reference = np.concatenate(references)
    # The converter shows a command one sample after it was computed.
    assert reference[12_500] != 0.0
    assert not reference[12_501:20_001].any()
    assert reference[20_001] != 0.0


def test_engine_on_a_stepping_grid_runs_in_a_process_of_its_own_with_the_same_bits(engine: Plant) -> None:
    steps = Steps(
        steps=(Step(frequency_hz=47.0, duration_s=0.33), Step(frequency_hz=50.0, duration_s=0.17)),
        amplitude_n=1000.0,
    )
    run_ = programme(engine, steps, scheduling_rule(engine, GRID_HZ), seed=1, disturbance_density_n=0.1)
    alone, blocks = SimulatedRig(run_), 0
    with EmbeddedRig(run_, speed=0.0) as there:
        there.connect()
        for block in there.blocks():
            values, on, _ = alone.next_block()
            np.testing.assert_array_equal(block.values, values.astype(np.float64))
            assert block.control_on == on
            there.gateway.heartbeat(block.end_sample)
            blocks += 1
    assert blocks == 5
    assert alone.finished


# --- excitation as data -----------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=50)
@given(
    hz=st.lists(st.floats(1.0, 400.0), min_size=1, max_size=6),
    seconds=st.lists(st.floats(0.001, 0.5), min_size=6, max_size=6),
    cut=st.integers(1, 4_999),
)
def test_steps_go_on_in_phase_wherever_they_jump_and_however_they_are_cut(
    hz: list[float], seconds: list[float], cut: int
) -> None:
    steps = Steps(
        steps=tuple(Step(frequency_hz=f, duration_s=s) for f, s in zip(hz, seconds, strict=False)),
        amplitude_n=2.0,
    )
    rate = 5_000.0
    whole = steps.samples(0, 5_000, rate)
    parts = np.concatenate([steps.samples(0, cut, rate), steps.samples(cut, 5_000 - cut, rate)])
    assert whole.tobytes() == parts.tobytes()
    # No sample is further from the one before than the fastest sine could bring it.
    assert np.abs(np.diff(whole)).max() <= 2.0 * 2.0 * np.pi * max(hz) / rate + 1e-9
    # Phase is the integral of frequency.
    t = np.arange(5_000) / rate
    edges = np.concatenate([[0.0], np.cumsum([s.duration_s for s in steps.steps])])
    turns = np.concatenate([[0.0], np.cumsum([s.frequency_hz * s.duration_s for s in steps.steps])])
    edges[-1], turns[-1] = 1e3, turns[-2] + steps.steps[-1].frequency_hz * (1e3 - edges[-2])
    np.testing.assert_allclose(whole, 2.0 * np.sin(2.0 * np.pi * np.interp(t, edges, turns)), atol=1e-9)
    spans = steps.spans(0, 5_000, rate)
    assert [spans[0].first, spans[-1].stop] == [0, 5_000]
    assert all(a.stop == b.first for a, b in pairwise(spans))
    assert all(
        steps.frequency_at(k, rate) == s.from_hz == s.to_hz for s in spans for k in (s.first, s.stop - 1)
    )


def test_steps_in_decimal_seconds_jump_on_their_sample() -> None:
    steps = Steps(
        steps=tuple(Step(frequency_hz=f, duration_s=0.1) for f in (47.0, 50.0, 53.0, 50.0)), amplitude_v=1.0
    )
    assert steps.starts(RATE_HZ) == (0, 5_000, 10_000, 15_000)
    assert steps.duration_s == 0.4
    assert steps.frequency_at(10**9, RATE_HZ) == 50.0


def test_duration_in_decimal_seconds_loses_no_block(rig: Plant) -> None:
    schedule = flat(Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    tone = Tone(frequency_hz=50.0, duration_s=0.29, amplitude_v=1.0)
    assert programme(rig, tone, schedule, block_samples=500).n_blocks == 29
    assert programme(rig, tone, schedule, block_samples=5_000).n_blocks == 2


def test_tone_is_a_sweep_that_stays() -> None:
    tone = Tone(frequency_hz=47.0, duration_s=1.0, amplitude_a=2.0)
    sweep = Sweep(from_hz=47.0, to_hz=47.0, duration_s=1.0, amplitude_a=2.0)
    np.testing.assert_allclose(tone.samples(7, 500, 1e4), sweep.samples(7, 500, 1e4), atol=1e-12)
    assert tone.spans(7, 500, 1e4) == sweep.spans(7, 500, 1e4)
    assert tone.frequency_at(3, 1e4) == 47.0


FORMS: list[dict[str, object]] = [
    {"from_hz": 40.0, "to_hz": 60.0, "duration_s": 60.0, "amplitude_v": 4.0},
    {"frequency_hz": 47.0, "duration_s": 2.0, "actuator": "shaker", "amplitude_v": 1.0},
    {
        "steps": [{"frequency_hz": 47.0, "duration_s": 1.0}, {"frequency_hz": 53.0, "duration_s": 0.5}],
        "amplitude_v": 2.0,
    },
]


@pytest.mark.parametrize("form", FORMS, ids=["sweep", "tone", "steps"])
def test_programme_goes_through_json_and_says_only_what_was_given(
    rig: Plant, form: dict[str, object]
) -> None:
    schedule = flat(Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    original = programme(rig, Tone(frequency_hz=50.0, duration_s=1.0, amplitude_v=1.0), schedule)
    data = original.model_dump(mode="json") | {"sweep": form}
    read = Programme.model_validate_json(json.dumps(data))
    assert set(read.model_dump(mode="json")["sweep"]) == set(form)
    assert read.model_dump(mode="json")["sweep"] == form
    assert read.sweep.description
    assert Programme.model_validate_json(read.model_dump_json()) == read


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"amplitude_v": None}, "give one of amplitude_v, amplitude_n, amplitude_a, got none"),
        ({"amplitude_n": 3.0}, "got amplitude_v, amplitude_n"),
        ({"amplitude_v": None, "amplitude_n": 3.0}, r"'shaker' is driven in V, .* in N: give amplitude_v"),
        ({"actuator": "vcm"}, r"'vcm' cannot excite plant 'rig'; those that can: shaker"),
        ({"duration_s": 0.0}, "greater than 0"),
        ({"from_hz": math.inf}, "finite number"),
        ({"speed": 1.0}, "sweep.sweep.speed"),
    ],
)
def test_excitation_that_does_not_fit_is_refused_with_the_remedy(
    rig: Plant, change: dict[str, object], complaint: str
) -> None:
    schedule = flat(Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    original = programme(rig, Tone(frequency_hz=50.0, duration_s=1.0, amplitude_v=1.0), schedule)
    data = original.model_dump(mode="json") | {"sweep": FORMS[0] | change}
    with pytest.raises(ValidationError, match=complaint):
        Programme.model_validate_json(json.dumps(data))


def test_plant_that_nothing_excites_is_no_rig(rig: Plant) -> None:
    alone = rig.model_copy(update={"actuator": rig.actuator[:1], "sensor": rig.sensor[:4]})
    with pytest.raises(ValidationError, match="no actuator besides its coil"):
        programme(
            alone,
            Tone(frequency_hz=50.0, duration_s=1.0, amplitude_v=1.0),
            flat(Gains(0.0, 0.0, 0.0, 200.0, 1.0)),
        )


def test_excitation_may_choose_among_actuators(rig: Plant) -> None:
    more = rig.model_copy(
        update={"actuator": (*rig.actuator, ForceActuator(name="hammer", kind="force", on="table"))}
    )
    tone = Tone(frequency_hz=50.0, duration_s=1.0, amplitude_n=1.0, actuator="hammer")
    assert exciter(more, tone).name == "hammer"
    assert exciter(more, Tone(frequency_hz=50.0, duration_s=1.0, amplitude_v=1.0)).name == "shaker"


# --- what the law measures ----------------------------------------------------------------------------------------


def test_engine_needs_accelerometers_to_be_controlled(engine: Plant) -> None:
    plant = engine.model_copy(update={"sensor": load_plant("engine_vcm").sensor})
    tone = Tone(frequency_hz=47.0, duration_s=1.0, amplitude_n=1000.0)
    run_ = programme(plant, tone, scheduling_rule(plant, BAND_HZ))
    with pytest.raises(ValueError, match=r"accelerometer on body 'case': .* of = \"case\""):
        SimulatedRig(run_)


def test_accelerometers_are_added_only_where_they_are_missing(rig: Plant) -> None:
    assert with_accelerometers(rig, 1.0) == rig
    added = with_accelerometers(load_plant("engine_vcm"), 2e-3)
    assert [(s.name, s.of, s.noise_density) for s in added.sensor[-2:]] == [
        ("case_acceleration", "case", 2e-3),
        ("absorber_acceleration", "absorber", 2e-3),
    ]
    assert isinstance(added.voice_coil, VoiceCoil)
    with pytest.raises(ValueError, match="has no voice coil"):
        with_accelerometers(load_plant("engine"), 1.0)


@pytest.mark.parametrize("leg_s", [0.37, 2.0])
def test_shuttle_goes_to_and_fro_in_phase_however_it_is_cut(leg_s: float) -> None:
    fs, shuttle = 5_000.0, Shuttle(from_hz=47.0, to_hz=53.0, leg_s=leg_s, duration_s=10.0, amplitude_n=2.0)
    n = int(4.5 * leg_s * fs)
    whole = shuttle.samples(0, n, fs)
    cut = np.concatenate([shuttle.samples(a, min(777, n - a), fs) for a in range(0, n, 777)])
    np.testing.assert_allclose(cut, whole, atol=1e-12)
    # The phase is the integral of the frequency: summed here by the trapezoidal rule.
    hz = np.array([shuttle.frequency_at(k, fs) for k in range(n)])
    turns = np.concatenate([[0.0], np.cumsum(0.5 * (hz[1:] + hz[:-1]) / fs)])
    np.testing.assert_allclose(whole, 2.0 * np.sin(2.0 * np.pi * turns), atol=2e-3)
    assert hz.min() == pytest.approx(47.0, abs=0.01)
    assert hz.max() == pytest.approx(53.0, abs=0.01)
    spans = shuttle.spans(0, n, fs)
    assert [s.first for s in spans] == [0, *(s.stop for s in spans[:-1])]
    assert len(spans) == 5
    for span in spans:
        np.testing.assert_allclose(span.from_hz, hz[span.first], atol=1e-9)
    assert shuttle.spans(100, 50, fs) == [Span(100, 150, hz[100], hz[150])]
