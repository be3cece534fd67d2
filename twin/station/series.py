"""Reading back the series a `RerunView` wrote, for summaries without Rerun's viewer."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.plant.linear import Array
from twin.rig.rrf import rows

_VALUES = {"Scalars:scalars": "SeriesLines:names", "Measurements:values": "Measurements:names"}


@dataclass(frozen=True, slots=True)
class Series:
    """One entity's curves: times (n,) [s], values (n, k), names (k,), standard deviations (n, k) or None."""

    time_s: Array
    values: Array
    names: tuple[str, ...]
    std: Array | None


def read_series(path: Path) -> dict[str, Series]:
    """Every scalar series and measurement in a recording, by entity path without its leading slash."""
    parts: dict[tuple[str, str], list[tuple[Array, Array]]] = {}
    names: dict[str, tuple[str, ...]] = {}
    for logged in rows(path):
        batch, entity = logged.batch, logged.entity.lstrip("/")
        if batch is None or entity.startswith("record/"):
            continue
        for column in batch.schema.names:
            if column in _VALUES.values():
                names[entity] = tuple(batch.column(column)[batch.num_rows - 1].as_py() or ())
            elif (column in _VALUES or column == "Measurements:variances") and "time" in batch.schema.names:
                values = np.asarray(batch.column(column).flatten(), dtype=np.float64)
                time_s = np.asarray(batch.column("time").cast("int64")) * 1e-9
                kind = "variance" if column == "Measurements:variances" else "value"
                parts.setdefault((entity, kind), []).append((time_s, values.reshape(len(time_s), -1)))
    found = {}
    for (entity, kind), some in parts.items():
        if kind == "variance":
            continue
        time_s, values = _sorted(some)
        spread = parts.get((entity, "variance"))
        std = None if spread is None else np.sqrt(_sorted(spread)[1])
        labels = names.get(entity, ())
        found[entity] = Series(time_s, values, labels or ("",) * values.shape[1], std)
    return found


def _sorted(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    time_s = np.concatenate([t for t, _ in parts])
    order = np.argsort(time_s, kind="stable")
    return time_s[order], np.concatenate([v for _, v in parts])[order]
