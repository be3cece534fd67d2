"""Sensor noise through the loop, and what an observer or a low-pass makes of it (thesis 6.9).

Every displacement and velocity is measured with noise of a variance per sample (thesis Table 6-3), held until the
next sample; the force follows it at once. White noise without a sample rate would give that force no finite
variance at all. Variances are the stationary ones, from a discrete Lyapunov equation.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm, matrix_balance

from twin.control.filters import SQRT2
from twin.control.laws import Law, measured_motion
from twin.control.lq import ForceModel
from twin.plant.config import Plant
from twin.plant.linear import Array

TABLE_6_3_VARIANCES = (5e-12, 0.25e-6, 2e-6, 1e-2)
"""Noise variances of the thesis: x1, x2 [m²], x1', x2' [(m/s)²]."""


@dataclass(frozen=True, slots=True)
class NoiseEffect:
    """Standard deviations that sensor noise alone causes; infinite if the loop is unstable."""

    primary_std_m: float
    force_std_n: float

    @property
    def stable(self) -> bool:
        """Whether there is a stationary state at all."""
        return math.isfinite(self.force_std_n)


def law_as_state_gain(plant: Plant, law: Law) -> Array:
    """K of ``f = -K x`` on displacements and velocities that is the same as a law without acceleration, (2 n,).

    Raises
    ------
    ValueError
        If the law feeds back acceleration, which is no state.
    """
    if law.alpha_kg != 0.0:
        raise ValueError("acceleration is no state: a law with alpha has no gain on states alone")
    motion = measured_motion(plant, law.measurement)
    return -np.concatenate([law.gamma_n_m * motion, law.beta_ns_m * motion])


def noise_direct(model: ForceModel, K: Array, variance: ArrayLike, sample_rate_hz: float) -> NoiseEffect:
    """Effect of noise that reaches the law as it is, ``f = -K (x + n)``.

    Parameters
    ----------
    variance
        (2 n,) of one sample of each displacement [m²] and velocity [(m/s)²].
    """
    A = model.A - np.outer(model.b, K)
    return _held_noise(A, -np.outer(model.b, K), -K, -K, variance, sample_rate_hz)


def noise_through_observer(
    model: ForceModel, K: Array, L: Array, C: ArrayLike, variance: ArrayLike, sample_rate_hz: float
) -> NoiseEffect:
    """Effect of noise on the outputs ``y = C x`` of an observer whose estimate feeds the law (thesis Figure 6-18).

    Parameters
    ----------
    L
        (2 n, p) observer gain, from `lq.placed_observer` or `lq.kalman_observer`.
    variance
        (p,) of one sample of each output.
    """
    measured = np.atleast_2d(np.asarray(C, dtype=np.float64))
    n, outputs = len(model.A), len(measured)
    by_estimate = np.outer(model.b, K)
    A = np.block([[model.A, -by_estimate], [L @ measured, model.A - by_estimate - L @ measured]])
    B = np.vstack([np.zeros((n, outputs)), L])
    return _held_noise(A, B, np.concatenate([np.zeros(n), -K]), np.zeros(outputs), variance, sample_rate_hz)


def noise_through_low_pass(
    model: ForceModel, K: Array, cutoff_hz: float, variance: ArrayLike, sample_rate_hz: float
) -> NoiseEffect:
    """Effect of noise behind a 2nd-order Butterworth low-pass on every measured state (thesis 6.9.4).

    The filter's lag is in the loop: above the tuned frequency it destabilises (thesis 6.9.5).
    """
    n, w = len(model.A), math.tau * cutoff_hz
    zero, eye = np.zeros((n, n)), np.eye(n)
    A = np.block(
        [
            [model.A, -np.outer(model.b, K), zero],
            [zero, zero, w * eye],
            [w * eye, -w * eye, -SQRT2 * w * eye],
        ]
    )
    B = np.vstack([zero, zero, w * eye])
    row = np.concatenate([np.zeros(n), -K, np.zeros(n)])
    return _held_noise(A, B, row, np.zeros(n), variance, sample_rate_hz)


def _held_noise(
    A: Array, B: Array, row: Array, feed: Array, variance: ArrayLike, sample_rate_hz: float
) -> NoiseEffect:
    """Stationary deviations of the first state and of ``row x + feed n`` under sampled and held noise n."""
    if np.linalg.eigvals(A).real.max() >= 0.0:
        return NoiseEffect(math.inf, math.inf)
    n, inputs = B.shape
    scaled, transform = matrix_balance(A, permute=False, separate=True)
    scale = np.asarray(transform[0])
    block = np.zeros((n + inputs, n + inputs))
    block[:n, :n], block[:n, n:] = scaled, B / scale[:, None]
    step = expm(block / sample_rate_hz)
    noise = np.diag(np.asarray(variance, dtype=np.float64))
    P = stationary_covariance(step[:n, :n], step[:n, n:] @ noise @ step[:n, n:].T)
    if P is None:
        return NoiseEffect(math.inf, math.inf)
    out = row * scale
    force = float(out @ P @ out + feed @ noise @ feed)
    return NoiseEffect(float(scale[0]) * math.sqrt(float(P[0, 0])), math.sqrt(force))


def stationary_covariance(F: Array, Q: Array) -> Array | None:
    """Solve ``P = F P F' + Q`` by doubling: a sum of squares, exact also for poles close to the unit circle.

    Parameters
    ----------
    F, Q
        (n, n), in states of like size.

    Returns
    -------
    ndarray or None
        (n, n); None if F has an eigenvalue on the unit circle or outside.
    """
    P = Q
    for _ in range(64):
        more = F @ P @ F.T
        if not np.isfinite(more).all():
            return None
        P = P + more
        if np.abs(more).max() <= 1e-15 * np.abs(P).max():
            return np.asarray(P)
        F = F @ F
    return None
