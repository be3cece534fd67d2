"""A plant with the oscillator of its excitation among its states: what LQ control of a steady vibration needs.

    x' = A x + b u + N n,   states: the plant's own, then d1, d2;   u: force of the coil [N];   n: white noise
    d1' = w d2,   d2' = -w d1 - 2 zeta w d2 + sqrt(4 zeta w) n,   excitation = amplitude/sqrt(2) d2

d2 has variance 1, so the excitation has the mean square of a sine of that peak; zeta is the relative width of the
line, that is, how well its frequency is known. Without d1 and d2 an LQ law knows nothing of the frequency it is for.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.plant.config import GROUND, Plant, VoiceCoil
from twin.plant.errors import InputError
from twin.plant.linear import Array, linear_model, read_only

OSCILLATOR = ("d1", "d2")


@dataclass(frozen=True)
class ExcitedPlant:
    """Plant, ideal coil force and excitation at one frequency, in SI units.

    Attributes
    ----------
    A, b, noise
        (n + 2, n + 2), (n + 2,), (n + 2,) of ``x' = A x + b u + noise n``, n white of unit two-sided density.
    states
        Names: those of `LinearModel`, then ``d1``, ``d2`` (dimensionless).
    motion, velocity, stroke, stroke_rate
        (n + 2,) rows: of the primary [m], [m/s]; of the coil's first body against its second [m], [m/s].
    coil
        The coil that pushes with u; its current is u/k.
    frequency_hz, relative_bandwidth
        Of the excitation: w/2 pi [Hz], zeta.
    """

    A: Array
    b: Array
    noise: Array
    states: tuple[str, ...]
    motion: Array
    velocity: Array
    stroke: Array
    stroke_rate: Array
    coil: VoiceCoil
    frequency_hz: float
    relative_bandwidth: float

    @property
    def own_states(self) -> int:
        """How many states are the plant's own; the oscillator's two follow."""
        return len(self.states) - len(OSCILLATOR)

    @property
    def angular_frequency(self) -> float:
        """W of the excitation [rad/s]."""
        return math.tau * self.frequency_hz

    def phasors(self) -> tuple[Array, Array]:
        """Peaks of the plant's own states per newton of the coil, and under the excitation alone, (n,) each.

        Raises
        ------
        InputError
            If the plant has an undamped resonance at just this frequency.
        """
        n = self.own_states
        inputs = np.column_stack([self.b[:n], math.sqrt(2.0) * self.A[:n, n + 1]])
        resolvent = 1j * self.angular_frequency * np.eye(n) - self.A[:n, :n]
        try:
            answer = np.abs(np.linalg.solve(resolvent, inputs))
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"the plant has an undamped resonance at {self.frequency_hz:g} Hz; give its bodies damping_ns_m"
            ) from error
        return answer[:, 0], answer[:, 1]


def excited_plant(
    plant: Plant,
    frequency_hz: float,
    excitation_amplitude: float,
    damping_ns_m: float | None = None,
    *,
    relative_bandwidth: float = 1e-5,
) -> ExcitedPlant:
    """Add the excitation's oscillator to a plant whose coil is an ideal force.

    Parameters
    ----------
    plant
        With a voice coil and one further actuator: the first other one excites.
    frequency_hz
        Of the excitation; damping given against frequency is read there [Hz].
    excitation_amplitude
        Peak, in the exciting actuator's unit.
    damping_ns_m
        Absorber damping in place of the plant's own [Ns/m].
    relative_bandwidth
        zeta: half width of the excitation's line over its frequency, about 1e-6 to 1e-2.

    Raises
    ------
    InputError
        If there is no coil on an absorber or nothing that excites, or a number is not positive.
    """
    coil, absorber = plant.voice_coil, plant.absorber
    if coil is None or absorber is None or coil.between is None:
        raise InputError(
            f"plant '{plant.name}' has no voice coil between two bodies: there is nothing to design"
        )
    exciters = [a for a in plant.actuator if a is not coil]
    if not exciters:
        raise InputError(
            f"plant '{plant.name}' has no actuator that excites it; add one, kind = \"force\" will do"
        )
    for name, value in (("frequency_hz", frequency_hz), ("relative_bandwidth", relative_bandwidth)):
        if not 0.0 < value < math.inf:
            raise InputError(f"{name} must be a number greater than 0, got {value}")
    if not 0.0 <= excitation_amplitude < math.inf:
        raise InputError(f"excitation_amplitude must be a number not below 0, got {excitation_amplitude}")
    damping = {} if damping_ns_m is None else {absorber.name: damping_ns_m}
    model = linear_model(plant, frequency_hz=frequency_hz, damping_ns_m=damping, current_driven=(coil.name,))
    n, w, zeta = len(model.A), math.tau * frequency_hz, relative_bandwidth
    A, b, noise = np.zeros((n + 2, n + 2)), np.zeros(n + 2), np.zeros(n + 2)
    A[:n, :n] = model.A
    A[:n, n + 1] = model.B[:, model.inputs.index(exciters[0].name)] * excitation_amplitude / math.sqrt(2.0)
    A[n, n + 1], A[n + 1, n], A[n + 1, n + 1] = w, -w, -2.0 * zeta * w
    b[:n] = model.B[:, model.inputs.index(coil.name)] / coil.force_constant_n_a
    noise[n + 1] = math.sqrt(4.0 * zeta * w)
    states = (*model.states, *OSCILLATOR)
    first, second = coil.between
    return ExcitedPlant(
        A=read_only(A),
        b=read_only(b),
        noise=read_only(noise),
        states=states,
        motion=_row(states, "x", plant.primary.name),
        velocity=_row(states, "v", plant.primary.name),
        stroke=read_only(_row(states, "x", first) - _row(states, "x", second)),
        stroke_rate=read_only(_row(states, "v", first) - _row(states, "v", second)),
        coil=coil,
        frequency_hz=frequency_hz,
        relative_bandwidth=relative_bandwidth,
    )


def _row(states: tuple[str, ...], kind: str, body: str) -> Array:
    row = np.zeros(len(states))
    if body != GROUND:
        row[states.index(f"{kind}_{body}")] = 1.0
    return read_only(row)


@dataclass(frozen=True)
class Scaling:
    """Units in which an `ExcitedPlant` has numbers of order one: ``x = scale xs``, ``u = force_n us``, time 1/w.

    A scaled covariance, gain or multiplier comes back to SI through these three.
    """

    scale: Array
    force_n: float
    angular_frequency: float

    def model(self, excited: ExcitedPlant) -> tuple[Array, Array]:
        """A and b in scaled units."""
        w = self.angular_frequency
        return (
            np.ascontiguousarray(excited.A * self.scale / self.scale[:, None] / w),
            np.ascontiguousarray(excited.b * self.force_n / self.scale / w),
        )


def balance(excited: ExcitedPlant, force_n: float) -> Scaling:
    """Scale each state by the motion that excitation and the most force (rms, [N]) put into it.

    Riccati equations and semidefinite programs in SI units mix micrometres with newtons and lose their digits.
    """
    by_force, alone = excited.phasors()
    size = np.maximum(by_force * force_n, 0.0) + alone / math.sqrt(2.0)
    # A body that the excitation leaves in peace still needs a scale: that of the others of its kind.
    kinds = np.array([name[0] for name in excited.states[: len(size)]])
    for kind in set(kinds.tolist()):
        mine = kinds == kind
        largest = float(size[mine].max())
        size[mine] = np.maximum(size[mine], 1e-3 * largest if largest > 0.0 else 1.0)
    return Scaling(read_only(np.concatenate([size, [1.0, 1.0]])), force_n, excited.angular_frequency)
