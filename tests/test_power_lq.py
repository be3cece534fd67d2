"""Power-budgeted LQ against the physical limit, python-control, SciPy and brute force."""

import math

import control
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import solve_continuous_lyapunov
from scipy.optimize import differential_evolution

from tuning.excited import ExcitedPlant, balance, excited_plant
from tuning.lq_kernels import excited_covariance, excited_sine, joint_moments, solve_care
from tuning.power_lq import LQDesign, PowerBudgetedLQ
from twin.control.lq import force_model
from twin.plant.config import Body, ForceActuator, Plant, VoiceCoil
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant

Array = NDArray[np.float64]
ENGINE = load_plant("engine_vcm")
RIG = load_plant("rig")


@pytest.fixture(scope="module")
def engine() -> PowerBudgetedLQ:
    return PowerBudgetedLQ(ENGINE)


@pytest.fixture(scope="module")
def rig() -> PowerBudgetedLQ:
    return PowerBudgetedLQ(RIG)


def recomputed_gain(design: LQDesign) -> Array:
    """K by python-control from what the design states in SI units."""
    stated = design.as_json()
    cross = np.array(stated.get("N", np.zeros(len(stated["K"]))))[:, None]
    K, _, _ = control.lqr(
        np.array(stated["A"]), np.array(stated["B"])[:, None], np.array(stated["Q"]), np.array([[stated["R"]]]),
        cross, method="scipy",
    )  # fmt: skip
    return np.asarray(K).ravel()


def physical_limit(plant: Plant, hz: float, amplitude: float, watt: float) -> float:
    """Closed form of the least motion under a power budget, from the continuous plant alone."""
    excited = excited_plant(plant, hz, amplitude)
    n = excited.own_states
    inputs = np.column_stack([excited.b[:n], math.sqrt(2.0) * excited.A[:n, n + 1]])
    answer = np.linalg.solve(1j * math.tau * hz * np.eye(n) - excited.A[:n, :n], inputs)
    per_newton, alone = excited.motion[:n] @ answer
    most = excited.coil.force_constant_n_a * math.sqrt(2.0 * watt / excited.coil.resistance_ohm)
    return max(0.0, float(abs(alone)) - float(abs(per_newton)) * most)


# --- the model and its kernels ------------------------------------------------------------------------------


def test_oscillator_has_unit_variance_and_the_mean_square_of_the_sine() -> None:
    excited = excited_plant(ENGINE, 53.0, 1000.0, relative_bandwidth=1e-3)
    n = excited.own_states
    A, noise = excited.A[n:, n:], excited.noise[n:]
    np.testing.assert_allclose(solve_continuous_lyapunov(A, -np.outer(noise, noise)), np.eye(2), atol=1e-9)
    # The force on the case: amplitude/sqrt(2) of unit variance.
    assert excited.A[excited.states.index("v_case"), n + 1] * 45.53 == pytest.approx(1000.0 / math.sqrt(2.0))


def test_coil_force_pushes_the_absorber_forward_and_its_base_back() -> None:
    excited = excited_plant(ENGINE, 50.0, 1.0)
    reference = force_model(ENGINE, 50.0)
    np.testing.assert_allclose(excited.A[:4, :4], reference.A)
    np.testing.assert_allclose(excited.b[:4], reference.b)
    assert excited.states == ("x_case", "x_absorber", "v_case", "v_absorber", "d1", "d2")


