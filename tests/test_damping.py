"""Coil damping from the force balance: exact on exact phasors, honest about its noise, learned from a sweep."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from estimators.damping import AbsorberBalance, DampingLearner, ForceBalance, LearnerSettings
from estimators.excitation import ExcitationTracker
from estimators.types import DampingCurve, Phasors
from tuning.loop import LoopFacts, RigModel
from tuning.retune import predict
from tuning.rule import scheduled_stiffness, scheduling_rule
from twin.control.schedule import Gains, GainSchedule
from twin.plant.blocks import Channel, make_block
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.rig.programme import Programme, Sweep
from twin.rig.simulated import SimulatedRig

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
NAMES = ("table_acceleration", "absorber_acceleration", "vcm_current")
GRID_HZ = tuple(np.linspace(45.0, 55.0, 21).tolist())
THESIS_DAMPING = DampingTable(
    frequency_hz=GRID_HZ, ns_m=tuple(9.58 * f - 0.103 * f**2 - 208.0 for f in GRID_HZ)
)


@pytest.fixture(scope="module")
def rig() -> Plant:
    return load_plant("rig")


def exact_phasors(
    s: complex,
    table: complex,
    absorber: complex,
    damping: float,
    stiffness: float,
    *,
    with_slope: bool = True,
) -> Phasors:
    """Phasors of motions ``Re{X e^(st)}`` that obey the absorber's equation with given damping and stiffness."""
    relative = absorber - table
    current = (0.4125 * s**2 * absorber + (stiffness + damping * s) * relative) / 8.0
    amplitude = np.array([s**2 * table, s**2 * absorber, current])
    return Phasors(
        frequency_hz=s.imag / math.tau,
        frequency_std_hz=1e-6,
        reference="shaker_voltage",
        channels=NAMES,
        amplitude=amplitude,
        slope=amplitude * s.real if with_slope else np.zeros(3, complex),
        variance=np.full(3, 1e-8),
    )


size, angle = st.floats(1e-6, 1e-3), st.floats(0.0, 2.0 * math.pi)


# --- the balance --------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(
    hz=st.floats(30.0, 70.0),
    damping=st.floats(0.0, 40.0),
    stiffness=st.floats(2e4, 8e4),
    sizes=st.tuples(size, size),
    angles=st.tuples(angle, angle),
)
def test_phasors_that_obey_newton_give_back_damping_and_stiffness(
    hz: float, damping: float, stiffness: float, sizes: tuple[float, float], angles: tuple[float, float]
) -> None:
    table, absorber = (a * np.exp(1j * p) for a, p in zip(sizes, angles, strict=True))
    if abs(table - absorber) < 1e-2 * max(sizes):
        return
    balance = AbsorberBalance(load_plant("rig"), NAMES).solve(
        exact_phasors(2j * math.pi * hz, table, absorber, damping, stiffness)
    )
    scale = stiffness / (2 * math.pi * hz)  # what a damping of the spring's own size would be
    assert balance.damping_ns_m == pytest.approx(damping, abs=1e-9 * scale)
    assert balance.stiffness_n_m == pytest.approx(stiffness, rel=1e-9)
    assert balance.transient_1_s == 0.0


def test_growing_motion_is_balanced_to_second_order_of_its_growth(rig: Plant) -> None:
    balance = AbsorberBalance(rig, NAMES)

    def error(growth_1_s: float, *, with_slope: bool) -> float:
        s = complex(growth_1_s, 2 * math.pi * 50.0)
        phasors = exact_phasors(s, 1e-5, 3e-4 * np.exp(0.7j), 13.5, 40714.0, with_slope=with_slope)
        return abs(balance.solve(phasors).damping_ns_m - 13.5)

    assert error(0.5, with_slope=True) / error(0.25, with_slope=True) == pytest.approx(4.0, rel=0.05)
    assert error(1.0, with_slope=True) < 1e-3
    assert error(1.0, with_slope=False) > 0.3  # what forgetting the slope would cost


