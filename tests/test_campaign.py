"""Campaigns: the batch kernel against the simulated rig, draws, resuming, a cluster that loses a worker."""

import errno
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.stats import norm
from typer.testing import CliRunner

from tuning.campaign.batch import run_cases
from tuning.campaign.figures import passive_motion
from tuning.campaign.kernel import (
    CURRENT_PEAK,
    CURRENT_SQUARES,
    MOTION_WORK,
    SATURATED,
    STORED,
    STROKE_PEAK,
    TILE,
    X_PEAK,
)
from tuning.campaign.sampling import Correlation, drawn_values
from tuning.campaign.scatter import LogNormal, Normal, Uniform, draw_factors
from tuning.campaign.statistics import sensitivities, wilson, worst_first
from tuning.loop import RigModel, margins, mode_grid
from twin.plant.config import DampingTable
from twin.plant.errors import InputError, RunError
from twin.plant.files import parse_toml
from twin.rig.recorded import open_recording
from twin.station.campaign.cases import Campaign, drawn_case, prepare, run_job, shape_of
from twin.station.campaign.replay import CaseRig, case_programme
from twin.station.campaign.run import CampaignOptions, run_campaign
from twin.station.campaign.spec import CampaignSpec
from twin.station.cli import app

CLOSE = 1e-9
CASES = 9 * TILE + 7
SPEC = """
name = "tolerances"
seed = 3
draws = {draws}
sample_rate_hz = 10000.0
delay_us = 130.0
report_hz = "45:55:5"

[[excitation]]
from_hz = 47.0
to_hz = 53.0
duration_s = {seconds}
amplitude_v = 4.0

[schedule]
kind = "thesis"
at_hz = "45:55:1"

[goal]
attenuation = 0.2
settle_s = 0.3

[[scatter]]
parameter = "absorber.stiffness_n_m"
distribution = "normal"
std = 0.01

[[scatter]]
parameter = "absorber.damping_ns_m"
distribution = "log_normal"
sigma = 0.2

[[scatter]]
parameter = "loop.delay_us"
distribution = "uniform"
scale = "absolute"
low = 20.0
high = 250.0
"""


def quiet(_line: str) -> None:
    """Say nothing."""


def campaign_of(text: str, **values: Any) -> Campaign:
    filled = text.format(**({"draws": 6, "seconds": 2.0} | values))
    return prepare(parse_toml(filled, CampaignSpec, "test"), Path(), quiet)


def by_the_rig(campaign: Campaign, number: int) -> tuple[np.ndarray, CaseRig]:
    """The kernel's figures from the simulated rig's own states, block by block."""
    drawn = drawn_case(campaign, number)
    rig = CaseRig(case_programme(campaign, drawn), drawn, keep_truth=True)
    coil, rows, before = drawn.case.coil, [], 0.0
    while not rig.finished:
        rig.next_block()
        for truth in rig.truth:
            names = truth.model.states
            x = {name: truth.states[1:, k] for k, name in enumerate(names)}
            i = x[f"i_{coil.name}"]
            row = np.zeros(8)
            row[X_PEAK] = np.abs(x["x_table"]).max()
            row[STROKE_PEAK] = np.abs(x["x_absorber"] - x["x_table"]).max()
            row[CURRENT_PEAK], row[CURRENT_SQUARES] = np.abs(i).max(), np.sum(i**2)
            row[MOTION_WORK] = np.sum(coil.force_constant_n_a * i * (x["v_absorber"] - x["v_table"]))
            row[STORED] = 0.5 * coil.inductance_h * (i[-1] ** 2 - before**2)
            before = i[-1]
            reference = truth.inputs[1:, 0]
            row[SATURATED] = np.sum(np.abs(reference) >= drawn.case.limit(f"{coil.name}_current_a"))
            rows.append(row)
    return np.array(rows), rig


def by_the_kernel(campaign: Campaign, numbers: list[int]) -> tuple[np.ndarray, np.ndarray]:
    run = run_cases([drawn_case(campaign, n).case for n in numbers], shape_of(campaign.spec, 0))
    return run.figures, run.tripped_at_s


