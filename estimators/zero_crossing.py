"""Excitation frequency by counting zero crossings, as the thesis has it (6.2.4, Figure 6-4).

Kept to compare: `excitation` uses every sample and knows its own error. Here only the samples around a crossing
count, and noise adds crossings of its own where the signal is slow, unless a hysteresis swallows them.
"""

import math

import numpy as np
from numpy.typing import ArrayLike


def zero_crossing_frequency_hz(
    values: ArrayLike, sample_rate_hz: float, hysteresis: float = 0.0
) -> float | None:
    """Frequency from the time between the first and the last rising zero crossing.

    Crossings are placed between samples by a straight line; a constant offset is the signal's own business.

    Parameters
    ----------
    values
        (n,) samples.
    hysteresis
        The signal must have been below ``-hysteresis`` since the last crossing for the next one to count, and
        reach ``+hysteresis`` after it; in the unit of the values. Three to four standard deviations of the noise
        are enough.

    Returns
    -------
    float or None
        Hz; None with fewer than two crossings.

    Raises
    ------
    ValueError
        If the samples are not one row of finite numbers or the hysteresis is negative.
    """
    x = np.asarray(values, dtype=np.float64)
    if x.ndim != 1 or not np.isfinite(x).all():
        raise ValueError("zero crossings need one row of finite samples")
    if not hysteresis >= 0.0:
        raise ValueError("the hysteresis must not be below 0")
    side = np.zeros(len(x), dtype=np.int64)
    side[x > hysteresis] = 1
    side[x < -hysteresis] = -1
    clear = np.nonzero(side)[0]
    rises = np.nonzero((side[clear[:-1]] < 0) & (side[clear[1:]] > 0))[0]
    if len(rises) < 2:
        return None
    first = _crossing(x, int(clear[rises[0]]), int(clear[rises[0] + 1]))
    last = _crossing(x, int(clear[rises[-1]]), int(clear[rises[-1] + 1]))
    return (len(rises) - 1) * sample_rate_hz / (last - first)


def frequency_std_hz(
    amplitude: float, noise_std: float, frequency_hz: float, crossings: int, sample_rate_hz: float
) -> float:
    """Standard deviation of that frequency for white noise, with no false crossings.

    Noise moves a crossing by ``noise/slope``, ``noise/(2 pi f A)`` in time, by two thirds of that variance on
    average where a line joins two samples; the first and the last crossing alone carry the error.

    Parameters
    ----------
    crossings
        Rising zero crossings in the record, at least two.
    sample_rate_hz
        Must leave many samples per period.
    """
    if sample_rate_hz < 8.0 * frequency_hz or crossings < 2:
        raise ValueError("two crossings and eight samples per period are the least")
    shift_s = noise_std / (math.tau * frequency_hz * amplitude)
    return math.sqrt(2.0 * 2.0 / 3.0) * shift_s * frequency_hz**2 / (crossings - 1)


def _crossing(x: np.ndarray, before: int, after: int) -> float:
    """Where x crosses zero between two samples, in samples: at the last change of sign between them."""
    part = x[before : after + 1]
    k = int(np.nonzero((part[:-1] < 0.0) & (part[1:] >= 0.0))[0][-1])
    return before + k + float(part[k] / (part[k] - part[k + 1]))
