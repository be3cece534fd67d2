"""People watching while the loop runs: a thread of its own feeds their stream and drops what they cannot take."""

import re
import socket
import subprocess
import tempfile
import threading
import time
from collections import deque

import rerun as rr

from twin.plant.errors import RunError
from twin.rig.rerun_tool import rerun_environment, rerun_program
from twin.station.frame import Frame
from twin.station.rerun_view import RerunView

_START_TIMEOUT_S = 20.0


class LiveView:
    """Hands frames to a view from another thread, so that a slow, stalled or dead viewer costs frames only.

    Parameters
    ----------
    view
        The view; nobody else may use it or its stream from now on.
    depth
        Frames that may wait; the oldest goes when another one comes.
    keep_stream
        Leave the stream connected at the end: a `WebViewer` goes on serving what it was given.
    viewer
        The viewer it feeds if that was started here; one that no longer answers at the end is stopped.

    Attributes
    ----------
    dropped
        Frames that nobody saw.
    error
        What stopped the view, if anything did.
    """

    def __init__(
        self,
        view: RerunView,
        *,
        depth: int = 50,
        keep_stream: bool = False,
        viewer: "NativeViewer | None" = None,
    ) -> None:
        self._at_end = view.send if keep_stream else view.disconnect
        self._view = view
        self._viewer = viewer
        self._depth = depth
        self._waiting: deque[Frame] = deque()
        self._change = threading.Condition()
        self._closing = False
        self.dropped = 0
        self.error: Exception | None = None
        self._thread = threading.Thread(target=self._feed, name="live view", daemon=True)
        self._thread.start()

    def show(self, frame: Frame) -> None:
        """Queue a frame; returns at once."""
        with self._change:
            if self._closing or self.error is not None:
                self.dropped += 1
                return
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append(frame)
            self._change.notify()

    def close(self, timeout_s: float = 2.0) -> None:
        """Show what waits and finish, for as long as that takes but no longer than the time-out [s]."""
        with self._change:
            self._closing = True
            self._change.notify()
        self._thread.join(timeout_s)
        if not self._thread.is_alive():
            return
        with self._change:
            self.dropped += len(self._waiting)
            self._waiting.clear()
        if self._viewer is not None:
            self._viewer.stop()
            self._thread.join(timeout_s)
        if self._thread.is_alive():
            # At exit Rerun would wait for this viewer for ever; the thread that waits instead ends with us.
            rr.unregister_shutdown()

    def _feed(self) -> None:
        while True:
            with self._change:
                while not self._waiting and not self._closing:
                    self._change.wait()
                if not self._waiting:
                    break
                frame = self._waiting.popleft()
            try:
                self._view.show(frame)
            except Exception as error:  # the run must go on whatever the viewer does
                with self._change:
                    self.error = error
                    self.dropped += 1 + len(self._waiting)
                    self._waiting.clear()
                return
        self._at_end()


class NativeViewer:
    """Rerun's own window, reachable from this machine only and without telemetry.

    Parameters
    ----------
    memory_limit
        Where the viewer begins to forget the oldest data, such as ``200MB``; it needs about 400 MB besides.
    headless
        Draw nothing on a screen; for tests and pictures.
    """

    def __init__(self, *, memory_limit: str = "200MB", headless: bool = False) -> None:
        self._memory_limit = memory_limit
        self._headless = headless
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> str:
        """Start the viewer and return the URL that a stream connects to.

        Raises
        ------
        RunError
            If it does not come up, for want of a display or a graphics driver.
        """
        port = free_port()
        command = [rerun_program(), "--bind", "127.0.0.1", "--port", str(port), "--hide-welcome-screen"]
        command += ["--memory-limit", self._memory_limit, "--server-memory-limit", "10MB"]
        command += ["--window-size", "1600x1000", *(["--headless"] if self._headless else [])]
        with tempfile.TemporaryFile() as log:
            self._process = subprocess.Popen(
                command, env=rerun_environment(), stdout=subprocess.DEVNULL, stderr=log
            )
            deadline = time.monotonic() + _START_TIMEOUT_S
            while not _listens(port):
                if self._process.poll() is not None or time.monotonic() > deadline:
                    self.stop()
                    log.seek(0)
                    raise RunError(f"the Rerun viewer did not start: {last_words(log.read())}")
                time.sleep(0.05)
        return f"rerun+http://127.0.0.1:{port}/proxy"

    @property
    def pid(self) -> int | None:
        """Process id while it runs."""
        return None if self._process is None else self._process.pid

    def stop(self) -> None:
        """Close the viewer, if it runs."""
        if self._process is None:
            return
        if self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(2.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


def free_port() -> int:
    """Return a TCP port of this machine that nobody uses at the moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def last_words(log: bytes) -> str:
    """Return the last line of a program's log that says something, without colours."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", log.decode(errors="replace"))
    lines = [
        line.strip() for line in plain.splitlines() if re.search("error|panick|fail|no ", line, re.IGNORECASE)
    ]
    return lines[-1][:300] if lines else "it gave no reason"


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(0.2)
        return probe.connect_ex(("127.0.0.1", port)) == 0
