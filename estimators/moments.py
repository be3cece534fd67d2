"""Moments of a block against smooth test functions: equations of motion without edges.

For a test function psi that vanishes at both ends of a block with its derivatives, integration by parts gives

    <x', psi> = -<x, psi'>,    <x, g> = integral of x(t) g(t) over the block,

so that a differential equation between measured signals becomes an algebraic one between their moments (the method
of modulating functions, Shinbrot 1957). It holds exactly whatever the signals do: growing, swept, shaken from
outside. With ``psi = w(t) exp(-j 2 pi f t)``, w a tapered window, the moments are the lock-in's phasors without what
a block cuts off at its ends.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import comb, pi

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from twin.plant.linear import Array, ComplexArray, read_only

MOST_DERIVATIVES = 4
"""Of the test function that its window allows: two for the equation of motion, two for a displacement in it."""

TAPER = 0.2
"""Share of the block at either end over which the window rises: costs a tenth of the standard deviation."""

BESIDE = (-6, -5, -4, -3, -2, 2, 3, 4, 6, 7, 8)
CLEAR = 1.75
"""Steps between a frequency where noise is looked at and anything that excites."""

RISE = Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
"""From 0 to 1 with four derivatives that vanish at both ends."""


@dataclass(frozen=True, slots=True)
class Moments:
    """Moments of p channels against the derivatives of test functions at n frequencies.

    Attributes
    ----------
    frequency_hz
        (n,) of the test functions: the excitation's first, then frequencies beside it, where there is only noise.
    against_derivatives
        (n, d + 1, p) sums over the samples of value times the test function's derivatives, up to the d-th.
    gram
        (n, d + 1, d + 1) sums of these derivatives' products, conjugated on the right: covariances of the moments
        of white noise with variance 1.
    """

    frequency_hz: Array
    against_derivatives: ComplexArray
    gram: ComplexArray


def moments(values: Array, duration_s: float, frequency_hz: float, derivatives: int) -> Moments:
    """Moments of a block at a frequency and beside it.

    Parameters
    ----------
    values
        (M, p) equidistant samples that fill the block.
    derivatives
        Highest derivative of the test functions, at most MOST_DERIVATIVES.
    """
    rows = len(values)
    steps = _steps(frequency_hz * duration_s)
    windows, table = _windows(rows, duration_s, (0, *steps), derivatives)
    time = (np.arange(rows) + 0.5) * (duration_s / rows) - 0.5 * duration_s
    turning = np.exp(-2j * pi * frequency_hz * time)
    against = (table.reshape(-1, rows) @ (values * turning[:, None])).reshape(*table.shape[:2], -1)
    hz = frequency_hz + np.array((0, *steps)) / duration_s
    leibniz = _leibniz(hz, derivatives)
    # A sensor's offset is no motion: what psi holds of a constant is taken out of it with a multiple of the window,
    # which vanishes at the ends as well.
    constant = (table[:, 0] @ turning) / windows[0].sum()
    moved = leibniz @ against - constant[:, None, None] * (windows @ values)
    return Moments(
        frequency_hz=read_only(hz),
        against_derivatives=moved,
        gram=leibniz @ (windows @ windows.T) @ leibniz.conj().transpose(0, 2, 1),
    )


def _leibniz(frequency_hz: Array, derivatives: int) -> ComplexArray:
    """(n, d + 1, d + 1): derivatives of ``w exp(-j 2 pi f t)`` out of those of w."""
    binomial, power = _binomial(derivatives)
    powers = [np.ones(len(frequency_hz), dtype=np.complex128)]
    for _ in range(derivatives):
        powers.append(powers[-1] * (-2j * pi * frequency_hz))
    return np.asarray(binomial * np.array(powers).T[:, power])


@lru_cache(maxsize=MOST_DERIVATIVES + 1)
def _binomial(derivatives: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(d + 1, d + 1) coefficients of Leibniz's rule, and how often its factors are the turning's derivatives."""
    order = np.arange(derivatives + 1)
    binomial = np.array([[comb(m, i) for i in order] for m in order])
    return binomial, np.maximum(order[:, None] - order[None, :], 0)


def _steps(cycles: float) -> tuple[int, ...]:
    """Distances from the excitation in steps of one over the block's duration: clear of 0 and of its harmonics."""
    found = []
    for k in BESIDE:
        at = cycles + k
        if at >= CLEAR and abs(at - cycles * round(at / cycles)) >= CLEAR:
            found.append(k)
    return tuple(found)


@lru_cache(maxsize=16)
def _windows(
    rows: int, duration_s: float, steps: tuple[int, ...], derivatives: int
) -> tuple[Array, ComplexArray]:
    """(derivatives + 1, rows) the window's derivatives, and (n_steps, ...) the same turning by each step."""
    x = (np.arange(rows) + 0.5) / rows
    edge = np.minimum(x, 1.0 - x) / TAPER
    rising = edge < 1.0
    windows = np.zeros((derivatives + 1, rows))
    windows[0] = 1.0
    for i in range(derivatives + 1):
        sign = np.where(x[rising] < 0.5, 1.0, (-1.0) ** i)
        slope = RISE.deriv(i) if i else RISE
        windows[i, rising] = sign * slope(edge[rising]) / (TAPER * duration_s) ** i
    slow = np.exp(-2j * pi * np.array(steps)[:, None] * (x - 0.5))
    turning = np.asarray(windows[None, :, :] * slow[:, None, :], dtype=np.complex128)
    return read_only(windows), turning
