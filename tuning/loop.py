"""The rig's closed loop as it is deployed: sampled plant, filter chain, delay, gains.

Everything here is exact for the sampled system: the plant with its converter's hold, the discrete filter chain, and
a delay of any length. Stability is judged by the closed loop's eigenvalues, never by a fitted delay.
"""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm
from scipy.linalg.lapack import dgeev

from twin.control.chain import CHAIN_STATES, chain_matrices, chain_response
from twin.control.schedule import Gains
from twin.plant.compiled import kernel
from twin.plant.config import Plant, Shaker
from twin.plant.discrete import DiscreteModel, discretise
from twin.plant.errors import RunError
from twin.plant.linear import Array, ComplexArray, LinearModel, linear_model

if TYPE_CHECKING:
    import control

WELL_CONDITIONED = 1e9
"""Eigenvectors worse than this are not trusted for responses; the state equation is then solved point by point."""

CLOSED_LOOP = 0.02
"""Half-width of a mode, as a share of its frequency, that gains may sharpen it to: grids are no coarser around it."""


@dataclass(frozen=True, slots=True)
class LoopFacts:
    """What the tuner must know of the rig besides the plant.

    Attributes
    ----------
    sample_rate_hz
        Of the controller [Hz].
    delay_samples
        Whole samples between measuring and the converter's update.
    relative
        True if both accelerometers form the difference, False if the absorber's alone stands for it.
    delay_fraction
        What the delay is longer by, as a share of a sample, from 0 up to but not 1: the converter then updates
        between two samples. The hold itself is no part of the delay.

    Raises
    ------
    ValueError
        For a rate that is not above zero, or a delay that is not a number of samples.
    """

    sample_rate_hz: float
    delay_samples: int
    relative: bool = True
    delay_fraction: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.sample_rate_hz < math.inf:
            raise ValueError(f"the sample rate must be above 0 Hz, got {self.sample_rate_hz:g}")
        if self.delay_samples < 0 or not 0.0 <= self.delay_fraction < 1.0:
            raise ValueError(
                f"a delay is whole samples from 0 and a fraction from 0 to below 1, got {self.delay_samples} and "
                f"{self.delay_fraction:g}"
            )

    @property
    def delay_s(self) -> float:
        """Time between measuring and the converter's update [s]."""
        return (self.delay_samples + self.delay_fraction) / self.sample_rate_hz


