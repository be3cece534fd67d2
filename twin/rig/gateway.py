"""The station's end of the wire: blocks in, commands out, and what to do when the rig falls silent."""

import contextlib
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
from twin.rig.drift import ClockDrift
from twin.rig.messages import VERSION, Hello, SamplesHeader
from twin.rig.units import COMMON, to_si, units_for
from twin.rig.wire import TOPIC_END, TOPIC_HELLO, TOPIC_SAMPLES, KeyPair, decode, encode, guard_client

CONNECT_TIMEOUT_S = 60.0
SILENCE_TIMEOUT_S = 5.0
POLL_MS = 100


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
    notice
        What the rig says of itself, with the latest block; empty if nothing.
    drift
        `ClockDrift` of rig against station.
    malformed
        Messages that could not be read and were left out.
    restarts
        How often the rig began anew.
    """

    def __init__(
        self, plant: Plant, samples_address: str, commands_address: str, keys: KeyPair, rig_public: bytes
    ) -> None:
        self._plant = plant
        self._ranges_by_name = {s.name: s.range for s in plant.sensor if s.range is not None}
        self._context = zmq.Context()
        self._samples = self._context.socket(zmq.SUB)
        self._samples.rcvhwm = 0
        self._commands = self._context.socket(zmq.DEALER)
        # An emergency stop goes out from another thread than the loop's; a socket stands one at a time.
        self._lock = threading.Lock()
        for socket, address in ((self._samples, samples_address), (self._commands, commands_address)):
            guard_client(socket, keys, rig_public)
            socket.connect(address)
        for topic in (TOPIC_HELLO, TOPIC_SAMPLES, TOPIC_END):
            self._samples.subscribe(topic)
        self.notice = ""
        self.drift = ClockDrift()
        self.malformed = self.restarts = 0
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
        end = time.monotonic() + timeout_s
        while self._run is None:
            while not self._samples.poll(POLL_MS):
                if not is_alive():
                    raise RunError("the rig ended before it began; its own message stands above")
                if time.monotonic() > end:
                    raise RunError(f"no rig answered within {timeout_s:.0f} s: check address and keys")
            topic, *frames = self._samples.recv_multipart()
            if topic == TOPIC_HELLO:
                self._greet(frames)
            elif time.monotonic() > end:
                raise RunError(
                    f"the rig sends samples but no hello of protocol version {VERSION} within {timeout_s:.0f} s; "
                    "see docs/protocol.md"
                )
        if start:
            self._send({"type": "start"})
        return self._run.hello

    def start(self) -> None:
        """Let the rig begin; what it has sent while the station made itself ready is left out."""
        while self._samples.poll(0):
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
        while True:
            silent_since, alive = time.monotonic(), True
            while not self._samples.poll(POLL_MS):
                waited = time.monotonic() - silent_since
                if not alive:
                    raise RunError(f"The rig's process ended in mid-run{self._last_heard()}.")
                alive = is_alive()  # one more look at the socket after the process has gone
                if waited > patience_s:
                    raise RunError(f"The rig has been silent for {waited:.0f} s{self._last_heard()}.")
                if on_silence is not None:
                    on_silence(waited)
            topic, *frames = self._samples.recv_multipart()
            if topic == TOPIC_END:
                if self._run is not None:
                    yield from self._run.arrivals.flush()
                return
            if topic == TOPIC_HELLO:
                self._greet(frames)
            elif topic == TOPIC_SAMPLES:
                yield from self._take_samples(frames)

    def heartbeat(self, next_sample: int) -> None:
        """Tell the rig how far the station has worked through its data."""
        self._send({"type": "heartbeat", "next_sample": max(0, next_sample - self._offset)})

    def send(self, command: Command) -> None:
        """Send a command, from any thread; its acknowledgement arrives through `acknowledgements`."""
        due = max(0, command.apply_at_sample - self._offset)
        message = command.model_copy(update={"apply_at_sample": due}).model_dump(mode="json")
        self._send({"type": "command", "command": message})

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """What the rig has answered since the last call."""
        while frames := self._answer():
            try:
                message = decode(frames[0]) if len(frames) == 1 else {}
                kind = message.pop("type", "")
                if kind == "ack":
                    answer = Acknowledgement.model_validate(message)
                    if answer.applied_at_sample is not None:
                        at = answer.applied_at_sample + self._offset
                        answer = answer.model_copy(update={"applied_at_sample": at})
                    self._acknowledgements.append(answer)
                elif kind == "refused":
                    self._events.append(f"the rig refused a message: {str(message.get('reason', ''))[:200]}")
                else:
                    self.malformed += 1
            except (RunError, ValidationError):
                self.malformed += 1
        answers, self._acknowledgements = tuple(self._acknowledgements), []
        return answers

    def events(self) -> tuple[str, ...]:
        """What has happened to the connection since the last call, in words."""
        events, self._events = tuple(self._events), []
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

    def _send(self, message: dict[str, Any]) -> None:
        # A rig that is away and a full queue: heartbeats and commands for then would come too late anyway.
        with self._lock, contextlib.suppress(zmq.Again):
            if not self._commands.closed:
                self._commands.send(encode(message), flags=zmq.NOBLOCK)

    def _last_heard(self) -> str:
        following = self._run.arrivals.next_sample if self._run is not None else None
        return "" if following is None else f" (last sample {following - 1})"

    def _greet(self, frames: list[bytes]) -> None:
        try:
            hello = Hello.model_validate_json(frames[0] if len(frames) == 1 else b"")
        except ValidationError as error:
            self._complain(f"a hello cannot be read: {_first(error)}")
            return
        run = self._run
        if run is None:
            self._run = _Run(hello, *_in_si_units(hello, self._plant))
            if hello.config_id and hello.config_id != self._plant.fingerprint:
                self._events.append(
                    f"the rig is set up for plant '{hello.plant}' ({hello.config_id}), "
                    f"this station models '{self._plant.name}' ({self._plant.fingerprint})"
                )
        elif hello.run_id != run.hello.run_id:
            self._begin_anew(run, hello)

    def _begin_anew(self, run: _Run, hello: Hello) -> None:
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
        fresh = _Run(
            hello, run.channels, run.factors, offset=following + round(away_s * hello.sample_rate_hz)
        )
        fresh.arrivals.next_sample = following
        self._past, self._run = counts, fresh
        self.restarts += 1
        self.drift.restart()
        self._events.append(f"the rig was started again; {away_s:.1f} s without samples are masked")
        if hello.waits_for_start:
            self._send({"type": "start"})

    def _take_samples(self, frames: list[bytes]) -> Iterator[Block]:
        run = self._run
        if run is None or len(frames) != 2:
            self._complain("a message of samples has not three frames")
            return
        try:
            header = SamplesHeader.model_validate_json(frames[0])
        except ValidationError as error:
            self._complain(f"the header of a block cannot be read: {_first(error)}")
            return
        if header.run_id != run.hello.run_id:
            return  # of a run whose hello has not come yet: its place will be masked
        wanted = 4 * header.n_samples * len(run.channels)
        if len(frames[1]) != wanted:
            self._complain(f"block {header.sequence} has {len(frames[1])} bytes of samples, not {wanted}")
            return
        self._last_arrival_s = time.monotonic()
        rate = run.hello.sample_rate_hz
        self.drift.take((header.first_sample + header.n_samples) / rate, self._last_arrival_s)
        self.notice = header.notice
        values = np.frombuffer(frames[1], dtype="<f4").reshape(header.n_samples, len(run.channels))
        if np.any(run.factors != 1.0):
            values = values * run.factors
        ranges = np.array([self._ranges_by_name.get(c.name, np.inf) for c in run.channels])
        block = make_block(
            header.first_sample + run.offset, rate, values, run.channels, ranges,
            config_id=header.config_id, control_on=header.control_on, commands_applied=header.commands_applied,
        )  # fmt: skip
        yield from run.arrivals.take(block, header.sequence)

    def _complain(self, what: str) -> None:
        self.malformed += 1
        if self.malformed <= 10:  # a flood of garbage must not become a flood of events
            self._events.append(what)


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


def _first(error: ValidationError) -> str:
    problem = error.errors()[0]
    return f"{'.'.join(str(part) for part in problem['loc']) or 'message'}: {problem['msg']}"
