"""A long live run with real processes: blocks lost, memory, file descriptors and threads, while somebody watches.

``python -m benchmarks soak --minutes 60`` runs ``atmd rig`` and ``atmd live`` side by side as a person would, the rig
as fast as the station follows, with a recording in several files, the operator page open and what-if questions asked.
Memory is proportional set size (``Pss`` of ``smaps_rollup``): pages that processes share are counted once in all.
"""

import argparse
import contextlib
import http.client
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from station_processes import ATMD, Station, station

from benchmarks.report import Report, Row

MB = 1e6
MEMORY_LIMIT_MB = 1000.0
WARM_UP_SHARE = 0.25
"""The first quarter is warm-up: caches and rings of fixed length fill."""

ASK_EVERY_S = 5.0


@dataclass(frozen=True, slots=True)
class Setting:
    """Minutes of data, seconds between looks, and when the recording goes on in another file.

    Attributes
    ----------
    speed
        Of the rig: 0 goes as fast as the station follows.
    automatic
        Verified proposals are sent at once: the controller is retuned all the time.
    keep
        Folder for recording and logs; a temporary one that is removed unless given.
    """

    minutes: float = 60.0
    every_s: float = 10.0
    rotate: str = "10min"
    speed: float = 0.0
    automatic: bool = True
    keep: Path | None = None


@dataclass(slots=True)
class Look:
    """What all processes together hold at an instant of the data."""

    data_s: float
    wall_s: float
    pss_mb: dict[str, float]
    rss_mb: dict[str, float]
    files: dict[str, int]
    threads: dict[str, int]


class Watcher(threading.Thread):
    """A browser's part: listens to the page's stream, and asks what-if questions now and then."""

    def __init__(self, url: str) -> None:
        super().__init__(name="watcher", daemon=True)
        self._place = urlsplit(url)
        self.state: dict[str, Any] = {}
        self.states = self.questions = self.rows = self.switched_on = 0
        self.error = ""
        self.over = threading.Event()

    def run(self) -> None:
        """Listen until the station ends."""
        place = self._place
        port = place.port or 80
        try:
            first = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
            first.request("GET", f"{place.path}?{place.query}")
            cookie = (first.getresponse().getheader("set-cookie") or "").split(";")[0]
            first.close()
            stream = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
            stream.request("GET", "/api/stream", headers={"Cookie": cookie})
            answer = stream.getresponse()
            asked, kept = time.monotonic(), b""
            while not self.over.is_set():
                kept += answer.read1(1 << 16) or b""
                *whole, kept = kept.split(b"\n\n")
                for one in whole:
                    self.state = json.loads(one.removeprefix(b"data: "))
                    self.states += 1
                    self.rows += len(self.state["log"])
                if not whole and not kept:
                    return
                if time.monotonic() - asked > ASK_EVERY_S:
                    asked = time.monotonic()
                    self._ask(port, cookie)
        except (OSError, http.client.HTTPException, ValueError) as error:
            if not self.over.is_set():
                self.error = f"{type(error).__name__}: {error}"

    def _ask(self, port: int, cookie: str) -> None:
        """One what-if question; and control on, if it is off: that is the operator's to order."""
        self.questions += 1
        asked = {"changes": {"budget_w": 0.2 + 0.1 * (self.questions % 40)}}
        self._post(port, cookie, "/api/whatif", asked)
        if self.state["control_on"] is False and 45.5 < (self.state["excitation_hz"] or 0.0) < 54.5:
            self.switched_on += 1
            self._post(port, cookie, "/api/on", {"seen_sample": self.state["sample"]})

    @staticmethod
    def _post(port: int, cookie: str, path: str, body: dict[str, Any]) -> None:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
        headers = {"Cookie": cookie, "Origin": f"http://127.0.0.1:{port}", "Content-Type": "application/json"}
        with contextlib.closing(connection):
            connection.request("POST", path, json.dumps(body), headers)
            connection.getresponse().read()