def loop_facts(sample_rate_hz: float, delay_s: float, relative: bool = True) -> LoopFacts:
    """Facts of a loop with a delay of any length [s]; a rounding off a whole sample is that sample."""
    samples = delay_s * sample_rate_hz
    nearest = round(samples)
    if abs(samples - nearest) < 1e-6:
        return LoopFacts(sample_rate_hz, nearest, relative)
    whole = math.floor(samples)
    return LoopFacts(sample_rate_hz, whole, relative, samples - whole)


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

    Raises
    ------
    ValueError
        If the plant has no such coil, the coil no current loop, or nothing excites the plant.
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
        for name, sign in ((first, 1.0), (second, -1.0)):
            if name not in x:
                continue  # the ground stands still
            rows[1, x[name]] = sign
            weight = 1.0 if facts.relative or name == second else 0.0
            of_state, of_input = _accelerometer(plant, model, name, n + x[name])
            rows[2] += sign * weight * of_state
            feed[2] += sign * weight * of_input
        rows[3, model.states.index(f"i_{coil.name}")] = 1.0
        self._rows, self._feed = rows, feed
        self._early, self._late = self._held(model.A, model.B[:, self.coil_input])
        self._cut: tuple[tuple[float, float], tuple[Array, Array, Array]] | None = None
        self._residues: ComplexArray | None = None
        self._decays: ComplexArray | None = None
        self._split_into_modes()

    def _held(self, A: Array, b: Array) -> tuple[Array, Array]:
        """What the last but one and the last command do to the state over a sample, (n,) each.

        With a fraction of a sample of delay the converter changes from one to the other inside the sample.
        """
        whole = self.discrete.B0[:, self.coil_input]
        share = self.facts.delay_fraction
        if share == 0.0:
            return np.zeros(len(whole)), np.asarray(whole)
        n, dt = len(A), (1.0 - share) / self.facts.sample_rate_hz
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n] = A * dt, b * dt
        late = expm(block)[:n, n]
        return np.asarray(whole - late), np.asarray(late)

    def _split_into_modes(self) -> None:
        """Residues (4, n, 4) of the outputs per mode for the four ways in, and the modes' factors per sample (n,)."""
        decays, vectors = np.linalg.eig(self.discrete.F)
        if np.linalg.cond(vectors) > WELL_CONDITIONED:
            return
        into = np.linalg.solve(vectors, self._ways_in().astype(np.complex128))
        self._residues = np.asarray((self._rows @ vectors)[:, :, None] * into)
        self._decays = np.asarray(decays, dtype=np.complex128)

    def _ways_in(self) -> Array:
        """(n, 4): what the command one and two samples ago, and the excitation one sample ago and now, do."""
        d, j = self.discrete, self.excitation_input
        return np.column_stack([self._late, self._early, d.B0[:, j], d.B1[:, j]])

    def response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Response of [x_primary, x_r, measured relative acceleration, coil current] to [i_ref, excitation].

        ``i_ref`` is the reference as the controller gave it, whole samples of delay ago; the hold and a fraction of
        a sample of delay are in the response.

        Returns
        -------
        ndarray
            (n_frequencies, 4, 2) in SI units per A and per unit of the excitation.
        """
        f = np.atleast_1d(np.asarray(frequency_hz, float))
        back = np.exp(-2j * np.pi * f / self.facts.sample_rate_hz)  # one sample
        steps = np.stack([back, back**2, back, np.ones_like(back)], axis=-1)
        if self._residues is not None and self._decays is not None:
            shares = 1.0 / (1.0 - self._decays * back[:, None])
            ways = np.einsum("fn,rnw->frw", shares, self._residues)
        else:
            inverse = np.linalg.solve(
                np.eye(len(self._late)) - self.discrete.F * back[:, None, None], self._ways_in()[None]
            )
            ways = self._rows @ inverse
        ways = ways * steps[:, None, :]
        out = np.stack([ways[..., 0] + ways[..., 1], ways[..., 2] + ways[..., 3]], axis=-1)
        reference = self._feed[:, self.coil_input] * (back[:, None] if self.facts.delay_fraction else 1.0)
        out[..., 0] += reference
        out[..., 1] += self._feed[:, self.excitation_input]
        return np.asarray(out)

    def acceleration(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Response of the measured relative acceleration to the reference, (n_frequencies,) [m/s² per A]."""
        f = np.atleast_1d(np.asarray(frequency_hz, float))
        if self._residues is None or self._decays is None:
            return np.asarray(self.response(f)[:, 2, 0])
        back = np.exp(-2j * np.pi * f / self.facts.sample_rate_hz)
        shares = 1.0 / (1.0 - self._decays * back[:, None])
        late, early = (shares @ self._residues[2, :, way] for way in (0, 1))
        feed = self._feed[2, self.coil_input] * (back if self.facts.delay_fraction else 1.0)
        return np.asarray((late + early * back) * back + feed)

    def paths(self, frequency_hz: ArrayLike, low_pass_hz: float, high_pass_hz: float) -> ComplexArray:
        """Response of the law's three terms, whole samples of delay included: measured acceleration to A per gain.

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
        paths = self.paths(frequency_hz, low_pass_hz, high_pass_hz)
        return np.asarray(-self.acceleration(frequency_hz)[:, None] * paths)

    def closed_loop(self, gains: Gains) -> "control.StateSpace":
        """Closed loop from the reference's disturbance to the relative acceleration, for its poles."""
        import control  # with it comes all of Matplotlib, which the processes that tune have no use for

        A = self.closed_loop_matrix(gains)
        n = len(self._late)
        into, out = np.zeros((len(A), 1)), np.zeros((1, len(A)))
        into[:n, 0], out[0, :n] = self._late + self._early, self._rows[2]
        return control.ss(A, into, out, [[0.0]], 1.0 / self.facts.sample_rate_hz)

    def closed_loop_matrix(self, gains: Gains) -> Array:
        """One sample of the closed loop: plant states, filter chain, commands on their way to the converter."""
        base, enters, commands = self._opened(gains.low_pass_hz, gains.high_pass_hz)
        law = np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
        return np.asarray(base + np.outer(enters, law @ commands))

    def _opened(self, low_pass_hz: float, high_pass_hz: float) -> tuple[Array, Array, Array]:
        """The loop cut at the command: its matrix (m, m), where a command enters (m,), commands per gain (3, m)."""
        if self._cut is not None and self._cut[0] == (low_pass_hz, high_pass_hz):
            return self._cut[1]
        fs, whole = self.facts.sample_rate_hz, self.facts.delay_samples
        A, B, C, D = chain_matrices(low_pass_hz, high_pass_hz, fs)
        n = len(self._late)
        line = n + CHAIN_STATES
        size = line + whole + (1 if self.facts.delay_fraction else 0)
        # A coil behind a current loop has inductance: its reference moves no acceleration at once.
        commands, enters = np.zeros((3, size)), np.zeros(size)
        commands[:, :n], commands[:, n:line] = D * self._rows[2], C
        commands /= self.coil.force_constant_n_a
        base = np.zeros((size, size))
        base[:n, :n], base[n:line, :n], base[n:line, n:line] = self.discrete.F, B * self._rows[2], A
        for effect, age in ((self._late, whole), (self._early, whole + 1)):
            if not effect.any():
                continue
            if age == 0:
                enters[:n] += effect
            else:
                base[:n, line + age - 1] += effect
        if size > line:
            enters[line] = 1.0
            base[line + 1 :, line:-1] = np.eye(size - line - 1)
        self._cut = (low_pass_hz, high_pass_hz), (base, enters, commands)
        return base, enters, commands

    def stepping(self) -> DiscreteModel:
        """The plant for stepping sample by sample, with the measured relative acceleration as its one output.

        The coil's input u is the command given ``delay_samples + 1`` samples ago, whatever the delay's fraction.
        """
        B0, B1 = self.discrete.B0.copy(), self.discrete.B1.copy()
        B0[:, self.coil_input], B1[:, self.coil_input] = self._early, self._late
        return DiscreteModel(self.discrete.F, B0, B1, self._rows[2:3].copy(), self._feed[2:3].copy())

    def decay_rate_1_s(self, gains: Gains) -> float:
        """Slowest decay of the closed loop [1/s]: the largest real part of its poles; below 0 is stable."""
        poles = np.abs(np.linalg.eigvals(self.closed_loop_matrix(gains)))
        return float(np.log(poles.max()) * self.facts.sample_rate_hz)

    def slowest_poles(self, gains: Gains, count: int) -> tuple[Array, Array]:
        """Real parts of the slowest closed-loop poles [1/s] and what the gains do to them.

        Returns
        -------
        tuple of ndarray
            (count,) real parts, the largest first, one of each pair; (count, 3) their slopes over alpha, beta, gamma.
        """
        _, enters, commands = self._opened(gains.low_pass_hz, gains.high_pass_hz)
        real, imaginary, left, right, failed = dgeev(self.closed_loop_matrix(gains))
        if failed:
            raise RunError(
                "the closed loop's poles could not be computed: its matrix is not finite or too large"
            )
        poles = real + 1j * imaginary
        order = np.argsort(-np.abs(poles), kind="stable")
        chosen = [int(j) for j in order if imaginary[j] >= 0.0][:count]
        poles = poles[chosen]
        # Of a pair the real and the imaginary part of the first one's vectors stand side by side.
        second = [1j * (imaginary[j] > 0.0) for j in chosen]
        beside = np.minimum(np.array(chosen) + 1, len(order) - 1)
        left, right = (part[:, chosen] + second * part[:, beside] for part in (left, right))
        overlap = np.sum(left.conj() * right, axis=0)
        # A pole on top of another has no slope of its own.
        share = np.where(np.abs(overlap) > 1e-7, 1.0 / np.where(overlap == 0.0, 1.0, overlap), 0.0)
        turns = (enters @ left.conj()) * share / poles * (commands @ right)
        fs = self.facts.sample_rate_hz
        return np.log(np.abs(poles)) * fs, np.asarray(turns.T.real * fs)

    @property
    def modes_hz(self) -> Array:
        """(n_modes, 2): frequency and half-width of every vibration mode of the plant without control [Hz]."""
        decays = np.linalg.eigvals(self.discrete.F)
        rates = np.log(decays[np.abs(decays.imag) > 1e-12 * np.abs(decays)]) * self.facts.sample_rate_hz
        rates = rates[rates.imag > 0.0]
        return np.column_stack([rates.imag, np.abs(rates.real)]) / math.tau


