"""A recording as something to play: step, pause, seek and branch, with the same results wherever one has jumped.

What a session knows is a function of every block before: seeking goes back to the last checkpoint before the instant, a
copy of the whole session made in passing, and runs on from there.
"""

import copy
import time
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from twin.control.schedule import Acknowledgement
from twin.plant.blocks import Block
from twin.station.frame import Frame
from twin.station.opened import Opened
from twin.station.orders import Order
from twin.station.session import Session

CHECKPOINT_S = 5.0
MOST_CHECKPOINTS = 64

Turn = Callable[[Session, Block, tuple[Acknowledgement, ...], Order | None], Frame]


@dataclass(frozen=True, slots=True)
class _Checkpoint:
    """A session that has seen all samples before one."""

    sample: int
    session: Session
    answers: int
    orders: int


def _advance(
    session: Session, block: Block, answers: tuple[Acknowledgement, ...], order: Order | None
) -> Frame:
    return session.advance(block, answers, order)


class Player:
    """Plays an opened recording through its session.

    Parameters
    ----------
    opened
        The recording.
    session
        A fresh one of it; made here unless given.
    turn
        What is done with a block; the session's own `advance` unless given.
    checkpoint_s
        Seconds of data between checkpoints; they lie further apart in long recordings. None makes none but the start.

    Attributes
    ----------
    session
        As it stands at the present position; another object after a `seek`.
    position
        First sample that it has not seen.
    paused
        Set it, from a callback or another thread, and `play` ends after the block at hand.
    """

    def __init__(
        self,
        opened: Opened,
        session: Session | None = None,
        turn: Turn = _advance,
        checkpoint_s: float | None = CHECKPOINT_S,
    ) -> None:
        self._opened, self._turn = opened, turn
        self.session = opened.session() if session is None else session
        self.position = 0
        self.paused = False
        self._answers = self._orders = 0
        self._every = None if checkpoint_s is None else max(1, round(checkpoint_s * opened.sample_rate_hz))
        self._checkpoints = [_Checkpoint(0, self._copy(), 0, 0)] if self._every is not None else []
        self._blocks = iter(opened.blocks())
        self._peeked: Block | None = None

    @property
    def time_s(self) -> float:
        """The present position [s]."""
        return self.position / self._opened.sample_rate_hz

    def step(self) -> Frame | None:
        """Take the next block; None at the end."""
        block, self._peeked = self._peeked or next(self._blocks, None), None
        if block is None:
            return None
        opened = self._opened
        due = []
        while self._answers < len(opened.acknowledgements):
            sample, answer = opened.acknowledgements[self._answers]
            if sample >= block.end_sample:
                break
            due.append(answer)
            self._answers += 1
        order = None
        if self._orders < len(opened.orders) and opened.orders[self._orders][0] < block.end_sample:
            order = opened.orders[self._orders][1]
            self._orders += 1
        frame = self._turn(self.session, block, tuple(due), order)
        self.position = block.end_sample
        self._keep()
        return frame

    def play(
        self,
        until_s: float | None = None,
        speed: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> Iterator[Frame]:
        """Take block after block until the end, an instant, or `paused`.

        Parameters
        ----------
        until_s
            Blocks that end after it are left for later.
        speed
            1 keeps the time of the data, 2 is twice as fast, 0 does not wait.
        """
        self.paused = False
        rate = self._opened.sample_rate_hz
        stop = None if until_s is None else round(until_s * rate)
        began, from_sample = clock(), self.position
        while not self.paused:
            if stop is not None and self._next_end() > stop:
                return
            frame = self.step()
            if frame is None:
                return
            if speed > 0.0:
                due = (self.position - from_sample) / (rate * speed)
                sleep(max(0.0, began + due - clock()))
            yield frame

    def seek(self, time_s: float) -> None:
        """Go to the last block boundary that is not after an instant, forth or back.

        The session is then what it is when everything before was played in one go, to the bit. Blocks on the way are
        taken without `turn`: nothing is shown or recorded twice.
        """
        target = round(time_s * self._opened.sample_rate_hz)
        if self._every is None:
            if target < self.position:
                raise ValueError("a player without checkpoints only goes forth")
        else:
            at = bisect_right([c.sample for c in self._checkpoints], target) - 1
            point = self._checkpoints[max(at, 0)]
            if target < self.position or point.sample > self.position:
                self.session = self._copy(point.session)
                self.position, self._answers, self._orders = point.sample, point.answers, point.orders
                self._blocks, self._peeked = iter(self._opened.blocks(point.sample)), None
        turn, self._turn = self._turn, _advance
        try:
            while self._next_end() <= target and self.step() is not None:
                pass
        finally:
            self._turn = turn

    def _next_end(self) -> int:
        """End of the next block; beyond everything where there is none."""
        self._peeked = self._peeked or next(self._blocks, None)
        return 1 << 62 if self._peeked is None else self._peeked.end_sample

    def _keep(self) -> None:
        points = self._checkpoints
        if self._every is None or self.position < points[-1].sample + self._every:
            return
        points.append(_Checkpoint(self.position, self._copy(), self._answers, self._orders))
        if len(points) > MOST_CHECKPOINTS:
            del points[1::2]
            self._every *= 2

    def _copy(self, session: Session | None = None) -> Session:
        """A session of its own, apart from what never changes."""
        session = self.session if session is None else session
        shared: list[Any] = [session.plant, session.settings, session.channels, self._opened.known]
        memo = {id(thing): thing for thing in shared}
        return copy.deepcopy(session, memo)