@dataclass(slots=True)
class Processes:
    """The rig's and the station's, with all their children."""

    both: Station
    began_s: float = field(default_factory=time.monotonic)

    def look(self, data_s: float) -> Look:
        """Sum memory, file descriptors and threads of every process by what it is."""
        found = Look(data_s, time.monotonic() - self.began_s, {}, {}, {}, {})
        for name, root in (("rig", self.both.rig.pid), ("station", self.both.live.pid)):
            with contextlib.suppress(psutil.NoSuchProcess):
                process = psutil.Process(root)
                self._add(found, name, process)
                for k, child in enumerate(sorted(process.children(recursive=True), key=lambda p: p.pid)):
                    self._add(found, f"{name}'s process {k + 1}", child)
        return found

    def _add(self, look: Look, name: str, process: psutil.Process) -> None:
        with contextlib.suppress(
            psutil.NoSuchProcess, psutil.AccessDenied, FileNotFoundError, ProcessLookupError
        ):
            memory = process.memory_full_info()
            look.rss_mb[name] = memory.rss / MB
            look.pss_mb[name] = getattr(memory, "pss", memory.rss) / MB
            look.files[name] = process.num_fds()
            look.threads[name] = process.num_threads()


def slope_per_hour(looks: list[Look], values: list[float]) -> tuple[float, float]:
    """Least-squares slope against the data's time, per hour, and its standard deviation from the residuals."""
    hours = np.array([look.data_s for look in looks]) / 3600.0
    if len(hours) < 3:
        return float("nan"), float("nan")
    t, y = hours - hours.mean(), np.array(values) - np.mean(values)
    spread = float(t @ t)
    slope = float(t @ y) / spread
    residual = y - slope * t
    return slope, float(np.sqrt(residual @ residual / (len(t) - 2) / spread))


def run_soak(setting: Setting) -> Report:
    """Run it and work the figures out."""
    folder = Path(tempfile.mkdtemp(prefix="soak-")) if setting.keep is None else setting.keep
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return _soak(setting, folder)
    finally:
        if setting.keep is None:
            shutil.rmtree(folder, ignore_errors=True)


