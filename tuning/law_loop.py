"""Any discrete state-space law on the sampled plant: poles, margins, steady state and simulation as it is deployed.

    s+ = A s + B y,   r = C s + D y:   measured channels y to the commanded current r [A]

Nothing here knows how the law was designed; it is judged by its four matrices on the full model.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance

from tuning.loop import Margins, loop_margins, margin_grid
from tuning.sampled import RELATIVE_ACCELERATION, SampledPlant
from tuning.types import Powers
from twin.control.chain import chain_matrices
from twin.control.noise import stationary_covariance
from twin.control.schedule import Gains
from twin.plant.discrete import simulate_block
from twin.plant.linear import Array, ComplexArray, natural_frequencies_hz, read_only


@dataclass(frozen=True)
class StateSpaceLaw:
    """A discrete law from measured channels to the commanded current [A].

    Attributes
    ----------
    A, B, C, D
        (n, n), (n, p), (n,), (p,), read-only; the states have no unit.
    channels
        Names of the p measured channels, in SI units.
    sample_rate_hz
        At which it runs [Hz].
    """

    A: Array
    B: Array
    C: Array
    D: Array
    channels: tuple[str, ...]
    sample_rate_hz: float

    def response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Response of the command to each channel, (n_frequencies, p)."""
        f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        z = np.exp(2j * np.pi * f / self.sample_rate_hz)
        left = z[:, None, None] * np.eye(len(self.A)) - self.A.T
        row = np.linalg.solve(left, np.broadcast_to(self.C[:, None], (len(f), len(self.A), 1)))[:, :, 0]
        return np.asarray(row @ self.B + self.D)


def rig_law(gains: Gains, force_constant_n_a: float, sample_rate_hz: float) -> StateSpaceLaw:
    """The rig's own law, gains behind its filter chain, on the relative acceleration."""
    A, B, C, D = chain_matrices(gains.low_pass_hz, gains.high_pass_hz, sample_rate_hz)
    row = np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m]) / force_constant_n_a
    return StateSpaceLaw(
        A=read_only(A),
        B=read_only(B),
        C=read_only(row @ C),
        D=read_only(row @ D),
        channels=(RELATIVE_ACCELERATION,),
        sample_rate_hz=sample_rate_hz,
    )


@dataclass(frozen=True, slots=True)
class SteadyState:
    """Peaks of primary motion, stroke [m], current [A] and coil voltage [V], and the three powers."""

    displacement_m: float
    stroke_m: float
    current_peak_a: float
    voltage_peak_v: float
    powers: Powers