def test_uncertainty_of_the_damping_is_that_of_repeated_trials(rig: Plant) -> None:
    s = 2j * math.pi * 50.0
    clean = exact_phasors(s, 1e-5, 3e-4 * np.exp(0.7j), 13.5, 40714.0).amplitude
    rate, n = 5_000.0, 500
    noise = np.array([0.1, 0.2, 0.01])
    names = (*NAMES, "drive")
    channels = tuple(Channel(c, "") for c in names)
    t = np.arange(2 * n) / rate
    turning = np.exp(s * t)[:, None]
    balance = AbsorberBalance(rig, names)
    found, claimed, stiffness, stiffness_claimed = [], [], [], []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        measured = (turning * clean).real + noise * rng.standard_normal((2 * n, 3))
        values = np.column_stack([measured, np.cos(s.imag * t)])
        tracker = ExcitationTracker("drive", names)
        for k in (0, n):
            phasors = tracker.advance(make_block(k, rate, values[k : k + n], channels))
        assert phasors is not None
        result = balance.solve(phasors)
        found.append(result.damping_ns_m)
        claimed.append(result.damping_std_ns_m)
        stiffness.append(result.stiffness_n_m)
        stiffness_claimed.append(result.stiffness_std_n_m)
    assert 0.8 < np.std(found) / np.mean(claimed) < 1.25
    assert 0.8 < np.std(stiffness) / np.mean(stiffness_claimed) < 1.25
    # and no bias beyond what that many trials can tell
    assert abs(np.mean(found) - 13.5) < 4.0 * np.std(found) / math.sqrt(len(found))


def test_absorber_that_stands_still_tells_nothing(rig: Plant) -> None:
    silent = exact_phasors(2j * math.pi * 50.0, 0.0, 0.0, 5.0, 4e4)
    balance = AbsorberBalance(rig, NAMES).solve(silent)
    assert math.isinf(balance.damping_std_ns_m)
    assert DampingLearner(rig).advance(balance, 0.1).reason == "too little excitation"


@pytest.mark.parametrize("missing", NAMES)
def test_balance_without_one_of_its_signals_is_refused(rig: Plant, missing: str) -> None:
    with pytest.raises(ValueError, match="no recorded sensor measures the"):
        AbsorberBalance(rig, tuple(n for n in NAMES if n != missing))


def test_balance_needs_a_coil_on_an_absorber() -> None:
    with pytest.raises(ValueError, match="no voice coil"):
        AbsorberBalance(load_plant("rig_no_vcm"), NAMES)


# --- the learner on the simulated rig -----------------------------------------------------------------------


def learn(programme: Programme) -> tuple[DampingLearner, list[DampingCurve], list[ForceBalance | None]]:
    """A learner that starts from the preset's 7 Ns/m, beside a simulated rig."""
    simulated = SimulatedRig(programme)
    names = tuple(c.name for c in simulated.channels)
    tracker, balance = ExcitationTracker("shaker_voltage", names), AbsorberBalance(programme.plant, names)
    learner, curves, balances = DampingLearner(programme.plant), [], []
    was_on, since = False, 0
    while not simulated.finished:
        first = simulated.next_sample
        values, on, _ = simulated.next_block()
        since, was_on = (0 if on != was_on else since + 1), on
        phasors = tracker.advance(make_block(first, RATE_HZ, values, simulated.channels))
        balances.append(balance.solve(phasors) if phasors is not None else None)
        curves.append(learner.advance(balances[-1], 0.1, "switched" if since < 3 else ""))
    return learner, curves, balances


@pytest.fixture(scope="module")
def swept(rig: Plant) -> tuple[DampingLearner, list[DampingCurve]]:
    schedule = scheduling_rule(rig.with_damping("absorber", THESIS_DAMPING), GRID_HZ)
    programme = Programme(
        plant=rig,
        true_damping=THESIS_DAMPING,
        sweep=Sweep(from_hz=40.0, to_hz=60.0, duration_s=60.0, amplitude_v=4.0),
        schedule=schedule,
        seed=5,
    )
    learner, curves, _ = learn(programme)
    return learner, curves


def test_one_sweep_teaches_the_damping_of_the_thesis_from_a_wrong_start(
    swept: tuple[DampingLearner, list[DampingCurve]],
) -> None:
    learner, curves = swept
    last = curves[-1]
    inside = (last.frequency_hz >= 45.0) & (last.frequency_hz <= 55.0)
    truth = np.array([THESIS_DAMPING.at(f) for f in last.frequency_hz])
    for learned in (last.damping_ns_m, last.in_use_ns_m):
        assert math.sqrt(np.mean((learned - truth)[inside] ** 2)) < 0.3
    assert np.all(last.std_ns_m[inside] < 0.5)
    assert np.all(last.coverage[inside] > 0.99)
    assert last.stiffness_n_m == pytest.approx(40714.0, rel=1e-3)
    assert learner.table().at(50.0) == pytest.approx(THESIS_DAMPING.at(50.0), abs=0.4)


