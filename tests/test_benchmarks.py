"""The benchmarks work, say what they measured, and what they compare is equal. Speed is not tested here."""

import json
import math
import subprocess
import sys
from typing import Any

import pytest

from benchmarks.cases import CASES, run_case
from benchmarks.report import Report, Row


@pytest.fixture(scope="module")
def reports() -> dict[str, Report]:
    return {name: run_case(name, small=True) for name in CASES}


def numbers(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [n for v in value.values() for n in numbers(v)]
    if isinstance(value, list):
        return [n for v in value for n in numbers(v)]
    return (
        [] if isinstance(value, str) or value is None else [float(value)]
    )  # None: not measured in this setting


@pytest.mark.parametrize("name", CASES)
def test_figures_are_finite_and_go_through_json(name: str, reports: dict[str, Report]) -> None:
    figures = reports[name].figures
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert numbers(figures)
    assert all(math.isfinite(n) and n >= 0.0 for n in numbers(figures))


def test_observer_reports_both_modes_at_both_sizes(reports: dict[str, Report]) -> None:
    entries = reports["observer"].figures["observer"]
    assert {(e["states"], e["mode"]) for e in entries} == {
        (n, mode) for n in (8, 12) for mode in ("full", "constant")
    }
    assert all(e["speedup_vs_filterpy"] > 0.0 and e["measurements"] == 4 for e in entries)


def test_observer_equals_filterpy(reports: dict[str, Report]) -> None:
    for entry in reports["observer"].figures["observer"]:
        bound = {"full": 1e-8, "constant": 1e-10}[entry["mode"]]
        assert entry["max_relative_difference"] <= bound, entry
    row = next(
        r
        for r in reports["observer"].rows
        if r.what == "least squares, 3 parameters: largest relative difference"
    )
    assert row.value <= 1e-9


def test_plant_equals_scipy_and_python_control(reports: dict[str, Report]) -> None:
    figures = reports["plant"].figures["plant"]
    assert figures["max_relative_difference_dlsim"] <= 1e-12
    assert figures["max_relative_difference_control"] <= 1e-12


def test_filter_chain_equals_scipy(reports: dict[str, Report]) -> None:
    assert reports["filters"].figures["filters"]["max_relative_difference"] <= 1e-9


def test_chain_reports_every_mode_and_stage(reports: dict[str, Report]) -> None:
    figures = reports["chain"].figures["chain"]
    assert all(figures[f"realtime_factor_{mode}"] > 0.0 for mode in ("full", "steady", "recorded"))
    stages = figures["stage_share_of_real_time"]
    assert {"observer", "lock-in", "retuning", "recording and view"} <= stages.keys()
    assert stages["observer"] > 0.0


def test_every_timed_proposal_is_feasible(reports: dict[str, Report]) -> None:
    figures = reports["retune"].figures["retune"]
    assert figures["feasible"] == figures["proposals"]
    assert 0.0 < figures["median_ms"] <= figures["p99_ms"]
    assert (
        figures["qp_ms"] < figures["median_ms"]
    )  # 0 where so few proposals needed no program for their start
    assert figures["loop_block_ms_idle"] > 0.0
    assert figures["loop_block_ms_retuning"] > 0.0


@pytest.mark.parametrize(("value", "better", "verdict"), [(2.0, "more", "ok"), (2.0, "less", "short")])
def test_target_is_judged(value: float, better: Any, verdict: str) -> None:
    assert Row("figure", value, "x", 1.0, better).verdict == verdict
    assert Row("figure", value).verdict == ""


def test_unknown_case_is_refused() -> None:
    command = [sys.executable, "-m", "benchmarks", "no_such_case"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "no_such_case" in done.stderr
