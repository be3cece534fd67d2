"""Picture of a what-if: motion, power and margin over the band, and the branches beside what was measured."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tuning.branch import BranchTrace
from tuning.whatif import Curves, Design
from twin.plant.errors import InputError
from twin.plant.linear import Array

COLOURS = {
    "passive": "#78909c", "in use": "#ef6c00", "proposed": "#1565c0", "given": "#2e7d32", "limit": "#c62828",
}  # fmt: skip
DASHES: dict[str, Any] = {
    "passive": ":",
    "in use": "--",
    "proposed": "-",
    "given": (0, (5, 1, 1, 1)),
    "limit": "-.",
}
LEAST_M = 1e-8


def draw_whatif(
    curves: Curves,
    traces: Sequence[BranchTrace],
    measured: tuple[Array, Array],
    path: Path,
    given: Sequence[Design | None] = (),
) -> None:
    """Write the picture.

    Parameters
    ----------
    given
        One per point of the curves: what gains of the person's own would do; none without any.

    Raises
    ------
    InputError
        If it cannot be written there, or its suffix is no picture's.
    """
    figure = Figure(figsize=(11.0, 8.5 if traces else 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    rows = 2 if traces else 1
    grid = figure.add_gridspec(rows, 3)
    motion, power, margin = (figure.add_subplot(grid[0, k]) for k in range(3))
    f = np.array([p.frequency_hz for p in curves.points])
    nan = float("nan")
    lines = {
        "passive": [p.passive_m for p in curves.points],
        "in use": [_or_nan(p.in_use.displacement_m) for p in curves.points],
        "proposed": [_or_nan(p.proposed.displacement_m if p.proposed else None) for p in curves.points],
        "limit": [_or_nan(p.limit_m) for p in curves.points],
    }
    designs: dict[str, list[Design | None]] = {
        "in use": [p.in_use for p in curves.points],
        "proposed": [p.proposed for p in curves.points],
    }
    if any(d is not None for d in given):
        designs["given"] = list(given)
        lines["given"] = [_or_nan(d.displacement_m if d else None) for d in given]
    for name, values in lines.items():
        shown = np.maximum(np.array(values, dtype=float), LEAST_M) * 1e6
        motion.semilogy(f, shown, linestyle=DASHES[name], color=COLOURS[name], label=name)
    motion.set(title="motion of the primary", xlabel="excitation [Hz]", ylabel="|x1| [µm]")
    motion.legend()
    for name, found in designs.items():
        watts = [d.powers.joule_mean_w if d is not None and d.powers is not None else nan for d in found]
        power.plot(f, watts, linestyle=DASHES[name], color=COLOURS[name], label=name)
        reached = [_or_nan(d.modulus_margin if d else None) for d in found]
        margin.plot(f, reached, linestyle=DASHES[name], color=COLOURS[name], label=name)
    power.axhline(curves.goal.joule_mean_w, color=COLOURS["limit"], linestyle="-.", label="budget")
    power.set(title="mean Joule power", xlabel="excitation [Hz]", ylabel="R i_rms² [W]")
    margin.axhline(curves.goal.modulus_margin, color=COLOURS["limit"], linestyle="-.", label="wanted")
    margin.set(title="modulus margin", xlabel="excitation [Hz]", ylabel="least |1 + L|")
    for axes in (power, margin):
        axes.set_ylim(bottom=0.0)
        axes.legend()
    if traces:
        branch = figure.add_subplot(grid[1, :])
        for trace in traces:
            x, std = 1e6 * trace.displacement_m, 1e6 * trace.displacement_std_m
            branch.plot(
                trace.time_s,
                x,
                linestyle=DASHES[trace.name],
                color=COLOURS[trace.name],
                label=trace.name,
                lw=1.0,
            )
            branch.fill_between(trace.time_s, x - std, x + std, color=COLOURS[trace.name], alpha=0.15)
        if len(measured[0]):
            branch.plot(measured[0], 1e6 * measured[1], color="black", lw=0.8, label="measured (observer)")
        branch.set(title="from this instant on, with one sigma", xlabel="time [s]", ylabel="x1 [µm]")
        branch.legend(loc="upper right", ncols=4)
    for axes in figure.axes:
        axes.grid(alpha=0.3)
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise InputError(f"--plot {path}: cannot be written ({error})") from error


def _or_nan(value: float | None) -> float:
    return float("nan") if value is None else value
