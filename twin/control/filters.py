"""The control chain as analogue filters (thesis 7.9): its state space, and its phase in closed form.

    relative acceleration -> low-pass -> integrate -> high-pass -> velocity -> integrate -> high-pass -> position

Both filters are 2nd-order Butterworth. Integrator and high-pass are one section, ``s/(s² + sqrt(2) wh s + wh²)``.
What the deployed rig computes sample by sample is in `chain`.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.plant.linear import Array

SQRT2 = math.sqrt(2.0)


@dataclass(frozen=True, slots=True)
class Cutoffs:
    """Cutoffs of the chain's low-pass and high-pass [Hz].

    Raises
    ------
    ValueError
        Unless both are positive and finite and the low-pass lies above the high-pass.
    """

    low_pass_hz: float
    high_pass_hz: float

    def __post_init__(self) -> None:
        if not 0.0 < self.high_pass_hz < self.low_pass_hz < math.inf:
            raise ValueError(
                f"the low-pass ({self.low_pass_hz:g} Hz) must lie above the high-pass "
                f"({self.high_pass_hz:g} Hz), both above 0 Hz"
            )


def chain_state_space(cutoffs: Cutoffs) -> tuple[Array, Array, Array]:
    """State space of the chain, from measured acceleration to acceleration, velocity and position.

    Returns
    -------
    tuple of ndarray
        A (6, 6), B (6,), C (3, 6): ``s' = A s + B a``, outputs ``C s``; there is no direct path.
    """
    A, B, C = np.zeros((6, 6)), np.zeros(6), np.zeros((3, 6))
    for row, hz in ((0, cutoffs.low_pass_hz), (2, cutoffs.high_pass_hz), (4, cutoffs.high_pass_hz)):
        w = math.tau * hz
        A[row, row + 1] = 1.0
        A[row + 1, row : row + 2] = -w * w, -SQRT2 * w
    B[1] = (math.tau * cutoffs.low_pass_hz) ** 2
    A[3, 0] = 1.0  # low-passed acceleration into the first integrator
    A[5, 3] = 1.0  # velocity into the second
    C[0, 0] = C[1, 3] = C[2, 5] = 1.0
    return A, B, C


def low_pass_phase(frequency_hz: float, cutoff_hz: float) -> float:
    """Phase [rad] of the 2nd-order Butterworth low-pass, a lag: -atan2(sqrt(2) q, 1 - q²), q = f/f_lp (eq. 7-9)."""
    q = frequency_hz / cutoff_hz
    return -math.atan2(SQRT2 * q, 1.0 - q * q)


def high_pass_phase(frequency_hz: float, cutoff_hz: float) -> float:
    """Phase [rad] of the 2nd-order Butterworth high-pass, a lead: atan2(sqrt(2) r, 1 - r²), r = f_hp/f (eq. 7-12)."""
    r = cutoff_hz / frequency_hz
    return math.atan2(SQRT2 * r, 1.0 - r * r)


def phase_delay_s(phase_rad: float, frequency_hz: float) -> float:
    """Delay [s] that a phase is worth at a frequency; a lag is positive (thesis eq. 7-10)."""
    return -phase_rad / (math.tau * frequency_hz)


def paired_low_pass_hz(excitation_hz: float, high_pass_hz: float) -> float:
    """Low-pass cutoff [Hz] whose lag one high-pass makes good: f_lp f_hp = f², thesis eq. 7-14.

    It nulls the phase of the velocity path; the position path has two high-passes and keeps a lead.
    """
    return excitation_hz**2 / high_pass_hz


def velocity_path_phase(frequency_hz: float, cutoffs: Cutoffs) -> float:
    """Phase error [rad] of the chain's velocity: one low-pass, one high-pass (thesis eq. 7-13 sets it to zero)."""
    return low_pass_phase(frequency_hz, cutoffs.low_pass_hz) + high_pass_phase(
        frequency_hz, cutoffs.high_pass_hz
    )


def position_path_phase(frequency_hz: float, cutoffs: Cutoffs) -> float:
    """Phase error [rad] of the chain's position: one low-pass, two high-passes.

    With the pairing of eq. 7-14 one high-pass is left over: the lead ``atan2(sqrt(2) r, 1 - r²)``, r = f_hp/f.
    """
    return velocity_path_phase(frequency_hz, cutoffs) + high_pass_phase(frequency_hz, cutoffs.high_pass_hz)


def phase_as_damping(gamma_n_m: float, phase_rad: float, frequency_hz: float) -> float:
    """Velocity gain [Ns/m] that a position gain becomes by a phase error: gamma sin(phase)/w.

    It adds to beta; with gamma and phase both negative, as below the tuned frequency behind a low-pass, it
    dampens the absorber and the primary is no longer quiet.
    """
    return gamma_n_m * math.sin(phase_rad) / (math.tau * frequency_hz)
