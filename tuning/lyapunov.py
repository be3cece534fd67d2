"""Quadratic functions of a sampled loop's state that fall while its frequency moves, found by semidefinite programs.

The state is carried from sample to sample as the firmware carries it, ``x+ = A(f) x``, while f moves by at most
``rate dt`` a sample. A function ``V = x' P(f) x``, P piecewise linear in f between knots, falls wherever

    (A' (P + s rate dt P') A - P)/dt < 0        s = +1, -1;  P' its slope over the interval

These are linear in P for a given rate (Wu, Yang, Packard and Becker, 1996, in the form for sampled loops). At 50 kS/s
A is the identity but for a few parts in a hundred thousand, and its time constants span five orders of magnitude. So
the condition is written with the difference divided by dt, never with A'PA - P, in balanced coordinates; per knot the
unknown is X of ``P = T' X T`` with a T for which X = I is an answer already: the solver sees numbers of order one.

What is found here is a candidate. `tuning.transition` judges it by eigenvalues of the exact matrices.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import matrix_balance

from twin.plant.linear import Array

LARGEST_TRACE, LEAST_EIGENVALUE = 30.0, 1e-3
"""Bounds on the unknowns of the program, whose starting values are identity matrices."""

SEARCH_ROUNDS = 10
MOST_DOUBLINGS = 46


@dataclass(frozen=True, slots=True)
class Samples:
    """The loop at the knots of a function, and half-way between them, where a function is bent most.

    Attributes
    ----------
    frequency_hz
        (2 m - 1,) ascending [Hz]: every other one, from the first, is a knot.
    A
        (2 m - 1, n, n) one sample of the closed loop.
    dt
        Sample period [s].
    """

    frequency_hz: Array
    A: Array
    dt: float

    @property
    def knots_hz(self) -> Array:
        """(m,) [Hz]."""
        return self.frequency_hz[::2]

    def scaled(self, scale: Array) -> "Samples":
        """The same with state i in units of ``scale[i]``."""
        return Samples(self.frequency_hz, np.asarray(self.A * scale / scale[:, None]), self.dt)


def balancing_scale(A: Array, dt: float) -> Array:
    """Powers of two, (n,), in whose units the states of a sampled loop weigh about the same."""
    change = (A - np.eye(len(A))) / dt
    return np.asarray(matrix_balance(change, permute=False, separate=True)[1][0], dtype=np.float64)


def frozen_functions(samples: Samples, weights: Array) -> Array | None:
    """P of ``(A' P A - P)/dt = -diag(weights)`` at every knot, by doubling; None for a loop that is unstable.

    Returns
    -------
    ndarray or None
        (m, n, n).
    """
    n = len(weights)
    power = samples.A[::2].copy()
    P = np.broadcast_to(np.diag(weights) * samples.dt, power.shape).copy()
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(MOST_DOUBLINGS):
            P += np.swapaxes(power, 1, 2) @ P @ power
            power = power @ power
            largest = np.abs(power).max()
            if not largest < 1e30:
                return None
            if largest < 1e-20 / n:
                return np.asarray(0.5 * (P + np.swapaxes(P, 1, 2)))
    return None


def decay_and_drift(A: Array, P: Array, slope: Array, dt: float) -> tuple[Array, Array, float] | None:
    """The condition of this module in the coordinates in which P is the identity.

    Parameters
    ----------
    A, P, slope
        (n, n) loop, function and its slope over frequency [per Hz] at one frequency.

    Returns
    -------
    tuple or None
        ``decay = (I - A'A)/dt`` [1/s] and ``drift = A' slope A`` [1/Hz], (n, n) each: V falls at a rate r where
        ``decay - r drift`` and ``decay + r drift`` are positive. Then a bound on the rounding errors in decay [1/s].
        None if P is not positive definite.
    """
    try:
        T = np.linalg.cholesky(P).T
    except np.linalg.LinAlgError:
        return None
    moved = np.linalg.solve(T.T, (T @ A).T).T  # T A T^-1
    tilted = np.linalg.solve(T.T, np.linalg.solve(T.T, slope.T).T)
    decay = (np.eye(len(A)) - moved.T @ moved) / dt
    drift = moved.T @ (0.5 * (tilted + tilted.T)) @ moved
    own = np.diag(T)  # what scaling of states alone brings in is harmless
    spread = np.linalg.cond(T / own[None, :])
    rounding = (
        8.0
        * len(A)
        * np.finfo(np.float64).eps
        * float(spread)
        * (1.0 + float(np.linalg.norm(moved)) ** 2)
        / dt
    )
    return np.asarray(0.5 * (decay + decay.T)), np.asarray(0.5 * (drift + drift.T)), rounding


def admissible_rate_hz_s(A: Array, P: Array, slope: Array, dt: float, least_decay_1_s: float = 0.0) -> float:
    """Fastest change of frequency [Hz/s] at which V still decays at a rate; 0 if it does not even at rest."""
    parts = decay_and_drift(A, P, slope, dt)
    if parts is None:
        return 0.0
    decay, drift, rounding = parts
    try:
        L = np.linalg.cholesky(decay - (least_decay_1_s + rounding) * np.eye(len(A)))
    except np.linalg.LinAlgError:
        return 0.0
    turned = np.linalg.solve(L, np.linalg.solve(L, drift).T)
    largest = float(np.abs(np.linalg.eigvalsh(0.5 * (turned + turned.T))).max())
    return math.inf if largest == 0.0 else 1.0 / largest


def frozen_rate_hz_s(samples: Samples, P: Array, weights: Array) -> float:
    """Admissible rate of frozen functions at all samples [Hz/s]: what the program starts from.

    Returns
    -------
    float
        Where they do not even fall at rest half-way between two knots: minus a measure of by how much not.
    """
    unit = 1.0 / np.sqrt(weights)
    slopes = np.diff(P, axis=0) / np.diff(samples.knots_hz)[:, None, None]
    middle, A = 0.5 * (P[:-1] + P[1:]), samples.A[1::2]
    still = (middle - np.swapaxes(A, 1, 2) @ middle @ A) / samples.dt * (unit[:, None] * unit)
    least = float(np.linalg.eigvalsh(0.5 * (still + np.swapaxes(still, 1, 2))).min())
    if least <= 0.0:
        return least - 1e-9
    largest = 0.0
    for A, share in (
        (samples.A[:-1:2], 1.0),
        (samples.A[2::2], 1.0),
        (samples.A[1::2], 1.0 / min(least, 1.0)),
    ):
        turned = np.swapaxes(A * unit, 1, 2) @ slopes @ (A * unit)
        largest = max(largest, share * float(np.abs(np.linalg.eigvalsh(turned)).max()))
    return math.inf if largest == 0.0 else 1.0 / largest


def starting_functions(samples: Samples) -> tuple[Array, Array] | None:
    """Frozen functions whose weights suit a moving frequency, by a search along each weight's logarithm.

    Returns
    -------
    tuple or None
        P (m, n, n) and the weights (n,); None if the loop is unstable at one of the knots.
    """
    n = samples.A.shape[1]
    exponents = np.zeros(n)
    best = frozen_functions(samples, np.ones(n))
    if best is None:
        return None
    if len(best) == 1:
        return best, np.ones(n)
    rate, step = frozen_rate_hz_s(samples, best, np.ones(n)), 2.0
    for turn in range(SEARCH_ROUNDS):
        for i in range(n):
            for change in (step, -step):
                trial = exponents.copy()
                trial[i] += change
                P = frozen_functions(samples, 10.0**trial)
                found = -math.inf if P is None else frozen_rate_hz_s(samples, P, 10.0**trial)
                if P is not None and found > rate:
                    best, rate, exponents = P, found, trial
                    break
        if turn % 2:
            step *= 0.6
    return best, np.asarray(10.0**exponents)


class MovingProgram:
    """The semidefinite program for functions at the knots, built once; the rate is its parameter.

    Parameters
    ----------
    samples
        The loop at the knots, in balanced coordinates.
    start, weights
        As `starting_functions` gives them.
    """

    def __init__(self, samples: Samples, start: Array, weights: Array) -> None:
        f, dt, n = samples.knots_hz, samples.dt, samples.A.shape[1]
        self._T = np.array([np.linalg.cholesky(P).T for P in start])
        self._X = [cp.Variable((n, n), symmetric=True) for _ in f]
        self._rate = cp.Parameter(nonneg=True)
        slack, unit, eye = cp.Variable(), 1.0 / np.sqrt(weights), np.eye(n)
        limits = [slack <= 1.0]
        for X in self._X:
            limits += [X >> LEAST_EIGENVALUE * eye, cp.trace(X) <= LARGEST_TRACE * n]
        for k in range(len(f) - 1):
            pair = (self._T[k], self._X[k]), (self._T[k + 1], self._X[k + 1])
            for j, shares in ((2 * k, (1.0, 0.0)), (2 * k + 1, (0.5, 0.5)), (2 * k + 2, (0.0, 1.0))):
                A, change = samples.A[j] * unit, (samples.A[j] - eye) / dt * unit
                still = sum(
                    share * _fall(T, X, change, unit, dt)
                    for (T, X), share in zip(pair, shares, strict=True)
                    if share
                )
                before, after = ((T @ A).T @ X @ (T @ A) for T, X in pair)
                drift = (after - before) / (f[k + 1] - f[k])
                for sign in (1.0, -1.0):
                    whole = still + sign * (self._rate * drift)
                    limits.append(0.5 * (whole + whole.T) << -slack * eye)
        self._problem = cp.Problem(cp.Maximize(slack), limits)

    def solve(self, rate_hz_s: float) -> Array | None:
        """Functions P (knots, n, n) that are to fall at this rate; None where the solver has none to offer."""
        self._rate.value = rate_hz_s
        return _candidate(self._problem, [(T, X) for T, X in zip(self._T, self._X, strict=True)])


def one_function(samples: Samples, start: Array, weights: Array) -> Array | None:
    """One P (n, n) for all frequencies, if the solver has a candidate.

    Parameters
    ----------
    start, weights
        P (n, n) of a frequency in the middle, and the weights it was made with.
    """
    n, dt = len(start), samples.dt
    T, unit, eye = np.linalg.cholesky(start).T, 1.0 / np.sqrt(weights), np.eye(len(start))
    X, slack = cp.Variable((n, n), symmetric=True), cp.Variable()
    limits = [slack <= 1.0, X >> LEAST_EIGENVALUE * eye, cp.trace(X) <= LARGEST_TRACE * n]
    for A in samples.A:
        still = _fall(T, X, (A - eye) / dt * unit, unit, dt)
        limits.append(0.5 * (still + still.T) << -slack * eye)
    found = _candidate(cp.Problem(cp.Maximize(slack), limits), [(T, X)])
    return None if found is None else found[0]


def _fall(T: Any, X: Any, change: Any, unit: Array, dt: float) -> Any:
    """``(A' P A - P)/dt`` of ``P = T' X T``, from change ``(A - I)/dt``: no difference of nearly equal numbers."""
    here, moved = T * unit, T @ change
    return moved.T @ X @ here + here.T @ X @ moved + dt * (moved.T @ X @ moved)


def _candidate(problem: cp.Problem, unknowns: list[tuple[Any, Any]]) -> Array | None:
    """Solve; whatever comes out is only a candidate, so that the solver's status does not matter."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # "may be inaccurate": it is judged elsewhere
        try:
            problem.solve(solver=cp.CLARABEL)
        except (cp.error.SolverError, ArithmeticError):
            return None
    if any(X.value is None or not np.isfinite(X.value).all() for _, X in unknowns):
        return None
    return np.array([T.T @ (0.5 * (X.value + X.value.T)) @ T for T, X in unknowns])