class LawLoop:
    """A law closed around a sampled plant.

    Parameters
    ----------
    plant
        Sampled with the law's channels and the rig's delay.
    law
        Running at the plant's sample rate.
    """

    def __init__(self, plant: SampledPlant, law: StateSpaceLaw) -> None:
        if law.channels != plant.channels or law.sample_rate_hz != plant.facts.sample_rate_hz:
            raise ValueError("law and plant have different channels or sample rates")
        self.plant, self.law = plant, law

    def matrices(self) -> tuple[Array, Array, Array]:
        """One sample of the closed loop: its matrix, and what excitation before and now does to it.

        States are the plant's, the commands on their way, newest first, and the law's.
        """
        p, law = self.plant, self.law
        n, line = len(p.F), p.waiting
        size = n + line + len(law.A)
        command, command_feed = np.zeros(size), float(law.D @ p.measured_feed)
        command[:n], command[n + line :] = law.D @ p.measured, law.C
        whole, before, now = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        whole[:n, :n], before[:n], now[:n] = p.F, p.before, p.now
        for effect, age in ((p.late, p.facts.delay_samples), (p.early, p.facts.delay_samples + 1)):
            if not effect.any():
                continue
            if age == 0:
                whole[:n] += np.outer(effect, command)
                before[:n] += effect * command_feed
            else:
                whole[:n, n + age - 1] += effect
        if line:
            whole[n], before[n] = command, command_feed
            whole[n + 1 : n + line, n : n + line - 1] = np.eye(line - 1)
        whole[n + line :, :n] = law.B @ p.measured
        whole[n + line :, n + line :] = law.A
        before[n + line :] = law.B @ p.measured_feed
        return whole, before, now

    def decay_rate_1_s(self) -> float:
        """Slowest decay of the closed loop [1/s]: the largest real part of its poles; below 0 is stable."""
        radius = float(np.abs(np.linalg.eigvals(self.matrices()[0])).max())
        return math.log(radius) * self.plant.facts.sample_rate_hz

    def gain(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Loop gain opened at the command, in the sign of negative feedback, (n_frequencies,)."""
        measured = self.plant.responses(frequency_hz)[1][:, :, 0]
        return np.asarray(-np.sum(self.law.response(frequency_hz) * measured, axis=1))

    def margins(self, excitation_hz: float) -> Margins:
        """Modulus and delay margin; the grid is dense around modes, law and excitation."""
        poles = np.log(np.linalg.eigvals(self.law.A).astype(np.complex128) + 1e-300)
        rates = poles * self.plant.facts.sample_rate_hz / math.tau
        own = rates[(rates.imag > 1.0) & (rates.imag < 0.2 * self.plant.facts.sample_rate_hz)]
        near = np.geomspace(1e-6, 0.2, 60)
        around = np.concatenate([-near[::-1], near])
        modes = natural_frequencies_hz(self.plant.plant)
        grid = [margin_grid(self.plant.facts.sample_rate_hz, modes, 200), excitation_hz * (1.0 + around)]
        grid += [np.abs(pole.imag + abs(pole.real) * np.linspace(-8.0, 8.0, 33)) for pole in own]
        grid.append(np.geomspace(0.1, 0.45 * self.plant.facts.sample_rate_hz, 300))
        frequencies = np.unique(np.concatenate(grid))
        frequencies = frequencies[(frequencies > 0.0) & (frequencies < 0.5 * self.plant.facts.sample_rate_hz)]
        return loop_margins(self.gain(frequencies), frequencies)

    def steady(self, frequency_hz: float, amplitude: float) -> SteadyState:
        """Steady state under a sine excitation of some peak, in the exciting actuator's unit."""
        motion, measured = self.plant.responses(frequency_hz)
        law = self.law.response(frequency_hz)[0]
        command = law @ measured[0, :, 1] * amplitude / (1.0 - law @ measured[0, :, 0])
        displacement, stroke, current = motion[0] @ np.array([command, amplitude])
        coil = self.plant.coil
        reference = command * np.exp(-2j * np.pi * frequency_hz * self.plant.facts.delay_s)
        # Terminal voltage behind the current loop; its product with the current is what the amplifier delivers.
        voltage = (coil.current_loop_kp_v_a or 0.0) * (reference - current)
        joule = 0.5 * coil.resistance_ohm * abs(current) ** 2
        return SteadyState(
            displacement_m=float(abs(displacement)),
            stroke_m=float(abs(stroke)),
            current_peak_a=float(abs(current)),
            voltage_peak_v=float(abs(voltage)),
            powers=Powers(
                joule_mean_w=float(joule),
                joule_peak_w=float(2.0 * joule),
                electrical_mean_w=float(0.5 * (voltage * np.conj(current)).real),
            ),
        )

    def noise_power_w(self, noise_density: ArrayLike | None = None) -> float:
        """Mean Joule power that sensor noise alone burns in the coil [W]; infinite if the loop is unstable.

        Parameters
        ----------
        noise_density
            (p,) one-sided, white up to half the sample rate, in each channel's unit per sqrt(Hz); None takes the
            sensors' own.
        """
        p, law = self.plant, self.law
        density = np.broadcast_to(
            np.asarray(p.noise_density if noise_density is None else noise_density, dtype=np.float64),
            (len(law.channels),),
        )
        whole = self.matrices()[0]
        n, line = len(p.F), p.waiting
        into = np.zeros((len(whole), len(density)))
        if line:
            into[n] = law.D
        else:
            into[:n] = np.outer(p.late, law.D)
        into[n + line :] = law.B
        into = into * density * math.sqrt(0.5 * p.facts.sample_rate_hz)
        balanced, transform = matrix_balance(whole, permute=False, separate=True)
        scale = np.asarray(transform[0])
        into = into / scale[:, None]
        if float(np.abs(np.linalg.eigvals(balanced)).max()) >= 1.0:
            return math.inf
        covariance = stationary_covariance(np.asarray(balanced), into @ into.T)
        if covariance is None:
            return math.inf
        current = np.zeros(len(whole))
        current[:n] = p.motion[2]
        current *= scale
        return float(p.coil.resistance_ohm * (current @ covariance @ current))

    def simulate(self, excitation: ArrayLike) -> Array:
        """Primary motion [m], stroke [m] and coil current [A] from rest under an excitation, (N, 3).

        Parameters
        ----------
        excitation
            (N,) at the sample rate, in the exciting actuator's unit.
        """
        whole, before, now = self.matrices()
        rows = np.zeros((3, len(whole)))
        rows[:, : len(self.plant.F)] = self.plant.motion
        drive = np.ascontiguousarray(np.asarray(excitation, dtype=np.float64).reshape(-1, 1))
        out = np.empty((len(drive), 3))
        simulate_block(
            whole, before[:, None].copy(), now[:, None].copy(), rows, np.zeros((3, 1)),
            np.zeros(len(whole)), np.zeros(1), drive, out,
        )  # fmt: skip
        return out
