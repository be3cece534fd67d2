"""The sample rate of a foreign recording: stated, or read off its time stamps if these can carry it."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.sidecar import Sidecar
from twin.rig.units import to_si

UNEVEN = 0.01  # largest departure of a step from the median step, as a share of it
REMEDY = "give the rate it was sampled at with --sample-rate HZ, or sample_rate_hz in a sidecar"


def sample_rate(
    path: Path,
    *,
    stamps: NDArray[np.generic] | None,
    name: str,
    unit: str | None,
    option_hz: float | None,
    beside: Sidecar,
    n_samples: int,
) -> tuple[float, str]:
    """Decide on a recording's sample rate [Hz] and say in a sentence where it came from.

    An option comes first. A nominal rate from beside the recording comes next; evenly spaced time stamps must
    agree with it within 1 %, and stamps that are uneven (rounded, repeating) are set aside for it. Without a
    nominal rate the time stamps must be even.

    Parameters
    ----------
    path, name, unit
        The file, the array of time stamps and its unit (s if None), for messages.
    stamps
        Time stamps, or None if there are none.
    option_hz
        Rate given by the person [Hz].
    beside
        The sidecar, for its nominal rate.
    n_samples
        Length of the channels.

    Raises
    ------
    InputError
        If there is no rate, it is not positive, or time stamps contradict it.
    """
    if option_hz is not None:
        if not (math.isfinite(option_hz) and option_hz > 0.0):
            raise InputError(f"sample rate [Hz]: must be a positive number of Hz, got {option_hz!r}")
        return float(option_hz), f"sample rate {option_hz:g} Hz as given"
    nominal = beside.sample_rate_hz
    said = f"sample rate {nominal:g} Hz from {beside.rate_from}" if nominal is not None else ""
    if stamps is None:
        if nominal is not None:
            return nominal, said
        raise InputError(f"{path}: no sample rate: it has no time array 't' or 'time'; {REMEDY}")
    problem, rate = _from_stamps(path, stamps, name, unit, n_samples)
    if problem is not None:
        if nominal is None:
            raise InputError(f"{path}: time array '{name}' {problem}; {REMEDY}")
        return nominal, f"{said}: time array '{name}' {problem}, so it is not used"
    if nominal is None:
        return rate, f"sample rate {rate:g} Hz from time array '{name}'"
    if abs(rate - nominal) > UNEVEN * nominal:
        raise InputError(
            f"{path}: time array '{name}' says {rate:g} Hz but {beside.rate_from} says {nominal:g} Hz; "
            "correct the sidecar, or decide with --sample-rate HZ"
        )
    return nominal, said


def _from_stamps(
    path: Path, stamps: NDArray[np.generic], name: str, unit: str | None, n_samples: int
) -> tuple[str | None, float]:
    """Return what is wrong with the stamps as a sentence's end (or None), and the rate [Hz] they give."""
    base, factor = to_si(unit or "s") or ("", 1.0)
    if base != "s":
        raise InputError(
            f"{path}: time array '{name}' is in {unit!r}, which is no unit of time; use s, ms or us"
        )
    if stamps.dtype.kind not in "fiu" or stamps.ndim != 1:
        return "is not one series of numbers", 0.0
    if len(stamps) != n_samples:
        return f"has {len(stamps)} stamps for {n_samples} samples", 0.0
    if n_samples < 2:
        return "has a single stamp", 0.0
    time = stamps.astype(np.float64) * factor
    if not np.all(np.isfinite(time)):
        return "has stamps that are not finite", 0.0
    steps = np.diff(time)
    median = float(np.median(steps))
    low, high = float(steps.min()), float(steps.max())
    if median <= 0.0 or max(high - median, median - low) > UNEVEN * median:
        return (
            f"is not evenly spaced (steps of {low * 1e3:.4g} to {high * 1e3:.4g} ms, "
            f"median {median * 1e3:.4g} ms)",
            0.0,
        )
    # The mean step of even stamps: the median would carry their rounding. Nine digits drop binary noise.
    return None, float(f"{(n_samples - 1) / (time[-1] - time[0]):.9g}")
