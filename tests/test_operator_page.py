"""The operator page: who may talk to it, what an order has to go through, and that nothing it gets stops the loop."""

import http.client
import json
import random
import socket
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import psutil
import pytest
from garbage import spoiled

from tuning.retune import TuningGoal
from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import make_block
from twin.rig.programme import Programme, Tone
from twin.rig.simulated import SimulatedRig
from twin.station import desk as desk_module
from twin.station.demo import demo_programme, facts_of, session_for
from twin.station.desk import Desk
from twin.station.frame import Frame
from twin.station.orders import Order
from twin.station.page_server import FILES, OperatorPage
from twin.station.retuning import RetuningSettings
from twin.station.session import Session
from twin.station.worker import AfterBlocks, TunerHere

PROGRAMME: Programme = demo_programme(20.0, 7).model_copy(
    update={"sweep": Tone(frequency_hz=52.0, duration_s=60.0, amplitude_v=4.0)}
)
GOAL = TuningGoal()
JSON = {"Content-Type": "application/json"}


@dataclass
class Bench:
    """A rig and a session in this process, block by block, with a page beside them."""

    rig: SimulatedRig
    session: Session
    desk: Desk
    answers: list[Acknowledgement] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    sent: list[Command] = field(default_factory=list)
    orders: list[tuple[int, Order]] = field(default_factory=list)

    # The link: what goes out takes effect at the rig.
    def send(self, command: Command) -> None:
        self.sent.append(command)
        self.rig.accept(command)

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        return ()

    def heartbeat(self, next_sample: int) -> None:
        pass

    def run(self, blocks: int = 1) -> Frame:
        for _ in range(blocks):
            first = self.rig.next_sample
            values, on, answers = self.rig.next_block()
            applied = tuple(a.command_id for a in answers)
            block = make_block(
                first, 50_000.0, values, self.rig.channels, control_on=on, commands_applied=applied
            )
            order = self.desk.order()
            frame = self.session.advance(block, tuple(answers), order)
            if order is not None:
                self.orders.append((block.end_sample - 1, order))
            for command in frame.commands:
                if order is None or order.command_id != command.command_id:
                    self.send(command)
            self.desk.show(frame, 0.01)
            self.frames.append(frame)
        return self.frames[-1]


def bench() -> Bench:
    rig = SimulatedRig(PROGRAMME)
    tuner = TunerHere(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, AfterBlocks(1))
    session = session_for(PROGRAMME, rig.channels, GOAL, RetuningSettings(approve=True), tuner)
    made = Bench(rig, session, Desk(session))
    made.desk.link = made
    return made


@pytest.fixture(scope="module")
def made() -> Iterator[Bench]:
    made = bench()
    yield made
    made.desk.close()


@pytest.fixture(scope="module")
def page(made: Bench) -> Iterator[OperatorPage]:
    made.run(25)
    with OperatorPage(made.desk) as page:
        yield page


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)

    @property
    def reason(self) -> str:
        return str(self.json["reason"])


def ask(page: OperatorPage, method: str, path: str, body: bytes = b"", **headers: str) -> Answer:
    place = urlsplit(page.url)
    connection = http.client.HTTPConnection("127.0.0.1", place.port, timeout=60.0)
    given = {k.replace("_", "-"): v for k, v in headers.items()}
    connection.request(method, path, body or None, given)
    answer = connection.getresponse()
    found = Answer(answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read())
    connection.close()
    return found


def cookie(page: OperatorPage) -> str:
    place = urlsplit(page.url)
    answer = ask(page, "GET", f"{place.path}?{place.query}")
    assert answer.status == 303
    assert answer.headers["location"] == "/"
    return answer.headers["set-cookie"]


def origin(page: OperatorPage) -> str:
    return f"http://{urlsplit(page.url).netloc}"


def post(page: OperatorPage, path: str, **body: Any) -> Answer:
    return ask(
        page, "POST", path, json.dumps(body).encode(), Content_Type="application/json",
        Origin=origin(page), Cookie=cookie(page).split(";")[0],
    )  # fmt: skip


