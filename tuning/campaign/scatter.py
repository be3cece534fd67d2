"""What is not known exactly: parameters drawn at random, each from a stream of its own.

A draw's number and a parameter's name decide what is drawn, nothing else: any case can be drawn alone, and asking for
one more parameter changes none of the others.
"""

import zlib
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import ndtr, ndtri

from twin.plant.config import DampingTable, Frozen, Plant, Positive
from twin.plant.errors import InputError
from twin.plant.files import unit_of
from twin.plant.linear import Array

MOST_REFUSED = 0.02
"""A normal distribution with a larger share below zero is not what is meant: cut off there it is another one."""

LOOP_DELAY, AMPLITUDE = "loop.delay_us", "excitation.amplitude"

OF_BODIES = ("mass_kg", "stiffness_n_m", "damping_ns_m")
OF_ACTUATORS = (
    "force_constant_n_a",
    "resistance_ohm",
    "inductance_h",
    "current_loop_kp_v_a",
    "force_constant_n_v",
)
OF_SENSORS = ("noise_density",)


class _Scatter(Frozen):
    """What all distributions share.

    Attributes
    ----------
    parameter
        ``<body>.mass_kg``, ``.stiffness_n_m``, ``.damping_ns_m``; ``<actuator>.force_constant_n_a``,
        ``.resistance_ohm``, ``.inductance_h``, ``.current_loop_kp_v_a``; ``<sensor>.noise_density``;
        ``loop.delay_us``; ``excitation.amplitude``.
    scale
        ``relative``: what is drawn is a factor on the nominal value; ``absolute``: the value itself, in its own unit.
    """

    parameter: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*\.[a-z][a-z0-9_]*$")
    scale: Literal["relative", "absolute"] = "relative"


class Uniform(_Scatter):
    """Equally likely from ``low`` to ``high``."""

    distribution: Literal["uniform"]
    low: Positive
    high: Positive

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low {self.low:g} is above high {self.high:g}")
        return self

    def draw(self, rng: np.random.Generator) -> float:
        """One value."""
        return float(rng.uniform(self.low, self.high))

    def at(self, share: Array) -> Array:
        """Values below which these shares of all lie."""
        return np.asarray(self.low + share * (self.high - self.low))


class Normal(_Scatter):
    """Normal about ``mean`` with standard deviation ``std``; what is not above zero is drawn again."""

    distribution: Literal["normal"]
    mean: Positive = 1.0
    std: Positive

    @model_validator(mode="after")
    def _mostly_above_zero(self) -> Self:
        share = float(ndtr(-self.mean / self.std))
        if share > MOST_REFUSED:
            raise ValueError(
                f"{self.parameter}: std {self.std:g} about mean {self.mean:g} puts {100.0 * share:.2g} % below 0, "
                'where nothing can be; make std smaller or take distribution = "log_normal"'
            )
        return self

    def draw(self, rng: np.random.Generator) -> float:
        """One value above zero."""
        value = float(rng.normal(self.mean, self.std))
        while value <= 0.0:
            value = float(rng.normal(self.mean, self.std))
        return value

    def at(self, share: Array) -> Array:
        """Values below which these shares of all that are above zero lie."""
        above = 1.0 - float(ndtr(-self.mean / self.std))
        # From the upper end: there the inverse keeps its precision, and what is above zero stays there.
        return np.asarray(self.mean - self.std * ndtri(above * (1.0 - share)))


class LogNormal(_Scatter):
    """Logarithm normal: median ``median``, and ``sigma`` the standard deviation of the natural logarithm."""

    distribution: Literal["log_normal"]
    median: Positive = 1.0
    sigma: Positive

    def draw(self, rng: np.random.Generator) -> float:
        """One value."""
        return float(self.median * np.exp(self.sigma * rng.standard_normal()))

    def at(self, share: Array) -> Array:
        """Values below which these shares of all lie."""
        return np.asarray(self.median * np.exp(self.sigma * ndtri(share)))


Scatter = Annotated[Uniform | Normal | LogNormal, Field(discriminator="distribution")]


def stream(seed: int, draw: int, what: str) -> np.random.SeedSequence:
    """Seed of one quantity in one draw."""
    return np.random.SeedSequence(seed, spawn_key=(draw, zlib.crc32(what.encode())))


def draw_factors(scatter: tuple[Uniform | Normal | LogNormal, ...], seed: int, draw: int) -> dict[str, float]:
    """What one draw gives each parameter: a factor or a value, as its scale says."""
    return {s.parameter: s.draw(np.random.default_rng(stream(seed, draw, s.parameter))) for s in scatter}


def noise_seed(seed: int, draw: int) -> int:
    """Seed of the sensors' noise in one draw."""
    return int(stream(seed, draw, "sensor noise").generate_state(1)[0])


def check_parameter(parameter: str, plant: Plant) -> None:
    """Raise InputError if a plant has no such parameter; the message names those it has."""
    if parameter in (LOOP_DELAY, AMPLITUDE):
        return
    owner, key = parameter.split(".")
    _, found = _owner(plant, owner)
    if found is None or key not in _keys(plant, owner) or getattr(found, key, None) is None:
        known = [
            f"{item.name}.{k}"
            for items in (plant.body, plant.actuator, plant.sensor)
            for item in items
            for k in _keys(plant, item.name)
            if getattr(item, k, None) is not None
        ]
        raise InputError(
            f"scatter parameter '{parameter}': plant '{plant.name}' has none of that name; known: "
            f"{', '.join([*known, LOOP_DELAY, AMPLITUDE])}"
        )


def nominal(plant: Plant, parameter: str) -> float | None:
    """Value of a plant's parameter in its own unit; None where it is a table."""
    owner, key = parameter.split(".")
    _, found = _owner(plant, owner)
    value = getattr(found, key)
    return None if isinstance(value, DampingTable) else float(value)


def scattered_plant(
    plant: Plant, scatter: tuple[Uniform | Normal | LogNormal, ...], drawn: dict[str, float]
) -> Plant:
    """Return the plant with what was drawn in place of its nominal parameters.

    Raises
    ------
    InputError
        If a table of damping is to be replaced by a number: it can only be scaled.
    """
    changed = plant
    for s in scatter:
        if s.parameter in (LOOP_DELAY, AMPLITUDE):
            continue
        owner, key = s.parameter.split(".")
        group, item = _owner(changed, owner)
        value, old = drawn[s.parameter], getattr(item, key)
        if isinstance(old, DampingTable):
            if s.scale == "absolute":
                raise InputError(
                    f"scatter {s.parameter} [{unit_of(key)}]: is given against frequency; scatter it with "
                    'scale = "relative"'
                )
            new: object = old.model_copy(update={"ns_m": tuple(value * c for c in old.ns_m)})
        else:
            new = value if s.scale == "absolute" else value * old
        items = tuple(
            i.model_copy(update={key: new}) if i.name == owner else i for i in getattr(changed, group)
        )
        changed = changed.model_copy(update={group: items})
    return changed


def _owner(plant: Plant, name: str) -> tuple[str, object | None]:
    for group in ("body", "actuator", "sensor"):
        for item in getattr(plant, group):
            if item.name == name:
                return group, item
    return "", None


def _keys(plant: Plant, name: str) -> tuple[str, ...]:
    group, _ = _owner(plant, name)
    return {"body": OF_BODIES, "actuator": OF_ACTUATORS, "sensor": OF_SENSORS}.get(group, ())
