"""A person at the rig: real processes, Debian's Chromium, from moving a slider to what the rig then does."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from station_processes import Station, station

from twin.rig.recorded import open_recording
from twin.station.replay import ReplayOptions, run_replay

FLAGS = ["--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"]


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    with station(tmp_path_factory.mktemp("station")) as both:
        both.start_rig()
        both.start_live("--seconds", "600")
        yield both


def number(text: str) -> float:
    return float(re.findall(r"[\d.]+(?:e-?\d+)?", text)[0])


def test_budget_moved_reviewed_sent_obeyed_audited_and_taken_back(
    running: Station, requires_debian: Callable[[str], Path]
) -> None:
    chromium = requires_debian("chromium")
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=45_000)
    complaints: list[str] = []
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), headless=True, args=FLAGS)
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.set_default_timeout(60_000)
        page.on("console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: complaints.append(r.url) if "127.0.0.1" not in r.url else None)
        page.goto(running.url)
        assert "token" not in page.url
        status = page.locator("#status")
        expect(page.locator("#s-rig dd")).to_have_text("connected")
        if page.locator("#s-control dd").inner_text() == "off":
            page.click("#on")
        expect(page.locator("#s-control dd")).to_have_text("on", timeout=30_000)
        expect(page.locator("#s-model dd")).to_have_text("consistent", timeout=60_000)
        page.wait_for_selector("body[data-redraws]")

        def proposed() -> list[float | None]:
            script = "document.getElementById('chart-motion').data.find(t => t.name === 'proposed').y"
            return list(page.evaluate(script))

        page.wait_for_selector("body[data-completes]")
        page.wait_for_timeout(1500)
        before = proposed()
        page.focus("#budget")
        while number(page.inner_text("#budget-out")) > 0.3:
            page.keyboard.press("ArrowLeft")
        end = time.monotonic() + 20.0
        while (after := proposed()) == before and time.monotonic() < end:
            page.wait_for_timeout(200)
        page.wait_for_timeout(1500)
        after = proposed()
        assert before != after
        assert max(v for v in after if v) > 2.0 * max(v for v in before if v)
        assert "/ 4 W" in status.inner_text()  # nothing has reached the rig yet

        page.click("#propose")
        page.wait_for_selector("#arm:enabled")
        assert page.locator("#send").is_disabled()
        assert "4 W mean Joule → 0.2" in page.inner_text("#review")
        page.click("#arm")
        page.wait_for_selector("#send:enabled")
        page.click("#send")
        expect(page.locator("#order-state")).to_have_text(re.compile(r"acknowledged at sample \d+"))
        expect(page.locator("#s-power dd")).to_have_text(re.compile(r"/ 0\.2\d* W"))
        expect(page.locator("#audit")).to_contain_text("predicted → achieved")

        page.click("#branch")
        expect(page.locator("#branch-state")).to_contain_text("1000 of 1000 ms")

        page.click("#revert")
        expect(page.locator("#s-power dd")).to_have_text(re.compile(r"/ 4 W"))
        page.keyboard.press("Shift+Escape")
        expect(page.locator("#s-control dd")).to_have_text("off")
        rows = page.inner_text("#rows")
        for what in ("what-if accepted", "back to the gains before", "emergency: control off"):
            assert what in rows
        assert len(set(re.findall(r"\b[0-9a-f]{8}\b", rows))) > 1
        browser.close()
    assert complaints == []


def test_page_is_usable_by_keyboard_and_on_a_tablet(
    running: Station, requires_debian: Callable[[str], Path]
) -> None:
    chromium = requires_debian("chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), headless=True, args=FLAGS)
        page = browser.new_page(viewport={"width": 820, "height": 1180})
        page.goto(running.url)
        page.wait_for_selector("body[data-redraws]", timeout=60_000)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        unnamed = page.evaluate(
            "[...document.querySelectorAll('input,select')].filter(e => !e.labels.length).map(e => e.id)"
        )
        assert unnamed == []
        small = page.evaluate(
            "[...document.querySelectorAll('button')].filter(b => b.offsetParent && b.offsetHeight < 40).map(b => b.id)"
        )
        assert small == []
        reached = []
        for _ in range(40):
            page.keyboard.press("Tab")
            reached.append(page.evaluate("document.activeElement.id"))
        for name in ("off", "budget", "kind", "margin", "propose", "branch"):
            assert name in reached
        assert page.locator("#status dd").count() == 11
        browser.close()


def test_ctrl_c_ends_with_a_summary_a_whole_recording_and_control_off(running: Station) -> None:
    children = psutil.Process(running.live.pid).children(recursive=True)
    said = running.end_live()
    assert running.live.returncode == 0
    assert "blocks lost" in said
    assert "Traceback" not in said
    _, alive = psutil.wait_procs(children, timeout=5.0)
    assert alive == []
    recording = open_recording(running.folder / "live.rrd")
    assert not recording.repaired
    time.sleep(1.0)
    result = run_replay(running.folder / "live.rrd", ReplayOptions(), lambda _: None, lambda *_: None)
    assert result["decisions_repeated"]
    assert running.rig.poll() is None


def test_a_station_that_returns_finds_the_rig_safe_and_a_rig_that_returns_is_followed(
    running: Station,
) -> None:
    if running.live.poll() is None:
        running.end_live()
    running.start_live("--no-web", "--automatic", "--seconds", "60")
    time.sleep(2.0)
    running.rig.kill()
    running.rig.wait()
    time.sleep(1.5)
    running.start_rig()
    log = running.folder / "live.log"
    end = time.monotonic() + 30.0
    while "started again" not in log.read_text() and time.monotonic() < end:
        time.sleep(0.2)
    assert "the rig is silent" in log.read_text()
    time.sleep(2.0)
    said = running.end_live()
    assert running.live.returncode == 0, said
    assert "rig began anew" in said
    assert "1 times" in said


def test_wrong_key_and_wrong_address_are_told_apart_from_a_crash(running: Station) -> None:
    process = running._start(
        "wrong", "live", "udp://127.0.0.1:1", "--plant", "rig",
        "--keys", running.folder / "station.key_secret", "--rig", running.folder / "rig.key",
    )  # fmt: skip
    assert process.wait(60.0) == 2
    assert "write tcp://HOST:PORT" in (running.folder / "wrong.log").read_text()
