"""What-if for the operator page, in a process of its own: neither loop nor page waits for a solver.

All curves come at once, with gains sought next to those of the question before so that a slider can be followed, and
then, from coarse to fine, what the tuner's whole search makes of the provisional points; a newer question ends that.
"""

import contextlib
import math
import multiprocessing
import os
import queue
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Literal

from tuning.branch import Brancher, Instant
from tuning.changes import Changes
from tuning.loop import LoopFacts, RigModel
from tuning.retune import TuningGoal
from tuning.step import between, step_n_m
from tuning.whatif import CurvePoint, Curves, WhatIf
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError

ANSWER_TIMEOUT_S = 60.0
MOST_RESTARTS = 20
"""A process that dies as often has a reason; without it there is no what-if, and everything else."""

LONGEST_STEP = 0.5
"""Share of the absorber's stiffness that gains may move at once, as when retuning."""

STALE = 5.0
"""So many times as far as what looks the same the model may have moved on for the first curves of an answer."""

BRANCH_STEP = 50


@dataclass(frozen=True, slots=True)
class Base:
    """What is known of the rig at the instant of a question."""

    plant: Plant
    facts: LoopFacts
    schedule: GainSchedule
    goal: TuningGoal
    amplitude: float
    damping_std_ns_m: float

    def is_like(self, other: "Base", times: float = 1.0) -> bool:
        """Whether curves of the one would look the same as those of the other, or how many times as far off."""
        ours, theirs = self.plant.absorber, other.plant.absorber
        if ours is None or theirs is None or (self.schedule, self.goal) != (other.schedule, other.goal):
            return False
        moved = max(abs(ours.damping_at(f) - theirs.damping_at(f)) for f in self.schedule.frequency_hz)
        return (
            moved < 0.05 * times
            and abs(self.amplitude / other.amplitude - 1.0) < 0.02 * times
            and abs(self.damping_std_ns_m - other.damping_std_ns_m) < 0.1 * times
        )


@dataclass(frozen=True, slots=True)
class Asked:
    """One question: curves over the band, a proposal for the whole table, or a branch from an instant."""

    kind: Literal["curves", "propose", "branch"]
    base: Base
    changes: Changes
    frequencies_hz: tuple[float, ...] = ()
    instant: Instant | None = None
    seconds: float = 1.0


