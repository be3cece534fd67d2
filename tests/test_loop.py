"""The sampled loop against python-control, the simulated rig and a plant stepped finely through the delay."""

import math

import control
import numpy as np
import pytest
from numpy.typing import NDArray
from tuned import FACTS, RATE_HZ, RIG, TEST_3, VOLTS, Array, phasors, simulate, unlimited

from tuning.loop import LoopFacts, Margins, RigModel, loop_facts, margin_grid, margins
from tuning.rule import scheduled_stiffness
from tuning.steady import predict
from twin.control.chain import chain_step
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.plant.linear import linear_model, natural_frequencies_hz


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


def test_margins_of_no_loop_are_one_and_any_delay() -> None:
    grid = margin_grid(RATE_HZ, [11.0, 55.0], 50)
    none = margins(np.ones((len(grid), 3), complex), grid, Gains(0.0, 0.0, 0.0, 200.0, 1.0))
    assert none == Margins(1.0, None)


@pytest.mark.parametrize("delay_us", [0.0, 4.0, 14.0, 20.0, 34.0, 50.0])
def test_delay_of_part_of_a_sample_is_that_of_a_plant_stepped_ten_times_as_finely(delay_us: float) -> None:
    coarse, fine = loop_facts(RATE_HZ, 1e-6 * delay_us), LoopFacts(10.0 * RATE_HZ, 0)
    assert coarse.delay_s == pytest.approx(1e-6 * delay_us, abs=1e-15)
    gains = Gains(0.02, -9.0, 1500.0, 1123.6, 2.5)
    model, stepped = RigModel(RIG, coarse, 53.0), RigModel(RIG, fine, 53.0).discrete
    n, late = len(stepped.F), round(delay_us / 2.0)
    # The coil's command changes ``late`` fine steps after its sample: the whole loop over one sample, by stepping.
    A = model.closed_loop_matrix(gains)
    whole, part = divmod(late, 10)
    rng = np.random.default_rng(1)
    state = rng.standard_normal(len(A)) * np.r_[np.full(n, 1e-4), np.full(len(A) - n, 1e-2)]
    after = A @ state
    line = state[n + 6 :]
    # Without a line of waiting commands the newest acts at once: its share of the state's change gives it away.
    command = A[n + 6] @ state if len(line) else _command(model, gains, state)
    sent = [command, *line]
    x = state[:n].copy()
    for step in range(10):
        held = sent[whole + 1] if step < part else sent[whole]
        x = stepped.F @ x + stepped.B0[:, model.coil_input] * held
    np.testing.assert_allclose(after[:n], x, rtol=1e-9, atol=1e-15)


def test_facts_of_a_delay_that_is_no_number_of_samples_are_refused() -> None:
    for samples, share in ((-1, 0.0), (1, 1.0), (1, -0.1), (0, math.nan)):
        with pytest.raises(ValueError, match="a delay is whole samples"):
            LoopFacts(RATE_HZ, samples, True, share)
    with pytest.raises(ValueError, match="sample rate must be above 0"):
        LoopFacts(0.0, 1)


def test_slopes_of_the_slowest_poles_are_differences_of_their_decay() -> None:
    model = RigModel(RIG, loop_facts(RATE_HZ, 50e-6), 53.0)
    numbers = np.array([0.02, -9.0, 1500.0])

    def gains(x: Array) -> Gains:
        alpha, beta, gamma = map(float, x)
        return Gains(alpha, beta, gamma, 1123.6, 2.5)

    rates, slopes = model.slowest_poles(gains(numbers), 3)
    assert rates[0] == pytest.approx(model.decay_rate_1_s(gains(numbers)), rel=1e-9)
    for k, step in enumerate((1e-5, 1e-3, 1e-1)):
        off = np.zeros(3)
        off[k] = step
        ends = [model.slowest_poles(gains(numbers + sign * off), 3)[0] for sign in (1.0, -1.0)]
        np.testing.assert_allclose(slopes[:, k], (ends[0] - ends[1]) / (2.0 * step), rtol=5e-3, atol=1e-6)


def _command(model: RigModel, gains: Gains, state: Array) -> float:
    """What the law commands from plant and filter states, by stepping the filter chain itself."""
    n = len(model.discrete.F)
    acceleration = float(model.stepping().C[0] @ state[:n])
    filtered = chain_step(
        state[n : n + 6].copy(), acceleration, math.tan(math.pi * gains.low_pass_hz / RATE_HZ),
        math.tan(math.pi * gains.high_pass_hz / RATE_HZ), 1.0 / RATE_HZ,
    )  # fmt: skip
    return float(np.dot(filtered, (gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m)) / 8.0)
