"""Any plant with any law as one linear loop in continuous time, opened at the commanded force.

    x' = A x + b u + e F      x: bodies, coil current, filter chain;  u: commanded force [N];  F: excitation
    law = c x + d u + h F     and the loop closes with u = law, delayed

The force acts between absorber and primary, or where the voice coil sits. A coil with circuit and current loop is
commanded ``i_ref = u/k`` and takes its time (thesis eq. 7-4, 8-1, energy-conserving back-EMF); without, the force is
ideal. Coils that are not the absorber's and do not excite are open: they carry no current.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance

from twin.control.filters import Cutoffs, chain_state_space
from twin.control.laws import Law, absorber_coil, actuated_pair, measured_motion
from twin.plant.config import GROUND, Actuator, ForceActuator, Plant, VoiceCoil
from twin.plant.linear import Array, ComplexArray, linear_model

SIGNALS = ("primary", "stroke", "force", "current", "voltage")


@dataclass(frozen=True)
class Loop:
    """The loop of this module, with rows for what is to be known of it.

    Attributes
    ----------
    A, b, c, d
        (n, n), (n,), (n,), float: from commanded force to the force the law answers with.
    e, h
        (n,), float: from the excitation to the states and to the law.
    rows, feed
        (5, n), (5,): `SIGNALS` from states and commanded force, in m, m, N, A, V. Current and voltage are NaN
        without a coil that has a current loop.
    mechanical_states
        Displacements, then velocities of the bodies come first among the states; this many together.
    coil
        The driven coil; None where the force is ideal.
    """

    A: Array
    b: Array
    c: Array
    d: float
    e: Array
    h: float
    rows: Array
    feed: Array
    mechanical_states: int
    coil: VoiceCoil | None

    @cached_property
    def balanced(self) -> tuple[Array, Array, Array]:
        """A, b and c in scaled states, for eigenvalues and solves that do not lose digits."""
        scaled, transform = matrix_balance(self.A, permute=False, separate=True)[:2]
        scale = np.asarray(transform[0])
        return np.asarray(scaled), self.b / scale, self.c * scale

    @cached_property
    def open_poles(self) -> ComplexArray:
        """Poles of the open loop [rad/s]."""
        return np.asarray(np.linalg.eigvals(self.A))

    @cached_property
    def closed_poles(self) -> ComplexArray:
        """Poles of the closed loop without delay [rad/s]; infinite if the law's own instant answer is -1."""
        if self.d == 1.0:
            return np.array([complex(np.inf)])
        return np.asarray(np.linalg.eigvals(self.A + np.outer(self.b, self.c) / (1.0 - self.d)))

    def gain(self, s: ArrayLike) -> ComplexArray:
        """Loop gain L(s) without delay, in the sign of negative feedback: the loop closes with 1 + L.

        Parameters
        ----------
        s
            (n,) complex frequencies [rad/s].
        """
        points = np.atleast_1d(np.asarray(s, dtype=np.complex128))
        A, b, c = self.balanced
        out = np.empty(len(points), dtype=np.complex128)
        for start in range(0, len(points), 4096):
            part = points[start : start + 4096]
            resolvent = part[:, None, None] * np.eye(len(A)) - A
            answer = np.linalg.solve(resolvent, np.broadcast_to(b[:, None], (len(part), len(b), 1)))
            out[start : start + 4096] = -(answer[:, :, 0] @ c + self.d)
        return out

    def steady(self, frequency_hz: float, delay_s: float = 0.0, excitation: complex = 1.0) -> ComplexArray:
        """Steady-state phasors of `SIGNALS` to a sine excitation, (5,), peaks.

        Of an unstable loop this is the periodic solution that it runs away from.

        Raises
        ------
        numpy.linalg.LinAlgError
            If plant or closed loop has a pole at just this frequency, on the imaginary axis.
        """
        s = 2j * np.pi * frequency_hz
        resolvent = s * np.eye(len(self.A)) - self.A
        by_force, by_excitation = np.linalg.solve(resolvent, np.column_stack([self.b, self.e])).T
        late = np.exp(-s * delay_s)
        rest = 1.0 - late * (self.c @ by_force + self.d)
        if abs(rest) < 1e-14:
            raise np.linalg.LinAlgError("the closed loop has a pole at the excitation")
        asked = late * (self.c @ by_excitation + self.h) / rest
        states = by_force * asked + by_excitation
        return np.asarray((self.rows @ states + self.feed * asked) * excitation)


