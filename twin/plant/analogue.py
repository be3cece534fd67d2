"""The electrical analogue of a mechanical plant: one loop of current per body (thesis 4.2, 4.3, Table 4-1).

Force is voltage, velocity is current, displacement is charge; so a mass is an inductor (L = m), a damper a
resistor (R = c) and a spring a capacitor (1/C = k). A body's inductor lies in its own loop. Its spring and damper
feel the motion of two bodies, so their capacitor and resistor form a branch that two loops share; the branch of a
body on the ground is in its own loop alone.
"""

from collections.abc import Collection
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from twin.plant.config import (
    GROUND,
    Actuator,
    Body,
    ForceActuator,
    Frozen,
    Name,
    NonNegative,
    Plant,
    Positive,
    Shaker,
    _Actuator,
)
from twin.plant.linear import ComplexArray

TAU = 2.0 * np.pi


class Loop(Frozen):
    """A loop of current: its inductor, and the resistor and capacitor that it may share with another loop.

    The capacitor is kept as elastance 1/C [1/F], which is the stiffness to the last bit; ``capacitance_f`` is
    accepted in its place. ``branch_with`` names the loop on the other side of the branch, None if there is none.
    """

    name: Name
    inductance_h: Positive
    resistance_ohm: NonNegative
    elastance_1_f: Positive
    branch_with: Name | None = None

    @model_validator(mode="before")
    @classmethod
    def _capacitance_is_accepted(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "capacitance_f" not in data:
            return data
        if "elastance_1_f" in data:
            raise ValueError("give capacitance_f or elastance_1_f, not both")
        rest = {key: value for key, value in data.items() if key != "capacitance_f"}
        farad = data["capacitance_f"]
        if isinstance(farad, bool) or not isinstance(farad, int | float) or not 0.0 < farad < np.inf:
            raise ValueError(f"capacitance_f must be a finite number of F above 0, got {farad!r}")
        return rest | {"elastance_1_f": 1.0 / farad}

    @property
    def capacitance_f(self) -> float:
        """Capacitance [F] of the branch."""
        return 1.0 / self.elastance_1_f


class Source(_Actuator):
    """A voltage in a loop (``on``), or the same one against the first and along the second (``between``).

    ``volts_per_unit`` is its gain over its command, in V/V or, for a coil driven by a current, in V/A.
    """

    command: Literal["V", "A"] = "V"
    volts_per_unit: Positive | None = None

    @model_validator(mode="after")
    def _a_current_needs_a_gain(self) -> Self:
        if self.command == "A" and self.volts_per_unit is None:
            raise ValueError('command = "A" needs volts_per_unit [V/A]')
        return self


class Feedback(Frozen):
    """A controlled source, ``v = alpha di_r/dt + beta i_r + gamma q_r`` of the difference first minus second.

    The voltage drives the second loop and opposes the first: the law ``f = alpha x_r'' + beta x_r' + gamma x_r``
    of an active absorber (thesis eq. 6-2; its circuits are in thesis 11.7 to 11.10).
    """

    name: Name
    first: Name
    second: Name
    alpha_h: float = 0.0
    beta_ohm: float = 0.0
    gamma_1_f: float = 0.0


class Circuit(Frozen):
    """Loops that share branches, voltage sources and controlled sources, in the order they are given."""

    name: Name
    loop: tuple[Loop, ...] = Field(min_length=1)
    source: tuple[Source, ...] = ()
    feedback: tuple[Feedback, ...] = ()

    @model_validator(mode="after")
    def _hangs_together(self) -> Self:
        loops = {loop.name for loop in self.loop}
        for loop in self.loop:
            if loop.branch_with is not None and loop.branch_with not in loops:
                raise ValueError(f"loop '{loop.name}': branch_with = \"{loop.branch_with}\" names no loop")
        for source in self.source:
            for place, _ in source.pushes:
                if place != GROUND and place not in loops:
                    raise ValueError(f"source '{source.name}': '{place}' names no loop")
        _mechanics(self)  # the rest is a plant's: names of their own, branches that run in no ring
        used = loops | {source.name for source in self.source}
        for law in self.feedback:
            if law.name in used:
                raise ValueError(f"two things are called '{law.name}'; rename the feedback")
            used.add(law.name)
            for place in (law.first, law.second):
                if place not in loops:
                    raise ValueError(f"feedback '{law.name}': '{place}' names no loop")
            if law.first == law.second:
                raise ValueError(f"feedback '{law.name}': first and second are the same loop")
        return self

    def with_feedback(self, *laws: Feedback) -> "Circuit":
        """Return a copy with these controlled sources and no others.

        Raises
        ------
        pydantic.ValidationError
            If one names no loop, or bears a name that is taken; it is a ValueError.
        """
        return Circuit(name=self.name, loop=self.loop, source=self.source, feedback=laws)

    def path(self, name: str) -> tuple[Loop, ...]:
        """The loops from that one to the last of its branches; their capacitors' charges add up to its own."""
        by_name = {loop.name: loop for loop in self.loop}
        trail = [by_name[name]]
        while (other := trail[-1].branch_with) is not None:
            trail.append(by_name[other])
        return tuple(trail)


def circuit_of(
    plant: Plant, *, frequency_hz: float | None = None, current_driven: Collection[str] = ()
) -> Circuit:
    """Electrical analogue of a plant's bodies and forces (thesis Table 4-1, eq. 4-16 and 4-18).

    Force actuators and current-driven shakers become voltage sources. Coils with a circuit of their own are left
    out (open) unless named in ``current_driven``. Sensors, limits and noise have no place in the circuit.

    Parameters
    ----------
    frequency_hz
        Where to read damping that is given against frequency [Hz].
    current_driven
        Coils that stay, driven by an ideal current [A] through their force constant.

    Raises
    ------
    ValueError
        If damping is given against frequency and no frequency says where.
    KeyError
        If a name in ``current_driven`` is not in the plant.
    """
    for name in current_driven:
        plant.find_actuator(name)
    loops = tuple(
        Loop(
            name=body.name,
            inductance_h=body.mass_kg,
            resistance_ohm=body.damping_at(frequency_hz),
            elastance_1_f=body.stiffness_n_m,
            branch_with=None if body.attached_to == GROUND else body.attached_to,
        )
        for body in plant.body
    )
    sources = tuple(_source(a) for a in plant.actuator if not _is_open(a, current_driven))
    return Circuit(name=plant.name, loop=loops, source=sources)


def plant_of(circuit: Circuit) -> Plant:
    """The mechanical plant behind a circuit: the way back from `circuit_of`, exact to the last bit.

    A source commanded by a current comes back as a current-driven shaker.

    Raises
    ------
    ValueError
        If the circuit has controlled sources: a plant holds no controller.
    """
    if circuit.feedback:
        names = ", ".join(law.name for law in circuit.feedback)
        raise ValueError(f"circuit '{circuit.name}' has feedback ({names}); a plant holds no controller")
    return _mechanics(circuit)


def series_impedance(
    frequency_hz: ArrayLike,
    *,
    inductance_h: ArrayLike = 0.0,
    resistance_ohm: ArrayLike = 0.0,
    elastance_1_f: ArrayLike = 0.0,
) -> ComplexArray:
    """Impedance ``R + j (wL - 1/(wC))`` [ohm] above 0 Hz (thesis eq. 4-13).

    With mass, damping and stiffness in their places it is the mechanical one [Ns/m] (thesis eq. 4-14).
    """
    w = TAU * np.asarray(frequency_hz, dtype=np.float64)
    reactance = w * np.asarray(inductance_h) - np.asarray(elastance_1_f) / w
    return np.asarray(np.asarray(resistance_ohm) + 1j * reactance)


def loop_impedance(circuit: Circuit, frequency_hz: ArrayLike) -> ComplexArray:
    """Loop impedance matrix Z(jw) [ohm]: ``Z i = v`` by Kirchhoff's voltage law around every loop.

    An inductor is on the diagonal, a shared branch on two diagonals and, with minus sign, across. Feedback of a
    difference of loops is one more branch between them, of L = alpha, R = beta and 1/C = gamma; its elements
    may be negative.

    Parameters
    ----------
    frequency_hz
        (n_frequencies,), above 0 Hz.

    Returns
    -------
    ndarray
        (n_frequencies, n_loops, n_loops), symmetric.
    """
    frequency = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
    row = {loop.name: i for i, loop in enumerate(circuit.loop)}
    Z = np.zeros((len(frequency), len(row), len(row)), dtype=np.complex128)

    def add(first: str, second: str | None, impedance: ComplexArray) -> None:
        link = np.zeros(len(row))
        link[row[first]] = 1.0
        if second is not None:
            link[row[second]] = -1.0
        Z[...] += impedance[:, None, None] * np.outer(link, link)

    for loop in circuit.loop:
        add(loop.name, None, series_impedance(frequency, inductance_h=loop.inductance_h))
        branch = series_impedance(
            frequency, resistance_ohm=loop.resistance_ohm, elastance_1_f=loop.elastance_1_f
        )
        add(loop.name, loop.branch_with, branch)
    for law in circuit.feedback:
        added = series_impedance(
            frequency, inductance_h=law.alpha_h, resistance_ohm=law.beta_ohm, elastance_1_f=law.gamma_1_f
        )
        add(law.first, law.second, added)
    return Z


def loop_currents(circuit: Circuit, frequency_hz: ArrayLike) -> ComplexArray:
    """Loop currents per unit of each source's command [A/V or A/A]; the bodies' velocities, by analogy.

    Returns
    -------
    ndarray
        (n_frequencies, n_loops, n_sources).
    """
    row = {loop.name: i for i, loop in enumerate(circuit.loop)}
    drive = np.zeros((len(row), len(circuit.source)))
    for column, source in enumerate(circuit.source):
        for place, sign in source.pushes:
            if place != GROUND:
                drive[row[place], column] = sign * (source.volts_per_unit or 1.0)
    Z = loop_impedance(circuit, frequency_hz)
    return np.asarray(np.linalg.solve(Z, np.broadcast_to(drive, (len(Z), *drive.shape))))


def circuit_toml(circuit: Circuit) -> str:
    """The circuit as TOML text, which ``twin.plant.files.read_toml(path, Circuit)`` reads back unchanged."""
    lines = [f'name = "{circuit.name}"']
    for kind, things in (("loop", circuit.loop), ("source", circuit.source), ("feedback", circuit.feedback)):
        for thing in things:
            lines += ["", f"[[{kind}]]"]
            lines += [
                f"{key} = {_toml(value)}" for key, value in thing.model_dump().items() if value is not None
            ]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return f'"{escaped}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(float(value))


def _is_open(actuator: Actuator, current_driven: Collection[str]) -> bool:
    if isinstance(actuator, ForceActuator) or actuator.name in current_driven:
        return False
    return not (isinstance(actuator, Shaker) and actuator.drive == "current")


def _source(actuator: Actuator) -> Source:
    place = actuator.model_dump(include={"name", "between", "on", "recorded_as"})
    if isinstance(actuator, ForceActuator):
        return Source(**place, volts_per_unit=actuator.force_constant_n_v)
    return Source(**place, command="A", volts_per_unit=actuator.force_constant_n_a)


def _mechanics(circuit: Circuit) -> Plant:
    """The circuit's loops and sources as a plant; whatever is wrong with them as a plant is wrong with them."""
    bodies = tuple(
        Body(
            name=loop.name,
            mass_kg=loop.inductance_h,
            attached_to=loop.branch_with or GROUND,
            stiffness_n_m=loop.elastance_1_f,
            damping_ns_m=loop.resistance_ohm,
        )
        for loop in circuit.loop
    )
    return Plant(name=circuit.name, body=bodies, actuator=tuple(_actuator(s) for s in circuit.source))


def _actuator(source: Source) -> Shaker | ForceActuator:
    place: dict[str, Any] = source.model_dump(include={"name", "between", "on", "recorded_as"})
    if source.command == "A":
        return Shaker(
            **place, kind="shaker", drive="current", force_constant_n_a=source.volts_per_unit or 1.0
        )
    return ForceActuator(**place, kind="force", force_constant_n_v=source.volts_per_unit)
