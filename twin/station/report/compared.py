"""Runs laid side by side: aligned quantities, their differences from the reference, damping, what else differs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.plant.linear import Array
from twin.station.report.aligned import By, Cells, Quantity, common_grid, quantities, to_cells
from twin.station.report.differences import (
    configuration_rows,
    decision_rows,
    event_rows,
    figure_rows,
    gain_rows,
)
from twin.station.report.origin import plain
from twin.station.report.replayed import Replayed

SIGNIFICANT = 2.0
"""Differences beyond so many standard deviations are counted."""

KNOWN_NS_M = 1.0
"""Damping counts as known where its standard deviation is below this, in both runs."""

RATIOS = ("m", "W", "A")
"""Units of quantities whose differences are told as shares of the reference, too."""

SAME = 1e-9
"""Share of the reference below which a difference is rounding."""


@dataclass(frozen=True, slots=True)
class Difference:
    """A run against the reference on the common grid.

    Attributes
    ----------
    value, std
        (n_cells,) run less reference; NaN where either is unknown.
    """

    value: Array
    std: Array

    def summary(self, grid: Array) -> dict[str, Any] | None:
        """Mean, worst and how many are significant; None where nothing is in common."""
        known = np.isfinite(self.value)
        if not known.any():
            return None
        worst = int(np.nanargmax(np.abs(self.value)))
        told = known & np.isfinite(self.std)
        beyond = np.abs(self.value[told]) > SIGNIFICANT * self.std[told]
        return {
            "cells": int(known.sum()),
            "mean": float(self.value[known].mean()),
            "mean_std": float(self.std[told].mean()) if told.any() else None,
            "worst": float(self.value[worst]),
            "worst_std": float(self.std[worst]),
            "worst_at": float(grid[worst]),
            "judged": int(told.sum()),
            "significant": int(beyond.sum()),
        }


@dataclass(frozen=True, slots=True)
class Line:
    """One quantity of all runs on the common grid; cells and differences in the order of the runs."""

    quantity: Quantity
    cells: tuple[Cells, ...]
    differences: tuple[Difference, ...]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Runs, the reference first.

    Attributes
    ----------
    grid
        (n_cells,) frequencies [Hz] or times [s].
    step
        Width of a cell.
    lines
        Quantities that at least one run knows.
    damping
        Learned c2(f) on the reference's own grid of frequencies; None where fewer than two runs learned any.
    """

    runs: tuple[Replayed, ...]
    by: By
    grid: Array
    step: float
    lines: tuple[Line, ...]
    damping: "DampingLine | None"


@dataclass(frozen=True, slots=True)
class DampingLine:
    """Damping of all runs at common frequencies; None for a run that learned none.

    Attributes
    ----------
    known
        (n_frequencies,) for each run, where it and the reference know the damping to 1 Ns/m.
    """

    frequency_hz: Array
    curves: tuple[tuple[Array, Array] | None, ...]
    differences: tuple[Difference, ...]
    known: tuple[NDArray[np.bool_], ...]


def compare(runs: list[Replayed], by: By, step: float | None = None) -> Comparison:
    """Compare runs with the first.

    Raises
    ------
    InputError
        If they have no excitation frequency in common.
    """
    grid, step = common_grid(runs, by, step)
    lines = []
    for columns in zip(*(quantities(run) for run in runs), strict=True):
        cells = tuple(to_cells(run, q, by, grid, step) for run, q in zip(runs, columns, strict=True))
        if any(np.isfinite(c.value).any() for c in cells):
            lines.append(Line(columns[0], cells, tuple(_difference(cells[0], c) for c in cells)))
    return Comparison(tuple(runs), by, grid, step, tuple(lines), _damping(runs))


def _difference(reference: Cells, run: Cells) -> Difference:
    value = run.value - reference.value
    value[np.abs(value) < SAME * np.abs(reference.value)] = 0.0
    return Difference(value, np.hypot(run.std, reference.std))


def _damping(runs: list[Replayed]) -> DampingLine | None:
    first = next((run.curve for run in runs if run.curve is not None), None)
    if first is None or sum(run.curve is not None for run in runs) < 2:
        return None
    f = first.frequency_hz
    curves: list[tuple[Array, Array] | None] = []
    for run in runs:
        c = run.curve
        if c is None:
            curves.append(None)
            continue
        reach = {"left": np.nan, "right": np.nan}
        curves.append((
            np.interp(f, c.frequency_hz, c.damping_ns_m, **reach),
            np.interp(f, c.frequency_hz, c.std_ns_m, **reach),
        ))  # fmt: skip
    nothing = np.full(len(f), np.nan)
    reference = curves[0] or (nothing, nothing)
    differences, known = [], []
    for curve in curves:
        value, std = curve or (nothing, nothing)
        differences.append(Difference(value - reference[0], np.hypot(std, reference[1])))
        known.append((std < KNOWN_NS_M) & (reference[1] < KNOWN_NS_M))
    return DampingLine(f, tuple(curves), tuple(differences), tuple(known))


