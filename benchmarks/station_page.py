"""The operator page measured: slider to redrawn curves, order to first obeyed sample; and its pictures.

Run: python benchmarks/station_page.py [--pictures docs/images]
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from station_processes import station

from twin.station.doctor import find_browser

SLIDES, ORDERS = 40, 20
WATCH = """() => new Promise(done => {
  const on = document.querySelector('#s-control dd').textContent, began = performance.now();
  const tick = () => document.querySelector('#s-control dd').textContent === on
    ? setTimeout(tick, 5) : done(performance.now() - began);
  document.getElementById(on === 'on' ? 'off' : 'on').click(); tick(); })"""


def main() -> None:
    """Print 50th and 95th percentiles in ms."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--pictures", type=Path)
    pictures = parser.parse_args().pictures
    with tempfile.TemporaryDirectory() as folder, station(Path(folder)) as both, sync_playwright() as play:
        both.start_rig()
        both.start_live()
        browser = play.chromium.launch(executable_path=str(find_browser()), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.goto(both.url)
        page.wait_for_selector("body[data-redraws]", timeout=60_000)
        page.wait_for_timeout(3000)
        if page.inner_text("#s-control dd") == "off":
            page.click("#on")
        page.wait_for_timeout(2000)
        drawn, whole = [], []
        page.focus("#budget")
        for k in range(SLIDES):
            page.keyboard.press("ArrowLeft" if k < 30 else "ArrowRight")
            page.wait_for_timeout(900)
            drawn.append(float(page.evaluate("document.body.dataset.redrawMs")))
            whole.append(float(page.evaluate("document.body.dataset.completeMs")))
        if pictures is not None:
            page.click("#propose")
            page.wait_for_selector("#arm:enabled", timeout=30_000)
            page.screenshot(path=pictures / "station-review.png")
            page.click("#arm")
            page.wait_for_selector("#send:enabled")
            page.click("#send")
            page.wait_for_timeout(6000)
            page.click("#branch")
            page.wait_for_timeout(5000)
            page.screenshot(path=pictures / "station-achieved.png", full_page=True)
            page.set_viewport_size({"width": 820, "height": 1180})
            page.wait_for_timeout(1000)
            page.screenshot(path=pictures / "station-tablet.png")
        obeyed = []
        for _ in range(ORDERS):
            page.wait_for_timeout(700)
            obeyed.append(float(page.evaluate(WATCH)))
        browser.close()

    def figures(values: list[float]) -> dict[str, float]:
        return {f"p{p}": round(float(np.percentile(values, p)), 1) for p in (50, 95)}

    result = {
        "slider_to_redrawn_ms": figures(drawn),
        "slider_to_all_proposed_ms": figures(whole),
        "order_to_shown_ms": figures(obeyed),
    }
    sys.stdout.write(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
