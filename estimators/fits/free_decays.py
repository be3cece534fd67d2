"""Where in a record something rings down by itself.

The record is looked at through a window of a few periods that slides along it; in each place a sinusoid, an offset
and a slope are fitted. A free decay is a stretch in which the sinusoid explains what is there and keeps getting
smaller. What was done by hand before the release (slow deflections) is slope and offset, a steady vibration does not
get smaller, and noise does not look like a sinusoid.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import periodogram

from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
PERIODS = 3.0
RISE = 1.25
"""A decay ends where the amplitude is so many times its smallest value so far."""


@dataclass(frozen=True, slots=True)
class Decay:
    """A stretch of free vibration.

    Attributes
    ----------
    first, end
        Samples, ``first <= k < end``.
    amplitude
        Amplitude at its first and at its last sample, in the unit of the record.
    """

    first: int
    end: int
    amplitude: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Envelope:
    """Amplitude of a sinusoid along a record.

    Attributes
    ----------
    centre
        (n_windows,) sample in the middle of each window.
    phasor
        (n_windows,) complex amplitude, relative to the phase at sample 0.
    residual
        (n_windows,) root mean square of what sinusoid, offset and slope leave.
    noise
        Standard deviation of the amplitude where only noise is left.
    """

    centre: Array
    phasor: ComplexArray
    residual: Array
    noise: float

    @property
    def amplitude(self) -> Array:
        """(n_windows,) peak amplitude."""
        return np.abs(self.phasor)


def main_frequency(values: Array, sample_rate_hz: float, band_hz: tuple[float, float] | None) -> float | None:
    """Frequency [Hz] of the strongest oscillation; None if there is none.

    Slow movements are left out: the spectrum of the second difference is used, and at least four periods must fit
    into the record.
    """
    low, high = band_hz or (4.0 * sample_rate_hz / len(values), 0.48 * sample_rate_hz)
    # Differences: a record that begins with the release must not be tapered, and slow deflections must not leak.
    hz, power = periodogram(np.diff(values), sample_rate_hz, detrend="constant", nfft=4 * len(values))
    power = power / np.maximum(np.sin(np.pi * hz / sample_rate_hz), 1e-6) ** 2
    inside = (hz >= low) & (hz <= high) & (hz > 0.0)
    if not inside.any() or not np.max(power[inside]) > 0.0:
        return None
    # Noise is taken off, then the frequency squared weighs: a slow deflection holds more than the vibration that
    # follows its release.
    above = np.maximum(power[inside] - 12.0 * float(np.median(power[1:])), 0.0)
    if not np.max(above) > 0.0:
        return None
    return float(hz[inside][np.argmax(above * hz[inside] ** 2)])


def envelope(values: Array, sample_rate_hz: float, frequency_hz: float) -> Envelope:
    """Amplitude along a record, window by window."""
    n = len(values)
    width = int(min(n, max(8, round(PERIODS * sample_rate_hz / frequency_hz))))
    step = max(1, width // 12)
    firsts = np.unique(np.append(np.arange(0, n - width + 1, step), n - width))
    local = np.arange(width) - 0.5 * (width - 1)
    angle = TAU * frequency_hz / sample_rate_hz
    basis = np.column_stack([np.cos(angle * local), np.sin(angle * local), np.ones(width), local / width])
    solve = np.linalg.pinv(basis)
    windows = np.lib.stride_tricks.sliding_window_view(values, width)[firsts]
    found = windows @ solve.T
    residual = np.sqrt(np.mean((windows - found @ basis.T) ** 2, axis=1))
    centre = firsts + 0.5 * (width - 1)
    phasor = (found[:, 0] - 1j * found[:, 1]) * np.exp(-1j * angle * centre)
    noise = float(np.quantile(residual, 0.1)) * np.sqrt(2.0 / width)
    return Envelope(centre, phasor, residual, noise)


def find_decays(values: Array, sample_rate_hz: float, frequency_hz: float) -> list[Decay]:
    """Free decays of the oscillation at a frequency, in order.

    Parameters
    ----------
    values
        (n,) finite samples.
    frequency_hz
        Its frequency, to within a few percent.
    """
    seen = envelope(values, sample_rate_hz, frequency_hz)
    amplitude, n = seen.amplitude, len(values)
    width = max(8, round(PERIODS * sample_rate_hz / frequency_hz))
    clean = amplitude / np.sqrt(2.0) > 0.8 * seen.residual
    floor = max(6.0 * seen.noise, 1e-9 * float(np.max(np.abs(values))))
    free = np.ones(len(amplitude), dtype=bool)
    out: list[Decay] = []
    while True:
        candidates = np.where(free & clean & (amplitude > floor), amplitude, 0.0)
        top = int(np.argmax(candidates))
        if candidates[top] <= max(0.02 * float(np.max(amplitude)), floor):
            break
        # Noise may put the largest value late in a slow decay: the decay begins with the first one nearly as large.
        nearly = amplitude[top] - max(0.02 * amplitude[top], 6.0 * seen.noise)
        while top > 0 and candidates[top - 1] > nearly:
            top -= 1
        last, smallest = top, amplitude[top]
        while (
            last + 1 < len(amplitude)
            and free[last + 1]
            and amplitude[last + 1] < RISE * smallest + seen.noise
            and amplitude[last + 1] > floor
            and seen.residual[last + 1] < max(1.0 * amplitude[last + 1], 3.0 * seen.noise * np.sqrt(width))
        ):
            last += 1
            smallest = min(smallest, amplitude[last])
        # What precedes a release is smaller than what follows it; a swell in a vibration that goes on is none.
        ahead = amplitude[max(0, top - 40) : top]
        released = (
            top == 0 or seen.centre[top] < 1.2 * width or (len(ahead) and ahead.min() < 0.5 * amplitude[top])
        )
        before = top
        while before > 0 and free[before - 1] and amplitude[before - 1] > 0.3 * amplitude[top]:
            before -= 1
        free[before : last + 1] = False
        # The first window that lies wholly after the release begins where the largest one is centred.
        first = 0 if seen.centre[top] < 0.51 * width else int(np.ceil(seen.centre[top]))
        end = n if last == len(amplitude) - 1 else int(seen.centre[last] + 0.25 * width)
        if released and end - first >= max(12, width) and amplitude[last] < amplitude[top] - 5.0 * seen.noise:
            out.append(Decay(first, min(n, end), (float(amplitude[top]), float(amplitude[last]))))
    return sorted(out, key=lambda d: d.first)
