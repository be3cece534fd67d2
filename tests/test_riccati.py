"""The Riccati solution against SciPy's, against the recursion it stands for, and where there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from estimators.augmented import Disturbances
from estimators.observer import Observer
from estimators.riccati import riccati_step, steady_prior
from estimators.small_matrices import multiply, multiply_transposed, solve_in_place
from twin.plant.files import load_plant

Array = NDArray[np.float64]


def system(seed: int, n: int, p: int) -> tuple[Array, Array, Array, Array]:
    """A random stable system whose units lie decades apart."""
    rng = np.random.default_rng(seed)
    F = rng.standard_normal((n, n))
    F *= rng.uniform(0.5, 1.0) / np.max(np.abs(np.linalg.eigvals(F)))
    root = rng.standard_normal((n, n))
    units = 10.0 ** rng.uniform(-4, 4, n)
    H = rng.standard_normal((p, n)) / units
    Q = root @ root.T * np.outer(units, units) * 10.0 ** rng.uniform(-6, 2)
    return F * units[:, None] / units, H, Q, np.diag(10.0 ** rng.uniform(-3, 3, p))


def in_units(M: Array, P: Array) -> float:
    """Largest element in standard deviations of the states."""
    std = np.sqrt(np.diag(P))
    return float(np.max(np.abs(M) / np.outer(std, std)))


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 100_000), n=st.integers(1, 14), p=st.integers(1, 5))
def test_solution_is_a_fixed_point_of_the_filters_recursion(seed: int, n: int, p: int) -> None:
    F, H, Q, R = system(seed, n, p)
    P = steady_prior(F, H, Q, R)
    assert in_units(riccati_step(F, H, Q, R, P) - P, P) <= 1e-13
    np.testing.assert_array_equal(P, P.T)
    by_scipy = solve_discrete_are(F.T, H.T, Q, R)
    # SciPy's own residual says how far its solution can be trusted.
    trust = in_units(riccati_step(F, H, Q, R, by_scipy) - by_scipy, P)
    assert in_units(P - by_scipy, P) <= 1e-10 + 1e3 * trust


@pytest.mark.parametrize(
    ("plant", "channels", "rate_hz"),
    [
        (
            "rig",
            ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_voltage", "vcm"),
            50_000.0,
        ),
        ("engine", ("case_displacement", "case_velocity", "absorber_velocity"), 50_000.0),
        ("beam", ("tip_displacement", "piezo"), 100.0),
    ],
)
def test_plants_observers_settle_at_a_solution_to_rounding(
    plant: str, channels: tuple[str, ...], rate_hz: float
) -> None:
    observer = Observer(
        load_plant(plant), channels, rate_hz, frequency_hz=50.0, disturbances=Disturbances(force_n=1.0)
    )
    kf = observer.filter
    P = steady_prior(kf.F, kf.H, kf.Q, kf.R)
    assert in_units(riccati_step(kf.F, kf.H, kf.Q, kf.R, P) - P, P) <= 1e-13
    recursed = 1.5 * P
    for _ in range(20_000 if rate_hz > 1e3 else 500):
        recursed = riccati_step(kf.F, kf.H, kf.Q, kf.R, recursed)
    assert in_units(recursed - P, P) <= 1e-3


def test_a_state_that_wanders_unseen_has_no_steady_covariance() -> None:
    F, H = np.diag([0.9, 1.0]), np.array([[1.0, 0.0]])
    with pytest.raises(np.linalg.LinAlgError, match="wanders that no measurement tells of"):
        steady_prior(F, H, np.eye(2), np.eye(1))
    plant = load_plant("rig")
    drifting = plant.with_damping("absorber", 7.0).model_copy(
        update={"body": tuple(b.model_copy(update={"disturbance_drift_n_s": 1.0}) for b in plant.body)}
    )
    with pytest.raises(
        ValueError, match=r"plant 'rig': no steady covariance.* its observer uses vcm_current"
    ):
        Observer(drifting, ("vcm_current", "vcm"), 1000.0, frequency_hz=50.0)


def test_scalar_solution_is_the_root_of_its_quadratic() -> None:
    # p = f² p r/(p + r) + q for h = 1
    f, q, r = 0.95, 0.3, 2.0
    b = r * (1.0 - f * f) - q
    expected = 0.5 * (-b + np.sqrt(b * b + 4.0 * q * r))
    (found,) = steady_prior(*(np.array([[v]]) for v in (f, 1.0, q, r))).ravel()
    assert found == pytest.approx(expected, rel=1e-14)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), n=st.integers(1, 12), m=st.integers(1, 12))
def test_small_matrices_are_multiplied_and_solved_as_by_lapack(seed: int, n: int, m: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, m))
    out = np.empty((n, m))
    multiply(A, B, out)
    np.testing.assert_allclose(out, A @ B, atol=1e-12)
    multiply_transposed(A, np.ascontiguousarray(B.T), out)
    np.testing.assert_allclose(out, A @ B, atol=1e-12)
    X = B.copy()
    assert solve_in_place(A.copy(), X)
    np.testing.assert_allclose(A @ X, B, atol=1e-9 * np.linalg.cond(A))
    assert not solve_in_place(np.zeros((n, n)), X)
