"""``atmd tune`` as a person runs it."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from twin.plant.errors import InputError
from twin.station.cli import app

RUNNER = CliRunner()


def tuned(*arguments: str) -> list[dict[str, object]]:
    result = RUNNER.invoke(app, ["tune", *arguments, "--json", "-"])
    assert result.exit_code == 0, result.output
    return list(json.loads(result.stdout)["points"])


def test_engine_at_25_w_comes_within_6_percent_of_its_limit(tmp_path: Path) -> None:
    picture = tmp_path / "tune.png"
    points = tuned("--plant", "engine_vcm", "--band", "47:53:3", "--plot", str(picture))
    assert [p["frequency_hz"] for p in points] == [47.0, 50.0, 53.0]
    assert picture.stat().st_size > 10_000
    assert points[2]["limit_displacement_m"] == pytest.approx(50.78e-6, rel=1e-3)
    for p in points:
        assert p["achieved_displacement_m"] <= 1.06 * p["limit_displacement_m"] + 1e-7  # type: ignore[operator]
        assert p["joule_mean_w"] <= 25.0  # type: ignore[operator]
        assert p["joule_peak_w"] == pytest.approx(2.0 * p["joule_mean_w"])  # type: ignore[operator]
        assert p["modulus_margin"] >= 0.3  # type: ignore[operator]
        assert p["delay_margin_s"] >= 200e-6  # type: ignore[operator]
        assert abs(p["duality_gap"]) <= 1e-6  # type: ignore[arg-type]
        lq = p["lq"]
        assert isinstance(lq, dict)
        assert np.shape(lq["Q"]) == (len(lq["states"]), len(lq["states"]))
    assert points[2]["active_limits"][0]["name"] == "power"  # type: ignore[index]


def test_wish_that_no_budget_meets_says_what_would_do() -> None:
    (point,) = tuned("--plant", "engine_vcm", "--band", "47", "--displacement-um", "20")
    assert point["achieved_displacement_m"] is None
    assert point["binding"] == ["power"]
    assert point["least_budget_w"] == pytest.approx(32.3, abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--plant", "rig_no_vcm"], "has no voice coil"),
        (["--plant", "rig", "--excitation-n", "5"], "use --excitation-v"),
        (["--plant", "rig", "--budget-w", "0"], "--budget-w 0"),
        (["--plant", "rig", "--band", "x"], "--band x"),
        (["--plant", "rig", "--modulus-margin", "1.5"], "--modulus-margin 1.5"),
        (["--plant", "rig", "--sample-rate", "120"], "--sample-rate 120"),
    ],
)
def test_what_cannot_be_tuned_is_said(arguments: list[str], words: str) -> None:
    result = RUNNER.invoke(app, ["tune", *arguments])
    assert isinstance(result.exception, InputError)
    assert words in str(result.exception)
