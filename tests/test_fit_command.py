"""``atmd fit`` as a person meets it: measured recordings, files of other people, input that cannot be used."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from twin.plant.errors import InputError
from twin.station.cli import app

TAU = 2.0 * np.pi


def fit(*arguments: object) -> dict[str, Any]:
    done = CliRunner().invoke(app, ["fit", *map(str, arguments), "--json", "-"])
    if done.exception is not None:
        raise done.exception
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert isinstance(result, dict)
    return result


def refused(*arguments: object) -> str:
    done = CliRunner().invoke(app, ["fit", *map(str, arguments)])
    assert isinstance(done.exception, InputError), done.output
    return str(done.exception)


def saved(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_beam_damping_falls_with_amplitude(realdata: Path) -> None:
    bands = fit("decay", realdata / "beam_open.npz", "--channel", "y")["bands"]
    by_edge = {(b["amplitude_from"], b["amplitude_to"]): b for b in bands}
    loud, quiet = by_edge[5.0, 10.0], by_edge[0.5, 1.0]
    assert loud["unit"] == "mm"
    assert loud["decays"] == quiet["decays"] == 3
    assert loud["damping_ratio"] == pytest.approx(0.0045, rel=0.1)
    assert quiet["damping_ratio"] == pytest.approx(0.0033, rel=0.06)
    assert loud["frequency_hz"] == pytest.approx(8.21, abs=0.01)
    assert quiet["frequency_hz"] == pytest.approx(8.24, abs=0.01)


@pytest.mark.parametrize("band", [[], ["--band", "4:40"], ["--band", "5:32"]])
def test_structure_has_its_three_modes_whatever_the_band(realdata: Path, band: list[str]) -> None:
    modes = fit("frf", realdata / "soton_frf_in1.npz", *band)["modes"]
    wanted = ((6.511, 0.0017), (17.46, 0.0025), (26.50, 0.0023))
    assert len(modes) == 3
    for mode, (hz, zeta) in zip(modes, wanted, strict=True):
        assert mode["frequency_hz"] == pytest.approx(hz, abs=0.01)
        assert mode["damping_ratio"] == pytest.approx(zeta, rel=0.12)


def test_circuit_is_not_given_ten_times_its_damping(realdata: Path, tmp_path: Path) -> None:
    plot = tmp_path / "circuit.svg"
    result = fit("step", realdata / "rlc_20221130_0001.npz", "--plot", plot)
    assert result["modes"][0]["frequency_hz"] == pytest.approx(12840.0, rel=0.005)
    assert result["modes"][0]["damping_ratio"] == pytest.approx(0.062, rel=0.1)
    assert result["steps"] == 30
    assert result["input"] == "data[0,0,:]"
    assert "</svg>" in plot.read_text()


def test_magnetorheological_damper_is_not_linear(realdata: Path) -> None:
    result = fit("damper", realdata / "mr_0V.npz")
    reference = json.loads((realdata / "mr_reference.json").read_text())["mr_0V"]
    assert result["linear_adequate"] is False
    assert result["c_eq_unit"] == "N s/m"
    for found, wanted in zip(result["records"], reference, strict=True):
        assert found["record"] == wanted["rec"]
        assert found["c_eq"] == pytest.approx(1e3 * wanted["c_LS"], rel=0.005)
        assert found["c_energy"] == pytest.approx(1e3 * wanted["c_power"], rel=0.01)
        assert found["linear_nrmse"] == pytest.approx(wanted["NRMSE_lin"], rel=0.05)


def test_fatigue_rig_gives_stiffness_and_loss_but_no_mass(realdata: Path) -> None:
    result = fit("damper", realdata / "faster.npz")
    assert result["k"] == pytest.approx(0.2086, rel=0.003)
    assert result["c_eq"] == pytest.approx(0.0117, rel=0.02)
    assert (result["k_unit"], result["c_eq_unit"]) == ("1/mm", "s/mm")
    assert list(result["not_identifiable"]) == ["m"]


def test_added_mass_table_with_decimal_commas(tmp_path: Path) -> None:
    grams = np.array([12.5, 32.5, 48.0, 63.5, 117.0, 169.0, 277.0])
    hz = np.sqrt(40714.0 / (0.0946 + 1e-3 * grams)) / TAU
    rows = [f"{g:.1f};{f:.2f}".replace(".", ",") for g, f in zip(grams, hz, strict=True)]
    path = tmp_path / "spring.csv"
    path.write_text("# resonances\nadded_mass_g;frequency_hz\n" + "\n".join(rows) + "\n")
    result = fit("added-mass", path, "--tune-to", "50", "--plot", tmp_path / "spring.png")
    assert result["stiffness_n_m"] == pytest.approx(40714.0, abs=4.0 * result["stiffness_std_n_m"])
    assert result["moving_mass_kg"] == pytest.approx(0.0946, abs=4.0 * result["moving_mass_std_kg"])
    assert result["mass_to_add_kg"] == pytest.approx(0.3179, rel=0.01)
    assert (tmp_path / "spring.png").stat().st_size > 10_000


@pytest.mark.parametrize("form", ["complex", "parts", "polar", "decibel"])
def test_transmissibility_in_any_form(tmp_path: Path, form: str) -> None:
    f = np.arange(20.0, 80.0, 0.5)
    r = f / 50.0
    h = (1.0 + 0.02j * r) / (1.0 - r**2 + 0.02j * r)
    path = tmp_path / "absorber.csv"
    if form == "complex":
        path = saved(tmp_path / "absorber.npz", frequency=f, TR=h)
    else:
        columns = {
            "parts": ("re,im", h.real, h.imag), "polar": ("magnitude,phase_deg", np.abs(h), np.degrees(np.angle(h))),
            "decibel": ("magnitude_db", 20.0 * np.log10(np.abs(h))),
        }[form]  # fmt: skip
        rows = np.column_stack([f, *columns[1:]])
        np.savetxt(path, rows, delimiter=",", header=f"frequency_hz,{columns[0]}", comments="", fmt="%.10g")
    mode = fit("transmissibility", path)["modes"][0]
    assert mode["frequency_hz"] == pytest.approx(50.0, abs=1e-3)
    assert mode["damping_ratio"] == pytest.approx(0.01, rel=1e-3)


def test_other_names_units_and_rates(tmp_path: Path) -> None:
    t = np.arange(3000) / 250.0
    signal = 1e3 * np.exp(-0.01 * TAU * 12.0 * t) * np.cos(TAU * 12.0 * t)
    path = saved(tmp_path / "ring.npz", tip=signal + 4.0, other=t**2)
    result = fit("decay", path, "--channel", "tip:um", "--sample-rate", 250)
    assert result["modes"][0]["damping_ratio"] == pytest.approx(0.01, rel=1e-3)
    assert result["bands"][0]["unit"] == "um"


def test_sidecar_of_the_same_name_is_used(tmp_path: Path) -> None:
    t = np.arange(4000) / 200.0
    v = np.sin(TAU * t)
    force = 30.0 * v + np.random.default_rng(0).standard_normal(len(t))
    path = saved(tmp_path / "linear.npz", a=np.column_stack([force, 1e3 * v]))
    side = {"fs_hz": 200.0, "channels": {"col0": "force N", "col1": "velocity mm/s"}}
    (tmp_path / "linear.json").write_text(json.dumps(side))
    result = fit("damper", path)
    assert result["linear_adequate"] is True
    assert result["c_eq"] == pytest.approx(30.0, abs=4.0 * result["c_eq_std"])


def test_input_that_cannot_be_used_is_refused_with_a_remedy(tmp_path: Path) -> None:
    t = np.arange(2000) / 100.0
    good = np.exp(-t) * np.cos(40.0 * t)
    holed = good.copy()
    holed[70] = np.nan
    path = saved(tmp_path / "a.npz", t=t, y=good, holed=holed, flat=np.ones(2000), steady=np.cos(40.0 * t))
    assert "no such file" in refused("decay", tmp_path / "none.npz")
    assert "no such array" in refused("decay", path, "--channel", "z")
    assert "row 70" in refused("decay", path, "--channel", "holed")
    assert "constant" in refused("decay", path, "--channel", "flat")
    assert "no free decay" in refused("decay", path, "--channel", "steady")
    assert "--channel force" in refused("damper", path)
    assert "no frequencies" in refused("frf", path)
    assert "--band" in refused("decay", path, "--channel", "y", "--band", "9:2")
    assert ".png" in refused("decay", path, "--channel", "y", "--plot", "x.pdf")
    bare = saved(tmp_path / "b.npz", y=good)
    assert "--sample-rate" in refused("decay", bare)
    short = saved(tmp_path / "c.npz", t=t[:6], y=good[:6])
    assert "too few" in refused("decay", short, "--channel", "y")
    (tmp_path / "masses.csv").write_text("added_mass_g,frequency_hz\n10,50\n20,49\n")
    assert "at least three" in refused("added-mass", tmp_path / "masses.csv")
