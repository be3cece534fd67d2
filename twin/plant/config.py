"""A plant as data: bodies, actuators, sensors and limits in one TOML, parsed into frozen models.

Everything that a number can get wrong is refused here, once: unknown keys, missing masses, values that are
not positive or not finite, bodies attached to nothing or to each other in a ring, limits without an owner.
"""

import hashlib
import json
import math
from itertools import pairwise
from typing import Annotated, Any, Literal, Protocol, Self, TypeVar

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    model_serializer,
    model_validator,
)

GROUND = "ground"

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False, strict=True)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]
# Where a channel lies in foreign recordings: array, array:unit or array[:,2]:unit.
RecordedAs = Annotated[str, Field(pattern=r"^[^\[\]:]+(\[[^\[\]]*\])?\s*(:[^:]+)?$")]

MOTION_UNITS = {"displacement": "m", "velocity": "m/s", "acceleration": "m/s²"}
SENSOR_UNITS = MOTION_UNITS | {"current": "A", "voltage": "V", "force": "N"}


class Frozen(BaseModel):
    """Base of every configuration model: immutable, unknown keys refused, no silent conversion."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DampingTable(Frozen):
    """Damping against frequency [Ns/m over Hz]: linear between the points, held beyond the ends."""

    frequency_hz: tuple[Positive, ...] = Field(min_length=2)
    ns_m: tuple[NonNegative, ...]

    @model_validator(mode="after")
    def _points_pair_up_and_rise(self) -> Self:
        if len(self.frequency_hz) != len(self.ns_m):
            raise ValueError(
                f"frequency_hz has {len(self.frequency_hz)} points and ns_m {len(self.ns_m)}; give one each"
            )
        if any(b <= a for a, b in pairwise(self.frequency_hz)):
            raise ValueError("frequency_hz must rise from point to point [Hz]")
        return self

    def at(self, frequency_hz: float) -> float:
        """Damping [Ns/m] at one frequency [Hz]."""
        return float(np.interp(frequency_hz, self.frequency_hz, self.ns_m))


def _number_or_table(value: Any) -> str:
    return "table" if isinstance(value, dict | DampingTable) else "number"


# Told apart by form, so that a mistake is explained for the form that was meant.
Damping = Annotated[
    Annotated[NonNegative, Tag("number")] | Annotated[DampingTable, Tag("table")],
    Discriminator(_number_or_table),
]


class Body(Frozen):
    """A rigid mass on a spring and a damper to the body (or the ground) it is attached to.

    ``disturbance_density_n`` is the one-sided density [N/sqrt(Hz)] of the white force that an observer may
    suppose to act on the body beside the known ones; None leaves it to the observer. ``disturbance_drift_n_s``
    adds a force that wanders, with white rate of change of this one-sided density [N/s per sqrt(Hz)]: a hand, a
    draught, a thermal load.
    """

    name: Name
    mass_kg: Positive
    attached_to: str
    stiffness_n_m: Positive
    damping_ns_m: Damping
    disturbance_density_n: NonNegative | None = None
    disturbance_drift_n_s: Positive | None = None

    def damping_at(self, frequency_hz: float | None) -> float:
        """Damping [Ns/m] at a frequency [Hz]; a plain number is the same at every frequency.

        Raises
        ------
        ValueError
            If the damping is a table and no frequency is given.
        """
        if not isinstance(self.damping_ns_m, DampingTable):
            return self.damping_ns_m
        if frequency_hz is None:
            raise ValueError(f"body '{self.name}' has damping against frequency: say at which frequency [Hz]")
        return self.damping_ns_m.at(frequency_hz)


class _Actuator(Frozen):
    """What all actuators share: a place to push, and where recordings keep the command."""

    name: Name
    between: tuple[str, str] | None = None
    on: str | None = None
    recorded_as: RecordedAs | None = None

    @model_validator(mode="after")
    def _pushes_somewhere(self) -> Self:
        if (self.between is None) == (self.on is None):
            raise ValueError('give either on = "body" or between = ["first", "second"]')
        return self

    @property
    def pushes(self) -> tuple[tuple[str, float], ...]:
        """Bodies and the sign with which the actuator's force acts on them."""
        if self.on is not None:
            return ((self.on, 1.0),)
        first, second = self.between or ("", "")
        return ((first, -1.0), (second, 1.0))


