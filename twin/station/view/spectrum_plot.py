"""Spectrum and waterfall of one signal over a common frequency axis, drawn line by line: Rerun has no log axis.

One unit across is one line of the spectrum. Above zero stands the spectrum on a logarithmic scale, measured and
twin; below it, the past as an image, newest on top.
"""

import numpy as np
import rerun as rr

from twin.plant.linear import Array
from twin.station import palette
from twin.station.columns import TIMELINE, nanoseconds
from twin.station.view.scales import tick_step, ticks
from twin.station.view.spectrum import BINS, SlidingSpectrum, Waterfall

ROOT = "spectrum"
HEIGHT, ROWS, SPACE = 64.0, 75, 13.0
DECADES = 6
GROWTH = 0.15
"""Share by which a run grows from one image of all of it to the next."""

_GRID, _TEXT = 0x37474FFF, 0xB0BEC5FF


class SpectrumPlot:
    """Spectrum and waterfall of one channel, measured beside twin.

    Parameters
    ----------
    stream
        Where to.
    sample_rate_hz, top_hz
        Of the signals, and the highest frequency shown.
    whole
        Whether the waterfall holds the whole run or the last half minute.
    line_s, image_s
        Time between spectra and between images [s].
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        sample_rate_hz: float,
        top_hz: float,
        *,
        whole: bool,
        line_s: float,
        image_s: float,
    ) -> None:
        self._stream = stream
        self._spectrum = SlidingSpectrum(sample_rate_hz, top_hz, 2)
        lines = len(self._spectrum.frequency_hz)
        self._waterfall = Waterfall(ROWS, lines, line_s if whole else 0.4, whole=whole)
        self._line_s, self._image_s, self._whole = line_s, image_s, whole
        self._line_at_s = self._image_at_s = -np.inf
        self._top: int | None = None
        self._length_s = 0.0
        self._x = np.arange(lines) + 0.5

    def add(self, end_s: float, values: Array, excitation_hz: float | None) -> None:
        """Take a block's samples, (n, 2) measured and twin, and draw what is due."""
        self._spectrum.add(values)
        if end_s < self._line_at_s - 1e-9:
            return
        amplitudes = self._spectrum.amplitudes()
        if amplitudes is None:
            return
        self._line_at_s = end_s + self._line_s
        self._waterfall.add(end_s, amplitudes[:, 0])
        self._stream.set_time(TIMELINE, duration=nanoseconds(end_s)[0])
        top = int(np.ceil(np.log10(max(float(np.nanmax(self._waterfall.levels)), 1e-12))))
        if self._top is None or top > self._top or top < self._top - 1:
            self._top = top
            self._draw_level_axis(top)
        self._draw_lines(amplitudes, excitation_hz)
        if end_s >= self._image_at_s - 1e-9:
            # An image of the whole run changes the slower the more there is of it.
            grown_s = GROWTH * self._waterfall.length_s if self._whole else 0.0
            self._image_at_s = end_s + max(self._image_s, grown_s)
            self._draw_image()

    def repeat(self) -> None:
        """Draw scales and image again when next they can be, for a viewer that has come since."""
        self._top, self._length_s, self._image_at_s = None, 0.0, -np.inf

    def _level(self, amplitudes: Array) -> Array:
        """Share of the scale, 0 at its bottom and 1 at its top."""
        with np.errstate(divide="ignore", invalid="ignore"):
            levels = (np.log10(amplitudes) - (self._top or 0) + DECADES) / DECADES
        return np.asarray(np.clip(levels, 0.0, 1.0))

    def _draw_lines(self, amplitudes: Array, excitation_hz: float | None) -> None:
        """Twin, measured on top of it, and ticks at the excitation and its multiples."""
        y = -SPACE - HEIGHT * self._level(amplitudes)
        strips = [np.column_stack([self._x, y[:, k]]) for k in (1, 0)]
        colours, widths = [palette.TWIN, palette.MEASURED], [1.8, 1.0]
        if excitation_hz is not None:
            hz = self._spectrum.frequency_hz
            marks = np.arange(excitation_hz, hz[-1], excitation_hz) / hz[1] + 0.5
            strips += [np.array([[f, -SPACE - HEIGHT], [f, -SPACE - HEIGHT - 3.0]]) for f in marks]
            colours += [palette.IN_USE] * len(marks)
            widths += [1.5] * len(marks)
        lines = rr.LineStrips2D(
            strips, colors=palette.array(colours), radii=rr.Radius.ui_points(widths), draw_order=10.0
        )
        self._stream.log(f"{ROOT}/lines", lines)

    def _draw_image(self) -> None:
        levels = self._waterfall.image()
        image = np.where(np.isnan(levels), 0.0, np.round(255.0 * self._level(levels)))
        self._stream.log(
            f"{ROOT}/waterfall",
            rr.DepthImage(
                image.astype(np.uint8), meter=1.0, depth_range=(0.0, 255.0), colormap="inferno",
                magnification_filter="nearest", draw_order=-10.0,
            ),
        )  # fmt: skip
        if self._waterfall.length_s != self._length_s:
            self._length_s = self._waterfall.length_s
            self._draw_time_axis(self._length_s)

    def _draw_level_axis(self, top: int) -> None:
        spectrum = self._spectrum
        step_hz = float(spectrum.frequency_hz[1])
        hz = ticks(0.0, float(spectrum.frequency_hz[-1]), 5)
        x = hz / step_hz + 0.5
        decades = np.arange(0, DECADES + 1, 2)
        y = -SPACE - HEIGHT * decades / DECADES
        level = [np.array([[0.0, v], [float(BINS), v]]) for v in y]
        upright = [np.array([[u, -SPACE - HEIGHT], [u, -SPACE]]) for u in x]
        grid = rr.LineStrips2D([*level, *upright], colors=_GRID, radii=rr.Radius.ui_points(0.5))
        self._stream.log(f"{ROOT}/grid", grid)
        places = np.concatenate(
            [
                np.column_stack([x, np.full(len(x), -SPACE + 3.0)]),
                np.column_stack([np.full(len(y) - 1, -11.0), y[1:] - 1.5]),
            ]
        )
        labels = [f"{f:g}" for f in hz] + [_power_of_ten(top - DECADES + d) for d in decades[1:]]
        self._stream.log(f"{ROOT}/labels", _labels(places, labels))

    def _draw_time_axis(self, length_s: float) -> None:
        ago = np.arange(1, 4) * tick_step(length_s, 3)
        ago = ago[ago < 0.97 * length_s]
        y = np.concatenate([[1.0], ago / length_s * ROWS])
        labels = ["now", *(f"−{t:g} s" for t in ago)]
        self._stream.log(f"{ROOT}/ago", _labels(np.column_stack([np.full(len(y), -11.0), y]), labels))


def _labels(places: Array, labels: list[str]) -> rr.Points2D:
    return rr.Points2D(places, labels=labels, colors=_TEXT, radii=0.0, show_labels=True)


def _power_of_ten(exponent: int) -> str:
    return f"{10.0**exponent:g}" if -4 <= exponent <= 4 else f"1e{exponent}"
