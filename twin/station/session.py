"""The only loop: one block in, one frame out, the same for a live rig, a recording and a what-if.

    block -> plant in parallel -> observer -> excitation -> damping -> retune -> frame (and perhaps a command)

A session owns no clock, no socket and no file. What it decides depends on the blocks and commands it is given and
on nothing else, so that a replay repeats it.
"""

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np

from estimators.damping import AbsorberBalance, DampingLearner, LearnerSettings
from estimators.excitation import ExcitationTracker, choose_reference
from estimators.health import model_health
from estimators.observer import Observer
from estimators.types import DampingCurve, Phasors, StateEstimate
from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.inputs import DriveReader, driven_model
from twin.plant.parallel import ParallelPlant
from twin.station.frame import Event, Frame, Performance
from twin.station.performance import PerformanceMeter
from twin.station.retuning import Retuning, RetuningSettings, Turn
from twin.station.worker import AfterBlocks, Tuner, TunerHere

SETTLE_BLOCKS = 3
"""Blocks not learned from after the controller went on or off."""


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
    retuning
        When gains are asked for and which become commands.
    model_step_ns_m
        The model is rebuilt when the damping in use has moved this far since.
    """

    loop: LoopFacts | None = None
    schedule: GainSchedule | None = None
    goal: TuningGoal = field(default_factory=TuningGoal)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    retuning: RetuningSettings = field(default_factory=RetuningSettings)
    model_step_ns_m: float = 0.02


class Session:
    """The twin beside one rig or recording.

    Parameters
    ----------
    plant
        The model to start from.
    channels, sample_rate_hz
        Of the blocks that will come.
    settings
        See `SessionSettings`.
    recorded_commands
        When a recording is replayed: the commands that acted then, by identifier.
    tuner
        Works out what gains would be better, see `twin.station.worker`; in this process, a fixed number of blocks after
        it was asked, unless given. Whoever gives one closes it.

    Raises
    ------
    InputError
        If nothing recorded is of use to the plant's observer, or limits the tuner needs are missing.
    """

    def __init__(
        self,
        plant: Plant,
        channels: tuple[Channel, ...],
        sample_rate_hz: float,
        settings: SessionSettings,
        recorded_commands: dict[int, Command] | None = None,
        tuner: Tuner | None = None,
    ) -> None:
        self.plant, self.settings = plant, settings
        self.channels = channels
        names = tuple(c.name for c in channels)
        self._names = names
        self._frequency = _nominal_hz(plant)
        try:
            self.observer = Observer(plant, names, sample_rate_hz, frequency_hz=self._frequency)
        except ValueError as error:
            raise InputError(str(error)) from error
        sources = self.observer.sources
        model, discrete = driven_model(plant, sources, sample_rate_hz, self._frequency)
        self._parallel = ParallelPlant(DriveReader(sources, names), model, discrete)
        self._parallel_rows = [model.outputs.index(s) for s in self.observer.sensors]

        self._tracker: ExcitationTracker | None = None
        self._balance: AbsorberBalance | None = None
        self._learner: DampingLearner | None = None
        self.retuning: Retuning | None = None
        self._start_learning(names, recorded_commands, tuner)
        self._modelled_damping = self._damping_now()
        self._meter = PerformanceMeter(plant, names)
        self._blocks = 0
        self._control_on: bool | None = None
        self._since_switch = SETTLE_BLOCKS
        self._status = self._health = ""

    def _start_learning(
        self, names: tuple[str, ...], recorded: dict[int, Command] | None, tuner: Tuner | None
    ) -> None:
        try:
            self._balance = AbsorberBalance(self.plant, names)
        except ValueError:
            return
        reference = choose_reference(self.plant, names)
        if reference is None:
            return
        self._tracker = ExcitationTracker(reference, names)
        self._learner = DampingLearner(self.plant, self.settings.learner)
        settings = self.settings
        if settings.loop is not None and tuner is None:
            when = AfterBlocks(settings.retuning.lag_blocks)
            tuner = TunerHere(self.plant, settings.loop, settings.goal, when)
        if tuner is not None and settings.schedule is not None:
            self.retuning = Retuning(settings.schedule, settings.goal, settings.retuning, tuner, recorded)

    @property
    def schedule(self) -> GainSchedule | None:
        """Gains in use at the rig, as far as its blocks tell; None if there is nothing to tune."""
        return self.settings.schedule if self.retuning is None else self.retuning.schedule

    @property
    def commands(self) -> dict[int, Command]:
        """Commands of the run so far, by identifier; of the whole run where a recording is replayed."""
        return {} if self.retuning is None else self.retuning.commands

    def warm_up(self) -> None:
        """Compile and load everything a block needs, on a throwaway twin of this session."""
        twin = Session(self.plant, self.channels, self.observer.sample_rate_hz, SessionSettings())
        n = 64
        values = np.zeros((n, len(self.channels)))
        valid = np.ones(values.shape, dtype=np.bool_)
        valid[0] = False  # both kernels of the observer
        for mask in (valid, np.ones_like(valid)):
            twin.observer.advance(Block(0, twin.observer.sample_rate_hz, values, mask, self.channels))
        twin._parallel.advance(Block(0, twin.observer.sample_rate_hz, values, valid, self.channels))
        if twin._learner is not None:
            twin._learner.warm_up()
        if self.retuning is not None:
            self.retuning.warm_up(self._plant_now())

    def advance(self, block: Block, acknowledgements: tuple[Acknowledgement, ...] = ()) -> Frame:
        """Take one block through the whole chain.

        Parameters
        ----------
        acknowledgements
            What the rig has answered since the last block, for the frame.
        """
        events = self._note_changes(block, acknowledgements)
        self._refresh_model()
        twin = self._parallel.advance(block)[:, self._parallel_rows]
        estimate = self.observer.advance(block)
        self._note_health(block, estimate, events)
        phasors = self._tracker.advance(block) if self._tracker is not None else None
        moved = 0.0
        if phasors is not None:
            moved = phasors.frequency_hz - self._frequency if self._blocks else 0.0
            self._frequency = phasors.frequency_hz
        curve = self._learn(block, phasors, events)
        turn = self._retune(block, phasors, moved, curve)
        events.extend(turn.events)
        performance = self._performance(block, phasors, estimate)
        self._blocks += 1
        return Frame(
            block=block,
            twin=twin,
            estimate=estimate,
            phasors=phasors,
            curve=curve,
            performance=performance,
            proposal=turn.proposal,
            decision=turn.decision,
            command=turn.command,
            acknowledgements=acknowledgements,
            events=tuple(events),
            asked=turn.asked,
            arrival=turn.arrival,
        )

    def _note_changes(self, block: Block, acknowledgements: tuple[Acknowledgement, ...]) -> list[Event]:
        events = []
        first = block.first_sample
        if self.retuning is not None:
            self.retuning.note(block, acknowledgements)
        for answer in acknowledgements:
            if not answer.accepted:
                events.append(Event(first, "error", f"command {answer.command_id} refused: {answer.reason}"))
            elif answer.reason:
                events.append(Event(first, "warning", f"command {answer.command_id}: {answer.reason}"))
        self._since_switch += 1
        if block.control_on is not None and block.control_on != self._control_on:
            if self._control_on is not None or block.control_on:
                events.append(Event(first, "info", f"control {'on' if block.control_on else 'off'}"))
                self._since_switch = 0
            self._control_on = block.control_on
        masked = block.valid.size - int(block.valid.sum())
        if masked:
            names = [c.name for i, c in enumerate(self.channels) if not block.valid[:, i].all()]
            events.append(Event(first, "warning", f"{masked} samples masked in {', '.join(names)}"))
        return events

    def _note_health(self, block: Block, estimate: StateEstimate, events: list[Event]) -> None:
        health = model_health(estimate.nis)
        if health == self._health:
            return
        if self._health or health != "agrees":
            level: Literal["info", "warning"] = "info" if health == "agrees" else "warning"
            ratio = estimate.innovation_rms / estimate.innovation_std
            worst = estimate.sensors[int(np.nanargmax(ratio))] if np.isfinite(ratio).any() else "no sensor"
            text = f"model {health} with the rig (NIS {estimate.nis:.2f}, most in {worst})"
            events.append(Event(block.end_sample - 1, level, text if health != "no data" else "no data"))
        self._health = health

    def _learn(self, block: Block, phasors: Phasors | None, events: list[Event]) -> DampingCurve | None:
        if self._learner is None or self._balance is None:
            return None
        balance = self._balance.solve(phasors) if phasors is not None else None
        objection = ""
        if self._since_switch < SETTLE_BLOCKS:
            objection = "control has just been switched"
        elif not block.valid.all():
            objection = "missing or saturated samples"
        curve = self._learner.advance(balance, block.n_samples / block.sample_rate_hz, objection)
        status = curve.status + (f": {curve.reason}" if curve.reason else "")
        if status != self._status:
            events.append(Event(block.first_sample, "info", f"damping {status}"))
            self._status = status
        return curve

    def _damping_now(self) -> float:
        if self._learner is None:
            return 0.0
        return self._learner.table().at(self._frequency)

    def _plant_now(self) -> Plant:
        absorber = self.plant.absorber
        if self._learner is None or absorber is None:
            return self.plant
        return self.plant.with_damping(absorber.name, self._learner.table())

    def _refresh_model(self) -> None:
        damping = self._damping_now()
        if abs(damping - self._modelled_damping) <= self.settings.model_step_ns_m:
            return
        self._modelled_damping = damping
        plant = self._plant_now()
        model, discrete = driven_model(
            plant, self.observer.sources, self.observer.sample_rate_hz, self._frequency
        )
        self.observer.set_model(plant, model, discrete)
        self._parallel.set_model(discrete)

    def _retune(
        self, block: Block, phasors: Phasors | None, moved_hz: float, curve: DampingCurve | None
    ) -> Turn:
        if self.retuning is None or self._learner is None:
            return Turn()
        amplitude = 0.0
        if phasors is not None:
            amplitude = abs(phasors.amplitude[self._names.index(phasors.reference)])
        return self.retuning.turn(
            block, phasors, amplitude, moved_hz, curve, self._plant_now(), self._learner
        )

    def _performance(
        self, block: Block, phasors: Phasors | None, estimate: StateEstimate
    ) -> Performance | None:
        retuning = self.retuning
        bounds = (math.nan, math.nan) if retuning is None else retuning.bounds_m
        goal = self.settings.goal if retuning is None else retuning.goal
        return self._meter.measure(block, phasors, estimate, bounds, goal.budget_w)

    def configuration(self) -> dict[str, Any]:
        """Settings as plain data, for the recording; `settings_from` reads them back."""
        s = self.settings
        return {
            "loop": None if s.loop is None else asdict(s.loop),
            "goal": asdict(s.goal),
            "schedule": None if s.schedule is None else s.schedule.model_dump(mode="json"),
            "learner": asdict(s.learner),
            "retuning": asdict(s.retuning),
            "model_step_ns_m": s.model_step_ns_m,
        }


def settings_from(configuration: dict[str, Any]) -> SessionSettings:
    """Read what `Session.configuration` wrote.

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
            goal=TuningGoal(**c.pop("goal")),
            learner=LearnerSettings(**c.pop("learner")),
            retuning=RetuningSettings(**c.pop("retuning")),
            **c,
        )
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the recording's configuration cannot be read ({error}); was it made by another version?"
        ) from error


def _nominal_hz(plant: Plant) -> float:
    """Where damping against frequency is read before the excitation is known: the absorber's own tuning."""
    body = plant.absorber or plant.primary
    return math.sqrt(body.stiffness_n_m / body.mass_kg) / math.tau
