"""Statistics of normalised innovations that say whether a filter is consistent, and the bands chance keeps them in.

Of a consistent filter the normalised innovations are white, of mean 0 and variance 1: their mean square (NIS) is
chi-squared, their mean and their autocorrelation from sample to sample are normal (Bar-Shalom, Li and Kirubarajan
2001, sec. 5.4).
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammainccinv, gammaincinv, ndtri

from estimators.types import StateEstimate
from twin.plant.linear import Array

CAPS = (4.0, 0.75, 1.0)
"""No block adds more than this NIS, mean and autocorrelation to the memory: a fault is forgotten in three time
constants."""


class Statistics(NamedTuple):
    """Per sensor: independent samples for squares and for means, pairs, and the three statistics."""

    squares: Array
    means: Array
    pairs: Array
    nis: Array
    bias: Array
    lag1: Array


class FadingStatistics:
    """Statistics with exponentially fading weights; what one block adds is capped, so that a fault is forgotten."""

    def __init__(self, sensors: int) -> None:
        self._weight, self._weight2 = np.zeros((3, sensors)), np.zeros((3, sensors))
        self._sum = np.zeros((3, sensors))

    def add(self, s: Statistics, fade: float) -> None:
        """Take one block in."""
        n = np.vstack([s.squares, s.means, s.pairs])
        value = np.vstack([s.nis, s.bias, s.lag1])
        n = np.where(np.isfinite(value), n, 0.0)
        caps = np.array(CAPS)[:, None]
        self._weight = fade * self._weight + n
        self._weight2 = fade**2 * self._weight2 + n
        self._sum = fade * self._sum + n * np.clip(np.nan_to_num(value), -caps, caps)

    def statistics(self) -> Statistics:
        """Weighted means, and the number of equally weighted samples that would be as certain."""
        some = self._weight > 0.0
        blank = np.full_like(self._sum, np.nan)
        value = np.divide(self._sum, self._weight, out=blank, where=some)
        n = np.divide(self._weight**2, self._weight2, out=np.zeros_like(self._sum), where=some)
        return Statistics(n[0], n[1], n[2], value[0], value[1], value[2])


def statistics_of(estimate: StateEstimate) -> Statistics:
    """Statistics of one block."""
    count = np.asarray(estimate.innovation_count, dtype=np.float64)
    lag1 = estimate.innovation_lag1
    with np.errstate(invalid="ignore", divide="ignore"):
        bias = estimate.innovation_mean / estimate.innovation_std
    return Statistics(
        squares=independent_samples(count, lag1, squares=True),
        means=independent_samples(count, lag1, squares=False),
        pairs=np.maximum(count - 1.0, 0.0),
        nis=estimate.nis_per_sensor,
        bias=bias,
        lag1=lag1,
    )


def independent_samples(count: Array, lag1: Array, *, squares: bool) -> Array:
    """How many independent samples are worth as much as correlated ones.

    Innovations with autocorrelation ``rho**|k|`` count ``(1 - rho) / (1 + rho)`` of their number for a mean, and with
    rho² for rho when their squares are averaged (Bartlett 1946). Correlation within 0.1 is taken as none, beyond 0.5 as
    0.5: there it is itself the finding.

    Parameters
    ----------
    count, lag1
        (n,) samples and their autocorrelation; NaN as none.
    squares
        Whether their squares are averaged.
    """
    rho = np.nan_to_num(lag1)
    rho = np.where(np.abs(rho) < 0.1, 0.0, np.clip(rho, -0.5, 0.5))
    rho = rho**2 if squares else np.maximum(rho, 0.0)
    return np.asarray(count * (1.0 - rho) / (1.0 + rho))


def nis_band(count: float, level: float) -> tuple[float, float]:
    """Band that the mean of ``count`` normalised squares leaves with probability ``level``, half on either side.

    ``chi2(count) / count``; (NaN, NaN) without any.
    """
    if not count > 0.0:
        return math.nan, math.nan
    return _chi2_band(count if count < 100.0 else float(round(count)), level)


@lru_cache(maxsize=1024)
def _chi2_band(count: float, level: float) -> tuple[float, float]:
    half = 0.5 * count
    return float(gammaincinv(half, 0.5 * level)) / half, float(gammainccinv(half, 0.5 * level)) / half


def nis_bands(count: Array, level: float) -> tuple[Array, Array]:
    """Lower and upper ends of `nis_band`, for each of some counts."""
    bands = np.array([nis_band(float(n), level) for n in count])
    return bands[:, 0], bands[:, 1]


def bias_band(count: Array | float, level: float) -> Array:
    """Magnitude that the mean of ``count`` normalised innovations passes with probability ``level``."""
    with np.errstate(divide="ignore"):
        return np.asarray(_normal(level) / np.sqrt(count))


def whiteness_band(count: Array | float, level: float) -> Array:
    """Magnitude that the lag-one autocorrelation of ``count`` pairs passes with probability ``level``.

    By Fisher's z-transformation, so that it stays below 1; 1 for fewer than four pairs, which tell nothing.
    """
    return np.asarray(np.tanh(_normal(level) / np.sqrt(np.maximum(np.asarray(count) - 3.0, 1e-9))))


@lru_cache(maxsize=16)
def _normal(level: float) -> float:
    return float(-ndtri(0.5 * level))
