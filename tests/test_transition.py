"""Moving frequencies: what is proven holds in simulation, what is not so is never proven, sweeps follow the rig."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tuning.loop import LoopFacts, RigModel, loop_facts
from tuning.rule import scheduling_rule
from tuning.steady import predict
from tuning.sweep import simulate_sweep
from tuning.transition import TransitionCertificate, check_transition, decay_of_function_1_s
from twin.control.schedule import GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.programme import Sweep
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import programme

Array = NDArray[np.float64]
FACTS = LoopFacts(50_000.0, 1)
DT = 1.0 / FACTS.sample_rate_hz
TEST_1, TEST_3 = programme("test1"), programme("test3")
RIG = load_plant("rig")


class Loop:
    """Closed loop against frequency, from a table so dense that straight lines between its rows are exact enough."""

    def __init__(self, plant: Plant, schedule: GainSchedule, facts: LoopFacts = FACTS, step_hz: float = 0.05):
        self.low, self.step = schedule.on_from_hz, step_hz
        count = round((schedule.on_to_hz - self.low) / step_hz) + 1
        self.A = np.array(
            [
                RigModel(plant, facts, f).closed_loop_matrix(schedule.at(f))
                for f in self.low + step_hz * np.arange(count)
            ]
        )

    def at(self, hz: float) -> Array:
        place = min(max((hz - self.low) / self.step, 0.0), len(self.A) - 1.0)
        row = min(int(place), len(self.A) - 2)
        share = place - row
        return (1.0 - share) * self.A[row] + share * self.A[row + 1]

    def growth_1_s(self, path_hz: Array) -> float:
        """Growth of the loop whose frequency goes along a closed path again and again: its monodromy matrix."""
        turn = np.eye(len(self.A[0]))
        for hz in path_hz:
            turn = self.at(float(hz)) @ turn
        return math.log(float(np.abs(np.linalg.eigvals(turn)).max())) / (len(path_hz) * DT)


def triangle(centre_hz: float, rate_hz_s: float, period_s: float, reach_hz: float) -> Array:
    """To and fro at a rate, held at a reach."""
    phase = np.arange(round(period_s / DT)) * DT / period_s
    swing = 0.25 * rate_hz_s * period_s * (4.0 * np.abs(phase - 0.5) - 1.0)
    return centre_hz + np.clip(swing, -reach_hz, reach_hz)


@pytest.fixture(scope="module")
def proof() -> TransitionCertificate:
    return check_transition(TEST_3.true_plant, FACTS, TEST_3.schedule, most_solves=2, enough_hz_s=20.0)


@pytest.fixture(scope="module")
def loop() -> Loop:
    return Loop(TEST_3.true_plant, TEST_3.schedule)


# --- the table ------------------------------------------------------------------------------------------------


@st.composite
def schedules(draw: st.DrawFn) -> GainSchedule:
    n = draw(st.integers(1, 6))
    steps = draw(st.lists(st.floats(0.05, 4.0), min_size=n, max_size=n))
    hz = tuple(float(f) for f in 44.0 + np.cumsum(steps))
    columns = {
        name: tuple(draw(st.lists(st.floats(low, high), min_size=n, max_size=n)))
        for name, low, high in (
            ("alpha_kg", -0.1, 0.2),
            ("beta_ns_m", -12.0, 30.0),
            ("gamma_n_m", -8e3, 8e3),
            ("low_pass_hz", 300.0, 3000.0),
            ("high_pass_hz", 0.5, 5.0),
        )
    }
    return GainSchedule(frequency_hz=hz, **columns, on_from_hz=hz[0], on_to_hz=hz[-1])


@settings(max_examples=60, deadline=None)
@given(schedule=schedules(), hz=st.floats(40.0, 70.0), step=st.floats(1e-9, 0.5))
def test_gains_and_cutoffs_move_no_faster_than_the_steepest_row_to_row(
    schedule: GainSchedule, hz: float, step: float
) -> None:
    a, b = schedule.at(hz).as_tuple(), schedule.at(hz + step).as_tuple()
    names = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
    for before, after, name in zip(a, b, names, strict=True):
        rows = list(zip(schedule.frequency_hz, getattr(schedule, name), strict=True))
        steepest = max((abs((y2 - y1) / (x2 - x1)) for (x1, y1), (x2, y2) in pairwise(rows)), default=0.0)
        size = max(abs(y) for _, y in rows)
        assert abs(after - before) <= steepest * step * (1.0 + 1e-9) + 1e-12 * size


# --- what is proven -------------------------------------------------------------------------------------------


def test_gains_unstable_above_51_hz_are_never_shown_to_be_safe() -> None:
    found = check_transition(TEST_1.true_plant, FACTS, TEST_1.schedule)
    assert not found.shown
    assert found.fastest_sweep_hz_s == 0.0
    assert found.worst_margin_1_s == pytest.approx(
        -RigModel(TEST_1.true_plant, FACTS, 55.0).decay_rate_1_s(TEST_1.schedule.at(55.0)), rel=1e-6
    )
    assert "from 51.75 to 55 Hz" in found.reason


def test_same_gains_are_shown_where_they_are_stable() -> None:
    below = TEST_1.schedule.model_copy(update={"on_to_hz": 51.0})
    assert check_transition(TEST_1.true_plant, FACTS, below, most_solves=0).shown


def test_controller_that_does_nothing_may_be_moved_as_fast_as_one_likes() -> None:
    still = TEST_3.schedule.model_copy(
        update=dict.fromkeys(("alpha_kg", "beta_ns_m", "gamma_n_m"), (0.0,) * 21)
        | {"low_pass_hz": (1000.0,) * 21}
    )
    found = check_transition(RIG, FACTS, still)
    assert found.shown
    assert found.method == "one function"
    assert found.fastest_sweep_hz_s == math.inf
    for hz in (45.0, 48.7, 55.0):
        assert decay_of_function_1_s(RIG, FACTS, still, found, hz, 1e9) > 0.0


def test_controller_at_one_frequency_is_proven_there() -> None:
    one = TEST_3.schedule.model_copy(update={"on_from_hz": 50.0, "on_to_hz": 50.0})
    assert check_transition(TEST_3.true_plant, FACTS, one).fastest_sweep_hz_s == math.inf


def test_retuning_rig_is_proven_for_sweeps_faster_than_any_grid(proof: TransitionCertificate) -> None:
    assert proof.shown
    assert proof.method == "function of frequency"
    assert proof.fastest_sweep_hz_s > 10.0
    assert proof.worst_margin_1_s > 0.0
    assert "no one function can hold" in proof.reason


def test_certificate_stands_up_to_plain_eigenvalues_at_frequencies_it_was_not_chosen_on(
    proof: TransitionCertificate,
) -> None:
    rate = proof.fastest_sweep_hz_s
    step = rate * DT
    for hz in np.random.default_rng(1).uniform(45.0 + step, 55.0 - step, 60):
        A = RigModel(TEST_3.true_plant, FACTS, float(hz)).closed_loop_matrix(TEST_3.schedule.at(float(hz)))
        P = proof.function_at(float(hz))
        root = np.linalg.cholesky(P)
        for ahead in (hz - step, hz, hz + step):
            after = np.linalg.cholesky(proof.function_at(float(ahead))).T @ A @ np.linalg.inv(root.T)
            assert np.linalg.norm(after, 2) < 1.0  # |x+| < |x| measured by the function before and after


@pytest.mark.parametrize("seed", range(3))
def test_function_falls_at_every_sample_while_the_frequency_wanders(
    proof: TransitionCertificate, loop: Loop, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    step = 0.99 * proof.fastest_sweep_hz_s * DT
    hz, heading, x = 50.0, 1.0, rng.standard_normal(len(loop.A[0]))
    value = float(x @ proof.function_at(hz) @ x)
    start = value
    for k in range(20_000):
        if k % 97 == 0:
            heading = float(rng.choice([-1.0, 1.0]))
        x = loop.at(hz) @ x
        hz = min(max(hz + heading * step, 45.0), 55.0)
        if k % 20 == 0:
            now = float(x @ proof.function_at(hz) @ x)
            assert now < value
            value = now
    assert value < 0.5 * start


def test_no_way_of_going_to_and_fro_refutes_the_certificate_and_some_faster_ones_do_destabilise(
    proof: TransitionCertificate, loop: Loop
) -> None:
    for centre, reach in ((47.0, 2.0), (50.0, 5.0), (53.0, 2.0)):
        for period in (0.009, 0.02, 0.05, 0.15):
            path = triangle(centre, proof.fastest_sweep_hz_s, period, reach)
            assert loop.growth_1_s(path) < 0.0
    assert max(loop.growth_1_s(triangle(50.0, 6000.0, period, 5.0)) for period in (0.009, 0.018)) > 1.0


def test_tampering_with_the_function_is_noticed(proof: TransitionCertificate) -> None:
    functions = proof.functions.copy()
    functions[5] *= 1.5
    forged = TransitionCertificate(
        True, proof.method, proof.fastest_sweep_hz_s, 1.0, "", proof.knots_hz, functions
    )
    decays = [
        decay_of_function_1_s(
            TEST_3.true_plant, FACTS, TEST_3.schedule, forged, float(f), proof.fastest_sweep_hz_s
        )
        for f in proof.knots_hz
    ]
    assert min(decays) < 0.0


@settings(max_examples=6, deadline=None)
@given(schedule=schedules(), delay_us=st.floats(0.0, 60.0))
def test_whatever_is_shown_of_random_tables_holds_when_the_frequency_goes_to_and_fro(
    schedule: GainSchedule, delay_us: float
) -> None:
    facts = loop_facts(50_000.0, 1e-6 * delay_us)
    found = check_transition(RIG, facts, schedule, most_solves=0)
    low, high = schedule.on_from_hz, schedule.on_to_hz
    growth = [
        RigModel(RIG, facts, f).decay_rate_1_s(schedule.at(f)) for f in np.linspace(low, high, 7).tolist()
    ]
    if max(growth) >= 0.0:
        assert not found.shown
    if not found.shown or high == low:
        return
    rate = min(found.fastest_sweep_hz_s, 5e3)
    going = Loop(RIG, schedule, facts, step_hz=(high - low) / 100.0)
    assert going.growth_1_s(triangle(0.5 * (low + high), rate, 0.02, 0.5 * (high - low))) < 0.0


# --- sweeps ---------------------------------------------------------------------------------------------------


def test_sweep_is_the_simulated_rig_without_its_noise() -> None:
    quiet = RIG.model_copy(
        update={"sensor": tuple(s.model_copy(update={"noise_density": 1e-30}) for s in RIG.sensor)}
    )
    sweep = Sweep(from_hz=44.8, to_hz=45.8, duration_s=2.0, amplitude_v=4.0)
    run = TEST_3.model_copy(update={"plant": quiet, "sweep": sweep, "disturbance_density_n": 0.0})
    rig = SimulatedRig(run, keep_truth=True)
    motion, current = [], []
    while not rig.finished:
        rig.next_block()
        (truth,) = rig.truth
        motion.append(np.abs(truth.states[1:, truth.model.states.index("x_table")]).max())
        current.append(np.abs(truth.states[1:, truth.model.states.index("i_vcm")]).max())
    found = simulate_sweep(run.true_plant, FACTS, run.schedule, 44.8, 45.8, 2.0, 4.0)
    assert found.control_on.sum() == 16
    np.testing.assert_allclose(found.displacement_m, motion, rtol=1e-6)
    np.testing.assert_allclose(found.current_peak_a, current, rtol=1e-6)


@pytest.mark.parametrize("delay_us", [0.0, 33.0, 50.0])
def test_frequency_that_stands_still_settles_to_the_steady_state(delay_us: float) -> None:
    facts = loop_facts(50_000.0, 1e-6 * delay_us)
    found = simulate_sweep(TEST_3.true_plant, facts, TEST_3.schedule, 52.0, 52.0, 4.0, 4.0)
    steady = predict(RigModel(TEST_3.true_plant, facts, 52.0), TEST_3.schedule.at(52.0), 52.0, 4.0)
    assert found.displacement_m[-1] == pytest.approx(steady.displacement_m, rel=2e-3)
    assert found.stroke_m[-1] == pytest.approx(steady.stroke_m, rel=1e-3)
    assert found.current_peak_a[-1] == pytest.approx(steady.current_peak_a, rel=1e-3)
    # A block is no whole number of periods: means over one are a little off.
    assert np.mean(found.joule_mean_w[-10:]) == pytest.approx(steady.powers.joule_mean_w, rel=5e-3)
    assert np.mean(found.electrical_mean_w[-10:]) == pytest.approx(steady.powers.electrical_mean_w, rel=2e-2)
    assert found.sweep_rate_hz_s == 0.0


def test_slow_sweep_follows_its_steady_states_and_the_first_tests_gains_run_away() -> None:
    good = simulate_sweep(TEST_3.true_plant, FACTS, TEST_3.schedule, 51.0, 54.0, 9.0, 4.0)
    assert good.sweep_rate_hz_s == pytest.approx(1.0 / 3.0)
    assert good.worst_excess_m(settled_blocks=20) < 0.03 * float(good.steady_displacement_m.max())
    assert not good.saturated.any()
    bad = simulate_sweep(TEST_1.true_plant, FACTS, TEST_1.schedule, 51.0, 54.0, 9.0, 4.0)
    assert bad.worst_excess_m() > 5.0 * float(good.steady_displacement_m.max())
    assert bad.saturated[-1] > 0.1
    assert bad.current_peak_a.max() < 2.2  # the clamp holds; the coil's own dynamics add little


def test_disturbance_dies_out_without_excitation() -> None:
    start = np.array([1e-4, -1e-4, 0.0, 0.0, 0.0, 0.0])
    found = simulate_sweep(TEST_3.true_plant, FACTS, TEST_3.schedule, 46.0, 54.0, 3.0, 0.0, start=start)
    assert found.displacement_m[-1] < 1e-3 * found.displacement_m[0]
    assert not found.steady_displacement_m.any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"from_hz": 0.0}, "0 Hz cannot be run"),
        ({"to_hz": 30_000.0}, "30000 Hz cannot be run"),
        ({"to_hz": math.nan}, "cannot be run"),
        ({"seconds": 0.01}, "0.01 s cannot be run"),
        ({"seconds": math.inf}, "cannot be run"),
        ({"excitation_amplitude": -1.0}, "amplitude"),
        ({"clamp_a": 0.0}, "clamp must be above 0 A"),
        ({"start": np.zeros(3)}, "the plant has 6 states"),
        ({"plant": RIG.model_copy(update={"limits": {}})}, r"limits.vcm_current_a \[A\] is missing"),
    ],
)
def test_sweep_that_cannot_be_run_says_why(change: dict[str, object], words: str) -> None:
    plain = {
        "plant": RIG, "facts": FACTS, "schedule": scheduling_rule(RIG, (45.0, 55.0)), "from_hz": 46.0,
        "to_hz": 47.0, "seconds": 0.2, "excitation_amplitude": 1.0,
    }  # fmt: skip
    with pytest.raises(InputError, match=words):
        simulate_sweep(**(plain | change))  # type: ignore[arg-type]