class _Coil(_Actuator):
    """A moving coil: force k i, back-EMF k (x2' - x1') (energy-conserving sign)."""

    force_constant_n_a: Positive


class VoiceCoil(_Coil):
    """Voice-coil motor, driven by voltage or, with a current loop, by a current reference (eq. 7-3, 7-4)."""

    kind: Literal["voice_coil"]
    resistance_ohm: Positive
    inductance_h: Positive
    current_loop_kp_v_a: Positive | None = None

    @property
    def input_unit(self) -> str:
        """Unit of the quantity that drives it: A with a current loop, V without."""
        return "V" if self.current_loop_kp_v_a is None else "A"


class Shaker(_Coil):
    """Electrodynamic shaker, driven by a voltage (eq. 7-2) or by an ideal current source (eq. 5-3)."""

    kind: Literal["shaker"]
    drive: Literal["voltage", "current"] = "voltage"
    resistance_ohm: Positive | None = None
    inductance_h: Positive | None = None

    @model_validator(mode="after")
    def _circuit_where_voltage_drives(self) -> Self:
        if self.drive == "voltage" and (self.resistance_ohm is None or self.inductance_h is None):
            raise ValueError(
                "a voltage-driven shaker needs resistance_ohm and inductance_h "
                '(or say drive = "current" for an ideal current source)'
            )
        return self

    @property
    def input_unit(self) -> str:
        """Unit of the quantity that drives it."""
        return "V" if self.drive == "voltage" else "A"


class ForceActuator(_Actuator):
    """An ideal force, commanded in newton or, with a constant in N/V, in volt."""

    kind: Literal["force"]
    force_constant_n_v: Positive | None = None

    @property
    def input_unit(self) -> str:
        """Unit of the quantity that drives it: V where a constant in N/V is given, N otherwise."""
        return "N" if self.force_constant_n_v is None else "V"


Actuator = Annotated[VoiceCoil | Shaker | ForceActuator, Field(discriminator="kind")]


def _one_or_pair(value: Any) -> str:
    return "pair" if isinstance(value, list | tuple) else "one"


OneOrPair = Annotated[
    Annotated[str, Tag("one")] | Annotated[tuple[str, str], Tag("pair")], Discriminator(_one_or_pair)
]