def test_scaled_model_has_the_eigenvalues_of_the_plant_over_w() -> None:
    excited = excited_plant(RIG, 52.0, 4.0)
    A, _ = balance(excited, 10.0).model(excited)
    expected = np.sort_complex(np.linalg.eigvals(excited.A) / excited.angular_frequency)
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(A)), expected, rtol=1e-7, atol=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10_000), st.integers(1, 6), st.floats(-3.0, 3.0))
def test_doubling_solves_random_riccati_equations_as_scipy_does(seed: int, n: int, log_weight: float) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n, n)) - 1.5 * math.sqrt(n) * np.eye(n)
    b, root = rng.standard_normal(n), rng.standard_normal((n, n))
    Q, R = root @ root.T, 10.0**log_weight
    N = 0.1 * math.sqrt(R) * (root @ rng.standard_normal(n)) / math.sqrt(n)
    P, error = solve_care(A, b, Q, R, N)
    expected, _, _ = control.care(A, b[:, None], Q, np.array([[R]]), N[:, None], method="scipy")
    np.testing.assert_allclose(P, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    assert error < 1e-10


def test_covariance_and_sine_are_those_of_a_lyapunov_solve_and_of_phasors(engine: PowerBudgetedLQ) -> None:
    design = engine.solve(53.0, 1000.0, joule_mean_w=25.0)
    excited = excited_plant(ENGINE, 53.0, 1000.0, relative_bandwidth=1e-2)
    scaling = balance(excited, 90.0)
    A, b = scaling.model(excited)
    K = design.K * scaling.scale / scaling.force_n
    noise = excited.noise / scaling.scale / math.sqrt(scaling.angular_frequency)
    closed = A - np.outer(b, K)
    X = excited_covariance(A, b, K)
    np.testing.assert_allclose(
        X, solve_continuous_lyapunov(closed, -np.outer(noise, noise)), rtol=1e-6, atol=1e-9
    )
    assert joint_moments(X, K)[-1, -1] == pytest.approx(K @ X @ K)
    # A narrower line comes ever closer to the pure sine.
    narrow = excited_plant(ENGINE, 53.0, 1000.0, relative_bandwidth=1e-9)
    A, b = balance(narrow, 90.0).model(narrow)
    sine = excited_sine(A, b, K, 1.0)
    np.testing.assert_allclose(
        joint_moments(excited_covariance(A, b, K), K), sine, rtol=1e-4, atol=1e-5 * np.abs(sine).max()
    )


# --- one limit ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("zeta", "um"), [(1e-2, 112.0), (1e-3, 58.6), (1e-4, 51.6), (1e-6, 50.78)])
def test_narrower_the_line_the_nearer_to_the_physical_limit(zeta: float, um: float) -> None:
    design = PowerBudgetedLQ(ENGINE, relative_bandwidth=zeta).solve(53.0, 1000.0, joule_mean_w=25.0)
    assert design.achieved_displacement_m * 1e6 == pytest.approx(um, rel=5e-3)
    assert design.line_joule_mean_w == pytest.approx(25.0, rel=1e-8)
    assert design.duality_gap < 1e-6


@pytest.mark.parametrize("watt", [5.0, 25.0, 50.0, 100.0])
@pytest.mark.parametrize("hz", [47.0, 48.5, 50.0, 51.5, 53.0])
def test_design_is_within_a_few_micrometres_of_the_limit_and_never_below_it(
    engine: PowerBudgetedLQ, hz: float, watt: float
) -> None:
    design = engine.solve(hz, 1000.0, joule_mean_w=watt)
    limit = physical_limit(ENGINE, hz, 1000.0, watt)
    assert limit - 1e-12 <= design.achieved_displacement_m <= 1.005 * limit + 0.2e-6
    assert design.joule_mean_w <= watt
    assert design.duality_gap < 1e-6


def test_limit_at_25_w_and_53_hz_is_the_known_one() -> None:
    assert physical_limit(ENGINE, 53.0, 1000.0, 25.0) * 1e6 == pytest.approx(50.776, abs=2e-3)


@pytest.mark.parametrize(
    ("plant", "hz", "amplitude", "watt"), [(ENGINE, 53.0, 1000.0, 25.0), (RIG, 46.0, 4.0, 0.4)]
)
def test_anybody_can_recompute_the_gain_from_the_stated_weights(
    plant: Plant, hz: float, amplitude: float, watt: float
) -> None:
    design = PowerBudgetedLQ(plant, relative_bandwidth=1e-4).solve(hz, amplitude, joule_mean_w=watt)
    again = recomputed_gain(design)
    # A gain on a state counts by the force it makes: compare in newtons at the states' own size.
    size = balance(design.excited, 1.0).scale
    np.testing.assert_allclose(again * size, design.K * size, atol=1e-7 * np.abs(design.K * size).max())
    assert np.all(np.linalg.eigvalsh(design.Q) > -1e-9 * np.abs(design.Q).max())
    assert design.R > 0.0


def test_price_is_what_one_more_watt_buys(engine: PowerBudgetedLQ) -> None:
    at = {w: engine.solve(53.0, 1000.0, joule_mean_w=w) for w in (24.9, 25.0, 25.1)}
    slope = (at[24.9].achieved_displacement_m - at[25.1].achieved_displacement_m) / 0.2
    (price,) = at[25.0].prices
    assert price.name == "power"
    assert price.price == pytest.approx(slope, rel=5e-3)


def test_current_limit_is_a_power_limit_by_another_name(engine: PowerBudgetedLQ) -> None:
    amperes = math.sqrt(2.0 * 25.0 / 3.0)
    by_current = engine.solve(53.0, 1000.0, current_peak_a=amperes)
    by_power = engine.solve(53.0, 1000.0, joule_mean_w=25.0)
    np.testing.assert_allclose(by_current.K, by_power.K, rtol=1e-6, atol=1e-6)
    assert by_current.prices[0].name == "current"
    assert by_current.current_peak_a <= amperes


def test_slack_power_leaves_the_floor_and_no_price(engine: PowerBudgetedLQ) -> None:
    design = engine.solve(50.0, 1000.0, joule_mean_w=100.0)
    assert design.prices == ()
    assert design.multipliers == {"power": 0.0}
    assert design.achieved_displacement_m < 0.1e-6
    assert design.evaluations == 1


def test_budget_holds_at_the_far_edge_of_the_drift(engine: PowerBudgetedLQ) -> None:
    careless = engine.solve(53.0, 1000.0, joule_mean_w=25.0)
    careful = engine.solve(53.0, 1000.0, joule_mean_w=25.0, drift_hz=0.25)
    for design, over in ((careless, True), (careful, False)):
        n, K = design.excited.own_states, design.K
        spent = []
        for hz in (52.75, 53.0, 53.25):
            A, b = design.excited.A, design.excited.b
            d = math.sqrt(2.0) * np.array([-1j, 1.0])
            closed = A[:n, :n] - np.outer(b[:n], K[:n])
            drive = (A[:n, n:] - np.outer(b[:n], K[n:])) @ d
            x = np.linalg.solve(2j * math.pi * hz * np.eye(n) - closed, drive)
            spent.append(1.5 * abs(K[:n] @ x + K[n:] @ d) ** 2 / 22.2**2)
        assert bool(max(spent) > 25.01) is over
        assert design is careless or max(spent) == pytest.approx(25.0, rel=1e-6)
    assert careful.duality_gap < 1e-6


def test_plain_lq_on_plant_states_cannot_follow() -> None:
    """Table 6-2's kind of weights, at any effort, leave far more than the oscillator's states do (thesis 6.4)."""
    model = force_model(RIG, 53.0)
    excited = excited_plant(RIG, 53.0, 4.0)
    limit = physical_limit(RIG, 53.0, 4.0, 0.4)
    best = math.inf
    n = excited.own_states
    for effort in np.geomspace(1e-6, 1e3, 40):
        K, _, _ = control.lqr(
            model.A, model.b[:, None], np.diag([1e11, 0, 1e10, 0]), [[effort * 1e6]], method="scipy"
        )
        full = np.zeros(n)
        full[:4] = np.asarray(K).ravel()
        x = np.linalg.solve(
            1j * excited.angular_frequency * np.eye(n) - excited.A[:n, :n] + np.outer(excited.b[:n], full),
            math.sqrt(2.0) * excited.A[:n, n + 1],
        )
        if 0.5 * 2.7 * abs(full @ x / 8.0) ** 2 <= 0.4:
            best = min(best, abs(x[0]))
    design = PowerBudgetedLQ(RIG).solve(53.0, 4.0, joule_mean_w=0.4)
    assert design.achieved_displacement_m < 1.01 * limit + 0.2e-6 < 0.2 * best


# --- several limits -----------------------------------------------------------------------------------------


def test_stroke_and_power_bind_together_and_no_multiplier_is_wasted(rig: PowerBudgetedLQ) -> None:
    free = rig.solve(53.0, 4.0, joule_mean_w=0.2)
    tight = rig.solve(53.0, 4.0, joule_mean_w=0.2, stroke_m=0.995 * free.stroke_m)
    assert tight.stroke_m <= 0.995 * free.stroke_m
    assert tight.joule_mean_w <= 0.2
    assert tight.achieved_displacement_m >= free.achieved_displacement_m
    assert tight.duality_gap < 1e-6
    np.testing.assert_allclose(recomputed_gain(tight), tight.K, rtol=1e-5, atol=1e-6 * np.abs(tight.K).max())


def test_semidefinite_program_and_secant_agree_where_power_alone_binds(rig: PowerBudgetedLQ) -> None:
    from tuning.budget_sdp import BudgetProgram

    alone = rig.solve(53.0, 4.0, joule_mean_w=0.2)
    excited = alone.excited
    scaling = balance(excited, math.sqrt(0.2 / 2.7) * 8.0)
    A, b = scaling.model(excited)
    size = len(A) + 1
    objective, power, stroke = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    row = np.append(excited.velocity * scaling.scale, 0.0) / (scaling.angular_frequency * 20e-6)
    objective += np.outer(row, row)
    objective[-1, -1], power[-1, -1] = 0.01, 1.0
    travel = np.append(excited.stroke * scaling.scale, 0.0)
    stroke += np.outer(travel, travel) * 2.0 / (2.0 * alone.stroke_m) ** 2
    noise = excited.noise / scaling.scale / math.sqrt(scaling.angular_frequency)
    found = BudgetProgram(len(A), 2).multipliers(A, b, noise, objective, [power, stroke])
    assert found is not None
    assert found[0] == pytest.approx(alone.multipliers["power"], rel=1e-2)
    assert found[1] < 1e-3 * found[0]


def test_electrical_budget_counts_what_the_vibration_gives_back(engine: PowerBudgetedLQ) -> None:
    design = engine.solve(53.0, 1000.0, electrical_mean_w=12.5)
    assert design.electrical_mean_w == pytest.approx(12.5, rel=2e-3)
    assert design.electrical_mean_w <= 12.5
    assert design.joule_mean_w > 12.5  # the coil brakes, and heats itself with what it takes out
    assert design.N.any()
    np.testing.assert_allclose(
        recomputed_gain(design), design.K, rtol=1e-5, atol=1e-6 * np.abs(design.K).max()
    )
    # Power balance at the terminals, from phasors: R i² and the work on the bodies.
    n, K, d = design.excited.own_states, design.K, math.sqrt(2.0) * np.array([-1j, 1.0])
    A, b, w = design.excited.A, design.excited.b, design.excited.angular_frequency
    x = np.linalg.solve(
        1j * w * np.eye(n) - A[:n, :n] + np.outer(b[:n], K[:n]), (A[:n, n:] - np.outer(b[:n], K[n:])) @ d
    )
    force = -(K[:n] @ x + K[n:] @ d)
    work = 0.5 * (force * np.conj(-(design.excited.stroke_rate[:n] @ x))).real
    assert design.electrical_mean_w == pytest.approx(design.joule_mean_w + work, rel=1e-9)


def test_a_stroke_that_power_cannot_hold_is_refused_with_the_power_that_would(
    engine: PowerBudgetedLQ,
) -> None:
    with pytest.raises(RunError, match=r"takes at least .* W mean Joule"):
        engine.solve(53.0, 1000.0, joule_mean_w=25.0, stroke_m=1e-3)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"joule_mean_w": 0.0}, "joule_mean_w must be greater than 0"),
        ({"joule_mean_w": math.nan}, "joule_mean_w must be greater than 0"),
        ({"stroke_m": 1e-3}, "give a limit on the coil"),
        ({"joule_mean_w": 1.0, "drift_hz": 60.0}, "drift_hz"),
    ],
)
def test_bad_limits_are_refused(engine: PowerBudgetedLQ, options: dict[str, float], match: str) -> None:
    with pytest.raises(InputError, match=match):
        engine.solve(53.0, 1000.0, **options)