def _accelerometer(plant: Plant, model: LinearModel, body: str, row: int) -> tuple[Array, Array]:
    """What the law gets of a body's acceleration: through its sensor's input stage, where one is stated."""
    for sensor in plant.sensor:
        if sensor.kind == "acceleration" and sensor.of == body and sensor.input_stage(1j) != 1.0:
            output = model.outputs.index(sensor.name)
            return model.C[output], model.D[output]
    return model.A[row], model.B[row]


@dataclass(frozen=True, slots=True)
class Margins:
    """Distance of the loop gain from -1 over all frequencies, and the delay that would destabilise it [s]."""

    modulus: float
    delay_s: float | None


def margins(terms: ComplexArray, frequency_hz: Array, gains: Gains, longest_delay_s: float = 8e-3) -> Margins:
    """Margins of the rig's own law, see `loop_margins`.

    Parameters
    ----------
    terms
        (n, 3) from `RigModel.loop_terms`.
    frequency_hz
        (n,) ascending [Hz].
    """
    L = terms @ np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
    return loop_margins(L, frequency_hz, longest_delay_s)


def loop_margins(L: ComplexArray, frequency_hz: Array, longest_delay_s: float = 8e-3) -> Margins:
    """Modulus and delay margin of a stable loop from its gain on a dense grid.

    The delay margin is exact for the grid's crossings of |L| = 1, interpolated linearly; None if no delay below
    ``longest_delay_s`` destabilises.

    Parameters
    ----------
    L
        (n,) loop gain in the sign of negative feedback.
    frequency_hz
        (n,) ascending [Hz].
    """
    modulus, delay_s = nearest_and_soonest(np.ascontiguousarray(L), np.asarray(frequency_hz, np.float64))
    return Margins(float(modulus), float(delay_s) if delay_s < longest_delay_s else None)


