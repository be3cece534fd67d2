"""Rows held back and sent as columns: a few large chunks cost a fraction of many small ones."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

from twin.plant.linear import Array

TIMELINE = "time"


def nanoseconds(time_s: Array | float) -> "np.ndarray[tuple[int], np.dtype[np.timedelta64]]":
    """Times [s] as Rerun takes them."""
    return np.atleast_1d(np.round(np.asarray(time_s) * 1e9)).astype("timedelta64[ns]")


@dataclass(slots=True)
class _Held:
    """Rows of one entity: what makes columns of them, things in a row, times and arrays by component."""

    make: Callable[..., Any]
    per_row: int
    times: list[Array] = field(default_factory=list)
    arrays: dict[str, list[Array]] = field(default_factory=lambda: defaultdict(list))


class Columns:
    """Series of many kinds, sent to a stream in chunks of several blocks.

    Parameters
    ----------
    stream
        Where to.
    hold
        Blocks in a chunk. Entities take turns, so that no block has to send them all.
    """

    def __init__(self, stream: rr.RecordingStream, hold: int = 1) -> None:
        self._stream, self._hold = stream, hold
        self._held: dict[str, _Held] = {}
        self._block = 0

    def add(self, path: str, time_s: Array, values: Array, variances: Array | None = None) -> None:
        """Hold rows back: times (n,) [s], values (n, k) and, for measurements, variances (n, k)."""
        if variances is None:
            self._add(path, rr.Scalars.columns, 0, time_s, scalars=values)
            return
        flat = {"values": values.ravel(), "variances": variances.ravel()}
        self._add(path, rr.Measurements.columns, values.shape[1], time_s, **flat)

    def add_motion(self, path: str, time_s: Array, shift: Array, stretch: Array | None = None) -> None:
        """Hold back how something drawn is moved, (n, 2), and stretched, (n,) in x."""
        n = len(time_s)
        arrays = {"translation": np.column_stack([shift, np.zeros(n)])}
        if stretch is not None:
            arrays["scale"] = np.column_stack([stretch, np.ones((n, 2))])
        self._add(path, rr.Transform3D.columns, 0, time_s, **arrays)

    def add_arrows(self, path: str, time_s: Array, vectors: Array) -> None:
        """Hold back arrows, (n, k, 2); where they begin is static."""
        k = vectors.shape[1]
        self._add(path, rr.Arrows2D.columns, k, time_s, vectors=vectors.reshape(-1, 2))

    def _add(self, path: str, make: Callable[..., Any], per_row: int, time_s: Array, **arrays: Array) -> None:
        if not len(time_s):
            return
        held = self._held.get(path)
        if held is None:
            held = self._held[path] = _Held(make, per_row)
        held.times.append(time_s)
        for name, values in arrays.items():
            held.arrays[name].append(values)

    def end_block(self) -> None:
        """Send what is due after a block."""
        self._block += 1
        for turn, (path, held) in enumerate(self._held.items()):
            if (self._block + turn) % self._hold == 0:
                self._send(path, held)

    def send(self) -> None:
        """Send all that is held back."""
        for path, held in self._held.items():
            self._send(path, held)

    def _send(self, path: str, held: _Held) -> None:
        if not held.times:
            return
        time_s = np.concatenate(held.times)
        index = rr.TimeColumn(TIMELINE, duration=nanoseconds(time_s))
        columns = held.make(**{name: np.concatenate(parts) for name, parts in held.arrays.items()})
        if held.per_row:
            columns = columns.partition(np.full(len(time_s), held.per_row))
        self._stream.send_columns(path, [index], columns)
        held.times.clear()
        held.arrays.clear()
