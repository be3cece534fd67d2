"""The operator's station: from a control that moves to the curves drawn for it, from an order to what obeys it.

A rig and a station as a person starts them (``atmd rig``, ``atmd live``), with the page in Chromium.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Report, Row
from benchmarks.station_orders import order_latencies
from benchmarks.station_page import move_latencies
from tests.station_processes import station
from twin.station.doctor import find_browser

WANTED_REDRAW_MS, WANTED_OBEYED_MS = 200.0, 300.0


@dataclass(frozen=True, slots=True)
class Setting:
    """How often controls are moved and orders given; how long the twin may settle before [s]."""

    moves: int = 160
    orders: int = 60
    settle_s: float = 20.0


SMALL = Setting(moves=4, orders=2, settle_s=1.0)


def run_latency(setting: Setting) -> Report:
    """Both latencies with medians and 95th percentiles; without a browser those of the orders alone."""
    browser_path = find_browser()
    with tempfile.TemporaryDirectory() as folder, station(Path(folder)) as both:
        both.start_rig()
        both.start_live()
        time.sleep(setting.settle_s)
        obeyed = order_latencies(both, setting.orders)
        redraws, completes = (
            ([], []) if browser_path is None else move_latencies(both, browser_path, setting.moves)
        )
    return _report(redraws, completes, obeyed)


def _report(redraws: list[float], completes: list[float], obeyed: dict[str, list[float]]) -> Report:
    redrawn, confirmed = _percentiles(redraws), _percentiles(completes)
    orders = [ms for values in obeyed.values() for ms in values]
    taken = _percentiles(orders)
    figures = {
        "moves": len(redraws),
        "redrawn_ms": redrawn,
        "confirmed_ms": confirmed,
        "orders": len(orders),
        "obeyed_ms": taken,
        "obeyed_by_kind_ms": {kind: _percentiles(values) for kind, values in obeyed.items()},
    }
    rows = []
    for what, found, wanted in (
        ("control moved to all curves drawn", redrawn, WANTED_REDRAW_MS),
        ("control left alone to curves confirmed", confirmed, None),
        ("order to the first sample that obeys it", taken, WANTED_OBEYED_MS),
    ):
        if found is not None:
            rows += [
                Row(f"{what}, median", found["p50"], "ms"),
                Row("  95th percentile", found["p95"], "ms", wanted, "less"),
            ]
    return Report({"latency": figures}, rows)


def _percentiles(values: list[float]) -> dict[str, float] | None:
    if not values:
        return None
    return {f"p{p}": round(float(np.percentile(values, p)), 1) for p in (50, 95, 100)}
