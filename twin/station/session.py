"""The only loop: one block in, one frame out, the same for a live rig, a recording and a what-if.

    block -> signal check -> plant in parallel -> observer -> health -> excitation -> damping -> retune
          -> frame (and perhaps a command)

A session owns no clock, no socket and no file. What it decides depends on the blocks and commands it is given and
on nothing else, so that a replay repeats it.
"""

import math
from typing import Any

import numpy as np

from estimators.augmented import UnknownForce
from estimators.damping import DampingLearner
from estimators.health import Health, HealthMonitor
from estimators.observer import Observer
from estimators.signal_check import Finding, SignalCheck
from estimators.types import DampingCurve, Phasors, StateEstimate
from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import GROUND, ForceActuator, Plant
from twin.plant.inputs import DampedModels, DriveReader, InputSource, choose_inputs, driven_model
from twin.plant.parallel import ParallelPlant
from twin.station.audit import SETTLED_1_S, SETTLED_BLOCKS, SETTLED_SHARE, AuditPoint, audit_point
from twin.station.frame import Event, Frame, Performance
from twin.station.identification import SETTLE_BLOCKS, Identification
from twin.station.orders import Order
from twin.station.performance import PerformanceMeter
from twin.station.retuning import Retuning, Turn
from twin.station.settings import SessionSettings, configuration, settings_from
from twin.station.worker import AfterBlocks, Tuner, TunerHere

__all__ = ["Session", "SessionSettings", "settings_from"]

FORCE_STEP_HZ = 0.005
"""The model of an unmeasured force is rebuilt when the excitation has moved this far."""

