"""The rig's closed loop as it is deployed: sampled plant, filter chain, delay, gains.

Everything here is exact for the sampled system: the plant with its converter's hold, the discrete filter chain,
whole samples of delay. Stability is judged by the closed loop's eigenvalues, never by a fitted delay.
"""

import math
from dataclasses import dataclass

import control
import numpy as np
from numpy.typing import ArrayLike

from twin.control.chain import CHAIN_STATES, chain_matrices, chain_response
from twin.control.schedule import Gains
from twin.plant.config import Plant, Shaker
from twin.plant.discrete import DiscreteModel, discretise
from twin.plant.linear import Array, ComplexArray, linear_model


@dataclass(frozen=True, slots=True)
class LoopFacts:
    """What the tuner must know of the rig besides the plant.

    Attributes
    ----------
    delay_samples
        Samples between measuring and the converter's update.
    relative
        True if both accelerometers form the difference, False if the absorber's alone stands for it.
    """

    sample_rate_hz: float
    delay_samples: int
    relative: bool = True


class RigModel:
    """Sampled plant between current reference, excitation and what the loop and its limits are about.

    Parameters
    ----------
    plant
        With a voice coil between primary and absorber and one further actuator as the excitation.
    frequency_hz
        Where damping against frequency is read [Hz].
    damping_ns_m
        Absorber damping in place of the plant's own [Ns/m].
    """

    def __init__(
        self, plant: Plant, facts: LoopFacts, frequency_hz: float, damping_ns_m: float | None = None
    ) -> None:
        coil, absorber = plant.voice_coil, plant.absorber
        if coil is None or absorber is None or coil.between is None:
            raise ValueError(f"plant '{plant.name}' has no voice coil on an absorber")
        if coil.current_loop_kp_v_a is None:
            raise ValueError(
                f"actuator '{coil.name}' needs current_loop_kp_v_a [V/A]: the rig commands a current"
            )
        exciters = [j for j, a in enumerate(plant.actuator) if a is not coil]
        if not exciters:
            raise ValueError(f"plant '{plant.name}' has no actuator that excites it")
        self.plant, self.coil, self.facts = plant, coil, facts
        damping = {} if damping_ns_m is None else {absorber.name: damping_ns_m}
        model = linear_model(plant, frequency_hz=frequency_hz, damping_ns_m=damping)
        self.coil_input, self.excitation_input = plant.actuator.index(coil), exciters[0]
        exciter = plant.actuator[exciters[0]]
        smooth = isinstance(exciter, Shaker)
        holds = ["foh" if smooth and j == exciters[0] else "zoh" for j in range(len(plant.actuator))]
        self.discrete: DiscreteModel = discretise(model, facts.sample_rate_hz, holds)  # type: ignore[arg-type]
        n = len(plant.body)
        x = {body.name: model.states.index(f"x_{body.name}") for body in plant.body}
        first, second = coil.between
        rows = np.zeros((4, len(model.states)))
        feed = np.zeros((4, len(plant.actuator)))
        rows[0, x[plant.primary.name]] = 1.0
        rows[1, x[first]], rows[1, x[second]] = 1.0, -1.0
        weight = 1.0 if facts.relative else 0.0
        rows[2] = weight * model.A[n + x[first]] - model.A[n + x[second]]
        feed[2] = weight * model.B[n + x[first]] - model.B[n + x[second]]
        rows[3, model.states.index(f"i_{coil.name}")] = 1.0
        self._rows, self._feed = rows, feed

    def response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Response of [x_primary, x_r, measured relative acceleration, coil current] to [i_ref, excitation].

        Returns
        -------
        ndarray
            (n_frequencies, 4, 2) in SI units per A and per unit of the excitation.
        """
        d = self.discrete
        z = np.exp(2j * np.pi * np.atleast_1d(np.asarray(frequency_hz, float)) / self.facts.sample_rate_hz)
        columns = [self.coil_input, self.excitation_input]
        drive = d.B0[:, columns] / z[:, None, None] + d.B1[:, columns]
        state = np.linalg.solve(np.eye(len(d.F)) - d.F / z[:, None, None], drive)
        return np.asarray(self._rows @ state + self._feed[:, columns])

    def paths(self, frequency_hz: ArrayLike, low_pass_hz: float, high_pass_hz: float) -> ComplexArray:
        """Response of the law's three terms, delay included: measured acceleration to A per unit of gain.

        Returns
        -------
        ndarray
            (n_frequencies, 3) for alpha, beta, gamma.
        """
        f = np.atleast_1d(np.asarray(frequency_hz, float))
        fs = self.facts.sample_rate_hz
        delay = np.exp(-2j * np.pi * f * self.facts.delay_samples / fs)
        chain = chain_response(f, low_pass_hz, high_pass_hz, fs)
        return np.asarray(chain * delay[:, None] / self.coil.force_constant_n_a)

    def loop_terms(self, frequency_hz: ArrayLike, low_pass_hz: float, high_pass_hz: float) -> ComplexArray:
        """Loop gain per unit of each gain, (n_frequencies, 3): ``L = terms @ (alpha, beta, gamma)``.

        The sign is that of negative feedback, so that the margins are distances of L from -1.
        """
        acceleration = self.response(frequency_hz)[:, 2, 0]
        return np.asarray(-acceleration[:, None] * self.paths(frequency_hz, low_pass_hz, high_pass_hz))

    def closed_loop(self, gains: Gains) -> control.StateSpace:
        """Closed loop from the reference's disturbance to the relative acceleration, for its poles."""
        d, fs = self.discrete, self.facts.sample_rate_hz
        j = [self.coil_input]
        # x_k = F x_{k-1} + B0 u_{k-1}: the hold keeps B1 at zero for the coil, so this is the usual form.
        plant = control.ss(d.F, d.B0[:, j], self._rows[2:3], self._feed[2:3, j], 1.0 / fs)
        A, B, C, D = chain_matrices(gains.low_pass_hz, gains.high_pass_hz, fs)
        law = np.array([[gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m]]) / self.coil.force_constant_n_a
        delay = self.facts.delay_samples
        shift = np.eye(delay, k=-1)
        size = CHAIN_STATES + delay
        chain_a, chain_b = np.zeros((size, size)), np.zeros((size, 1))
        chain_a[:CHAIN_STATES, :CHAIN_STATES], chain_b[:CHAIN_STATES] = A, B
        chain_a[CHAIN_STATES:, CHAIN_STATES:] = shift
        chain_a[CHAIN_STATES, :CHAIN_STATES], chain_b[CHAIN_STATES] = law @ C, law @ D
        out = np.zeros((1, size))
        out[0, -1] = 1.0
        return control.feedback(plant, control.ss(chain_a, chain_b, out, [[0.0]], 1.0 / fs), sign=1)

    def decay_rate_1_s(self, gains: Gains) -> float:
        """Slowest decay of the closed loop [1/s]: the largest real part of its poles; below 0 is stable."""
        poles = np.abs(self.closed_loop(gains).poles())
        return float(np.log(poles.max()) * self.facts.sample_rate_hz)