class Sensor(Frozen):
    """A measured channel. ``noise_density`` is one-sided, in the sensor's SI unit per sqrt(Hz).

    A motion ``of`` two bodies is that of the first against the second. The acquisition's input stage may have
    ``bandwidth_hz``, the corner of a first-order low-pass [Hz], and ``ac_coupled_hz``, that of a first-order high-pass
    behind it; None where everything passes.
    ``recorded_as`` names it in foreign recordings: ``"y:mm"`` for an array y in mm.
    """

    name: Name
    kind: Literal["displacement", "velocity", "acceleration", "current", "voltage", "force"]
    of: OneOrPair
    noise_density: Positive
    range: Positive | None = None
    bandwidth_hz: Positive | None = None
    ac_coupled_hz: Positive | None = None
    recorded_as: RecordedAs | None = None

    @model_serializer(mode="wrap")
    def _leave_out_no_input_stage(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        # Plants without one keep the fingerprints under which recordings and learned curves know them.
        data: dict[str, Any] = handler(self)
        return {k: v for k, v in data.items() if v is not None or k not in ("bandwidth_hz", "ac_coupled_hz")}

    def input_stage(self, s: complex) -> complex:
        """Response of the acquisition's input stage at a complex frequency [rad/s]; 1 where everything passes."""
        low = 1.0 if self.bandwidth_hz is None else 1.0 / (1.0 + s / (2.0 * math.pi * self.bandwidth_hz))
        high = 1.0 if self.ac_coupled_hz is None else s / (s + 2.0 * math.pi * self.ac_coupled_hz)
        return complex(low * high)

    @property
    def unit(self) -> str:
        """SI unit of the channel."""
        return SENSOR_UNITS[self.kind]

    def noise_variance(self, sample_rate_hz: float) -> float:
        """Variance of one sample [unit²] of white noise of this density up to half the sample rate."""
        return self.noise_density**2 * sample_rate_hz / 2.0


class FittedOn(Frozen):
    """Where a plant's parameters came from: rows of a recording that are no fair test of it any more.

    Rows count from 0; ``last_row`` is the first one that was not used.
    """

    recording: str
    first_row: int = Field(ge=0)
    last_row: int = Field(gt=0)

    @model_validator(mode="after")
    def _holds_rows(self) -> Self:
        if self.last_row <= self.first_row:
            raise ValueError(f"last_row {self.last_row} must be after first_row {self.first_row}")
        return self


class Plant(Frozen):
    """A whole plant. Bodies keep the order of the file; the first is the primary one."""

    name: Name
    body: tuple[Body, ...] = Field(min_length=1)
    actuator: tuple[Actuator, ...] = ()
    sensor: tuple[Sensor, ...] = ()
    limits: dict[str, Positive] = Field(default_factory=dict)
    fitted_on: tuple[FittedOn, ...] = ()

    @model_validator(mode="after")
    def _hangs_together(self) -> Self:
        _check_unique([b.name for b in self.body] + [a.name for a in self.actuator], "body or actuator")
        _check_unique([a.name for a in self.actuator] + [s.name for s in self.sensor], "actuator or sensor")
        bodies = {b.name for b in self.body}
        if GROUND in bodies:
            raise ValueError(f"no body may be called '{GROUND}': it is what stands still")
        _check_attachments({b.name: b.attached_to for b in self.body})
        for actuator in self.actuator:
            _check_pushes(actuator, bodies, self.body[0].name)
        for sensor in self.sensor:
            _check_sensor(sensor, bodies, {a.name: a for a in self.actuator})
        known = set(self.limit_units)
        for key in self.limits:
            if key not in known:
                raise ValueError(f"limits.{key} is no limit of this plant; known: {', '.join(sorted(known))}")
        return self

    @property
    def limit_units(self) -> dict[str, str]:
        """Every limit this plant may state, with its unit."""
        units = {"stroke_m": "m", "primary_displacement_m": "m"}
        for actuator in self.actuator:
            if isinstance(actuator, ForceActuator):
                units[f"{actuator.name}_force_n"] = "N"
            else:
                units |= {
                    f"{actuator.name}_current_a": "A",
                    f"{actuator.name}_voltage_v": "V",
                    f"{actuator.name}_power_w": "W",
                }
        return units

    @property
    def primary(self) -> Body:
        """The body whose vibration matters: the first in the file."""
        return self.body[0]

    @property
    def voice_coil(self) -> VoiceCoil | None:
        """The coil that makes the absorber active, if there is one."""
        return next((a for a in self.actuator if isinstance(a, VoiceCoil)), None)

    @property
    def absorber(self) -> Body | None:
        """The body the voice coil pushes; without a coil, the first one attached to the primary."""
        coil = self.voice_coil
        pushed = None if coil is None else coil.pushes[-1][0]
        if pushed is not None and pushed != self.primary.name:
            return self.find_body(pushed)
        return next((b for b in self.body if b.attached_to == self.primary.name), None)

    def find_body(self, name: str) -> Body:
        """Return the body of that name; KeyError if there is none."""
        return _named(self.body, name)

    def find_actuator(self, name: str) -> VoiceCoil | Shaker | ForceActuator:
        """Return the actuator of that name; KeyError if there is none."""
        return _named(self.actuator, name)

    def with_damping(self, body: str, damping: float | DampingTable) -> "Plant":
        """Return a copy in which one body's damping [Ns/m] is replaced; KeyError if there is no such body."""
        self.find_body(body)
        bodies = tuple(
            b.model_copy(update={"damping_ns_m": damping}) if b.name == body else b for b in self.body
        )
        return self.model_copy(update={"body": bodies})

    @property
    def fingerprint(self) -> str:
        """First 16 hex digits of the SHA-256 of the canonical configuration."""
        return fingerprint(self)


def fingerprint(model: BaseModel) -> str:
    """First 16 hex digits of the SHA-256 of a model's canonical JSON: equal content, equal fingerprint."""
    canonical = json.dumps(model.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:16]


class _Named(Protocol):
    @property
    def name(self) -> str: ...


T = TypeVar("T", bound=_Named)


def _named(things: tuple[T, ...], name: str) -> T:
    for thing in things:
        if thing.name == name:
            return thing
    raise KeyError(name)


def _check_unique(names: list[str], what: str) -> None:
    for name in names:
        if names.count(name) > 1:
            raise ValueError(
                f"two things are called '{name}'; every {what} needs a name of its own: rename one"
            )


def _check_attachments(attached_to: dict[str, str]) -> None:
    for name, parent in attached_to.items():
        if parent != GROUND and parent not in attached_to:
            raise ValueError(
                f'body \'{name}\': attached_to = "{parent}" names no body; use "{GROUND}" or one of '
                f"{', '.join(sorted(attached_to))}"
            )
    for name in attached_to:
        trail = [name]
        while (parent := attached_to[trail[-1]]) != GROUND:
            if parent in trail:
                ring = " -> ".join([*trail, parent])
                raise ValueError(
                    f"body '{name}': attached_to runs in a loop ({ring}); attach one of them to \"{GROUND}\""
                )
            trail.append(parent)


def _check_pushes(actuator: _Actuator, bodies: set[str], primary: str) -> None:
    places = [name for name, _ in actuator.pushes]
    for place in places:
        if place != GROUND and place not in bodies:
            raise ValueError(
                f"actuator '{actuator.name}': '{place}' names no body; known: {', '.join(sorted(bodies))}"
            )
    if places == [GROUND]:
        raise ValueError(f"actuator '{actuator.name}': on = \"{GROUND}\" moves nothing; name a body")
    if len(set(places)) < len(places):
        raise ValueError(
            f"actuator '{actuator.name}': between must name two different places, at least one a body"
        )
    if isinstance(actuator, VoiceCoil) and places[1:] in ([GROUND], [primary]) and places[0] != GROUND:
        raise ValueError(
            f"actuator '{actuator.name}': between ends in '{places[1]}'; "
            "a voice coil's second body is the absorber it pushes, the first what it stands on"
        )


def _check_sensor(sensor: Sensor, bodies: set[str], actuators: dict[str, Any]) -> None:
    names = (sensor.of,) if isinstance(sensor.of, str) else sensor.of
    if sensor.kind in MOTION_UNITS:
        known, what = bodies, "body"
    else:
        known, what = set(actuators), "actuator"
        if len(names) > 1:
            raise ValueError(f"sensor '{sensor.name}': a {sensor.kind} is of one actuator, not of a pair")
    for name in names:
        if name not in known:
            raise ValueError(
                f"sensor '{sensor.name}': of = \"{name}\" names no {what}; "
                f"known: {', '.join(sorted(known)) or 'none'}"
            )
    if len(set(names)) < len(names):
        raise ValueError(
            f"sensor '{sensor.name}': of names '{names[0]}' twice; it needs two different bodies"
        )
    if sensor.kind in ("current", "voltage") and isinstance(actuators[names[0]], ForceActuator):
        raise ValueError(f"sensor '{sensor.name}': a force actuator has no {sensor.kind}")
    if sensor.kind == "voltage" and getattr(actuators[names[0]], "drive", "voltage") == "current":
        raise ValueError(f"sensor '{sensor.name}': the voltage of a current-driven shaker is not modelled")
