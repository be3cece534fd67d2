"""What happened when, and what was promised against what was achieved, as drawings."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.station.report.figures import MOST_POINTS
from twin.station.report.replayed import Replayed
from twin.station.validation.canvas import CONTROLLED, LIMIT, PASSIVE, SECOND, THIRD, dress

MICRO = 1e6
STATES = {
    "on": "#1565c0", "off": "#b0bec5", "unknown": "#e0e4e7",
    "consistent": "#2e7d32", "drifting": "#ef6c00", "diverged": "#c62828", "no data": "#78909c",
    "unestimated": "#b0bec5", "learning": "#42a5f5", "estimated": "#2e7d32", "invalid": "#c62828", "": "#e0e4e7",
}  # fmt: skip


def lanes_of(run: Replayed) -> list[tuple[str, list[str]]]:
    """State of control, damping learner and model, block by block."""
    control = [
        "unknown" if not np.isfinite(v) else "on" if v > 0.0 else "off" for v in run.tracks["control_on"]
    ]
    return [("control", control), ("damping", list(run.tracks.learner)), ("model", list(run.tracks.verdict))]


def shade_states(axes: Axes, run: Replayed) -> dict[str, str]:
    """Draw the lanes at 0, -1, -2; the states that occur with their colours."""
    t = run.tracks
    begin, end = t["time_s"] - t["duration_s"], t["time_s"]
    seen: dict[str, str] = {}
    for row, (_, states) in enumerate(lanes_of(run)):
        first = 0
        for k in range(1, len(states) + 1):
            if k == len(states) or states[k] != states[first]:
                state, width = states[first], end[k - 1] - begin[first]
                colour = STATES.get(state, "#78909c")
                axes.broken_barh([(begin[first], width)], (-row - 0.34, 0.68), color=colour, lw=0)
                if state:
                    seen.setdefault(state, colour)
                first = k
    axes.set_xlim(float(begin[0]), float(end[-1]))
    return seen


def draw_timeline(figure: Figure, run: Replayed) -> None:
    """States, events, decisions, commands and masked blocks along time."""
    axes = figure.add_subplot()
    t = run.tracks
    end = t["time_s"]
    seen = shade_states(axes, run)
    masked = t["masked"] > 0.0
    marks = [
        ("events", [e["time_s"] for e in run.history.events if e["level"] == "info"], "#78909c", "|"),
        ("events", [e["time_s"] for e in run.history.events if e["level"] == "warning"], SECOND, "v"),
        ("events", [e["time_s"] for e in run.history.events if e["level"] == "error"], LIMIT, "X"),
        ("decisions", [p["time_s"] for p in run.history.proposals if p["accepted"]], THIRD, "^"),
        ("decisions", [p["time_s"] for p in run.history.proposals if not p["accepted"]], PASSIVE, "x"),
        ("commands", [c["sent_s"] for c in run.history.commands.values()], CONTROLLED, "D"),
        ("masked", [float(v) for v in end[masked]], LIMIT, "|"),
    ]
    names = [name for name, _ in lanes_of(run)]
    for name, times, colour, mark in marks:
        if name not in names:
            names.append(name)
        shown = times[:: -(-len(times) // MOST_POINTS) or 1]
        axes.plot(shown, [-names.index(name)] * len(shown), mark, color=colour, ms=6, ls="", label="_marks")
    axes.set_yticks([-k for k in range(len(names))], names)
    axes.set_ylim(-len(names) + 0.4, 0.6)
    for state, colour in seen.items():
        axes.plot([], [], color=colour, lw=5, label=state)
    dress(axes, "time [s]", "", legend=False)
    axes.grid(axis="y", visible=False)
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, 1.16), ncol=9, fontsize=8, frameon=False, handlelength=1.2
    )


def draw_audit(figure: Figure, run: Replayed) -> None:
    """What was promised over what was achieved."""
    left, right = figure.subplots(1, 2)
    points = run.history.audit
    moved = [(p.displacement_m, p.displacement_error is not None) for p in points]
    spent = [(p.joule_mean_w, p.power_error is not None) for p in points]
    for axes, scale, unit, title, found in (
        (left, MICRO, "µm", "Motion", moved),
        (right, 1.0, "W", "Mean Joule power", spent),
    ):
        values = scale * np.array([pair for pair, _ in found])
        counted = np.array([counts for _, counts in found], dtype=bool)
        axes.plot(values[counted, 1], values[counted, 0], "o", color=CONTROLLED, ms=4, label="counts")
        axes.plot(
            values[~counted, 1],
            values[~counted, 0],
            "o",
            mfc="none",
            color=PASSIVE,
            ms=4,
            label="below the floor",
        )
        known = values[np.isfinite(values).all(axis=1) & (values > 0.0).all(axis=1)]
        if len(known):
            ends = np.array([0.8 * known.min(), 1.25 * known.max()])
            axes.plot(ends, ends, color="#455a64", lw=0.9, label="_equal")
            axes.fill_between(ends, 0.95 * ends, 1.05 * ends, color="#b0bec5", alpha=0.4, lw=0)
            if ends[1] > 10.0 * ends[0]:
                axes.set_xscale("log")
                axes.set_yscale("log")
        dress(axes, f"achieved [{unit}]", f"predicted [{unit}]", f"{title}; grey: ± 5 %")
