"""A simulated rig behind the live wire: samples out, commands in, and safe when its station is lost.

The rig's only clock is its sample count. At ``speed`` 1 blocks leave at the rate of a real rig; at ``speed`` 0
they leave as fast as the station's heartbeats allow, which makes a run repeatable whatever else the machine does.
Without heartbeats the controller goes off after half a second of the rig's samples; where these wait for the station,
after half a second of this machine's time.
"""

import contextlib
import json
import math
import secrets
import time
from collections.abc import Callable, Collection
from typing import Any, TypeGuard

import zmq
from pydantic import ValidationError
from zmq.auth.thread import ThreadAuthenticator

from twin.control.schedule import Acknowledgement, Command
from twin.plant.errors import InputError, RunError
from twin.rig.complaints import Complaints, plain
from twin.rig.daqmx import DaqmxRig
from twin.rig.messages import VERSION, Hello, SamplesHeader, WireChannel
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import (
    ANOTHER_STATION,
    TOPIC_END,
    TOPIC_HELLO,
    TOPIC_SAMPLES,
    KeyPair,
    decode,
    encode,
    guard_server,
)

HEARTBEAT_TIMEOUT_S = 0.5
"""Without a heartbeat for so long the rig switches its controller off."""

STALE_S = 1.0
"""A command due longer ago than this was meant for another situation; only switching off is never too late."""

LEAD_BLOCKS = 2
"""Blocks the rig may be ahead of what the station has worked through, when it does not keep real time."""

EARLY_S = 60.0
"""A command may be due so far ahead; and so many may wait."""
MOST_WAITING = 100

MAX_COMMAND_BYTES = 1024 * 1024
MOST_AT_ONCE = 200
"""Messages read before the rig looks at its samples again: a flood of them must not hold up a block."""

START_TIMEOUT_S = 300.0
STATION_SILENT_S = 30.0
HELLO_EVERY_S = 0.02
HELLO_EVERY_STREAMING_S = 1.0


class _KnownStations:
    """Let the listed public keys in and nobody else."""

    def __init__(self, public: Collection[bytes], complaints: Complaints) -> None:
        self._public, self._complaints = frozenset(public), complaints

    def callback(self, _domain: str, key: bytes) -> bool:
        """Answer the authenticator."""
        known = key in self._public
        if not known:
            self._complaints.add("a station with an unknown key was refused", key.decode("ascii", "replace"))
        return known


