"""A rig and a station as a person starts them: real processes, real keys, real sockets."""

import contextlib
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ATMD = Path(sys.executable).with_name("atmd")


def two_free_ports() -> int:
    """First of two neighbouring free ports."""
    while True:
        with socket.socket() as one, socket.socket() as two:
            one.bind(("127.0.0.1", 0))
            port = int(one.getsockname()[1])
            with contextlib.suppress(OSError, OverflowError):
                two.bind(("127.0.0.1", port + 1))
                return port


def wait_for(log: Path, pattern: str, process: subprocess.Popen[bytes], within_s: float = 90.0) -> str:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if found := re.search(pattern, log.read_text()):
            return found[found.re.groups]
        if process.poll() is not None:
            break
        time.sleep(0.05)
    raise AssertionError(f"'{pattern}' never came: {log.read_text()}")


def atmd(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end."""
    return subprocess.run(
        [ATMD, *arguments], capture_output=True, text=True, check=False, env=os.environ | {"COLUMNS": "200"}
    )


class Station:
    """``atmd rig`` and ``atmd live`` side by side in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.port = two_free_ports()
        self.url = ""
        for name in ("rig", "station"):
            subprocess.run([ATMD, "keys", name, "--dir", folder], check=True, capture_output=True)

    def _start(self, name: str, *arguments: str | Path) -> subprocess.Popen[bytes]:
        log = self.folder / f"{name}.log"
        with log.open("wb") as out:
            return subprocess.Popen(
                [ATMD, *arguments],
                stdout=out,
                stderr=out,
                cwd=self.folder,
                env=os.environ | {"COLUMNS": "200"},
            )

    def start_rig(self, hz: float = 53.0, *more: str) -> None:
        self.rig = self._start(
            "rig", "rig", "--keys", self.folder / "rig.key_secret", "--station", self.folder / "station.key",
            "--port", str(self.port), "--pattern", "tone", "--band", f"{hz:g}:{hz + 1:g}",
            *more,
        )  # fmt: skip
        wait_for(self.folder / "rig.log", "samples on", self.rig)

    def start_live(self, *more: str, connected: bool = True) -> None:
        """Start the station; ``connected`` False does not wait until it has heard of the rig."""
        self.live = self._start(
            "live", "live", f"tcp://127.0.0.1:{self.port}", "--plant", "rig",
            "--keys", self.folder / "station.key_secret", "--rig", self.folder / "rig.key",
            "--save", self.folder / "live.rrd", *more,
        )  # fmt: skip
        wait_for(self.folder / "live.log", "connected: " if connected else "waiting for", self.live)
        if "--no-web" not in more and connected:
            self.url = wait_for(self.folder / "live.log", r"page: (\S+)", self.live)

    def end_live(self) -> str:
        self.live.send_signal(signal.SIGINT)
        self.live.wait(30.0)
        return (self.folder / "live.log").read_text()

    def close(self) -> None:
        for process in (getattr(self, "live", None), getattr(self, "rig", None)):
            if process is not None and process.poll() is None:
                process.kill()
                process.wait()


@contextlib.contextmanager
def station(folder: Path) -> Iterator[Station]:
    both = Station(folder)
    try:
        yield both
    finally:
        both.close()
