"""A simulated rig in a process of its own, started and ended with the program that wants it."""

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from types import TracebackType
from typing import Self

from twin.plant.blocks import Block, Channel
from twin.plant.errors import RunError
from twin.rig.gateway import RigGateway
from twin.rig.programme import Programme, rig_channels
from twin.rig.wire import KeyPair


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
