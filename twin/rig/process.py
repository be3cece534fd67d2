"""The simulated rig as a process of its own: `SimulatedRig` behind the live wire.

Started with a JSON object on standard input (programme, keys, pace), it answers with one JSON line on standard
output (its ports) and then speaks only over ZeroMQ. When its standard input closes, its starter is gone and it
ends.

The rig's only clock is its sample count. At ``speed`` 1 blocks leave at the rate of a real rig; at ``speed`` 0
they leave as fast as the station's heartbeats allow, which makes a run repeatable whatever else the machine does.
"""

import contextlib
import json
import os
import select
import sys
import time
from typing import Any

import zmq
from pydantic import ValidationError
from zmq.auth.thread import ThreadAuthenticator

from twin.control.schedule import Acknowledgement, Command
from twin.plant.errors import RunError
from twin.rig.programme import Programme
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import TOPIC_END, TOPIC_HELLO, TOPIC_SAMPLES, KeyPair, decode, encode, guard_server

HEARTBEAT_TIMEOUT_S = 0.5
LEAD_BLOCKS = 2
"""Blocks the rig may be ahead of what the station has worked through, when it does not keep real time."""

START_TIMEOUT_S = 60.0
STATION_SILENT_S = 30.0
HELLO_EVERY_S = 0.02


class _OneStation:
    """Let exactly one public key in."""

    def __init__(self, public: bytes) -> None:
        self._public = public

    def callback(self, _domain: str, key: bytes) -> bool:
        """Answer the authenticator."""
        return key == self._public


