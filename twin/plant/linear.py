"""A plant's equations of motion as a linear state-space model.

Bodies give ``M x'' + C x' + K x = sum(E_a f_a)``; each coil driven by a voltage adds its current as a state,
``L i' = v - R i - k E' x'`` with ``f = k i``, so that ``v i = R i² + d/dt(L i²/2) + f E' x'`` holds at every
instant (the energy-conserving sign; the thesis's eq. 7-3 has the opposite one, which creates energy).
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.plant.config import GROUND, ForceActuator, Plant, Sensor, Shaker, VoiceCoil

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


def read_only(values: ArrayLike) -> Array:
    """Return a C-contiguous float64 copy that nobody can write to."""
    array = np.array(values, dtype=np.float64, order="C")
    array.flags.writeable = False
    return array


@dataclass(frozen=True, slots=True)
class LinearModel:
    """``x' = A x + B u``, ``y = C x + D u`` in SI units, with the names of its signals.

    Attributes
    ----------
    A, B, C, D
        Read-only arrays, (n, n), (n, m), (p, n), (p, m).
    states
        ``x_<body>`` [m] and ``v_<body>`` [m/s] in the plant's order of bodies, then ``i_<actuator>`` [A], then
        ``h_<sensor>`` [the sensor's unit], what the input stage of an AC-coupled sensor holds back.
    inputs
        Actuator names; the unit is the actuator's ``input_unit``.
    outputs
        Sensor names; a voltage whose circuit is left out of the model is not among them.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def response(self, frequency_hz: ArrayLike) -> ComplexArray:
        """Complex response ``C (jw - A)^-1 B + D`` of every output to every input.

        Returns
        -------
        ndarray
            (n_frequencies, p, m), output unit per input unit.
        """
        return frequency_response(self.A, self.B, self.C, self.D, frequency_hz)


def frequency_response(A: Array, B: Array, C: Array, D: Array, frequency_hz: ArrayLike) -> ComplexArray:
    """``C (jw - A)^-1 B + D`` on a frequency grid [Hz], (n_frequencies, p, m)."""
    s = 2j * np.pi * np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    resolvent = s[:, None, None] * np.eye(len(A)) - A
    return np.asarray(C @ np.linalg.solve(resolvent, np.broadcast_to(B, (len(s), *B.shape))) + D)


def linear_model(
    plant: Plant,
    *,
    frequency_hz: float | None = None,
    damping_ns_m: Mapping[str, float] | None = None,
    current_driven: Collection[str] = (),
) -> LinearModel:
    """State-space model of a plant (thesis eq. 5-1, 7-2, 7-3 with the energy-conserving sign).

    Parameters
    ----------
    frequency_hz
        Where to read damping that is given against frequency [Hz].
    damping_ns_m
        Damping [Ns/m] by body name, in place of the plant's own.
    current_driven
        Coils whose current [A] is the input, whatever their circuit: an ideal current source. With no
        current this is the open coil.

    Raises
    ------
    ValueError
        If damping is given against frequency and neither a frequency nor a value replaces it.
    KeyError
        If a body in ``damping_ns_m`` or a coil in ``current_driven`` is not in the plant.
    """
    for name in damping_ns_m or {}:
        plant.find_body(name)
    for name in current_driven:
        plant.find_actuator(name)
    damping = dict(damping_ns_m or {})
    for body in plant.body:
        if body.name not in damping:
            damping[body.name] = body.damping_at(frequency_hz)
    order = {body.name: row for row, body in enumerate(plant.body)}
    n = len(order)
    mass, C, K = _mechanics(plant, damping, order)

    circuits = [a for a in plant.actuator if a.name not in current_driven and _has_circuit(a)]
    size = 2 * n + len(circuits)
    A, B = np.zeros((size, size)), np.zeros((size, len(plant.actuator)))
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n, :n] = -K / mass[:, None]
    A[n : 2 * n, n : 2 * n] = -C / mass[:, None]

    # Force [N] and terminal voltage [V] of each actuator as rows over states and inputs.
    force_x, force_u = np.zeros((len(plant.actuator), size)), np.zeros((len(plant.actuator),) * 2)
    current_x, current_u = np.zeros_like(force_x), np.zeros_like(force_u)
    volt_x, volt_u = np.zeros_like(force_x), np.zeros_like(force_u)
    for column, a in enumerate(plant.actuator):
        push = np.zeros(n)
        for place, sign in a.pushes:
            if place != GROUND:
                push[order[place]] = sign
        if a in circuits:
            _circuit(a, push, 2 * n + circuits.index(a), column, A, B, (volt_x, volt_u))
            current_x[column, 2 * n + circuits.index(a)] = 1.0
            force_x[column, 2 * n + circuits.index(a)] = getattr(a, "force_constant_n_a", 0.0)
        else:
            gain = _direct_gain(a)
            force_u[column, column] = gain
            current_u[column, column] = gain / getattr(a, "force_constant_n_a", np.inf)
        A[n : 2 * n] += np.outer(push / mass, force_x[column])
        B[n : 2 * n] += np.outer(push / mass, force_u[column])

    rows_c, rows_d = [], []
    kept: list[str] = []
    index = {a.name: column for column, a in enumerate(plant.actuator)}
    for sensor in plant.sensor:
        if sensor.kind == "voltage" and sensor.of not in {a.name for a in circuits}:
            continue  # its circuit is left out of this model
        c, d = _sensor_row(
            sensor, order, index, A, B, (force_x, force_u, current_x, current_u, volt_x, volt_u)
        )
        rows_c.append(c)
        rows_d.append(d)
        kept.append(sensor.name)
    states = (
        tuple(f"x_{b}" for b in order)
        + tuple(f"v_{b}" for b in order)
        + tuple(f"i_{a.name}" for a in circuits)
    )
    C_y = np.reshape(rows_c, (len(kept), size))
    D_y = np.reshape(rows_d, (len(kept), len(plant.actuator)))
    for prefix, key in (("l_", "bandwidth_hz"), ("h_", "ac_coupled_hz")):
        corners = {s.name: getattr(s, key) for s in plant.sensor if getattr(s, key) and s.name in kept}
        if corners:
            rows = {kept.index(name): hz for name, hz in corners.items()}
            A, B, C_y, D_y = _input_stage(A, B, C_y, D_y, rows, low_pass=prefix == "l_")
            states += tuple(f"{prefix}{name}" for name in corners)
    return LinearModel(
        A=read_only(A),
        B=read_only(B),
        C=read_only(C_y),
        D=read_only(D_y),
        states=states,
        inputs=tuple(index),
        outputs=tuple(kept),
    )


