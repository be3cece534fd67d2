"""Linear quadratic control on a plant's own states, with and without an observer (thesis 6.4).

``f = -K x`` with x all bodies' displacements and then velocities. A loop with such a K keeps ``|1 + L| >= 1`` as
long as all states are measured at once; that is also why no weights make it quiet one frequency as zero placement
does, and why delay and a current loop, which the design does not know, may destabilise a large K.

python-control is imported where it is called: it brings all of Matplotlib, 30 MB in every process that only tunes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from twin.control.continuous import Loop, build_loop
from twin.control.laws import actuated_pair
from twin.plant.config import ForceActuator, Plant
from twin.plant.linear import Array, ComplexArray, linear_model, read_only

if TYPE_CHECKING:
    import control

PRIMARY_DISPLACEMENT_WEIGHT, PRIMARY_VELOCITY_WEIGHT, FORCE_WEIGHT = 1e11, 1e10, 1e-6
"""Thesis Table 6-2: weights on (x1, x1') and on the force; the absorber's states weigh nothing."""


@dataclass(frozen=True, slots=True)
class ForceModel:
    """Bodies between an ideal force on the absorber and the excitation, ``x' = A x + b f + e F`` (eq. 6-8).

    Attributes
    ----------
    A, b, e
        (2 n, 2 n), (2 n,), (2 n,); states are displacements, then velocities, of the n bodies.
    """

    A: Array
    b: Array
    e: Array


def force_model(plant: Plant, frequency_hz: float | None = None) -> ForceModel:
    """Mechanics of a plant with an ideal force where its coil is, coils open.

    Parameters
    ----------
    frequency_hz
        Where damping given against frequency is read [Hz].

    Raises
    ------
    ValueError
        If the plant has no absorber.
    """
    actuators = (
        ForceActuator(name="absorber_force", kind="force", between=actuated_pair(plant)),
        ForceActuator(name="excitation_force", kind="force", on=plant.primary.name),
    )
    bare = plant.model_copy(update={"actuator": actuators, "sensor": (), "limits": {}})
    model = linear_model(bare, frequency_hz=frequency_hz)
    return ForceModel(model.A, read_only(model.B[:, 0]), read_only(model.B[:, 1]))


def bryson_weights(largest: ArrayLike) -> Array:
    """Diagonal weights by Bryson's rule: 1/max² of each state or input (thesis 6.4.1); inf weighs nothing.

    Raises
    ------
    ValueError
        If a largest value is not positive.
    """
    values = np.atleast_1d(np.asarray(largest, dtype=np.float64))
    if not np.all(values > 0.0):
        raise ValueError("Bryson's rule needs the largest acceptable value of each quantity, above zero")
    return np.diag(1.0 / values**2)


def table_6_2_weights(bodies: int) -> tuple[Array, Array]:
    """Q (2 n, 2 n) and R (1, 1) of thesis Table 6-2 for any number of bodies, the primary first."""
    Q = np.zeros((2 * bodies, 2 * bodies))
    Q[0, 0], Q[bodies, bodies] = PRIMARY_DISPLACEMENT_WEIGHT, PRIMARY_VELOCITY_WEIGHT
    return Q, np.array([[FORCE_WEIGHT]])


def lq_gain(model: ForceModel, Q: ArrayLike, R: ArrayLike) -> Array:
    """Gain K of ``f = -K x`` that minimises the integral of ``x'Qx + f'Rf`` (thesis eq. 6-9 to 6-12), (2 n,).

    Raises
    ------
    ValueError
        If the Riccati equation has no stabilising solution for these weights.
    """
    import control

    try:
        K, _, poles = control.lqr(model.A, model.b[:, None], np.asarray(Q), np.asarray(R), method="scipy")
    except (np.linalg.LinAlgError, control.ControlArgument) as error:
        raise ValueError(f"no LQ gain for these weights: {error}") from error
    if not np.all(np.real(poles) < 0.0):
        raise ValueError("no LQ gain for these weights: the closed loop would not be stable")
    return np.asarray(K, dtype=np.float64).ravel()


def placed_observer(model: ForceModel, C: ArrayLike, K: Array, faster: float = 4.0) -> Array:
    """Observer gain with the controller's poles, ``faster`` times as far out (thesis 6.4.2: 4 to 10 times).

    Returns
    -------
    ndarray
        (2 n, p) for the p outputs ``y = C x``, so that A - L C has the poles.
    """
    import control

    measured = np.atleast_2d(np.asarray(C, dtype=np.float64))
    poles = faster * np.linalg.eigvals(model.A - np.outer(model.b, K))
    return np.asarray(control.place(model.A.T, measured.T, _apart(np.asarray(poles, dtype=np.complex128))).T)


def kalman_observer(
    model: ForceModel, C: ArrayLike, force_density: float, noise_density: Sequence[float]
) -> Array:
    """Stationary Kalman-Bucy gain for an unknown white force on the primary and white sensor noise (6.4.2).

    Parameters
    ----------
    force_density
        One-sided density of the excitation the observer does not know [N/sqrt(Hz)].
    noise_density
        (p,) one-sided density of each output [its unit/sqrt(Hz)].

    Returns
    -------
    ndarray
        (2 n, p).
    """
    import control

    measured = np.atleast_2d(np.asarray(C, dtype=np.float64))
    # Two-sided densities are half the square of one-sided ones.
    process = np.array([[0.5 * force_density**2]])
    sensors = np.diag(0.5 * np.asarray(noise_density, dtype=np.float64) ** 2)
    L, _, _ = control.lqe(model.A, model.e[:, None], measured, process, sensors, method="scipy")
    return np.asarray(L, dtype=np.float64)


def lqg_controller(model: ForceModel, C: ArrayLike, K: Array, L: Array) -> "control.StateSpace":
    """Observer and gain as one controller from measured outputs to force (thesis eq. 6-14 to 6-18)."""
    import control

    measured = np.atleast_2d(np.asarray(C, dtype=np.float64))
    A = model.A - np.outer(model.b, K) - L @ measured
    return control.ss(A, L, -K[None, :], np.zeros((1, len(measured))))


def lqg_loop(plant: Plant, C: ArrayLike, K: Array, L: Array, frequency_hz: float | None = None) -> Loop:
    """LQG on a plant as a loop opened at the commanded force, for its exact margins and steady state.

    The observer knows what it commands, not when a delay lets it act: that is what the delay margin is about.

    Parameters
    ----------
    C
        (p, 2 n) measured outputs from the states of `force_model`.
    K, L
        (2 n,) gain and (2 n, p) observer gain.
    frequency_hz
        Where damping given against frequency is read [Hz].

    Raises
    ------
    ValueError
        If the plant has no absorber.
    """
    model = force_model(plant, frequency_hz)
    measured = np.atleast_2d(np.asarray(C, dtype=np.float64))
    size = len(model.A)
    plain = build_loop(plant, np.zeros(size), frequency_hz=frequency_hz)
    correction = np.asarray(L, dtype=np.float64).reshape(size, len(measured)) @ measured
    A = np.zeros((2 * size, 2 * size))
    A[:size, :size], A[size:, :size] = model.A, correction
    A[size:, size:] = model.A - np.outer(model.b, K) - correction
    zero = np.zeros(size)
    rows = np.full((5, 2 * size), np.nan)
    rows[:3] = 0.0
    rows[:2, :size] = plain.rows[:2, :size]
    return Loop(
        A=A,
        b=np.concatenate([model.b, zero]),
        c=np.concatenate([zero, -K]),
        d=0.0,
        e=np.concatenate([model.e, zero]),
        h=0.0,
        rows=rows,
        feed=np.array([0.0, 0.0, 1.0, np.nan, np.nan]),
        mechanical_states=size,
        coil=None,
    )


def _apart(poles: ComplexArray) -> ComplexArray:
    """Poles of which none repeats more often than pole placement can do: equal real ones are moved apart."""
    out = poles.copy()
    for k in range(1, len(out)):
        if np.any(np.abs(out[:k] - out[k]) < 1e-6 * abs(out[k])) and out[k].imag == 0.0:
            out[k] *= 1.0 + 1e-3 * k
    return out
