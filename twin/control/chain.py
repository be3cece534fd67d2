"""The rig's control law: filter chain, gains, clamp (thesis 7.9), sample by sample.

    relative acceleration -> low-pass -> integrate -> high-pass -> velocity -> integrate -> high-pass -> position
    i_ref = (alpha a + beta v + gamma x) / k, clamped

Filters are 2nd-order Butterworth in topology-preserving (trapezoidal) form (Zavalishin, *The Art of VA Filter
Design*, 2012): a cutoff may move at any sample with the state carried. Integrator and high-pass are one section,
``s / (s² + sqrt(2) wc s + wc²)``: the same transfer function without the integrator that an accelerometer's
offset would run away with.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from twin.plant.compiled import kernel
from twin.plant.linear import Array, ComplexArray, read_only

CHAIN_STATES = 6
SQRT2 = math.sqrt(2.0)


@kernel
def chain_step(s: Array, a_in: float, g_low: float, g_high: float, dt: float) -> tuple[float, float, float]:
    """Advance the filter chain by one sample, in place.

    Parameters
    ----------
    s
        (6,) section states.
    a_in
        Relative acceleration [m/s²].
    g_low, g_high
        ``tan(pi f_cutoff dt)`` of low-pass and high-pass.
    dt
        Sample period [s].

    Returns
    -------
    tuple of float
        Filtered relative acceleration [m/s²], velocity [m/s], position [m].
    """
    band = (s[0] + g_low * (a_in - s[1])) / (1.0 + g_low * (g_low + SQRT2))
    a = s[1] + g_low * band
    s[0], s[1] = 2.0 * band - s[0], 2.0 * a - s[1]

    scale = dt / (2.0 * g_high)
    band = (s[2] + g_high * (a - s[3])) / (1.0 + g_high * (g_high + SQRT2))
    low = s[3] + g_high * band
    s[2], s[3] = 2.0 * band - s[2], 2.0 * low - s[3]
    v = scale * band

    band = (s[4] + g_high * (v - s[5])) / (1.0 + g_high * (g_high + SQRT2))
    low = s[5] + g_high * band
    s[4], s[5] = 2.0 * band - s[4], 2.0 * low - s[5]
    return a, v, scale * band


def chain_response(
    frequency_hz: ArrayLike, low_pass_hz: float, high_pass_hz: float, sample_rate_hz: float
) -> ComplexArray:
    """Exact response of the discrete chain from acceleration to acceleration, velocity and position.

    Returns
    -------
    ndarray
        (n_frequencies, 3): dimensionless, s, s².
    """
    f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    dt = 1.0 / sample_rate_hz
    z = np.exp(2j * np.pi * f * dt)
    s = (z - 1.0) / (z + 1.0)  # trapezoidal: s dt / 2
    g_low, g_high = math.tan(math.pi * low_pass_hz * dt), math.tan(math.pi * high_pass_hz * dt)
    low = g_low**2 / (s**2 + SQRT2 * g_low * s + g_low**2)
    integrate = 0.5 * dt * s / (s**2 + SQRT2 * g_high * s + g_high**2)
    return np.stack([low, low * integrate, low * integrate**2], axis=-1)


@lru_cache(maxsize=512)
def chain_matrices(
    low_pass_hz: float, high_pass_hz: float, sample_rate_hz: float
) -> tuple[Array, Array, Array, Array]:
    """State-space form of the chain, by stepping `chain_step` itself through unit states and a unit input.

    Returns
    -------
    tuple of ndarray
        A (6, 6), B (6, 1), C (3, 6), D (3, 1) of ``s+ = A s + B a``, ``(a, v, x) = C s + D a``; read-only.
    """
    dt = 1.0 / sample_rate_hz
    g_low, g_high = math.tan(math.pi * low_pass_hz * dt), math.tan(math.pi * high_pass_hz * dt)
    n = CHAIN_STATES
    A, C = np.empty((n, n)), np.empty((3, n))
    for column in range(n):
        s = np.zeros(n)
        s[column] = 1.0
        C[:, column] = chain_step(s, 0.0, g_low, g_high, dt)
        A[:, column] = s
    s = np.zeros(n)
    D = np.array(chain_step(s, 1.0, g_low, g_high, dt))[:, None]
    return read_only(A), read_only(s[:, None]), read_only(C), read_only(D)
