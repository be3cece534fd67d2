"""Measuring side by side: the candidates take turns, so that a busy machine slows them alike."""

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds per sample: the median, and half of the range between the quartiles as a share of it."""

    median_s: float
    spread: float


def side_by_side(runs: Mapping[str, tuple[Callable[[], object], int]], repetitions: int) -> dict[str, Timing]:
    """Time several runs in turns, once unmeasured and then ``repetitions`` times.

    Parameters
    ----------
    runs
        By name: what to call, and how many samples it takes through.
    """
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for repetition in range(repetitions + 1):
        for name, (call, samples) in runs.items():
            gc.disable()
            began = time.perf_counter()
            call()
            elapsed = time.perf_counter() - began
            gc.enable()
            if repetition:
                taken[name].append(elapsed / samples)
    return {name: _timing(values) for name, values in taken.items()}


def _timing(values: list[float]) -> Timing:
    low, median, high = np.percentile(values, [25.0, 50.0, 75.0])
    return Timing(float(median), float(0.5 * (high - low) / median))
