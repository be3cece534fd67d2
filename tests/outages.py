"""Rig, station, viewer and browser as processes that are ended, stopped and started again in any order.

What must hold is checked after every blow: who was not hit lives on, a rig without a station switches its controller
off within half a second of its own samples, and what was recorded can be read.
"""

import contextlib
import http.client
import json
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from urllib.parse import parse_qs, urlsplit

import psutil
import zmq
from station_processes import ATMD, Station, wait_for

from twin.rig.keys import load_pair, load_public
from twin.rig.recorded import open_recording
from twin.rig.rerun_tool import rerun_environment, rerun_program
from twin.rig.wire import TOPIC_SAMPLES, guard_client

Part = Literal["rig", "station", "viewer", "browser"]
Blow = Literal["kill", "end", "stop"]
PARTS: tuple[Part, ...] = ("rig", "station", "viewer", "browser")
BLOWS: tuple[Blow, ...] = ("kill", "end", "stop")
SAFE_SAMPLES = 25_000
SPEED = 0.5
"""Of the rig: what is measured is measured in its samples, and a machine with much else to do must not matter."""

LEAST_URGENT = ["nice", "-n", "15"]
FLAGS = [
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--no-first-run",
    "--disable-background-networking",
]


@dataclass(frozen=True, slots=True)
class Heard:
    """A block of the rig, as somebody hears it who has no part in it."""

    run_id: str
    first: int
    end: int
    control_on: bool
    notice: str


class Listener(threading.Thread):
    """Hears what the rig sends and says nothing: the witness of what the rig did."""

    def __init__(self, folder: Path, port: int) -> None:
        super().__init__(name="listener", daemon=True)
        self.heard: list[Heard] = []
        self._over = threading.Event()
        self._keys, self._rig = load_pair(folder / "witness.key_secret"), load_public(folder / "rig.key")
        self._address = f"tcp://127.0.0.1:{port}"

    def run(self) -> None:
        """Listen until `close`."""
        context = zmq.Context()
        socket = context.socket(zmq.SUB)
        guard_client(socket, self._keys, self._rig)
        socket.connect(self._address)
        socket.subscribe(TOPIC_SAMPLES)
        while not self._over.is_set():
            if socket.poll(100):
                h = json.loads(socket.recv_multipart()[1])
                first = int(h["first_sample"])
                self.heard.append(
                    Heard(h["run_id"], first, first + h["n_samples"], bool(h["control_on"]), h["notice"])
                )
        context.destroy(linger=0)

    def close(self) -> None:
        """Stop listening."""
        self._over.set()
        self.join(5.0)


@dataclass
class Page:
    """The page's calls without a browser."""

    url: str
    cookie: str = ""

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        place = urlsplit(self.url)
        connection = http.client.HTTPConnection("127.0.0.1", place.port or 80, timeout=30.0)
        with contextlib.closing(connection):
            if not self.cookie:
                connection.request("GET", f"{place.path}?{place.query}")
                answer = connection.getresponse()
                answer.read()
                self.cookie = (answer.getheader("set-cookie") or "").split(";")[0]
            headers = {
                "Cookie": self.cookie,
                "Origin": f"http://{place.netloc}",
                "Content-Type": "application/json",
            }
            connection.request(method, path, None if body is None else json.dumps(body), headers)
            answer = connection.getresponse()
            return json.loads(answer.read())

    @property
    def state(self) -> dict[str, Any]:
        return dict(self.ask("GET", "/api/state"))