def _soak(setting: Setting, folder: Path) -> Report:
    seconds = 60.0 * setting.minutes
    looks: list[Look] = []
    with station(folder) as both:
        both.start_rig(45.0, "--speed", f"{setting.speed:g}", "--pattern", "shuttle", "--band", "40:60")
        more = ["--seconds", f"{seconds:g}", "--rotate", setting.rotate, "--json", str(folder / "live.json")]
        both.start_live(*more, *(["--automatic"] if setting.automatic else []))
        watcher = Watcher(both.url)
        watcher.start()
        processes = Processes(both)
        while both.live.poll() is None:
            with contextlib.suppress(subprocess.TimeoutExpired):
                both.live.wait(setting.every_s)
            sample = watcher.state.get("sample")
            if sample is not None and both.live.poll() is None:
                looks.append(processes.look(watcher.state["time_s"]))
                last = looks[-1]
                with (folder / "looks.jsonl").open("a", encoding="utf-8") as log:
                    log.write(json.dumps({name: getattr(last, name) for name in Look.__slots__}) + "\n")
        watcher.over.set()
        code, rig_alive = both.live.returncode, both.rig.poll() is None
    wall_s = time.monotonic() - processes.began_s
    result = json.loads((folder / "live.json").read_text(encoding="utf-8"))
    verified = subprocess.run(
        [ATMD, "recordings", "verify", folder / "live.rrd"], capture_output=True, check=False,
        env=os.environ | {"COLUMNS": "200"},
    )  # fmt: skip
    if not looks:
        raise SystemExit("the run was over before it was looked at; give more --minutes")
    everybody = max(len(look.pss_mb) for look in looks)
    looks = [look for look in looks if len(look.pss_mb) == everybody]  # not while it takes itself down
    warm_s = looks[0].data_s + WARM_UP_SHARE * seconds
    settled = [look for look in looks if look.data_s >= warm_s] or looks
    pss = [sum(look.pss_mb.values()) for look in settled]
    slope, std = slope_per_hour(settled, pss)
    figures: dict[str, Any] = {
        "data_s": result["samples"] / 50_000.0,
        "wall_s": wall_s,
        "blocks": result["blocks"],
        **{
            k: result[k]
            for k in ("lost", "late", "repeated", "reordered", "malformed", "restarts", "commands")
        },
        "masked_samples": result["masked_samples"],
        "frames_unseen": result["frames_unseen"],
        "memory_is": "sum of proportional set sizes of all processes of rig and station, MB",
        "pss_mb_begin": sum(looks[0].pss_mb.values()),
        "pss_mb_max": max(sum(look.pss_mb.values()) for look in looks),
        "pss_mb_end": sum(looks[-1].pss_mb.values()),
        "rss_mb_max": max(sum(look.rss_mb.values()) for look in looks),
        "pss_mb_slope_per_hour": slope,
        "pss_mb_slope_std": std,
        "slope_by_process_mb_per_hour": {
            name: slope_per_hour(settled, [look.pss_mb.get(name, 0.0) for look in settled])[0]
            for name in sorted({name for look in settled for name in look.pss_mb})
        },
        "pss_mb_by_process_end": looks[-1].pss_mb,
        "files_begin": sum(settled[0].files.values()),
        "files_end": sum(settled[-1].files.values()),
        "files_max": max(sum(look.files.values()) for look in settled),
        "threads_begin": sum(settled[0].threads.values()),
        "threads_end": sum(settled[-1].threads.values()),
        "threads_max": max(sum(look.threads.values()) for look in settled),
        "looks": len(looks),
        "states_seen_by_page": watcher.states,
        "log_rows_seen_by_page": watcher.rows,
        "what_if_questions": watcher.questions,
        "control_switched_on": watcher.switched_on,
        "watcher_error": watcher.error,
        "exit_code": code,
        "rig_alive_at_end": rig_alive,
        "recording_verified": verified.returncode == 0,
    }
    rows = [
        Row("data", figures["data_s"] / 60.0, "min", setting.minutes * 0.999),
        Row("blocks lost", float(result["lost"]), "", 0.0, "less"),
        Row("memory, largest sum", figures["pss_mb_max"], "MB", MEMORY_LIMIT_MB, "less"),
        Row("memory, slope after warm-up", slope, "MB/h", max(10.0, 3.0 * std), "less"),
        Row(
            "file descriptors, growth", float(figures["files_end"] - figures["files_begin"]), "", 2.0, "less"
        ),
        Row("threads, growth", float(figures["threads_end"] - figures["threads_begin"]), "", 2.0, "less"),
        Row("recording verified", float(figures["recording_verified"]), "", 1.0),
        Row("times real time", figures["data_s"] / wall_s, "x"),
    ]
    return Report({"soak": figures}, rows)


def setting_from(arguments: list[str]) -> Setting:
    """Read the options of ``python -m benchmarks soak``."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks soak", description=__doc__)
    usual = Setting()
    parser.add_argument("--minutes", type=float, default=usual.minutes, help="of data")
    parser.add_argument("--every", type=float, default=usual.every_s, metavar="S", help="between looks")
    parser.add_argument("--rotate", default=usual.rotate, help="when the recording goes on in another file")
    parser.add_argument("--speed", type=float, default=usual.speed, help="of the rig; 0 as fast as it goes")
    parser.add_argument("--manual", action="store_true", help="the operator decides, and never does")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep recording, logs and looks.jsonl there")
    given = parser.parse_args(arguments)
    return Setting(given.minutes, given.every, given.rotate, given.speed, not given.manual, given.keep)
