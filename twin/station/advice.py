"""What the loop asks about retuning, and the answer: plain data in, plain data out, wherever it is worked out.

An adviser's answers depend on the questions it was asked and on nothing else, so that a replay that asks the same
questions gets the same answers to the bit, in this process or another.
"""

import math
from dataclasses import dataclass

import numpy as np

from tuning.loop import LoopFacts, RigModel
from tuning.retune import Prediction, Retuner, TuningGoal, predict
from tuning.stability import Instability, StabilityWatch
from tuning.step import Stepper
from tuning.types import Proposal
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import RunError


@dataclass(frozen=True, slots=True)
class Question:
    """One question of the loop.

    Attributes
    ----------
    number
        Counts up from 1 within a run.
    sample
        Last sample the model has seen.
    goal
        Budget and margins.
    plant
        As identified, the damping in use included.
    damping_std_ns_m
        Standard deviation of its damping at the excitation [Ns/m].
    excitation_hz, amplitude
        Of the excitation; amplitude is its peak in the exciting actuator's unit.
    ahead_hz
        How far the excitation will have moved when the next proposal could take effect [Hz].
    schedule
        In use.
    propose
        False asks for motion without control and the limit alone.
    longest_step
        How far any gain may move at once, as a share of the absorber's stiffness.
    promised_by
        Model behind the gains in use, for the audit; None if they were not proposed.
    """

    number: int
    sample: int
    goal: TuningGoal
    plant: Plant
    damping_std_ns_m: float
    excitation_hz: float
    amplitude: float
    ahead_hz: float
    schedule: GainSchedule
    propose: bool
    longest_step: float
    promised_by: Plant | None


@dataclass(frozen=True, slots=True)
class Answer:
    """What came of a question.

    Attributes
    ----------
    passive_m, limit_m
        Motion of the primary without control, and the least any linear controller can reach [m]; NaN if unknown.
    proposal
        None if none was asked for.
    steps
        (row of the table, gains to deploy): the proposal's, or a verified step towards them.
    promise
        Steady state of the gains in use at the question's excitation, by the model that proposed them.
    promise_std_m
        How far its displacement is off with the damping one standard deviation off [m].
    unstable
        Where the gains in use are unstable near the excitation, if they are.
    """

    number: int
    passive_m: float = math.nan
    limit_m: float = math.nan
    proposal: Proposal | None = None
    steps: tuple[tuple[int, Gains], ...] = ()
    promise: Prediction | None = None
    promise_std_m: float = math.nan
    unstable: Instability | None = None


class Adviser:
    """Works out answers, one after the other.

    Parameters
    ----------
    plant
        The model to start from; its limits are kept.
    facts
        Sampling and delay of the rig's loop.
    goal
        The one to prepare for; questions may come with others.

    Raises
    ------
    InputError
        If limits the tuner needs are missing.
    """

    def __init__(self, plant: Plant, facts: LoopFacts, goal: TuningGoal) -> None:
        self._plant, self._facts = plant, facts
        self._retuners = {goal: Retuner(plant, facts, goal)}
        self._watch = StabilityWatch(facts)

    def answer(self, question: Question) -> Answer:
        """Answer one question; a limit that cannot be computed is NaN, not an error."""
        q, facts = question, self._facts
        retuner = self._retuner(q.goal)
        model = RigModel(q.plant, facts, q.excitation_hz)
        passive = abs(model.response(q.excitation_hz)[0, 0, 1]) * q.amplitude
        try:
            limit = retuner.limit_at(q.plant, q.excitation_hz, q.amplitude).displacement_m
        except RunError:
            limit = math.nan
        promise, promise_std = self._promise(q)
        unstable = None
        if q.schedule.acts_at(q.excitation_hz):
            low, high = sorted((q.excitation_hz, q.excitation_hz + q.ahead_hz))
            unstable = self._watch.look(q.plant, q.schedule, low - 0.5, high + 0.5)
        proposal: Proposal | None = None
        steps: tuple[tuple[int, Gains], ...] = ()
        if q.propose:
            proposal = retuner.propose(
                q.sample, q.plant, q.damping_std_ns_m, q.excitation_hz, q.amplitude, q.schedule, q.ahead_hz
            )
            steps = self._steps(q, proposal)
        return Answer(q.number, float(passive), limit, proposal, steps, promise, promise_std, unstable)

    def _retuner(self, goal: TuningGoal) -> Retuner:
        if goal not in self._retuners:
            self._retuners[goal] = Retuner(self._plant, self._facts, goal)
        return self._retuners[goal]

    def _steps(self, q: Question, proposal: Proposal) -> tuple[tuple[int, Gains], ...]:
        absorber = q.plant.absorber
        longest = q.longest_step * absorber.stiffness_n_m if absorber is not None else math.inf
        stepper = Stepper(q.plant, self._facts, q.damping_std_ns_m, q.amplitude)
        return tuple(
            (row, stepper.limited(q.schedule.at(point.frequency_hz), point, longest))
            for row, point in proposal.points
        )

    def _promise(self, q: Question) -> tuple[Prediction | None, float]:
        plant = q.promised_by
        if plant is None or plant.absorber is None or not q.schedule.acts_at(q.excitation_hz):
            return None, math.nan
        f, gains = q.excitation_hz, q.schedule.at(q.excitation_hz)
        damping = plant.absorber.damping_at(f)
        off = damping + max(q.damping_std_ns_m, 1e-3) * np.array([0.0, 1.0])
        promise, beside = (
            predict(RigModel(plant, self._facts, f, float(c)), gains, f, q.amplitude) for c in off
        )
        return promise, abs(beside.displacement_m - promise.displacement_m)
