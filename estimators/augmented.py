"""The model an observer filters with: the driven plant, and what else moves without being measured.

Further states stand for wandering forces, for an exciting force nobody measures (an oscillator at the tracked
frequency) and, where it cannot be kept apart from the measurements, for the noise of a measured input.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from estimators.types import StateEstimate
from twin.plant.config import ForceActuator, Plant
from twin.plant.discrete import DiscreteModel
from twin.plant.errors import InputError
from twin.plant.inputs import InputSource
from twin.plant.linear import Array, LinearModel, linear_model, read_only


@dataclass(frozen=True, slots=True)
class Disturbances:
    """White disturbances that the model does not know, one-sided densities.

    Attributes
    ----------
    force_n
        Force on every body without a ``disturbance_density_n`` of its own [N/sqrt(Hz)].
    voltage_v
        Voltage in every coil's circuit [V/sqrt(Hz)].
    """

    force_n: float = 0.01
    voltage_v: float = 1e-4


@dataclass(frozen=True, slots=True)
class UnknownForce:
    """A sinusoidal force on a body that nothing measures, at a frequency that is tracked elsewhere.

    Its states are the force ``f_<body>`` and its quadrature ``f_<body>_quadrature`` [N], which turn at the tracked
    frequency and wander: both receive white noise of intensity
    ``amplitude_n² (amplitude_wander² + (2 pi frequency_std_hz)² hold_s) / 2``.

    Attributes
    ----------
    body
        On which it acts.
    frequency_hz
        To begin with; `Observer.set_excitation_frequency` moves it.
    amplitude_n
        About how large it is; what it wanders by is relative to this [N].
    amplitude_wander
        Standard deviation of the relative change of the amplitude over one second [1/sqrt(s)].
    frequency_std_hz
        Standard deviation of the tracked frequency [Hz].
    hold_s
        How long the tracked frequency's error lasts before another takes its place: the tracker's block [s].
    """

    body: str
    frequency_hz: float
    amplitude_n: float
    amplitude_wander: float = 0.05
    frequency_std_hz: float = 0.02
    hold_s: float = 0.1

    def __post_init__(self) -> None:
        for name in ("frequency_hz", "amplitude_n", "hold_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"unknown force on '{self.body}': {name} is {value}; it must be above zero")
        for name in ("amplitude_wander", "frequency_std_hz"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(
                    f"unknown force on '{self.body}': {name} is {value}; it must not be negative"
                )
        if self.intensity_n2_s <= 0.0:
            raise InputError(
                f"unknown force on '{self.body}': give amplitude_wander or frequency_std_hz; a force that never "
                "changes would soon be known for good, and no later change noticed"
            )

    @property
    def intensity_n2_s(self) -> float:
        """Two-sided intensity of the white noise on force and quadrature [N²/s]."""
        turned = (2.0 * math.pi * self.frequency_std_hz) ** 2 * self.hold_s
        return 0.5 * self.amplitude_n**2 * (self.amplitude_wander**2 + turned)

    @property
    def states(self) -> tuple[str, str]:
        """Names of its states."""
        return f"f_{self.body}", f"f_{self.body}_quadrature"

    def amplitude(self, estimate: StateEstimate) -> tuple[float, float]:
        """Amplitude at a block's last sample and its standard deviation [N]."""
        rows = [estimate.states.index(name) for name in self.states]
        f = estimate.mean[-1, rows]
        size = float(np.hypot(*f))
        P = estimate.covariance[np.ix_(rows, rows)]
        along = f / size if size > 0.0 else np.array([1.0, 0.0])
        return size, math.sqrt(max(float(along @ P @ along), 0.0))


@dataclass(frozen=True, slots=True)
class FilterModel:
    """``x_k = F x_{k-1} + B0 u_{k-1} + B1 u_k + w``, ``z_k = H x_k + D u_k + v``, w of covariance Q.

    Attributes
    ----------
    states
        Those of the linear model, then ``d_<body>`` and ``f_<body>`` [N] and ``n_<actuator>`` [the input's unit].
    F, B0, B1, H, D, Q
        (n, n), (n, m), (n, m), (p, n), (p, m), (n, n), read-only.
    """

    states: tuple[str, ...]
    F: Array
    B0: Array
    B1: Array
    H: Array
    D: Array
    Q: Array


