"""Where steps are in a record, and which channel is the input."""

import numpy as np

from estimators.fits.step import StepPiece
from twin.plant.linear import Array

FEWEST = 24


def squareness(values: Array) -> float:
    """How much a series looks like a step or a square wave: share of its samples close to one of two levels."""
    low, high = np.quantile(values, [0.02, 0.98])
    if not high > low:
        return 0.0
    level = (values - low) / (high - low)
    two = (np.abs(level) < 0.12) | (np.abs(level - 1.0) < 0.12)
    return float(np.mean(two)) * float(
        min(1.0, 8.0 * np.mean(np.abs(level) < 0.2), 8.0 * np.mean(np.abs(level - 1.0) < 0.2))
    )


def edges(values: Array) -> list[int]:
    """Samples at which a square wave changes its level, in order."""
    low, high = np.quantile(values, [0.02, 0.98])
    if not high > low:
        return []
    level = (values - low) / (high - low)
    out, state = [], bool(np.median(level[: max(3, len(level) // 200)]) > 0.5)
    for k, x in enumerate(level):
        if (x > 0.7 and not state) or (x < 0.3 and state):
            state = not state
            out.append(k)
    # Back from the crossing to where the edge began.
    begun = []
    for k in out:
        base = level[k - 1] if k else level[0]
        start = k
        while start > 0 and abs(level[start - 1] - round(float(base))) > 0.15 and k - start < 20:
            start -= 1
        begun.append(max(0, start - 1))
    return begun


def find_steps(output: Array, drive: Array | None, record: int = 0) -> list[StepPiece]:
    """Cut a record at its steps.

    Parameters
    ----------
    output
        (n,) response.
    drive
        (n,) input, or None: then the response itself shows where steps are, by jumps between resting levels.
    record
        Number of the record, for messages.

    Returns
    -------
    list of StepPiece
        Each from a little before its edge to just before the next.
    """
    at = edges(drive) if drive is not None else _jumps(output)
    out = []
    for k, edge in enumerate(at):
        end = at[k + 1] if k + 1 < len(at) else len(output)
        begin = max(edge - max(8, (end - edge) // 10), 0 if k == 0 else at[k - 1])
        if end - edge >= FEWEST:
            out.append(
                StepPiece(
                    output[begin:end], None if drive is None else drive[begin:end], edge - begin, record
                )
            )
    # The last step may be cut off by the end of the record: without its settled level it says little.
    longest = max((len(p.output) - p.edge for p in out), default=0)
    return [p for p in out if len(p.output) - p.edge > 0.5 * longest]


def _jumps(output: Array) -> list[int]:
    """Edges in a response: where, after quiet, it moves by far more than it did before."""
    n = len(output)
    span = max(8, n // 100)
    noise = max(float(np.median(np.abs(np.diff(output)))) / 0.6745, 1e-9 * float(np.ptp(output)))
    out: list[int] = []
    k = 0
    size = float(np.ptp(output))
    while k < n - FEWEST:
        before = output[max(0, k - span) : k] if k else output[:1]
        level, quiet = float(np.median(before)), float(np.ptp(before))
        ahead = output[k : k + max(3, span // 4)]
        if (
            abs(float(ahead[0]) - level) > max(6.0 * noise, 0.04 * size)
            and quiet < 0.25 * size
            and k - (out[-1] if out else -n) > span
        ):
            start = k
            while start > 0 and abs(float(output[start - 1]) - level) > max(3.0 * noise, 0.005 * size):
                start -= 1
            # A swing about the final level is no step: what follows must settle elsewhere, or ring.
            out.append(max(0, start - 1))
            k += span
        k += 1
    if not out:
        out = [0]
    return _merge(output, out)


def _merge(output: Array, at: list[int]) -> list[int]:
    """Keep jumps that are as large as the largest: the others are swings of the ringing."""
    at = sorted(set(at))
    ends = [*at[1:], len(output)]
    heights = [float(np.ptp(output[a:b])) for a, b in zip(at, ends, strict=True)]
    top = max(heights)
    return [a for a, h in zip(at, heights, strict=True) if h > 0.6 * top]