def seen(made: Bench) -> int:
    return int(made.desk.state()["sample"])


# --- who may talk to it ------------------------------------------------------------------------------------


def test_token_becomes_a_cookie_that_scripts_and_other_sites_do_not_get(page: OperatorPage) -> None:
    given = cookie(page).lower()
    assert "httponly" in given
    assert "samesite=strict" in given
    assert ask(page, "GET", "/", Cookie=cookie(page).split(";")[0]).status == 200


PLACES = ["/", "/api/state", "/api/stream", "/page/page.js", "/plotly.js", "/nowhere"]


@pytest.mark.parametrize("path", PLACES)
@pytest.mark.parametrize("given", ["", "atmd1=x", "atmd=", "=;=,\x7f", "a" * 4000])
def test_nothing_is_shown_without_the_token(page: OperatorPage, path: str, given: str) -> None:
    assert ask(page, "GET", path, Cookie=given).status == 401


@pytest.mark.parametrize("token", ["", "x", "é" * 20, "%00"])
def test_wrong_token_is_refused(page: OperatorPage, token: str) -> None:
    assert ask(page, "GET", f"/?token={token.encode().hex() if token else ''}").status == 401


@pytest.mark.parametrize("path", ["arm", "send", "revert", "on", "off", "propose", "whatif", "branch"])
@pytest.mark.parametrize(
    "given", ["", "null", "http://rig.example", "https://127.0.0.1", "http://127.0.0.1:1", "file://"]
)
def test_orders_from_another_page_are_refused(page: OperatorPage, made: Bench, path: str, given: str) -> None:
    before = len(made.sent), len(made.desk._orders)
    headers = {"Origin": given} if given else {}
    answer = ask(page, "POST", f"/api/{path}", b"{}", Cookie=cookie(page).split(";")[0], **headers, **{
        "Content_Type": "application/json"})  # fmt: skip
    assert answer.status == 403
    assert "another page" in answer.reason
    assert (len(made.sent), len(made.desk._orders)) == before


@pytest.mark.parametrize("host", ["rig.example", "127.0.0.1", "127.0.0.1:1", "evil.example:80"])
def test_a_name_that_is_not_the_stations_is_refused(page: OperatorPage, host: str) -> None:
    assert ask(page, "GET", "/", Host=host, Cookie=cookie(page).split(";")[0]).status == 400


def test_forms_of_other_sites_cannot_speak_json(page: OperatorPage) -> None:
    answer = ask(
        page, "POST", "/api/off", b"{}", Origin=origin(page), Cookie=cookie(page).split(";")[0],
        Content_Type="text/plain",
    )  # fmt: skip
    assert answer.status == 415