def filter_model(
    plant: Plant,
    model: LinearModel,
    discrete: DiscreteModel,
    sources: Sequence[InputSource],
    sensors: Sequence[str],
    sample_rate_hz: float,
    disturbances: Disturbances,
    unknown_force: UnknownForce | None = None,
) -> FilterModel:
    """Filter's model of a driven plant.

    The noise of a measured input n enters the state through B0 and B1 and, where the input is felt at once, the
    measurements through D. There, n is a state of its own: that is exact. Elsewhere its two parts are added up in
    one, ``F B1 + B0``, exact for the state ``x + B1 n``; what this leaves out, ``H B1 n`` in the measurements, is of
    the order of the input's noise acting for half a sample.

    Parameters
    ----------
    plant, model, discrete, sources
        The plant and its `twin.plant.inputs.driven_model` by these sources.
    sensors
        Names of the measurements, in their order.
    """
    rows = [model.outputs.index(name) for name in sensors]
    n, m, dt = len(model.states), len(sources), 1.0 / sample_rate_hz
    drifting = [b.name for b in plant.body if b.disturbance_drift_n_s is not None]
    oscillating = [] if unknown_force is None else [unknown_force.body]
    states = [*model.states, *(f"d_{b}" for b in drifting)]
    if unknown_force is not None:
        states += unknown_force.states
    extra = len(states) - n
    A, H = _padded(model.A, extra, extra), _padded(model.C[rows], 0, extra)
    if extra:
        acting = drifting + oscillating
        A[:n, n : n + len(acting)], H[:, n : n + len(acting)] = _columns_of_forces(
            plant, sources, acting, rows
        )
    if unknown_force is not None:
        w, f = math.tau * unknown_force.frequency_hz, n + len(drifting)
        A[f, f + 1], A[f + 1, f] = w, -w
    F = expm(A * dt) if extra else discrete.F
    B0, B1 = (_padded(B, extra, 0) for B in (discrete.B0, discrete.B1))
    Q = van_loan(A, np.diag(_intensities(plant, states, disturbances, unknown_force)), dt)

    D = model.D[rows]
    variances = np.array([s.noise_density**2 * sample_rate_hz / 2.0 for s in sources])
    felt = [j for j in range(m) if variances[j] > 0.0 and np.any(D[:, j] != 0.0)]
    for j in set(range(m)) - set(felt):
        walked = F @ B1[:, j] + B0[:, j]
        Q += variances[j] * np.outer(walked, walked)
    if felt:
        states += [f"n_{sources[j].actuator}" for j in felt]
        more, r = len(felt), np.diag(variances[felt])
        cross = -B1[:, felt] @ r
        Q = np.block([[Q - cross @ B1[:, felt].T, cross], [cross.T, r]])
        F = np.block([[F, -B0[:, felt]], [np.zeros((more, len(F) + more))]])
        H = np.hstack([H, -D[:, felt]])
        B0, B1 = (_padded(B, more, 0) for B in (B0, B1))
    return FilterModel(tuple(states), *(read_only(M) for M in (F, B0, B1, H, D, Q)))


def _padded(M: Array, rows: int, columns: int) -> Array:
    """A copy with zeros below and to the right; `numpy.pad` takes twenty times as long for a matrix this small."""
    out = np.zeros((M.shape[0] + rows, M.shape[1] + columns))
    out[: M.shape[0], : M.shape[1]] = M
    return out


def _columns_of_forces(
    plant: Plant, sources: Sequence[InputSource], bodies: Sequence[str], rows: Sequence[int]
) -> tuple[Array, Array]:
    """What a newton on each body does to the states and to the measurements."""
    forces = tuple(
        ForceActuator(name=f"force_{k}_on_{body}", kind="force", on=body) for k, body in enumerate(bodies)
    )
    pushed = linear_model(
        plant.model_copy(update={"actuator": (*plant.actuator, *forces)}),
        damping_ns_m={b.name: 0.0 for b in plant.body},  # makes no difference to what a force does at once
        current_driven=[s.actuator for s in sources if s.by_current],
    )
    columns = [pushed.inputs.index(force.name) for force in forces]
    return pushed.B[:, columns], pushed.D[np.ix_(rows, columns)]


def _intensities(
    plant: Plant, states: Sequence[str], disturbances: Disturbances, unknown_force: UnknownForce | None
) -> Array:
    """Two-sided intensity of the white noise on each state's rate of change, [unit²/s]."""
    intensity = np.zeros(len(states))
    for row, state in enumerate(states):
        kind, name = state.split("_", 1)
        if kind == "v":
            body = plant.find_body(name)
            density = body.disturbance_density_n
            density = disturbances.force_n if density is None else density
            intensity[row] = (density / body.mass_kg) ** 2 / 2.0
        elif kind == "d":
            intensity[row] = (plant.find_body(name).disturbance_drift_n_s or 0.0) ** 2 / 2.0
        elif kind == "i":
            inductance = getattr(plant.find_actuator(name), "inductance_h", None) or math.inf
            intensity[row] = (disturbances.voltage_v / inductance) ** 2 / 2.0
        elif kind == "f" and unknown_force is not None:
            intensity[row] = unknown_force.intensity_n2_s
    return intensity


def van_loan(A: Array, intensity: Array, dt: float) -> Array:
    """Covariance that white noise of a given two-sided intensity adds over one sample.

    ``integral of expm(A s) W expm(A s)' ds`` from 0 to dt (Van Loan 1978), for an interval so short that the inverse
    of a stiff circuit's decay loses no digits, then doubled: ``Q(2 h) = Q(h) + F(h) Q(h) F(h)'``.
    """
    n = len(A)
    doublings = max(0, math.ceil(math.log2(max(float(np.max(np.abs(np.linalg.eigvals(A)))) * dt, 1e-9))))
    h = dt / 2**doublings
    big = np.zeros((2 * n, 2 * n))
    big[:n, :n], big[:n, n:], big[n:, n:] = -A * h, intensity * h, A.T * h
    phi = expm(big)
    F = phi[n:, n:].T
    Q = F @ phi[:n, n:]
    for _ in range(doublings):
        Q, F = Q + F @ Q @ F.T, F @ F
    return np.asarray(0.5 * (Q + Q.T))