def until(what: str, true: Any, within_s: float = 120.0) -> None:
    """Wait for something; AssertionError with its name if it does not come."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        with contextlib.suppress(OSError, http.client.HTTPException, KeyError, IndexError, ValueError):
            if true():
                return
        time.sleep(0.05)
    raise AssertionError(f"{what}: not within {within_s:.0f} s")


@dataclass
class Everything:
    """All four, and what was measured.

    Attributes
    ----------
    safe_after_ms
        From the last block that was out when a station was hit to the end of the last one under control, in the rig's
        own samples.
    """

    folder: Path
    chromium: Path | None
    both: Station = field(init=False)
    page: Page | None = None
    processes: dict[Part, "subprocess.Popen[bytes] | None"] = field(default_factory=dict)
    stopped: set[Part] = field(default_factory=set)
    safe_after_ms: list[float] = field(default_factory=list)
    recordings: list[Path] = field(default_factory=list)
    exit_codes: dict[str, set[int]] = field(default_factory=dict)
    told: str = ""
    stream: str = "rerun+http://127.0.0.1:9/proxy"

    def __post_init__(self) -> None:
        self.both = Station(self.folder)
        subprocess.run([ATMD, "keys", "witness", "--dir", self.folder], check=True, capture_output=True)
        self.listener = Listener(self.folder, self.both.port)
        self.listener.start()

    # --- starting ---

    def start(self, part: Part) -> None:
        """Start a part, or let one that stands still go on."""
        if part in self.stopped:
            process = self.processes[part]
            assert process is not None
            for one in _family(process):
                one.resume()
            self.stopped.discard(part)
            if part == "rig" and not self.up("station") and self.blocks and self.blocks[-1].control_on:
                self._check_safe(self.blocks[-1])
            return
        getattr(self, f"_start_{part}")()

    def _start_rig(self) -> None:
        self.both.start_rig(53.0, "--station", str(self.folder / "witness.key"), "--speed", f"{SPEED:g}")
        self.processes["rig"] = self.both.rig

    def _start_station(self) -> None:
        recording = self.folder / f"run{len(self.recordings)}.rrd"
        self.recordings.append(recording)
        self.both.start_live("--save", str(recording), "--seconds", "3000", connected=False)
        self.processes["station"] = self.both.live
        if self.up("rig"):
            self._open_page()

    def _open_page(self) -> None:
        self.page = Page(wait_for(self.folder / "live.log", r"page: (\S+)", self.both.live))

    def _start_viewer(self) -> None:
        command = [rerun_program(), "--headless", "--window-size", "320x200", "--memory-limit", "100MB"]
        if self.up("station") and self.page is not None:
            # Else it comes to a stream that is not there, as somebody's viewer may.
            with contextlib.suppress(OSError, http.client.HTTPException, KeyError):
                place = urlsplit(str(self.page.state["viewer_url"]))
                connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=5.0)
                connection.request("GET", f"/?{place.query}")
                welcome = connection.getresponse()
                cookie = (welcome.getheader("set-cookie") or "").partition(";")[0]
                welcome.read()
                connection.request("GET", "/", headers={"Cookie": cookie})
                target = connection.getresponse().getheader("location") or ""
                self.stream = parse_qs(urlsplit(target).query)["url"][0]
                connection.close()
        port = self.both.port + 2 + len(self.safe_after_ms)
        self.processes["viewer"] = subprocess.Popen(
            [*LEAST_URGENT, *command, "--bind", "127.0.0.1", "--port", str(port), self.stream],
            env=rerun_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    def _start_browser(self) -> None:
        if self.chromium is None or self.page is None:
            return
        profile = self.folder / "profile"
        shutil.rmtree(profile, ignore_errors=True)
        self.processes["browser"] = subprocess.Popen(
            [*LEAST_URGENT, self.chromium, *FLAGS, f"--user-data-dir={profile}", self.page.url],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip

    # --- blows ---

    def strike(self, part: Part, blow: Blow) -> None:
        """Kill, end or stop a part, and check what must hold at once."""
        process = self.processes.get(part)
        if process is None:
            return
        watched = part == "station" and self.up("rig") and self.blocks and self.blocks[-1].control_on
        if blow == "stop":
            for one in _family(process):
                one.suspend()
            self.stopped.add(part)
        else:
            process.send_signal(signal.SIGKILL if blow == "kill" else signal.SIGTERM)
        if watched:
            time.sleep(0.05)
            self._check_safe(self.blocks[-1])
        if blow != "stop":
            code = process.wait(30.0)
            self.exit_codes.setdefault(f"{part} {blow}", set()).add(code)
            self.processes[part] = None
            if part == "browser":
                _reap(self.folder / "profile")
            if part == "station":
                self._check_words(blow)
                self.check_recording()
        time.sleep(0.3)
        for other in PARTS:
            if other != part and self.processes.get(other) is not None:
                assert self.alive(other), f"{other} did not survive {blow} of {part}: {self.words()}"

    def _check_safe(self, last: Heard) -> None:
        """Control must be off half a second after what was out when the station was hit."""
        until(
            "rig safe",
            lambda: self.blocks[-1].end > last.end + 2 * SAFE_SAMPLES or not self.alive("rig"),
            30.0,
        )
        after = [h for h in self.blocks if h.run_id == last.run_id and h.end > last.end]
        on = [h.end for h in after if h.control_on]
        self.safe_after_ms.append((max(on, default=last.end) - last.end) / 50.0)
        assert self.safe_after_ms[-1] <= 500.0, (
            f"control on {self.safe_after_ms[-1]:.0f} ms after the station"
        )
        assert not after[-1].control_on

    def _check_words(self, blow: Blow) -> None:
        self.told = (self.folder / "live.log").read_text()
        assert "Traceback" not in self.told, self.told
        if blow == "end":
            assert "recording: " in self.told

    def check_recording(self) -> None:
        """What is recorded so far can be read, whoever was hit and however."""
        recording = self.recordings[-1]
        if recording.exists():
            open_recording(recording)

    # --- what there is ---

    @property
    def blocks(self) -> list[Heard]:
        return self.listener.heard

    def alive(self, part: Part) -> bool:
        """Whether a part runs or stands still, and has not ended."""
        process = self.processes.get(part)
        return process is not None and process.poll() is None

    def up(self, part: Part) -> bool:
        return self.alive(part) and part not in self.stopped

    def words(self) -> str:
        return (self.folder / "live.log").read_text()[-2000:]

    def settle(self) -> None:
        """With rig and station up: blocks flow, the controller can be had, and obeys."""
        self._open_page()
        page = self.page
        assert page is not None
        for part in ("rig", "station"):
            assert self.up(part), self.words()
        first = [-1]

        def flows() -> bool:
            sample = int(page.state["sample"])
            first[0] = sample if first[0] < 0 else first[0]
            return sample > first[0] + 10_000 and page.state["silent_s"] < 1.0

        until(f"blocks flow ({self.words()})", flows)

        def obeys() -> bool:
            if not self.blocks[-1].control_on:
                page.ask("POST", "/api/on", {"seen_sample": page.state["sample"]})
                time.sleep(0.7)
            return self.blocks[-1].control_on

        until(f"control on ({self.words()})", obeys)

    def close(self) -> None:
        """End everything."""
        for part in PARTS:
            process = self.processes.get(part)
            if process is not None and process.poll() is None:
                for one in _family(process):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        one.kill()
                process.wait()
        _reap(self.folder / "profile")
        self.listener.close()


def _family(process: "subprocess.Popen[bytes]") -> list[psutil.Process]:
    parent = psutil.Process(process.pid)
    return [parent, *parent.children(recursive=True)]


def _reap(profile: Path) -> None:
    """What a killed browser leaves behind: only processes with this test's own profile."""
    for process in psutil.process_iter(["cmdline"]):
        if any(str(profile) in part for part in process.info["cmdline"] or ()):
            with contextlib.suppress(psutil.NoSuchProcess):
                process.kill()


@contextlib.contextmanager
def everything(folder: Path, chromium: Path | None) -> Iterator[Everything]:
    """All four parts running; ended afterwards."""
    four = Everything(folder, chromium)
    try:
        for part in PARTS:
            four.start(part)
        four.settle()
        yield four
    finally:
        four.close()


def every_pair() -> list[Part]:
    """A closed walk that goes once from every part to every other one (Hierholzer)."""
    left: dict[Part, list[Part]] = {a: [b for b in PARTS if b != a] for a in PARTS}
    stack: list[Part] = ["station"]
    walk: list[Part] = []
    while stack:
        if left[stack[-1]]:
            stack.append(left[stack[-1]].pop())
        else:
            walk.append(stack.pop())
    return walk[::-1]