def test_frequencies_the_sweep_never_visited_stay_uncertain(
    swept: tuple[DampingLearner, list[DampingCurve]],
) -> None:
    learner, curves = swept
    last = curves[-1]
    assert last.std_ns_m[last.frequency_hz == 35.0][0] > 4.0
    assert last.std_ns_m[last.frequency_hz == 65.0][0] > 4.0
    assert learner.std_at(65.0) > 10.0 * learner.std_at(50.0)


def test_before_the_first_block_nothing_is_claimed(rig: Plant) -> None:
    curve = DampingLearner(rig).curve()
    assert curve.status == "unestimated"
    assert math.isnan(curve.stiffness_n_m)
    np.testing.assert_array_equal(curve.damping_ns_m, 7.0)
    np.testing.assert_array_equal(curve.std_ns_m, 8.0)
    assert not curve.coverage.any()


def test_value_in_use_never_moves_faster_than_its_rate(
    swept: tuple[DampingLearner, list[DampingCurve]],
) -> None:
    _, curves = swept
    in_use = np.array([c.in_use_ns_m for c in curves])
    assert np.max(np.abs(np.diff(in_use, axis=0))) <= 0.5 + 1e-12  # 5 Ns/m per s, 0.1 s blocks
    assert np.max(np.abs(np.diff(in_use, axis=0))) > 0.1


def test_filter_phase_that_fakes_damping_to_a_quiet_table_does_not_fake_the_force_balance(rig: Plant) -> None:
    # thesis Test 2: absorber tuned at 55 Hz, 200 Hz low-pass, 1 Hz high-pass; the coil's damping is 7 throughout.
    # Turning beta until the table is quiet finds what is filter phase and damping together.
    body = rig.body[1]
    tuned = rig.model_copy(
        update={
            "body": (
                rig.body[0],
                body.model_copy(update={"stiffness_n_m": body.mass_kg * (math.tau * 55.0) ** 2}),
            )
        }
    )
    facts = LoopFacts(RATE_HZ, 1)
    quiet_beta = {}
    for hz in (45.0, 47.5, 50.0, 52.5, 55.0):
        model = RigModel(tuned, facts, hz)
        gamma = scheduled_stiffness(body.mass_kg, 55.0, hz)

        def motion(beta: float, model: RigModel = model, gamma: float = gamma, hz: float = hz) -> float:
            return predict(model, Gains(0.0, -beta, gamma, 200.0, 1.0), hz, 4.0).displacement_m

        quiet_beta[hz] = float(minimize_scalar(motion, bounds=(0.0, 40.0), method="bounded").x)
    assert list(quiet_beta.values()) == pytest.approx([23.1, 19.6, 15.8, 11.6, 7.1], abs=0.3)

    # The rig run at exactly those betas: the balance still sees the coil alone.
    for hz in (47.5, 52.5):
        gains = Gains(0.0, -quiet_beta[hz], scheduled_stiffness(body.mass_kg, 55.0, hz), 200.0, 1.0)
        schedule = GainSchedule(
            frequency_hz=(hz,),
            alpha_kg=(0.0,),
            beta_ns_m=(gains.beta_ns_m,),
            gamma_n_m=(gains.gamma_n_m,),
            low_pass_hz=(200.0,),
            high_pass_hz=(1.0,),
            on_from_hz=hz,
            on_to_hz=hz,
        )
        programme = Programme(
            plant=tuned,
            true_damping=DampingTable(frequency_hz=(45.0, 55.0), ns_m=(7.0, 7.0)),
            sweep=Sweep(from_hz=hz, to_hz=hz, duration_s=6.0, amplitude_v=1.0),
            schedule=schedule,
        )
        _, _, balances = learn(programme)
        late = [b.damping_ns_m for b in balances[30:] if b is not None]
        assert len(late) == 30
        assert np.mean(late) == pytest.approx(7.0, abs=0.3)


# --- gates --------------------------------------------------------------------------------------------------


def balance_of(
    hz: float = 50.0, damping: float = 7.0, std: float = 0.05, transient: float = 0.0
) -> ForceBalance:
    return ForceBalance(hz, damping, std, 40714.0, 10.0, transient)


def taught(plant: Plant, damping: float = 7.0, blocks: int = 30) -> DampingLearner:
    learner = DampingLearner(plant)
    for _ in range(blocks):
        learner.advance(balance_of(damping=damping), 0.1)
    return learner


