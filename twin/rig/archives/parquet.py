"""Parquet tables, read a row group at a time."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, damaged, refuse_absurd

UNREADABLE = (pa.ArrowException, OSError, ValueError)


class ParquetArchive(Archive):
    """The numeric columns of one Parquet file; a field's metadata may state its ``unit``.

    Raises
    ------
    InputError
        If the file is damaged or holds no columns of numbers.
    """

    format = "Parquet"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            # Pages in turn: a row group of another's file may be all of it.
            self._file = pq.ParquetFile(path, buffer_size=1 << 20, pre_buffer=False, memory_map=False)
            schema = self._file.schema_arrow
        except UNREADABLE as error:
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        refuse_absurd(path, "any column", 8.0 * self._file.metadata.num_rows)
        numeric = [f for f in schema if pa.types.is_integer(f.type) or pa.types.is_floating(f.type)]
        self.names = tuple(f.name for f in numeric)
        if not self.names:
            raise InputError(f"{path}: holds no columns of numbers")
        self.units = {
            f.name: f.metadata[b"unit"].decode(errors="replace")
            for f in numeric
            if f.metadata and b"unit" in f.metadata
        }

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of rows."""
        return (int(self._file.metadata.num_rows),)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of one column."""
        stop = self.shape(name)[0] if stop is None else stop
        parts, at = [], 0
        for chunk in self.chunks([name], 1 << 20):
            column = chunk[name]
            parts.append(column[max(0, first - at) : max(0, stop - at)])
            at += len(column)
            if at >= stop:
                break
        return np.concatenate(parts) if parts else np.empty(0)

    def chunks(self, names: Sequence[str], rows: int) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Go through several columns together."""
        wanted = list(dict.fromkeys(names))
        try:
            for batch in self._file.iter_batches(batch_size=rows, columns=wanted, use_threads=False):
                # A null is a missing sample.
                yield {
                    name: np.asarray(batch.column(name).cast(pa.float64()).to_numpy(zero_copy_only=False))
                    for name in wanted
                }
        except UNREADABLE as error:
            raise damaged(self.path, ", ".join(wanted), error) from error

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()