class WhatIfProcess:
    """Asks the process; safe to use from several threads.

    The process ends with `close` and with this object's process, and is started anew if it dies.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._number = self._restarts = 0
        self._waiting: dict[int, queue.SimpleQueue[tuple[str, Any]]] = {}
        self._process: SpawnProcess | None = None
        self._connection: Connection[Any, Any] | None = None
        self._start()

    @property
    def pid(self) -> int | None:
        """Number of the process, while there is one."""
        return None if self._process is None else self._process.pid

    def ask(self, asked: Asked) -> Iterator[Any]:
        """Yield the parts of the answer as they come; ends early if a newer question came.

        Raises
        ------
        InputError
            If the question has no answer with this plant.
        RunError
            If the process died or does not answer.
        """
        with self._lock:
            self._number += 1
            number, connection = self._number, self._connection
            parts = self._waiting[number] = queue.SimpleQueue()
            try:
                if connection is None:
                    raise RunError("what-if has ended")
                connection.send((number, asked))
            except OSError as error:
                self._start()
                raise RunError("what-if had to be started anew; ask again") from error
        try:
            while True:
                try:
                    what, part = parts.get(timeout=ANSWER_TIMEOUT_S)
                except queue.Empty as error:
                    raise RunError("what-if does not answer") from error
                match what:
                    case "end":
                        return
                    case "unusable":
                        raise InputError(part)
                    case "failed":
                        raise RunError(part)
                yield part
        finally:
            self._waiting.pop(number, None)

    def last(self, asked: Asked) -> Any:
        """Return the last part of the answer; None if there is none."""
        return next(iter(deque(self.ask(asked), maxlen=1)), None)

    def close(self) -> None:
        """End the process."""
        process, self._process, self._connection = self._process, None, None
        if process is not None:
            process.kill()
            process.join()

    def _start(self) -> None:
        self.close()
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(theirs,), name="what-if", daemon=True)
        process.start()
        theirs.close()
        self._process, self._connection = process, ours
        threading.Thread(target=self._receive, args=(ours,), name="what-if", daemon=True).start()

    def _receive(self, connection: "Connection[Any, Any]") -> None:
        """Hand the parts of answers to whoever asked, until the process is gone."""
        try:
            while True:
                number, what, part = connection.recv()
                parts = self._waiting.get(number)
                if parts is not None:  # else its asker has gone
                    parts.put((what, part))
        except (EOFError, OSError, TypeError):
            with self._lock:
                if self._connection is connection:  # it died, and was not ended
                    self._restarts += 1
                    if self._restarts <= MOST_RESTARTS:
                        self._start()
                    else:
                        self.close()
            for parts in list(self._waiting.values()):
                parts.put(("failed", "what-if had to be started anew; ask again"))


def _serve(connection: "Connection[Any, Any]") -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(1)
    worker = _Worker(connection)
    with contextlib.suppress(EOFError, OSError):
        while True:
            number, asked = connection.recv()
            try:
                with contextlib.suppress(_SupersededError):
                    for part in worker.answer(asked):
                        connection.send((number, "part", part))
                connection.send((number, "end", None))
            except InputError as error:
                connection.send((number, "unusable", str(error)))
            except (ValueError, ArithmeticError, RunError) as error:
                connection.send((number, "failed", f"{type(error).__name__}: {error}"))


class _SupersededError(Exception):
    """A newer question has come."""


class _Worker:
    def __init__(self, connection: "Connection[Any, Any]") -> None:
        self._connection = connection
        self._base: Base | None = None
        self._what_if: WhatIf | None = None

    def answer(self, asked: Asked) -> Iterator[Any]:
        match asked.kind:
            case "curves":
                yield from self._curves(asked)
            case "propose":
                yield self._proposal(asked)
            case "branch":
                yield self._branches(asked)

    def _curves(self, asked: Asked) -> Iterator[Any]:
        band = asked.frequencies_hz
        # A model that has moved on a little is built anew behind the first curves, all provisional then.
        known = self._base
        stale = known is not None and not asked.base.is_like(known) and asked.base.is_like(known, STALE)
        at_hand = self._what_if if stale and self._what_if is not None else self._for(asked.base)
        quick = at_hand.curves(band, asked.changes, quick=True)
        if stale:
            quick = replace(quick, points=tuple(replace(p, provisional=True) for p in quick.points))
        yield quick
        self._go_on()
        what_if = self._for(asked.base)
        # Holes first: points without gains next to the last ones may have some elsewhere.
        open_points = [k for k in coarse_to_fine(len(band)) if quick.points[k].provisional]
        for k in sorted(open_points, key=lambda k: quick.points[k].proposed is not None):
            self._go_on()
            yield k, what_if.curves(band[k : k + 1], asked.changes, go_on=self._go_on).points[0]

    def _go_on(self) -> None:
        if self._connection.poll(0):
            raise _SupersededError

    def _for(self, base: Base) -> WhatIf:
        if self._what_if is None or self._base is None or not base.is_like(self._base):
            before = self._what_if
            self._base = base
            self._what_if = WhatIf(
                base.plant, base.facts, base.schedule, base.goal, base.amplitude, base.damping_std_ns_m
            )
            if before is not None:
                self._what_if.begin_like(before)
        return self._what_if

    def _proposal(self, asked: Asked) -> "WhatIfProposal":
        base, changes = asked.base, asked.changes
        what_if = self._for(base)
        base = self._base or base
        goal = changes.goal(base.goal)
        points: list[CurvePoint] = []
        for f in base.schedule.frequency_hz:
            points += what_if.curves([f], changes).points
        new = {
            row: p.proposed.gains
            for row, p in enumerate(points)
            if p.proposed is not None and p.proposed.gains is not None
        }
        window = {
            name: value
            for name in ("on_from_hz", "on_to_hz")
            if (value := getattr(changes, name)) is not None
        }
        try:
            meant = GainSchedule.model_validate(
                base.schedule.with_points(new).model_dump() | window, strict=False
            )
        except ValueError as error:
            raise InputError(f"the control window cannot be used: {error}") from error
        return WhatIfProposal(base, Curves(tuple(points), goal, base.amplitude), _steps(base, meant), goal)

    def _branches(self, asked: Asked) -> list[Any]:
        # Brings readers of all recordings with it: fifty megabytes that nobody needs before the first branch.
        from twin.station.whatif_source import proposed_schedule

        base, instant = asked.base, asked.instant
        if instant is None:
            raise InputError("a branch needs an instant")
        schedule, changes = base.schedule, asked.changes
        f = instant.frequency_hz
        ends = (f, f + instant.rate_hz_s * asked.seconds)
        low, high = min(*ends) - 0.3, max(*ends) + 0.3
        proposed = self._for(base).curves([low, f, high], changes).points
        gains = [(p.frequency_hz, p.proposed.gains) for p in proposed if p.proposed and p.proposed.gains]
        window = (changes.on_from_hz or schedule.on_from_hz, changes.on_to_hz or schedule.on_to_hz)
        other = proposed_schedule(schedule, gains, window)
        brancher = Brancher(base.plant, base.facts, instant, base.damping_std_ns_m)
        runs: list[tuple[str, GainSchedule | None]] = [("passive", None), ("in use", schedule)]
        if other is not None:
            runs.append(("proposed", other))
        return [brancher.run(name, gains, asked.seconds, BRANCH_STEP) for name, gains in runs]


@dataclass(frozen=True, slots=True)
class WhatIfProposal:
    """Gains for the whole table, with what is predicted of them, and the steps that lead there."""

    base: Base
    curves: Curves
    schedules: tuple[GainSchedule, ...]
    goal: TuningGoal


def coarse_to_fine(n: int) -> list[int]:
    """All of ``range(n)``, both ends and the middle first, then what lies between."""
    order, stride = [0, n - 1] if n > 1 else list(range(n)), 1 << max(n - 1, 1).bit_length()
    while stride > 1:
        stride //= 2
        order += range(0, n, stride)
    return list(dict.fromkeys(order))


def _steps(base: Base, meant: GainSchedule) -> tuple[GainSchedule, ...]:
    """The schedule meant, after as many in between as keep a step short, where all of these are stable."""
    absorber = base.plant.absorber
    longest = LONGEST_STEP * absorber.stiffness_n_m if absorber is not None else math.inf
    table = base.schedule.frequency_hz
    old: Sequence[Gains] = [base.schedule.at(f) for f in table]
    new: Sequence[Gains] = [meant.at(f) for f in table]
    n = max(math.ceil(step_n_m(a, b, f) / longest) for a, b, f in zip(old, new, table, strict=True))
    steps = []
    for j in range(1, min(n, 20)):
        gains = {row: between(a, b, j / n) for row, (a, b) in enumerate(zip(old, new, strict=True))}
        for row, f in enumerate(table):
            if not RigModel(base.plant, base.facts, f).decay_rate_1_s(gains[row]) < 0.0:
                return (meant,)
        steps.append(meant.with_points(gains))
    return (*steps, meant)
