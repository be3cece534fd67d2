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
from twin.plant.compiled import kernel
from twin.plant.linear import Array

NIS, BIAS, LAG1 = 0, 1, 2
"""Rows of the statistics: mean square, mean, autocorrelation from one sample to the next."""

CAPS = np.array([4.0, 0.75, 1.0])
"""No block adds more than this to the memory: a fault is forgotten within three of its time constants."""


class Statistics(NamedTuple):
    """Three statistics of each sensor's normalised innovations, in the rows NIS, BIAS and LAG1.

    Attributes
    ----------
    samples
        (3, p) number of independent samples that would be as certain; 0 where nothing was measured.
    value
        (3, p); NaN where there is none.
    """

    samples: Array
    value: Array


class FadingStatistics:
    """Statistics with exponentially fading weights.

    Parameters
    ----------
    sensors
        How many.
    """

    def __init__(self, sensors: int) -> None:
        self._sums = np.zeros((3, 3, sensors))  # weights, squared weights, weighted values

    def add(self, s: Statistics, fade: float) -> None:
        """Take one block in, after the older ones' weight has faded by a factor."""
        fade_in(s.samples, s.value, fade, CAPS, self._sums)

    def statistics(self) -> Statistics:
        """Weighted means, and the number of equally weighted samples that would be as certain."""
        count, value = np.empty(self._sums.shape[1:]), np.empty(self._sums.shape[1:])
        take_out(self._sums, count, value)
        return Statistics(count, value)


def statistics_of(estimate: StateEstimate) -> Statistics:
    """Statistics of one block."""
    shape = (3, len(estimate.sensors))
    count, value = np.empty(shape), np.empty(shape)
    gather(
        estimate.innovation_count,
        estimate.nis_per_sensor,
        estimate.innovation_mean,
        estimate.innovation_std,
        estimate.innovation_lag1,
        count,
        value,
    )
    return Statistics(count, value)


@kernel
def independent_samples(count: float, lag1: float, squares: bool) -> float:
    """How many independent samples are worth as much as correlated ones.

    Innovations with autocorrelation ``rho**|k|`` count ``(1 - rho) / (1 + rho)`` of their number for a mean, and with
    rho² for rho when their squares are averaged (Bartlett 1946). Correlation within 0.1 is taken as none, beyond 0.5 as
    0.5: there it is itself the finding. NaN is none.
    """
    rho = 0.0
    if abs(lag1) >= 0.1:
        rho = min(max(lag1, -0.5), 0.5)
    rho = rho * rho if squares else max(rho, 0.0)
    return count * (1.0 - rho) / (1.0 + rho)


@kernel
def gather(
    samples: Array, nis: Array, mean: Array, std: Array, lag1: Array, count: Array, value: Array
) -> None:
    """Fill (3, p) counts and statistics from those of a `StateEstimate`, each (p,)."""
    for r in range(len(samples)):
        count[NIS, r] = independent_samples(samples[r], lag1[r], True)
        count[BIAS, r] = independent_samples(samples[r], lag1[r], False)
        count[LAG1, r] = max(samples[r] - 1.0, 0.0)
        value[NIS, r], value[LAG1, r] = nis[r], lag1[r]
        value[BIAS, r] = mean[r] / std[r] if std[r] > 0.0 else np.nan
        for k in range(3):
            if not np.isfinite(value[k, r]):
                count[k, r], value[k, r] = 0.0, np.nan


@kernel
def fade_in(count: Array, value: Array, fade: float, caps: Array, sums: Array) -> None:
    """Fade (3, 3, p) sums of weights, squared weights and weighted values, and add capped statistics to them."""
    for k in range(count.shape[0]):
        for r in range(count.shape[1]):
            n = count[k, r]
            capped = min(max(value[k, r], -caps[k]), caps[k]) if n > 0.0 else 0.0
            sums[0, k, r] = fade * sums[0, k, r] + n
            sums[1, k, r] = fade * fade * sums[1, k, r] + n
            sums[2, k, r] = fade * sums[2, k, r] + n * capped


@kernel
def take_out(sums: Array, count: Array, value: Array) -> None:
    """Counts and statistics, (3, p), that (3, 3, p) sums stand for."""
    for k in range(count.shape[0]):
        for r in range(count.shape[1]):
            # Weights below one sample are the remains of what was measured long ago.
            some = sums[0, k, r] > 1.0
            count[k, r] = sums[0, k, r] ** 2 / sums[1, k, r] if some else 0.0
            value[k, r] = sums[2, k, r] / sums[0, k, r] if some else np.nan


def nis_band(count: float, level: float) -> tuple[float, float]:
    """Band that the mean of ``count`` normalised squares leaves with probability ``level``, half on either side.

    ``chi2(count) / count``, with large counts rounded to three digits; (NaN, NaN) without any.
    """
    if not count > 0.0:
        return math.nan, math.nan
    return _chi2_band(count if count < 100.0 else round(count, 2 - math.floor(math.log10(count))), level)


@lru_cache(maxsize=4096)
def _chi2_band(count: float, level: float) -> tuple[float, float]:
    half = 0.5 * count
    return float(gammaincinv(half, 0.5 * level)) / half, float(gammainccinv(half, 0.5 * level)) / half


def bias_band(count: float, level: float) -> float:
    """Magnitude that the mean of ``count`` normalised innovations passes with probability ``level``."""
    return _normal(level) / math.sqrt(count) if count > 0.0 else math.inf


def whiteness_band(count: float, level: float) -> float:
    """Magnitude that the lag-one autocorrelation of ``count`` pairs passes with probability ``level``.

    By Fisher's z-transformation, so that it stays below 1; 1 for fewer than four pairs, which tell nothing.
    """
    return math.tanh(_normal(level) / math.sqrt(count - 3.0)) if count > 3.0 else 1.0


@lru_cache(maxsize=16)
def _normal(level: float) -> float:
    return float(-ndtri(0.5 * level))
