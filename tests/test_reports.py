"""Reports and comparisons: closed forms, independent oracles, recorded cases, and pages that stand alone."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from tuning.loop import LoopFacts, RigModel
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.station.cli import app
from twin.station.opened import ReplayOptions
from twin.station.replay import run_replay
from twin.station.report import compare_page, compare_plots, filed
from twin.station.report.aligned import common_grid, quantities, to_cells
from twin.station.report.compared import as_data, compare
from twin.station.report.document import document
from twin.station.report.figures import as_html, save_plots, thinned
from twin.station.report.limits import judge
from twin.station.report.page import Html, element, table, text
from twin.station.report.passive import Hindsight, in_hindsight
from twin.station.report.plots import plots_of
from twin.station.report.replayed import Replayed, replayed
from twin.station.report.tracks import COLUMNS, Tracks
from twin.station.report.words import quantity, share

LIBRARY = Path(__file__).parents[1] / "recordings"
FLAGS = ["--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update"]


def quiet(*_: object) -> None:
    pass


@pytest.fixture(scope="module")
def case() -> Callable[[str], Replayed]:
    """A recorded case, replayed once for all tests."""
    known: dict[str, Replayed] = {}

    def of(name: str) -> Replayed:
        if name not in known:
            known[name] = replayed(LIBRARY / name / "recording.rrd", ReplayOptions(), quiet, quiet, name)
        return known[name]

    return of


def invoke(*arguments: object) -> Any:
    return CliRunner().invoke(app, list(map(str, arguments)))


def made(run: Replayed, n: int, block_s: float, name: str, **columns: Any) -> Replayed:
    """A run of which every column is known: NaN unless given, control on and settled throughout."""
    table: dict[str, Any] = {key: np.full(n, np.nan) for key in COLUMNS}
    table |= {
        "time_s": block_s * np.arange(1, n + 1),
        "duration_s": np.full(n, block_s),
        "control_on": np.ones(n),
        "settled": np.ones(n),
        "masked": np.zeros(n),
    }
    table |= {key: np.broadcast_to(np.asarray(v, float), n).copy() for key, v in columns.items()}
    peaks = np.full((n, len(run.tracks.channels)), np.nan)
    tracks = Tracks(
        table, ("consistent",) * n, ("",) * n, run.tracks.channels, peaks, (), np.zeros((n, 0)), "shaker_voltage", False
    )  # fmt: skip
    nothing = np.full(n, np.nan)
    return replace(run, name=name, tracks=tracks, hindsight=Hindsight(nothing, nothing, nothing, nothing))


# --- alignment and differences: closed forms ----------------------------------------------------------------


def two_sweeps(run: Replayed) -> tuple[Replayed, Replayed]:
    """Up in 10 s in blocks of 100 ms, down in 4 s in blocks of 50 ms; linear in frequency, 5 µm and 0.2 W/Hz apart."""
    up = 45.0 + 10.0 * (np.arange(100) + 0.5) / 100
    down = 54.0 - 7.0 * (np.arange(80) + 0.5) / 80
    a = made(run, 100, 0.1, "a", frequency_hz=up, displacement_m=1e-6 * up, displacement_std_m=3e-7,
             joule_mean_w=0.5 * up - 20.0, nis=1.0)  # fmt: skip
    b = made(run, 80, 0.05, "b", frequency_hz=down, displacement_m=1e-6 * down + 5e-6, displacement_std_m=4e-7,
             joule_mean_w=0.7 * down - 20.0, nis=1.25)  # fmt: skip
    return a, b


def test_sweeps_of_other_rates_directions_and_lengths_differ_by_what_they_differ(
    case: Callable[[str], Replayed],
) -> None:
    c = compare(list(two_sweeps(case("whatif_budget_change"))), "frequency")
    assert c.grid[0] == 47.0
    assert c.grid[-1] == 54.0
    inside = slice(1, -1)  # the outermost cells have blocks on one side of their centre alone
    lines = {line.quantity.key: line for line in c.lines}
    motion, power, nis = (lines[k].differences[1] for k in ("displacement_m", "joule_mean_w", "nis"))
    np.testing.assert_allclose(motion.value[inside], 5e-6, rtol=1e-9)
    np.testing.assert_allclose(motion.std[inside], 5e-7, rtol=1e-6)  # 3 and 4 in quadrature, no scatter
    np.testing.assert_allclose(power.value[inside], 0.2 * c.grid[inside], rtol=1e-9)
    np.testing.assert_allclose(nis.value, 0.25, rtol=1e-12)
    found = motion.summary(c.grid)
    assert found is not None
    assert found["mean"] == pytest.approx(5e-6, rel=0.02)
    assert found["significant"] == found["judged"] == len(c.grid)
    assert all(abs(v) < 1e-18 for v in lines["displacement_m"].differences[0].value)
    assert as_data(c)["quantities"]["displacement_m"]["differences"][1]["relative"] == pytest.approx(
        5.0 / 50.5, rel=0.02
    )


def test_by_time_blocks_of_other_lengths_meet_at_the_same_instants(case: Callable[[str], Replayed]) -> None:
    run = case("whatif_budget_change")
    t_a, t_b = 0.1 * (np.arange(40) + 0.5), 0.025 * (np.arange(100) + 0.5)
    a = made(run, 40, 0.1, "a", joule_mean_w=2.0 + t_a)
    b = made(run, 100, 0.025, "b", joule_mean_w=3.0 + 2.0 * t_b)
    c = compare([a, b], "time")
    assert c.step == 0.1
    np.testing.assert_allclose(c.grid, 0.1 * (np.arange(25) + 0.5))
    line = next(line for line in c.lines if line.quantity.key == "joule_mean_w")
    np.testing.assert_allclose(line.differences[1].value, 1.0 + c.grid, rtol=1e-9)


def test_scatter_of_the_blocks_is_the_difference_s_uncertainty_where_nothing_else_is_known(
    case: Callable[[str], Replayed],
) -> None:
    run, rng = case("whatif_budget_change"), np.random.default_rng(4)
    errors, told = [], []
    for _ in range(300):
        a, b = (
            made(run, 25, 0.1, name, frequency_hz=50.0, joule_mean_w=level + 0.1 * rng.standard_normal(25))
            for name, level in (("a", 1.0), ("b", 1.5))
        )
        d = next(
            x for x in compare([a, b], "frequency").lines if x.quantity.key == "joule_mean_w"
        ).differences[1]
        errors.append(d.value[0] - 0.5)
        told.append(d.std[0])
    assert np.std(errors) == pytest.approx(0.1 * np.sqrt(2.0 / 25.0), rel=0.15)
    assert np.mean(told) == pytest.approx(np.std(errors), rel=0.15)


def test_only_settled_blocks_count_by_frequency_where_a_run_has_any(case: Callable[[str], Replayed]) -> None:
    settled = (np.arange(40) >= 20).astype(float)
    columns = {"settled": settled, "joule_mean_w": settled, "nis": settled}
    run = made(case("whatif_budget_change"), 40, 0.1, "a", frequency_hz=50.0, **columns)
    grid, step = common_grid([run, run], "frequency", None)
    cells = {q.key: to_cells(run, q, "frequency", grid, step) for q in quantities(run)}
    assert cells["joule_mean_w"].value[0] == pytest.approx(1.0)
    assert cells["joule_mean_w"].blocks[0] == 20
    assert cells["nis"].value[0] == pytest.approx(0.5)
    never = replace(run, tracks=replace(run.tracks, columns={**run.tracks.columns, "settled": np.zeros(40)}))
    power = next(q for q in quantities(never) if q.key == "joule_mean_w")
    assert to_cells(never, power, "frequency", grid, step).blocks[0] == 40


def test_a_run_against_itself_differs_by_nothing(case: Callable[[str], Replayed]) -> None:
    for name, by in (("whatif_budget_change", "frequency"), ("fault_stuck_accelerometer", "time")):
        run = case(name)
        c = compare([run, replace(run, name="again")], by)  # type: ignore[arg-type]
        said = as_data(c)
        assert len(c.lines) >= 8
        for line in c.lines:
            known = line.differences[1].value[np.isfinite(line.differences[1].value)]
            assert len(known)
            assert not known.any()
        assert said["configuration"] == []
        assert all(row["differences"][1] in (0.0, None) for row in said["figures"])
        assert said["damping"]["differences"][1]["summary"]["worst"] == 0.0


# --- recorded cases ----------------------------------------------------------------------------------------


def test_two_tests_of_one_rig_differ_in_what_is_known_to_differ(case: Callable[[str], Replayed]) -> None:
    c = compare([case("test3"), case("test2")], "frequency")
    said = as_data(c)
    settings = {row["key"]: row["values"] for row in said["configuration"]}
    stated = settings["plant.body.absorber.stiffness_n_m"]
    assert settings["rig.seed"] == [3, 2]
    assert "rig.sweep.from_hz" not in settings
    stiffness = next(row for row in said["figures"] if row["key"] == "stiffness_n_m")
    assert abs(stiffness["differences"][1] - (stated[1] - stated[0])) < 3.0 * stiffness["differences_std"][1]
    damping = said["damping"]["differences"][1]["summary"]  # the same coil: the same damping
    assert damping["cells"] > 15
    assert damping["significant"] <= 0.1 * damping["judged"]
    quieter = said["quantities"]["attenuation"]["differences"][1]["summary"]
    assert quieter["significant"] == quieter["judged"] > 10
    assert quieter["mean"] < -0.3


def test_attenuation_in_hindsight_is_that_of_the_test_s_own_readme(case: Callable[[str], Replayed]) -> None:
    # There it is against a run of the simulated rig without control: 94 % less on average, 91 % at worst at 50.8 Hz.
    said = document(case("test3"))["hindsight"]
    assert said["attenuation_mean"] == pytest.approx(0.94, abs=0.007)
    assert said["attenuation_worst"] == pytest.approx(0.91, abs=0.007)
    assert said["worst_at_hz"] == pytest.approx(50.8, abs=0.2)


def test_faults_differ_where_they_are(case: Callable[[str], Replayed]) -> None:
    c = compare([case("fault_lost_blocks"), case("fault_stuck_accelerometer")], "frequency")
    said = as_data(c)
    assert [round(float(f), 3) for f in c.grid] == [51.0]
    lost, stuck = (said["health"][k]["faults"] for k in (0, 1))
    assert any(f["kind"] == "missing" for f in lost)
    assert any(f["kind"] == "stuck" and f["channel"].endswith("acceleration") for f in stuck)
    only_stuck = [
        e for e in said["events"] if e["times_s"][1] and not e["times_s"][0] and "stuck" in e["text"]
    ]
    assert only_stuck


def test_runs_without_a_common_frequency_are_told_where_each_has_been(
    case: Callable[[str], Replayed],
) -> None:
    a, b = case("whatif_budget_change"), case("fault_lost_blocks")
    with pytest.raises(InputError, match=r"whatif_budget_change: 53 Hz; fault_lost_blocks: 51 Hz.*--by time"):
        compare([a, b], "frequency")
    assert len(compare([a, b], "frequency", step=4.0).grid) == 1
    assert len(compare([a, b], "time").grid) == 40
    silent = made(a, 10, 0.1, "silent", nis=1.0)
    with pytest.raises(InputError, match="no excitation frequency"):
        compare([a, silent], "frequency")


def test_three_runs_are_each_held_against_the_first(case: Callable[[str], Replayed]) -> None:
    run = case("whatif_budget_change")
    runs = [
        made(run, 30, 0.1, name, frequency_hz=50.0, joule_mean_w=level)
        for name, level in (("a", 1.0), ("b", 3.0), ("c", 0.5))
    ]
    line = next(x for x in compare(runs, "frequency").lines if x.quantity.key == "joule_mean_w")
    assert [float(d.value[0]) for d in line.differences] == pytest.approx([0.0, 2.0, -0.5])


# --- report ------------------------------------------------------------------------------------------------


def test_figures_are_those_of_a_replay(case: Callable[[str], Replayed]) -> None:
    run = case("whatif_budget_change")
    alone = run_replay(run.path, ReplayOptions(), quiet, quiet)
    timing = ("realtime_factor", "replay_s")
    assert {k: v for k, v in run.figures.items() if k not in timing} == {
        k: v for k, v in alone.items() if k not in timing
    }
    said = document(run)
    assert len(said["commands"]) == alone["commands"] >= 1
    assert said["proposals"][0]["by"] == "operator"
    assert said["audit"]["summary"] == alone["audit"]
    assert said["setup"]["recorded_at"].startswith("20")
    assert said["verify"]["whole"] is True


def test_motion_without_control_is_that_of_the_sampled_model_and_its_spread_that_of_the_damping(
    case: Callable[[str], Replayed],
) -> None:
    run, rng = case("test3"), np.random.default_rng(1)
    curve, t = run.curve, run.tracks
    assert curve is not None
    facts = LoopFacts(run.sample_rate_hz, 1)
    for k in (8, 20, 30):
        hz, volt = float(t["frequency_hz"][k]), float(t["excitation"][k])
        mean, std = (
            float(np.interp(hz, curve.frequency_hz, c)) for c in (curve.damping_ns_m, curve.std_ns_m)
        )
        drawn = [
            abs(RigModel(run.plant, facts, hz, damping_ns_m=c).response(hz)[0, 0, 1]) * volt
            for c in (mean, *rng.normal(mean, std, 200))
        ]
        assert run.hindsight.passive_m[k] == pytest.approx(drawn[0], rel=1e-3)
        assert run.hindsight.passive_std_m[k] == pytest.approx(np.std(drawn[1:]), rel=0.25)


def test_excitation_that_does_not_say_how_strong_it_is_gives_no_attenuation(
    case: Callable[[str], Replayed],
) -> None:
    run = case("test3")
    found = in_hindsight(run.plant, replace(run.tracks, reference="absorber_acceleration"), run.curve)
    assert "does not say how strong" in found.why_not
    assert not np.isfinite(found.attenuation).any()
    by_current = in_hindsight(run.plant, replace(run.tracks, reference="shaker_current"), run.curve)
    assert np.isfinite(by_current.passive_m).any()  # a current is an excitation, too


def test_limits_name_the_worst_its_time_and_margin(case: Callable[[str], Replayed]) -> None:
    plant = load_plant("rig")
    stroke = np.full(50, 4e-3)
    stroke[30] = 7.6e-3
    run = made(
        case("whatif_budget_change"), 50, 0.1, "a", frequency_hz=50.0 + 0.1 * np.arange(50), stroke_peak_m=stroke,
        stroke_std_m=1e-5, displacement_m=25e-6, settled=(np.arange(50) >= 10).astype(float), joule_mean_w=1.0,
        budget_w=np.where(np.arange(50) < 20, 4.0, 0.9),
    )  # fmt: skip
    found = {j.key: j for j in judge(plant, run.tracks, "joule_mean")}
    assert found["stroke_m"].margin == pytest.approx(0.2)
    assert found["stroke_m"].at_s == pytest.approx(3.1)
    assert found["stroke_m"].at_hz == pytest.approx(53.0)
    assert found["stroke_m"].worst_std == pytest.approx(1e-5)
    assert found["stroke_m"].verdict == "kept"
    assert (
        found["primary_displacement_m"].verdict == found["primary_displacement_m"].verdict_settled == "broken"
    )
    assert found["vcm_power_w"].worst == pytest.approx(1.0)
    # Under 4 W it was kept; after the cut a full second passes before the new budget is judged, and is then broken.
    assert found["budget"].limit == 0.9
    assert found["budget"].margin == pytest.approx(1.0 - 1.0 / 0.9)
    assert found["budget"].verdict == "broken"
    # Nothing was recorded of the current: unknown, never kept.
    assert found["vcm_current_a"].verdict == "unknown"
    assert found["vcm_current_a"].margin is None


def test_power_is_judged_by_its_mean_of_a_second(case: Callable[[str], Replayed]) -> None:
    rng = np.random.default_rng(2)
    power, length = rng.uniform(0.0, 50.0, 120), rng.uniform(0.05, 0.2, 120)
    run = made(case("whatif_budget_change"), 120, 0.1, "a", joule_mean_w=power, duration_s=length)
    judged = next(j for j in judge(load_plant("rig"), run.tracks) if j.key == "vcm_power_w")
    means = []
    for k in range(120):  # brute force: the fewest last blocks that make a second
        for first in range(k, -1, -1):
            if length[first : k + 1].sum() >= 1.0:
                means.append(np.average(power[first : k + 1], weights=length[first : k + 1]))
                break
    assert judged.worst == pytest.approx(max(means))


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = (LIBRARY / "whatif_budget_change" / "recording.rrd").read_bytes()
    path = tmp_path_factory.mktemp("cut") / "cut.rrd"
    path.write_bytes(whole[: int(0.6 * len(whole))])
    return path


def test_report_of_a_file_that_was_cut_short_says_so_first_and_lies_beside_it(cut: Path) -> None:
    figures = cut.with_suffix(".json")
    done = invoke("report", cut)
    assert done.exit_code == 0, done.output
    assert "not whole" in done.stdout
    page = cut.with_suffix(".html").read_text(encoding="utf-8")
    assert page.index("The recording is not whole: cut short") < page.index('id="limits"')
    done = invoke("report", cut, "--json", figures)
    said = json.loads(figures.read_text())
    assert said["verify"]["whole"] is False
    assert 10 < said["verify"]["blocks"] < 40
    assert said["figures"]["blocks"] == said["verify"]["blocks"]


def test_report_of_a_file_with_a_damaged_block_holds_what_lies_before_it(tmp_path: Path) -> None:
    damaged, figures = tmp_path / "damaged.rrd", tmp_path / "figures.json"
    content = bytearray((LIBRARY / "whatif_budget_change" / "recording.rrd").read_bytes())
    for k in range(40):
        content[len(content) // 2 + k] ^= 0x5A
    damaged.write_bytes(content)
    done = invoke("report", damaged, "--json", figures)
    assert done.exit_code == 0, done.output
    said = json.loads(figures.read_text())
    assert said["verify"]["whole"] is False
    assert "damaged" in said["verify"]["damage"][0]
    assert 10 < said["figures"]["blocks"] == said["verify"]["blocks"] < 40


def test_foreign_recording_is_reported_with_what_can_be_said(realdata: Path, tmp_path: Path) -> None:
    page, figures = tmp_path / "beam.html", tmp_path / "beam.json"
    done = CliRunner().invoke(
        app,
        [
            "report",
            str(realdata / "beam_closed_lq.npz"),
            "--plant",
            "beam",
            "--html",
            str(page),
            "--json",
            str(figures),
        ],
    )
    assert done.exit_code == 0, done.output
    said = json.loads(figures.read_text())
    assert said["verify"]["whole"] is None
    assert said["limits"][0]["key"] == "piezo_force_n"
    assert said["limits"][0]["worst"] == pytest.approx(120.0 * 1.876e-4, rel=1e-3)
    told = " ".join(said["cannot_say"])
    for words in ("no checksums", "c2(f)", "Motion, attenuation and power", "Proposals"):
        assert words in told
    assert "sample rate 100 Hz" in page.read_text(encoding="utf-8")


# --- pages -------------------------------------------------------------------------------------------------


class Parsed(HTMLParser):
    """Elements with their attributes; complains of tags that do not pair."""

    VOID = ("meta", "link", "br", "img", "wbr")

    def __init__(self, page: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(page)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def pages(case: Callable[[str], Replayed], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pages")
    run = replace(case("whatif_budget_change"), name="<script>alert(1)</script>")
    run.history.events.append({"time_s": 3.0, "level": "warning", "text": "<img src=x onerror=alert(2)>"})
    c = compare([run, replace(case("whatif_budget_change"), name='"b" & <i>')], "frequency")
    written = {
        "report": filed.filed_page(run, document(run)),
        "comparison": compare_page.comparison_page(c, as_data(c)),
    }
    run.history.events.pop()
    for name, content in written.items():
        (folder / f"{name}.html").write_text(content, encoding="utf-8")
    return {name: folder / f"{name}.html" for name in written}


@pytest.mark.parametrize("name", ["report", "comparison"])
def test_page_stands_alone_pairs_its_tags_and_escapes_what_files_say(
    pages: dict[str, Path], name: str
) -> None:
    page = pages[name].read_text(encoding="utf-8")
    parsed = Parsed(page)
    for tag, attributes in parsed.found:
        assert tag not in ("iframe", "object", "embed", "base", "form")
        for key in ("src", "href", "srcset", "action", "data"):
            value = attributes.get(key)
            assert value is None or value.startswith(("#", "data:")), (tag, key, value)
        assert not any(key.startswith("on") for key in attributes)
    assert not re.search(r"@import|url\((?!#)", page)
    ids = [attributes["id"] for _, attributes in parsed.found if "id" in attributes]
    assert len(ids) == len(set(ids))
    referred = set(re.findall(r'(?:href="|url\()#([^")]+)', page))
    assert referred <= set(ids)
    words = " ".join(parsed.words)
    assert "<script>alert(1)</script>" in words  # as text
    assert "<script>alert" not in page
    assert "<img" not in page
    assert len(page) < 600_000


@pytest.mark.parametrize("name", ["report", "comparison"])
def test_page_opens_from_disk_reads_out_values_and_prints(
    pages: dict[str, Path], name: str, requires_debian: Callable[[str], Path]
) -> None:
    chromium = requires_debian("chromium")
    from playwright.sync_api import sync_playwright

    complaints: list[str] = []
    asked: list[str] = []
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=str(chromium), headless=True, args=FLAGS)
        page = browser.new_page(viewport={"width": 1200, "height": 900})
        page.on("console", lambda m: complaints.append(m.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda r: asked.append(r.url))
        page.goto(pages[name].as_uri())
        plot = page.locator(".plot").first
        plot.locator("svg").hover()
        page.wait_for_function("document.querySelector('.plot output').textContent.includes(': ')")
        plot.focus()
        page.keyboard.press("ArrowRight")
        inside, box = (plot.locator(what).bounding_box() for what in ("output", "svg"))
        assert inside is not None
        assert box is not None
        assert box["y"] <= inside["y"] < inside["y"] + inside["height"] <= box["y"] + box["height"]
        assert box["x"] <= inside["x"] < inside["x"] + inside["width"] <= box["x"] + box["width"]
        first = plot.locator("output").inner_text()
        page.keyboard.press("ArrowLeft")
        assert plot.locator("output").inner_text() != first or name == "comparison"  # a dwell has one cell
        page.keyboard.press("Escape")
        assert plot.locator("output").inner_text() == ""
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        page.set_viewport_size({"width": 420, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        printed = page.pdf(prefer_css_page_size=True)
        browser.close()
    assert complaints == []
    assert asked == [pages[name].as_uri()]
    assert 3 <= len(re.findall(rb"/Type /Page\b", printed)) <= 16


def test_everything_said_is_json_without_nan_and_bytes_of_a_page_repeat(
    case: Callable[[str], Replayed],
) -> None:
    for name in ("fault_lost_blocks", "fault_stuck_accelerometer", "test3"):
        json.dumps(document(case(name)), allow_nan=False)
    c = compare([case("fault_lost_blocks"), case("fault_stuck_accelerometer")], "frequency")
    json.dumps(as_data(c), allow_nan=False)
    plot = compare_plots.comparison_plots(c)[0]
    assert as_html(plot) == as_html(plot)


def test_pages_of_an_hour_stay_small(case: Callable[[str], Replayed]) -> None:
    n, rng = 36_000, np.random.default_rng(3)
    run = case("whatif_budget_change")
    motion, hz = 1e-5 * rng.uniform(0.5, 1.5, n), 50.0 + 5.0 * np.sin(np.arange(n) / 900.0)
    hour = made(
        run, n, 0.1, "hour", frequency_hz=hz, displacement_m=motion, stroke_peak_m=1e-3, joule_mean_w=motion * 1e5,
        joule_peak_w=1.0, electrical_mean_w=1.0, current_peak_a=0.5, budget_w=4.0, nis=rng.uniform(0.9, 1.1, n),
        nis_low=0.95, nis_high=1.05, masked=(np.arange(n) % 3 == 0).astype(float),
    )  # fmt: skip
    passive = np.full(n, 1e-4)
    hour = replace(
        hour, hindsight=Hindsight(passive, 0.01 * passive, 1.0 - motion / passive, 0.01 * passive / 1e-4)
    )
    assert len(filed.filed_page(hour, document(hour))) < 1_500_000
    c = compare([hour, replace(hour, name="again")], "time")
    assert len(c.grid) <= 600
    assert c.step == pytest.approx(6.0)
    assert sum(len(as_html(plot)) for plot in compare_plots.comparison_plots(c)[:2]) < 400_000


def test_parts_of_a_page_escape_what_is_not_html_already() -> None:
    assert text("<b>") == "&lt;b&gt;"
    assert text(Html("<b>")) == "<b>"
    assert text(None) == "–"
    assert element("a", "<", href='"', aria_label="x") == '<a href="&quot;" aria-label="x">&lt;</a>'
    assert '<td class="n">1</td>' in table(("a", "b"), [("<", 1)], (1,))


def test_words_carry_as_many_digits_as_the_uncertainty_leaves() -> None:
    assert quantity(81.51e-6, "m", 2.833e-6) == "81.5 ± 2.8 µm"
    assert quantity(40714.23, "N/m", 23.4) == "40714 ± 23 N/m"
    assert quantity(49261.663, "N/m") == "49262 N/m"
    assert quantity(0.6031, "A") == "603.1 mA"
    assert quantity(0.0, "A") == "0 A"
    assert quantity(float("nan"), "A") == quantity(None) == "–"
    assert share(0.73369, 0.0009) == "73.37 ± 0.09 %"
    assert share(0.5) == "50.0 %"


def test_long_series_keep_their_peaks() -> None:
    x = np.arange(100_000.0)
    y = np.sin(x / 500.0)
    y[77_777] = 40.0
    few, values = thinned(x, y)
    assert len(few) <= 1502
    assert values.max() == 40.0
    assert np.all(np.diff(few) > 0.0)


# --- the commands ------------------------------------------------------------------------------------------


def test_commands_write_page_plots_and_figures(tmp_path: Path) -> None:
    a = LIBRARY / "fault_lost_blocks" / "recording.rrd"
    b = LIBRARY / "fault_wrong_model" / "recording.rrd"
    page, plots = tmp_path / "c.html", tmp_path / "c.pdf"
    done = invoke("compare", a, b, "--reference", "2", "--html", page, "--plot", plots, "--json", "-")
    assert done.exit_code == 0, done.output
    said = json.loads(done.stdout)
    assert said["reference"] == "fault_wrong_model"
    assert [run["name"] for run in said["runs"]] == ["fault_wrong_model", "fault_lost_blocks"]
    assert plots.read_bytes().startswith(b"%PDF")
    assert "fault_lost_blocks" in page.read_text(encoding="utf-8")


def test_what_cannot_be_written_or_read_is_said_before_anything_is_replayed(
    tmp_path: Path, cut: Path
) -> None:
    for arguments, words in (
        (("compare", cut), "two recordings"),
        (("compare", cut, cut, "--reference", "3"), "--reference 3"),
        (
            ("compare", cut, tmp_path / "none.rrd", "--html", tmp_path / "none" / "x.html"),
            "folder that exists",
        ),
        (("report", cut, "--plot", tmp_path / "x.gif"), ".png"),
        (("report", cut, "--html", tmp_path / "x.rrd"), "ends in .html"),
        (("report", tmp_path / "none.rrd"), "no such recording"),
        (("report", cut, "--channel", "x"), "NAME=ARRAY"),
    ):
        done = invoke(*arguments)
        assert isinstance(done.exception, InputError), (arguments, done.output)
        assert words in str(done.exception)


def test_picture_of_several_plots_is_one_file(case: Callable[[str], Replayed], tmp_path: Path) -> None:
    plots = plots_of(case("whatif_budget_change"))
    assert [p.name for p in plots] == [
        "motion",
        "attenuation",
        "power",
        "damping",
        "health",
        "timeline",
        "audit",
    ]
    save_plots(plots, tmp_path / "all.png")
    assert (tmp_path / "all.png").read_bytes().startswith(b"\x89PNG")
    numbers = json.loads(re.findall(r'application/json">(.*?)</script>', as_html(plots[2]))[0])
    shown = next(s for s in numbers[0]["series"] if s["label"] == "Joule mean")
    np.testing.assert_allclose(shown["y"], case("whatif_budget_change").tracks["joule_mean_w"], rtol=1e-4)
