"""Where retuning is worked out: beside the loop in a process of its own, or in this one, block-exact either way.

The loop hands over a question and takes the answer at a later block. When that is, is the only thing in which the
ways differ, and it is recorded: a replay takes every answer at the block at which the run took it.

- ``TunerProcess(lag_blocks=None)``: a live rig. An answer is taken when it is there; the loop never waits.
- ``TunerProcess(lag_blocks=n)`` and ``TunerHere(AfterBlocks(n))``: runs that can wait for the twin. The answer to a
  question of block k is taken at block k + n, whatever the machine does meanwhile.
- ``TunerHere(AsRecorded(...))``: a replay. Recorded answers to the very same questions are taken as they are.
"""

import contextlib
import copy
import json
import multiprocessing
import os
import signal
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol

from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.station.advice import Adviser, Answer, Question
from twin.station.answers import NOTHING_KNOWN, KnownAnswers, chain, chain_begin

START_TIMEOUT_S = 120.0
ANSWER_TIMEOUT_S = 60.0
OVERDUE_BLOCKS = 100
"""A live loop gives up an answer after so many blocks and starts the worker anew."""

MOST_RESTARTS = 3


@dataclass(frozen=True, slots=True)
class Arrival:
    """What the loop took at a block: an answer, or the news that there will be none (``trouble`` says why).

    ``chain`` is the fingerprint of the question and those before it, see `twin.station.answers`.
    """

    number: int
    answer: Answer | None
    trouble: str = ""
    chain: str = ""


class Tuner(Protocol):
    """What the loop sees of retuning."""

    def warm_up(self, question: Question) -> None:
        """Make everything ready that the first answer needs; may take seconds."""

    def ready(self, sample: int) -> bool:
        """Whether a question may be asked at a block's last sample."""

    def ask(self, question: Question) -> None:
        """Hand a question over; returns at once."""

    def take(self, sample: int) -> Arrival | None:
        """What has come by a block's last sample; called once per block, before `ask`."""

    def close(self) -> None:
        """End it; calling it twice does nothing."""


class When(Protocol):
    """When an answer that is worked out here is taken."""

    def may_ask(self, number: int, sample: int) -> bool:
        """Whether question ``number`` is asked at this sample."""

    def due(self, number: int, blocks: int, sample: int) -> str | None:
        """None: not yet. Else the reason why the answer is lost; empty if it is taken now."""


@dataclass(frozen=True, slots=True)
class AfterBlocks:
    """Answers are taken a fixed number of blocks after the question."""

    lag_blocks: int

    def may_ask(self, number: int, sample: int) -> bool:
        """Questions may be asked at any time."""
        return True

    def due(self, number: int, blocks: int, sample: int) -> str | None:
        """Taken once the blocks have passed."""
        return "" if blocks >= self.lag_blocks else None


@dataclass(frozen=True, slots=True)
class AsRecorded:
    """Questions and answers at the samples at which a recorded run asked and took them.

    Attributes
    ----------
    asked
        Sample by question's number.
    taken
        (sample, why there was no answer or an empty string) by question's number.
    """

    asked: Mapping[int, int]
    taken: Mapping[int, tuple[int, str]]

    def may_ask(self, number: int, sample: int) -> bool:
        """A worker may have been busy: only what was asked then is asked now."""
        return self.asked.get(number, sample + 1) <= sample

    def due(self, number: int, blocks: int, sample: int) -> str | None:
        """Taken, or lost, when it was."""
        at, trouble = self.taken.get(number, (sample + 1, ""))
        return trouble if at <= sample else None


def as_recorded(
    questions: Iterable[tuple[int, str]], answers: Iterable[tuple[int, str]]
) -> AsRecorded | None:
    """Read when a recorded run asked and took, from its notes; None if it has none.

    Parameters
    ----------
    questions, answers
        (sample, JSON) of the notes ``questions`` and ``answers``.
    """
    asked = {int(json.loads(text)["number"]): sample for sample, text in questions}
    told = [(sample, json.loads(text)) for sample, text in answers]
    taken = {int(a["number"]): (sample, str(a["trouble"])) for sample, a in told}
    return AsRecorded(asked, taken) if asked else None