def test_oversized_messages_are_refused_with_and_without_a_stated_length(page: OperatorPage) -> None:
    answer = post(page, "/api/whatif", changes={"budget_kind": "x" * 20_000})
    assert answer.status == 413
    lines = [
        "POST /api/whatif HTTP/1.1", f"Host: {urlsplit(page.url).netloc}", f"Origin: {origin(page)}",
        "Content-Type: application/json", f"Cookie: {cookie(page).split(';')[0]}", "Transfer-Encoding: chunked",
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", urlsplit(page.url).port or 0), timeout=10.0) as raw:
        raw.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        chunk = b"4000\r\n" + b"a" * 0x4000 + b"\r\n"
        for _ in range(3):
            raw.sendall(chunk)
        raw.sendall(b"0\r\n\r\n")
        assert b"413" in raw.recv(200).split(b"\r\n")[0]


def test_policy_leaves_scripts_of_the_station_alone(page: OperatorPage) -> None:
    answer = ask(page, "GET", "/", Cookie=cookie(page).split(";")[0])
    policy = dict(rule.split(" ", 1) for rule in answer.headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["script-src"] == "'self'"
    assert policy["connect-src"] == "'self'"
    assert policy["frame-ancestors"] == "'none'"
    assert b"<script>" not in answer.body
    assert b"style=" not in answer.body
    assert b"//" not in answer.body.replace(b"<!doctype", b"").replace(b"http://www.w3.org", b"")


@pytest.mark.parametrize("name", FILES)
def test_page_files_are_served_with_their_type(page: OperatorPage, name: str) -> None:
    answer = ask(page, "GET", f"/page/{name}", Cookie=cookie(page).split(";")[0])
    assert answer.status == 200
    assert answer.headers["content-type"] == FILES[name]


@pytest.mark.parametrize("path", ["/page/..%2fdesk.py", "/page/../desk.py", "/page/desk.py", "/page/"])
def test_no_other_file_is_served(page: OperatorPage, path: str) -> None:
    assert ask(page, "GET", path, Cookie=cookie(page).split(";")[0]).status == 404


def test_refusals_are_in_the_log_with_their_reason(made: Bench, page: OperatorPage) -> None:
    made.desk.remarks()
    ask(page, "GET", "/api/state")
    post(page, "/api/whatif", changes={"budgt_w": 3})
    said = made.desk.remarks()
    assert any("refused" in text and "token" in text for text in said)
    assert any("budgt_w" in text for text in said)


# --- what it is asked ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "body", "reason"),
    [
        ("whatif", {"changes": {"budget_w": -1}}, "greater than 0 W"),
        ("whatif", {"changes": {"budget_kind": "volts"}}, "joule_mean"),
        ("whatif", {"changes": {"modulus_margin": "wide"}}, "modulus_margin"),
        ("whatif", {"changes": {"modulus_margin": 2}}, "below 1"),
        ("whatif", {"changes": []}, "malformed"),
        ("whatif", {"surprise": 1}, "malformed"),
        ("branch", {"seconds": 1e9}, "malformed"),
        ("arm", {"proposal": 1}, "seen_sample"),
        ("arm", {"proposal": "x", "seen_sample": 1}, "malformed"),
        ("send", {"proposal": 1, "seen_sample": -5, "code": ""}, "malformed"),
        ("propose", {"changes": {"damping_scale": 2}}, "overrides"),
        ("propose", {"changes": {"on_from_hz": 20}}, "control window"),
        ("review", {"standing": 12345}, "no longer stands"),
    ],
)
def test_malformed_questions_get_a_reason(
    page: OperatorPage, path: str, body: dict[str, Any], reason: str
) -> None:
    answer = post(page, f"/api/{path}", **body)
    assert 400 <= answer.status < 500
    assert reason in answer.reason


def test_all_curves_come_at_once_are_confirmed_behind_and_move_with_the_budget(page: OperatorPage) -> None:
    found = {}
    for watt in (4.0, 0.2):
        lines = list(map(json.loads, post(page, "/api/whatif", changes={"budget_w": watt}).body.splitlines()))
        first = dict(enumerate(lines[0]["points"]))
        assert len(first) == 11
        assert lines[-1] == {"done": True}
        confirmed = {line["k"]: line["point"] for line in lines[1:-1]}
        assert set(confirmed) == {k for k, p in first.items() if p["provisional"]}
        assert not any(p["provisional"] for p in confirmed.values())
        parts = first | confirmed
        for k, p in parts.items():
            assert p["frequency_hz"] == first[k]["frequency_hz"]
            if p["proposed"] is not None:
                assert p["proposed"]["power_w"] <= watt * 1.01
                assert p["proposed"]["displacement_m"] >= p["limit_m"] * 0.999 - 1e-12
        found[watt] = parts
    assert found[0.2][0]["proposed"]["displacement_m"] > 2 * found[4.0][0]["proposed"]["displacement_m"]


def test_nothing_is_sent_that_was_not_reviewed_armed_and_seen(
    page: OperatorPage, made: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    while seen(made) < 300_000:
        made.run()
    sent = len(made.sent)
    number = post(page, "/api/propose", changes={"budget_w": 1.0}).json["proposal"]
    at = seen(made)
    assert "not armed" in post(page, "/api/send", proposal=number, code="", seen_sample=at).reason
    assert "no proposal" in post(page, "/api/arm", proposal=9999, seen_sample=at).reason
    assert "stale" in post(page, "/api/arm", proposal=number, seen_sample=0).reason
    assert "not been measured" in post(page, "/api/arm", proposal=number, seen_sample=at + 10**6).reason
    code = post(page, "/api/arm", proposal=number, seen_sample=at).json["code"]
    assert "code" in post(page, "/api/send", proposal=number, code="0" * 16, seen_sample=at).reason
    assert "not armed" in post(page, "/api/send", proposal=number, code=code, seen_sample=at).reason
    monkeypatch.setattr(desk_module, "ARMED_S", -1.0)
    code = post(page, "/api/arm", proposal=number, seen_sample=at).json["code"]
    assert "arm again" in post(page, "/api/send", proposal=number, code=code, seen_sample=at).reason
    assert made.desk.order() is None
    assert len(made.sent) == sent


def test_budget_of_an_operator_reaches_the_rig_is_kept_and_goes_back(page: OperatorPage, made: Bench) -> None:
    made.run()
    before = made.rig.schedule
    review = post(page, "/api/propose", changes={"budget_w": 0.1}).json
    assert review["goal"]["budget_w"] == 0.1
    assert review["worst_w"] <= 0.1 * 1.01
    assert review["least_modulus_margin"] >= 0.149
    assert any(limit["name"] == "power" for row in review["rows"] for limit in row["limits"])
    code = post(page, "/api/arm", proposal=review["proposal"], seen_sample=seen(made)).json["code"]
    assert post(page, "/api/send", proposal=review["proposal"], code=code, seen_sample=seen(made)).json == {
        "queued": True
    }
    made.run(45)
    decisions = [d for f in made.frames for d in f.decisions if d.by == "operator"]
    assert any(d.accepted and "what-if accepted" in d.reason for d in decisions)
    assert made.rig.schedule != before
    assert made.session.schedule == made.rig.schedule
    state = made.desk.state()
    assert state["goal"]["budget_w"] == 0.1
    assert state["sent"]["state"] == "acknowledged"
    # Single blocks scatter: sensor noise burns power, too.
    spent = [f.performance.powers.joule_mean_w for f in made.frames[-20:] if f.performance is not None]
    assert sum(spent) / 20 < 0.12
    promised, achieved = state["audit"]["displacement_m"]
    assert promised == pytest.approx(achieved, rel=0.05)

    assert post(page, "/api/revert", seen_sample=seen(made)).json == {"queued": True}
    made.run(5)
    assert made.rig.schedule == before
    assert made.desk.state()["goal"]["budget_w"] == GOAL.budget_w


def test_without_the_operator_nothing_is_ever_sent() -> None:
    made = bench()
    made.run(25)
    assert sum(f.proposal is not None for f in made.frames) > 2
    assert made.sent == []
    assert made.session.retuning is not None
    number = max(made.session.retuning.standing)
    made.desk._orders.append(Order(kind="accept", number=number))
    made.run(4)
    assert len(made.sent) == 1
    assert made.rig.schedule == made.sent[0].schedule
    made.desk.close()


def test_emergency_off_goes_out_while_the_loop_stands_still(page: OperatorPage, made: Bench) -> None:
    made.run()
    sent = len(made.sent)
    number = post(page, "/api/off").json["command_id"]
    assert [c.control_enabled for c in made.sent[sent:]] == [False]  # and no block has passed
    assert made.sent[-1].command_id == number
    frame = made.run(2)
    assert frame.block.control_on is False
    made.run(2)
    assert post(page, "/api/on", seen_sample=seen(made)).status == 200
    frame = made.run(4)
    assert frame.block.control_on is True
    assert made.sent[-1].command_id > number


def test_emergency_off_gets_through_while_every_thread_of_the_page_is_busy(
    page: OperatorPage, made: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    answered = threading.Event()

    def stuck(*_: object) -> None:
        answered.wait(30.0)
        raise desk_module.RefusedError("it took too long")

    monkeypatch.setattr(Desk, "propose", stuck)
    busy = [
        threading.Thread(target=post, args=(page, "/api/propose"), kwargs={"changes": {}}) for _ in range(60)
    ]
    for thread in busy:
        thread.start()
    time.sleep(0.5)
    sent = len(made.sent)
    assert post(page, "/api/off").status == 200
    assert all(thread.is_alive() for thread in busy)
    assert made.sent[sent].control_enabled is False
    answered.set()
    for thread in busy:
        thread.join()
    made.run(2)
    post(page, "/api/on", seen_sample=seen(made))
    made.run(3)


def test_branch_begins_where_the_measured_trace_goes_on(page: OperatorPage, made: Bench) -> None:
    made.run(10)
    answer = post(page, "/api/branch", changes={}, seconds=0.3).json
    made.run(3)
    measured = ask(
        page,
        "GET",
        f"/api/trace?from_sample={answer['from_sample']}&seconds=0.3",
        Cookie=cookie(page).split(";")[0],
    ).json["displacement_m"]
    used = next(t for t in answer["traces"] if t["name"] == "in use")
    assert len(measured) == len(used["displacement_m"]) == 300
    off = [a - b for a, b in zip(measured, used["displacement_m"], strict=True)]
    inside = sum(abs(o) < 4 * s for o, s in zip(off, used["displacement_std_m"], strict=True))
    assert inside > 250


def test_orders_repeat_in_a_replay(made: Bench) -> None:
    tuner = TunerHere(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, AfterBlocks(1))
    session = session_for(PROGRAMME, made.rig.channels, GOAL, RetuningSettings(approve=True), tuner)
    again = Session(
        PROGRAMME.plant, made.rig.channels, 50_000.0, session.settings, dict(made.session.commands), tuner
    )
    orders = [(s, Order.model_validate_json(o.model_dump_json())) for s, o in made.orders]
    for frame in made.frames:
        due = orders.pop(0)[1] if orders and orders[0][0] < frame.block.end_sample else None
        other = again.advance(frame.block, frame.acknowledgements, due)
        assert other.commands == frame.commands
        assert other.decisions == frame.decisions
    assert orders == []


def test_a_recording_takes_no_orders() -> None:
    made = bench()
    made.desk.link = None
    made.run(3)
    with OperatorPage(made.desk) as page:
        for path in ("revert", "on", "off"):
            body = {} if path == "off" else {"seen_sample": seen(made)}
            answer = post(page, f"/api/{path}", **body)
            assert answer.status == 403
            assert "recording" in answer.reason
        assert made.desk.state()["read_only"]


# --- garbage -----------------------------------------------------------------------------------------------


FRAMES, REQUESTS = 98_000, 2_000


def throw_garbage(page: OperatorPage, count: int, seed: int = 4) -> None:
    """Random bytes, half-right requests and cut-off ones, on many short connections."""
    rng = random.Random(seed)
    place = urlsplit(page.url)
    good = (
        f"POST /api/send HTTP/1.1\r\nHost: {place.netloc}\r\nOrigin: {origin(page)}\r\n"
        f"Cookie: {cookie(page).split(';')[0]}\r\nContent-Type: application/json\r\nContent-Length: 40\r\n\r\n"
    ).encode()
    raw: socket.socket | None = None
    for k in range(count):
        kind = rng.randrange(4)
        data = rng.randbytes(rng.randrange(1, 200))
        if kind == 1:
            spoiled = bytearray(good)
            for _ in range(rng.randrange(1, 6)):
                spoiled[rng.randrange(len(spoiled))] = rng.randrange(256)
            data = bytes(spoiled)
        elif kind == 2:
            data = good + data[:40]
        elif kind == 3:
            data = good[: rng.randrange(len(good))]
        try:
            if raw is None or k % 40 == 0:
                if raw is not None:
                    raw.close()
                raw = socket.create_connection(("127.0.0.1", place.port or 0), timeout=5.0)
            raw.sendall(data)
        except OSError:
            if raw is not None:
                raw.close()
            raw = None
    if raw is not None:
        raw.close()


def ask_nonsense(page: OperatorPage, count: int, seed: int = 5) -> dict[int, int]:
    """Requests that are HTTP and make no sense: whose, where to and what; returns how often each status came."""
    rng = random.Random(seed)
    place = urlsplit(page.url)
    known = {"Cookie": cookie(page).split(";")[0], "Origin": origin(page), "Content-Type": "application/json"}
    bodies: dict[str, dict[str, Any]] = {
        "arm": {"proposal": 1, "seen_sample": 5}, "send": {"proposal": 1, "seen_sample": 5, "code": "0" * 16},
        "revert": {"seen_sample": 5}, "on": {"seen_sample": 5}, "review": {"standing": 10**6},
    }  # fmt: skip
    found: dict[int, int] = {}
    connection = http.client.HTTPConnection("127.0.0.1", place.port, timeout=60.0)
    for _ in range(count):
        what = rng.choice(list(bodies))
        headers = dict(known)
        method, path, body = "POST", f"/api/{what}", spoiled(rng, bodies[what])
        match rng.randrange(6):
            case 0:
                del headers[rng.choice(list(headers))]
            case 1:
                headers[rng.choice(list(headers))] = "".join(chr(rng.randrange(33, 255)) for _ in range(30))
            case 2:
                method, path = rng.choice(["PUT", "DELETE", "GET", "PATCH"]), f"/api/{rng.getrandbits(40):x}"
            case 3:
                body = b"x" * 17_000
        try:
            if connection.sock is None:
                connection.connect()
                connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            answer.read()
            found[answer.status] = found.get(answer.status, 0) + 1
        except (OSError, http.client.HTTPException):
            connection.close()
            found[0] = found.get(0, 0) + 1
    connection.close()
    return found


def test_hundred_thousand_random_frames_at_the_page_order_nothing_and_stop_nothing(
    page: OperatorPage, made: Bench
) -> None:
    while seen(made) < 300_000:  # what was seen at sample 5 is old by then
        made.run()
    sent = len(made.sent)
    made.desk.remarks()
    refused_before, rss_before = made.desk.refused_in_all, psutil.Process().memory_info().rss
    over, remarks, frames = threading.Event(), [], 0

    def loop() -> None:
        """The loop goes on meanwhile, as at a rig."""
        nonlocal frames
        while not over.is_set():
            made.run()
            del made.frames[:-5]
            frames += 1
            remarks.extend(made.desk.remarks())
            over.wait(0.1)

    beside = threading.Thread(target=loop)
    beside.start()
    switch_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-4)  # three threads of one process talk to each other a hundred thousand times
    try:
        throw_garbage(page, FRAMES)
        statuses = ask_nonsense(page, REQUESTS)
    finally:
        over.set()
        beside.join()
        sys.setswitchinterval(switch_s)
    assert frames > 10
    assert made.desk.order() is None
    assert len(made.sent) == sent
    assert not any(200 <= status < 400 for status in statuses), statuses
    assert all(status < 500 for status in statuses), statuses
    assert {401, 403, 413, 415, 422} <= set(statuses)
    assert (
        made.desk.refused_in_all - refused_before > 0.7 * REQUESTS
    )  # the rest was no HTTP, or told of what is not there
    assert 0 < len(remarks) < 400
    assert psutil.Process().memory_info().rss - rss_before < 150e6
    assert post(page, "/api/whatif", changes={}).status == 200


def test_page_ends_at_once_and_without_a_word_while_a_browser_listens(
    made: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    made.run()
    with OperatorPage(made.desk) as page:
        place = urlsplit(page.url)
        listening = http.client.HTTPConnection("127.0.0.1", place.port, timeout=60.0)
        listening.request("GET", "/api/stream", headers={"Cookie": cookie(page).split(";")[0]})
        answer = listening.getresponse()
        assert answer.read1(100)
    assert caplog.records == []
    assert not page._thread.is_alive()
    while answer.read1(10_000):
        pass
    listening.close()
