"""The station's end of the wire: blocks in, commands out, and what to do when the rig falls silent."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import zmq
from pydantic import ValidationError

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.plant.linear import Array
from twin.rig.arrivals import ArrivalCounts, Arrivals
from twin.rig.complaints import Complaints, plain
from twin.rig.doorbell import Doorbell, Trouble
from twin.rig.drift import ClockDrift
from twin.rig.messages import Hello, SamplesHeader
from twin.rig.units import COMMON, to_si, units_for
from twin.rig.wire import (
    ANOTHER_STATION,
    TOPIC_END,
    TOPIC_HELLO,
    TOPIC_SAMPLES,
    KeyPair,
    decode,
    encode,
    guard_client,
)

CONNECT_TIMEOUT_S = 60.0
SILENCE_TIMEOUT_S = 5.0
POLL_MS = 100

KEPT_BLOCKS = 600
"""Blocks that wait here for a loop that stands still, a minute's worth; what comes then is lost, and counted."""

MAX_ANSWER_BYTES = 64 * 1024
MAX_SAMPLE = 2**62
START_AGAIN_S = 0.5

MOST_ANSWERS = 200
"""Messages read from the rig between two blocks: more than a rig has to say wait for the next turn."""

ANNOUNCED = 16
"""Runs that were announced and have not been seen: what only says hello is no reason to leave the one that sends."""

FOR_GOOD_S = 2.0
"""A rig that does not know this station's key is asked for so long: it may be starting."""

CATCH_UP_S = 1.0

AFTERTHOUGHT_S = 0.5
"""A rig whose last blocks were lost is believed that it has ended when it has sent nothing for so long after."""


