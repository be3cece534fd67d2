"""Measured recordings of other rigs: replayed through the session where there is a rig in them, else fitted."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from twin.station.cli import app

CIRCUIT = """
name = "series_circuit"                 # inductance for mass, resistance for damping, 1/C for stiffness
[[body]]
name = "charge"
mass_kg = 1.54e-3
attached_to = "ground"
stiffness_n_m = 1.0e7
damping_ns_m = 15.4
disturbance_drift_n_s = 3.0e3         # the source that was not recorded jumps
[[sensor]]
name = "capacitor"
kind = "displacement"
of = "charge"
noise_density = 3e-12
"""
CHARGE_PER_VOLT = "V@10000000 V/m"

REPLAYED: dict[str, tuple[str, list[str], float]] = {
    "beam_open": ("beam", ["--channel", "piezo=none"], 0.045),
    "beam_closed_lq": ("beam", [], 0.070),
    # What drives the circuit is recorded ahead of an amplifier of unknown gain.
    "rlc_20221130_0001": (CIRCUIT, ["--channel", f"capacitor=data[3,1,:]:{CHARGE_PER_VOLT}"], 0.06),
}
"""Plant, options, and the error of the one-step prediction that is not to be exceeded."""

FITTED: dict[str, tuple[str, str]] = {
    "faster": (
        "damper",
        "quasi-static and in normalised force: no mass can be told, so there is no plant to step",
    ),
    "mr_0V": (
        "damper",
        "a crank imposes the motion: what is measured is a force law, not a rig that moves freely",
    ),
    "soton_frf_in1": ("frf", "frequency responses, no series in time"),
}


def run(*arguments: object) -> dict[str, Any]:
    done = CliRunner().invoke(app, [*map(str, arguments), "--json", "-"])
    assert done.exception is None, done.exception
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def replay(path: Path, plant: str, folder: Path, *options: str) -> dict[str, Any]:
    if "\n" in plant:
        file = folder / "plant.toml"
        file.write_text(plant)
        plant = str(file)
    return run("replay", path, "--plant", plant, *options)


def test_every_recording_there_is_replayed_or_fitted(realdata: Path) -> None:
    assert {p.stem for p in realdata.glob("*.npz")} == REPLAYED.keys() | FITTED.keys()


@pytest.mark.parametrize("name", REPLAYED)
def test_session_predicts_what_was_measured_and_repeats_itself_from_its_own_recording(
    realdata: Path, tmp_path: Path, name: str
) -> None:
    plant, options, error = REPLAYED[name]
    path, saved = realdata / f"{name}.npz", tmp_path / "saved.rrd"
    result = replay(path, plant, tmp_path, *options, "--save", str(saved))
    # Rows that a preset's parameters were fitted on are no test of them.
    assert bool(result["fitted_rows_left_out"]) is (plant == "beam")
    assert all(0.0 < s["nrmse"] < error for s in result["sensors"] if s["nrmse"] is not None)
    assert any(s["nrmse"] is not None for s in result["sensors"])
    again = run("replay", saved)
    assert [s["sensor"] for s in again["sensors"]] == [s["sensor"] for s in result["sensors"]]
    assert again["samples"] == result["samples"]
    if not result["fitted_rows_left_out"]:
        assert again["sensors"] == result["sensors"]  # to the bit


@pytest.mark.parametrize("name", FITTED)
def test_what_is_no_rig_in_time_is_fitted(realdata: Path, name: str) -> None:
    how, why = FITTED[name]
    assert why
    result = run("fit", how, realdata / f"{name}.npz")
    assert result["guesses"] == []  # all of it is said beside the file
    assert result["modes"] if how == "frf" else result["c_eq"] > 0.0