@kernel
def nearest_and_soonest(L: ComplexArray, frequency_hz: Array) -> tuple[float, float]:
    """Least distance from -1 to the chords between a grid's points, and the least delay [s] that reaches -1.

    Parameters
    ----------
    L, frequency_hz
        As `loop_margins`.

    Returns
    -------
    tuple of float
        The delay is infinite where the loop gain never crosses one.
    """
    nearest, soonest = np.inf, np.inf
    for k in range(len(L) - 1):
        chord = L[k + 1] - L[k]
        away = 1.0 + L[k]
        length = chord.real * chord.real + chord.imag * chord.imag
        along = -(chord.real * away.real + chord.imag * away.imag) / max(length, 1e-300)
        point = away + min(max(along, 0.0), 1.0) * chord
        nearest = min(nearest, np.sqrt(point.real * point.real + point.imag * point.imag))
        before, after = np.abs(L[k]) - 1.0, np.abs(L[k + 1]) - 1.0
        if before * after < 0.0:
            share = before / (before - after)
            f = frequency_hz[k] + share * (frequency_hz[k + 1] - frequency_hz[k])
            crossing = L[k] + share * chord
            angle = np.arctan2(crossing.imag, crossing.real) + np.pi
            soonest = min(soonest, (angle % (2.0 * np.pi)) / (2.0 * np.pi * f))
    return nearest, soonest


def mode_grid(model: RigModel, points: int) -> Array:
    """Frequency grid [Hz] for a model's loop: the whole band, and each mode as densely as it is sharp.

    Parameters
    ----------
    points
        On either side of each mode, and half as many again as both sides of one over the whole band.
    """
    parts = [np.geomspace(0.3, 0.49 * model.facts.sample_rate_hz, 3 * points)]
    for frequency, width in model.modes_hz:
        off = np.geomspace(0.1 * min(width, CLOSED_LOOP * frequency), 0.6 * frequency, points)
        parts += [frequency + off, frequency - off, np.array([frequency])]
    grid = np.unique(np.concatenate(parts))
    return grid[(grid > 0.0) & (grid < 0.495 * model.facts.sample_rate_hz)]


def margin_grid(sample_rate_hz: float, modes_hz: ArrayLike, points: int) -> Array:
    """Frequency grid [Hz] for margins: logarithmic over the loop's band, denser around each mode."""
    near = [np.linspace(0.75 * f, 1.3 * f, points) for f in np.atleast_1d(np.asarray(modes_hz, float))]
    return np.unique(np.concatenate([*near, np.geomspace(0.3, 0.1 * sample_rate_hz, points)]))
