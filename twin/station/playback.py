"""A recording under a page's hand: play, pause, step, speed and seek, asked for by any thread, done by the playing one.

What has been played is shown through the same desk as a live run, so that what-if starts from the instant at hand.
"""

import math
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from twin.plant.errors import InputError
from twin.station.frame import Frame
from twin.station.player import Player

IDLE_S = 0.1
SEEK_STEP_S = 1.0
"""A seek forth goes in steps of so much, so that another wish is heard on the way."""

FIRST_GUESS_S = 0.1
HISTORY_BLOCKS = 10
"""So many blocks before a seek's target are shown: curves and branches start from them."""

FASTEST = 100.0

Action = Literal["play", "pause", "step", "seek", "speed"]


@dataclass(frozen=True, slots=True)
class Wish:
    """What the person at the page wants; the value is an instant [s] of a seek, or a speed."""

    action: Action
    value: float = 0.0


class Playback:
    """Plays a recording as it is told.

    Parameters
    ----------
    player
        What is played; its `turn` shows the frames.
    sample_rate_hz, n_samples
        Of the recording.
    speed
        1 keeps the time of the data, 0 does not wait.
    from_s, to_s
        Where to begin and to pause [s].
    seekable
        False where a jump would spoil something, such as a recording that is being made of the replay.
    jumped
        Called in the playing thread after each jump, before anything is shown.
    """

    def __init__(
        self,
        player: Player,
        sample_rate_hz: float,
        n_samples: int,
        *,
        speed: float = 1.0,
        from_s: float = 0.0,
        to_s: float | None = None,
        seekable: bool = True,
        jumped: Callable[[], None] = lambda: None,
    ) -> None:
        self._player, self._rate = player, sample_rate_hz
        self._from_s = from_s
        self._stop_s, self._length_s = to_s, n_samples / sample_rate_hz
        self.speed, self.playing, self.ended, self.seeking = speed, True, False, False
        self.jumps = 0
        self._block_s, self._begin_s = FIRST_GUESS_S, math.inf
        self._seekable, self._jumped = seekable, jumped
        self._wishes: queue.SimpleQueue[Wish] = queue.SimpleQueue()
        self._due: tuple[float, float] | None = None

    # --- any thread ---

    def ask(self, wish: Wish) -> None:
        """Have a wish done soon.

        Raises
        ------
        InputError
            If it cannot be.
        """
        if wish.action == "seek":
            if not self._seekable:
                raise InputError(
                    "this replay is being recorded and cannot jump; replay without --save for that"
                )
            if not 0.0 <= wish.value <= self._length_s:
                raise InputError(f"{wish.value:g} s: the recording lasts from 0 to {self._length_s:.1f} s")
        if wish.action == "speed" and not (math.isfinite(wish.value) and 0.0 <= wish.value <= FASTEST):
            raise InputError(f"speed {wish.value:g}: give 0 (as fast as it goes) to {FASTEST:g}")
        self._wishes.put(wish)

    def state(self) -> dict[str, Any]:
        """What the page shows of it."""
        return {
            "position_s": round(self._player.time_s, 4),
            "begin_s": round(self._begin_s, 4) if math.isfinite(self._begin_s) else 0.0,
            "length_s": round(self._length_s, 4),
            "playing": self.playing,
            "speed": self.speed,
            "seeking": self.seeking,
            "ended": self.ended,
            "seekable": self._seekable,
        }

    # --- the thread that plays ---

    def run(
        self, take: Callable[[Frame], None], at_end: Callable[[], None], stay: Callable[[], bool]
    ) -> None:
        """Play until the end, and for as long as somebody stays.

        Parameters
        ----------
        take
            Given every frame that was shown.
        at_end
            Called once, when the end is reached for the first time.
        stay
            Whether anybody may still ask for something; a pause nobody can end is ended here.
        """
        if self._from_s > 0.0:
            self._player.seek(self._from_s)
        while True:
            self._obey(take)
            if self.playing:
                self._play_block(take)
                if self.ended:
                    at_end()
                    at_end = _nothing
                continue
            if not stay():
                if self.ended:
                    return
                self.playing, self._due = True, None
                continue
            self._wait(IDLE_S, take)

    def _play_block(self, take: Callable[[Frame], None]) -> None:
        frame = None
        if self._stop_s is None or self._fits(self._stop_s):
            frame = self._player.step()
        if frame is None:
            self.playing, self.ended, self._stop_s = False, True, None
            return
        self._note(frame)
        take(frame)
        if self.speed <= 0.0:
            return
        now = time.monotonic()
        if self._due is None:
            self._due = (now, frame.block.start_s)
        began, at_s = self._due
        left = began + (self._player.time_s - at_s) / self.speed - now
        if left < -1.0:  # slower than asked for: what was missed is not caught up with
            self._due = (now, self._player.time_s)
        elif left > 0.0:
            self._wait(left, take)

    def _wait(self, seconds: float, take: Callable[[Frame], None]) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            try:
                wish = self._wishes.get(timeout=left)
            except queue.Empty:
                return
            self._do(wish, take)
            if self._due is None:
                return

    def _obey(self, take: Callable[[Frame], None]) -> None:
        while not self._wishes.empty():
            self._do(self._wishes.get(), take)

    def _do(self, wish: Wish, take: Callable[[Frame], None]) -> None:
        self._due = None
        match wish.action:
            case "play":
                if self.ended:
                    self._seek(0.0, take)
                self.playing = True
            case "pause":
                self.playing = False
            case "speed":
                self.speed = wish.value
            case "step":
                self.playing = False
                frame = self._player.step()
                if frame is None:
                    self.ended = True
                else:
                    take(frame)
            case "seek":
                self._seek(wish.value, take)

    def _seek(self, target_s: float, take: Callable[[Frame], None]) -> None:
        player = self._player
        self.seeking, self.ended = True, False
        self.jumps += 1
        before_s = max(0.0, target_s - HISTORY_BLOCKS * self._block_s)
        try:
            if before_s < player.time_s:
                player.seek(before_s)
            while player.time_s + SEEK_STEP_S < before_s and self._wishes.empty():
                at_s = player.time_s
                player.seek(at_s + SEEK_STEP_S)
                if player.time_s == at_s:
                    break  # nothing lies there: the recording begins later, or has a gap
            if self._wishes.empty():
                player.seek(before_s)
            else:
                target_s = (
                    player.time_s + HISTORY_BLOCKS * self._block_s
                )  # far enough: somewhere else is wanted
            self._jumped()
            while self._fits(target_s) and (frame := player.step()) is not None:
                self._note(frame)
                take(frame)
        finally:
            self.seeking = False

    def _note(self, frame: Frame) -> None:
        """Learn how long blocks are, and where the recording begins: a rig may have run long before its station."""
        block = frame.block
        self._block_s = block.n_samples / self._rate
        self._begin_s = min(self._begin_s, block.start_s)

    def _fits(self, end_s: float) -> bool:
        """Whether another block ends by then."""
        return self._player.time_s + self._block_s <= end_s + 0.5 / self._rate


def _nothing() -> None:
    """What is done at a second end."""