@pytest.mark.parametrize(
    ("stray", "reason"),
    [
        (balance_of(damping=9.0), "outlier"),
        (balance_of(transient=1.5), "transient"),
        (balance_of(std=2.0), "too little excitation"),
        (balance_of(std=math.nan), "too little excitation"),
        (balance_of(hz=34.0), "excitation outside 35 to 65 Hz"),
        (balance_of(hz=66.0), "excitation outside 35 to 65 Hz"),
        (None, "no excitation"),
    ],
)
def test_block_that_fails_a_gate_teaches_nothing_and_says_why(
    rig: Plant, stray: ForceBalance | None, reason: str
) -> None:
    learner = taught(rig)
    before = learner.curve()
    assert before.status == "estimated"
    after = learner.advance(stray, 0.1)
    assert (after.status, after.reason) == ("learning", reason)
    np.testing.assert_array_equal(after.damping_ns_m, before.damping_ns_m)
    np.testing.assert_array_equal(after.std_ns_m, before.std_ns_m)
    assert learner.advance(balance_of(), 0.1).status == "estimated"


def test_objection_of_the_caller_keeps_a_block_out(rig: Plant) -> None:
    learner = taught(rig)
    before = learner.curve()
    after = learner.advance(balance_of(damping=7.1), 0.1, "control has just been switched")
    assert after.reason == "control has just been switched"
    np.testing.assert_array_equal(after.damping_ns_m, before.damping_ns_m)


def test_damping_that_really_stepped_is_believed_after_five_blocks(rig: Plant) -> None:
    learner = taught(rig, damping=7.0)
    reasons = [learner.advance(balance_of(damping=20.5), 0.1).reason for _ in range(40)]
    assert reasons[:4] == ["outlier"] * 4
    assert not any(reasons[4:])
    curve = learner.curve()
    at_50 = curve.frequency_hz == 50.0
    assert curve.damping_ns_m[at_50][0] == pytest.approx(20.5, abs=0.05)
    assert curve.in_use_ns_m[at_50][0] == pytest.approx(20.5, abs=0.05)
    assert curve.status == "estimated"


def test_single_outliers_among_good_blocks_are_never_believed(rig: Plant) -> None:
    learner = taught(rig)
    for k in range(60):
        learner.advance(balance_of(damping=20.5 if k % 3 == 0 else 7.0), 0.1)
    assert learner.curve().damping_ns_m[15] == pytest.approx(7.0, abs=0.05)


def test_negative_readings_never_reach_the_value_in_use(rig: Plant) -> None:
    learner = DampingLearner(rig)
    for _ in range(80):
        curve = learner.advance(balance_of(damping=-4.0), 0.1)
        assert np.all(curve.in_use_ns_m >= 0.0)
    assert curve.damping_ns_m[15] == pytest.approx(-4.0, abs=0.1)  # what is learned is shown as it is
    assert curve.in_use_ns_m[15] == 0.0
    assert learner.table().at(50.0) == 0.0


@settings(deadline=None, max_examples=30)
@given(
    blocks=st.lists(
        st.tuples(st.floats(30.0, 70.0), st.floats(-100.0, 100.0), st.floats(1e-4, 2.0)),
        min_size=1,
        max_size=60,
    )
)
def test_knowledge_stays_a_covariance_and_the_curve_in_use_a_damping(
    blocks: list[tuple[float, float, float]],
) -> None:
    learner = DampingLearner(load_plant("rig"))
    for hz, damping, std in blocks:
        curve = learner.advance(balance_of(hz=hz, damping=damping, std=std), 0.1)
        P = learner._covariance
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P).min() > -1e-9 * np.linalg.eigvalsh(P).max()
        assert np.all(curve.in_use_ns_m >= 0.0)
        assert np.all((curve.coverage >= 0.0) & (curve.coverage <= 1.0))
        assert np.all(np.isfinite(curve.damping_ns_m))


def test_repeated_measurements_average_down_to_the_believed_floor(rig: Plant) -> None:
    # Kalman filter of one knot without forgetting: the mean's own variance is that of the average.
    settings_ = replace(LearnerSettings(), forgetting_ns_m_sqrt_s=0.0)
    learner = DampingLearner(rig, settings_)
    rng = np.random.default_rng(0)
    readings = 7.0 + 0.5 * rng.standard_normal(100)
    for reading in readings:
        learner.advance(balance_of(damping=float(reading), std=0.5), 0.1)
    spread = math.hypot(0.5, settings_.floor_std_ns_m)
    assert learner.std_at(50.0) == pytest.approx(spread / 10.0, rel=1e-3)
    assert learner.curve().damping_ns_m[15] == pytest.approx(np.mean(readings), abs=1e-3)
