"""The damping curve as lines and labels in a plane: Rerun has no plot of one quantity over another.

The plane is `WIDTH` by `HEIGHT` with y pointing down; the axes follow the data in whole ticks.
"""

from dataclasses import dataclass

import numpy as np
import rerun as rr

from estimators.types import DampingCurve
from twin.plant.linear import Array
from twin.station import palette
from twin.station.view.scales import tick_step, ticks

WIDTH, HEIGHT = 160.0, 64.0
ROOT = "damping/curve"
_GRID, _TEXT, _BAND = 0x37474FFF, 0xB0BEC5FF, 0x2E5A3AFF


@dataclass(frozen=True, slots=True)
class Axes:
    """Ranges of the plot: frequency [Hz] and damping [Ns/m], on whole ticks."""

    low_hz: float
    high_hz: float
    top_ns_m: float

    def place(self, frequency_hz: Array, damping_ns_m: Array) -> Array:
        """(n, 2) positions in the plane."""
        x = (np.asarray(frequency_hz) - self.low_hz) / (self.high_hz - self.low_hz) * WIDTH
        y = -np.clip(np.asarray(damping_ns_m) / self.top_ns_m, -0.02, 1.02) * HEIGHT
        return np.column_stack([x, y])


def axes_for(curve: DampingCurve, previous: Axes | None) -> Axes:
    """Axes that hold the curve and its band; the previous ones while they still do."""
    reach = float(np.max(np.maximum(curve.damping_ns_m + curve.std_ns_m, curve.in_use_ns_m), initial=1.0))
    low, high = float(curve.frequency_hz[0]), float(curve.frequency_hz[-1])
    if (
        previous is not None
        and previous == Axes(low, high, previous.top_ns_m)
        and (0.4 * previous.top_ns_m < reach <= previous.top_ns_m)
    ):
        return previous
    step = tick_step(1.2 * reach, 5)
    return Axes(low, high, float(np.ceil(1.2 * reach / step) * step))


def log_axes(stream: rr.RecordingStream, axes: Axes) -> None:
    """Grid lines and tick labels."""
    hz = ticks(axes.low_hz, axes.high_hz, 7)
    ns_m = ticks(0.0, axes.top_ns_m, 4)
    upright = [axes.place(np.array([f, f]), np.array([0.0, axes.top_ns_m])) for f in hz]
    level = [axes.place(np.array([axes.low_hz, axes.high_hz]), np.array([c, c])) for c in ns_m]
    stream.log(
        f"{ROOT}/axes", rr.LineStrips2D([*upright, *level], colors=_GRID, radii=rr.Radius.ui_points(0.5))
    )
    below = axes.place(hz, np.zeros(len(hz))) + np.array([0.0, 1.5])
    beside = axes.place(np.full(len(ns_m), axes.low_hz), ns_m) + np.array([-6.0, -3.5])
    stream.log(
        f"{ROOT}/labels",
        rr.Points2D(
            np.concatenate([below, beside]),
            labels=[f"{tick:g}" for tick in (*hz, *ns_m)],
            colors=_TEXT,
            radii=0.0,
            show_labels=True,
        ),
    )


def log_curve(
    stream: rr.RecordingStream, curve: DampingCurve, axes: Axes, excitation_hz: float | None
) -> None:
    """Learned damping with its one-sigma band, damping in use, and where the excitation is."""
    f, c, std = curve.frequency_hz, curve.damping_ns_m, curve.std_ns_m
    # A band cannot be filled, so it is hatched as densely as it is wide.
    fine = np.linspace(f[0], f[-1], 161)
    low, high = (axes.place(fine, np.interp(fine, f, c + sign * std)) for sign in (-1.0, 1.0))
    stream.log(
        f"{ROOT}/band",
        rr.LineStrips2D(np.stack([low, high], axis=1), colors=_BAND, radii=0.55, draw_order=-10.0),
    )
    lines = [axes.place(f, c), axes.place(f, curve.in_use_ns_m)]
    stream.log(
        f"{ROOT}/lines",
        rr.LineStrips2D(
            lines,
            colors=palette.array([palette.LEARNED, palette.IN_USE]),
            radii=rr.Radius.ui_points([2.0, 1.2]),
            draw_order=10.0,
        ),
    )
    if excitation_hz is None:
        return
    at = axes.place(np.full(2, excitation_hz), np.array([0.0, axes.top_ns_m]))
    stream.log(
        f"{ROOT}/excitation",
        rr.LineStrips2D([at], colors=palette.MEASURED, radii=rr.Radius.ui_points(1.0), draw_order=5.0),
    )