class TunerHere:
    """Works answers out in this process, at the block they are due: the loop waits, for data that can.

    Parameters
    ----------
    plant, facts, goal
        See `Adviser`.
    when
        At which blocks.
    known
        Answers of the run that is being replayed; what is among them is not worked out again.

    Attributes
    ----------
    worked_out
        Answers that were.

    Raises
    ------
    InputError
        If limits the tuner needs are missing.
    """

    def __init__(
        self,
        plant: Plant,
        facts: LoopFacts,
        goal: TuningGoal,
        when: When,
        known: KnownAnswers = NOTHING_KNOWN,
    ) -> None:
        self._order = (plant, facts, goal)
        self._adviser = self._fresh()
        self._when, self._known = when, known
        self._worked: dict[str, Answer] = {}
        self._begin = self._chain = chain_begin(plant, facts, goal)
        self._heard: list[Question] = []
        self._behind = 0
        self._open: Question | None = None
        self._blocks = 0
        self._asked = 0
        self.worked_out = 0

    def _fresh(self) -> Adviser:
        return Adviser(*self._order)

    def warm_up(self, question: Question) -> None:
        """Answer a question on a throwaway adviser, unless the answers are known."""
        if not self._known.by_chain:
            self._fresh().answer(question)

    def ready(self, sample: int) -> bool:
        """Whether no question is open and the run asked one here."""
        return self._open is None and self._when.may_ask(self._asked + 1, sample)

    def ask(self, question: Question) -> None:
        """Keep the question until its block."""
        self._open, self._blocks, self._asked = question, 0, question.number
        self._chain = chain(self._chain, question)

    def take(self, sample: int) -> Arrival | None:
        """Work the answer out, if its block has come."""
        question = self._open
        if question is None:
            return None
        self._blocks += 1
        trouble = self._when.due(question.number, self._blocks, sample)
        if trouble is None:
            return None
        self._open, asked = None, self._chain
        answer = None
        if not trouble:
            answer = self._known.get(asked) or self._worked.get(asked)
            if answer is None:
                answer, trouble = self._work_out(question)
            self._heard.append(question)
        if answer is None:
            self._adviser = self._fresh()  # as a worker that is started anew it remembers nothing
            self._chain, self._heard, self._behind = self._begin, [], 0
        else:
            self._worked[asked] = answer
        return Arrival(question.number, answer, trouble, asked)

    def _work_out(self, question: Question) -> tuple[Answer | None, str]:
        # An adviser remembers what it was asked: what it did not hear of is made up for first.
        for before in self._heard[self._behind :]:
            _answer(self._adviser, before)
        self._behind = len(self._heard) + 1
        self.worked_out += 1
        return _answer(self._adviser, question)

    def __deepcopy__(self, memo: dict[int, Any]) -> "TunerHere":
        """A tuner that goes on from here by itself; its adviser hears of what was asked only if it is needed."""
        twin = copy.copy(self)
        twin._adviser, twin._behind, twin._heard = self._fresh(), 0, list(self._heard)
        return twin

    def close(self) -> None:
        """Nothing to end."""


