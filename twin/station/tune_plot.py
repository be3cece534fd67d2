"""Picture of ``atmd tune``: motion against the limit, powers against the budget, margins, over the band."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.plant.errors import InputError
from twin.plant.linear import Array

PASSIVE, GAINS, LIMIT, SECOND, THIRD = "#78909c", "#1565c0", "#c62828", "#ef6c00", "#2e7d32"
LEAST_UM = 1e-2


def draw_tune(result: dict[str, Any], path: Path) -> None:
    """Write the picture.

    Raises
    ------
    InputError
        If it cannot be written there, or its suffix is no picture's.
    """
    figure = Figure(figsize=(12.0, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    motion, power, margin = (figure.add_subplot(1, 3, k) for k in (1, 2, 3))
    points = result["points"]
    f = np.array([p["frequency_hz"] for p in points])
    marker = "o" if len(f) < 40 else ""
    for key, name, colour, dash in (
        ("passive_displacement_m", "passive", PASSIVE, ":"),
        ("achieved_displacement_m", "these gains", GAINS, "-"),
        ("limit_displacement_m", "physical limit", LIMIT, "-."),
    ):
        shown = np.maximum(1e6 * _column(points, key), LEAST_UM)
        motion.semilogy(f, shown, dash, color=colour, label=name, marker=marker, markersize=3)
    motion.set(
        title=f"motion (below {LEAST_UM:g} µm drawn there)", xlabel="excitation [Hz]", ylabel="|x1| [µm]"
    )
    for key, name, colour in (
        ("joule_mean_w", "mean Joule", GAINS),
        ("joule_peak_w", "peak Joule", SECOND),
        ("electrical_mean_w", "mean electrical", THIRD),
    ):
        power.plot(f, _column(points, key), color=colour, label=name, marker=marker, markersize=3)
    kind = result["budget_kind"].replace("_", " ")
    power.axhline(result["budget_w"], color=LIMIT, linestyle="-.", label=f"budget, {kind}")
    power.set(title="coil power", xlabel="excitation [Hz]", ylabel="[W]")
    margin.plot(
        f, _column(points, "modulus_margin"), color=GAINS, label="least |1 + L|", marker=marker, markersize=3
    )
    margin.axhline(
        result["wanted_modulus_margin"], color=GAINS, linestyle="-.", linewidth=0.9, label="wanted"
    )
    margin.set(title="margins", xlabel="excitation [Hz]", ylabel="least |1 + L|", ylim=(0.0, 1.05))
    delay = margin.twinx()
    delay.semilogy(f, 1e6 * _column(points, "delay_margin_s"), color=SECOND, label="further delay", marker=marker,
                   markersize=3)  # fmt: skip
    if result["wanted_delay_margin_s"] > 0.0:
        wanted = 1e6 * result["wanted_delay_margin_s"]
        delay.axhline(wanted, color=SECOND, linestyle="-.", linewidth=0.9, label="wanted")
    delay.set(ylabel="further delay tolerated [µs]", ylim=(30.0, 1.2e4))
    handles = [*margin.get_legend_handles_labels()[0], *delay.get_legend_handles_labels()[0]]
    for axes in (motion, power):
        axes.legend(fontsize=8)
    margin.legend(handles, [str(h.get_label()) for h in handles], fontsize=8)
    for axes in (motion, power, margin):
        axes.grid(alpha=0.3)
    figure.suptitle(f"{result['plant']}, {result['excitation']:g} {result['excitation_unit']} peak")
    try:
        figure.savefig(path, dpi=130)
    except (OSError, ValueError) as error:
        raise InputError(f"--plot {path}: cannot be written ({error}); name a .png, .svg or .pdf") from error


def _column(points: list[dict[str, Any]], key: str) -> Array:
    return np.array([np.nan if p[key] is None else p[key] for p in points], dtype=np.float64)
