"""Round numbers for scales and ticks, and a scale that follows what it shows without twitching."""

from dataclasses import dataclass

import numpy as np

from twin.plant.linear import Array

STEPS = (1.0, 2.0, 5.0, 10.0)

FALL_SHARE = 0.3
"""A scale becomes finer when so little of it has been used for `FALL_BLOCKS` calls."""

FALL_BLOCKS = 20


def rounded_up(value: float) -> float:
    """Smallest of 1, 2 or 5 times a power of ten that is not below a positive value."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in STEPS if m * power >= value * (1.0 - 1e-9)))


def tick_step(span: float, wanted: int) -> float:
    """Step of 1, 2 or 5 times a power of ten that divides a span into about so many."""
    raw = span / wanted
    power = 10.0 ** np.floor(np.log10(raw))
    return float(min((m * power for m in STEPS), key=lambda s: abs(s - raw)))


def ticks(low: float, high: float, wanted: int) -> Array:
    """Whole multiples of a round step within a range."""
    step = tick_step(high - low, wanted)
    return np.arange(round(np.ceil(low / step - 1e-9)), round(np.floor(high / step + 1e-9)) + 1) * step


def in_words(value: float, unit: str) -> str:
    """A quantity with three digits and the prefix that suits it: ``1.2 µm``, ``40.7 kN/m``."""
    size = abs(value)
    for scale, prefix in ((1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n")):
        if size >= scale * 0.9995:
            return f"{_three(value / scale)} {prefix}{unit}"
    return f"0 {unit}" if size < 1e-12 else f"{_three(value * 1e9)} n{unit}"


def _three(value: float) -> str:
    digits = max(0, 2 - int(np.floor(np.log10(max(abs(value), 1e-9)) + 1e-9)))
    text = f"{value:.{digits}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


@dataclass(slots=True)
class FollowingScale:
    """Full scale that holds the largest value: it widens at once, and narrows only when that is worth it.

    Attributes
    ----------
    full
        At present, 1, 2 or 5 times a power of ten.
    least
        It never becomes finer than this.
    """

    least: float
    full: float = 0.0
    _unused: int = 0

    def follow(self, peak: float) -> bool:
        """Take the largest value since the last call; returns whether the scale has changed."""
        before = self.full
        peak = max(peak, self.least) if np.isfinite(peak) else max(self.full, self.least)
        if self.full == 0.0 or peak > self.full:
            self.full, self._unused = rounded_up(peak), 0
        elif peak < FALL_SHARE * self.full:
            self._unused += 1
            if self._unused >= FALL_BLOCKS:
                self.full, self._unused = rounded_up(peak / 0.8), 0
        else:
            self._unused = 0
        return self.full != before