class TunerProcess:
    """Works answers out in a process of its own, on another core, at low priority.

    The process ends with `close`, with this object's process however that ends, and is started anew, a few times, if
    it dies or does not answer.

    Parameters
    ----------
    plant, facts, goal
        See `Adviser`.
    lag_blocks
        Take answers so many blocks after the question, waiting if need be; None takes what is there and never waits.

    Attributes
    ----------
    restarts
        How often the process had to be started anew.
    """

    def __init__(self, plant: Plant, facts: LoopFacts, goal: TuningGoal, lag_blocks: int | None) -> None:
        self._order = (plant, facts, goal)
        self._lag = lag_blocks
        self._open: int | None = None
        self._blocks = 0
        self._chain = self._begin = chain_begin(plant, facts, goal)
        self._warm: Question | None = None
        self._is_ready = False
        self._process: SpawnProcess | None = None
        self._connection: Connection[Any, Any] | None = None
        self.restarts = 0
        self._start()

    @property
    def pid(self) -> int | None:
        """Number of the process, while there is one."""
        return None if self._process is None else self._process.pid

    def warm_up(self, question: Question) -> None:
        """Wait until the process has answered a question on a throwaway adviser.

        Raises
        ------
        InputError
            If limits the tuner needs are missing.
        RunError
            If the process does not come up.
        """
        self._warm = question
        self._send(("warm up", question))
        self._await_ready()

    def ready(self, sample: int) -> bool:
        """Whether the process waits for a question; never waits itself unless answers have a fixed block."""
        if self._connection is None or self._open is not None:
            return False
        if not self._is_ready:
            if self._lag is not None:
                self._await_ready()
            elif self._connection.poll(0):
                self._heed(self._receive())
        return self._is_ready

    def ask(self, question: Question) -> None:
        """Hand the question over."""
        self._open, self._blocks = question.number, 0
        self._chain = chain(self._chain, question)
        self._send(("ask", question))

    def take(self, sample: int) -> Arrival | None:
        """Return the answer if it is there, or due."""
        number, connection = self._open, self._connection
        if number is None:
            return None
        self._blocks += 1
        if connection is None:
            return self._lost(number, "the retuning process could not be reached")
        if self._lag is not None:
            if self._blocks < self._lag:
                return None
            there = connection.poll(ANSWER_TIMEOUT_S)
        else:
            there = connection.poll(0)
            if not there and self._blocks < OVERDUE_BLOCKS:
                return None
        if not there:
            return self._lost(number, "retuning did not answer")
        answer, trouble = self._receive() or (None, "the retuning process ended")
        if answer is None:
            return self._lost(number, trouble)
        self._open = None
        return Arrival(number, answer, chain=self._chain)

    def close(self) -> None:
        """End the process and wait until it is gone."""
        connection, process = self._connection, self._process
        self._connection = self._process = None
        self._is_ready = False
        if connection is not None:
            connection.close()
        if process is not None:
            process.kill()  # it holds nothing that could be lost
            process.join()
            process.close()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs, *self._order), name="retuning", daemon=True)
        process.start()
        theirs.close()  # the only copy is the process's own: when it ends, ours says so
        self._process, self._connection, self._is_ready = process, ours, False

    def _lost(self, number: int, why: str) -> Arrival:
        self._open, self._chain = None, self._begin
        self.close()
        if self.restarts >= MOST_RESTARTS:
            return Arrival(number, None, f"{why}; it is not started again after {self.restarts} restarts")
        self.restarts += 1
        self._start()
        if self._warm is not None:
            self._send(("warm up", self._warm))
        return Arrival(number, None, f"{why}; started anew")

    def _await_ready(self) -> None:
        connection = self._connection
        if connection is None or not connection.poll(START_TIMEOUT_S):
            raise RunError(f"the retuning process did not start within {START_TIMEOUT_S:.0f} s")
        self._heed(self._receive())
        if not self._is_ready:
            raise RunError("the retuning process ended before it was ready; its own message stands above")

    def _heed(self, message: Any) -> None:
        match message:
            case ("ready",):
                self._is_ready = True
            case ("unusable", reason):
                self.close()
                raise InputError(reason)
            case _:
                self.close()

    def _send(self, message: tuple[str, Question]) -> None:
        with contextlib.suppress(OSError):  # `take` will find that it is gone
            if self._connection is not None:
                self._connection.send(message)

    def _receive(self) -> Any:
        """Return the next message; None if the process is gone."""
        try:
            return self._connection.recv() if self._connection is not None else None
        except (EOFError, OSError):
            return None


def _serve(connection: "Connection[Any, Any]", plant: Plant, facts: LoopFacts, goal: TuningGoal) -> None:
    """Answer until the other end closes or is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the loop, which then ends this process
    if hasattr(os, "nice"):
        os.nice(10)
    with contextlib.suppress(EOFError, OSError):
        try:
            adviser = Adviser(plant, facts, goal)
        except InputError as error:
            connection.send(("unusable", str(error)))
            return
        while True:
            what, question = connection.recv()
            if what == "warm up":
                Adviser(plant, facts, goal).answer(question)
                connection.send(("ready",))
                continue
            connection.send(_answer(adviser, question))


def _answer(adviser: Adviser, question: Question) -> tuple[Answer | None, str]:
    """Answer, or what went wrong: numbers that no solver takes must not end a run."""
    try:
        return adviser.answer(question), ""
    except (ValueError, ArithmeticError, RunError) as error:
        return None, f"retuning failed ({type(error).__name__}: {error})"
