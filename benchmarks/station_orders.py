"""How long an order of the operator takes to the first sample that obeys it.

From its posting to the page until that sample was taken: the rig names it in the header of the block that begins with
it, whose arrival, heard by a listener of its own beside the station, less the block's length is when that was.
"""

import http.client
import json
import random
import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any
from urllib.parse import urlsplit

import zmq

from tests.station_processes import Station
from twin.rig.keys import load_pair, load_public
from twin.rig.messages import SamplesHeader
from twin.rig.wire import TOPIC_SAMPLES, guard_client

GIVEN_UP_S, START_S = 30.0, 60.0
SAMPLE_RATE_HZ, QUIET_S = 50_000.0, 1.0
BUDGETS_W = (0.5, 0.8, 0.4, 1.0)
"""So little that gains must change."""


def order_latencies(both: Station, count: int) -> dict[str, list[float]]:
    """[ms] by kind of order: gains sent and taken back, control switched on and off, at any time within a block."""
    out: dict[str, list[float]] = {"send": [], "revert": [], "off": [], "on": []}
    rng = random.Random(3)  # noqa: S311 - moments to press a button, no secret
    with closing(_Operator(both.url)) as operator, closing(_Blocks(both)) as blocks:
        operator.wait_until_followed()
        blocks.start()
        blocks.heard.wait(START_S)
        for k in range(count):
            kind = tuple(out)[k % len(out)]
            press = _armed(operator, BUDGETS_W[k // len(out) % len(BUDGETS_W)]) if kind == "send" else None
            time.sleep(rng.uniform(0.3, 0.6))
            seen = operator.state()["sample"]
            known, began = set(blocks.obeyed_s), time.monotonic()
            if press is not None:
                press()
            elif kind == "off":
                operator.post("/api/off")
            else:
                operator.post(f"/api/{kind}", seen_sample=seen)
            out[kind].append(1e3 * (blocks.next_after(known, kind) - began))
            blocks.wait_until_quiet()
    return out


def _armed(operator: "_Operator", budget_w: float) -> Callable[[], Any]:
    """A proposal, reviewed and armed; what is returned sends it."""
    found = operator.post("/api/propose", changes={"budget_w": budget_w})["proposal"]
    seen = operator.state()["sample"]
    code = operator.post("/api/arm", proposal=found, seen_sample=seen)["code"]
    return lambda: operator.post("/api/send", proposal=found, code=code, seen_sample=seen)


class _Blocks(threading.Thread):
    """Hears the rig's blocks beside the station, and notes when which command had taken effect.

    Attributes
    ----------
    obeyed_s
        By number of the command: when the first sample that obeys it was taken, by this machine's clock.
    heard
        Set with the first block.
    """

    def __init__(self, both: Station) -> None:
        super().__init__(name="listener", daemon=True)
        self.obeyed_s: dict[int, float] = {}
        self._address = f"tcp://127.0.0.1:{both.port}"
        self._keys = load_pair(both.folder / "station.key_secret")
        self._rig = load_public(both.folder / "rig.key")
        self._over, self.heard = threading.Event(), threading.Event()
        self._rate_hz = SAMPLE_RATE_HZ

    def run(self) -> None:
        """Listen until closed."""
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            guard_client(socket, self._keys, self._rig)
            socket.connect(self._address)
            socket.subscribe(TOPIC_SAMPLES)
            while not self._over.is_set():
                if not socket.poll(100):
                    continue
                _, header, _ = socket.recv_multipart()
                arrived = time.monotonic()
                self.heard.set()
                block = SamplesHeader.model_validate_json(header)
                for number in block.commands_applied:
                    self.obeyed_s[number] = arrived - block.n_samples / self._rate_hz

    def next_after(self, known: set[int], kind: str) -> float:
        """When the first command beyond those known took effect."""
        end = time.monotonic() + GIVEN_UP_S
        while time.monotonic() < end:
            new = sorted(set(self.obeyed_s) - known)
            if new:
                return self.obeyed_s[new[0]]
            time.sleep(0.005)
        raise RuntimeError(f"{kind}: the rig obeyed nothing within {GIVEN_UP_S:.0f} s")

    def wait_until_quiet(self) -> None:
        """Until no further step of an order has taken effect for a while."""
        while time.monotonic() - max(self.obeyed_s.values()) < QUIET_S:
            time.sleep(0.05)

    def close(self) -> None:
        """End."""
        self._over.set()
        self.join(2.0)


class _Operator:
    """Talks to the page as the page's own scripts do."""

    def __init__(self, url: str) -> None:
        place = urlsplit(url)
        self._connection = http.client.HTTPConnection(place.netloc, timeout=30.0)
        self._connection.request("GET", f"/?{place.query}")
        answer = self._connection.getresponse()
        answer.read()
        self._cookie = (answer.getheader("set-cookie") or "").split(";")[0]
        self._origin = f"http://{place.netloc}"

    def close(self) -> None:
        """Hang up."""
        self._connection.close()

    def state(self) -> dict[str, Any]:
        """What the page shows."""
        return self._ask("GET", "/api/state", None)

    def wait_until_followed(self) -> None:
        """Until the twin follows a rig with a controller and an excitation."""
        end = time.monotonic() + START_S
        while not self.state()["what_if"]:
            if time.monotonic() > end:
                raise RuntimeError(f"the twin follows no rig within {START_S:.0f} s")
            time.sleep(0.1)

    def post(self, path: str, **body: Any) -> dict[str, Any]:
        """Answer to a call of the page."""
        return self._ask("POST", path, json.dumps(body))

    def _ask(self, method: str, path: str, body: str | None) -> dict[str, Any]:
        headers = {"Cookie": self._cookie, "Origin": self._origin, "Content-Type": "application/json"}
        self._connection.request(method, path, body, headers)
        answer = self._connection.getresponse()
        found = json.loads(answer.read())
        if answer.status != 200:
            raise RuntimeError(f"{path}: {found}")
        return dict(found)
