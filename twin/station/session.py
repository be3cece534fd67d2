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
from tuning.loop import LoopFacts, RigModel
from tuning.retune import Retuner, TuningGoal
from tuning.types import Powers, Proposal
from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant, VoiceCoil
from twin.plant.errors import InputError, RunError
from twin.plant.inputs import DriveReader, driven_model
from twin.plant.parallel import ParallelPlant
from twin.station.frame import UNCHANGED, Decision, Event, Frame, Performance

COMMAND_LEAD_BLOCKS = 2
"""A command is due this many blocks after the one that led to it: time for it to reach the rig."""

MAX_AHEAD_HZ = 3.0
"""A jump of the excitation is no sweep: no more of the table than this is retuned ahead of it."""

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
    retune_every_blocks
        How often proposals are made.
    model_step_ns_m
        The model is rebuilt when the damping in use has moved this far since.
    min_change
        A proposal is worth a command if a gain moves by this share of the largest in the table.
    """

    loop: LoopFacts | None = None
    schedule: GainSchedule | None = None
    goal: TuningGoal = field(default_factory=TuningGoal)
    learner: LearnerSettings = field(default_factory=LearnerSettings)
    retune_every_blocks: int = 5
    model_step_ns_m: float = 0.02
    min_change: float = 2e-3


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
        self._retuner: Retuner | None = None
        self._start_learning(names)
        self._modelled_damping = self._damping_now()
        self.schedule = settings.schedule
        self.commands: dict[int, Command] = dict(recorded_commands or {})
        self._replaying = recorded_commands is not None
        self._next_command = 1
        self._blocks = 0
        self._ahead_hz = 0.0
        self._control_on: bool | None = None
        self._since_switch = SETTLE_BLOCKS
        self._status = self._health = ""
        self._passive_and_limit = (math.nan, math.nan)

    def _start_learning(self, names: tuple[str, ...]) -> None:
        try:
            self._balance = AbsorberBalance(self.plant, names)
        except ValueError:
            return
        reference = choose_reference(self.plant, names)
        if reference is None:
            return
        self._tracker = ExcitationTracker(reference, names)
        self._learner = DampingLearner(self.plant, self.settings.learner)
        if self.settings.loop is not None:
            self._retuner = Retuner(self.plant, self.settings.loop, self.settings.goal)

    def warm_up(self) -> None:
        """Compile and load everything a block needs, on a throwaway twin of this session."""
        twin = Session(self.plant, self.channels, self.observer.sample_rate_hz, self.settings)
        n = 64
        values = np.zeros((n, len(self.channels)))
        valid = np.ones(values.shape, dtype=np.bool_)
        valid[0] = False  # both kernels of the observer
        for mask in (valid, np.ones_like(valid)):
            twin.observer.advance(Block(0, twin.observer.sample_rate_hz, values, mask, self.channels))
        twin._parallel.advance(Block(0, twin.observer.sample_rate_hz, values, valid, self.channels))
        if twin._learner is not None:
            twin._learner.warm_up()
        if twin._retuner is not None and twin.schedule is not None:
            middle = twin.schedule.frequency_hz[len(twin.schedule.frequency_hz) // 2]
            twin._retuner.propose(0, twin._plant_now(), 0.1, middle, 1.0, twin.schedule)

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
        if phasors is not None:
            if self._blocks:
                self._ahead_hz = self._look_ahead(phasors.frequency_hz - self._frequency)
            self._frequency = phasors.frequency_hz
        curve = self._learn(block, phasors, events)
        proposal, decision, command = self._retune(block, phasors, curve, events)
        performance = self._performance(block, phasors, estimate)
        self._blocks += 1
        return Frame(
            block=block,
            twin=twin,
            estimate=estimate,
            phasors=phasors,
            curve=curve,
            performance=performance,
            proposal=proposal,
            decision=decision,
            command=command,
            acknowledgements=acknowledgements,
            events=tuple(events),
        )

    def _note_changes(self, block: Block, acknowledgements: tuple[Acknowledgement, ...]) -> list[Event]:
        events = []
        first = block.first_sample
        for number in block.commands_applied:
            command = self.commands.get(number)
            if command is not None and command.schedule is not None:
                self.schedule = command.schedule
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
        self, block: Block, phasors: Phasors | None, curve: DampingCurve | None, events: list[Event]
    ) -> tuple[Proposal | None, Decision | None, Command | None]:
        retuner, learner, schedule = self._retuner, self._learner, self.schedule
        if retuner is None or learner is None or schedule is None or phasors is None or curve is None:
            return None, None, None
        if self._blocks % self.settings.retune_every_blocks:
            return None, None, None
        plant, f = self._plant_now(), phasors.frequency_hz
        amplitude = abs(phasors.amplitude[self._names.index(phasors.reference)])
        self._passive_and_limit = self._bounds(retuner, plant, f, amplitude)
        reach = self.settings.goal.reach_hz
        low, high = sorted((f, f + self._ahead_hz))
        near = low - reach <= schedule.frequency_hz[-1] and schedule.frequency_hz[0] <= high + reach
        if curve.status == "unestimated" or not near:
            return None, None, None
        last = block.end_sample - 1
        proposal = retuner.propose(last, plant, learner.std_at(f), f, amplitude, schedule, self._ahead_hz)
        if proposal.reason:
            events.append(Event(last, "warning", f"retuning: {proposal.reason}"))
        if not proposal.feasible:
            return proposal, Decision(last, False, "automatic", proposal.reason), None
        points = {row: point.gains for row, point in proposal.points}
        if not self._worth_it(schedule, proposal):
            return proposal, Decision(last, False, "automatic", UNCHANGED), None
        command = Command(
            command_id=self._next_command,
            apply_at_sample=block.end_sample + COMMAND_LEAD_BLOCKS * block.n_samples,
            schedule=schedule.with_points(points),
        )
        self._next_command += 1
        if not self._replaying:
            self.commands[command.command_id] = command
        return proposal, Decision(last, True, "automatic", "verified and better"), command

    def _look_ahead(self, moved_hz: float) -> float:
        """How far the excitation moves until the proposal after this one takes effect [Hz]."""
        blocks = self.settings.retune_every_blocks + COMMAND_LEAD_BLOCKS + 1
        return min(max(moved_hz * blocks, -MAX_AHEAD_HZ), MAX_AHEAD_HZ)

    def _worth_it(self, schedule: GainSchedule, proposal: Proposal) -> bool:
        columns = ("alpha_kg", "beta_ns_m", "gamma_n_m")
        sizes = [max(map(abs, getattr(schedule, c))) or 1.0 for c in columns]
        return any(
            abs(getattr(point.gains, c) - getattr(schedule, c)[row]) > self.settings.min_change * size
            for row, point in proposal.points
            for c, size in zip(columns, sizes, strict=True)
        )

    def _bounds(self, retuner: Retuner, plant: Plant, f: float, amplitude: float) -> tuple[float, float]:
        """Motion without control and the physical limit at the excitation [m]."""
        passive = abs(RigModel(plant, retuner.facts, f).response(f)[0, 0, 1]) * amplitude
        try:
            return passive, retuner.limit_at(plant, f, amplitude).displacement_m
        except RunError:
            return passive, math.nan

    def _performance(
        self, block: Block, phasors: Phasors | None, estimate: StateEstimate
    ) -> Performance | None:
        coil = self.plant.voice_coil
        if coil is None or phasors is None:
            return None
        passive, limit = self._passive_and_limit
        current = _current_of(coil, estimate)
        return Performance(
            displacement_m=self._displacement(phasors),
            passive_m=passive,
            limit_m=limit,
            current_peak_a=float(np.max(np.abs(current))) if current is not None else math.nan,
            powers=_powers(coil, current, estimate, block),
            budget_w=self.settings.goal.budget_w,
        )

    def _displacement(self, phasors: Phasors) -> float:
        """Peak displacement of the primary body at the excitation [m], from its acceleration."""
        for sensor in self.plant.sensor:
            if sensor.name in self._names and sensor.of == self.plant.primary.name:
                order = {"displacement": 0, "velocity": 1, "acceleration": 2}.get(sensor.kind)
                if order is not None:
                    a = abs(phasors.amplitude[self._names.index(sensor.name)])
                    return float(a / (math.tau * phasors.frequency_hz) ** order)
        return math.nan

    def configuration(self) -> dict[str, Any]:
        """Settings as plain data, for the recording; `settings_from` reads them back."""
        s = self.settings
        return {
            "loop": None if s.loop is None else asdict(s.loop),
            "goal": asdict(s.goal),
            "schedule": None if s.schedule is None else s.schedule.model_dump(mode="json"),
            "learner": asdict(s.learner),
            "retune_every_blocks": s.retune_every_blocks,
            "model_step_ns_m": s.model_step_ns_m,
            "min_change": s.min_change,
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
        return SessionSettings(
            loop=None if loop is None else LoopFacts(**loop),
            schedule=None if schedule is None else GainSchedule.model_validate(schedule, strict=False),
            goal=TuningGoal(**c.pop("goal")),
            learner=LearnerSettings(**c.pop("learner")),
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


def _current_of(coil: VoiceCoil, estimate: StateEstimate) -> np.ndarray | None:
    name = f"i_{coil.name}"
    return estimate.mean[:, estimate.states.index(name)] if name in estimate.states else None


def _powers(coil: VoiceCoil, current: np.ndarray | None, estimate: StateEstimate, block: Block) -> Powers:
    """Powers over a block from the estimated states: v i = R i² + d/dt(L i²/2) + k i (v2 - v1)."""
    if current is None or coil.between is None:
        return Powers(math.nan, math.nan, math.nan)
    velocity = {b: estimate.mean[:, estimate.states.index(f"v_{b}")] for b in coil.between}
    first, second = coil.between
    joule = coil.resistance_ohm * current**2
    stored = 0.5 * coil.inductance_h * (current[-1] ** 2 - current[0] ** 2)
    mechanical = coil.force_constant_n_a * np.mean(current * (velocity[second] - velocity[first]))
    return Powers(
        joule_mean_w=float(np.mean(joule)),
        joule_peak_w=float(np.max(joule)),
        electrical_mean_w=float(
            np.mean(joule) + mechanical + stored * block.sample_rate_hz / max(block.n_samples - 1, 1)
        ),
    )
