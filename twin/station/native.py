"""Rerun's own window: started on a stream that we serve, started again when it dies, and told where to go on.

The stream is served by this program and fetched by viewers (`Broadcast`), so that a viewer which dies, hangs or starts
anew never holds up whoever writes: it fetches what it missed when it can, as far as the server has kept it.
"""

import contextlib
import re
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Sequence

import rerun as rr
from rerun.experimental import ViewerClient

from twin.plant.errors import RunError
from twin.rig.rerun_tool import rerun_environment, rerun_program
from twin.station.columns import TIMELINE

HOST = "127.0.0.1"
MEMORY_LIMIT = "100MB"
"""What the server keeps of a run for viewers that come late or come again; some four minutes of the rig."""

BEHIND_S = 5.0
"""A viewer that has not got on although there is so much more data to see has lost its connection."""

_START_TIMEOUT_S = 20.0
_LOOK_S = 1.0
_MOST_STARTS = 5


class Broadcast:
    """Serves one stream to any number of viewers on this machine.

    Parameters
    ----------
    stream
        Its sinks are replaced.
    memory_limit
        How much of the run is kept, such as ``100MB``.

    Attributes
    ----------
    url
        To be opened in a viewer; ``rerun URL`` shows the run in another window.
    """

    def __init__(
        self, stream: rr.RecordingStream, memory_limit: str = MEMORY_LIMIT, origins: Sequence[str] = ()
    ) -> None:
        port = free_port()
        self.url = f"rerun+http://{HOST}:{port}/proxy"
        stream.set_sinks(
            rr.GrpcServerSink(
                bind_ip=HOST,
                port=port,
                server_memory_limit=memory_limit,
                newest_first=True,  # who comes late sees what is now, and then what was
                cors_allow_origin=list(origins),
            )
        )


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

    def start(self, source: str = "") -> str:
        """Start the viewer and return the URL at which it takes orders and data.

        Parameters
        ----------
        source
            URL of a stream to show, of a `Broadcast`.

        Raises
        ------
        RunError
            If it does not come up, for want of a display or a graphics driver.
        """
        port = free_port()
        command = [rerun_program(), *([source] if source else []), "--bind", HOST, "--port", str(port)]
        command += ["--hide-welcome-screen"]
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

    @property
    def exit_code(self) -> int | None:
        """Of the viewer that was started last; None while it runs, negative if a signal ended it."""
        return None if self._process is None else self._process.poll()

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


class ViewerKeeper:
    """Keeps a window on a stream, from a thread of its own.

    A viewer that crashes or is killed is started again; one that a person closes stays closed. One that hung so long
    that its connection was cut is told to fetch the stream anew.

    Parameters
    ----------
    viewer
        Not yet started.
    source
        URL of the stream.

    Attributes
    ----------
    shown_s
        End of what the stream was given [s]; set by whoever feeds it.
    seen_s
        End of what the viewer has; None before it has said so.
    starts, reconnections
        How often it was started, and told to fetch the stream anew.

    Raises
    ------
    RunError
        If the viewer does not come up.
    """

    def __init__(self, viewer: NativeViewer, source: str) -> None:
        self._viewer, self._source = viewer, source
        self._control = viewer.start(source)
        self.shown_s = 0.0
        self.seen_s: float | None = None
        self.starts, self.reconnections = 1, 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._keep, name="viewer keeper", daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Wait until the viewer has seen all, no longer than the time-out [s], and let go of it."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline and self._is_behind(0.05) and self._viewer.exit_code is None:
            time.sleep(0.05)
        self._done.set()

    def _is_behind(self, by_s: float) -> bool:
        return self.seen_s is None or self.seen_s < self.shown_s - by_s

    def _keep(self) -> None:
        client: ViewerClient | None = None
        stuck = 0
        while not self._done.wait(_LOOK_S):
            code = self._viewer.exit_code
            if code is not None:
                client, self.seen_s, stuck = None, None, 0
                if code == 0 or self.starts >= _MOST_STARTS:
                    return
                with contextlib.suppress(RunError):
                    self.starts += 1
                    self._control = self._viewer.start(self._source)
                continue
            before = self.seen_s
            # A viewer that hangs lets a call wait for 15 s, and then fail: it is asked again.
            with contextlib.suppress(Exception):
                client = client or ViewerClient.connect(self._control)
                self.seen_s = _end_s(client)
                stuck = stuck + 1 if self._is_behind(BEHIND_S) and self.seen_s == before else 0
                if stuck >= 3:
                    client.close(store_ids=[r.store_id for r in client.get_state().recordings])
                    client.open(self._source)
                    self.reconnections += 1
                    stuck = 0


def _end_s(client: ViewerClient) -> float | None:
    """End of the data that a viewer has [s]."""
    timelines = [t for recording in client.get_state().recordings for t in recording.timelines]
    ends = [t.end for t in timelines if t.name == TIMELINE and t.end is not None]
    return 1e-9 * max(ends) if ends else None


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