GRAVITY_M_S2 = 9.81


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
        sources = choose_inputs(plant, names)
        self.observer = Observer(
            plant,
            names,
            sample_rate_hz,
            frequency_hz=self._frequency,
            sources=sources,
            unknown_force=_unknown_force(plant, sources, self._frequency),
        )
        model, discrete = driven_model(plant, sources, sample_rate_hz, self._frequency)
        self._parallel = ParallelPlant(DriveReader(sources, names), model, discrete, self.observer.sensors)
        self._models: DampedModels | None = None
        self._identification = Identification(plant, names, settings)
        self.retuning = self._start_retuning(recorded_commands, tuner)
        self._modelled_damping = self._identification.damping_at(self._frequency)
        self._meter = PerformanceMeter(plant, names)
        self._to_audit: tuple[int, float, Performance, float, float] | None = None
        self._blocks = 0
        self._control_on: bool | None = None
        self._since_switch = SETTLE_BLOCKS
        self._status = ""
        self._health: Health | None = None
        self._masked: tuple[str, ...] = ()
        used = {*self.observer.sensors, *(source.channel for source in sources if source.channel is not None)}
        self._check = SignalCheck(plant, names, sample_rate_hz, used)
        self._monitor = HealthMonitor(channels)

    def _start_retuning(self, recorded: dict[int, Command] | None, tuner: Tuner | None) -> Retuning | None:
        settings = self.settings
        if self.learner is None:
            return None
        if settings.loop is not None and tuner is None:
            when = AfterBlocks(settings.retuning.lag_blocks)
            tuner = TunerHere(self.plant, settings.loop, settings.goal, when)
        if tuner is None or settings.schedule is None:
            return None
        return Retuning(settings.schedule, settings.goal, settings.retuning, tuner, recorded)

    @property
    def learner(self) -> DampingLearner | None:
        """What learns the damping; None if the plant or its channels do not let it."""
        return self._identification.learner

    @property
    def schedule(self) -> GainSchedule | None:
        """Gains in use at the rig, as far as its blocks tell; None if there is nothing to tune."""
        return self.settings.schedule if self.retuning is None else self.retuning.schedule

    @property
    def commands(self) -> dict[int, Command]:
        """Commands of the run so far, by identifier; of the whole run where a recording is replayed."""
        return {} if self.retuning is None else self.retuning.commands

    @property
    def modelled_damping_ns_m(self) -> float:
        """Damping of the absorber in the model that the observer goes by at present."""
        return self._modelled_damping

    @property
    def answers_worked_out(self) -> int | None:
        """Answers of a replay's tuner that were not taken from the recording; None where there is no such tuner."""
        tuner = None if self.retuning is None else self.retuning.tuner
        return tuner.worked_out if isinstance(tuner, TunerHere) else None

    def warm_up(self) -> None:
        """Compile and load everything a block needs, on a throwaway twin of this session."""
        twin = Session(self.plant, self.channels, self.observer.sample_rate_hz, SessionSettings())
        n = 64
        values = np.zeros((n, len(self.channels)))
        valid = np.ones(values.shape, dtype=np.bool_)
        valid[0] = False  # both kernels of the observer
        for mask in (valid, np.ones_like(valid)):
            twin.observer.advance(Block(0, twin.observer.sample_rate_hz, values, mask, self.channels))
        block = Block(0, twin.observer.sample_rate_hz, values, np.ones_like(valid), self.channels)
        twin._parallel.advance(block)
        twin._check.warm_up(block)
        if twin.learner is not None:
            twin.learner.warm_up()
        # And a few blocks as they come, through everything: read-only, whole and with a gap.
        fs, n = twin.observer.sample_rate_hz, 2_000
        t = np.arange(4 * n)[:, None] / fs
        wave = 0.1 * np.sin(2.0 * np.pi * self._frequency * t + np.arange(len(self.channels)))
        wave += 1e-3 * np.sin(1e3 * t * t * fs)  # no two samples alike, as noise has it
        wave[n, :] = np.nan
        for k in range(4):
            twin.advance(make_block(k * n, fs, wave[k * n : (k + 1) * n], self.channels, control_on=False))
        if self.retuning is not None:
            self.retuning.warm_up(self.identified_plant())

    def advance(
        self, block: Block, acknowledgements: tuple[Acknowledgement, ...] = (), order: Order | None = None
    ) -> Frame:
        """Take one block through the whole chain.

        Parameters
        ----------
        acknowledgements
            What the rig has answered since the last block, for the frame.
        order
            The operator's, to take effect after this block.
        """
        events = self._note_changes(block, acknowledgements)
        raw, checked = block, self._check.advance(block)
        block = checked.block
        self._note_masked(block, checked.findings, events)
        self._refresh_model()
        twin = self._parallel.advance(block)
        estimate = self.observer.advance(block)
        health = self._note_health(block, estimate, checked.findings, events)
        tracker = self._identification.tracker
        phasors = tracker.advance(block) if tracker is not None else None
        moved = 0.0
        if phasors is not None:
            moved = phasors.frequency_hz - self._frequency if self._blocks else 0.0
            self._frequency = phasors.frequency_hz
        force = self._follow_force(estimate, phasors)
        curve = self._learn(block, phasors, checked.findings, health, events)
        ordered = None
        if self.retuning is not None:
            ordered = self.retuning.order(block, order, self.identified_plant)
        turn = self._retune(block, phasors, moved, curve, health, force)
        events.extend(turn.events)
        performance = self._performance(block, phasors, estimate)
        audited = self._audit(turn, block, phasors, performance)
        self._blocks += 1
        return Frame(
            block=raw,
            checked=checked,
            twin=twin,
            estimate=estimate,
            health=health,
            phasors=phasors,
            force_n=force,
            curve=curve,
            performance=performance,
            proposal=turn.proposal,
            decision=turn.decision,
            command=turn.command,
            acknowledgements=acknowledgements,
            events=tuple(events),
            asked=turn.asked,
            arrival=turn.arrival,
            audited=audited,
            ordered=ordered,
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
        return events

    def _note_masked(self, block: Block, findings: tuple[Finding, ...], events: list[Event]) -> None:
        masked = tuple(f"{f.channel} ({f.kind})" for f in findings)
        if masked and masked != self._masked:
            count = sum(f.samples for f in findings)
            events.append(
                Event(block.first_sample, "warning", f"{count} samples masked in {', '.join(masked)}")
            )
        self._masked = masked

    def _note_health(
        self, block: Block, estimate: StateEstimate, findings: tuple[Finding, ...], events: list[Event]
    ) -> Health:
        health = self._monitor.advance(block, estimate, findings, self.observer, self._frequency)
        before, self._health = self._health, health
        same = before is not None and (before.verdict, before.channel) == (health.verdict, health.channel)
        if not same and (before is not None or health.verdict != "consistent"):
            sample = block.end_sample - 1
            if health.verdict == "consistent":
                events.append(Event(sample, "info", "model consistent with the rig"))
            else:
                what = {"no data": "no data"}.get(health.verdict, f"model {health.verdict}")
                events.append(Event(sample, "warning", f"{what}: {health.reason}"))
        return health

    def _learn(
        self,
        block: Block,
        phasors: Phasors | None,
        findings: tuple[Finding, ...],
        health: Health,
        events: list[Event],
    ) -> DampingCurve | None:
        curve = self._identification.learn(
            block, phasors, findings, health, self._frequency, self._since_switch
        )
        if curve is None:
            return None
        status = curve.status + (f": {curve.reason}" if curve.reason else "")
        if status != self._status:
            events.append(Event(block.first_sample, "info", f"damping {status}"))
            self._status = status
        return curve

    def damping_std_at(self, frequency_hz: float) -> float:
        """Standard deviation of the learned damping at a frequency [Ns/m]; 0 where none is learned."""
        return self._identification.std_at(frequency_hz)

    def identified_plant(self) -> Plant:
        """Return the plant with the damping in use."""
        return self._identification.plant

    def _follow_force(self, estimate: StateEstimate, phasors: Phasors | None) -> tuple[float, float] | None:
        """Amplitude of an exciting force that nothing measures, and its standard deviation [N]; None if all is."""
        unknown = self.observer.unknown_force
        if unknown is None:
            return None
        found = unknown.amplitude(estimate)
        if phasors is not None and abs(phasors.frequency_hz - unknown.frequency_hz) > FORCE_STEP_HZ:
            self.observer.set_excitation_frequency(phasors.frequency_hz)
        return found

    def _refresh_model(self) -> None:
        damping = self._identification.damping_at(self._frequency)
        if abs(damping - self._modelled_damping) <= self.settings.model_step_ns_m:
            return
        self._modelled_damping = damping
        if self._models is None:
            self._models = DampedModels(self.plant, self.observer.sources, self.observer.sample_rate_hz)
        model, discrete = self._models.at(damping, self._frequency)
        self.observer.set_model(self.identified_plant(), model, discrete)
        self._parallel.set_model(discrete)

    def _retune(
        self,
        block: Block,
        phasors: Phasors | None,
        moved_hz: float,
        curve: DampingCurve | None,
        health: Health,
        force: tuple[float, float] | None,
    ) -> Turn:
        if self.retuning is None or self.learner is None:
            return Turn()
        amplitude = 0.0
        if phasors is not None and force is not None:
            amplitude = force[0]
        elif phasors is not None:
            amplitude = abs(phasors.amplitude[self._names.index(phasors.reference)])
        coil = self.plant.voice_coil
        rms = 0.0
        if coil is not None and coil.name in self._names:
            signal = block.values[:, self._names.index(coil.name)]
            rms = math.sqrt(float(signal @ signal) / max(len(signal), 1))
        return self.retuning.turn(
            block,
            phasors,
            amplitude,
            moved_hz,
            curve,
            self.identified_plant,
            self.learner,
            reference_rms=rms if math.isfinite(rms) else 0.0,
            doubt=health.reason if health.verdict == "diverged" else "",
        )

    def _performance(
        self, block: Block, phasors: Phasors | None, estimate: StateEstimate
    ) -> Performance | None:
        retuning = self.retuning
        bounds = (math.nan, math.nan) if retuning is None else retuning.bounds_m
        goal = self.settings.goal if retuning is None else retuning.goal
        return self._meter.measure(block, phasors, estimate, bounds, goal.budget_w)

    def _audit(
        self, turn: Turn, block: Block, phasors: Phasors | None, performance: Performance | None
    ) -> AuditPoint | None:
        """Hold an answer's promise against the block it was asked at, if settled; keep this block for the next."""
        point, arrival, kept = None, turn.arrival, self._to_audit
        if arrival is not None and arrival.answer is not None and kept is not None:
            answer = arrival.answer
            if answer.promise is not None:
                point = audit_point(answer.promise, answer.promise_std_m, *kept)
        if arrival is not None:
            self._to_audit = None
        retuning = self.retuning
        if turn.asked is None or retuning is None or phasors is None or performance is None:
            return point
        settled = (
            bool(block.control_on)
            and self._since_switch >= SETTLED_BLOCKS
            and retuning.same_for_blocks >= SETTLED_BLOCKS
            and self._meter.absorber_drift_1_s(phasors) < SETTLED_1_S
            and not self._meter.elsewhere(phasors, performance) > SETTLED_SHARE
        )
        if settled:
            noise, rate = self._meter.displacement_std(phasors), self._meter.displacement_rate(phasors)
            self._to_audit = (block.end_sample - 1, phasors.frequency_hz, performance, noise, rate)
        return point

    def configuration(self) -> dict[str, Any]:
        """Settings as plain data, for the recording; `settings_from` reads them back."""
        return configuration(self.settings)


def _unknown_force(
    plant: Plant, sources: tuple[InputSource, ...], frequency_hz: float
) -> UnknownForce | None:
    """The machine's own force where it has an absorber and nothing measures what shakes it."""
    if plant.absorber is None or plant.voice_coil is None:
        return None
    unmeasured = {s.actuator for s in sources if s.channel is None}
    for actuator in plant.actuator:
        if isinstance(actuator, ForceActuator) and actuator.name in unmeasured:
            # About as large as the weight of what it shakes: the filter needs an order of magnitude.
            weight_n = GRAVITY_M_S2 * sum(body.mass_kg for body in plant.body)
            body = next(place for place, _ in actuator.pushes if place != GROUND)
            return UnknownForce(body, frequency_hz, weight_n)
    return None


def _nominal_hz(plant: Plant) -> float:
    """Where damping against frequency is read before the excitation is known: the absorber's own tuning."""
    body = plant.absorber or plant.primary
    return math.sqrt(body.stiffness_n_m / body.mass_kg) / math.tau
