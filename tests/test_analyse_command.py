"""``atmd analyse`` as people type it."""

import json
import subprocess
import sys

import pytest

from twin.plant.errors import InputError
from twin.station.analyse import parse_cutoffs, parse_frequencies

KEYS = {
    "frequency_hz", "primary_displacement_m", "stroke_m", "actuator_force_n", "current_a", "voltage_v",
    "joule_peak_w", "joule_mean_w", "electrical_mean_w", "stable", "delay_margin_s", "modulus_margin",
}  # fmt: skip


def atmd(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "twin.station.cli", "analyse", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_figures_as_json_and_a_table_beside():
    done = atmd(
        "--plant", "engine_vcm", "--controller", "gain_scheduling", "--at", "47:53:3", "--json", "-"
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert set(result) == {"natural_frequencies_hz", "points"}
    assert result["natural_frequencies_hz"] == pytest.approx([1.96, 54.97], abs=0.01)
    assert [p["frequency_hz"] for p in result["points"]] == [47.0, 50.0, 53.0]
    assert all(set(p) == KEYS for p in result["points"])
    first = result["points"][0]
    assert first["joule_peak_w"] == pytest.approx(100.23, rel=1e-4)
    assert first["delay_margin_s"] is None
    assert "100" in done.stderr
    assert "…" not in done.stderr


def test_plant_without_a_coil_has_no_current():
    done = atmd("--plant", "engine", "--at", "50", "--controller", "lq", "--json", "-")
    (point,) = json.loads(done.stdout)["points"]
    assert (
        point["current_a"]
        is point["voltage_v"]
        is point["joule_peak_w"]
        is point["electrical_mean_w"]
        is None
    )


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["--plant", "nope"], "--plant nope"),
        (["--plant", "beam"], "no absorber"),
        (["--plant", "rig", "--at", "55:45:1"], "--at 55:45:1"),
        (["--plant", "rig", "--filters", "1,200"], "--filters 1,200"),
        (["--plant", "rig", "--controller", "lq", "--filters", "200,1"], "--filters"),
        (["--plant", "rig", "--delay-us", "-1"], "--delay-us"),
        (["--plant", "rig", "--excitation-n", "nan"], "--excitation-n"),
        (["--plant", "rig", "--controller", "pid"], "--controller"),
        (["--plant", "rig", "--json", "/nowhere/x.json"], "--json"),
    ],
)
def test_mistakes_end_with_2_and_name_the_option(words, names):
    done = atmd(*words)
    assert done.returncode == 2
    assert names in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


@pytest.mark.parametrize(
    "text", ["", "45:55", "45:55:0", "0:5:1", "a,b", "47,-1", "nan", "1:inf:1", "1:2:1e-9"]
)
def test_ranges_that_are_none(text):
    with pytest.raises(InputError, match="--at"):
        parse_frequencies(text)


def test_ranges_include_their_ends():
    assert parse_frequencies("45:46:0.1")[-1] == 46.0
    assert len(parse_frequencies("45:55:1")) == 11
    assert parse_frequencies("50, 47") == [50.0, 47.0]


@pytest.mark.parametrize("text", ["200", "200,1,3", "a,b", "1,200", "200,0", "nan,1"])
def test_cutoffs_that_are_none(text):
    with pytest.raises(InputError, match="--filters"):
        parse_cutoffs(text)