def as_data(c: Comparison) -> dict[str, Any]:
    """Everything a comparison says, as JSON takes it.

    Returns
    -------
    dict
        ``by``, ``step``, ``grid``, ``reference``, ``runs`` (name, file, sha256, plant, verify, figures of
        ``atmd replay``), ``figures``, ``quantities``, ``damping``, ``health``, ``configuration``, ``events``,
        ``decisions``, ``gains``.
    """
    hz = c.grid if c.by == "frequency" else _frequencies(c)
    return dict(plain({
        "by": c.by,
        "step": c.step,
        "grid": c.grid,
        "reference": c.runs[0].name,
        "runs": [_run(run) for run in c.runs],
        "figures": figure_rows(list(c.runs)),
        "quantities": {line.quantity.key: _line(c, line) for line in c.lines},
        "damping": _damping_data(c),
        "health": [_health(run) for run in c.runs],
        "configuration": configuration_rows(list(c.runs)),
        "events": event_rows(list(c.runs)),
        "decisions": decision_rows(list(c.runs)),
        "gains": gain_rows(list(c.runs), hz) if len(hz) else None,
    }))  # fmt: skip


def _frequencies(c: Comparison) -> Array:
    """Whole half hertz that every run's excitation has been at."""
    ends = []
    for run in c.runs:
        hz = run.tracks["frequency_hz"]
        if not np.isfinite(hz).any():
            return np.zeros(0)
        ends.append((float(np.nanmin(hz)), float(np.nanmax(hz))))
    low, high = max(a for a, _ in ends), min(b for _, b in ends)
    return np.arange(np.ceil(2.0 * low - 0.1) / 2.0, high + 0.05, 0.5)


def _run(run: Replayed) -> dict[str, Any]:
    return {
        "name": run.name,
        "file": str(run.path),
        "files": run.origin["files"],
        "recorded_at": run.origin["recorded_at"],
        "plant": run.plant.name,
        "plant_fingerprint": run.origin["plant_fingerprint"],
        "sample_rate_hz": run.sample_rate_hz,
        "seconds": run.seconds,
        "verify": run.origin["verify"],
        "estimates": run.estimates,
        "limits": [entry.as_dict() for entry in run.limits],
        "figures": run.figures,
    }


def _line(c: Comparison, line: Line) -> dict[str, Any]:
    return {
        "title": line.quantity.title,
        "unit": line.quantity.unit,
        "runs": [{"value": k.value, "std": k.std, "blocks": k.blocks} for k in line.cells],
        "differences": [
            {"value": d.value, "std": d.std, "summary": d.summary(c.grid), "relative": _relative(line, d)}
            for d in line.differences
        ],
    }


def _relative(line: Line, difference: Difference) -> float | None:
    """Mean difference over the reference's mean in the same cells; None for what has no size of its own."""
    known, reference = np.isfinite(difference.value), line.cells[0].value
    if line.quantity.unit not in RATIOS or not known.any() or not reference[known].mean() > 0.0:
        return None
    return float(difference.value[known].mean() / reference[known].mean())


def _damping_data(c: Comparison) -> dict[str, Any] | None:
    d = c.damping
    if d is None:
        return None
    parts = []
    for difference, known in zip(d.differences, d.known, strict=True):
        where = np.where(known, difference.value, np.nan)
        parts.append({
            "value": difference.value, "std": difference.std, "known": known,
            "summary": Difference(where, difference.std).summary(d.frequency_hz),
        })  # fmt: skip
    return {
        "frequency_hz": d.frequency_hz,
        "runs": [
            None if curve is None else {"damping_ns_m": curve[0], "std_ns_m": curve[1]} for curve in d.curves
        ],
        "differences": parts,
    }


def _health(run: Replayed) -> dict[str, Any]:
    verdicts = run.tracks.verdict
    sensors = run.figures["sensors"]
    return {
        "verdicts": {v: verdicts.count(v) / len(verdicts) for v in dict.fromkeys(verdicts)},
        "nis_median": run.figures["nis_median"],
        "nrmse": {s["sensor"]: s["nrmse"] for s in sensors},
        "faults": list(run.history.faults.values()),
    }