def build_loop(
    plant: Plant,
    law: Law | Array | None,
    *,
    frequency_hz: float | None = None,
    filters: Cutoffs | None = None,
    excited_by: str | None = None,
) -> Loop:
    """Put a plant, a law and, if given, the filter chain into one loop.

    Parameters
    ----------
    plant
        Any, with an absorber; the first body is the primary.
    law
        `Law`; or a state feedback ``f = -K x``, (2 n_bodies,), on all bodies' displacements and then velocities;
        or None: passive, the coil open.
    frequency_hz
        Where damping given against frequency is read [Hz].
    filters
        Cutoffs of the chain between measured acceleration and `Law`; None measures all three motions directly.
    excited_by
        Actuator that excites, in its own unit and with its own circuit. None: a force [N] on the primary.

    Raises
    ------
    ValueError
        If there is no absorber, filters are asked for with another law, or K has the wrong length.
    KeyError
        If no actuator has the name ``excited_by``.
    """
    first, second = actuated_pair(plant)
    coil = absorber_coil(plant)
    driven = coil if coil is not None and coil.current_loop_kp_v_a is not None else None
    exciter: Actuator = ForceActuator(name="excitation_force", kind="force", on=plant.primary.name)
    if excited_by is not None:
        exciter = plant.find_actuator(excited_by)
        if exciter is coil:
            raise ValueError(f"actuator '{excited_by}' is the absorber's own coil: it cannot excite as well")
    drive: Actuator | None = driven
    if law is None:
        drive = None
    elif driven is None:
        ends = (first, second)
        drive = ForceActuator(name="absorber_force", kind="force", between=ends)
    actuators = (exciter,) if drive is None else (exciter, drive)
    model = linear_model(
        plant.model_copy(update={"actuator": actuators, "sensor": (), "limits": {}}),
        frequency_hz=frequency_hz,
    )
    n, size = len(plant.body), len(model.A)
    k = driven.force_constant_n_a if driven is not None else 1.0
    b = np.zeros(size) if drive is None else model.B[:, 1] / k
    e = model.B[:, 0]

    rows, feed = np.zeros((5, size)), np.zeros(5)
    names = [body.name for body in plant.body]
    stroke = np.zeros(n)
    stroke[names.index(second)] = -1.0
    if first != GROUND:
        stroke[names.index(first)] = 1.0
    rows[0, 0] = 1.0
    rows[1, :n] = stroke
    if driven is None:
        feed[2] = 0.0 if drive is None else 1.0
        rows[3:], feed[3:] = np.nan, np.nan
    elif drive is None:  # an open coil shows its back-EMF
        rows[4, n : 2 * n] = -driven.force_constant_n_a * stroke
    else:
        current = model.states.index(f"i_{driven.name}")
        kp = driven.current_loop_kp_v_a or 0.0
        rows[2, current], rows[3, current] = k, 1.0
        rows[4, current], feed[4] = -kp, kp / k

    c, d, h = np.zeros(size), 0.0, 0.0
    A = model.A
    if isinstance(law, Law):
        motion = measured_motion(plant, law.measurement)
        seen = (motion @ A[n : 2 * n], float(motion @ b[n : 2 * n]), float(motion @ e[n : 2 * n]))
        if filters is None:
            c = law.alpha_kg * seen[0]
            c[:n] += law.gamma_n_m * motion
            c[n : 2 * n] += law.beta_ns_m * motion
            d, h = law.alpha_kg * seen[1], law.alpha_kg * seen[2]
        else:
            A, b, c, e = _with_chain(A, b, e, seen, law, filters)
            rows = np.hstack([rows, np.zeros((5, len(A) - size))])
            rows[3:] = rows[3:] + (0.0 if driven is not None else np.nan)
    elif filters is not None and law is not None:
        raise ValueError("the filter chain feeds the law on relative motion, not a state feedback")
    elif law is not None:
        if law.shape != (2 * n,):
            raise ValueError(f"the state feedback has shape {law.shape}; {n} bodies need ({2 * n},)")
        c[: 2 * n] = -law
    return Loop(A, b, c, d, e, h, rows, feed, 2 * n, driven)


def _with_chain(
    A: Array, b: Array, e: Array, seen: tuple[Array, float, float], law: Law, filters: Cutoffs
) -> tuple[Array, Array, Array, Array]:
    """Append the chain's six states, fed by the measured acceleration ``seen`` (states, force, excitation)."""
    chain_a, chain_b, chain_c = chain_state_space(filters)
    size, more = len(A), len(chain_a)
    whole = np.zeros((size + more, size + more))
    whole[:size, :size] = A
    whole[size:, :size] = np.outer(chain_b, seen[0])
    whole[size:, size:] = chain_a
    gains = np.array([law.alpha_kg, law.beta_ns_m, law.gamma_n_m])
    return (
        whole,
        np.concatenate([b, chain_b * seen[1]]),
        np.concatenate([np.zeros(size), gains @ chain_c]),
        np.concatenate([e, chain_b * seen[2]]),
    )