def test_a_plant_without_coil_is_refused() -> None:
    with pytest.raises(InputError, match="no voice coil"):
        PowerBudgetedLQ(load_plant("engine")).solve(50.0, 1000.0, joule_mean_w=1.0)


# --- brute force and random plants --------------------------------------------------------------------------


def cost_and_power(excited: ExcitedPlant, K: Array) -> tuple[float, float]:
    """Peak motion under a sine, and mean Joule power, of any stabilising gain; infinite if it is not."""
    n, d = excited.own_states, math.sqrt(2.0) * np.array([-1j, 1.0])
    A, b = excited.A, excited.b
    closed = A[:n, :n] - np.outer(b[:n], K[:n])
    if np.linalg.eigvals(closed).real.max() >= 0.0:
        return math.inf, math.inf
    drive = (A[:n, n:] - np.outer(b[:n], K[n:])) @ d
    x = np.linalg.solve(1j * excited.angular_frequency * np.eye(n) - closed, drive)
    current = (K[:n] @ x + K[n:] @ d) / excited.coil.force_constant_n_a
    return float(abs(excited.motion[:n] @ x)), float(0.5 * excited.coil.resistance_ohm * abs(current) ** 2)


def test_differential_evolution_over_weights_finds_nothing_better(rig: PowerBudgetedLQ) -> None:
    design = rig.solve(54.0, 4.0, joule_mean_w=0.3)
    excited = design.excited
    scaling = balance(excited, math.sqrt(0.3 / 2.7) * 8.0)
    A, b = scaling.model(excited)
    n = len(A)
    noise = np.ascontiguousarray(excited.noise[-2:]) / math.sqrt(scaling.angular_frequency)
    from tuning.lq_kernels import excited_gain

    def motion(log_weights: Array) -> float:
        Q = np.zeros((n, n))
        Q[range(5), range(5)] = 10.0 ** log_weights[:5]
        K, _, error = excited_gain(A, b, Q, 10.0 ** float(log_weights[5]), np.zeros(n), noise)
        if not error < 1e-6:
            return 1.0
        moved, spent = cost_and_power(excited, K * scaling.force_n / scaling.scale)
        return moved + 1e-3 * max(0.0, spent / 0.3 - 1.0)

    found = differential_evolution(
        motion, [(-6.0, 6.0)] * 5 + [(-6.0, 2.0)], seed=1, maxiter=40, popsize=10, tol=0.0
    )
    assert found.fun > 0.99 * design.achieved_displacement_m


