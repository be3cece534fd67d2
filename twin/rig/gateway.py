"""The station's end of the wire: blocks in, commands out, and what to do when the rig falls silent."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import zmq

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.rig.arrivals import ArrivalCounts
from twin.rig.complaints import Complaints
from twin.rig.doorbell import Doorbell, Trouble
from twin.rig.intake import Intake, Run
from twin.rig.messages import Hello
from twin.rig.replies import Replies
from twin.rig.wire import (
    ANOTHER_STATION,
    TOPIC_END,
    TOPIC_HELLO,
    TOPIC_SAMPLES,
    KeyPair,
    encode,
    guard_client,
)

CONNECT_TIMEOUT_S = 60.0
SILENCE_TIMEOUT_S = 5.0
POLL_MS = 100

KEPT_BLOCKS = 600
"""Blocks that wait here for a loop that stands still, a minute's worth; what comes then is lost, and counted."""

START_AGAIN_S = 0.5

MOST_ANSWERS = 200
"""Messages read from the rig between two blocks: more than a rig has to say wait for the next turn."""

FOR_GOOD_S = 2.0
"""A rig that does not know this station's key is asked for so long: it may be starting."""

CATCH_UP_S = 1.0

AFTERTHOUGHT_S = 0.5
"""A rig whose last blocks were lost is believed that it has ended when it has sent nothing for so long after."""


