"""Recorded tests, replayed: the results that were stored come out again."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recordings.results import CONFIG, EXPECTED, FOLDER, RECORDING, recorded_tests, replay_results
from twin.rig.recorded import open_recording
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import TESTS, measured_damping, programme

RELATIVE = 1e-9
BYTES_PER_FOLDER, BYTES_IN_ALL = 6_000_000, 30_000_000
CASES = (
    "fault_stuck_accelerometer",
    "fault_lost_blocks",
    "fault_saturating_sensor",
    "fault_wrong_model",
    "whatif_budget_change",
)


@pytest.fixture(scope="module", params=recorded_tests(), ids=lambda folder: folder.name)
def folder(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture(scope="module")
def results(folder: Path) -> dict[str, Any]:
    return replay_results(folder / RECORDING)


@pytest.fixture(scope="module")
def expected(folder: Path) -> dict[str, Any]:
    return json.loads((folder / EXPECTED).read_text(encoding="utf-8"))


def assert_equal(found: Any, stored: Any, where: str, scale: float = 0.0) -> None:
    """Equal, numbers to RELATIVE of the largest beside them."""
    if isinstance(stored, dict):
        assert found.keys() == stored.keys(), where
        for key, value in stored.items():
            assert_equal(found[key], value, f"{where}.{key}")
    elif isinstance(stored, list | tuple):
        assert len(found) == len(stored), where
        sizes = [abs(v) for v in stored if isinstance(v, float) and math.isfinite(v)]
        for k, value in enumerate(stored):
            assert_equal(found[k], value, f"{where}[{k}]", max(sizes, default=0.0))
    elif isinstance(stored, float):
        assert found == pytest.approx(stored, rel=RELATIVE, abs=RELATIVE * scale, nan_ok=True), where
    else:
        assert found == stored, where


def as_plain(value: Any) -> Any:
    """Return the value as it comes back from JSON."""
    return json.loads(json.dumps(value))


def test_the_four_tests_of_chapter_7_and_the_cases_are_recorded_and_stay_small() -> None:
    assert {path.name for path in recorded_tests()} >= {*TESTS, *CASES}
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < BYTES_IN_ALL


def test_data_of_a_simulated_rig_says_so(folder: Path) -> None:
    if folder.name in (*TESTS, *CASES):
        assert "from the simulated rig of this program, not from a real one" in (
            folder / "README.md"
        ).read_text(encoding="utf-8")


def test_damping_that_was_learned_is_the_true_one_whatever_the_gains_were(
    folder: Path, results: dict[str, Any]
) -> None:
    if folder.name not in TESTS:
        pytest.skip("dwells at one frequency")
    curve, truth = results["damping"], measured_damping()
    for f, learned in zip(curve["frequency_hz"], curve["damping_ns_m"], strict=True):
        if 47.0 <= f <= 54.0:
            assert learned == pytest.approx(truth.at(f), abs=0.25)


@pytest.mark.parametrize("test", TESTS)
def test_recorded_samples_are_those_the_programme_gives(test: Any) -> None:
    config = tomllib.loads((FOLDER / test / CONFIG).read_text(encoding="utf-8"))
    run = programme(
        config["test"], seconds=config["seconds"], sweep_hz=config["sweep_hz"], seed=config["seed"]
    )
    first = next(open_recording(FOLDER / test / RECORDING).blocks())
    np.testing.assert_allclose(SimulatedRig(run).next_block()[0], first.values, rtol=1e-4, atol=1e-5)


def test_folder_says_what_it_is_and_stays_small(folder: Path) -> None:
    text = (folder / "README.md").read_text(encoding="utf-8")
    for heading in ("## Goal", "## Set-up", "## Result", "## How it was made"):
        assert heading in text
    assert (folder / CONFIG).is_file()
    assert sum(path.stat().st_size for path in folder.iterdir()) < BYTES_PER_FOLDER


def test_figures_are_those_stored(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert_equal(as_plain(results["figures"]), expected["figures"], "figures")
    assert_equal(as_plain(results["estimate"]), expected["estimate"], "estimate")


def test_learned_damping_is_that_stored(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert_equal(as_plain(results["damping"]), expected["damping"], "damping")


def test_events_and_decisions_are_identical(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert results["events"] == expected["events"]
    assert as_plain(results["decisions"]) == expected["decisions"]


def test_commands_carry_the_stored_gains(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert_equal(as_plain(results["commands"]), expected["commands"], "commands")


SAYS = {
    "fault_stuck_accelerometer": "table_acceleration is stuck",
    "fault_lost_blocks": "no valid sample of any sensor",
    "fault_saturating_sensor": "absorber_acceleration disagree at the excitation",
    "fault_wrong_model": "absorber_acceleration are coloured",
}


def test_what_went_wrong_is_said_and_what_was_ordered_is_repeated(
    folder: Path, results: dict[str, Any]
) -> None:
    if folder.name in SAYS:
        assert any(SAYS[folder.name] in text for text in results["events"])
    if folder.name == "whatif_budget_change":
        assert [d["accepted"] for d in results["decisions"] if d["by"] == "operator"] == [True]
    if folder.name in CASES:
        assert results["commands_repeated"]


def test_second_replay_in_the_same_process_is_equal_to_the_bit(folder: Path, results: dict[str, Any]) -> None:
    assert replay_results(folder / RECORDING) == results
