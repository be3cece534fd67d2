"""A schedule handed over to a rig's firmware, as a file: what it is for, what is predicted of it, and the tables."""

from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from tuning.firmware import FixedTable, PointFigures, RoundingEffect
from tuning.loop import LoopFacts
from tuning.types import BudgetKind
from twin.control.schedule import GainSchedule
from twin.plant.config import Damping, Frozen, NonNegative, Plant, Positive
from twin.plant.errors import InputError


class LoopTiming(Frozen):
    """The loop that the margins hold for."""

    sample_rate_hz: Positive
    delay_samples: int = Field(ge=0)
    delay_fraction: NonNegative
    delay_s: NonNegative
    measurement: Literal["relative", "absolute"]

    @property
    def facts(self) -> LoopFacts:
        """The same for the tuner."""
        return LoopFacts(
            self.sample_rate_hz, self.delay_samples, self.measurement == "relative", self.delay_fraction
        )


class CoilData(Frozen):
    """What the controller must know of the coil it drives."""

    name: str
    force_constant_n_a: Positive
    current_limit_a: Positive


class Budget(Frozen):
    """Coil power that may be spent, and which power that is."""

    power_w: Positive
    kind: BudgetKind


class ExcitationData(Frozen):
    """The excitation that the figures hold for: peak, its unit, and who excites."""

    amplitude: Positive
    unit: str
    actuator: str


class TransitionData(Frozen):
    """What is proven about a moving frequency; see `tuning.transition.TransitionCertificate`.

    ``fastest_sweep_hz_s`` is None with ``shown`` where the frequency may move as fast as it likes.
    """

    shown: bool
    method: str
    fastest_sweep_hz_s: float | None
    worst_margin_1_s: float
    reason: str


class Handover(Frozen):
    """Everything that is handed over.

    Attributes
    ----------
    plant, fingerprint
        Name and fingerprint of the plant's configuration that the schedule is for.
    damping_ns_m
        Damping of the absorber in the model that the figures come from.
    source
        Where the schedule comes from, in words.
    made
        When or by whom, as the operator gave it; None if nothing was given.
    """

    format: Literal["atmd-schedule"] = "atmd-schedule"
    version: Literal[1] = 1
    plant: str
    fingerprint: str
    damping_ns_m: Damping
    source: str
    made: str | None
    budget: Budget | None
    excitation: ExcitationData
    loop: LoopTiming
    coil: CoilData
    schedule: GainSchedule
    points: tuple[PointFigures, ...]
    transition: TransitionData
    fixed_point: FixedTable | None
    rounding: RoundingEffect | None


def read_export(path: Path, plant: Plant) -> Handover:
    """Read what ``atmd export`` wrote, for one plant.

    Raises
    ------
    InputError
        If the file cannot be read, is nothing of that kind, or was made for a plant of another fingerprint.
    """
    handover = parse_handover(read_text(path), path)
    if handover.fingerprint != plant.fingerprint:
        raise InputError(
            f"{path}: is for plant '{handover.plant}' with fingerprint {handover.fingerprint}, not for '{plant.name}' "
            f"with {plant.fingerprint}; export a schedule for this plant"
        )
    return handover


def parse_handover(text: str, path: Path) -> Handover:
    """Parse the JSON text of a hand-over; raises InputError as `read_export`."""
    try:
        return Handover.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{path}: {complaints(error)}; give the .json that 'atmd export' wrote") from error


def complaints(error: ValidationError) -> str:
    """What is wrong with a JSON file, with the places, in one line."""
    problems = [(".".join(str(part) for part in p["loc"]), p["msg"]) for p in error.errors()[:4]]
    return "; ".join(f"{place}: {message}" if place else message for place, message in problems)


def read_text(path: Path) -> str:
    """Text of a file; raises InputError if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: cannot be read ({reason}); check the path") from error
