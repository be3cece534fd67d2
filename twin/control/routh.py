"""Routh-Hurwitz: which gains leave two bodies stable (thesis 6.2.3)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from twin.control.laws import Law
from twin.plant.config import Plant
from twin.plant.linear import Array


@dataclass(frozen=True, slots=True)
class GainBounds:
    """Gains above which the thesis calls the loop stable: alpha > -m2, beta > -c2, gamma > -k2 (6.2.3).

    They are where the absorber's effective mass, damping and stiffness vanish. Two things they leave out:
    relative acceleration feedback is unstable from ``-m1 m2/(m1 + m2)`` down already, which is above -m2
    (``alpha_relative_kg``), and with absolute measurement they do not suffice: see `characteristic_polynomial`.
    """

    alpha_kg: float
    beta_ns_m: float
    gamma_n_m: float
    alpha_relative_kg: float


def gain_bounds(plant: Plant, frequency_hz: float | None = None) -> GainBounds:
    """Return the bounds of thesis 6.2.3 for a plant's primary and absorber.

    Parameters
    ----------
    frequency_hz
        Where damping given against frequency is read [Hz].

    Raises
    ------
    ValueError
        If the plant has no absorber.
    """
    absorber = plant.absorber
    if absorber is None:
        raise ValueError(f"plant '{plant.name}' has no absorber")
    m1, m2 = plant.primary.mass_kg, absorber.mass_kg
    return GainBounds(
        alpha_kg=-m2,
        beta_ns_m=-absorber.damping_at(frequency_hz),
        gamma_n_m=-absorber.stiffness_n_m,
        alpha_relative_kg=-m1 * m2 / (m1 + m2),
    )


def characteristic_polynomial(plant: Plant, law: Law, frequency_hz: float | None = None) -> Array:
    """Coefficients a4 to a0 of the closed loop of two bodies (thesis eq. 6-4 and 6-6).

    ``D1 N + m2 s² Z`` with the primary's own ``D1 = m1 s² + c1 s + k1``, the absorber's
    ``N = (m2 + alpha) s² + (c2 + beta) s + k2 + gamma`` and the link between them, ``Z = N - m2 s²``; with absolute
    measurement the link stays the passive one, ``Z = c2 s + k2``.

    Returns
    -------
    ndarray
        (5,), highest power first.

    Raises
    ------
    ValueError
        Unless the plant is a primary on the ground with an absorber on it.
    """
    if len(plant.body) != 2 or plant.body[1].attached_to != plant.primary.name:
        raise ValueError(f"plant '{plant.name}' is no primary with one absorber on it")
    one, two = plant.body
    c1, c2 = one.damping_at(frequency_hz), two.damping_at(frequency_hz)
    m2, stiffness, damping = two.mass_kg, two.stiffness_n_m + law.gamma_n_m, c2 + law.beta_ns_m
    link = [law.alpha_kg, damping, stiffness]
    if law.measurement == "absolute":
        link = [0.0, c2, two.stiffness_n_m]
    own = np.polymul([one.mass_kg, c1, one.stiffness_n_m], [m2 + law.alpha_kg, damping, stiffness])
    return np.asarray(np.polyadd(own, np.polymul([m2, 0.0, 0.0], link)), dtype=np.float64)


def routh_table(coefficients: ArrayLike) -> Array:
    """Routh's table of a characteristic polynomial.

    Parameters
    ----------
    coefficients
        (n + 1,), highest power first.

    Returns
    -------
    ndarray
        (n + 1, n // 2 + 1), padded with zeros. The sign changes of its first column are the roots in the right
        half plane. A row of zeros (roots mirrored in the origin) is replaced by the derivative of its auxiliary
        polynomial; a zero at the head of a row that is none by a number small against the row.

    Raises
    ------
    ValueError
        If the leading coefficient is zero or one is not finite.
    """
    a = np.asarray(coefficients, dtype=np.float64)
    if a.ndim != 1 or len(a) < 2 or not np.isfinite(a).all() or a[0] == 0.0:
        raise ValueError("a characteristic polynomial has finite coefficients, the first not zero")
    n = len(a) - 1
    table = np.zeros((n + 1, n // 2 + 1))
    table[0, : len(a[0::2])] = a[0::2]
    table[1, : len(a[1::2])] = a[1::2]
    for row in range(1, n + 1):
        if row > 1:
            above, over = table[row - 1], table[row - 2]
            products = (above[0] * over[1:], over[0] * above[1:])
            table[row, :-1] = (products[0] - products[1]) / above[0]
            # What cancels to rounding is zero.
            scale = (np.abs(products[0]) + np.abs(products[1])) / abs(above[0])
            table[row, :-1][np.abs(table[row, :-1]) < 1e-13 * scale] = 0.0
        if not table[row].any():
            powers = n - row + 1 - 2 * np.arange(table.shape[1])
            table[row] = table[row - 1] * np.maximum(powers, 0)
        if table[row, 0] == 0.0:
            table[row, 0] = 1e-12 * max(float(np.abs(table[row]).max()), np.finfo(float).tiny)
    return table


def unstable_roots(coefficients: ArrayLike) -> int:
    """Roots of a polynomial in the right half plane, by Routh's table; those on the axis are not counted."""
    first = routh_table(coefficients)[:, 0]
    return int(np.count_nonzero(np.diff(np.signbit(first))))


def is_hurwitz(coefficients: ArrayLike) -> bool:
    """Whether all roots of a polynomial lie in the left half plane: neither right of the axis nor on it."""
    a = np.asarray(coefficients, dtype=np.float64)
    if not (np.all(a > 0.0) or np.all(a < 0.0)):
        return False  # a missing coefficient, or one of the other sign
    over, above = np.abs(a[0::2]), np.zeros(len(a[0::2]))
    above[: len(a[1::2])] = np.abs(a[1::2])
    for _ in range(len(a) - 2):
        products = over[1:], above[1:] * (over[0] / above[0])
        row = np.append(products[0] - products[1], 0.0)
        if row[0] <= 1e-13 * (products[0][0] + abs(products[1][0])):
            return False
        over, above = above, row
    return True
