"""The operator page without a mouse, without colours, on a tablet, under its policy; and of a recording."""

import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from station_processes import Station, station, wait_for

FLAGS = ["--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"]

CONTRAST = """
() => {
  const parse = (c) => { const m = c.match(/[\\d.]+/g).map(Number); return { rgb: m.slice(0, 3), a: m[3] ?? 1 }; };
  const light = (rgb) => rgb.map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0);
  const behind = (e) => {
    const layers = [];
    for (let n = e; n; n = n.parentElement) {
      const b = parse(getComputedStyle(n).backgroundColor);
      if (b.a > 0) layers.push(b);
      if (b.a === 1) break;
    }
    return layers.reverse().reduce((under, b) => b.rgb.map((v, k) => v * b.a + under[k] * (1 - b.a)), [255, 255, 255]);
  };
  const ratio = (a, b) => {
    const [x, y] = [light(a), light(b)].sort((p, q) => q - p);
    return (x + 0.05) / (y + 0.05);
  };
  const texts = [], graphics = [];
  for (const e of document.querySelectorAll("body *")) {
    if (!e.checkVisibility({ checkVisibilityCSS: true }) || e.closest(".sr, .skip") || e.disabled) continue;
    const s = getComputedStyle(e);
    const name = `${e.tagName}#${e.id || e.closest("[id]")?.id}.${e.getAttribute("class") ?? ""}`;
    if ([...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim())) {
      const svg = e instanceof SVGElement;
      texts.push([ratio(parse(svg ? s.fill : s.color).rgb, behind(e)), name]);
    }
    if (e.matches("input:not([type=range]), select, button, .button")) {
      const border = ratio(parse(s.borderTopColor).rgb, behind(e.parentElement));
      const fill = ratio(behind(e), behind(e.parentElement));
      graphics.push([Math.max(border, fill), name]);
    }
    if (e.matches("#steps li")) graphics.push([ratio(parse(s.borderBottomColor).rgb, behind(e)), name]);
    if (e.matches("#verdict")) graphics.push([ratio(parse(s.borderTopColor).rgb, behind(e.parentElement)), name]);
    if (e.matches("path.js-line")) graphics.push([ratio(parse(s.stroke).rgb, behind(e.closest(".chart"))), name]);
  }
  const worst = (found) => found.sort((a, b) => a[0] - b[0]).slice(0, 5);
  return { texts: worst(texts), n: texts.length, graphics: worst(graphics), m: graphics.length };
}
"""


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    with station(tmp_path_factory.mktemp("everybody")) as both:
        # Half as fast as a real rig: what is tested here are pages, also on a machine that has much else to do.
        both.start_rig(53.0, "--speed", "0.5")
        both.start_live("--seconds", "600")
        yield both


@pytest.fixture(scope="module")
def browser(requires_debian: Callable[[str], Path]) -> Iterator[Any]:
    chromium = requires_debian("chromium")
    from playwright.sync_api import expect, sync_playwright

    expect.set_options(timeout=60_000)
    with sync_playwright() as play:
        made = play.chromium.launch(executable_path=str(chromium), headless=True, args=FLAGS)
        yield made
        made.close()


