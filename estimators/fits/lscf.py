"""Poles of measured frequency responses: least-squares complex frequency domain, and what stays the same.

A common denominator is fitted to all responses at once, for every order up to a largest one (Guillaume et al., IMAC
2003, "poly-reference LSCF", here with one denominator for all columns). Poles of the structure come out the same at
one order after another, poles that only fit noise move about: the stabilisation diagram.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
STABLE_FREQUENCY, STABLE_DAMPING = 0.003, 0.3
"""Relative change from one order to the next below which a pole counts as the same; damping may also change
by `DAMPING_FLOOR`."""
DAMPING_FLOOR = 3e-4


@dataclass(frozen=True, slots=True)
class Pole:
    """A pole that stays where it is as the order grows.

    Attributes
    ----------
    frequency_hz, damping_ratio
        Median over the orders in which it was found.
    found
        Share of the orders, from the first in which it appears, that have it.
    """

    frequency_hz: float
    damping_ratio: float
    found: float


@dataclass(frozen=True, slots=True)
class Stabilisation:
    """Stabilisation diagram.

    Attributes
    ----------
    order, frequency_hz, damping_ratio, stable
        (n_points,) one entry per pole and order; stable if the order before had the same pole.
    poles
        Poles that stay, by frequency.
    """

    order: Array
    frequency_hz: Array
    damping_ratio: Array
    stable: Array
    poles: tuple[Pole, ...]


def poles_by_order(
    frequency_hz: Array, response: ComplexArray, weight: Array, orders: Sequence[int]
) -> list[ComplexArray]:
    """Stable poles [1/s] inside the band for each order, all responses together.

    Parameters
    ----------
    frequency_hz
        (n,) frequencies, ascending.
    response
        (n, n_responses) measured responses.
    weight
        (n, n_responses) one over the standard deviation of their noise.
    orders
        Numbers of poles to fit, ascending.
    """
    low, span = frequency_hz[0], 1.05 * (frequency_hz[-1] - frequency_hz[0])
    turn = np.exp(-1j * TAU * (frequency_hz - low) / span)
    top = orders[-1]
    powers = turn[:, None] ** np.arange(top + 1)
    blocks = []
    for h, w in zip(response.T, weight.T, strict=True):
        x = w[:, None] * powers
        y = -(w * h)[:, None] * powers
        blocks.append((x.conj().T @ x, x.conj().T @ y, y.conj().T @ y))
    out = []
    for order in orders:
        size = order + 1
        reduced = np.zeros((size, size), dtype=np.complex128)
        for r, s, t in blocks:
            r_n, s_n = r[:size, :size], s[:size, :size]
            reduced += t[:size, :size] - s_n.conj().T @ np.linalg.lstsq(r_n, s_n, rcond=1e-13)[0]
        # The coefficient of the highest power is set to one: that makes the poles which only fit noise unstable.
        lower = np.linalg.lstsq(reduced[:order, :order], -reduced[:order, order], rcond=1e-13)[0]
        roots = np.roots(np.concatenate([[1.0], lower[::-1]]))
        roots = roots[np.abs(roots) > 0.0]
        pole = -np.log(roots) * span + 1j * TAU * low
        pole = np.where(pole.imag < TAU * (low - 0.02 * span), pole + 1j * TAU * span, pole)
        hz, zeta = np.abs(pole) / TAU, -pole.real / np.abs(pole)
        inside = (pole.imag / TAU >= frequency_hz[0]) & (pole.imag / TAU <= frequency_hz[-1])
        keep = inside & (zeta > -0.002) & (zeta < 0.6) & (hz > 0.0)
        out.append(pole[keep])
    return out


def stabilise(
    frequency_hz: Array, response: ComplexArray, weight: Array, largest_order: int
) -> Stabilisation:
    """Stabilisation diagram and the poles that stay."""
    orders = list(range(2, largest_order + 1))
    rows: list[tuple[int, float, float, bool]] = []
    before = np.zeros(0, dtype=np.complex128)
    for order, poles in zip(orders, poles_by_order(frequency_hz, response, weight, orders), strict=True):
        rows += [(order, abs(p) / TAU, -p.real / abs(p), _has(before, p)) for p in poles]
        before = poles
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    steady = _clusters(table, orders, float(frequency_hz[1] - frequency_hz[0]))
    return Stabilisation(table[:, 0], table[:, 1], table[:, 2], table[:, 3], steady)


def _has(poles: ComplexArray, wanted: complex) -> bool:
    hz, zeta = np.abs(poles), -poles.real / np.maximum(np.abs(poles), 1e-300)
    f, z = abs(wanted), -wanted.real / abs(wanted)
    near = np.abs(hz - f) < STABLE_FREQUENCY * f
    return bool((near & (np.abs(zeta - z) < STABLE_DAMPING * abs(z) + DAMPING_FLOOR)).any())


def _clusters(table: Array, orders: list[int], resolution_hz: float) -> tuple[Pole, ...]:
    """Poles marked stable, gathered by frequency; those that most orders have once they have appeared."""
    steady = table[table[:, 3] > 0.0]
    steady = steady[np.argsort(steady[:, 1])]
    if len(steady) == 0:
        return ()
    reach = np.maximum(STABLE_FREQUENCY * steady[:-1, 1], 0.25 * resolution_hz)
    groups = np.split(steady, np.flatnonzero(np.diff(steady[:, 1]) > reach) + 1)
    out = []
    for g in groups:
        first = g[:, 0].min()
        found = len(np.unique(g[:, 0])) / max(1.0, orders[-1] - first + 1.0)
        if len(g) >= 4 and first <= orders[0] + 0.7 * (orders[-1] - orders[0]):
            out.append(Pole(float(np.median(g[:, 1])), float(np.median(g[:, 2])), float(found)))
    return tuple(out)