@dataclass(slots=True)
class _Run:
    """One run of the rig: its own count of samples, and where that count lies in the station's."""

    hello: Hello
    channels: tuple[Channel, ...]
    factors: Array
    offset: int = 0
    arrivals: Arrivals = field(default_factory=Arrivals)


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
    restarts
        How often the rig began anew.
    in_control
        False if the rig has said that another station has the controls.
    """

    def __init__(
        self, plant: Plant, samples_address: str, commands_address: str, keys: KeyPair, rig_public: bytes
    ) -> None:
        self._plant = plant
        self._ranges_by_name = {s.name: s.range for s in plant.sensor if s.range is not None}
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
        self._rig_notice = ""
        self.drift = ClockDrift()
        self.restarts = 0
        self.in_control = True
        self._complaints = Complaints()
        self._announced: dict[Hello, int] = {}
        self._sighted: SamplesHeader | None = None
        self._unanswered: set[int] = set()
        self._off: Command | None = None
        self._start_due_s = 0.0
        self._run: _Run | None = None
        self._past = ArrivalCounts()
        self._last_arrival_s = 0.0
        self._events: list[str] = []
        self._acknowledgements: list[Acknowledgement] = []

    @property
    def hello(self) -> Hello:
        """What the rig said of itself; RunError before `connect`."""
        if self._run is None:
            raise RunError("the rig is not connected")
        return self._run.hello

    @property
    def counts(self) -> ArrivalCounts:
        """What the wire did to the blocks, all runs of the rig together."""
        now = self._run.arrivals.counts if self._run is not None else ArrivalCounts()
        return ArrivalCounts(
            *(getattr(self._past, name) + getattr(now, name) for name in ArrivalCounts.__slots__)
        )

    @property
    def notice(self) -> str:
        """What the rig says of itself, with the latest block, and of who has the controls; empty if nothing."""
        watching = "" if self.in_control else f"{ANOTHER_STATION}; this one only watches"
        return "; ".join(words for words in (self._rig_notice, watching) if words)

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
                    self._meet(frames)
                elif topic == TOPIC_SAMPLES and len(self._announced) == 1:
                    self._meet_by_samples(frames)
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
                if now - ended_s > AFTERTHOUGHT_S:
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
                end = self._end(frames)
                if end is not None and self._run is not None:
                    if end == self._run.arrivals.due_sample:
                        yield from self._run.arrivals.flush()
                        return
                    ended_s = time.monotonic()
            elif topic == TOPIC_HELLO:
                self._greet(frames)
            elif topic == TOPIC_SAMPLES:
                for block in self._take_samples(frames):
                    yield block
                    silent_since, ended_s = time.monotonic(), math.inf
            else:
                self._complain("a message of unknown kind", repr(topic[:20]))

    def heartbeat(self, next_sample: int) -> None:
        """Tell the rig how far the station has worked through its data."""
        self._send({"type": "heartbeat", "next_sample": max(0, next_sample - self._offset)})

    def send(self, command: Command) -> None:
        """Send a command, from any thread; its acknowledgement arrives through `acknowledgements`.

        One that finds no rig is lost, with an event; one that only switches off is sent when the rig is back.
        """
        due = max(0, command.apply_at_sample - self._offset)
        message = command.model_copy(update={"apply_at_sample": due}).model_dump(mode="json")
        self._unanswered.add(command.command_id)
        if self._send({"type": "command", "command": message}):
            self._off = None
            return
        only_off = command.control_enabled is False and command.schedule is None
        self._off = command if only_off else self._off
        then = "it is sent when the rig is back" if only_off else "it is lost"
        self._events.append(f"command {command.command_id} finds no rig: {then}")

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """What the rig has answered since the last call."""
        for _ in range(MOST_ANSWERS):
            frames = self._answer()
            if not frames:
                break
            self._hear(frames)
        answers, self._acknowledgements = tuple(self._acknowledgements), []
        return answers

    def _hear(self, frames: list[bytes]) -> None:
        try:
            if len(frames) != 1 or len(frames[0]) > MAX_ANSWER_BYTES:
                raise RunError(f"{len(frames)} frames of {sum(map(len, frames))} bytes")
            message = decode(frames[0])
            kind = message.pop("type", "")
            if kind == "ack":
                self._acknowledge(Acknowledgement.model_validate(message, strict=True))
            elif kind == "refused":
                self._refused(plain(message.get("reason", "")))
            elif kind == "controls":
                self.in_control = True
                self._events.append("this station has the controls")
            else:
                raise RunError(f"of type {plain(kind, 20)!r}")
        except ValidationError as error:
            self._complain("an answer of the rig cannot be read", _first(error))
        except RunError as error:
            self._complain("an answer of the rig cannot be read", str(error))

    def _acknowledge(self, answer: Acknowledgement) -> None:
        at = answer.applied_at_sample
        if answer.command_id not in self._unanswered or not (at is None or 0 <= at <= MAX_SAMPLE):
            self._complain(
                "an acknowledgement of what was not sent", f"command {plain(answer.command_id, 20)}"
            )
            return
        self._unanswered.discard(answer.command_id)
        self.in_control = self.in_control or answer.accepted
        changes: dict[str, Any] = {"reason": plain(answer.reason)}
        if at is not None:
            changes["applied_at_sample"] = at + self._offset
        self._acknowledgements.append(answer.model_copy(update=changes))

    def _refused(self, reason: str) -> None:
        if ANOTHER_STATION in reason:
            if self.in_control:
                self._events.append(f"the rig refuses orders of this station: {reason}; it only watches")
            self.in_control = False
            return
        self._complaints.add("the rig refused a message", reason)

    def events(self) -> tuple[str, ...]:
        """What has happened to the connection since the last call, in words."""
        events, self._events = (*self._events, *self._complaints.said()), []
        return events

    def close(self) -> None:
        """Take leave of the rig and close both sockets."""
        with contextlib.suppress(zmq.ZMQError):
            self._send({"type": "stop"})
        with self._lock:
            self._context.destroy(linger=200)

    @property
    def _offset(self) -> int:
        return self._run.offset if self._run is not None else 0

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

    def _hello_in(self, frames: list[bytes]) -> Hello | None:
        try:
            return Hello.model_validate_json(frames[0] if len(frames) == 1 else b"")
        except ValidationError as error:
            self._complain("a hello cannot be read", _first(error))
            return None

    def _announce(self, hello: Hello) -> None:
        self._announced[hello] = self._announced.get(hello, 0) + 1
        while len(self._announced) > ANNOUNCED:
            del self._announced[min(self._announced, key=lambda h: self._announced[h])]

    def _meet(self, frames: list[bytes]) -> None:
        """Take a hello that was said twice for what the rig is."""
        hello = self._hello_in(frames)
        if hello is not None:
            self._announce(hello)
            if self._announced.get(hello, 0) > 1:
                self._begin(hello)

    def _meet_by_samples(self, frames: list[bytes]) -> None:
        """Take the only hello there was for what the rig is, if its samples agree."""
        hello = next(iter(self._announced))
        with contextlib.suppress(ValidationError):
            header = SamplesHeader.model_validate_json(frames[0] if len(frames) == 2 else b"")
            if header.run_id == hello.run_id and len(frames[1]) == 4 * header.n_samples * len(hello.channels):
                self._begin(hello)

    def _begin(self, hello: Hello) -> None:
        self._run = _Run(hello, *_in_si_units(hello, self._plant))
        self._announced.clear()
        if hello.config_id and hello.config_id != self._plant.fingerprint:
            self._events.append(
                f"the rig is set up for plant '{plain(hello.plant)}' ({plain(hello.config_id)}), "
                f"this station models '{self._plant.name}' ({self._plant.fingerprint})"
            )

    def _greet(self, frames: list[bytes]) -> None:
        """Note a hello; one of another run counts when samples of that run come."""
        hello, run = self._hello_in(frames), self._run
        if hello is None or run is None or hello.run_id == run.hello.run_id:
            return
        self._announce(hello)
        if hello.waits_for_start and time.monotonic() >= self._start_due_s:
            self._start_due_s = time.monotonic() + START_AGAIN_S
            self._send({"type": "start"})

    def _end(self, frames: list[bytes]) -> int | None:
        """Sample that the run ends before; None if what says so cannot be believed."""
        run = self._run
        try:
            message = decode(frames[0] if len(frames) == 1 else b"")
        except RunError as error:
            self._complain("an end cannot be read", str(error))
            return None
        end = message.get("next_sample")
        following = run.arrivals.next_sample if run is not None else None
        if run is None or not isinstance(end, int) or isinstance(end, bool):
            self._complain("an end without a whole next_sample")
        elif message.get("run_id", run.hello.run_id) != run.hello.run_id:
            self._complain("an end of another run")
        elif following is not None and not following <= end + run.offset <= MAX_SAMPLE:
            self._complain("an end at another sample than the blocks'", plain(end, 30))
        else:
            return end + run.offset
        return None

    def _ask_why_nothing_comes(self) -> None:
        trouble = self._doorbell.news()
        if trouble.reason:
            self._complain(trouble.reason)

    def _begin_anew(self, run: _Run, hello: Hello) -> _Run:
        old = run.hello
        for what in ("sample_rate_hz", "channels", "config_id"):
            if getattr(hello, what) != getattr(old, what):
                raise RunError(
                    f"the rig came back with another {what} ({getattr(old, what)} before, {getattr(hello, what)} now); "
                    "start again for a new recording"
                )
        counts = self.counts
        heard = self._last_arrival_s  # 0 before the first block: then nothing is missing
        away_s = max(0.0, time.monotonic() - heard) if heard else 0.0
        following = run.arrivals.next_sample or 0
        offset = following + round(away_s * hello.sample_rate_hz)
        fresh = _Run(hello, run.channels, run.factors, offset, Arrivals(offset, following))
        self._past, self._run = counts, fresh
        self.restarts += 1
        self.drift.restart()
        self._announced.clear()
        self._unanswered.clear()
        self._events.append(f"the rig was started again; {away_s:.1f} s without samples are masked")
        if self._off is not None:
            self.send(self._off)
        return fresh

    def _take_samples(self, frames: list[bytes]) -> Iterator[Block]:
        run = self._run
        if run is None or len(frames) != 2:
            self._complain("a message of samples has not three frames")
            return
        try:
            header = SamplesHeader.model_validate_json(frames[0])
        except ValidationError as error:
            self._complain("the header of a block cannot be read", _first(error))
            return
        if header.run_id != run.hello.run_id:
            hello = self._announced_as(header)
            if hello is None:
                # Of a run that is over, or whose hello has not come yet: its place will be masked.
                self._complain("a block of another run")
                return
            run = self._begin_anew(run, hello)
        wanted = 4 * header.n_samples * len(run.channels)
        if len(frames[1]) != wanted:
            self._complain(
                "a block has not the samples that it says",
                f"number {header.sequence} has {len(frames[1])} bytes, not {wanted}",
            )
            return
        if header.n_samples > run.hello.block_samples:
            self._complain("a block is longer than the rig's", f"{header.n_samples} samples")
            return
        values = np.frombuffer(frames[1], dtype="<f4").reshape(header.n_samples, len(run.channels))
        if np.any(run.factors != 1.0):
            values = values * run.factors
        ranges = np.array([self._ranges_by_name.get(c.name, np.inf) for c in run.channels])
        block = make_block(
            header.first_sample + run.offset, run.hello.sample_rate_hz, values, run.channels, ranges,
            config_id=plain(header.config_id), control_on=header.control_on, commands_applied=header.commands_applied,
        )  # fmt: skip
        arrived_s, counts = time.monotonic(), run.arrivals.counts
        received, stray = counts.received, counts.stray
        for due in run.arrivals.take(block, header.sequence):
            # What is handed on says that this one is believed.
            self._last_arrival_s, self._rig_notice = arrived_s, plain(header.notice, 500)
            yield due
        if counts.received == received + 1:  # in its turn: others waited for somebody
            end = header.first_sample + header.n_samples
            self.drift.take(end / run.hello.sample_rate_hz, arrived_s)
        for _ in range(counts.stray - stray):
            self._complain(
                "a block's number and place contradict those of the others", f"number {header.sequence}"
            )

    def _announced_as(self, header: SamplesHeader) -> Hello | None:
        """The hello of another run, if it has begun: with its first block, or two that agree on where it is."""
        found = [h for h in self._announced if h.run_id == header.run_id]
        if not found:
            return None
        before, self._sighted = self._sighted, header
        begins = header.sequence == 0 and header.first_sample == 0
        if before is not None and before.run_id == header.run_id:
            apart = header.sequence - before.sequence
            begins |= apart == 1 and header.first_sample == before.first_sample + before.n_samples
        return max(found, key=lambda h: self._announced[h]) if begins else None

    def _complain(self, kind: str, words: str = "") -> None:
        self._complaints.add(kind, words)


def _in_si_units(hello: Hello, plant: Plant) -> tuple[tuple[Channel, ...], Array]:
    """Columns as the plant knows them, in SI units, and the factor that takes each there."""
    expected = {s.name: s.unit for s in plant.sensor} | {a.name: a.input_unit for a in plant.actuator}
    channels, factors = [], np.ones(len(hello.channels))
    for k, sent in enumerate(hello.channels):
        wanted = expected.get(sent.name)
        found = to_si(sent.unit, wanted or "")
        if wanted is not None and (found is None or found[0] != wanted):
            raise RunError(
                f"the rig sends channel '{sent.name}' in '{sent.unit}'; plant '{plant.name}' has it in {wanted}: "
                f"have the rig say one of {', '.join(units_for(wanted))}"
            )
        unit, factors[k] = found if found is not None and found[0] in COMMON else (sent.unit, 1.0)
        channels.append(Channel(sent.name, unit))
    if len({c.name for c in channels}) < len(channels):
        raise RunError("the rig sends two channels of the same name")
    return tuple(channels), factors


def _because(trouble: Trouble) -> str:
    return f" ({trouble.reason})" if trouble.reason else ""


def _first(error: ValidationError) -> str:
    problem = error.errors()[0]
    return f"{'.'.join(str(part) for part in problem['loc']) or 'message'}: {problem['msg']}"
