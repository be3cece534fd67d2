"""Excitation tracker and lock-in: frequency of the excitation, and every channel's phasor at it.

Per block, all channels are fitted by least squares with ``Re{(A + S (t - t_mid)) exp(j phi(t))} + offset``, where
``phi`` is the tracked phase of the excitation, its sweep rate included. The slope S makes the phasors right while
amplitudes move, and its imaginary part on the reference channel is what the tracker corrects its frequency by.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.types import Phasors
from twin.plant.blocks import Block
from twin.plant.config import Plant, Shaker
from twin.plant.linear import Array, ComplexArray

MIN_VALID_SHARE = 0.5
MIN_CYCLES = 1.5
"""Cycles of the excitation a block must hold: with fewer its frequency, offset and drift look alike."""

LOST_SIGNAL_RATIO = 5.0
"""Amplitude over its standard deviation below which a reference tells no frequency."""


def choose_reference(plant: Plant, channels: Sequence[str]) -> str | None:
    """Channel that tells the excitation's frequency best.

    A shaker's voltage, its command or current (nothing the controller does moves them much), else the primary
    body's acceleration, velocity or displacement; None if the plant has none of them recorded.
    """
    for actuator in plant.actuator:
        if isinstance(actuator, Shaker):
            of_it = {s.kind: s.name for s in plant.sensor if s.of == actuator.name}
            for name in (of_it.get("voltage"), actuator.name, of_it.get("current")):
                if name in channels:
                    return name
    of_primary = {s.kind: s.name for s in plant.sensor if s.of == plant.primary.name}
    for kind in ("acceleration", "velocity", "displacement"):
        if of_primary.get(kind) in channels:
            return of_primary[kind]
    return None


class ExcitationTracker:
    """Track the excitation's phase from block to block and lock every channel in to it.

    Parameters
    ----------
    reference
        Name of the channel to track.
    channels
        Names of a block's columns.
    band_hz
        Frequencies among which a lost excitation is looked for [Hz].
    """

    def __init__(
        self, reference: str, channels: Sequence[str], band_hz: tuple[float, float] = (5.0, 500.0)
    ) -> None:
        self.reference = reference
        self.channels = tuple(channels)
        self._column = self.channels.index(reference)
        self._band = band_hz
        self._frequency: float | None = None  # at the end of the last block [Hz]
        self._rate = 0.0  # Hz/s
        self._phase = 0.0  # at the end of the last block [rad]
        self._age = 0

    def advance(self, block: Block) -> Phasors | None:
        """Phasors of one block; None while there is no excitation to track."""
        dt = 1.0 / block.sample_rate_hz
        rows = block.valid.all(axis=1)
        n = block.n_samples
        if n < 8 or rows.sum() < max(8, MIN_VALID_SHARE * n):
            self._coast(n * dt)
            return None
        values = block.values if rows.all() else block.values[rows]
        t = (np.arange(n) - 0.5 * (n - 1)) * dt
        t_used = t if rows.all() else t[rows]
        half = 0.5 * n * dt
        signal = values[:, self._column]
        band = (max(self._band[0], MIN_CYCLES / (n * dt)), min(self._band[1], 0.45 / dt))

        searching = self._frequency is None
        if self._frequency is None:
            strongest = _search(signal, dt, (self._band[0], band[1]))
            if strongest < band[0]:
                return None
            self._frequency, self._rate, self._age = strongest, 0.0, 0
        f_mid = self._frequency + self._rate * half
        phase_mid = self._phase + math.tau * (self._frequency + 0.5 * self._rate * half) * half
        fit = None
        for _ in range(6 if searching else 2):
            fit = _fit(t_used, values[:, self._column : self._column + 1], phase_mid, f_mid, self._rate)
            amplitude, slope = complex(fit[0][0]), complex(fit[1][0])
            if abs(amplitude) == 0.0:
                break
            correction = (slope / amplitude).imag / math.tau
            f_mid += float(np.clip(correction, -0.5 / half, 0.5 / half))
        if not band[0] <= f_mid <= band[1]:
            self._frequency = None
            return None
        amplitude_, slope_, variance, slope_variance = _fit(t_used, values, phase_mid, f_mid, self._rate)
        a_ref = complex(amplitude_[self._column])
        if abs(a_ref) ** 2 <= LOST_SIGNAL_RATIO**2 * variance[self._column]:
            self._frequency = None
            return None

        # Second-order tracking: what the middle frequency moved since the last block's is the sweep rate.
        predicted_mid = self._frequency + self._rate * half
        gain = 1.0 if self._age == 1 else 0.2
        if self._age >= 1:
            self._rate += gain * (f_mid - predicted_mid) / (2.0 * half)
        self._age += 1
        self._frequency = f_mid + self._rate * half
        self._phase = math.remainder(
            phase_mid + math.tau * (f_mid + 0.5 * self._rate * half) * half, math.tau
        )
        f_std = math.sqrt(0.5 * slope_variance[self._column]) / (math.tau * abs(a_ref))
        return Phasors(
            frequency_hz=f_mid,
            frequency_std_hz=f_std,
            reference=self.reference,
            channels=self.channels,
            amplitude=amplitude_,
            slope=slope_,
            variance=variance,
        )

    def _coast(self, duration_s: float) -> None:
        if self._frequency is not None:
            self._phase += math.tau * (self._frequency + 0.5 * self._rate * duration_s) * duration_s
            self._phase = math.remainder(self._phase, math.tau)
            self._frequency += self._rate * duration_s


def _search(signal: Array, dt: float, band_hz: tuple[float, float]) -> float:
    """Strongest frequency in the band [Hz], from a Hann-windowed, zero-padded spectrum."""
    n = len(signal)
    windowed = (signal - signal.mean()) * np.hanning(n)
    size = 1 << max(14, (8 * n - 1).bit_length())
    spectrum = np.abs(np.fft.rfft(windowed, size))
    frequency = np.fft.rfftfreq(size, dt)
    inside = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    if not inside.any():
        inside = frequency > 0.0
    return float(frequency[inside][np.argmax(spectrum[inside])])


def _fit(
    t: NDArray[np.floating], values: Array, phase_mid: float, f_mid: float, rate: float
) -> tuple[ComplexArray, ComplexArray, NDArray[np.float64], NDArray[np.float64]]:
    """Least-squares phasors of all channels.

    Parameters
    ----------
    t
        (N,) time from the block's middle [s].
    values
        (N, p) samples.

    Returns
    -------
    amplitude, slope
        (p,) complex.
    variance, slope_variance
        (p,) of each complex number, E|error|², from the residual's own variance.
    """
    phase = phase_mid + math.tau * (f_mid + 0.5 * rate * t) * t
    basis = np.empty((5, len(t)))
    np.cos(phase, out=basis[0])
    np.sin(phase, out=basis[1])
    basis[1] *= -1.0
    scale = max(float(np.max(np.abs(t))), 1e-12)
    basis[2] = basis[0] * (t / scale)
    basis[3] = basis[1] * (t / scale)
    basis[4] = 1.0
    inverse = np.linalg.pinv(basis @ basis.T)
    projected = basis @ values
    solution = inverse @ projected
    squares = np.einsum("ij,ij->j", values, values) - np.einsum("ij,ij->j", solution, projected)
    residual = np.maximum(squares, 0.0) / max(len(t) - 5, 1)
    return (
        solution[0] + 1j * solution[1],
        (solution[2] + 1j * solution[3]) / scale,
        residual * (inverse[0, 0] + inverse[1, 1]),
        residual * (inverse[2, 2] + inverse[3, 3]) / scale**2,
    )
