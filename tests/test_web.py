"""The viewer in a browser: everything from this machine, nothing to anywhere else."""

import http.client
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import rerun as rr
from frames import RATE, channels, frames, schedule
from matplotlib.image import imread

from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.station import web
from twin.station.live import LiveView
from twin.station.rerun_view import RerunView
from twin.station.web import WebViewer

CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[str, rr.RecordingStream]]:
    stream = rr.RecordingStream("atmd_twin")
    viewer = WebViewer(stream)
    yield viewer.start(), stream
    viewer.stop()


class NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_: object) -> None:
        return None


def get(url: str, cookie: str = "") -> http.client.HTTPResponse:
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), NoRedirect())
    try:
        opener.addheaders = [("Cookie", cookie)]
        return opener.open(url, timeout=10.0)
    except urllib.error.HTTPError as error:
        return error


def get_file(url: str, name: str) -> http.client.HTTPResponse:
    return get(f"http://{urlsplit(url).netloc}/{name}", cookie_of(url))


def cookie_of(url: str) -> str:
    with get(url) as answer:
        assert answer.status == 303
        cookie, _, rest = answer.headers["Set-Cookie"].partition(";")
    assert "httponly" in rest.lower()
    assert "samesite=strict" in rest.lower()
    return cookie


def raw_get(url: str, path: str, host: str | None = None, cookie: str = "") -> int:
    place = urlsplit(url)
    connection = http.client.HTTPConnection(place.hostname, place.port, timeout=10.0)
    connection.putrequest("GET", path, skip_host=host is not None)
    if host is not None:
        connection.putheader("Host", host)
    connection.putheader("Cookie", cookie)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


def test_the_first_page_opens_the_viewer_on_the_stream(served: tuple[str, rr.RecordingStream]) -> None:
    with get_file(served[0], "") as answer:
        assert answer.status == 307
        target = urlsplit(answer.headers["Location"])
    assert target.path == "/index.html"
    stream = parse_qs(target.query)["url"][0]
    assert stream.startswith("rerun+http://127.0.0.1:")
    assert stream.endswith("/proxy")


@pytest.mark.parametrize(
    ("name", "kind", "least"),
    [
        ("index.html", "text/html", 5_000),
        ("re_viewer.js", "text/javascript", 50_000),
        ("re_viewer_bg.wasm", "application/wasm", 10**7),
    ],
)
def test_files_come_with_their_type_and_a_policy(
    served: tuple[str, rr.RecordingStream], name: str, kind: str, least: int
) -> None:
    url, _ = served
    with get_file(url, name) as answer:
        assert answer.headers["Content-Type"].startswith(kind)
        assert int(answer.headers["Content-Length"]) > least
        policy = dict(rule.split(" ", 1) for rule in answer.headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert "unsafe-inline" not in policy["script-src"]
    assert policy["connect-src"].startswith("'self' http://127.0.0.1:")
    assert not any(
        "rerun.io" in rule or "https:" in rule or "*" in rule
        for rule in (policy["script-src"], policy["connect-src"])
    )


@pytest.mark.parametrize(
    "path",
    [
        "/../pyproject.toml",
        "/..%2f..%2fetc%2fpasswd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "//etc/passwd",
        "/sw.js",
        "/.",
        "/a/b",
    ],
)
def test_nothing_else_is_served(served: tuple[str, rr.RecordingStream], path: str) -> None:
    url, _ = served
    assert raw_get(url, path, cookie=cookie_of(url)) == 404


@pytest.mark.parametrize("path", ["/", "/index.html", "/re_viewer_bg.wasm", "/?token=guessed"])
def test_nothing_is_served_without_the_token(served: tuple[str, rr.RecordingStream], path: str) -> None:
    assert raw_get(served[0], path) == 401
    assert raw_get(served[0], path, cookie=cookie_of(served[0]) + "x") == 401


def test_a_page_that_pretends_to_be_this_machine_is_refused(served: tuple[str, rr.RecordingStream]) -> None:
    url, _ = served
    assert raw_get(url, "/index.html", host="rig.example") == 400


def test_a_port_that_is_taken_is_named(served: tuple[str, rr.RecordingStream]) -> None:
    port = urlsplit(served[0]).port
    viewer = WebViewer(rr.RecordingStream("other"))
    with pytest.raises(InputError, match=f"port {port} cannot be used"):
        viewer.start(port)
    viewer.stop()


def test_a_package_without_the_viewer_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web, "_fetch_from_program", lambda _: None)
    with pytest.raises(InputError, match=r"re_viewer_bg\.wasm missing"):
        web.fetch_viewer(tmp_path)


def coloured(path: Path, rgb: tuple[int, int, int]) -> int:
    image = imread(path)[..., :3] * 255
    return int(np.sum(np.all(np.abs(image - rgb) < 30, axis=-1)))


def test_a_browser_draws_the_run_and_asks_nobody_else(
    served: tuple[str, rr.RecordingStream], requires_debian: Callable[[str], Path], tmp_path: Path
) -> None:
    chromium = requires_debian("chromium")
    from playwright.sync_api import sync_playwright

    url, stream = served
    plant = load_plant("rig")
    view = RerunView(stream, plant=plant, sample_rate_hz=RATE, channels=channels(plant), schedule=schedule())
    live = LiveView(view, depth=100)
    for frame in frames(plant, 6.0):
        live.show(frame)
    live.close(10.0)
    assert live.dropped == 0

    asked: list[str] = []
    refused: dict[str, str | None] = {}
    net_log = tmp_path / "net.json"
    with sync_playwright() as play:
        browser = play.chromium.launch(
            executable_path=str(chromium), headless=True, args=[*CHROMIUM_FLAGS, f"--log-net-log={net_log}"]
        )
        page = browser.new_page(viewport={"width": 1100, "height": 760})
        page.on("request", lambda request: asked.append(request.url))
        page.on("requestfailed", lambda request: refused.update({request.url: request.failure}))
        page.goto(url, timeout=60_000)
        deadline = time.monotonic() + 200.0
        picture = tmp_path / "web.png"
        while time.monotonic() < deadline:
            time.sleep(3.0)
            page.screenshot(path=picture, timeout=60_000)
            if coloured(picture, (0xF2, 0xB8, 0x4B)) > 300 and coloured(picture, (0xEF, 0x53, 0x50)) > 100:
                break
        else:
            pytest.fail("no curves were drawn within 200 s")
        browser.close()
    # The page would like fonts and a script from elsewhere; the policy must have stopped every one of them.
    foreign = [
        u for u in asked if urlsplit(u).scheme in ("http", "https") and urlsplit(u).hostname != "127.0.0.1"
    ]
    assert {refused.get(u) for u in foreign} <= {"csp"}
    assert any(u.endswith(".wasm") for u in asked)
    for host in ("fonts.g", "rerun.io"):
        assert host not in net_log.read_text(errors="replace")