@st.composite
def rigs(draw: st.DrawFn) -> Plant:
    """Two or three bodies with a coil between two of them and a force on the first."""
    bodies = [
        Body(name="m1", mass_kg=draw(st.floats(0.5, 100.0)), attached_to="ground",
             stiffness_n_m=draw(st.floats(1e2, 1e5)), damping_ns_m=draw(st.floats(0.5, 300.0))),
        Body(name="m2", mass_kg=draw(st.floats(0.1, 20.0)), attached_to="m1",
             stiffness_n_m=draw(st.floats(1e3, 1e6)), damping_ns_m=draw(st.floats(0.1, 30.0))),
    ]  # fmt: skip
    if draw(st.booleans()):
        bodies.append(
            Body(name="m3", mass_kg=draw(st.floats(0.1, 5.0)), attached_to=draw(st.sampled_from(["m1", "m2"])),
                 stiffness_n_m=draw(st.floats(1e3, 1e5)), damping_ns_m=draw(st.floats(0.1, 30.0)))
        )  # fmt: skip
    coil = VoiceCoil(
        name="coil", kind="voice_coil", between=("m1", "m2"), resistance_ohm=draw(st.floats(0.5, 10.0)),
        inductance_h=2e-3, force_constant_n_a=draw(st.floats(2.0, 60.0)), current_loop_kp_v_a=200.0,
    )  # fmt: skip
    push = ForceActuator(name="push", kind="force", on="m1")
    return Plant(name="random", body=tuple(bodies), actuator=(coil, push))