@dataclass(frozen=True, slots=True)
class Margins:
    """Distance of the loop gain from -1 over all frequencies, and the delay that would destabilise it [s]."""

    modulus: float
    delay_s: float | None


def margins(terms: ComplexArray, frequency_hz: Array, gains: Gains, longest_delay_s: float = 8e-3) -> Margins:
    """Modulus and delay margin of a stable loop from its gain on a dense grid.

    The delay margin is exact for the grid's crossings of |L| = 1, interpolated linearly; None if no delay below
    ``longest_delay_s`` destabilises.

    Parameters
    ----------
    terms
        (n, 3) from `RigModel.loop_terms`.
    frequency_hz
        (n,) ascending [Hz].
    """
    L = terms @ np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
    modulus = float(np.min(np.abs(1.0 + L)))
    size = np.abs(L) - 1.0
    crossing = np.nonzero(size[:-1] * size[1:] < 0.0)[0]
    best = math.inf
    for k in crossing:
        share = size[k] / (size[k] - size[k + 1])
        f = frequency_hz[k] + share * (frequency_hz[k + 1] - frequency_hz[k])
        angle = np.angle(L[k] + share * (L[k + 1] - L[k])) + math.pi
        best = min(best, float(angle % math.tau) / (math.tau * f))
    return Margins(modulus, best if best < longest_delay_s else None)


def margin_grid(sample_rate_hz: float, modes_hz: ArrayLike, points: int) -> Array:
    """Frequency grid [Hz] for margins: logarithmic over the loop's band, denser around each mode."""
    near = [np.linspace(0.75 * f, 1.3 * f, points) for f in np.atleast_1d(np.asarray(modes_hz, float))]
    return np.unique(np.concatenate([*near, np.geomspace(0.3, 0.1 * sample_rate_hz, points)]))
