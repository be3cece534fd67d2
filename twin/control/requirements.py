"""What active damping asks of an actuator, and which coils of a catalogue can give it (thesis 8.1 to 8.4).

Force, current, voltage and the three powers come from the whole model, so they hold for any plant and for both
laws; thesis eq. 8-3 to 8-11 write them out for two bodies, with the back-EMF's sign that creates energy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from twin.control.analysis import Controller, OperatingPoint, analyse
from twin.control.filters import Cutoffs
from twin.control.laws import Feedback, absorber_coil
from twin.plant.config import Frozen, Plant, Positive, VoiceCoil
from twin.plant.errors import InputError
from twin.plant.files import parse_toml, read_toml

PowerKind = Literal["joule_peak", "joule_mean", "electrical_mean"]


class CatalogueCoil(Frozen):
    """A coil on the market: circuit, the masses it brings along, and what it stands for any length of time."""

    name: Annotated[str, Field(min_length=1)]
    resistance_ohm: Positive
    inductance_h: Positive
    force_constant_n_a: Positive
    coil_mass_kg: Positive
    body_mass_kg: Positive
    stroke_m: Positive | None = None
    continuous_force_n: Positive | None = None
    continuous_power_w: Positive | None = None


class CoilCatalogue(Frozen):
    """Coils to choose from, each with a name of its own."""

    coil: tuple[CatalogueCoil, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _names_differ(self) -> Self:
        names = [c.name for c in self.coil]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"two coils are called '{name}'; rename one")
        return self


def load_catalogue(path: Path | None = None) -> CoilCatalogue:
    """Read a catalogue of coils from a TOML file; without one, the coils of the thesis.

    Raises
    ------
    InputError
        If it cannot be read or used.
    """
    if path is not None:
        return read_toml(path, CoilCatalogue)
    text = files("twin.control").joinpath("coils.toml").read_text(encoding="utf-8")
    return parse_toml(text, CoilCatalogue, "catalogue coils")


@dataclass(frozen=True, slots=True)
class Requirements:
    """Largest figures over a band of excitation frequencies; peaks, SI. None without a coil."""

    primary_displacement_m: float
    stroke_m: float
    actuator_force_n: float
    current_a: float | None
    voltage_v: float | None
    joule_peak_w: float | None
    joule_mean_w: float | None
    electrical_mean_w: float | None
    stable: bool


def requirements(points: Sequence[OperatingPoint]) -> Requirements:
    """Collect the worst of some operating points; `stable` only if all are.

    Raises
    ------
    ValueError
        If there are none.
    """
    if not points:
        raise ValueError("no operating points")

    def worst(name: str) -> float | None:
        values = [getattr(p, name) for p in points]
        return None if values[0] is None else max(values)

    return Requirements(
        primary_displacement_m=max(p.primary_displacement_m for p in points),
        stroke_m=max(p.stroke_m for p in points),
        actuator_force_n=max(p.actuator_force_n for p in points),
        current_a=worst("current_a"),
        voltage_v=worst("voltage_v"),
        joule_peak_w=worst("joule_peak_w"),
        joule_mean_w=worst("joule_mean_w"),
        electrical_mean_w=worst("electrical_mean_w"),
        stable=all(p.stable for p in points),
    )


def with_coil(plant: Plant, coil: CatalogueCoil, current_loop_kp_v_a: float = 200.0) -> Plant:
    """Return the plant with a coil built in between primary and absorber (thesis 8.2).

    The coil's body adds to the primary's mass, its moving part to the absorber's, and the absorber's spring is
    retuned so that its frequency stays.

    Raises
    ------
    InputError
        If the plant has no absorber or the absorber has a coil already.
    """
    absorber = plant.absorber
    if absorber is None:
        raise InputError(f"plant '{plant.name}' has no absorber to build a coil into")
    if absorber_coil(plant) is not None:
        raise InputError(f"plant '{plant.name}' has a coil on its absorber: start from the plant without one")
    moving = absorber.mass_kg + coil.coil_mass_kg
    spring = absorber.stiffness_n_m * moving / absorber.mass_kg
    changed = {
        plant.primary.name: {"mass_kg": plant.primary.mass_kg + coil.body_mass_kg},
        absorber.name: {"mass_kg": moving, "stiffness_n_m": spring},
    }
    taken = {b.name for b in plant.body} | {a.name for a in plant.actuator} | {s.name for s in plant.sensor}
    name = next(n for n in ("vcm", *(f"vcm{k}" for k in range(2, 100))) if n not in taken)
    actuator = VoiceCoil(
        name=name,
        kind="voice_coil",
        between=(plant.primary.name, absorber.name),
        resistance_ohm=coil.resistance_ohm,
        inductance_h=coil.inductance_h,
        force_constant_n_a=coil.force_constant_n_a,
        current_loop_kp_v_a=current_loop_kp_v_a,
    )
    bodies = tuple(b.model_copy(update=changed.get(b.name, {})) for b in plant.body)
    return plant.model_copy(update={"body": bodies, "actuator": (*plant.actuator, actuator)})


@dataclass(frozen=True, slots=True)
class CoilVerdict:
    """What a coil of the catalogue comes to in a plant.

    Attributes
    ----------
    worst
        Largest figures over the band.
    shortfalls
        What it does not meet, in words; empty if it does.
    """

    coil: CatalogueCoil
    worst: Requirements
    shortfalls: tuple[str, ...]

    @property
    def meets(self) -> bool:
        """Whether the coil meets every limit."""
        return not self.shortfalls


def select_coils(
    plant: Plant,
    catalogue: CoilCatalogue,
    frequencies_hz: Sequence[float],
    *,
    excitation_n: float,
    displacement_limit_m: float,
    budget_w: float,
    budget_kind: PowerKind = "joule_mean",
    controller: Controller = "gain_scheduling",
    feedback: Feedback = "position",
    delay_s: float = 0.0,
    filters: Cutoffs | None = None,
    current_loop_kp_v_a: float = 200.0,
) -> list[CoilVerdict]:
    """Try every coil of a catalogue in a plant, those that meet the limits first, then by power.

    Parameters
    ----------
    plant
        Without a coil; see `with_coil`.
    frequencies_hz
        Excitation frequencies that all must be met [Hz].
    displacement_limit_m
        Largest peak of the primary's motion [m].
    budget_w, budget_kind
        Power per operating point [W], and which of the three it bounds.

    Raises
    ------
    InputError
        As `with_coil`.
    """
    verdicts = []
    for coil in catalogue.coil:
        points = analyse(
            with_coil(plant, coil, current_loop_kp_v_a),
            controller,
            list(frequencies_hz),
            feedback=feedback,
            excitation_n=excitation_n,
            delay_s=delay_s,
            filters=filters,
        )
        worst = requirements(points)
        spent = getattr(worst, f"{budget_kind}_w")
        heat = worst.joule_mean_w or 0.0
        limits = (
            ("displacement", worst.primary_displacement_m, displacement_limit_m, "m"),
            (budget_kind.replace("_", " ") + " power", spent, budget_w, "W"),
            ("stroke", worst.stroke_m, None if coil.stroke_m is None else 0.5 * coil.stroke_m, "m"),
            ("rms force", worst.actuator_force_n / 2**0.5, coil.continuous_force_n, "N"),
            ("continuous power", heat, coil.continuous_power_w, "W"),
        )
        short = [
            f"{what} {value:.3g} {unit} is above {limit:.3g} {unit}"
            for what, value, limit, unit in limits
            if limit is not None and value > limit
        ]
        if not worst.stable:
            short.append("the loop is unstable")
        verdicts.append(CoilVerdict(coil, worst, tuple(short)))
    return sorted(verdicts, key=lambda v: (not v.meets, getattr(v.worst, f"{budget_kind}_w")))
