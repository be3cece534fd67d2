"""Recorded tests, replayed: the results that were stored come out again."""

import json
import math
from pathlib import Path
from typing import Any

import pytest

from recordings.results import CONFIG, EXPECTED, RECORDING, recorded_tests, replay_results

RELATIVE = 1e-9
BYTES_PER_FOLDER = 6_000_000


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


def test_there_is_a_recorded_test() -> None:
    assert recorded_tests()


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


def test_decisions_are_identical(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert as_plain(results["decisions"]) == expected["decisions"]


def test_commands_carry_the_stored_gains(results: dict[str, Any], expected: dict[str, Any]) -> None:
    assert_equal(as_plain(results["commands"]), expected["commands"], "commands")


def test_second_replay_in_the_same_process_is_equal_to_the_bit(folder: Path, results: dict[str, Any]) -> None:
    assert replay_results(folder / RECORDING) == results
