"""The station's end of the wire: blocks in, commands out, and what to do when the rig falls silent."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, Self

import numpy as np
import zmq
from pydantic import ValidationError

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.rig.programme import Programme, rig_channels
from twin.rig.wire import TOPIC_END, TOPIC_HELLO, TOPIC_SAMPLES, KeyPair, decode, encode, guard_client

CONNECT_TIMEOUT_S = 60.0
SILENCE_TIMEOUT_S = 5.0


class RigGateway:
    """One connection to a rig; iterate it for blocks.

    Lost blocks come out as blocks without a valid sample and are counted in ``dropped``.

    Parameters
    ----------
    plant
        Tells the sensors' ranges.
    samples_address, commands_address
        ``tcp://host:port`` of the rig's two sockets.
    keys
        The station's own.
    rig_public
        The rig's public key.
    """

    def __init__(
        self, plant: Plant, samples_address: str, commands_address: str, keys: KeyPair, rig_public: bytes
    ) -> None:
        self._ranges_by_name = {s.name: s.range for s in plant.sensor if s.range is not None}
        self._context = zmq.Context()
        self._samples = self._context.socket(zmq.SUB)
        self._samples.rcvhwm = 0
        self._commands = self._context.socket(zmq.DEALER)
        for socket, address in ((self._samples, samples_address), (self._commands, commands_address)):
            guard_client(socket, keys, rig_public)
            socket.connect(address)
        for topic in (TOPIC_HELLO, TOPIC_SAMPLES, TOPIC_END):
            self._samples.subscribe(topic)
        self.dropped = 0
        self.notice = ""
        self._acknowledgements: list[Acknowledgement] = []
        self._expected_sample: int | None = None

    def connect(self, is_alive: Any = lambda: True) -> None:
        """Wait until both sockets are through, then let the rig begin.

        Raises
        ------
        RunError
            If the rig does not answer in time: wrong address, wrong key, or no rig.
        """
        end = time.monotonic() + CONNECT_TIMEOUT_S
        while not self._samples.poll(100):
            if not is_alive():
                raise RunError("the rig ended before it began; its own message stands above")
            if time.monotonic() > end:
                raise RunError(f"no rig answered within {CONNECT_TIMEOUT_S:.0f} s: check address and keys")
        self._send({"type": "start"})

    def blocks(self, is_alive: Any = lambda: True) -> Iterator[Block]:
        """Blocks in order until the rig says it has finished.

        Raises
        ------
        RunError
            If the rig falls silent, dies, or sends what cannot be read.
        """
        while True:
            waited, alive = 0.0, True
            while not self._samples.poll(100):
                waited += 0.1
                if not alive:
                    raise RunError(f"The rig's process ended in mid-run{self._last_heard()}.")
                alive = is_alive()  # one more look at the socket after the process has gone
                if waited > SILENCE_TIMEOUT_S:
                    raise RunError(f"The rig has been silent for {waited:.0f} s{self._last_heard()}.")
            topic, *frames = self._samples.recv_multipart()
            if topic == TOPIC_END:
                return
            if topic == TOPIC_SAMPLES and len(frames) == 2:
                yield from self._with_gaps(self._read(frames[0], frames[1]))

    def heartbeat(self, next_sample: int) -> None:
        """Tell the rig how far the station has worked through its data."""
        self._send({"type": "heartbeat", "next_sample": next_sample})

    def send(self, command: Command) -> None:
        """Send a command; its acknowledgement arrives through `acknowledgements`."""
        self._send({"type": "command", "command": command.model_dump(mode="json")})

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """What the rig has answered since the last call."""
        while self._commands.poll(0):
            message = decode(self._commands.recv())
            if message.pop("type", "") == "ack":
                with contextlib.suppress(ValidationError):
                    self._acknowledgements.append(Acknowledgement.model_validate(message))
        answers, self._acknowledgements = tuple(self._acknowledgements), []
        return answers

    def close(self) -> None:
        """Take leave of the rig and close both sockets."""
        with contextlib.suppress(zmq.ZMQError):
            self._send({"type": "stop"})
        self._context.destroy(linger=200)

    def _send(self, message: dict[str, Any]) -> None:
        self._commands.send(encode(message), flags=zmq.NOBLOCK)

    def _last_heard(self) -> str:
        return "" if self._expected_sample is None else f" (last sample {self._expected_sample - 1})"

    def _read(self, header_frame: bytes, payload: bytes) -> Block:
        header = decode(header_frame)
        try:
            channels = tuple(Channel(c["name"], c["unit"]) for c in header["channels"])
            values = np.frombuffer(payload, dtype="<f4").reshape(header["n_samples"], len(channels))
            ranges = np.array([self._ranges_by_name.get(c.name, np.inf) for c in channels])
            self.notice = str(header.get("notice", ""))
            return make_block(
                int(header["first_sample"]), float(header["sample_rate_hz"]), values, channels, ranges,
                config_id=str(header["config_id"]), control_on=bool(header["control_on"]),
                commands_applied=tuple(int(i) for i in header["commands_applied"]),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"a block of samples cannot be read: {error!r}") from error

    def _with_gaps(self, block: Block) -> Iterator[Block]:
        """Put blocks without a valid sample in the place of lost ones."""
        expected = self._expected_sample
        if expected is not None and block.first_sample > expected:
            missing = block.first_sample - expected
            self.dropped += -(-missing // block.n_samples)
            lost = np.full((missing, len(block.channels)), np.nan)
            yield make_block(expected, block.sample_rate_hz, lost, block.channels, config_id=block.config_id)
        self._expected_sample = block.end_sample
        yield block


class EmbeddedRig:
    """A simulated rig in a process of its own, with fresh keys, and the gateway to it.

    Use as a context manager: leaving it ends the process.
    """

    def __init__(self, programme: Programme, speed: float) -> None:
        self.programme = programme
        self._speed = speed
        self._process: subprocess.Popen[bytes] | None = None
        self._gateway: RigGateway | None = None

    def __enter__(self) -> Self:
        rig_keys, station_keys = KeyPair.fresh(), KeyPair.fresh()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [sys.executable, "-m", "twin.rig.process"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
        )  # fmt: skip
        self._process = process
        order = {
            "programme": self.programme.model_dump(mode="json"),
            "rig_public": rig_keys.public.decode(),
            "rig_secret": rig_keys.secret.decode(),
            "station_public": station_keys.public.decode(),
            "speed": self._speed,
        }
        if process.stdin is None:
            raise RunError("the rig's process has no pipes")
        with contextlib.suppress(BrokenPipeError):  # `connect` will find that it is gone
            process.stdin.write(json.dumps(order).encode() + b"\n")
            process.stdin.flush()
        self._keys, self._rig_public = station_keys, rig_keys.public
        return self

    def connect(self) -> None:
        """Wait for the rig to be ready and let it begin.

        Raises
        ------
        RunError
            If its process did not start.
        """
        process = self._process
        try:
            line = process.stdout.readline() if process is not None and process.stdout is not None else b""
            ports = json.loads(line)
        except json.JSONDecodeError as error:
            raise RunError("the rig's process did not start; its own message stands above") from error
        self._gateway = RigGateway(
            self.programme.plant,
            f"tcp://127.0.0.1:{ports['samples_port']}",
            f"tcp://127.0.0.1:{ports['commands_port']}",
            self._keys,
            self._rig_public,
        )
        self._gateway.connect(self.is_alive)

    @property
    def gateway(self) -> RigGateway:
        """The connection; RunError before `connect`."""
        if self._gateway is None:
            raise RunError("the rig is not connected")
        return self._gateway

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What its blocks will hold."""
        return rig_channels(self.programme.plant)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._gateway is not None:
            self._gateway.close()
        process = self._process
        if process is None:
            return
        # Let it take its leave; a closed input tells it that nobody is left; then there is nothing to be said.
        if not _ended(process):
            with contextlib.suppress(OSError):
                if process.stdin is not None:
                    process.stdin.close()
            if not _ended(process):
                process.kill()
                process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()

    @property
    def pid(self) -> int:
        """Process number of the rig."""
        return self._process.pid if self._process is not None else 0

    def is_alive(self) -> bool:
        """Whether the rig's process runs."""
        return self._process is not None and self._process.poll() is None

    def blocks(self) -> Iterator[Block]:
        """Blocks of the rig; see `RigGateway.blocks`."""
        return self.gateway.blocks(self.is_alive)


def _ended(process: subprocess.Popen[bytes], within_s: float = 2.0) -> bool:
    try:
        process.wait(timeout=within_s)
    except subprocess.TimeoutExpired:
        return False
    return True
