"""Exact discretisation and the block kernel against SciPy and an adaptive integrator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.signal import cont2discrete, dlsim

from twin.plant.discrete import DiscreteModel, Hold, discretise, simulate_block
from twin.plant.files import load_plant
from twin.plant.linear import LinearModel, linear_model, read_only

Array = NDArray[np.float64]


def stable_plant(seed: int, n: int = 5, m: int = 2, p: int = 3) -> LinearModel:
    """A random plant whose modes all decay, with rates of order one."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    swing = rng.normal(size=(n, n))
    A = -(root @ root.T) / n - 0.1 * np.eye(n) + (swing - swing.T)
    return LinearModel(
        A=read_only(A),
        B=read_only(rng.normal(size=(n, m))),
        C=read_only(rng.normal(size=(p, n))),
        D=read_only(rng.normal(size=(p, m))),
        states=tuple(f"s{i}" for i in range(n)),
        inputs=tuple(f"u{j}" for j in range(m)),
        outputs=tuple(f"y{i}" for i in range(p)),
    )


def run(d: DiscreteModel, u: Array, x: Array | None = None, u_before: Array | None = None) -> Array:
    x = np.zeros(len(d.F)) if x is None else x
    u_before = u[0].copy() if u_before is None else u_before
    y = np.empty((len(u), len(d.C)))
    simulate_block(d.F, d.B0, d.B1, d.C, d.D, x, u_before, u, y)
    return y


@pytest.mark.parametrize("seed", range(5))
def test_held_input_steps_the_plant_as_scipy_does(seed: int) -> None:
    model, rate = stable_plant(seed), 20.0
    A, B, C, D, dt = cont2discrete((model.A, model.B, model.C, model.D), 1.0 / rate, method="zoh")
    d = discretise(model, rate, ["zoh", "zoh"])
    np.testing.assert_allclose(d.F, A, atol=1e-13)
    np.testing.assert_allclose(d.B0, B, atol=1e-13)
    assert not d.B1.any()
    u = np.random.default_rng(seed).normal(size=(400, 2))
    # Ours starts at the sample before the block, so that with the first input held the states differ by one step.
    x0 = A @ np.zeros(5) + B @ u[0]
    _, y, _ = dlsim((A, B, C, D, dt), u, x0=x0)
    np.testing.assert_allclose(run(d, u), y, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_joined_input_answers_as_scipys_first_order_hold(seed: int) -> None:
    model, rate = stable_plant(seed), 20.0
    A, B, C, D, dt = cont2discrete((model.A, model.B, model.C, model.D), 1.0 / rate, method="foh")
    u = np.random.default_rng(seed).normal(size=(400, 2))
    u[0] = 0.0
    _, y, _ = dlsim((A, B, C, D, dt), u)
    np.testing.assert_allclose(run(discretise(model, rate, ["foh", "foh"]), u), y, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("holds", [("zoh", "foh"), ("foh", "zoh")])
def test_each_input_keeps_its_own_hold_against_an_adaptive_integrator(holds: tuple[Hold, Hold]) -> None:
    model, rate = stable_plant(11), 10.0
    u = np.random.default_rng(3).normal(size=(30, 2))

    def between(k: int, share: float) -> Array:
        joined = u[k - 1] + share * (u[k] - u[k - 1])
        return np.where([h == "foh" for h in holds], joined, u[k - 1])

    x = np.zeros(5)
    truth = [model.C @ x + model.D @ u[0]]
    for k in range(1, len(u)):
        answer = solve_ivp(
            lambda t, s, k=k: model.A @ s + model.B @ between(k, t * rate),
            (0.0, 1.0 / rate), x, method="DOP853", rtol=1e-12, atol=1e-14,
        )  # fmt: skip
        x = answer.y[:, -1]
        truth.append(model.C @ x + model.D @ u[k])
    d = discretise(model, rate, holds)
    y = run(d, u[1:], u_before=u[0].copy())
    np.testing.assert_allclose(y, truth[1:], rtol=1e-9, atol=1e-9)


@settings(deadline=None, max_examples=25)
@given(cuts=st.lists(st.integers(1, 199), max_size=6, unique=True), seed=st.integers(0, 1000))
def test_where_a_run_is_cut_into_blocks_changes_no_bit(cuts: list[int], seed: int) -> None:
    d = discretise(stable_plant(seed), 20.0, ["zoh", "foh"])
    u = np.random.default_rng(seed).normal(size=(200, 2))
    whole = run(d, u)
    x, u_before = np.zeros(5), u[0].copy()
    pieces = [run(d, np.ascontiguousarray(piece), x, u_before) for piece in np.split(u, sorted(cuts))]
    assert np.concatenate(pieces).tobytes() == whole.tobytes()


def test_joined_samples_of_a_chirp_leave_a_thousandth_where_held_ones_leave_a_hundredth() -> None:
    # A shaker's voltage is smooth: samples joined by lines follow it, held ones lag half a sample.
    model, rate = linear_model(load_plant("rig")), 50_000.0
    t = np.arange(25_000) / rate
    rise = (1200.0 - 800.0) / t[-1]

    def chirp(at: Array | float) -> Array:
        return np.asarray(4.0 * np.sin(2.0 * np.pi * (800.0 * at + 0.5 * rise * at**2)))

    fine = 16  # the truth: the same chirp joined at 16 times the rate
    fine_t = np.arange(fine * len(t)) / (fine * rate)
    out = model.outputs.index("shaker_current")
    shaker = model.inputs.index("shaker")

    def current(rate_hz: float, volts: Array, hold: Hold) -> Array:
        u = np.zeros((len(volts), 2))
        u[:, shaker] = volts
        return run(discretise(model, rate_hz, [hold, hold]), u)[:, out]

    truth = current(fine * rate, chirp(fine_t), "foh")[::fine]
    scale = np.max(np.abs(truth))
    joined = np.max(np.abs(current(rate, chirp(t), "foh") - truth)) / scale
    held = np.max(np.abs(current(rate, chirp(t), "zoh") - truth)) / scale
    assert joined < 2e-3
    assert held > 3e-2


def test_an_input_without_a_hold_is_refused() -> None:
    with pytest.raises(ValueError, match="2 inputs need 2 holds, got 1"):
        discretise(stable_plant(0), 20.0, ["zoh"])


def test_arrays_of_a_discrete_model_cannot_be_written_to() -> None:
    d = discretise(stable_plant(0), 20.0, ["zoh", "foh"])
    for matrix in (d.F, d.B0, d.B1, d.C, d.D):
        with pytest.raises(ValueError, match="read-only"):
            matrix[0, 0] = 1.0