class RigServer:
    """Serve one `SimulatedRig` on loopback until its programme ends or its station is gone.

    Parameters
    ----------
    rig
        What to serve.
    keys
        The rig's own.
    station_public
        The one key that may connect.
    speed
        1 keeps real time, 0 goes as fast as the station follows.
    """

    def __init__(self, rig: SimulatedRig, keys: KeyPair, station_public: bytes, speed: float) -> None:
        self.rig, self.speed = rig, speed
        self._context = zmq.Context()
        self._authenticator = ThreadAuthenticator(self._context)
        self._authenticator.start()
        self._authenticator.configure_curve_callback("rig", _OneStation(station_public))
        self._samples = self._context.socket(zmq.PUB)
        self._samples.sndhwm = 0  # a slow station is held back by its heartbeats, never by lost blocks
        self._commands = self._context.socket(zmq.ROUTER)
        for socket in (self._samples, self._commands):
            guard_server(socket, keys)
        self.samples_port = self._samples.bind_to_random_port("tcp://127.0.0.1")
        self.commands_port = self._commands.bind_to_random_port("tcp://127.0.0.1")
        self._station: bytes | None = None
        self._started = self._stopped = False
        self._station_sample = 0

    def run(self) -> None:
        """Wait for the station, run the programme, say goodbye.

        Raises
        ------
        RunError
            If no station comes or the station falls silent.
        """
        try:
            self._await_station()
            self._stream()
            self._samples.send_multipart([TOPIC_END, encode({"next_sample": self.rig.next_sample})])
            self._await(lambda: self._stopped, STATION_SILENT_S, "the station did not take its leave")
        finally:
            self._authenticator.stop()
            self._context.destroy(linger=200)

    def _await_station(self) -> None:
        self._await(lambda: self._started, START_TIMEOUT_S, "no station came", hello=True)

    def _await(self, done: Any, timeout_s: float, complaint: str, *, hello: bool = False) -> None:
        end = time.monotonic() + timeout_s
        while not done() and not self._stopped:
            if hello:
                self._samples.send_multipart([TOPIC_HELLO, encode({"version": 1})])
            self._poll(HELLO_EVERY_S)
            if _starter_gone():
                raise RunError("the starter of this rig is gone")
            if time.monotonic() > end:
                raise RunError(f"{complaint} within {timeout_s:.0f} s")

    def _stream(self) -> None:
        programme = self.rig.programme
        block_s = programme.block_s
        begin = time.monotonic()
        sequence = 0
        fallen_back = False
        while not self.rig.finished and not self._stopped:
            if self.speed > 0.0:
                self._poll(0.0)
            else:
                lead = LEAD_BLOCKS * programme.block_samples
                self._await(
                    lambda lead=lead: self.rig.next_sample - self._station_sample <= lead,
                    STATION_SILENT_S,
                    "the station fell silent",
                )
            silent_s = (self.rig.next_sample - self._station_sample) / programme.sample_rate_hz
            if self.speed > 0.0 and silent_s > HEARTBEAT_TIMEOUT_S + block_s:
                # Safe gains: none. What the station last ordered may not fit what the rig does by now.
                self.rig.control_enabled, fallen_back = False, True
            first = self.rig.next_sample
            values, control_on, acknowledgements = self.rig.next_block()
            fallen_back = fallen_back and not self.rig.control_enabled
            if self.speed > 0.0:
                due = begin + (sequence + 1) * block_s / self.speed
                while (left := due - time.monotonic()) > 0.0:
                    self._poll(left)
            header = {
                "sequence": sequence,
                "first_sample": first,
                "n_samples": len(values),
                "sample_rate_hz": programme.sample_rate_hz,
                "channels": [{"name": c.name, "unit": c.unit} for c in self.rig.channels],
                "config_id": programme.plant.fingerprint,
                "control_on": control_on,
                "commands_applied": [a.command_id for a in acknowledgements if a.accepted],
                "notice": self.rig.tripped or ("station lost: control off" if fallen_back else ""),
            }
            self._samples.send_multipart([TOPIC_SAMPLES, encode(header), values.astype("<f4").tobytes()])
            for acknowledgement in acknowledgements:
                self._answer({"type": "ack", **acknowledgement.model_dump()})
            sequence += 1
            if _starter_gone():
                raise RunError("the starter of this rig is gone")

    def _poll(self, timeout_s: float) -> None:
        if self._commands.poll(max(0, round(timeout_s * 1e3))):
            with contextlib.suppress(zmq.Again):
                while True:
                    sender, *frames = self._commands.recv_multipart(flags=zmq.NOBLOCK)
                    self._station = sender
                    self._take(frames)

    def _take(self, frames: list[bytes]) -> None:
        try:
            message = decode(frames[0]) if len(frames) == 1 else {}
        except RunError as error:
            self._answer({"type": "refused", "reason": str(error)})
            return
        match message.get("type"):
            case "start":
                self._started = True
            case "stop":
                self._stopped = True
            case "heartbeat" if isinstance(message.get("next_sample"), int):
                told = min(message["next_sample"], self.rig.next_sample)  # nobody is ahead of the rig
                self._station_sample = max(self._station_sample, told)
            case "command":
                self._command(message.get("command"))
            case _:
                self._answer({"type": "refused", "reason": "unknown message"})

    def _command(self, body: object) -> None:
        try:
            command = Command.model_validate_json(json.dumps(body))
        except ValidationError as error:
            number = body.get("command_id", 0) if isinstance(body, dict) else 0
            refusal = Acknowledgement(
                command_id=number if isinstance(number, int) else 0,
                accepted=False,
                reason=f"malformed command: {error.error_count()} problems, first: {error.errors()[0]['msg']}",
            )
            self._answer({"type": "ack", **refusal.model_dump()})
            return
        self.rig.accept(command)

    def _answer(self, message: dict[str, Any]) -> None:
        if self._station is not None:
            self._commands.send_multipart([self._station, encode(message)])


def _starter_gone() -> bool:
    """Whether standard input has closed: nobody is left who would miss this process."""
    if os.name != "posix":
        return False  # pipes cannot be polled there; the silent-station limit ends the rig instead
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and os.read(sys.stdin.fileno(), 4096) == b""


def main() -> None:
    """Entry point of the process; see the module's description."""
    order = json.loads(sys.stdin.buffer.readline())
    programme = Programme.model_validate_json(json.dumps(order["programme"]))
    rig = SimulatedRig(programme)
    _warm_up(programme)
    keys = KeyPair(order["rig_public"].encode(), order["rig_secret"].encode())
    server = RigServer(rig, keys, order["station_public"].encode(), float(order["speed"]))
    ports = {"samples_port": server.samples_port, "commands_port": server.commands_port}
    print(json.dumps(ports), flush=True)
    try:
        server.run()
    except RunError as error:
        print(f"rig: {error}", file=sys.stderr, flush=True)
        sys.exit(3)
    except KeyboardInterrupt:
        sys.exit(130)


def _warm_up(programme: Programme) -> None:
    """Compile the kernels before the first block is due."""
    short = programme.model_copy(update={"block_samples": 10})
    SimulatedRig(short).next_block()


if __name__ == "__main__":
    main()