VARIANTS = {
    "as it is": lambda text: text,
    "whole samples of delay": lambda text: re.sub(
        r"low = 20.0\nhigh = 250.0", "low = 200.0\nhigh = 200.0", text
    ),
    "absolute": lambda text: text.replace("seed = 3", 'seed = 3\nmeasurement = "absolute"'),
    "noise": lambda text: text.replace("seed = 3", "seed = 3\nsensor_noise = true"),
    "steps": lambda text: text.replace(
        "from_hz = 47.0\nto_hz = 53.0\nduration_s = {seconds}",
        "steps = [{{frequency_hz = 47.0, duration_s = 0.83}}, {{frequency_hz = 52.0, duration_s = 0.57}}]",
    ),
    "switched on the way": lambda text: text.replace("45:55:1", "48:52:1"),
    "saturated": lambda text: text.replace("amplitude_v = 4.0", "amplitude_v = 60.0"),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_case_in_the_batch_is_the_simulated_rig(variant: str) -> None:
    campaign = campaign_of(VARIANTS[variant](SPEC))
    figures, tripped = by_the_kernel(campaign, list(range(3)))
    for k in range(3):
        wanted, rig = by_the_rig(campaign, k)
        for row in (X_PEAK, STROKE_PEAK, CURRENT_PEAK, CURRENT_SQUARES, MOTION_WORK, STORED, SATURATED):
            scale = max(np.abs(wanted[:, row]).max(), 1e-300)
            np.testing.assert_allclose(figures[:, row, k], wanted[:, row], rtol=CLOSE, atol=CLOSE * scale)
        assert bool(rig.tripped) == (tripped[k] >= 0.0)
    if variant == "saturated":
        assert (tripped >= 0.0).any()
        assert figures[:, SATURATED].any()


def test_damping_against_frequency_is_that_of_each_block() -> None:
    campaign = campaign_of(SPEC)
    table = DampingTable(frequency_hz=(45.0, 50.0, 55.0), ns_m=(14.5, 13.5, 7.3))
    plant = campaign.plants[0].with_damping("absorber", table)
    campaign = Campaign(campaign.spec, (plant,), campaign.schedules)
    figures, _ = by_the_kernel(campaign, [4])
    wanted, _ = by_the_rig(campaign, 4)
    np.testing.assert_allclose(figures[:, X_PEAK, 0], wanted[:, X_PEAK], rtol=CLOSE)
    np.testing.assert_allclose(figures[:, CURRENT_SQUARES, 0], wanted[:, CURRENT_SQUARES], rtol=CLOSE)


THREE_BODIES = """
name = "three"
[[body]]
name = "table"
mass_kg = 2.1
attached_to = "ground"
stiffness_n_m = 12300.0
damping_ns_m = 5.0
[[body]]
name = "absorber"
mass_kg = 0.4125
attached_to = "table"
stiffness_n_m = 40714.0
damping_ns_m = 7.0
[[body]]
name = "cable"
mass_kg = 0.05
attached_to = "table"
stiffness_n_m = 9000.0
damping_ns_m = 1.0
[[actuator]]
name = "vcm"
kind = "voice_coil"
between = ["table", "absorber"]
resistance_ohm = 2.7
inductance_h = 0.0013
force_constant_n_a = 8.0
current_loop_kp_v_a = 100.0
[[actuator]]
name = "push"
kind = "force"
on = "table"
[[sensor]]
name = "table_acceleration"
kind = "acceleration"
of = "table"
noise_density = 1e-3
[[sensor]]
name = "absorber_acceleration"
kind = "acceleration"
of = "absorber"
noise_density = 1e-3
[limits]
vcm_current_a = 2.0
vcm_power_w = 33.0
stroke_m = 0.0095
"""


def test_a_plant_of_more_bodies_is_its_simulated_rig(tmp_path: Path) -> None:
    (tmp_path / "three.toml").write_text(THREE_BODIES, encoding="utf-8")
    text = SPEC.replace("seed = 3", f'seed = 3\nplants = ["{tmp_path / "three.toml"}"]')
    campaign = campaign_of(text.replace("amplitude_v = 4.0", "amplitude_n = 8.0"))
    figures, _ = by_the_kernel(campaign, [1])
    wanted, _ = by_the_rig(campaign, 1)
    for row in (X_PEAK, STROKE_PEAK, CURRENT_SQUARES, MOTION_WORK):
        scale = np.abs(wanted[:, row]).max()
        np.testing.assert_allclose(figures[:, row, 0], wanted[:, row], rtol=CLOSE, atol=CLOSE * scale)


def test_a_case_is_the_same_to_the_bit_in_any_company() -> None:
    campaign = campaign_of(SPEC, draws=TILE + 5, seconds=0.3)
    everyone, _ = by_the_kernel(campaign, list(range(TILE + 5)))
    some = [TILE + 3, 0, 17]
    few, _ = by_the_kernel(campaign, some)
    np.testing.assert_array_equal(everyone[:, :, some], few)


def test_a_row_states_the_poles_margins_and_powers_of_its_case() -> None:
    campaign = campaign_of(SPEC)
    rows = run_job(campaign, campaign.jobs[0])
    for row in rows[:3]:
        drawn = drawn_case(campaign, row["case"])
        case = drawn.case
        model = RigModel(case.plant, case.facts, 50.0)
        gains = {f: case.schedule.at(f) for f in (45.0, 50.0, 55.0)}
        growth = {f: model.decay_rate_1_s(g) for f, g in gains.items()}
        assert row["growth_1_s"] == pytest.approx(max(growth.values()), rel=1e-6)
        assert growth[row["growth_hz"]] == max(growth.values())
        assert row["stable"] == (row["growth_1_s"] < 0.0)
        if row["stable"]:
            grid = mode_grid(model, 36)
            found = [
                margins(model.loop_terms(grid, g.low_pass_hz, g.high_pass_hz), grid, g)
                for g in gains.values()
            ]
            assert row["modulus_margin"] == pytest.approx(min(m.modulus for m in found))
            assert row["delay_margin_s"] == pytest.approx(
                min(m.delay_s for m in found if m.delay_s is not None)
            )
        wanted, _ = by_the_rig(campaign, row["case"])
        window = wanted[-10:].sum(axis=0) / 10_000
        heat = case.coil.resistance_ohm * window[CURRENT_SQUARES]
        assert row["joule_mean_w"] >= heat * (1.0 - CLOSE)
        assert row["joule_peak_w"] == pytest.approx(
            case.coil.resistance_ohm * wanted[:, CURRENT_PEAK].max() ** 2
        )
        assert row["drawn loop.delay_us"] == pytest.approx(1e6 * case.facts.delay_s)


def test_the_passive_rig_settles_to_what_it_is_compared_with() -> None:
    text = SPEC.replace("45:55:1", "60:61:1").replace("to_hz = 53.0", "to_hz = 47.0")
    campaign = campaign_of(text, seconds=6.0)
    case = drawn_case(campaign, 1).case
    figures, _ = by_the_kernel(campaign, [1])
    assert passive_motion(case, np.array([47.0]))[0] == pytest.approx(figures[-1, X_PEAK, 0], rel=2e-3)


def test_every_case_gets_gains_of_its_own_where_it_is_retuned() -> None:
    text = (
        SPEC.replace("seed = 3", "seed = 3\nbudgets_w = [4.0]")
        .replace("47.0", "49.5")
        .replace("53.0", "50.5")
    )
    text = text.replace(
        'kind = "thesis"\nat_hz = "45:55:1"', 'kind = "retuned"\nat_hz = "49,50,51"\nper_case = {own}'
    )
    text = text.replace('"45:55:5"', '"49:51:1"').replace("attenuation = 0.2\n", "")
    rows = {
        own: run_job(campaign, campaign.jobs[0])
        for own in ("true", "false")
        for campaign in [campaign_of(text, own=own, draws=3, seconds=3.0)]
    }
    campaign = campaign_of(text, own="true", draws=3, seconds=3.0)
    assert campaign.schedules == (None,)
    schedules = [drawn_case(campaign, k).case.schedule for k in range(3)]
    assert len({s.gamma_n_m for s in schedules}) == 3
    for own, common in zip(rows["true"], rows["false"], strict=True):
        assert own["refused_points"] == 0
        assert own["stable"]
        assert own["modulus_margin"] >= 0.15 * (1.0 - 1e-3)
        assert own["drawn absorber.stiffness_n_m"] == common["drawn absorber.stiffness_n_m"]
    assert sum(r["attenuation_mean"] for r in rows["true"]) > sum(
        r["attenuation_mean"] for r in rows["false"]
    )


def test_each_parameter_has_a_stream_of_its_own() -> None:
    mass = Normal(parameter="a.mass_kg", distribution="normal", std=0.1)
    delay = Uniform(parameter="loop.delay_us", distribution="uniform", low=1.0, high=2.0)
    alone, both = draw_factors((mass,), 7, 12), draw_factors((delay, mass), 7, 12)
    assert alone["a.mass_kg"] == both["a.mass_kg"]
    assert alone != draw_factors((mass,), 7, 13)
    assert alone != draw_factors((mass,), 8, 12)


def test_draws_follow_their_distributions() -> None:
    spread = (
        Normal(parameter="a.n", distribution="normal", mean=2.0, std=0.3),
        LogNormal(parameter="a.l", distribution="log_normal", median=3.0, sigma=0.5),
        Uniform(parameter="a.u", distribution="uniform", low=1.0, high=4.0),
    )
    drawn = [draw_factors(spread, 1, k) for k in range(3000)]
    n, logarithm = np.array([d["a.n"] for d in drawn]), np.log([d["a.l"] for d in drawn])
    u = np.array([d["a.u"] for d in drawn])
    root = np.sqrt(3000)
    assert abs(n.mean() - 2.0) < 4 * 0.3 / root
    assert n.std() == pytest.approx(0.3, rel=0.06)
    assert abs(logarithm.mean() - np.log(3.0)) < 4 * 0.5 / root
    assert logarithm.std() == pytest.approx(0.5, rel=0.06)
    assert abs(u.mean() - 2.5) < 4 * 3.0 / np.sqrt(12) / root
    assert u.min() >= 1.0
    assert u.max() <= 4.0


SPREAD = (
    Normal(parameter="a.mass_kg", distribution="normal", mean=2.0, std=0.3),
    LogNormal(parameter="b.mass_kg", distribution="log_normal", median=3.0, sigma=0.5),
    Uniform(parameter="c.mass_kg", distribution="uniform", low=1.0, high=4.0),
)


def table_of(kind: Any, draws: int, correlations: tuple[Correlation, ...] = ()) -> np.ndarray:
    """Draws of `SPREAD`, (draws, 3)."""
    return np.array(
        [list(drawn_values(SPREAD, correlations, kind, 4, draws, k).values()) for k in range(draws)]
    )


@pytest.mark.parametrize("kind", ["latin_hypercube", "sobol"])
def test_even_sampling_puts_one_draw_into_every_stratum(kind: str) -> None:
    drawn, n = table_of(kind, 128), 128
    shares = np.column_stack([
        norm.cdf(drawn[:, 0], 2.0, 0.3), norm.cdf(np.log(drawn[:, 1] / 3.0) / 0.5), (drawn[:, 2] - 1.0) / 3.0
    ])  # fmt: skip
    for column in shares.T:
        assert sorted(np.floor(column * n).astype(int)) == list(range(n))
    assert abs(drawn[:, 0].mean() - 2.0) < 0.1 * 0.3 / np.sqrt(n)  # far below a random sample's error


@pytest.mark.parametrize("kind", ["random", "latin_hypercube", "sobol"])
def test_parameters_vary_together_as_they_were_told(kind: str) -> None:
    tied = (Correlation(between=("a.mass_kg", "b.mass_kg"), coefficient=-0.8),)
    drawn = table_of(kind, 1000, tied)
    assert np.corrcoef(drawn[:, 0], np.log(drawn[:, 1]))[0, 1] == pytest.approx(-0.8, abs=0.06)
    assert abs(np.corrcoef(drawn[:, 0], drawn[:, 2])[0, 1]) < 0.12
    assert drawn[:, 0].std() == pytest.approx(0.3, rel=0.08)
    if kind == "random":
        np.testing.assert_array_equal(drawn[:, 2], table_of(kind, 1000)[:, 2])


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (("std = 0.01", "std = 0.8"), "absorber.stiffness_n_m: std 0.8 .* below 0"),
        (("seed = 3", 'seed = 3\nsampling = "grid"'), "sampling"),
        (
            ("[goal]", '[[correlation]]\nbetween = ["a.b", "loop.delay_us"]\ncoefficient = 0.5\n[goal]'),
            "'a.b' is not",
        ),
        (("seed = 3", "seed = 3\nsede = 4"), "sede: unknown key"),
        (("delay_us = 130.0", 'delay_us = "much"'), r"delay_us \[µs\]: must be a number of µs"),
        (("std = 0.01", "std = 0.01\nspread = 2"), r"scatter\[0\].*spread: unknown key"),
        (("absorber.stiffness_n_m", "absorber.colour"), "known: table.mass_kg"),
        (("amplitude_v = 4.0", "amplitude_n = 4.0"), "driven in V"),
        (('distribution = "normal"', ""), r"scatter\[0\]: distribution is missing"),
        (('kind = "thesis"\nat_hz = "45:55:1"', 'kind = "from_file"'), "schedule file: missing"),
        (('kind = "thesis"', 'kind = "retuned"'), r"budgets_w \[W\]: missing"),
        (('at_hz = "45:55:1"', 'at_hz = "45-55"'), "schedule.at_hz 45-55"),
        (("sample_rate_hz = 10000.0", "sample_rate_hz = 2000.0"), "half of sample_rate_hz"),
        (("seed = 3", 'seed = 3\nplants = ["rig_no_vcm"]'), "no voice coil between two bodies"),
    ],
)
def test_a_specification_that_cannot_be_used_says_why(change: tuple[str, str], wanted: str) -> None:
    with pytest.raises(InputError, match=wanted):
        campaign_of(SPEC.replace(*change))