def natural_frequencies_hz(plant: Plant) -> Array:
    """Undamped natural frequencies [Hz], ascending (thesis eq. 3-17, 3-18 for two bodies).

    Coils are open and dampers left out: the square roots of the eigenvalues of M^-1 K over 2 pi.
    """
    order = {body.name: row for row, body in enumerate(plant.body)}
    mass, _, K = _mechanics(plant, {body.name: 0.0 for body in plant.body}, order)
    scale = 1.0 / np.sqrt(mass)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(scale[:, None] * K * scale)) / (2.0 * np.pi))


def _has_circuit(actuator: VoiceCoil | Shaker | ForceActuator) -> bool:
    return isinstance(actuator, VoiceCoil) or (isinstance(actuator, Shaker) and actuator.drive == "voltage")


def _direct_gain(actuator: VoiceCoil | Shaker | ForceActuator) -> float:
    """Force per unit of input for actuators without a circuit in the model."""
    if isinstance(actuator, ForceActuator):
        return actuator.force_constant_n_v or 1.0
    return actuator.force_constant_n_a


def _mechanics(
    plant: Plant, damping: Mapping[str, float], order: Mapping[str, int]
) -> tuple[Array, Array, Array]:
    n = len(order)
    mass = np.array([b.mass_kg for b in plant.body])
    C, K = np.zeros((n, n)), np.zeros((n, n))
    for body in plant.body:
        link = np.zeros(n)
        link[order[body.name]] = 1.0
        if body.attached_to != GROUND:
            link[order[body.attached_to]] = -1.0
        K += body.stiffness_n_m * np.outer(link, link)
        C += damping[body.name] * np.outer(link, link)
    return mass, C, K


def _circuit(
    coil: VoiceCoil | Shaker | ForceActuator,
    push: Array,
    row: int,
    column: int,
    A: Array,
    B: Array,
    volt: tuple[Array, Array],
) -> None:
    """Add ``L i' = v - R i - k E' x'``; with a current loop ``v = kp (i_ref - i)`` (thesis eq. 7-4, 8-1)."""
    if isinstance(coil, ForceActuator) or coil.resistance_ohm is None or coil.inductance_h is None:
        raise TypeError(f"{coil.name} has no circuit")
    n = len(push)
    kp = coil.current_loop_kp_v_a if isinstance(coil, VoiceCoil) else None
    volt_x, volt_u = volt
    volt_u[column, column] = kp or 1.0
    volt_x[column, row] = -(kp or 0.0)
    A[row, n : 2 * n] = -coil.force_constant_n_a * push / coil.inductance_h
    A[row, row] = -(coil.resistance_ohm + (kp or 0.0)) / coil.inductance_h
    B[row, column] = (kp or 1.0) / coil.inductance_h


def _input_stage(
    A: Array, B: Array, C: Array, D: Array, corners_hz: Mapping[int, float], *, low_pass: bool
) -> tuple[Array, Array, Array, Array]:
    """Append ``h' = w (y - h)`` for some outputs, which then show h (a low-pass) or ``y - h`` (a high-pass)."""
    n, more = len(A), len(corners_hz)
    A, C = np.pad(A, ((0, more), (0, more))), np.pad(C, ((0, 0), (0, more)))
    B, D = np.pad(B, ((0, more), (0, 0))), D.copy()
    for column, (row, corner_hz) in enumerate(corners_hz.items(), start=n):
        w = 2.0 * np.pi * corner_hz
        A[column, :n], A[column, column], B[column] = w * C[row, :n], -w, w * D[row]
        if low_pass:
            C[row], D[row] = 0.0, 0.0
        C[row, column] = 1.0 if low_pass else -1.0
    return A, B, C, D


def _sensor_row(
    sensor: Sensor,
    order: Mapping[str, int],
    index: Mapping[str, int],
    A: Array,
    B: Array,
    rows: tuple[Array, ...],
) -> tuple[Array, Array]:
    n = len(order)
    if sensor.kind in ("displacement", "velocity", "acceleration"):
        names = (sensor.of,) if isinstance(sensor.of, str) else sensor.of
        c, d = np.zeros(A.shape[1]), np.zeros(B.shape[1])
        for name, sign in zip(names, (1.0, -1.0), strict=False):
            row = order[name]
            if sensor.kind == "displacement":
                c[row] += sign
            elif sensor.kind == "velocity":
                c[n + row] += sign
            else:
                c += sign * A[n + row]
                d += sign * B[n + row]
        return c, d
    column = index[str(sensor.of)]
    force_x, force_u, current_x, current_u, volt_x, volt_u = rows
    x, u = {
        "force": (force_x, force_u), "current": (current_x, current_u), "voltage": (volt_x, volt_u)
    }[sensor.kind]  # fmt: skip
    return x[column].copy(), u[column].copy()
