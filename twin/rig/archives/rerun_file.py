"""Rerun files of other programs: every entity's scalars as a series, its stamps as time."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, damaged, guard_memory
from twin.rig.rrf import extent, rows

TIME = "time"
SCALARS = "Scalars:scalars"
WALL_CLOCK = "log_time"
UNEVEN = 0.01
IN_MEMORY = 4
"""Its rows lie in any order: it can only be read whole, which takes so many times its size."""


@dataclass(frozen=True, slots=True)
class _Series:
    """Samples of one entity in order of time; stamps in ns, or plain counts where ``in_time`` is False."""

    values: NDArray[np.float64]
    stamps: NDArray[np.int64]
    in_time: bool

    @property
    def rate_hz(self) -> float | None:
        """Rate of even stamps."""
        steps = np.diff(self.stamps)
        if not self.in_time or len(steps) == 0:
            return None
        mean = float(self.stamps[-1] - self.stamps[0]) / len(steps)
        even = mean > 0.0 and float(np.max(np.abs(steps - mean))) <= UNEVEN * mean + 1.0
        return float(f"{1e9 / mean:.9g}") if even else None


class RerunArchive(Archive):
    """The scalars of a Rerun file (``.rrd``), an array an entity, named by its path.

    Entities that were logged at the same instants share the array ``time``. Where they were not, each must be even, and
    its rate and beginning are its own. The timeline is the one called ``time``, else the first of times, not of counts.

    Raises
    ------
    InputError
        If the file is damaged, cut short, or holds no scalars.
    """

    format = "Rerun .rrd"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        guard_memory(
            path,
            "it",
            IN_MEMORY * path.stat().st_size,
            "export the part you need, with 'rerun rrd' or as .parquet",
        )
        try:
            if extent(path).cut:
                raise InputError(
                    f"{path}: is cut short; save what is whole of it first: "
                    f"rerun rrd filter --continue-on-error {path} -o whole.rrd"
                )
            self._series = dict(_read(path))
        except InputError:
            raise
        except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        if not self._series:
            raise InputError(f"{path}: holds no scalars; expected entities logged as Scalars")
        self._stamps: NDArray[np.floating[Any]] | None = None
        self._judge_times()
        self.names = ((TIME,) if self._stamps is not None else ()) + tuple(self._series)

    def shape(self, name: str) -> tuple[int, ...]:
        """(n_samples,), or (n_samples, n) of an entity with several scalars a row."""
        if name == TIME and self._stamps is not None:
            return self._stamps.shape
        series = self._series[name]
        if series.in_time and self._stamps is None and series.rate_hz is None:
            raise InputError(
                f"{self.path}: entity '{name}' is not logged at even instants, nor at those of the others; resample "
                "it, or leave it out"
            )
        return series.values.shape

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of one entity, in order of time."""
        self.shape(name)
        if name == TIME and self._stamps is not None:
            return self._stamps[first:stop]
        return self._series[name].values[first:stop]

    def _judge_times(self) -> None:
        timed = {name: s for name, s in self._series.items() if s.in_time}
        if not timed:
            return
        begin = min(int(s.stamps[0]) for s in timed.values())
        first = next(iter(timed.values()))
        if all(np.array_equal(first.stamps, s.stamps) for s in timed.values()) and TIME not in self._series:
            self._stamps = (first.stamps - begin) * 1e-9
            self.units = {TIME: "s"}
            return
        self.rates_hz = {name: rate for name, s in timed.items() if (rate := s.rate_hz) is not None}
        self.starts_s = {name: float(timed[name].stamps[0] - begin) * 1e-9 for name in self.rates_hz}


def _read(path: Path) -> Iterator[tuple[str, _Series]]:
    parts: dict[str, list[tuple[pa.RecordBatch, str]]] = {}
    stores = set()
    for found in rows(path):
        batch = found.batch
        if batch is None:
            raise InputError(f"{path}: is damaged; use another copy")
        index = _timeline(batch.schema)
        if SCALARS in batch.schema.names and index:
            parts.setdefault(found.entity.lstrip("/"), []).append((batch, index))
            stores.add(found.store)
    if len(stores) > 1:
        raise InputError(
            f"{path}: holds {len(stores)} recordings; save each in a file of its own: rerun rrd filter"
        )
    for name, batches in parts.items():
        indices = {index for _, index in batches}
        if len(indices) > 1:
            raise damaged(
                path, name, ValueError(f"logged on different timelines: {', '.join(sorted(indices))}")
            )
        stamps = np.concatenate([_as_integers(b.column(index)) for b, index in batches])
        values = np.concatenate([_as_rows(path, name, b.column(SCALARS)) for b, _ in batches])
        order = np.argsort(stamps, kind="stable")
        values = values[order] if values.shape[1] > 1 else values[order, 0]
        in_time = not pa.types.is_integer(batches[0][0].schema.field(batches[0][1]).type)
        yield name, _Series(values, stamps[order], in_time)


def _timeline(schema: Any) -> str:
    """The index to go by: ``time``, else one of times, else one of counts; the clock of the computer last."""
    indices = [f for f in schema if (f.metadata or {}).get(b"rerun:kind") == b"index"]
    ranked = sorted(
        indices, key=lambda f: (f.name == WALL_CLOCK, pa.types.is_integer(f.type), f.name != TIME)
    )
    return str(ranked[0].name) if ranked else ""


def _as_integers(column: Any) -> NDArray[np.int64]:
    return np.asarray(column.cast(pa.int64()).to_numpy(zero_copy_only=False), dtype=np.int64)


def _as_rows(path: Path, name: str, column: Any) -> NDArray[np.float64]:
    lengths = set(column.value_lengths().to_pylist())
    if len(lengths) > 1 or None in lengths or 0 in lengths:
        raise damaged(path, name, ValueError("rows of different numbers of scalars"))
    flat = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=np.float64)
    return flat.reshape(len(column), -1)