class RigGateway:
    """One connection to a rig; iterate `blocks`.

    Lost blocks come out as blocks without a valid sample. A rig that was started again goes on in the same count of
    samples: the pause between is masked, by this machine's clock.

    Parameters
    ----------
    plant
        Tells the sensors' ranges.
    samples_address, commands_address
        ``tcp://host:port`` of the rig's two sockets.
    keys
        The station's own.
    rig_public
        The rig's public key: nobody else can answer.

    Attributes
    ----------
    drift
        `ClockDrift` of rig against station.
    """

    def __init__(
        self, plant: Plant, samples_address: str, commands_address: str, keys: KeyPair, rig_public: bytes
    ) -> None:
        self._context = zmq.Context()
        self._samples = self._context.socket(zmq.SUB)
        self._samples.rcvhwm = KEPT_BLOCKS
        self._commands = self._context.socket(zmq.DEALER)
        # What cannot be said now is not said later: an order from before the rig was away has no business after it.
        self._commands.immediate = True
        # An emergency stop goes out from another thread than the loop's; a socket stands one at a time.
        self._lock = threading.Lock()
        self._doorbell = Doorbell(self._context, self._samples, samples_address)
        for socket, address in ((self._samples, samples_address), (self._commands, commands_address)):
            guard_client(socket, keys, rig_public)
            socket.connect(address)
        for topic in (TOPIC_HELLO, TOPIC_SAMPLES, TOPIC_END):
            self._samples.subscribe(topic)
        self._complaints = Complaints()
        self._intake, self._replies = Intake(plant, self._complaints), Replies(self._complaints)
        self.drift = self._intake.drift
        self._off: Command | None = None
        self._start_due_s = 0.0
        self._events: list[str] = []

    @property
    def hello(self) -> Hello:
        """What the rig said of itself; RunError before `connect`."""
        if self._run is None:
            raise RunError("the rig is not connected")
        return self._run.hello

    @property
    def counts(self) -> ArrivalCounts:
        """What the wire did to the blocks, all runs of the rig together."""
        return self._intake.counts

    @property
    def restarts(self) -> int:
        """How often the rig began anew."""
        return self._intake.restarts

    @property
    def in_control(self) -> bool:
        """False if the rig has said that another station has the controls."""
        return self._replies.in_control

    @property
    def notice(self) -> str:
        """What the rig says of itself, with the latest block, and of who has the controls; empty if nothing."""
        watching = "" if self.in_control else f"{ANOTHER_STATION}; this one only watches"
        return "; ".join(words for words in (self._intake.notice, watching) if words)

    @property
    def malformed(self) -> int:
        """Messages that could not be read, or made no sense, and were left out."""
        return self._complaints.in_all

    @property
    def dropped(self) -> int:
        """Blocks whose samples are lost."""
        return self.counts.lost

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Columns of its blocks, in SI units; RunError before `connect`."""
        if self._run is None:
            raise RunError("the rig is not connected")
        return self._run.channels

    def connect(
        self,
        is_alive: Callable[[], bool] = lambda: True,
        timeout_s: float | None = None,
        *,
        start: bool = True,
    ) -> Hello:
        """Wait until both sockets are through and the rig has said what it is, then let it begin.

        Parameters
        ----------
        is_alive
            Whether there is still somebody to wait for.
        timeout_s
            Give up after so many seconds; `CONNECT_TIMEOUT_S` unless given.
        start
            False leaves that to `start`, for a station that has to make itself ready for what the rig is.

        Raises
        ------
        RunError
            If the rig does not answer in time: wrong address, wrong key, or no rig; or if it cannot be understood.
        """
        timeout_s = CONNECT_TIMEOUT_S if timeout_s is None else timeout_s
        begin = time.monotonic()
        while self._run is None or not self._commands.poll(0, zmq.POLLOUT):
            if not self._samples.poll(POLL_MS) and not is_alive():
                raise RunError("the rig ended before it began; its own message stands above")
            waited = time.monotonic() - begin
            trouble = self._doorbell.trouble()
            if waited > (min(FOR_GOOD_S, timeout_s) if trouble.for_good else timeout_s):
                raise RunError(
                    f"no rig answered within {waited:.0f} s: check address and keys{_because(trouble)}"
                )
            while self._run is None and self._samples.poll(0):
                topic, *frames = self._samples.recv_multipart()
                if topic == TOPIC_HELLO:
                    self._intake.meet(frames)
                elif topic == TOPIC_SAMPLES:
                    self._intake.meet_by_samples(frames)
                if time.monotonic() - begin > timeout_s:
                    break
        if start:
            self._send({"type": "start"})
        return self._run.hello

    def start(self) -> None:
        """Let the rig begin; what it has sent while the station made itself ready is left out."""
        end = time.monotonic() + CATCH_UP_S
        while self._samples.poll(0) and time.monotonic() < end:
            topic, *frames = self._samples.recv_multipart()
            if topic == TOPIC_HELLO:
                self._greet(frames)
        self._send({"type": "start"})

    def blocks(
        self,
        is_alive: Callable[[], bool] = lambda: True,
        *,
        patience_s: float | None = None,
        on_silence: Callable[[float], None] | None = None,
    ) -> Iterator[Block]:
        """Blocks in order until the rig says it has finished.

        Parameters
        ----------
        is_alive
            Whether there is still somebody to wait for.
        patience_s
            Silence after which the rig is given up; `SILENCE_TIMEOUT_S` unless given, infinity waits for ever.
        on_silence
            Called every tenth of a second without a message, with the seconds it has lasted.

        Raises
        ------
        RunError
            If the rig falls silent or dies, or comes back as another rig.
        """
        patience_s = SILENCE_TIMEOUT_S if patience_s is None else patience_s
        alive, ended_s = True, math.inf
        silent_since = looked = time.monotonic()
        while True:
            ready = self._samples.poll(POLL_MS)
            now = time.monotonic()
            if not ready or now - looked > 1e-3 * POLL_MS:  # a flood of garbage is silence, too
                looked, waited = now, now - silent_since
                self._ask_why_nothing_comes()
                if not ready and now - ended_s > AFTERTHOUGHT_S:
                    yield from self._rest()
                    return
                if not ready and not alive:
                    raise RunError(f"The rig's process ended in mid-run{self._last_heard()}.")
                alive = is_alive()  # one more look at the socket after the process has gone
                if waited > patience_s:
                    raise RunError(f"The rig has been silent for {waited:.0f} s{self._last_heard()}.")
                if on_silence is not None and waited > 1e-3 * POLL_MS:
                    on_silence(waited)
            if not ready:
                continue
            topic, *frames = self._samples.recv_multipart()
            if topic == TOPIC_END:
                end = self._intake.end(frames)
                if end is not None and self._run is not None:
                    if end == self._run.arrivals.due_sample:
                        yield from self._rest()
                        return
                    ended_s = time.monotonic()
            elif topic == TOPIC_HELLO:
                self._greet(frames)
            elif topic == TOPIC_SAMPLES:
                restarts = self.restarts
                for block in self._intake.take(frames, now):
                    yield block
                    silent_since, ended_s = time.monotonic(), math.inf
                if self.restarts != restarts:
                    self._send_off()
            else:
                self._complaints.add("a message of unknown kind", repr(topic[:20]))

    def _rest(self) -> Iterator[Block]:
        if self._run is not None:
            yield from self._run.arrivals.flush()

    def heartbeat(self, next_sample: int) -> None:
        """Tell the rig how far the station has worked through its data."""
        self._send({"type": "heartbeat", "next_sample": max(0, next_sample - self._offset)})
        self._send_off()

    def send(self, command: Command) -> None:
        """Send a command, from any thread; its acknowledgement arrives through `acknowledgements`.

        One that finds no rig is lost, with an event; one that only switches off is sent when the rig is back.
        """
        self._replies.await_for(command.command_id)
        if self._send_command(command):
            self._off = None
            return
        only_off = command.control_enabled is False and command.schedule is None
        self._off = command if only_off else self._off
        then = "it is sent when the rig is back" if only_off else "it is lost"
        self._events.append(f"command {command.command_id} finds no rig: {then}")

    def _send_command(self, command: Command) -> bool:
        due = max(0, command.apply_at_sample - self._offset)
        message = command.model_copy(update={"apply_at_sample": due}).model_dump(mode="json")
        return self._send({"type": "command", "command": message})

    def _send_off(self) -> None:
        """Send what switches off and found no rig, now that there is one."""
        off = self._off
        if off is not None and self._send_command(off):
            self._off = None

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """What the rig has answered since the last call."""
        for _ in range(MOST_ANSWERS):
            frames = self._answer()
            if not frames:
                break
            self._replies.take(frames, self._offset)
        answers, self._replies.acknowledgements = tuple(self._replies.acknowledgements), []
        return answers

    def events(self) -> tuple[str, ...]:
        """What has happened to the connection since the last call, in words."""
        found: list[str] = []
        for events in (self._events, self._intake.events, self._replies.events):
            while events:
                found.append(events.pop(0))
        return (*found, *self._complaints.said())

    def close(self) -> None:
        """Take leave of the rig and close both sockets."""
        with contextlib.suppress(zmq.ZMQError):
            self._send({"type": "stop"})
        with self._lock:
            self._context.destroy(linger=200)

    @property
    def _run(self) -> Run | None:
        return self._intake.run

    @property
    def _offset(self) -> int:
        return self._intake.offset

    def _answer(self) -> list[bytes]:
        with self._lock:
            return self._commands.recv_multipart() if self._commands.poll(0) else []

    def _send(self, message: dict[str, Any]) -> bool:
        """Whether it is on its way: to a rig that is away nothing is."""
        with self._lock, contextlib.suppress(zmq.Again):
            if not self._commands.closed:
                self._commands.send(encode(message), flags=zmq.NOBLOCK)
                return True
        return False

    def _last_heard(self) -> str:
        following = self._run.arrivals.next_sample if self._run is not None else None
        return "" if following is None else f" (last sample {following - 1})"

    def _greet(self, frames: list[bytes]) -> None:
        hello = self._intake.greet(frames)
        if hello is not None and hello.waits_for_start and time.monotonic() >= self._start_due_s:
            self._start_due_s = time.monotonic() + START_AGAIN_S
            self._send({"type": "start"})

    def _ask_why_nothing_comes(self) -> None:
        trouble = self._doorbell.news()
        if trouble.reason:
            self._complaints.add(trouble.reason)


def _because(trouble: Trouble) -> str:
    return f" ({trouble.reason})" if trouble.reason else ""