@settings(deadline=None, max_examples=60)
@given(
    rigs(), st.floats(10.0, 120.0), st.floats(1.0, 2000.0), st.floats(-2.0, 2.0), st.sampled_from([0.0, 0.2]),
    st.floats(0.9, 1.3),
)  # fmt: skip
def test_random_plants_and_budgets_are_stable_within_budget_and_optimal(
    plant: Plant, hz: float, newton: float, log_watt: float, drift: float, share: float
) -> None:
    lq = PowerBudgetedLQ(plant)
    watt = 10.0**log_watt
    design = lq.solve(hz, newton, joule_mean_w=watt, drift_hz=drift)
    try:
        design = lq.solve(hz, newton, joule_mean_w=watt, drift_hz=drift, stroke_m=share * design.stroke_m)
    except RunError as error:
        assume("takes at least" in str(error) or "all limits" in str(error))
    n = design.excited.own_states
    closed = design.excited.A[:n, :n] - np.outer(design.excited.b[:n], design.K[:n])
    assert np.linalg.eigvals(closed).real.max() < 0.0
    moved, spent = cost_and_power(design.excited, design.K)
    assert spent <= watt * (1.0 + 1e-6)
    assert design.drift_joule_mean_w <= watt * (1.0 + 1e-9)
    assert moved == pytest.approx(design.achieved_displacement_m, rel=1e-6, abs=1e-12)
    if not any(price.name == "stroke" for price in design.prices):  # to hold the stroke may take motion
        assert moved <= cost_and_power(design.excited, np.zeros(n + 2))[0] * (1.0 + 1e-9)
    assert moved >= physical_limit(plant, hz, newton, watt) * (1.0 - 1e-6) - 1e-12
    assert design.duality_gap < 1e-6
