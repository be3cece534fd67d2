"""The thesis recomputed: every figure is there, judged as it should be, and the page shows it all."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from estimators.fits.added_mass import fit_absorber
from twin.plant.errors import InputError
from twin.station.cli import app
from twin.station.validate import run_validation
from twin.station.validation.catalogue import FIGURES
from twin.station.validation.report import DRAWINGS, NOT_DRAWN
from twin.station.validation.rows import EXACT, Figure, Tolerance, digits, judge

KEYS = {"id", "source", "unit", "thesis", "computed", "relative_error", "verdict", "note"}
VERDICTS = {"reproduced", "differs", "not reproducible"}

REPRODUCED = [
    "engine.mode1_hz", "engine.mode2_hz", "rig_no_vcm.mode1_hz", "rig_no_vcm.mode2_hz", "analogue.mode1_hz",
    "engine.stroke_50hz_m", "engine_vcm.joule_peak_47hz_w", "engine_vcm.joule_peak_47hz_3kn_w",
    "engine_vcm.current_47hz_a", "filter.low_pass_phase_45hz_deg", "filter.low_pass_phase_55hz_deg",
    "filter.high_pass_phase_45hz_deg", "test1.saturates_hz", "test2.stable", "test3.stable", "test4.stable",
    "denhartog.frequency_ratio", "denhartog.damping_ratio", "engine.alpha_45hz_kg", "absorber.tuned_mass_kg",
    "engine.absolute_keeps_the_zero",
]  # fmt: skip
DIFFERS = [
    "analogue.mode2_hz", "rig.mode1_hz", "rig.mode2_hz", "engine.stiffness_table_6_1_n_m",
    "engine.lq_delay_margin_s", "filter.high_pass_delay_45hz_s", "filter.pairing_nulls_position",
    "test1.first_unstable_hz", "test2.mean_attenuation", "test3.beta_45hz_ns_m", "test3.mean_attenuation",
    "engine.alpha_bound_kg", "engine.absolute_bounds_suffice", "test2.quiet_beta_45hz_ns_m",
    "rig.shorted_damping_ns_m", "engine_vcm_large.joule_peak_47hz_3kn_w",
]  # fmt: skip
NOT_REPRODUCIBLE = [
    "engine.passive_47hz_m", "engine.passive_53hz_m", "engine.delay_margin_51hz_s",
    "engine.delay_margin_53hz_s", "engine.delay_margin_55hz_s", "rig.delay_margin_53hz_s",
    "absorber.stiffness_n_m", "absorber.mass_kg", "engine.absorber_damping_ns_m",
    "engine.measured_acceleration",
]  # fmt: skip

# Model-level figures worked out independently; relative tolerance by the digits that they are quoted with.
INDEPENDENT = {
    "engine.mode1_hz": (2.054, 5e-4), "engine.mode2_hz": (55.103, 1e-4),
    "rig_no_vcm.mode1_hz": (11.80, 5e-4), "rig_no_vcm.mode2_hz": (55.74, 1e-4),
    "rig.mode1_hz": (11.09, 5e-4), "rig.mode2_hz": (54.92, 1e-4),
    "analogue.mode1_hz": (0.953, 6e-4), "analogue.mode2_hz": (52.44, 1e-4),
    "engine.stroke_50hz_m": (1.1433e-3, 1e-4),
    "engine.passive_45hz_m": (142.27e-6, 1e-4), "engine.passive_47hz_m": (97.65e-6, 1e-4),
    "engine.passive_50hz_m": (1.109e-6, 5e-4), "engine.passive_53hz_m": (296.5e-6, 2e-4),
    "engine.passive_55hz_m": (6859.5e-6, 1e-4),
    "engine_vcm.case_47hz_m": (2.785e-6, 2e-4), "engine_vcm.current_47hz_a": (5.780, 1e-4),
    "engine_vcm.joule_peak_47hz_w": (100.23, 1e-4), "engine_vcm.electrical_mean_47hz_w": (50.06, 1e-4),
    "engine_vcm.joule_peak_47hz_3kn_w": (902.1, 1e-4), "engine_vcm.joule_peak_47hz_printed_sign_w": (100.28, 1e-4),
    "engine.delay_margin_51hz_s": (0.177e-3, 3e-3), "engine.delay_margin_53hz_s": (0.0577e-3, 1e-3),
    "engine.delay_margin_55hz_s": (0.0340e-3, 2e-3), "rig.delay_margin_53hz_s": (0.0290e-3, 3e-3),
    "filter.low_pass_phase_45hz_deg": (-18.53, 1e-4), "filter.low_pass_phase_55hz_deg": (-22.82, 2e-4),
    "filter.low_pass_delay_45hz_s": (1.144e-3, 4e-4), "filter.high_pass_phase_45hz_deg": (1.801, 1e-4),
    "filter.high_pass_delay_45hz_s": (-0.1112e-3, 5e-4),
    "test1.first_unstable_hz": (52.0, 0.0), "test3.mean_attenuation": (0.94, 1e-3),
    "test2.quiet_beta_45hz_ns_m": (23.1, 2e-3), "test2.quiet_beta_47.5hz_ns_m": (19.6, 2e-3),
    "test2.quiet_beta_50hz_ns_m": (15.8, 2e-3), "test2.quiet_beta_52.5hz_ns_m": (11.6, 2e-3),
    "test2.quiet_beta_55hz_ns_m": (7.1, 4e-3),
    "denhartog.frequency_ratio": (1.0 / 1.05, 1e-9), "denhartog.damping_ratio": (0.12727, 1e-4),
    "engine.alpha_bound_kg": (-7.299, 1e-4),
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("validation") / "report"


@pytest.fixture(scope="module")
def result(folder: Path) -> dict[str, Any]:
    return run_validation(folder)


@pytest.fixture(scope="module")
def rows(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["id"]: row for row in result["rows"]}


def test_every_figure_has_one_row_with_all_its_fields(result, rows):
    assert len(rows) == len(result["rows"]) == len(FIGURES)
    for row in result["rows"]:
        assert set(row) == KEYS
        assert row["verdict"] in VERDICTS
        assert row["source"]
        assert row["unit"]
    json.dumps(result, allow_nan=False)


def test_counts_are_those_of_the_rows(result):
    found = result["counts"]
    for verdict in VERDICTS:
        assert found[verdict] == sum(row["verdict"] == verdict for row in result["rows"])
    assert found["rows"] == len(result["rows"])


@pytest.mark.parametrize(
    ("names", "verdict"),
    [(REPRODUCED, "reproduced"), (DIFFERS, "differs"), (NOT_REPRODUCIBLE, "not reproducible")],
)
def test_verdicts_are_as_expected(rows, names, verdict):
    assert {name: rows[name]["verdict"] for name in names} == dict.fromkeys(names, verdict)


@pytest.mark.parametrize("name", INDEPENDENT)
def test_figure_agrees_with_the_one_worked_out_independently(rows, name):
    value, tolerance = INDEPENDENT[name]
    assert rows[name]["computed"] == pytest.approx(value, rel=max(tolerance, 1e-9))


def test_what_differs_or_cannot_be_reproduced_says_why(rows):
    for row in rows.values():
        if row["verdict"] != "reproduced":
            text = re.sub(r"^Tolerance [^.]*(\.\d[^.]*)*\.\s*", "", row["note"])
            assert len(text) > 5, row


def test_numbers_that_are_compared_state_their_tolerance(rows):
    for row in rows.values():
        if row["verdict"] != "not reproducible" and not isinstance(row["thesis"], bool):
            assert row["note"].startswith("Tolerance"), row["id"]


def test_error_is_that_of_the_two_values(rows):
    for row in rows.values():
        if row["relative_error"] is not None and not isinstance(row["thesis"], bool):
            expected = abs(row["computed"] - row["thesis"]) / abs(row["thesis"])
            assert row["relative_error"] == pytest.approx(expected)


# --- judging ----------------------------------------------------------------------------------------------


def figure(thesis: Any, computed: Any, tolerance: Tolerance | None = EXACT, **more: Any) -> Figure:
    return Figure(
        "a.b", "1.1", "m", thesis, None if computed is None else lambda: computed, tolerance, **more
    )


def test_a_figure_within_its_tolerance_is_reproduced_and_one_outside_differs():
    assert judge(figure(2.0, 2.04, digits(2.0, 0.1))).verdict == "reproduced"
    assert judge(figure(2.0, 2.06, digits(2.0, 0.1))).verdict == "differs"
    assert judge(figure(-2.0, 2.0, digits(2.0, 0.1))).verdict == "differs"


def test_a_statement_is_true_or_not():
    assert judge(figure(True, True, None)).verdict == "reproduced"
    found = judge(figure(True, False, None))
    assert (found.verdict, found.relative_error) == ("differs", 1.0)


def test_what_lacks_a_side_or_does_not_follow_is_not_reproducible():
    assert judge(figure(None, 1.0)).verdict == "not reproducible"
    assert judge(figure(1.0, None)).computed is None
    assert judge(figure(1.0, 1.0, comparable=False)).verdict == "not reproducible"


# --- fit of eq. 7-1 -----------------------------------------------------------------------------------------


def test_fit_finds_the_spring_behind_exact_resonances_and_its_minimum_is_one():
    added = np.array([0.0125, 0.0325, 0.048, 0.0635, 0.117, 0.169, 0.277])
    hz = np.sqrt(40714.0 / (0.0946 + added)) / (2.0 * np.pi)
    fit = fit_absorber(added, hz)
    assert fit == pytest.approx((40714.0, 0.0946), rel=1e-9)
    noisy = hz + np.array([0.2, -0.3, 0.1, 0.0, -0.2, 0.3, -0.1])
    w2 = (2.0 * np.pi * noisy) ** 2

    def z(k: float, m: float) -> float:
        total = 0.0
        for i in range(len(added)):
            for j in range(i + 1, len(added)):
                total += (w2[i] * (m + added[i]) - w2[j] * (m + added[j])) ** 2
                total += ((k / w2[i] - added[i]) - (k / w2[j] - added[j])) ** 2
        return total

    k, m = fit_absorber(added, noisy)
    for factor in (0.999, 1.001):
        assert z(k, m) < z(k, factor * m)
    # the stiffness's square is small beside the mass's: compared on its own scale
    assert z(k, m) <= min(z(0.99 * k, m), z(1.01 * k, m)) + 1e-12 * z(k, m)


@pytest.mark.parametrize(
    ("added", "hz", "message"),
    [
        ([0.1], [50.0, 60.0], "one resonance per"),
        ([0.1, 0.2], [50.0, 50.0], "different resonances"),
        ([0.1, 0.2], [50.0, 0.0], "above 0 Hz"),
        ([0.1, math.nan], [50.0, 60.0], "finite"),
    ],
)
def test_fit_refuses_what_it_cannot_use(added, hz, message):
    with pytest.raises(ValueError, match=message):
        fit_absorber(added, hz)


# --- report -------------------------------------------------------------------------------------------------


def test_page_holds_every_row_and_every_drawing_and_nothing_from_elsewhere(result, folder):
    page = (folder / "index.html").read_text(encoding="utf-8")
    for row in result["rows"]:
        assert f'<tr id="{row["id"]}">' in page
    for drawing in DRAWINGS:
        assert f'src="{drawing.name}.png"' in page
        picture = (folder / f"{drawing.name}.png").read_bytes()
        assert picture.startswith(b"\x89PNG")
        assert len(picture) > 10_000
    assert not re.search(r"https?://|<script|@import", page)
    for which, _why in NOT_DRAWN:
        assert which in page


def test_drawings_refer_to_rows_that_exist(rows):
    assert len({drawing.name for drawing in DRAWINGS}) == len(DRAWINGS) >= 25
    for drawing in DRAWINGS:
        assert set(drawing.rows) <= set(rows)
        assert drawing.caption
        assert drawing.source


def test_report_into_a_file_is_refused_before_anything_is_computed(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(InputError, match="is a file"):
        run_validation(file)


def test_command_prints_a_table_and_writes_json(result, tmp_path):
    target = tmp_path / "figures.json"
    done = CliRunner().invoke(app, ["validate", "--json", str(target)])
    assert done.exit_code == 0
    written = json.loads(target.read_text(encoding="utf-8"))
    assert written["counts"] == result["counts"]
    assert set(written) == {"rows", "counts"}