class RigServer:
    """Serve one rig, simulated or measured by a device, until its programme ends or whoever started it is gone.

    Parameters
    ----------
    rig
        What to serve.
    keys
        The rig's own.
    stations
        Public keys that may connect.
    speed
        1 keeps real time, 0 goes as fast as the station follows; a rig of its own then keeps real time without one.
    host, samples_port, commands_port
        Where to bind; port 0 takes a free one.
    stands_alone
        A rig of its own: it runs whether a station is there or not, and stations come and go. Otherwise it waits
        for one station, and ends with it.
    starter_gone
        Whether nobody is left who would miss this rig.
    say
        Takes lines for the person at the rig: what was refused and why, and who has the controls.

    Attributes
    ----------
    complaints
        What was refused, by reason.

    Raises
    ------
    InputError
        If it cannot bind.
    """

    def __init__(
        self,
        rig: SimulatedRig | DaqmxRig,
        keys: KeyPair,
        stations: Collection[bytes],
        speed: float,
        *,
        host: str = "127.0.0.1",
        samples_port: int = 0,
        commands_port: int = 0,
        stands_alone: bool = False,
        starter_gone: Callable[[], bool] = lambda: False,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.rig, self.speed = rig, speed
        self._say, self.complaints = say, Complaints()
        self._stands_alone, self._starter_gone = stands_alone, starter_gone
        self._context = zmq.Context()
        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.start()
        self._authenticator.configure_curve_callback("rig", _KnownStations(stations, self.complaints))
        self._samples = self._context.socket(zmq.PUB)
        # A slow station is held back by its heartbeats; a rig of its own waits for nobody.
        self._samples.sndhwm = 600 if stands_alone else 0
        self._commands = self._context.socket(zmq.ROUTER)
        for socket in (self._samples, self._commands):
            guard_server(socket, keys)
        try:
            self.samples_port = _bind(self._samples, host, samples_port)
            self.commands_port = _bind(self._commands, host, commands_port)
        except InputError:
            self._close()
            raise
        self._run_id = secrets.token_hex(8)
        self._station: bytes | None = None
        self._sent_sample = self._heard_sample = 0
        self._heard_s = 0.0
        self._started = self._stopped = self._fallen_back = False
        self._station_sample = self._last_command = 0
        self._hello_due = 0.0

    def run(self) -> None:
        """Run the programme, with or without waiting for a station, and say goodbye.

        Raises
        ------
        RunError
            If no station comes or the station falls silent, where the rig depends on one.
        """
        try:
            if not self._stands_alone:
                self._await(lambda: self._started, START_TIMEOUT_S, "no station came", hello=True)
            self._stream()
            self._samples.send_multipart(
                [TOPIC_END, encode({"next_sample": self.rig.next_sample, "run_id": self._run_id})]
            )
            if not self._stands_alone:
                self._await(lambda: self._stopped, STATION_SILENT_S, "the station did not take its leave")
        finally:
            self._close()

    def _close(self) -> None:
        self._authenticator.stop()
        self._context.destroy(linger=200)

    def _await(
        self, done: Callable[[], bool], timeout_s: float, complaint: str, *, hello: bool = False
    ) -> None:
        end = time.monotonic() + timeout_s
        while not done() and not self._stopped:
            if hello:
                self._say_hello()
            self._poll(HELLO_EVERY_S)
            if self._starter_gone():
                raise RunError("the starter of this rig is gone")
            if time.monotonic() > end:
                raise RunError(f"{complaint} within {timeout_s:.0f} s")

    def _stream(self) -> None:
        programme = self.rig.programme
        self._last_block_s = time.monotonic()
        while not self.rig.finished and not self._stopped:
            if self.speed > 0.0:
                self._poll(0.0)
                self._watch_the_station()
            elif self._stands_alone:
                self._await_leisurely()
            else:
                lead = LEAD_BLOCKS * programme.block_samples
                self._await(
                    lambda lead=lead: self.rig.next_sample - self._station_sample <= lead,  # type: ignore[misc]
                    STATION_SILENT_S,
                    "the station fell silent",
                )
            if time.monotonic() >= self._hello_due:
                self._say_hello()
                self._hello_due = time.monotonic() + HELLO_EVERY_STREAMING_S
            values, control_on, acknowledgements = self.rig.next_block()
            first = self.rig.next_sample - len(values)
            sequence = first // programme.block_samples  # a device's overrun leaves blocks out
            self._fallen_back = self._fallen_back and not self.rig.control_enabled
            if self.speed > 0.0:
                self._await_due(programme.block_s / self.speed)
            header = SamplesHeader(
                run_id=self._run_id,
                sequence=sequence,
                first_sample=first,
                n_samples=len(values),
                config_id=programme.plant.fingerprint,
                control_on=control_on,
                commands_applied=tuple(a.command_id for a in acknowledgements if a.accepted),
                notice=self.rig.tripped or ("station lost: control off" if self._fallen_back else ""),
            )
            self._sent_sample = self.rig.next_sample
            samples = values.astype("<f4").tobytes()
            self._samples.send_multipart([TOPIC_SAMPLES, header.model_dump_json().encode(), samples])
            for acknowledgement in acknowledgements:
                self._answer(self._station, {"type": "ack", **acknowledgement.model_dump()})
            if self._starter_gone():
                raise RunError("the starter of this rig is gone")

    def _await_due(self, period_s: float) -> None:
        """Wait until the block's time has come; what was missed while this process stood still is not made up for."""
        due = self._last_block_s + period_s
        if time.monotonic() - due > HEARTBEAT_TIMEOUT_S:
            due = time.monotonic()
        while (left := due - time.monotonic()) > 0.0:
            self._poll(left)
        self._last_block_s = due

    def _await_leisurely(self) -> None:
        """Wait for the station as long as there is one, and for nobody longer than in real time."""
        programme = self.rig.programme
        lead = LEAD_BLOCKS * programme.block_samples
        while True:
            self._poll(0.0)
            now = time.monotonic()
            if self._station is None:
                self._watch_the_station()
                left = self._last_block_s + programme.block_s - now
            elif self.rig.next_sample - self._station_sample <= lead:
                left = 0.0
            else:
                left = self._heard_s + HEARTBEAT_TIMEOUT_S - now
                if left <= 0.0:
                    self._lose_the_station()
            if left <= 0.0:
                self._last_block_s = now
                return
            self._poll(left)

    def _watch_the_station(self) -> None:
        """Switch control off so early that the coming block ends within the time a station may be silent."""
        programme = self.rig.programme
        silent = self.rig.next_sample + programme.block_samples - self._heard_sample
        if silent > HEARTBEAT_TIMEOUT_S * programme.sample_rate_hz:
            self._lose_the_station()

    def _lose_the_station(self) -> None:
        # Safe gains: none. What the station last ordered may not fit what the rig does by now.
        if self._station is not None or self.rig.control_enabled:
            self._say(f"no station for {HEARTBEAT_TIMEOUT_S:g} s: control off")
        if self.rig.control_enabled:
            self.rig.control_enabled, self._fallen_back = False, True
        self._station = None if self._stands_alone else self._station

    def _say_hello(self) -> None:
        programme = self.rig.programme
        hello = Hello(
            version=VERSION,
            run_id=self._run_id,
            sample_rate_hz=programme.sample_rate_hz,
            block_samples=programme.block_samples,
            channels=tuple(WireChannel(name=c.name, unit=c.unit) for c in self.rig.channels),
            plant=programme.plant.name,
            config_id=programme.plant.fingerprint,
            schedule=self.rig.schedule,
            measurement=programme.measurement,
            loop_delay_samples=programme.loop_delay_samples,
            waits_for_start=not self._stands_alone,
        )
        self._samples.send_multipart([TOPIC_HELLO, hello.model_dump_json().encode()])

    def _poll(self, timeout_s: float) -> None:
        if self._commands.poll(max(0, math.ceil(timeout_s * 1e3))):
            with contextlib.suppress(zmq.Again):
                for _ in range(MOST_AT_ONCE):
                    sender, *frames = self._commands.recv_multipart(flags=zmq.NOBLOCK)
                    self._take(sender, frames)
        for line in self.complaints.said():
            self._say(line)

    def _take(self, sender: bytes, frames: list[bytes]) -> None:
        message = self._read(sender, frames)
        if message is None:
            return
        kind = message["type"]
        taken_over = self._station is None and kind != "stop"
        if taken_over:
            self._give_controls(sender)
        if sender != self._station:
            if kind == "command":
                self._refuse_command(sender, message.get("command"), ANOTHER_STATION)
            elif kind == "start":
                self._refuse(sender, ANOTHER_STATION)
            return
        match kind:
            case "start":
                self._started = True
            case "stop":
                self._leave()
            case "heartbeat" if _whole(message.get("next_sample")):
                told = min(message["next_sample"], self.rig.next_sample)  # nobody is ahead of the rig
                if taken_over:
                    self._station_sample = (
                        told - 1
                    )  # it may have been listening, and have blocks to catch up with
                if told > self._station_sample:  # one that repeats itself has stopped working
                    self._station_sample, self._heard_sample = told, self._sent_sample
                    self._heard_s = time.monotonic()
            case "command":
                self._command(sender, message.get("command"))
            case _:
                self._refuse(sender, "a heartbeat needs a whole next_sample")

    def _read(self, sender: bytes, frames: list[bytes]) -> dict[str, Any] | None:
        """One message; None, and the sender told, if it is none."""
        size = sum(map(len, frames))
        if len(frames) != 1:
            self._refuse(sender, f"a message has one frame, not {len(frames)}")
        elif size > MAX_COMMAND_BYTES:
            self._refuse(sender, f"a message of {size} bytes is too large; {MAX_COMMAND_BYTES} are taken")
        else:
            try:
                message = decode(frames[0])
            except RunError as error:
                self._refuse(sender, str(error))
                return None
            kind = message.get("type")
            if isinstance(kind, str) and kind in ("start", "stop", "heartbeat", "command"):
                return message
            self._refuse(sender, "unknown message")
        return None

    def _refuse(self, sender: bytes, reason: str) -> None:
        self.complaints.add("a message was refused", reason)
        self._answer(sender, {"type": "refused", "reason": plain(reason)})

    def _refuse_command(self, sender: bytes, body: object, reason: str) -> None:
        self.complaints.add("a command was refused", reason)
        self._answer(sender, _refusal(body, plain(reason, 500)))

    def _give_controls(self, sender: bytes) -> None:
        """Whoever speaks first has the controls, until leaving or falling silent; what was before it is not its own."""
        self._station, self._last_command = sender, 0
        self._station_sample, self._heard_sample = self.rig.next_sample, self._sent_sample
        self._heard_s = time.monotonic()
        self._answer(sender, {"type": "controls"})
        self._say("a station has the controls")

    def _leave(self) -> None:
        self._say("the station took its leave")
        if not self._stands_alone:
            self._stopped = True
            return
        self._station = None
        if self.rig.control_enabled:
            self.rig.control_enabled, self._fallen_back = False, True

    def _command(self, sender: bytes, body: object) -> None:
        try:
            command = Command.model_validate_json(json.dumps(body))
        except ValidationError as error:
            problem = error.errors()[0]["msg"]
            reason = f"malformed command: {error.error_count()} problems, first: {problem}"
            self._refuse_command(sender, body, reason)
            return
        reason = self._objection(command)
        if reason:
            self._refuse_command(sender, body, reason)
            return
        self._last_command = command.command_id
        self.rig.accept(command)

    def _objection(self, command: Command) -> str:
        rig = self.rig
        if command.command_id <= self._last_command:
            return (
                f"command {command.command_id} follows command {self._last_command}: repeated or out of order"
            )
        if command.config_id and command.config_id != rig.programme.plant.fingerprint:
            return (
                f"command {command.command_id} was made for model {command.config_id}, "
                f"this rig is set up for {rig.programme.plant.fingerprint}"
            )
        rate = rig.programme.sample_rate_hz
        if command.apply_at_sample > rig.next_sample + EARLY_S * rate:
            return f"command {command.command_id} is due more than {EARLY_S:g} s ahead"
        if rig.waiting >= MOST_WAITING:
            return f"command {command.command_id} finds {rig.waiting} others waiting for their samples"
        late_s = (rig.next_sample - command.apply_at_sample) / rate
        only_off = command.schedule is None and command.control_enabled is False
        if self.speed > 0.0 and late_s > STALE_S and not only_off:
            return f"command {command.command_id} is stale: it was due {late_s:.1f} s ago"
        return ""

    def _answer(self, station: bytes | None, message: dict[str, Any]) -> None:
        if station is not None:
            with contextlib.suppress(zmq.Again):
                self._commands.send_multipart([station, encode(message)], flags=zmq.NOBLOCK)


def _bind(socket: "zmq.Socket[bytes]", host: str, port: int) -> int:
    try:
        if port == 0:
            return int(socket.bind_to_random_port(f"tcp://{host}"))
        socket.bind(f"tcp://{host}:{port}")
    except zmq.ZMQError as error:
        raise InputError(
            f"the rig cannot listen on {host}:{port} ({error.strerror}); choose another --port or --bind"
        ) from error
    return port


def _whole(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= 2**62


def _refusal(body: object, reason: str) -> dict[str, Any]:
    number = body.get("command_id") if isinstance(body, dict) else None
    refused = Acknowledgement(command_id=number if _whole(number) else 0, accepted=False, reason=reason)
    return {"type": "ack", **refused.model_dump()}
