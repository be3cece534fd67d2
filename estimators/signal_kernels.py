"""Compiled parts of the check of raw signals: one quick look at a block, and what marks the samples if it must."""

import math

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array
from twin.plant.stretches import STRETCH

BINS, LOWEST = 64, -50
"""Steps from sample to sample are counted by powers of two of the sensor's standard deviation, from this one on."""

SUBSAMPLE = 16
"""Every so many rows are counted; a few hundred tell roughness, steps and extremes well enough."""


@kernel
def scan(
    values: Array,
    before: Array,
    ranges: Array,
    bound: Array,
    std: Array,
    noisy: NDArray[np.bool_],
    steps: Array,
    counts: NDArray[np.int64],
    levels: Array,
) -> None:
    """Cheap look at a block, which tells whether it deserves a closer one.

    Parameters
    ----------
    values
        (N, p) samples.
    before
        (2, p) the two samples before the block.
    ranges
        (p,) magnitudes from which on a sample is saturated.
    bound
        (p,) spikes' bound. The second difference at a spike is twice its height; from one and a half times the
        bound on it is suspicious.
    std, noisy, steps
        (p,), (p,), (p, bins): standard deviations, whether to count, and the counts of steps by size, updated.

    counts
        (3, p) receives how many samples are at the end of their range or not finite; equal to the one before;
        suspicious jumps.
    levels
        (3, p) receives the mean of clipped |second differences| over some of the rows, NaN where there were none;
        the lowest and the highest value among them.
    """
    n, p = values.shape
    beyond, same, jumps = counts[0], counts[1], counts[2]
    rough, low, high = levels[0], levels[1], levels[2]
    counts[:] = 0
    rough[:], low[:], high[:] = np.nan, np.inf, -np.inf
    signals = np.empty((p, STRETCH + 2))
    for c in range(p):
        signals[c, 0], signals[c, 1] = before[0, c], before[1, c]
    for first in range(0, n, STRETCH):
        count = min(STRETCH, n - first)
        for k in range(count):
            for c in range(p):
                signals[c, k + 2] = values[first + k, c]
        for c in range(p):
            s, limit, end = signals[c], 1.5 * bound[c], ranges[c]
            n_beyond, n_same, n_jumps = 0, 0, 0
            for k in range(2, count + 2):
                d = s[k] - s[k - 1]
                n_same += d == 0.0
                n_beyond += not abs(s[k]) < end
                n_jumps += abs(d - (s[k - 1] - s[k - 2])) > limit
            beyond[c], same[c], jumps[c] = beyond[c] + n_beyond, same[c] + n_same, jumps[c] + n_jumps
            s[0], s[1] = s[count], s[count + 1]
    stride = max(1, min(SUBSAMPLE, n // SUBSAMPLE))
    for c in range(p):
        if not noisy[c]:
            continue
        total, counted = 0.0, 0
        for k in range(2, n, stride):
            v = values[k, c]
            low[c], high[c] = min(low[c], v), max(high[c], v)
            d = v - values[k - 1, c]
            second = abs(d - (values[k - 1, c] - values[k - 2, c]))
            if not np.isfinite(second):
                continue
            if d != 0.0:
                _, exponent = math.frexp(abs(d) / std[c])
                steps[c, min(max(exponent - LOWEST, 0), BINS - 1)] += 1.0
            total += min(second, 4.0 * bound[c])
            counted += 1
        if counted:
            rough[c] = total / counted


@kernel
def mark_missing(values: Array, valid: NDArray[np.bool_], ranges: Array, kinds: NDArray[np.uint8]) -> None:
    """Mark samples that came invalid or are not finite by 1, and those at the end of their range by 2."""
    for k in range(values.shape[0]):
        for c in range(values.shape[1]):
            v = values[k, c]
            if not np.isfinite(v):
                kinds[k, c] = 1
            elif not abs(v) < ranges[c]:
                kinds[k, c] = 2
            elif not valid[k, c]:
                kinds[k, c] = 1


@kernel
def mark_runs(
    signal: Array, longest: int, run_length: int, run_value: float, kinds: NDArray[np.uint8]
) -> None:
    """Mark runs of at least ``longest`` equal samples by 3, from their first sample in this block on.

    Samples that are marked already neither lengthen a run nor end it.

    Parameters
    ----------
    run_length, run_value
        Of the run that was going on before the block.
    """
    first = 0
    for k in range(len(signal)):
        if kinds[k] != 0:
            continue
        if signal[k] == run_value:
            run_length += 1
        else:
            run_length, run_value, first = 1, signal[k], k
        if run_length == longest:
            for j in range(first, k + 1):
                if kinds[j] == 0:
                    kinds[j] = 3
        elif run_length > longest:
            kinds[k] = 3


@kernel
def trailing_runs(values: Array, run_length: NDArray[np.int64], same: NDArray[np.int64]) -> NDArray[np.int64]:
    """Length of the run of equal samples with which each channel ends, (p,), given those before and `scan`'s count."""
    n, p = values.shape
    ends = np.ones(p, dtype=np.int64)
    for c in range(p):
        if same[c] == n:
            ends[c] = run_length[c] + n
        else:
            while ends[c] < n and values[n - ends[c] - 1, c] == values[n - 1, c]:
                ends[c] += 1
    return ends


@kernel
def insert(sorted_: Array, count: int, value: float) -> None:
    """Insert a value among the first ``count`` of an ascending array."""
    while count > 0 and sorted_[count - 1] > value:
        sorted_[count] = sorted_[count - 1]
        count -= 1
    sorted_[count] = value


@kernel
def mark_spikes(
    signal: Array, valid: NDArray[np.bool_], tail: Array, bound: float, kinds: NDArray[np.uint8]
) -> None:
    """Mark by 4 what lies off the median of five by more than the bound, and by more than three of them spread.

    Steps and one or two spikes among five leave the median where it is; the five are freed of their slope first. The
    spread of those three that lie closest together keeps the crests of an oscillation sampled a few times per period
    from passing for spikes (Hampel's filter with a guard). The block's last two samples are judged, less
    strictly, with those before them.

    Parameters
    ----------
    valid
        (n,) whether a sample is one.
    tail
        (4,) samples before the block; NaN where there are none.
    """
    n = len(signal)
    window, level, steps = np.empty(5), np.empty(5), np.empty(4)
    for k in range(n):
        if kinds[k] != 0:
            continue
        start = min(k - 2, n - 5)
        complete = True
        for j in range(5):
            at = start + j
            if at < -4 or at >= n:
                complete = False
            elif at < 0:
                window[j] = tail[4 + at]
            elif valid[at]:
                window[j] = signal[at]
            else:
                complete = False
            if complete and not np.isfinite(window[j]):
                complete = False
        if not complete:
            continue
        # A spike spoils two of the four differences, the same way at most if there are two of it: of the middle ones
        # the smaller is sound.
        for j in range(4):
            insert(steps, j, window[j + 1] - window[j])
        slope = steps[1] if abs(steps[1]) < abs(steps[2]) else steps[2]
        for j in range(5):
            insert(level, j, window[j] - slope * (j - 2))
        off = abs(signal[k] - slope * (k - start - 2) - level[2])
        spread = min(level[2] - level[0], level[3] - level[1], level[4] - level[2])
        # At the block's end the five lie to one side, where a curve bends away from its slope further.
        least = bound if start == k - 2 else 3.0 * bound
        if off > least and off > 3.0 * spread:
            kinds[k] = 4
