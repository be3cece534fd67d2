"""Plots of runs side by side, each quantity with its difference from the reference below it."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.plant.linear import Array
from twin.station.report.compared import SIGNIFICANT, Comparison, Line
from twin.station.report.event_plots import lanes_of, shade_states
from twin.station.report.figures import Plot
from twin.station.report.plots import DWELL_HZ, draw_curve
from twin.station.report.words import prefix_for
from twin.station.validation.canvas import dress

COLOURS = ("#1565c0", "#e65100", "#2e7d32", "#8e24aa", "#00838f", "#5d4037", "#c2185b", "#455a64")
MARKS = "osD^vP*X"
MOST_BARS = 150
"""Of more cells the uncertainty is drawn as a band."""

SHOWN = (
    "attenuation",
    "displacement_m",
    "joule_mean_w",
    "joule_peak_w",
    "electrical_mean_w",
    "stroke_peak_m",
    "nis",
)


def comparison_plots(c: Comparison) -> list[Plot]:
    """Every plot for which there is something to show."""
    found = []
    where = "excitation frequency" if c.by == "frequency" else "time"
    no_excitation = not any(line.quantity.key == "displacement_m" for line in c.lines)
    for line in c.lines:
        q = line.quantity
        if q.key not in SHOWN and not (q.key == "motion_peak_m" and no_excitation):
            continue
        caption = (
            f"Read at common cells of {where}, {c.step:g} {'Hz' if c.by == 'frequency' else 's'} wide; below: less "
            f"{c.runs[0].name}, with {SIGNIFICANT:g} standard deviations where they are known."
        )
        if q.key == "attenuation":
            caption = (
                "Against each run's own model without control, with the damping known in its end. " + caption
            )
        title = q.title[0].upper() + q.title[1:]
        found.append(Plot(q.key, title, caption, 4.2, lambda f, line=line: _quantity(f, c, line)))  # type: ignore[misc]
    if c.damping is not None:
        caption = (
            "Learned curves with one and two standard deviations; below: less the reference's, where both are known to "
            "1 Ns/m. Doubt about the channels' delays counts in full, though two runs on one rig share it."
        )
        found.append(Plot("damping", "Coil damping c2(f)", caption, 4.4, lambda f: _damping(f, c)))
    caption = "Each run's control, damping learner and model, from its own beginning. "
    caption += "Marks: ▼ warning, ✖ error, ◆ command."
    found.append(
        Plot("timeline", "Course of events", caption, 0.9 + 0.8 * len(c.runs), lambda f: _timeline(f, c))
    )
    return found


def _quantity(figure: Figure, c: Comparison, line: Line) -> None:
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
    q = line.quantity
    largest = max(
        (float(np.nanmax(np.abs(k.value))) for k in line.cells if np.isfinite(k.value).any()), default=1.0
    )
    scale, prefix = prefix_for(largest, q.unit)
    unit = f"{prefix}{q.unit}"
    if q.key == "attenuation":
        scale, unit = 0.01, "%"
    for k, run in enumerate(c.runs):
        cells = line.cells[k]
        _points(top, c.grid, cells.value / scale, cells.std / scale, k, run.name)
        if k:
            d = line.differences[k]
            _points(
                low, c.grid, d.value / scale, SIGNIFICANT * d.std / scale, k, f"{run.name} - {c.runs[0].name}"
            )
    low.axhline(0.0, color=COLOURS[0], lw=1.0)
    if c.by == "frequency" and np.ptp(c.grid) < DWELL_HZ:
        top.set_xlim(c.grid.mean() - DWELL_HZ, c.grid.mean() + DWELL_HZ)
    dress(top, "", f"[{unit}]")
    dress(low, "excitation [Hz]" if c.by == "frequency" else "time [s]", f"difference [{unit}]")


def _points(axes: Axes, x: Array, y: Array, std: Array, k: int, label: str) -> None:
    colour, mark = COLOURS[k % len(COLOURS)], MARKS[k % len(MARKS)]
    known = np.isfinite(y)
    bars = np.where(np.isfinite(std), std, 0.0)
    if (bars[known] > 0.0).any() and len(x) > MOST_BARS:
        axes.fill_between(x[known], (y - bars)[known], (y + bars)[known], color=colour, alpha=0.2, lw=0)
    elif (bars[known] > 0.0).any():
        axes.errorbar(x[known], y[known], bars[known], fmt="none", ecolor=colour, lw=0.9, label="_bars")
    size = 4.0 if len(x) < 80 else 0.0
    axes.plot(x[known], y[known], color=colour, marker=mark, ms=size, lw=1.2, label=label)


def _damping(figure: Figure, c: Comparison) -> None:
    d = c.damping
    if d is None:
        return
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[1.6, 1.0])
    largest = 1.0
    for k, run in enumerate(c.runs):
        draw_curve(top, run, COLOURS[k % len(COLOURS)], run.name)
        if run.curve is not None:
            largest = max(largest, float(np.max(run.curve.damping_ns_m)))
        if k and d.known[k].any():
            known, difference = d.known[k], d.differences[k]
            f, value, std = d.frequency_hz[known], difference.value[known], difference.std[known]
            colour = COLOURS[k % len(COLOURS)]
            low.fill_between(
                f, value - SIGNIFICANT * std, value + SIGNIFICANT * std, color=colour, alpha=0.2, lw=0
            )
            low.plot(f, value, color=colour, lw=1.3, label=f"{run.name} - {c.runs[0].name}")
    low.axhline(0.0, color=COLOURS[0], lw=1.0)
    top.set_ylim(0.0, 1.6 * largest)
    dress(top, "", "c2 [Ns/m]")
    dress(low, "frequency [Hz]", "difference [Ns/m]")


def _timeline(figure: Figure, c: Comparison) -> None:
    panels = figure.subplots(len(c.runs), 1, sharex=True, squeeze=False)[:, 0]
    seen: dict[str, str] = {}
    for axes, run in zip(panels, c.runs, strict=True):
        seen |= shade_states(axes, run)
        for level, mark, colour in (("warning", "v", "#e65100"), ("error", "X", "#c62828")):
            times = [e["time_s"] for e in run.history.events if e["level"] == level]
            axes.plot(times, [-3.0] * len(times), mark, color=colour, ms=5, label="_marks")
        sent = [command["sent_s"] for command in run.history.commands.values()]
        axes.plot(sent, [-3.0] * len(sent), "D", color="#1565c0", ms=4, label="_marks")
        axes.set_yticks([0, -1, -2, -3], [*(name for name, _ in lanes_of(run)), "marks"], fontsize=7)
        axes.set_ylim(-3.6, 0.6)
        axes.grid(axis="y", visible=False)
        dress(axes, "time [s]" if axes is panels[-1] else "", "", run.name, legend=False)
    for state, colour in seen.items():
        panels[0].plot([], [], color=colour, lw=5, label=state)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc="outside upper right",
        ncol=9,
        fontsize=7.5,
        frameon=False,
        handlelength=1.2,
    )
