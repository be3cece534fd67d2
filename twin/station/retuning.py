"""What the loop decides about gains: when to ask, which answers still hold, what is worth a command.

Questions go to a `Tuner`; here is only compared and counted. What is decided depends on blocks, commands and the
blocks at which answers came, all of which are recorded, so that a replay repeats it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from estimators.damping import DampingLearner
from estimators.types import DampingCurve, Phasors
from tuning.retune import TuningGoal
from tuning.stability import Instability
from tuning.types import Proposal
from twin.control.schedule import Acknowledgement, Command, Gains, GainSchedule
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.station.advice import Answer, Question
from twin.station.frame import STANDS, UNCHANGED, Decision, Event
from twin.station.orders import Order, Ordered
from twin.station.retuning_rules import COMMAND_LEAD_BLOCKS, ReferenceGrowth, RetuningSettings, StepJudge
from twin.station.worker import Arrival, Tuner

__all__ = ["Retuning", "RetuningSettings", "Standing", "Turn"]

FORGOTTEN_BLOCKS = 20
"""A command that the rig has neither obeyed nor refused after this many blocks is no longer waited for."""

ORDER_LEAD_BLOCKS = 1
"""What the operator orders is due sooner: a block."""

STANDING = 60
"""So many proposals may wait for the operator; the oldest go."""


@dataclass(frozen=True, slots=True)
class Standing:
    """A proposal that may become a command when the operator accepts it."""

    question: Question
    proposal: Proposal
    steps: Mapping[int, Gains]


@dataclass(frozen=True, slots=True)
class Turn:
    """What one block brought: a question asked, an answer taken, a decision made."""

    asked: int | None = None
    arrival: Arrival | None = None
    proposal: Proposal | None = None
    decision: Decision | None = None
    command: Command | None = None
    events: tuple[Event, ...] = ()


class Retuning:
    """Keeps the schedule in use and decides about the next one.

    Parameters
    ----------
    schedule
        The one the rig starts with.
    recorded
        Commands of the run that is being replayed; None in a run of its own.

    Attributes
    ----------
    schedule
        In use at the rig, as far as its blocks tell.
    bounds_m
        Motion without control and the physical limit at the excitation [m], of the last answer.
    goal
        What is asked of the tuner; may be changed between blocks.
    same_for_blocks
        Blocks since the gains in use last changed.
    outdated
        Proposals dropped because the model or the schedule had moved on.
    approve
        Whether proposals wait for the operator; begins as the settings say and holds once the operator took gains back.
    standing
        By number of the question, those that wait.
    """

    def __init__(
        self,
        schedule: GainSchedule,
        goal: TuningGoal,
        settings: RetuningSettings,
        tuner: Tuner,
        recorded: dict[int, Command] | None,
    ) -> None:
        self.schedule, self.goal, self.settings = schedule, goal, settings
        self.tuner = tuner
        self.commands = dict(recorded or {})
        self.bounds_m = (float("nan"), float("nan"))
        self.outdated = 0
        self.answer: Answer | None = None
        self.approve = settings.approve
        self.standing: dict[int, Standing] = {}
        self._before: list[tuple[GainSchedule, TuningGoal]] = []
        self._goal_in_use = goal
        self._ramp: list[GainSchedule] = []
        self._ramp_length = self._reverting = 0
        self._in_ramp = False
        self._replaying = recorded is not None
        self._promises: dict[int, Plant] = {}
        self._promised_by: Plant | None = None
        self._next_command = self._next_question = 1
        self._since_question = settings.every_blocks
        self.same_for_blocks = 0
        self._on_its_way: int | None = None
        self._way_blocks = 0
        self._open: Question | None = None
        self._judge = StepJudge(settings)
        self._unstable: Instability | None = None
        self._growth = ReferenceGrowth()

    def warm_up(self, plant: Plant) -> None:
        """Make the tuner ready; may take seconds."""
        middle = self.schedule.frequency_hz[len(self.schedule.frequency_hz) // 2]
        self.tuner.warm_up(self._question(0, plant, 0.1, middle, 1.0, 0.0, propose=True))

    def note(self, block: Block, acknowledgements: tuple[Acknowledgement, ...]) -> None:
        """Take in what the rig says it has done."""
        self._way_blocks += 1
        self.same_for_blocks += 1
        refused = {a.command_id for a in acknowledgements if not a.accepted}
        for number in block.commands_applied:
            command = self.commands.get(number)
            if command is not None and command.schedule is not None:
                self._keep_for_reverting(number, command.schedule)
                self.schedule = command.schedule
                self.same_for_blocks = 0
                self._promised_by = self._promises.pop(number, None)
        known = self._on_its_way
        if known in refused:
            self._ramp = []
        if known in refused or known in block.commands_applied or self._way_blocks > FORGOTTEN_BLOCKS:
            self._on_its_way = None

    def turn(
        self,
        block: Block,
        phasors: Phasors | None,
        amplitude: float,
        moved_hz: float,
        curve: DampingCurve | None,
        plant: Callable[[], Plant],
        learner: DampingLearner,
        reference_rms: float = 0.0,
        doubt: str = "",
    ) -> Turn:
        """Take an answer if one has come, decide about it, and ask the next question if it is time.

        Parameters
        ----------
        amplitude
            Peak of the excitation.
        moved_hz
            How far the excitation moved over this block [Hz].
        plant
            Gives the plant as identified.
        reference_rms
            Root mean square of the coil's current reference over the block [A]; 0 if it is not recorded.
        doubt
            Why the model must not be relied on at present; nothing is proposed then.
        """
        last = block.end_sample - 1
        self._growth.add(reference_rms, block.n_samples / block.sample_rate_hz)
        arrival = self.tuner.take(last)
        done = Turn() if arrival is None else self._decide(block, arrival, plant(), doubt)
        self._since_question += 1
        asked = None
        if (
            phasors is not None
            and curve is not None
            and self._since_question >= self.settings.every_blocks
            and self._on_its_way is None
            and self.tuner.ready(last)
        ):
            f, ahead = phasors.frequency_hz, self.settings.look_ahead_hz(moved_hz)
            std = learner.std_at(f)
            propose = (
                not doubt and curve.status != "unestimated" and self._is_near(f, ahead) and self._is_wanted()
            )
            self._open = self._question(last, plant(), std, f, amplitude, ahead, propose=propose)
            self.tuner.ask(self._open)
            asked = self._next_question
            self._next_question += 1
            self._since_question = 0
        return Turn(asked, arrival, done.proposal, done.decision, done.command, done.events)

    def _is_wanted(self) -> bool:
        settings = self.settings
        if not settings.only_if_unstable:
            return True
        wanted = settings.only_if_growing_1_s
        seen = wanted <= 0.0 or self._growth.rate_1_s >= wanted
        return self._unstable is not None and seen

    def _question(
        self,
        sample: int,
        plant: Plant,
        std: float,
        frequency: float,
        amplitude: float,
        ahead: float,
        *,
        propose: bool,
    ) -> Question:
        return Question(
            number=self._next_question,
            sample=sample,
            goal=self.goal,
            plant=plant,
            damping_std_ns_m=std,
            excitation_hz=frequency,
            amplitude=amplitude,
            ahead_hz=ahead,
            schedule=self.schedule,
            propose=propose,
            longest_step=self.settings.longest_step,
            promised_by=self._promised_by,
        )

    def _decide(self, block: Block, arrival: Arrival, plant: Plant, doubt: str) -> Turn:
        last = block.end_sample - 1
        question, self._open = self._open, None
        answer = arrival.answer
        if answer is None or question is None:
            return Turn(events=(Event(last, "error", f"retuning: {arrival.trouble}"),))
        events: list[Event] = []
        self.answer = answer
        self.bounds_m = (answer.passive_m, answer.limit_m)
        if answer.unstable is not None and self._unstable is None:
            events.append(Event(last, "warning", answer.unstable.explanation))
        self._unstable = answer.unstable
        proposal = answer.proposal
        if proposal is None:
            return Turn(events=tuple(events))
        if proposal.reason:
            events.append(Event(last, "warning", f"retuning: {proposal.reason}"))
        infeasible = "" if proposal.feasible else proposal.reason
        verdict = doubt or infeasible or self._outdated(question, proposal, plant)
        steps: dict[int, Gains] = {}
        if not verdict:
            steps = {
                row: gains
                for row, gains in answer.steps
                if self._judge.is_worth_it(self.schedule, row, gains)
            }
            verdict = "" if steps else UNCHANGED
        if not verdict and (self._on_its_way is not None or self._ramp):
            verdict = "outdated: the operator's command is on its way"
        if not verdict and self.approve:
            self.standing[answer.number] = Standing(question, proposal, steps)
            for number in list(self.standing)[:-STANDING]:
                del self.standing[number]
            verdict = STANDS
        if verdict:
            return Turn(
                proposal=proposal,
                decision=Decision(last, False, "automatic", verdict),
                events=tuple(events),
            )
        schedule = self.schedule.with_points(steps)
        command = self._command(block, COMMAND_LEAD_BLOCKS, schedule, question.plant)
        self._judge.taken(self.schedule, steps)
        decision = Decision(last, True, "automatic", "verified and better")
        return Turn(proposal=proposal, decision=decision, command=command, events=tuple(events))

    def order(self, block: Block, order: Order | None, plant: Callable[[], Plant]) -> Ordered | None:
        """Take an order of the operator after a block, or the next step of the last one.

        Parameters
        ----------
        plant
            Gives the plant as identified.
        """
        last = block.end_sample - 1
        if order is None:
            if not self._ramp or self._on_its_way is not None:
                return None
            further = self._command(block, ORDER_LEAD_BLOCKS, self._ramp.pop(0), plant())
            step = f"step {self._ramp_length - len(self._ramp)} of {self._ramp_length}"
            return Ordered(None, Decision(last, True, "operator", step), further)
        command: Command | None = None
        words = ""
        match order.kind:
            case "off" | "on":
                command = self._switch(block, order)
                words = "emergency: control off" if order.kind == "off" else "control on"
            case "found":
                self._forget(order.schedules)
                words = "the rig began anew with its own gains"
            case _ if self._on_its_way is not None or self._ramp:
                words = "refused: another command is on its way; wait for the rig's answer"
            case "accept":
                command, words = self._accept(block, order.number, plant())
            case "schedule" if order.schedules:
                self._ramp, self._ramp_length = list(order.schedules), len(order.schedules)
                self.goal = order.goal or self.goal
                command = self._command(block, ORDER_LEAD_BLOCKS, self._ramp.pop(0), plant())
                words = "what-if accepted" + (f", step 1 of {self._ramp_length}" if self._ramp else "")
            case "revert" if self._before:
                schedule, self.goal = self._before.pop()
                self.approve = True
                command = self._command(block, ORDER_LEAD_BLOCKS, schedule, plant())
                self._reverting = command.command_id
                words = "back to the gains before"
            case _:
                words = "refused: there is nothing to go back to"
        words += f" ({order.note})" if order.note else ""
        taken = command is not None or order.kind == "found"
        return Ordered(order, Decision(last, taken, "operator", words), command)

    def _accept(self, block: Block, number: int, plant: Plant) -> tuple[Command | None, str]:
        standing = self.standing.get(number)
        if standing is None:
            return None, f"refused: proposal {number} no longer stands"
        verdict = self._outdated(standing.question, standing.proposal, plant)
        if verdict:
            return None, f"refused: {verdict}"
        self.standing.clear()
        schedule = self.schedule.with_points(dict(standing.steps))
        self._judge.taken(self.schedule, standing.steps)
        command = self._command(block, ORDER_LEAD_BLOCKS, schedule, standing.question.plant)
        return command, f"proposal {number} accepted"

    def _switch(self, block: Block, order: Order) -> Command:
        off = order.kind == "off"
        number = order.command_id or self._next_command
        self._next_command = max(self._next_command, number + 1)
        lead = 0 if off else ORDER_LEAD_BLOCKS
        command = Command(
            command_id=number,
            apply_at_sample=0 if off else block.end_sample + lead * block.n_samples,
            control_enabled=not off,
        )
        if off:
            self._ramp, self._on_its_way = [], None  # nothing that was meant for a running controller follows
        if not self._replaying:
            self.commands[number] = command
        return command

    def _forget(self, schedules: tuple[GainSchedule, ...]) -> None:
        """Begin anew with the rig's own gains."""
        if schedules:
            self.schedule = schedules[-1]
        self.same_for_blocks, self._on_its_way, self._ramp = 0, None, []
        self._promised_by = None
        self._promises.clear()
        self._before.clear()
        self.standing.clear()

    def _command(self, block: Block, lead_blocks: int, schedule: GainSchedule, promised_by: Plant) -> Command:
        command = Command(
            command_id=self._next_command,
            apply_at_sample=block.end_sample + lead_blocks * block.n_samples,
            schedule=schedule,
        )
        self._next_command += 1
        self._on_its_way, self._way_blocks = command.command_id, 0
        self._promises[command.command_id] = promised_by
        if not self._replaying:
            self.commands[command.command_id] = command
        return command

    @property
    def next_command(self) -> int:
        """Number of the command after the last."""
        return self._next_command

    @property
    def can_revert(self) -> bool:
        """Whether there are gains to go back to."""
        return bool(self._before)

    def _keep_for_reverting(self, number: int, schedule: GainSchedule) -> None:
        if schedule != self.schedule and number != self._reverting and not self._in_ramp:
            self._before = [*self._before[-19:], (self.schedule, self._goal_in_use)]
        self._in_ramp = bool(self._ramp)
        self._goal_in_use = self.goal

    def _outdated(self, question: Question, proposal: Proposal, plant: Plant) -> str:
        """Why a proposal no longer fits; empty if it does."""
        reason = ""
        before, now = question.plant.absorber, plant.absorber
        if question.schedule != self.schedule:
            reason = "outdated: the gains in use have changed since it was asked for"
        elif question.goal != self.goal:
            reason = "outdated: the goal has changed since it was asked for"
        elif before is not None and now is not None:
            moved = max(
                (abs(now.damping_at(p.frequency_hz) - before.damping_at(p.frequency_hz)))
                for _, p in proposal.points
            )
            if moved > self.settings.outdated_ns_m:
                reason = f"outdated: the damping has moved by {moved:.2f} Ns/m since it was asked for"
        self.outdated += bool(reason)
        return reason

    def _is_near(self, frequency: float, ahead: float) -> bool:
        low, high = sorted((frequency, frequency + ahead))
        table, reach = self.schedule.frequency_hz, self.goal.reach_hz
        return low - reach <= table[-1] and table[0] <= high + reach
