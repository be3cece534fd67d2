"""Blocks of different runs brought to common instants: the same excitation frequencies, or the same times.

In each cell of the grid a run's blocks are fitted by a straight line, or where they are few joined by one, and read at
the cell's centre: runs that swept at other rates, or met other frequencies within the cell, give the same value where
the quantity is the same. Where the frequency stands still there is no slope to fit, and the mean is taken.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.plant.linear import Array
from twin.station.report.replayed import Replayed

By = Literal["frequency", "time"]

STEP_HZ = 0.5
MOST_CELLS = 600
"""Of time, unless a person asks for more."""

SLOPE_SPREAD = 0.15
"""A slope is fitted where the blocks of a cell spread (standard deviation) over this share of it; spread evenly over
the whole cell they have 0.29."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One quantity of a run, block by block.

    Attributes
    ----------
    values, std
        (n_blocks,) NaN where it is not known; ``std`` is what is common to neighbouring blocks or unknown.
    settled_only
        Whether by frequency only blocks under settled control count, where a run has any.
    """

    key: str
    title: str
    unit: str
    values: Array
    std: Array
    settled_only: bool


@dataclass(frozen=True, slots=True)
class Cells:
    """A run's quantity on the common grid, NaN where the run has no block.

    Attributes
    ----------
    value
        (n_cells,) at the centres.
    known_std
        (n_cells,) what the blocks themselves state; 0 where they state nothing.
    scatter_std
        (n_cells,) standard error by the blocks' scatter about the line; NaN where there are too few.
    blocks
        (n_cells,) how many.
    """

    value: Array
    known_std: Array
    scatter_std: Array
    blocks: NDArray[np.int64]

    @property
    def std(self) -> Array:
        """(n_cells,) both together; NaN where neither is known."""
        scatter = np.where(np.isfinite(self.scatter_std), self.scatter_std, 0.0)
        total = np.hypot(self.known_std, scatter)
        return np.where((total > 0.0) | np.isfinite(self.scatter_std), total, np.nan)


def quantities(run: Replayed) -> tuple[Quantity, ...]:
    """Everything of a run that is compared block by block."""
    t, h = run.tracks, run.hindsight
    unknown = np.full(len(t), np.nan)
    unit = "N" if t.force_estimated else next((c.unit for c in t.channels if c.name == t.reference), "")
    return (
        Quantity("attenuation", "attenuation", "1", h.attenuation, h.attenuation_std, True),
        Quantity(
            "displacement_m",
            "motion at the excitation",
            "m",
            t["displacement_m"],
            t["displacement_std_m"],
            True,
        ),
        Quantity("motion_peak_m", "largest estimated motion", "m", t["motion_peak_m"], unknown, True),
        Quantity("stroke_peak_m", "stroke", "m", t["stroke_peak_m"], t["stroke_std_m"], True),
        Quantity("joule_mean_w", "mean Joule power", "W", t["joule_mean_w"], unknown, True),
        Quantity("joule_peak_w", "peak Joule power", "W", t["joule_peak_w"], unknown, True),
        Quantity("electrical_mean_w", "mean electrical power", "W", t["electrical_mean_w"], unknown, True),
        Quantity("current_peak_a", "peak current", "A", t["current_peak_a"], unknown, True),
        Quantity("excitation", "excitation", unit, t["excitation"], unknown, False),
        Quantity("nis", "NIS", "1", t["nis"], unknown, False),
    )


def places(run: Replayed, by: By) -> Array:
    """(n_blocks,) where each block lies: its excitation frequency [Hz], or its middle [s]."""
    t = run.tracks
    return t["frequency_hz"] if by == "frequency" else t["time_s"] - 0.5 * t["duration_s"]


def common_grid(runs: list[Replayed], by: By, step: float | None) -> tuple[Array, float]:
    """Centres of the cells in which the reference, which is the first, and every other run have blocks.

    Parameters
    ----------
    step
        Width of a cell [Hz] or [s]; half a hertz unless given, or the longest block, and no more than `MOST_CELLS` of
        time.

    Raises
    ------
    InputError
        If a run has no excitation frequency, or none in common with the reference; the message says which and where.
    """
    if step is None:
        step = STEP_HZ
        if by == "time":
            block_s = max(float(np.median(run.tracks["duration_s"])) for run in runs)
            step = block_s * max(1, math.ceil(min(run.seconds for run in runs) / (MOST_CELLS * block_s)))
    cells = []
    for run in runs:
        x = places(run, by)
        x = x[np.isfinite(x)]
        if not len(x):
            raise InputError(
                f"{run.path}: shows no excitation frequency, so it cannot be compared by frequency; add --by time"
            )
        cells.append(set(_cell(x, by, step).tolist()))
    for run, found in zip(runs[1:], cells[1:], strict=True):
        if not found & cells[0]:
            ranges = "; ".join(f"{r.name}: {_range(places(r, by))} Hz" for r in (runs[0], run))
            raise InputError(
                f"no excitation frequency in common ({ranges}): compare by time with --by time"
                + (f", or take wider cells than {step:g} Hz with --step" if by == "frequency" else "")
            )
    in_any = sorted(cells[0] & set().union(*cells[1:]))
    return _centre(np.array(in_any, dtype=np.float64), by, step), step


def _cell(x: Array, by: By, step: float) -> NDArray[np.int64]:
    """Number of the cell; frequencies have centres at whole multiples, times have edges there."""
    cells: NDArray[np.int64] = np.floor(x / step + (0.5 if by == "frequency" else 0.0) + 1e-9).astype(
        np.int64
    )
    return cells


def _centre(cells: Array, by: By, step: float) -> Array:
    return np.asarray((cells + (0.0 if by == "frequency" else 0.5)) * step)


def _range(x: Array) -> str:
    low, high = f"{np.nanmin(x):.4g}", f"{np.nanmax(x):.4g}"
    return low if low == high else f"{low} to {high}"


def to_cells(run: Replayed, quantity: Quantity, by: By, grid: Array, step: float) -> Cells:
    """Bring a quantity to the grid."""
    x, y = places(run, by), quantity.values
    counts = np.isfinite(x) & np.isfinite(y)
    settled = run.tracks["settled"] > 0.0
    if by == "frequency" and quantity.settled_only and settled.any():
        counts &= settled
    order = np.flatnonzero(counts)[np.argsort(x[counts], kind="stable")]
    places_in_order = x[order]
    cell = _cell(places_in_order, by, step)
    value, known, scatter = (np.full(len(grid), np.nan) for _ in range(3))
    blocks = np.zeros(len(grid), dtype=np.int64)
    for k, number in enumerate(_cell(grid, by, step)):
        first, end = np.searchsorted(places_in_order, [grid[k] - step, grid[k] + step])
        near = order[first:end]
        rows = near[cell[first:end] == number]
        blocks[k] = len(rows)
        if len(rows):
            around = (x[near] - grid[k]) / step, y[near]
            value[k], scatter[k] = _at_centre((x[rows] - grid[k]) / step, y[rows], *around)
            stated = quantity.std[rows]
            # A block's own standard deviation is mostly the model's, which is its neighbours', too.
            known[k] = float(np.mean(stated[np.isfinite(stated)])) if np.isfinite(stated).any() else 0.0
    return Cells(value, known, scatter, blocks)


def _at_centre(u: Array, y: Array, around_u: Array, around_y: Array) -> tuple[float, float]:
    """Value at the centre, u = 0, and its standard error.

    Parameters
    ----------
    u, y
        The cell's own blocks, a line through them where they spread, else their mean.
    around_u, around_y
        Those up to a cell's width from the centre: where the cell has one or two of a sweep's blocks, the value lies
        between the two nearest on either side.
    """
    n = len(y)
    if n < 3:
        before, after = around_u <= 0.0, around_u >= 0.0
        if before.any() and after.any():
            ends = np.array([around_u[before].max(), around_u[after].min()])
            if ends[1] - ends[0] > SLOPE_SPREAD:
                left = float(around_y[before][np.argmax(around_u[before])])
                right = float(around_y[after][np.argmin(around_u[after])])
                return float(np.interp(0.0, ends, [left, right])), math.nan
    sloped = n >= 3 and float(np.std(u)) > SLOPE_SPREAD
    columns = np.column_stack([np.ones(n), u]) if sloped else np.ones((n, 1))
    solution, *_ = np.linalg.lstsq(columns, y, rcond=None)
    left_over = n - columns.shape[1]
    if left_over < 1:
        return float(solution[0]), math.nan
    residual = y - columns @ solution
    variance = float(residual @ residual) / left_over
    return float(solution[0]), float(np.sqrt(variance * np.linalg.inv(columns.T @ columns)[0, 0]))
