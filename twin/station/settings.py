"""What a session is told besides the plant, and how a recording keeps it."""

from dataclasses import asdict, dataclass, field, fields
from typing import Any, TypeVar

from estimators.damping import LearnerSettings
from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.control.schedule import GainSchedule
from twin.plant.errors import InputError
from twin.station.retuning import RetuningSettings


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """What a session is told besides the plant.

    Attributes
    ----------
    loop
        Sampling and delay of the rig's controller; None if there is no controller to tune.
    schedule
        The schedule the rig starts with; None likewise.
    goal
        Budget and margin of the tuner.
    learner
        Of the damping curve.
    learned
        What was learned before, as `DampingLearner.state` gives it, to go on from; None begins anew.
    retuning
        When gains are asked for and which become commands.
    model_step_ns_m
        The model is rebuilt when the damping in use has moved this far since.
    """

    loop: LoopFacts | None = None
    schedule: GainSchedule | None = None
    goal: TuningGoal = field(default_factory=TuningGoal)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    learned: dict[str, Any] | None = None
    retuning: RetuningSettings = field(default_factory=RetuningSettings)
    model_step_ns_m: float = 0.02


def configuration(settings: SessionSettings) -> dict[str, Any]:
    """Settings as plain data, for the recording; `settings_from` reads them back."""
    s = settings
    return {
        "loop": None if s.loop is None else asdict(s.loop),
        "goal": asdict(s.goal),
        "schedule": None if s.schedule is None else s.schedule.model_dump(mode="json"),
        "learner": asdict(s.learner),
        "learned": s.learned,
        "retuning": asdict(s.retuning),
        "model_step_ns_m": s.model_step_ns_m,
    }


def settings_from(configuration: dict[str, Any]) -> SessionSettings:
    """Read what `configuration` wrote.

    Raises
    ------
    InputError
        If it is not that.
    """
    try:
        c = dict(configuration)
        loop, schedule = c.pop("loop"), c.pop("schedule")
        if "retuning" not in c:  # recorded before these had a place of their own
            c["retuning"] = {"every_blocks": c.pop("retune_every_blocks"), "min_change": c.pop("min_change")}
        return SessionSettings(
            loop=None if loop is None else LoopFacts(**loop),
            schedule=None if schedule is None else GainSchedule.model_validate(schedule, strict=False),
            goal=_settings(TuningGoal, "goal", c.pop("goal")),
            learner=_settings(LearnerSettings, "learner", c.pop("learner")),
            retuning=_settings(RetuningSettings, "retuning", c.pop("retuning")),
            **c,
        )
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the recording's configuration cannot be read ({error}); was it made by another version?"
        ) from error


_S = TypeVar("_S")


def _settings(kind: type[_S], name: str, values: dict[str, Any]) -> _S:
    """Build settings; a key that is no longer one would change results if it were passed over."""
    known = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    unknown = [f"{name}.{key}" for key in values if key not in known]
    if unknown:
        raise InputError(
            f"the recording was made by a version with the setting {', '.join(unknown)}, which this one does not have: "
            "replay it with that version, or export its samples (atmd recordings export) and replay those with --plant"
        )
    return kind(**values)
