"""Amplitude spectra of a few signals as they come: low-passed, thinned out, and transformed over a sliding window."""

import numpy as np
from scipy.signal import firwin

from twin.plant.linear import Array

BINS = 250
"""Lines from zero to the highest frequency."""

GUARD = 4.0
"""Samples per period of the highest frequency that are kept. More than the usual 2.56: the filter that keeps the rest
from folding back is then so much shorter that all of it costs half."""

MOST_MISSING = 0.02
"""A window with a larger share of samples missing has no spectrum."""


class SlidingSpectrum:
    """Spectra over the last `window_s` of several signals.

    A flat-top scale: a sine of amplitude A stands as A at its frequency if that is a line, and down to 0.85 A half way
    between two (Hann window).

    Parameters
    ----------
    sample_rate_hz
        Of the signals.
    top_hz
        Highest frequency wanted; lowered where the sample rate does not reach so far.
    n_signals
        How many.

    Attributes
    ----------
    frequency_hz
        (n,) lines from 0 [Hz].
    window_s
        Length of the window [s], the inverse of the distance between lines.
    """

    def __init__(self, sample_rate_hz: float, top_hz: float, n_signals: int) -> None:
        self._step = max(1, int(sample_rate_hz / (GUARD * top_hz)))
        rate = sample_rate_hz / self._step
        top_hz = min(top_hz, rate / 2.56)
        n = round(rate * BINS / top_hz)
        self.frequency_hz = np.fft.rfftfreq(n, 1.0 / rate)[: BINS + 1]
        self.window_s = n / rate
        taps = 2 * round(1.65 * self._step / (1.0 - 2.0 / GUARD)) + 1
        self._taps = firwin(taps, 1.0 / self._step) if self._step > 1 else np.ones(1)
        self._tail = np.zeros((len(self._taps) - 1, n_signals))
        self._skip = 0
        self._kept = np.zeros((n, n_signals))
        self._missing = np.ones(n)
        window = np.hanning(n + 1)[:n, None]
        self._window = 2.0 * window / window.sum()

    def add(self, values: Array) -> None:
        """Take the next samples, (n, n_signals); NaN where there is none."""
        known = np.isfinite(values)
        signal = np.concatenate([self._tail, np.where(known, values, 0.0)])
        n_taps = len(self._taps)
        self._tail = signal[len(signal) - n_taps + 1 :]
        windows = np.lib.stride_tricks.sliding_window_view(signal, n_taps, axis=0)[self._skip :: self._step]
        missing = np.any(~known, axis=1, keepdims=True)[self._skip :: self._step, 0]
        self._skip = (self._skip - len(values)) % self._step
        new = np.ascontiguousarray(windows) @ self._taps
        self._kept = np.concatenate([self._kept, new])[-len(self._kept) :]
        self._missing = np.concatenate([self._missing, missing])[-len(self._missing) :]

    def amplitudes(self) -> Array | None:
        """(n_lines, n_signals) in the signals' units, peak; None while the window is not full."""
        if np.mean(self._missing) > MOST_MISSING:
            return None
        lines = np.abs(np.fft.rfft(self._kept * self._window, axis=0))[: len(self.frequency_hz)]
        lines[0] *= 0.5
        return np.asarray(lines)


class Waterfall:
    """Spectra of the past, newest first, in a fixed number of rows.

    Parameters
    ----------
    rows, lines
        Size.
    row_s
        Time of one row [s]; where more come, the largest of each line is kept.
    whole
        Whether all of the run is kept: when the rows are used up, two become one and each stands for twice the time.
        Otherwise the oldest goes.
    """

    def __init__(self, rows: int, lines: int, row_s: float, *, whole: bool) -> None:
        self.row_s = row_s
        self._whole = whole
        self.levels = np.full((rows, lines), np.nan)
        self._used, self._row_ends_s = 0, -np.inf

    @property
    def length_s(self) -> float:
        """Time that `image` spans [s]."""
        return self.row_s * (max(self._used, 1) if self._whole else len(self.levels))

    def image(self) -> Array:
        """(rows, lines), newest first; a whole run fills all of them from its first spectrum on."""
        if not self._whole:
            return self.levels
        rows = np.arange(len(self.levels)) * max(self._used, 1) // len(self.levels)
        return self.levels[rows]

    def add(self, time_s: float, amplitudes: Array) -> None:
        """Take a spectrum."""
        if time_s < self._row_ends_s and self._used:
            self.levels[0] = np.fmax(self.levels[0], amplitudes)
            return
        self._row_ends_s = time_s + self.row_s * (1.0 - 1e-9)
        if self._whole and self._used == len(self.levels):
            half = len(self.levels) // 2
            self.levels[:half] = np.fmax(self.levels[0 : 2 * half : 2], self.levels[1 : 2 * half : 2])
            self.levels[half:] = np.nan
            self._used = half
            self.row_s *= 2.0
        self.levels = np.roll(self.levels, 1, axis=0)
        self.levels[0] = amplitudes
        self._used = min(self._used + 1, len(self.levels))