def opened(browser: Any, url: str, width: int = 1600, height: int = 1000) -> tuple[Any, list[str]]:
    """A page, and everything the browser complains of."""
    complaints: list[str] = []
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(60_000)
    page.on("console", lambda m: complaints.append(m.text) if m.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(url)
    return page, complaints


def tab_to(page: Any, name: str) -> None:
    """Press Tab until an element has the focus, which must be seen on every one on the way."""
    for _ in range(60):
        page.keyboard.press("Tab")
        found, outline = page.evaluate(
            "(() => { const e = document.activeElement, s = getComputedStyle(e);"
            " return [e.id, s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) >= 2]; })()"
        )
        assert outline or found == "", f"the focus on {found} cannot be seen"
        if found == name:
            return
    raise AssertionError(f"Tab never came to {name}")


def test_from_the_slider_to_the_rig_and_back_with_the_keyboard_alone(running: Station, browser: Any) -> None:
    from playwright.sync_api import expect

    page, complaints = opened(browser, running.url)
    expect(page.locator("#s-rig dd")).to_have_text("connected")
    expect(page.locator("#s-model dd")).to_have_text("consistent", timeout=60_000)
    page.wait_for_selector("body[data-redraws]")
    if page.locator("#s-control dd").inner_text() == "off":
        tab_to(page, "on")
        page.keyboard.press("Enter")
    expect(page.locator("#s-control dd")).to_have_text("on")
    expect(page.locator("#verdict-word")).not_to_have_text(re.compile("Alarm|Trouble|No station"))
    tab_to(page, "budget")
    for _ in range(50):
        page.keyboard.press("ArrowLeft")
    assert "0.398 W" in page.inner_text("#budget-out")
    tab_to(page, "propose")
    page.keyboard.press("Enter")
    expect(page.locator("#arm")).to_be_focused()  # one goes on where the work goes on
    review = page.inner_text("#review")
    for what in (
        "4 W mean Joule → 0.398 W",
        "worst motion",
        "highest power",
        "modulus",
        "delay",
        "power, ",
        "µm/W",
        "γ",
    ):
        assert what in review, what
    page.keyboard.press("Enter")
    expect(page.locator("#send")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#order-state")).to_have_text(re.compile(r"acknowledged at sample \d+"))
    expect(page.locator("#s-power dd")).to_have_text(re.compile(r"/ 0\.398 W"))
    expect(page.locator("#audit")).to_contain_text("predicted → achieved")
    tab_to(page, "revert")
    page.keyboard.press("Enter")
    expect(page.locator("#s-power dd")).to_have_text(re.compile(r"/ 4 W"))
    page.keyboard.press("Shift+Escape")
    expect(page.locator("#emergency")).to_contain_text("the rig confirms it")
    expect(page.locator("#s-control dd")).to_have_text("off")
    assert complaints == []  # the policy among them: not one violation
    page.close()


def test_words_and_lines_can_be_told_from_what_is_behind_them(running: Station, browser: Any) -> None:
    page, _ = opened(browser, running.url)
    page.wait_for_selector("body[data-redraws]")
    page.wait_for_timeout(1500)
    page.click("summary")
    found = page.evaluate(CONTRAST)
    assert found["n"] > 80
    assert found["m"] > 20
    assert found["texts"][0][0] >= 4.5, found["texts"]
    assert found["graphics"][0][0] >= 3.0, found["graphics"]
    # Never by colour alone: what is good, odd or bad has a sign of its own as well.
    signs = page.evaluate(
        "[...document.querySelectorAll('#status > .good dd, #status > .warn dd, #status > .bad dd')]"
        ".map((e) => getComputedStyle(e, '::before').content)"
    )
    assert signs
    assert set(signs) <= {'"✓"', '"!"', '"✕"'}
    page.close()


@pytest.mark.parametrize(("width", "height"), [(1024, 768), (768, 1024), (400, 800)])
def test_on_a_tablet_nothing_runs_off_the_side_and_fingers_find_what_they_want(
    running: Station, browser: Any, width: int, height: int
) -> None:
    page, _ = opened(browser, running.url, width, height)
    page.wait_for_selector("body[data-redraws]")
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    small = page.evaluate(
        "[...document.querySelectorAll('button, input, select, a.button, summary')].filter((e) => e.offsetParent)"
        ".map((e) => e.closest('label.check') ?? e).filter((e) => e.getBoundingClientRect().height < 44)"
        ".map((e) => e.id || e.className)"
    )
    assert small == []
    off = page.locator("#off").bounding_box()
    assert 0 <= off["y"] < height - 44
    page.evaluate("window.scrollTo(0, document.documentElement.scrollHeight)")
    off = page.locator("#off").bounding_box()
    assert 0 <= off["y"] < height - 44, "wherever one has scrolled to, control can be switched off"
    page.close()


def test_stop_is_not_said_to_have_worked_where_it_has_not(running: Station, browser: Any) -> None:
    from playwright.sync_api import expect

    page, _ = opened(browser, running.url)
    expect(page.locator("#s-rig dd")).to_have_text("connected")
    running.rig.send_signal(signal.SIGSTOP)
    try:
        page.keyboard.press("Shift+Escape")
        expect(page.locator("#emergency")).to_contain_text("has not confirmed it. Use the switch at the rig")
        running.live.send_signal(signal.SIGSTOP)
        try:
            expect(page.locator("#verdict-word")).to_have_text("No station")
            page.click("#off")
            expect(page.locator("#emergency")).to_contain_text("did NOT reach the station", timeout=20_000)
        finally:
            running.live.send_signal(signal.SIGCONT)
    finally:
        running.rig.send_signal(signal.SIGCONT)
    expect(page.locator("#stale")).to_have_text("")
    expect(page.locator("#s-rig dd")).to_have_text("connected")
    page.close()


def test_recording_is_played_from_the_same_page_and_takes_no_orders(running: Station, browser: Any) -> None:
    from playwright.sync_api import expect

    if running.live.poll() is None:
        page, _ = opened(browser, running.url)
        page.wait_for_selector("body[data-redraws]")
        page.wait_for_timeout(10_000)
        page.close()
        running.end_live()
    replay = running._start("replay", "replay", running.folder / "live.rrd", "--web", "--speed", "0.1")
    try:
        url = wait_for(running.folder / "replay.log", r"page: (\S+)", replay)
        page, complaints = opened(browser, url)
        expect(page.locator("#player")).to_be_visible()
        expect(page.locator("#s-rig dd")).to_have_text("recording")
        assert not page.locator(".switches").is_visible()
        assert not page.locator("#order-buttons").is_visible()
        page.wait_for_selector("body[data-redraws]")

        def at() -> float:
            return float(page.inner_text("#position").split("/")[0])

        page.click("#play")
        expect(page.locator("#play")).to_have_text("Play")
        page.wait_for_timeout(400)
        stands = at()
        page.wait_for_timeout(500)
        assert at() == stands
        page.click("#step")
        expect(page.locator("#position")).to_have_text(re.compile(rf"^{stands + 0.1:.1f} /"))
        page.focus("#seek")
        page.keyboard.press("Home")
        begin = float(page.get_attribute("#seek", "min"))  # the rig ran before there was a station
        expect(page.locator("#position")).to_have_text(re.compile(rf"^({begin:.1f}|{begin + 0.1:.1f}) /"))
        page.evaluate(
            "(() => { const s = document.getElementById('seek'); s.value = String(Number(s.min) + 3);"
            " for (const e of ['input', 'change']) s.dispatchEvent(new Event(e)); })()"
        )
        expect(page.locator("#position")).to_have_text(re.compile(rf"^{begin + 3.0:.1f} /"))
        expect(page.locator("#rows")).to_contain_text("the replay jumped here")
        page.click("#branch")
        expect(page.locator("#branch-state")).to_contain_text("Play on to see what was measured")
        page.select_option("#speed", "1")
        page.click("#play")
        expect(page.locator("#branch-state")).to_contain_text("1000 of 1000 ms")
        refused = page.evaluate(
            "fetch('/api/off', { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: '{}' })"
            ".then((a) => a.json())"
        )
        assert "recording" in refused["reason"]
        assert [c for c in complaints if "403" not in c] == []
        page.close()
        replay.send_signal(signal.SIGINT)
        replay.wait(30.0)
        said = (running.folder / "replay.log").read_text()
        assert replay.returncode == 0, said
        assert "there were jumps" in said
        assert "Traceback" not in said
    finally:
        if replay.poll() is None:
            replay.kill()
            replay.wait()


def test_replay_without_a_visitor_ends_by_itself(running: Station) -> None:
    if running.live.poll() is None:
        running.end_live()
    replay = running._start(
        "alone", "replay", running.folder / "live.rrd", "--web", "--to", "2", "--speed", "0", "--json", "-"
    )
    began = time.monotonic()
    assert replay.wait(90.0) == 0
    assert '"decisions_repeated": true' in (running.folder / "alone.log").read_text()
    assert time.monotonic() - began < 90.0