def test_an_interval_for_a_share_is_wilsons() -> None:
    # Wilson 1927, worked: 81 of 263 gives 0.2553 to 0.3662 (Newcombe 1998, Table I).
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(0, 20)[0] == 0.0


def test_sensitivities_find_what_a_result_is_made_of() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.standard_normal((2, 400))
    rest = {"attenuation_worst": None, "displacement_m": None, "joule_mean_w": 1.0, "growth_1_s": None}
    rows = [
        {"attenuation_mean": 3.0 * x - y, "modulus_margin": 0.1, "drawn a": x, "drawn b": y, **rest}
        for x, y in zip(a, b, strict=True)
    ]
    found = sensitivities(rows)
    assert set(found) == {"attenuation_mean"}
    ratio = found["attenuation_mean"]["a"]["regression"] / found["attenuation_mean"]["b"]["regression"]
    assert ratio == pytest.approx(-3.0, rel=0.15)
    assert found["attenuation_mean"][""]["explained"] > 0.95


def test_the_worst_case_is_the_one_that_grows_fastest() -> None:
    def row(case: int, growth: float, least: float) -> dict[str, Any]:
        return {
            "case": case, "stable": growth < 0, "meets": least > 0.5, "growth_1_s": growth, "attenuation_worst": least,
        }  # fmt: skip

    ordered = worst_first([row(0, -1, 0.9), row(1, 2, 0.8), row(2, -1, 0.1), row(3, 5, 0.9)])
    assert [r["case"] for r in ordered] == [3, 1, 2, 0]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A specification of several jobs, run on threads, and its result."""
    folder = tmp_path_factory.mktemp("campaign")
    path = folder / "spec.toml"
    path.write_text(SPEC.format(draws=CASES, seconds=1.5), encoding="utf-8")
    return path, run_campaign(CampaignOptions(path, threads=2), quiet, lambda _d, _n: None)


def test_a_run_leaves_its_rows_its_plots_and_its_page(finished: tuple[Path, dict[str, Any]]) -> None:
    path, result = finished
    table = pq.read_table(result["results"])
    assert table.column("case").to_pylist() == list(range(CASES))
    assert result["cases"] == result["computed"] == CASES
    assert result["meeting"] == sum(table.column("meets").to_pylist())
    assert sum(result["first_limits"].values()) == result["cases"]
    json.dumps(result, allow_nan=False)
    assert all(Path(p).read_bytes().startswith(b"\x89PNG") for p in result["plots"])
    assert "Worst cases" in (path.with_suffix(".campaign") / "report.html").read_text(encoding="utf-8")


def test_a_run_goes_on_where_it_was_left(finished: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    path, result = finished
    before = Path(result["results"]).read_bytes()
    parts = path.with_suffix(".campaign") / "parts"
    (parts / "part-000001.parquet").unlink()
    (parts / "part-000002.parquet").write_bytes(b"PAR1 cut short")
    lines: list[str] = []
    again = run_campaign(CampaignOptions(path, threads=1, plots=False), lines.append, lambda _d, _n: None)
    assert again["computed"] == 2 * TILE
    assert "are there already" in lines[0]
    assert Path(again["results"]).read_bytes() == before
    other = tmp_path / "spec.toml"
    other.write_text(path.read_text(encoding="utf-8").replace("seed = 3", "seed = 4"), encoding="utf-8")
    with pytest.raises(InputError, match="another campaign"):
        run_campaign(CampaignOptions(other, out=path.with_suffix(".campaign")), quiet, lambda _d, _n: None)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_a_run_that_is_stopped_or_killed_is_finished_by_the_next(
    how: signal.Signals, finished: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    path, result = finished
    out = tmp_path / "results"
    run = subprocess.Popen(
        [
            sys.executable, "-c", "from twin.station.cli import main; main()", "campaign", str(path), "--threads", "1",
            "--out", str(out),
        ],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        wait_for(lambda: any((out / "parts").glob("part-*")))
        run.send_signal(how)
        _, complaint = run.communicate(timeout=60)
    finally:
        run.kill()
    assert run.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert "Traceback" not in complaint
    kept = sum(pq.read_table(p).num_rows for p in (out / "parts").glob("part-*"))
    assert 0 < kept < CASES
    again = run_campaign(CampaignOptions(path, out=out, threads=2, plots=False), quiet, lambda _d, _n: None)
    assert again["computed"] == CASES - kept
    assert Path(again["results"]).read_bytes() == Path(result["results"]).read_bytes()
    assert not list((out / "parts").glob(".*"))


def test_a_full_disk_is_said_and_loses_nothing(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, result = finished
    options = CampaignOptions(path, out=tmp_path / "full", threads=2, plots=False)
    write, written = pq.write_table, []

    def until_full(table: Any, to: Any) -> None:
        if len(written) == 3:
            Path(to).write_bytes(b"PAR1")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written.append(to)
        write(table, to)

    monkeypatch.setattr(pq, "write_table", until_full)
    with pytest.raises(RunError, match=r"part-\d+.parquet: cannot be written \(No space left on device\)"):
        run_campaign(options, quiet, lambda _d, _n: None)
    monkeypatch.setattr(pq, "write_table", write)
    again = run_campaign(options, quiet, lambda _d, _n: None)
    assert again["computed"] == CASES - 3 * TILE
    assert Path(again["results"]).read_bytes() == Path(result["results"]).read_bytes()


def test_a_case_runs_again_alone_and_can_be_recorded(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    path, result = finished
    worst = result["worst"][0]["case"]
    out = tmp_path / "case.rrd"
    answer = CliRunner().invoke(
        app, ["campaign", str(path), "--replay", str(worst), "--recording", str(out), "--json", "-"]
    )
    assert answer.exit_code == 0, answer.output
    found = json.loads(answer.stdout)
    row = pq.read_table(result["results"]).slice(worst, 1).to_pylist()[0]
    assert found["row"] == row
    recording = open_recording(out)
    assert recording.end_sample == 15_000
    current = np.concatenate(
        [b.values[:, [c.name for c in b.channels].index("vcm_current")] for b in recording.blocks()]
    )
    assert np.abs(current).max() == pytest.approx(row["current_peak_a"], rel=1e-6)


def test_an_archive_is_replayed_recording_by_recording(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    path, _ = finished
    for k in (0, 1):
        CliRunner().invoke(
            app, ["campaign", str(path), "--replay", str(k), "--recording", str(tmp_path / f"{k}.rrd")]
        )
    (tmp_path / "broken.rrd").write_bytes(b"no recording")
    spec = tmp_path / "archive.toml"
    spec.write_text('name = "archive"\n[archive]\nrecordings = "*.rrd"\n', encoding="utf-8")
    result = run_campaign(CampaignOptions(spec, threads=2), quiet, lambda _d, _n: None)
    assert result["recordings"] == 3
    assert result["failed"] == 1
    good = [row for row in result["rows"] if not row["trouble"]]
    assert all(row["blocks"] == 15 and row["decisions_repeated"] for row in good)
    other = tmp_path / "other.toml"
    other.write_text(
        'name = "other"\n[archive]\nrecordings = "0.rrd"\nbudgets_w = [0.5, 4.0]\nmodulus_margins = [0.1, 0.3]\n',
        encoding="utf-8",
    )
    rows = run_campaign(CampaignOptions(other, threads=2), quiet, lambda _d, _n: None)["rows"]
    assert [(r["budget_w"], r["modulus_margin"]) for r in rows] == [
        (0.5, 0.1),
        (0.5, 0.3),
        (4.0, 0.1),
        (4.0, 0.3),
    ]
    assert all(r["trouble"] == "" and r["attenuation_mean"] == good[0]["attenuation_mean"] for r in rows)


def wait_for(happened: Any, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not happened():
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.02)


@pytest.fixture
def cluster() -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and three workers, as a person starts them."""
    pytest.importorskip("distributed")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    environment = os.environ | {"PYTHONWARNINGS": "ignore", "DASK_DISTRIBUTED__WORKER__DAEMON": "False"}
    common: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    dask = [sys.executable, "-m", "dask"]
    port = address.rsplit(":", 1)[1]
    started = [
        subprocess.Popen(
            [*dask, "scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard"], **common
        )
    ]
    worker = [
        *dask,
        "worker",
        address,
        "--nthreads",
        "1",
        "--no-nanny",
        "--no-dashboard",
        "--host",
        "127.0.0.1",
    ]
    try:
        started += [subprocess.Popen(worker, **common) for _ in range(3)]
        yield address, started[1:]
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning", "ignore::UserWarning")
def test_a_cluster_that_loses_a_worker_loses_no_case(
    finished: tuple[Path, dict[str, Any]], cluster: tuple[str, list[subprocess.Popen[bytes]]], tmp_path: Path
) -> None:
    from distributed import Client

    path, result = finished
    address, workers = cluster
    with Client(address, timeout=60, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=60)
        busiest: list[int] = []
        pids = client.run(os.getpid)

        def on_progress(done: int, total: int) -> None:
            # While others still work: the first rows are in, and one of the workers is lost.
            running = [a for a, keys in client.processing().items() if keys] if 0 < done < total else []
            if running and not busiest:
                busiest.append(pids[running[0]])
                os.kill(busiest[0], signal.SIGKILL)

        options = CampaignOptions(path, out=tmp_path / "cluster", scheduler=address, plots=False)
        there = run_campaign(options, quiet, on_progress)
        assert len(client.scheduler_info(n_workers=-1)["workers"]) == 2
    assert any(w.pid == busiest[0] and w.wait(10) == -signal.SIGKILL for w in workers)
    assert there["computed"] == result["cases"]
    assert Path(there["results"]).read_bytes() == Path(result["results"]).read_bytes()


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_a_cluster_that_is_not_there_or_cannot_be_used_says_so(
    finished: tuple[Path, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = finished
    options = CampaignOptions(path, out=tmp_path / "nowhere", scheduler="tcp://127.0.0.1:1")
    monkeypatch.setattr("twin.station.campaign.cluster.CONNECT_S", 0.3)
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_campaign(options, quiet, lambda _d, _n: None)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"atmd-twin\[cluster\]"):
        run_campaign(options, quiet, lambda _d, _n: None)
