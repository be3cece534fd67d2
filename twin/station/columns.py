"""Rows held back and sent as columns: a few large chunks cost a fraction of many small ones."""

from collections import defaultdict

import numpy as np
import rerun as rr

from twin.plant.linear import Array

TIMELINE = "time"


def nanoseconds(time_s: Array | float) -> "np.ndarray[tuple[int], np.dtype[np.timedelta64]]":
    """Times [s] as Rerun takes them."""
    return np.atleast_1d(np.round(np.asarray(time_s) * 1e9)).astype("timedelta64[ns]")


class Columns:
    """Series of scalars and of measurements with a variance, sent to a stream in chunks of several blocks."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._rows: dict[str, list[tuple[Array, Array, Array | None]]] = defaultdict(list)

    def add(self, path: str, time_s: Array, values: Array, variances: Array | None = None) -> None:
        """Hold rows back: times (n,) [s], values (n, k) and, for measurements, variances (n, k)."""
        if len(time_s):
            self._rows[path].append((time_s, values, variances))

    def send(self) -> None:
        """Send all that is held back."""
        for path, rows in self._rows.items():
            index = rr.TimeColumn(TIMELINE, duration=nanoseconds(np.concatenate([r[0] for r in rows])))
            values = np.concatenate([r[1] for r in rows])
            if rows[0][2] is None:
                self._stream.send_columns(path, [index], rr.Scalars.columns(scalars=values))
                continue
            variances = np.concatenate([r[2] for r in rows if r[2] is not None])
            lengths = np.full(len(values), values.shape[1])
            columns = rr.Measurements.columns(values=values.ravel(), variances=variances.ravel())
            self._stream.send_columns(path, [index], columns.partition(lengths))
        self._rows.clear()
