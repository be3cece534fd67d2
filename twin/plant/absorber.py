"""Tuned absorbers and isolators in closed form: what can be said without building a state space.

Everything takes numbers or arrays, which broadcast, and gives arrays. Frequencies are in Hz where the name says
so; ratios are free of units: ``g`` forced frequency and ``f`` absorber's own frequency, both over the primary's
own frequency sqrt(k1/m1); ``mu`` absorber mass over primary mass; ``zeta`` absorber damping over
``2 m2 sqrt(k1/m1)``, which is Den Hartog's reference and not the absorber's own critical damping.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi


class Tuning(NamedTuple):
    """Absorber of least peak amplification, and what it reaches."""

    frequency_ratio: Array
    damping_ratio: Array
    amplification: Array


class FixedPoints(NamedTuple):
    """Where all damping ratios give the same amplitude: lower and upper ``g``, and the amplitude there."""

    lower: Array
    upper: Array
    lower_amplification: Array
    upper_amplification: Array


def natural_frequencies(
    m1_kg: ArrayLike, m2_kg: ArrayLike, k1_n_m: ArrayLike, k2_n_m: ArrayLike
) -> tuple[Array, Array]:
    """Lower and upper undamped natural frequency [Hz] of an absorber on a primary mass.

    Roots of ``m1 m2 w⁴ - ((k1 + k2) m2 + k2 m1) w² + k1 k2``, thesis eq. 3-17 and 3-18 (again as 4-5). The lower
    one is taken from the product of the roots, so that a stiff absorber costs it no digits.
    """
    m1, m2, k1, k2 = (np.asarray(v, dtype=np.float64) for v in (m1_kg, m2_kg, k1_n_m, k2_n_m))
    primary, absorber, coupling = (k1 + k2) / m1, k2 / m2, k2 / m1
    half_gap = (primary - absorber) / 2.0
    upper = (primary + absorber) / 2.0 + np.sqrt(half_gap**2 + coupling * absorber)
    lower = (k1 / m1) * absorber / upper
    return np.sqrt(lower) / TAU, np.sqrt(upper) / TAU


def absorber_response(
    frequency_hz: ArrayLike,
    *,
    m1_kg: ArrayLike,
    m2_kg: ArrayLike,
    k1_n_m: ArrayLike,
    k2_n_m: ArrayLike,
    c2_ns_m: ArrayLike = 0.0,
    c1_ns_m: ArrayLike = 0.0,
) -> tuple[ComplexArray, ComplexArray]:
    """Displacement of primary and absorber per force on the primary [m/N] (thesis eq. 4-4, with c1 beside it)."""
    s = 1j * TAU * np.asarray(frequency_hz, dtype=np.float64)
    m1, m2 = np.asarray(m1_kg, dtype=np.float64), np.asarray(m2_kg, dtype=np.float64)
    ground = np.asarray(c1_ns_m) * s + np.asarray(k1_n_m)
    link = np.asarray(c2_ns_m) * s + np.asarray(k2_n_m)
    absorber = m2 * s**2 + link
    # (m1 s² + ground + link) absorber - link², without its cancelling parts
    determinant = (m1 * s**2 + ground) * absorber + link * m2 * s**2
    return np.asarray(absorber / determinant), np.asarray(link / determinant)


def normalised_amplitude(g: ArrayLike, f: ArrayLike, mu: ArrayLike, zeta: ArrayLike) -> Array:
    """Amplitude of an undamped primary over its static deflection F/k1 (thesis eq. 4-6).

    Infinite at the two resonances of an undamped absorber.
    """
    g, f, mu, zeta = (np.asarray(v, dtype=np.float64) for v in (g, f, mu, zeta))
    damping = (2.0 * zeta * g) ** 2
    above = damping + (g**2 - f**2) ** 2
    below = (
        damping * (g**2 - 1.0 + mu * g**2) ** 2
        + (mu * f**2 * g**2 - (g**2 - 1.0) * (g**2 - f**2)) ** 2
    )  # fmt: skip
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt(above / below))


def fixed_points(f: ArrayLike, mu: ArrayLike) -> FixedPoints:
    """The two frequencies at which damping does not matter, and the amplitudes there.

    Where the curves of no damping and of infinite damping cross with opposite phase (Den Hartog, behind thesis
    eq. 4-7): ``(2 + mu) g⁴ - 2 (1 + (1 + mu) f²) g² + 2 f² = 0``, amplitude ``1 / |1 - (1 + mu) g²|``.
    """
    f, mu = np.asarray(f, dtype=np.float64), np.asarray(mu, dtype=np.float64)
    half = 1.0 + (1.0 + mu) * f**2
    # half² - 2 (2 + mu) f², written as a sum of squares
    upper = (half + np.sqrt((1.0 - (1.0 + mu) * f**2) ** 2 + 2.0 * mu * f**2)) / (2.0 + mu)
    lower = 2.0 * f**2 / ((2.0 + mu) * upper)
    low, high = (1.0 / np.abs(1.0 - (1.0 + mu) * g2) for g2 in (lower, upper))
    return FixedPoints(np.sqrt(lower), np.sqrt(upper), low, high)


def den_hartog(mu: ArrayLike) -> Tuning:
    """Den Hartog's tuning: fixed points of equal height, and damping that makes them about the peaks.

    ``f = 1/(1 + mu)`` (thesis eq. 4-7), ``zeta = sqrt(3 mu / (8 (1 + mu)³))`` (eq. 4-8, with the damping referred to
    the primary's frequency as in eq. 4-6) and the height of the fixed points ``sqrt(1 + 2/mu)``. The frequency
    is exact; the damping is the mean of the two that put a level tangent on one fixed point each, so the peaks
    stand a little above the fixed points, by under 0.5 % up to mu = 0.3.
    """
    mu = np.asarray(mu, dtype=np.float64)
    return Tuning(
        np.asarray(1.0 / (1.0 + mu)),
        np.asarray(np.sqrt(3.0 * mu / (8.0 * (1.0 + mu) ** 3))),
        np.asarray(np.sqrt(1.0 + 2.0 / mu)),
    )


def transmissibility(r: ArrayLike, zeta: ArrayLike) -> Array:
    """Force that reaches the foundation over the exciting force (thesis eq. 3-26).

    Parameters
    ----------
    r
        Frequency over the isolator's own; it isolates above sqrt(2), whatever its damping.
    zeta
        Damping ratio c / (2 m w_n).
    """
    r, zeta = np.asarray(r, dtype=np.float64), np.asarray(zeta, dtype=np.float64)
    damping = (2.0 * zeta * r) ** 2
    with np.errstate(divide="ignore"):
        return np.asarray(np.sqrt((1.0 + damping) / ((1.0 - r**2) ** 2 + damping)))


def absorber_transmissibility(
    frequency_hz: ArrayLike, *, m2_kg: ArrayLike, c2_ns_m: ArrayLike, k2_n_m: ArrayLike
) -> ComplexArray:
    """Absorber's motion over that of what it stands on, such as a shaker table (thesis eq. 5-4)."""
    s = 1j * TAU * np.asarray(frequency_hz, dtype=np.float64)
    link = np.asarray(c2_ns_m) * s + np.asarray(k2_n_m)
    return np.asarray(link / (np.asarray(m2_kg) * s**2 + link))
