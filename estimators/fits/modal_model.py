"""Frequency responses as a sum of modes, as they come out of an analyser that cuts records of finite length.

An averaged response of a lightly damped structure is not H itself. With random excitation and records of length T
under a window w, the H1 estimate is the transform of the impulse response times the window's autocorrelation: that
broadens the peaks and doubles or triples the damping that is read off them. Here the broadening is in the model, so
the damping that is fitted is the structure's.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
WindowKind = Literal["none", "rectangular", "hann", "exponential"]
ResponseKind = Literal["receptance", "mobility", "accelerance"]
POWER_OF_S = {"receptance": 0, "mobility": 1, "accelerance": 2}
DEGREE = 2
REMAINDERS = 2 * (DEGREE + 1)


@dataclass(frozen=True, slots=True)
class Window:
    """How the records behind a response were cut.

    Attributes
    ----------
    kind
        ``none`` if the records hold the whole response (impact that decays, burst, periodic excitation, stepped
        sine); ``rectangular`` or ``hann`` for continuous random excitation; ``exponential`` for impact tests.
    record_s
        Length of a record [s]; for ``exponential`` the time constant of the window [s].
    """

    kind: WindowKind = "none"
    record_s: float = float("inf")

    def kernel(self, a: ComplexArray) -> ComplexArray:
        """Transform of ``exp((lambda - s) t)`` times the window's autocorrelation, from ``a = s - lambda``."""
        match self.kind:
            case "none":
                return 1.0 / a
            case "exponential":
                return 1.0 / (a + 1.0 / self.record_s)
            case "rectangular":
                return self.record_s * _ramp(a * self.record_s)
            case "hann":
                x, turn = a * self.record_s, 1j * TAU
                cosine = 0.5 * (_ramp(x - turn) + _ramp(x + turn))
                sine = (_gate(x - turn) - _gate(x + turn)) / 2j
                return self.record_s * (2.0 / 3.0 * _ramp(x) + cosine / 3.0 + sine / TAU)


def modal_basis(frequency_hz: Array, theta: Array, window: Window) -> Array:
    """(2 n, 2 n_modes + 6) real matrix of a response's real parts above its imaginary parts.

    Columns: real and imaginary part of each mode's residue, then what modes elsewhere leave behind, a polynomial of
    second degree in frequency with complex coefficients.

    Parameters
    ----------
    theta
        (2 n_modes,) natural frequency [Hz] and damping ratio, mode by mode.
    """
    s: ComplexArray = np.asarray(1j * TAU * frequency_hz, dtype=np.complex128)
    columns: list[ComplexArray] = []
    for f, zeta in theta.reshape(-1, 2):
        columns += mode_columns(s, f, zeta, window)
    place = 2.0 * (frequency_hz - frequency_hz[0]) / (frequency_hz[-1] - frequency_hz[0]) - 1.0
    for power in range(DEGREE + 1):
        columns += [place**power + 0j, 1j * place**power]
    matrix = np.column_stack(columns)
    return np.concatenate([matrix.real, matrix.imag])


def mode_columns(
    s: ComplexArray, frequency_hz: float, damping_ratio: float, window: Window
) -> list[ComplexArray]:
    """(n,) responses to a mode's residue of 1 and of j, at ``s = jw``."""
    pole = TAU * frequency_hz * (-damping_ratio + 1j * np.sqrt(max(1.0 - damping_ratio**2, 0.0)))
    here, mirrored = window.kernel(s - pole), window.kernel(s - np.conj(pole))
    return [here + mirrored, 1j * (here - mirrored)]


def _gate(x: ComplexArray) -> ComplexArray:
    """``(1 - e^-x)/x``."""
    small = np.abs(x) < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1.0 - x / 2.0 + x * x / 6.0, (1.0 - np.exp(-safe)) / safe)


def _ramp(x: ComplexArray) -> ComplexArray:
    """``1/x - (1 - e^-x)/x²``."""
    small = np.abs(x) < 1e-2
    safe = np.where(small, 1.0, x)
    return np.where(
        small, 0.5 - x / 6.0 + x * x / 24.0 - x**3 / 120.0, (1.0 - (1.0 - np.exp(-safe)) / safe) / safe
    )
