"""The time base of a foreign recording: its rate, stated or read off its time stamps, and where rows are missing."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.sidecar import Sidecar
from twin.rig.units import to_si

UNEVEN = 0.01  # largest departure of a step from the median step, as a share of it
GAP_TOLERANCE = 0.1  # and of a gap from a whole number of steps, in steps
MAX_GAPS = 100_000
MAX_GAP_STEPS = 100_000_000
REMEDY = "give the rate it was sampled at with --sample-rate HZ, or sample_rate_hz in a sidecar"


@dataclass(frozen=True, slots=True)
class Gap:
    """So many samples are missing before a row of the file."""

    before_row: int
    missing: int


@dataclass(frozen=True, slots=True)
class TimeBase:
    """When a recording's rows were sampled.

    Attributes
    ----------
    rate_hz
        Samples per second.
    note
        Where that comes from, in a sentence.
    gaps
        Where rows are missing, in the file's order.
    by_stamps
        Rate and gaps are those of the time stamps.
    """

    rate_hz: float
    note: str
    gaps: tuple[Gap, ...] = ()
    by_stamps: bool = False

    @property
    def missing(self) -> int:
        """Samples missing in all gaps."""
        return sum(gap.missing for gap in self.gaps)


@dataclass(frozen=True, slots=True)
class Stamps:
    """Time stamps as they lie in the file, in parts.

    Attributes
    ----------
    name, unit
        Of the array; the unit is s if None.
    parts
        The stamps, front to back.
    problem
        Why they are no series of numbers, if they are none.
    """

    name: str
    unit: str | None
    parts: Iterable[NDArray[np.generic]]
    problem: str = ""


def time_base(
    path: Path,
    *,
    stamps: Stamps | None,
    option_hz: float | None,
    own_hz: float | None,
    beside: Sidecar,
    n_rows: int,
) -> TimeBase:
    """Decide on a recording's sample rate [Hz] and say in a sentence where it came from.

    An option comes first. A nominal rate from beside the recording comes next, then one that the file itself states;
    evenly spaced time stamps must agree with it within 1 %, and stamps that are uneven (rounded, repeating) are set
    aside for it. Without a nominal rate the time stamps must be even, but for gaps of whole steps: these are masked.

    Parameters
    ----------
    path
        The file, for messages.
    stamps
        Time stamps, or None if there are none.
    option_hz
        Rate given by the person [Hz].
    own_hz
        Rate that the file states [Hz].
    beside
        The sidecar, for its nominal rate.
    n_rows
        Length of the channels.

    Raises
    ------
    InputError
        If there is no rate, it is not positive, or time stamps contradict it.
    """
    if option_hz is not None:
        if not (math.isfinite(option_hz) and option_hz > 0.0):
            raise InputError(f"sample rate [Hz]: must be a positive number of Hz, got {option_hz!r}")
        return TimeBase(float(option_hz), f"sample rate {option_hz:g} Hz as given")
    nominal, said_by = (beside.sample_rate_hz, beside.rate_from)
    if nominal is None and own_hz is not None:
        nominal, said_by = own_hz, "the file itself"
    said = f"sample rate {nominal:g} Hz from {said_by}" if nominal is not None else ""
    if stamps is None:
        if nominal is not None:
            return TimeBase(nominal, said)
        raise InputError(f"{path}: no sample rate: it has no time array 't' or 'time'; {REMEDY}")
    found = _Steps(path, stamps).look(n_rows)
    if found.problem:
        if nominal is None:
            raise InputError(f"{path}: time array '{stamps.name}' {found.problem}; {REMEDY}")
        return TimeBase(nominal, f"{said}: time array '{stamps.name}' {found.problem}, so it is not used")
    missing = sum(gap.missing for gap in found.gaps)
    gaps = f"; {missing} samples are missing in {len(found.gaps)} gaps and masked" if found.gaps else ""
    if nominal is None:
        return TimeBase(
            found.rate_hz,
            f"sample rate {found.rate_hz:g} Hz from time array '{stamps.name}'{gaps}",
            tuple(found.gaps),
            by_stamps=True,
        )
    if abs(found.rate_hz - nominal) > UNEVEN * nominal:
        raise InputError(
            f"{path}: time array '{stamps.name}' says {found.rate_hz:g} Hz but {said_by} says {nominal:g} Hz; "
            "correct the sidecar, or decide with --sample-rate HZ"
        )
    return TimeBase(nominal, said + gaps, tuple(found.gaps), by_stamps=bool(found.gaps))


class _Steps:
    """What the steps between time stamps say, found in one pass without holding the stamps."""

    def __init__(self, path: Path, stamps: Stamps) -> None:
        self.problem = stamps.problem
        self.rate_hz = 0.0
        self.gaps: list[Gap] = []
        self._parts = stamps.parts
        base, self._factor = to_si(stamps.unit or "s") or ("", 1.0)
        if base != "s":
            raise InputError(
                f"{path}: time array '{stamps.name}' is in {stamps.unit!r}, which is no unit of time; use s, ms or us"
            )

    def look(self, n_rows: int) -> "_Steps":
        """Go through the stamps once."""
        if self.problem:
            return self
        first = last = math.nan
        low, high, median = math.inf, -math.inf, math.nan
        rows, uneven, whole = 0, False, 0
        for part in self._parts:
            if part.dtype.kind not in "fiu":
                self.problem = "is not one series of numbers"
                return self
            time = part.astype(np.float64) * self._factor
            if not np.all(np.isfinite(time)):
                self.problem = "has stamps that are not finite"
                return self
            if not len(time):
                continue
            steps = np.diff(time, prepend=time[0] if rows == 0 else last)
            steps = steps[1:] if rows == 0 else steps
            first = float(time[0]) if rows == 0 else first
            if len(steps):
                median = float(np.median(steps)) if math.isnan(median) else median
                low, high = min(low, float(steps.min())), max(high, float(steps.max()))
                if median > 0.0:
                    at = rows if rows else 1
                    uneven |= not self._find_gaps(steps, median, at)
            last, rows = float(time[-1]), rows + len(time)
        if rows != n_rows:
            self.problem = f"has {rows} stamps for {n_rows} samples"
        elif rows < 2:
            self.problem = "has a single stamp"
        elif not median > 0.0 or uneven or len(self.gaps) > MAX_GAPS:
            self.gaps.clear()
            self.problem = (
                f"is not evenly spaced (steps of {low * 1e3:.4g} to {high * 1e3:.4g} ms, "
                f"median {median * 1e3:.4g} ms)"
            )
        else:
            whole = rows - 1 + sum(gap.missing for gap in self.gaps)
            # The mean step of even stamps: the median would carry their rounding. Nine digits drop binary noise.
            self.rate_hz = float(f"{whole / (last - first):.9g}")
        return self

    def _find_gaps(self, steps: NDArray[np.float64], median: float, at_row: int) -> bool:
        """Note steps that skip whole samples; False if any step is neither one nor several."""
        odd = np.nonzero(np.abs(steps - median) > UNEVEN * median)[0]
        for k in odd[: MAX_GAPS + 1]:
            share = steps[k] / median
            whole = round(share) if 0.0 < share < MAX_GAP_STEPS else 0
            if whole < 2 or abs(share - whole) > max(GAP_TOLERANCE, UNEVEN * whole):
                return False
            self.gaps.append(Gap(at_row + int(k), whole - 1))
        return True
