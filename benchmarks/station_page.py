"""The operator's page in Chromium: how long until a control's curves are drawn; and its pictures.

Time runs from the browser's own stamp of the input event until the frame with all four curves has been painted.

Run for the pictures: python -m benchmarks.station_page docs/images
"""

import argparse
import itertools
import random
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from tests.station_processes import Station, station
from twin.station.doctor import find_browser

GIVEN_UP_S = 30.0
FLAGS = ["--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"]
LISTEN = """() => {
  window.redraws = []; window.completes = [];
  document.addEventListener("curves-redraw", (e) => redraws.push(e.detail));
  document.addEventListener("curves-complete", (e) => completes.push(e.detail));
}"""


def move_latencies(both: Station, browser: Path, count: int) -> tuple[list[float], list[float]]:
    """Move controls; returns the times [ms] until curves were drawn and, of those left alone, confirmed."""
    with _page(both, browser) as page:
        return _moves(page, count)


@contextmanager
def _page(both: Station, browser_path: Path) -> Iterator[Page]:
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(browser_path), args=FLAGS)
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.goto(both.url)
        page.wait_for_selector("body[data-completes]", timeout=60_000)
        yield page
        browser.close()


def _moves(page: Page, count: int) -> tuple[list[float], list[float]]:
    """Move budget, margin and cutoffs in turn, now slowly, now while the last answer is still being refined."""
    rng = random.Random(5)  # noqa: S311 - a pattern of moves, no secret
    moves = itertools.islice(_pattern(page), count)
    page.evaluate(LISTEN)
    for move in moves:
        seen = page.evaluate("redraws.length")
        move()
        page.wait_for_timeout(rng.choice((60.0, 250.0, 700.0)))
        end = time.monotonic() + GIVEN_UP_S
        while page.evaluate("redraws.length") == seen:
            if time.monotonic() > end:
                raise RuntimeError(f"no curves within {GIVEN_UP_S:.0f} s of a move")
            page.wait_for_timeout(50.0)
    page.wait_for_timeout(500)
    return page.evaluate("redraws"), page.evaluate("completes")


def _pattern(page: Page) -> Iterator[Callable[[], None]]:
    def press(control: str, key: str) -> Callable[[], None]:
        return lambda: page.locator(control).press(key)

    def fill(control: str, value: float) -> Callable[[], None]:
        return lambda: page.fill(control, f"{value:g}")

    while True:
        yield from [press("#budget", "ArrowLeft")] * 25
        yield from [press("#margin", "ArrowRight")] * 10
        yield from (fill("#low", 150.0 + 10.0 * k) for k in range(3))
        yield from (fill("#high", 2.0 - 0.2 * k) for k in range(3))
        yield from [press("#budget", "ArrowRight")] * 25
        yield from [press("#margin", "ArrowLeft")] * 10
        yield from (fill(c, v) for c, v in (("#excitation", 3.5), ("#c2", 9.0)))
        yield lambda: page.click("#reset")


def draw_pictures(folder: Path) -> None:
    """Have a person's way through the page drawn: review, what was achieved, on a tablet."""
    browser = find_browser()
    if browser is None:
        raise SystemExit("no Chromium was found: see atmd doctor")
    with tempfile.TemporaryDirectory() as run, station(Path(run)) as both:
        both.start_rig()
        both.start_live()
        with _page(both, browser) as page:
            page.wait_for_timeout(5000)
            if page.inner_text("#s-control dd") == "off":
                page.click("#on")
                page.wait_for_timeout(2000)
            page.click("#propose")
            page.wait_for_selector("#arm:enabled", timeout=30_000)
            page.screenshot(path=folder / "station-review.png")
            page.click("#arm")
            page.wait_for_selector("#send:enabled")
            page.click("#send")
            page.wait_for_timeout(6000)
            page.click("#branch")
            page.wait_for_timeout(5000)
            page.screenshot(path=folder / "station-achieved.png", full_page=True)
            page.set_viewport_size({"width": 820, "height": 1180})
            page.wait_for_timeout(1000)
            page.screenshot(path=folder / "station-tablet.png")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    draw_pictures(parser.parse_args().folder)
