"""Plots of one run: motion, attenuation, power, damping, consistency, and what happened when."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.plant.linear import Array
from twin.station.report.event_plots import draw_audit, draw_timeline
from twin.station.report.figures import MOST_POINTS, Plot, thinned
from twin.station.report.replayed import Replayed
from twin.station.validation.canvas import CONTROLLED, LIMIT, PASSIVE, SECOND, SHADES, THIRD, dress

MICRO, MILLI = 1e6, 1e3
LEAST_M, LEAST_DB = 1e-8, -60.0
"""Nothing below these is drawn: where the limit is standstill, rounding is all that is left of it."""

DWELL_HZ = 0.5
"""An excitation that moves by less stands still: no line is drawn along it."""

MOST_BARS = 500
"""Points with a bar each; of more every second, third and so on is drawn."""

GROUND_ON = "#eaf2fb"


def plots_of(run: Replayed) -> list[Plot]:
    """Every plot for which the run has something to show."""
    t = run.tracks
    found = []
    if _any(t["displacement_m"]) or _any(t["motion_peak_m"]):
        found.append(
            Plot("motion", "Motion and stroke", _motion_caption(run), 4.4, lambda f: _motion(f, run))
        )
    if _any(run.hindsight.attenuation):
        caption = (
            "Of settled blocks, against the model without control with the damping known in the end; bars are one "
            "standard deviation, by the block's noise and the damping's. 0 dB is no effect; nothing is drawn below -60."
        )
        found.append(
            Plot("attenuation", "Attenuation against frequency", caption, 3.4, lambda f: _attenuation(f, run))
        )
    if _any(t["joule_mean_w"]):
        found.append(
            Plot(
                "power",
                "Power and current of the coil",
                "Each block's mean Joule power R i_rms², peak Joule power R i_peak² and mean electrical power v i, "
                "beside the budget at the time; current against its limit.",
                4.4,
                lambda f: _power(f, run),
            )
        )
    if run.curve is not None:
        caption = (
            "Learned value with one and two standard deviations, what model and tuner worked with, and the plant's "
            "own value from its file. Shaded: where the excitation has been."
        )
        found.append(Plot("damping", "Coil damping c2(f)", caption, 3.4, lambda f: _damping(f, run)))
    caption = "Normalised innovation squared with the 95 % band of a consistent filter, and each sensor's innovations "
    caption += "over what the filter expected: 1 is right."
    found.append(Plot("health", "Consistency of the observer", caption, 4.2, lambda f: _health(f, run)))
    caption = (
        "Lanes say what state things were in. Events: | note, ▼ warning, ✖ error. Decisions: ▲ taken, × declined. "
        "◆ command. Masked: blocks with samples that were not used."
    )
    found.append(Plot("timeline", "Course of events", caption, 3.0, lambda f: draw_timeline(f, run)))
    if run.history.audit:
        caption = (
            "What the gains in use were promised to do, against what they did, where the motion had settled. "
        )
        caption += "Open marks lie below the floor at which a comparison says anything."
        found.append(Plot("audit", "Predicted against achieved", caption, 3.6, lambda f: draw_audit(f, run)))
    return found


def shade_control(axes: Axes, run: Replayed) -> None:
    """Grey-blue ground where the controller acted."""
    t = run.tracks
    begin, on = t["time_s"] - t["duration_s"], t["control_on"] > 0.0
    for first, last in _stretches(on):
        axes.axvspan(begin[first], t["time_s"][last], color=GROUND_ON, lw=0, zorder=0)


def _stretches(on: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(int), [0]])))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _any(values: Array) -> bool:
    return bool(np.isfinite(values).any())


def _line(axes: Axes, x: Array, y: Array, colour: str, label: str, **style: object) -> None:
    if _any(y):
        axes.plot(*thinned(x, y), color=colour, label=label, **style)  # type: ignore[arg-type]


def _motion_caption(run: Replayed) -> str:
    name = run.plant.primary.name
    if _any(run.tracks["displacement_m"]):
        return (
            f"Peak displacement of {name} at the excitation, block by block; without control as the model has it with "
            "the damping known in the end; nothing is drawn below 10 nm. Shaded: the controller acts."
        )
    return f"Largest displacement of {name} in each block, as the observer estimates it: no excitation is tracked."


def _motion(figure: Figure, run: Replayed) -> None:
    t, x = run.tracks, run.tracks["time_s"]
    rows = 2 if _any(t["stroke_peak_m"]) else 1
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False, height_ratios=[1.8, 1.0][:rows])[:, 0]
    top = axes[0]
    shade_control(top, run)
    if _any(t["displacement_m"]):
        _line(top, x, MICRO * t["displacement_m"], CONTROLLED, "measured", lw=1.6)
        _line(top, x, MICRO * run.hindsight.passive_m, PASSIVE, "model, no control", lw=1.3, ls="--")
        _line(
            top,
            x,
            MICRO * np.maximum(t["limit_m"], LEAST_M),
            THIRD,
            "least of any controller",
            lw=1.2,
            ls=":",
        )
    else:
        _line(top, x, MICRO * t["motion_peak_m"], CONTROLLED, "estimated, largest of the block", lw=1.4)
    if (limit := run.plant.limits.get("primary_displacement_m")) is not None:
        top.axhline(MICRO * limit, color=LIMIT, lw=1.1, label=f"limit {MICRO * limit:g} µm")
    positive = [
        v for line in top.get_lines() for v in np.ravel(np.asarray(line.get_ydata(), float)) if v > 0.0
    ]
    if positive and max(positive) > 30.0 * min(positive):
        top.set_yscale("log")
    dress(top, "" if rows == 2 else "time [s]", f"{run.plant.primary.name} [µm]")
    if rows == 2:
        low = axes[1]
        shade_control(low, run)
        _line(low, x, MILLI * t["stroke_peak_m"], SECOND, "stroke, largest of the block", lw=1.3)
        _limit_line(low, run.plant.limits.get("stroke_m"), MILLI, "mm", float(np.nanmax(t["stroke_peak_m"])))
        dress(low, "time [s]", "stroke [mm]")


def _limit_line(axes: Axes, limit: float | None, scale: float, unit: str, seen: float) -> None:
    """A limit as a line where it is near what was seen, else in words: it would press the plot flat."""
    if limit is None:
        return
    label = f"limit {scale * limit:g} {unit}"
    if limit < 4.0 * seen:
        axes.axhline(scale * limit, color=LIMIT, lw=1.1, label=label)
    else:
        axes.plot([], [], color=LIMIT, lw=1.1, label=f"{label}, above")


def _attenuation(figure: Figure, run: Replayed) -> None:
    axes = figure.add_subplot()
    h, hz = run.hindsight, run.tracks["frequency_hz"]
    known = np.isfinite(h.attenuation) & np.isfinite(hz)
    order = np.argsort(hz[known], kind="stable")
    order = order[:: -(-len(order) // MOST_BARS)]
    f, left = hz[known][order], np.maximum(1.0 - h.attenuation[known][order], 10.0 ** (LEAST_DB / 20.0))
    std = h.attenuation_std[known][order]
    db = 20.0 * np.log10(left)
    spread = 20.0 / np.log(10.0) * std / left
    style = {"fmt": "o", "ms": 3.2, "lw": 0.9, "capsize": 0.0}
    axes.errorbar(f, db, np.minimum(spread, 20.0), color=CONTROLLED, label="_bars", **style)  # type: ignore[arg-type]
    axes.plot(f, db, "o", ms=3.2, color=CONTROLLED, label="motion with / without control [dB]")
    limit = run.tracks["limit_m"][known][order] / h.passive_m[known][order]
    if _any(limit):
        floor = np.maximum(20.0 * np.log10(np.maximum(limit, 1e-12)), LEAST_DB)
        mark = "v" if np.ptp(f) < DWELL_HZ else ":"
        axes.plot(f, floor, mark, ms=4, color=THIRD, label="least of any controller [dB]")
    axes.axhline(0.0, color="#455a64", lw=0.8)
    axes.axhline(-20.0, color="#b0bec5", lw=0.8, ls="--")
    axes.annotate(
        "90 %",
        (1.0, -20.0),
        xycoords=("axes fraction", "data"),
        xytext=(3, -3),
        textcoords="offset points",
        fontsize=8,
    )
    axes.margins(x=0.03)
    if np.ptp(f) < DWELL_HZ:
        axes.set_xlim(f.mean() - DWELL_HZ, f.mean() + DWELL_HZ)
    dress(axes, "excitation [Hz]", "with / without control [dB]")


def _power(figure: Figure, run: Replayed) -> None:
    t, x = run.tracks, run.tracks["time_s"]
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[1.8, 1.0])
    shade_control(top, run)
    _line(top, x, t["joule_peak_w"], "#90a4ae", "Joule peak", lw=1.0)
    _line(top, x, t["electrical_mean_w"], SECOND, "electrical mean", lw=1.3)
    _line(top, x, t["joule_mean_w"], CONTROLLED, "Joule mean", lw=1.7)
    if run.budget_kind is not None:
        kind = run.budget_kind.replace("_", " ")
        top.plot(*thinned(x, t["budget_w"]), color=LIMIT, lw=1.3, ls="--", label=f"budget ({kind})")
    coil = run.plant.voice_coil
    if coil is not None:
        seen = float(np.nanmax(t["joule_mean_w"]))
        _limit_line(top, run.plant.limits.get(f"{coil.name}_power_w"), 1.0, "W", seen)
    dress(top, "", "power [W]")
    top.set_ylim(bottom=min(0.0, top.get_ylim()[0]))
    shade_control(low, run)
    _line(low, x, t["current_peak_a"], CONTROLLED, "current, largest of the block", lw=1.3)
    if coil is not None and _any(t["current_peak_a"]):
        limit = run.plant.limits.get(f"{coil.name}_current_a")
        _limit_line(low, limit, 1.0, "A", float(np.nanmax(t["current_peak_a"])))
    dress(low, "time [s]", "current [A]")
    low.set_ylim(bottom=0.0)


def draw_curve(axes: Axes, run: Replayed, colour: str, label: str, bands: bool = True) -> None:
    """The learned damping with its bands, where it is better known than at first."""
    curve = run.curve
    if curve is None:
        return
    f, c, s = curve.frequency_hz, curve.damping_ns_m, curve.std_ns_m
    if bands:
        axes.fill_between(f, c - 2.0 * s, c + 2.0 * s, color=colour, alpha=0.12, lw=0)
        axes.fill_between(f, c - s, c + s, color=colour, alpha=0.22, lw=0)
    axes.plot(f, c, color=colour, lw=1.7, label=label)


def _damping(figure: Figure, run: Replayed) -> None:
    axes = figure.add_subplot()
    curve, absorber = run.curve, run.plant.absorber
    hz = run.tracks["frequency_hz"]
    if curve is None or absorber is None:
        return
    draw_curve(axes, run, THIRD, "learned ± 1, 2 σ")
    f = curve.frequency_hz
    axes.plot(f, curve.in_use_ns_m, color=CONTROLLED, lw=1.3, ls="--", label="in use")
    stated = np.array([absorber.damping_at(float(v)) for v in f])
    axes.plot(f, stated, color=PASSIVE, lw=1.2, ls=":", label="plant file")
    if _any(hz):
        axes.axvspan(float(np.nanmin(hz)), float(np.nanmax(hz)), color="#f1f4f6", lw=0, zorder=0)
    top = float(np.max(np.maximum(curve.damping_ns_m, curve.in_use_ns_m))) * 1.6
    axes.set_ylim(min(0.0, float(np.min(curve.damping_ns_m))), max(top, 1.0))
    dress(axes, "frequency [Hz]", "c2 [Ns/m]")


def _health(figure: Figure, run: Replayed) -> None:
    t, x = run.tracks, run.tracks["time_s"]
    top, low = figure.subplots(2, 1, sharex=True)
    a, b = t["nis_low"], t["nis_high"]
    if _any(a) and _any(b):
        some = slice(None, None, -(-len(x) // MOST_POINTS))
        top.fill_between(x[some], a[some], b[some], color=THIRD, alpha=0.2, lw=0)
    _line(top, x, t["nis"], "#37474f", "NIS", lw=1.2)
    dress(top, "", "NIS [1]")
    for k, sensor in enumerate(run.tracks.sensors):
        _line(low, x, run.tracks.innovation[:, k], SHADES[(2 * k + 1) % len(SHADES)], sensor, lw=1.1)
    low.axhline(1.0, color="#455a64", lw=0.7)
    for axes, values in ((top, t["nis"]), (low, run.tracks.innovation)):
        if _any(values) and np.nanmax(values) > 8.0 and np.nanmin(values) > 0.0:
            axes.set_yscale("log")
    dress(low, "time [s]", "rms / expected [1]")
