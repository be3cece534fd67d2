"""Hand-over to firmware: the C header computes what the program computes, files read back, nothing unsafe leaves."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tuning.firmware import BITS, fixed_table, point_figures, rounding_effect
from tuning.loop import LoopFacts, RigModel
from tuning.rule import scheduling_rule
from tuning.steady import predict
from twin.control.chain import chain_step
from twin.control.schedule import Acknowledgement, Command, Gains, GainSchedule
from twin.plant.blocks import make_block
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.rig.recording import Recorder
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import programme
from twin.station.export import run_export
from twin.station.export_source import ExportOptions
from twin.station.firmware_header import c_header
from twin.station.handover import Handover, parse_handover, read_export
from twin.station.session import Session, SessionSettings

RIG = load_plant("rig")
FACTS = LoopFacts(50_000.0, 1)
COLUMNS = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")


def quiet(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the thesis's rule for the rig, rows that no decimal fraction hits exactly."""
    out = tmp_path_factory.mktemp("firmware")
    run_export(
        ExportOptions(out=out, plant="rig", rule="thesis", band="45.1:54.9:0.7", made="a Sunday", solves=0),
        quiet,
    )
    return out


@pytest.fixture(scope="module")
def handover(exported: Path) -> Handover:
    return read_export(exported / "rig_schedule.json", RIG)


def compiler(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"needs the C compiler {name}")
    return found


def build(folder: Path, code: str, tool: str = "gcc", standard: str = "c99") -> Path:
    source = folder / ("main.c" if tool == "gcc" else "main.cpp")
    source.write_text(code, encoding="ascii")
    flags = [f"-std={standard}", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    program = folder / f"main_{standard.replace('+', 'p')}"
    done = subprocess.run(
        [compiler(tool), *flags, "-I", str(folder), str(source), "-o", str(program), "-lm"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return program


def run(program: Path, rows: str) -> list[list[float]]:
    done = subprocess.run([str(program)], input=rows, capture_output=True, text=True, check=True, timeout=60)
    return [[float(word) for word in line.split()] for line in done.stdout.splitlines()]


# --- the C header ---------------------------------------------------------------------------------------------

GAINS = r"""
#include <stdio.h>
#include "rig_schedule.h"
int main(void)
{
    double f;
    while (scanf("%lf", &f) == 1) {
        const atmd_gains g = atmd_gains_at(f);
        printf("%.17g %.17g %.17g %.17g %.17g %d\n", g.alpha_kg, g.beta_ns_m, g.gamma_n_m, g.low_pass_hz,
               g.high_pass_hz, atmd_acts_at(f));
    }
    return 0;
}
"""


def frequencies(schedule: GainSchedule) -> list[float]:
    rng = np.random.default_rng(3)
    span = schedule.frequency_hz[0] - 2.0, schedule.frequency_hz[-1] + 2.0
    edges = [math.nextafter(f, side) for f in schedule.frequency_hz for side in (0.0, f, 1e9)]
    return [*edges, *rng.uniform(*span, 500).tolist(), 0.0, -1.0, 1e300]


def agrees(program: Path, schedule: GainSchedule) -> None:
    hz = frequencies(schedule)
    rows = run(program, "\n".join(repr(f) for f in hz))
    expected = np.array([(*schedule.at(f).as_tuple(), schedule.acts_at(f)) for f in hz])
    scale = np.abs(expected).max(axis=0) + 1e-300
    assert np.abs(np.array(rows) - expected).max(axis=0) == pytest.approx(0.0, abs=1e-12 * scale.max())
    np.testing.assert_allclose(np.array(rows) / scale, expected / scale, rtol=0.0, atol=1e-12)


def test_header_interpolates_as_the_schedule_does(exported: Path, handover: Handover, tmp_path: Path) -> None:
    shutil.copy(exported / "rig_schedule.h", tmp_path)
    agrees(build(tmp_path, GAINS), handover.schedule)


@pytest.mark.parametrize("standard", ["c++98", "c++17"])
def test_header_serves_cpp_as_well(exported: Path, handover: Handover, tmp_path: Path, standard: str) -> None:
    shutil.copy(exported / "rig_schedule.h", tmp_path)
    agrees(build(tmp_path, GAINS, "g++", standard), handover.schedule)


def test_header_may_be_included_twice_and_by_two_files(exported: Path, tmp_path: Path) -> None:
    shutil.copy(exported / "rig_schedule.h", tmp_path)
    twice = '#include "rig_schedule.h"\n' * 2
    other = f"{twice}int other(void);\nint other(void) {{ return ATMD_POINTS; }}\n"
    (tmp_path / "other.c").write_text(other)
    code = '#include "other.c"\n#include "rig_schedule.h"\nint main(void) { return other() == ATMD_POINTS ? 0 : 1; }\n'
    assert subprocess.run([str(build(tmp_path, code))], check=False).returncode == 0


STEP = r"""
#include <stdio.h>
#include "rig_schedule.h"
int main(void)
{
    double f, a;
    int on;
    atmd_chain chain, twin;
    atmd_reset(&chain);
    atmd_reset(&twin);
    while (scanf("%lf %d %lf", &f, &on, &a) == 3) {
        double motion[3];
        const atmd_coefficients c = atmd_coefficients_from(atmd_gains_at(f));
        atmd_chain_step(&twin, &c, a, motion);
        printf("%.17g %.17g %.17g %.17g\n", motion[0], motion[1], motion[2], atmd_step(&chain, &c, a, on));
    }
    return 0;
}
"""


def test_header_steps_the_controller_as_the_rig_does(
    exported: Path, handover: Handover, tmp_path: Path
) -> None:
    shutil.copy(exported / "rig_schedule.h", tmp_path)
    program = build(tmp_path, STEP)
    rng = np.random.default_rng(5)
    n, dt, k = 20_000, 1.0 / 50_000.0, 8.0
    hz = 50.0 + 6.0 * np.sin(np.linspace(0.0, 9.0, n))
    t = np.arange(n) * dt
    a_in = 150.0 * np.sin(math.tau * 50.0 * t) + rng.normal(0.0, 20.0, n)
    s, expected, clamped = np.zeros(6), np.empty((n, 4)), 0
    for i in range(n):
        on = handover.schedule.acts_at(hz[i])
        g = handover.schedule.at(float(hz[i]))
        low, high = (math.tan(math.pi * f * dt) for f in (g.low_pass_hz, g.high_pass_hz))
        a, v, x = chain_step(s, float(a_in[i]), low, high, dt)
        command = (g.alpha_kg * a + g.beta_ns_m * v + g.gamma_n_m * x) / k if on else 0.0
        clamped += abs(command) > 2.0
        expected[i] = a, v, x, min(max(command, -2.0), 2.0)
    rows = [
        f"{f!r} {int(handover.schedule.acts_at(f))} {a!r}"
        for f, a in zip(hz.tolist(), a_in.tolist(), strict=True)
    ]
    found = np.array(run(program, "\n".join(rows)))
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=1e-12)
    assert 100 < clamped < n // 2  # the clamp was tried, and not all of the time


def test_header_sends_no_current_for_what_is_no_number(exported: Path, tmp_path: Path) -> None:
    shutil.copy(exported / "rig_schedule.h", tmp_path)
    rows = run(build(tmp_path, STEP), "50.0 1 nan\n50.0 1 1.0\nnan 1 1.0\n50.0 1 inf")
    assert [row[3] for row in rows] == [0.0] * 4


FIXED = r"""
#include <stdio.h>
#include "rig_schedule.h"
int main(void)
{
    long f;
    while (scanf("%ld", &f) == 1) {
        const atmd_fixed_gains q = atmd_fixed_gains_at((int32_t)f);
        const atmd_coefficients c = atmd_coefficients_from_fixed(q);
        printf("%ld %ld %ld %ld %ld %d %.17g %.17g\n", (long)q.alpha_kg, (long)q.beta_ns_m, (long)q.gamma_n_m,
               (long)q.low_pass_g, (long)q.high_pass_g, atmd_fixed_acts_at((int32_t)f), c.gamma, c.g_low);
    }
    return 0;
}
"""


@pytest.mark.parametrize("word", ["Q15", "Q31"])
def test_fixed_point_of_the_header_is_that_of_the_margins_to_the_last_step(
    handover: Handover, tmp_path: Path, word: Any
) -> None:
    table = fixed_table(handover.schedule, 50_000.0, word)
    (tmp_path / "rig_schedule.h").write_text(c_header(handover.model_copy(update={"fixed_point": table})))
    program = build(tmp_path, FIXED)
    q, rng = table.frequency_hz.numbers, np.random.default_rng(7)
    numbers = [*q, *(x + 1 for x in q), *(x - 1 for x in q), 0, -5, (1 << (BITS[table.word] - 1)) - 1]
    numbers += rng.integers(q[0] - 50, q[-1] + 50, 800).tolist()
    for f, row in zip(numbers, run(program, "\n".join(map(str, numbers))), strict=True):
        assert tuple(int(x) for x in row[:5]) == table.numbers_at(f)
        assert row[5] == (table.on_from <= f <= table.on_to)
        assert row[6] == pytest.approx(row[2] * table.gamma_n_m.resolution / 8.0, rel=1e-15)
        assert row[7] == row[3] * table.low_pass_g.resolution


# --- rounding -------------------------------------------------------------------------------------------------


@st.composite
def tables(draw: st.DrawFn) -> GainSchedule:
    n = draw(st.integers(1, 8))
    hz = tuple(
        float(f) for f in 40.0 + np.cumsum(draw(st.lists(st.floats(0.1, 3.0), min_size=n, max_size=n)))
    )
    any_gain = st.floats(-1e6, 1e6, allow_subnormal=False)
    columns = {name: tuple(draw(st.lists(any_gain, min_size=n, max_size=n))) for name in COLUMNS[:3]}
    columns |= {
        name: tuple(draw(st.lists(st.floats(1.0, 5e3), min_size=n, max_size=n))) for name in COLUMNS[3:]
    }
    inside = sorted(draw(st.lists(st.floats(hz[0], hz[-1]), min_size=2, max_size=2)))
    return GainSchedule(frequency_hz=hz, **columns, on_from_hz=inside[0], on_to_hz=inside[1])


@settings(max_examples=80, deadline=None)
@given(schedule=tables(), share=st.floats(0.0, 1.0), word=st.sampled_from(["Q15", "Q31"]))
def test_fixed_point_stays_within_its_stated_steps(schedule: GainSchedule, share: float, word: Any) -> None:
    try:
        table = fixed_table(schedule, 50_000.0, word)
    except RunError:
        assert word == "Q15"  # too coarse is possible there only
        return
    largest = (1 << (BITS[table.word] - 1)) - 1
    f = schedule.frequency_hz[0] + share * (schedule.frequency_hz[-1] - schedule.frequency_hz[0])
    numbers = table.numbers_at(table.frequency_hz.nearest(f))
    hz = np.array(schedule.frequency_hz)
    for name, q in zip((*COLUMNS[:3], "low_pass_g", "high_pass_g"), numbers, strict=True):
        column = getattr(table, name)
        assert max(abs(x) for x in column.numbers) <= largest
        plain = getattr(schedule, name.replace("_pass_g", "_pass_hz"))
        values = np.tan(np.pi * np.array(plain) / 50_000.0) if name.endswith("_g") else np.array(plain)
        if any(values):
            assert max(abs(x) for x in column.numbers) > largest // 2 - 1  # no bit is wasted
        steepest = float(np.abs(np.diff(values) / np.diff(hz)).max()) if len(hz) > 1 else 0.0
        bound = 1.01 * column.resolution + 1.5 * steepest * table.frequency_hz.resolution
        assert abs(q * column.resolution - float(np.interp(f, hz, values))) <= bound


@settings(max_examples=40, deadline=None)
@given(schedule=tables())
def test_any_table_reads_back_to_the_same_bits(handover: Handover, schedule: GainSchedule) -> None:
    changed = handover.model_copy(
        update={"schedule": schedule, "fixed_point": fixed_table(schedule, 50_000.0, "Q31")}
    )
    assert parse_handover(changed.model_dump_json(), Path("x.json")) == changed
    header = c_header(changed)
    start = header.index("atmd_gamma_n_m[ATMD_POINTS]")
    words = header[header.index("{", start) + 1 : header.index("}", start)].split(",")
    assert tuple(float(w) for w in words if w.strip()) == schedule.gamma_n_m


def test_rounding_is_judged_on_the_full_model() -> None:
    schedule = scheduling_rule(RIG, np.arange(45.0, 55.01, 0.5).tolist())
    effects = {
        word: rounding_effect(RIG, FACTS, schedule, fixed_table(schedule, 50_000.0, word), 4.0)
        for word in ("Q15", "Q31")
    }
    assert effects["Q31"].margin_lost < 1e-6 < effects["Q15"].margin_lost < 1e-2
    assert effects["Q31"].modulus_margin == effects["Q15"].modulus_margin
    assert effects["Q15"].delay_margin_rounded_s == pytest.approx(effects["Q15"].delay_margin_s, rel=1e-2)
    with pytest.raises(RunError, match=r"Q15, a margin at .* falls by"):
        rounding_effect(RIG, FACTS, schedule, fixed_table(schedule, 50_000.0, "Q15"), 4.0, most_lost=1e-6)


def test_table_that_rounding_makes_unstable_is_refused() -> None:
    # A row far outside the band makes the steps of gamma so coarse that nothing is left of it inside.
    inside = scheduling_rule(RIG, (54.0, 55.0))
    wide = inside.model_copy(
        update={name: (*getattr(inside, name), getattr(inside, name)[-1]) for name in COLUMNS}
        | {"frequency_hz": (54.0, 55.0, 56.0), "beta_ns_m": (-7.0, -7.0, -3e6)}
    )
    table = fixed_table(wide, 50_000.0, "Q15")
    assert table.beta_ns_m.resolution > 50.0
    slipped = table.model_copy(
        update={"beta_ns_m": table.beta_ns_m.model_copy(update={"numbers": (-1, -1, -32_000)})}
    )
    with pytest.raises(RunError, match="rounded to Q15 is not stable at 54 Hz"):
        rounding_effect(RIG, FACTS, wide, slipped, 4.0)


def test_rows_closer_than_a_step_need_longer_words() -> None:
    schedule = scheduling_rule(RIG, (50.0, 50.0005, 51.0))
    with pytest.raises(RunError, match="two rows of the table fall on the same step"):
        fixed_table(schedule, 50_000.0, "Q15")
    assert len(set(fixed_table(schedule, 50_000.0, "Q31").frequency_hz.numbers)) == 3


# --- figures and files ----------------------------------------------------------------------------------------


def test_figures_are_those_of_the_full_model(handover: Handover) -> None:
    point = handover.points[3]
    model = RigModel(RIG, handover.loop.facts, point.frequency_hz)
    gains = handover.schedule.at(point.frequency_hz)
    steady = predict(model, gains, point.frequency_hz, 4.0)
    assert point.achieved_displacement_m == steady.displacement_m
    assert point.joule_peak_w == pytest.approx(2.7 * steady.current_peak_a**2)
    assert point.slowest_pole_1_s == model.decay_rate_1_s(gains) < 0.0
    assert point.passive_displacement_m == pytest.approx(
        abs(model.response(point.frequency_hz)[0, 0, 1]) * 4.0
    )
    grid = np.geomspace(1.0, 5_000.0, 40_000)
    loop = model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz) @ np.array(gains.as_tuple()[:3])
    assert point.modulus_margin == pytest.approx(float(np.abs(1.0 + loop).min()), rel=1e-2)
    assert point.limit_displacement_m is not None
    assert point.limit_displacement_m <= point.achieved_displacement_m
    assert handover.transition.shown


def test_budget_moves_the_limit_and_is_stamped() -> None:
    schedule = scheduling_rule(RIG, (45.0, 55.0))
    free, poor = (point_figures(RIG, FACTS, schedule, 4.0, watt)[0] for watt in (None, 0.3))
    assert poor.limit_displacement_m is not None
    assert free.limit_displacement_m is not None
    assert poor.limit_displacement_m > free.limit_displacement_m + 1e-6
    assert poor.achieved_displacement_m == free.achieved_displacement_m


def test_files_carry_plant_fingerprint_and_what_was_said_of_their_making(
    exported: Path, handover: Handover
) -> None:
    header = (exported / "rig_schedule.h").read_text(encoding="ascii")
    assert f'#define ATMD_FINGERPRINT "{RIG.fingerprint}"' in header
    assert "Made a Sunday." in header
    assert handover.made == "a Sunday"
    assert (handover.plant, handover.fingerprint) == ("rig", RIG.fingerprint)
    again = c_header(handover.model_copy(update={"made": "*/ int x = 1; /*"}))
    assert "*/ int x" not in again


def test_export_for_another_plant_or_of_another_kind_is_refused(exported: Path, tmp_path: Path) -> None:
    path = exported / "rig_schedule.json"
    with pytest.raises(InputError, match=f"fingerprint {RIG.fingerprint}, not for 'rig'"):
        read_export(path, RIG.with_damping("absorber", 8.0))
    text = path.read_text()
    for bad in (text[: len(text) // 2], "{}", "[]", text.replace('"version": 1', '"version": 2')):
        damaged = tmp_path / "damaged.json"
        damaged.write_text(bad)
        with pytest.raises(InputError, match=r"damaged\.json"):
            read_export(damaged, RIG)
    with pytest.raises(InputError, match="cannot be read"):
        read_export(tmp_path / "none.json", RIG)


def test_export_of_an_export_is_the_same_but_for_its_words(exported: Path, tmp_path: Path) -> None:
    old = read_export(exported / "rig_schedule.json", RIG)
    options = ExportOptions(
        out=tmp_path, file=exported / "rig_schedule.json", fixed_point="Q31", made="a Sunday", solves=0
    )
    run_export(options, quiet)
    new = read_export(tmp_path / "rig_schedule.json", RIG)
    assert new.fixed_point is not None
    assert new.fixed_point.word == "Q31"
    same = {"fixed_point": old.fixed_point, "rounding": old.rounding}
    assert new.model_copy(update=same) == old


# --- sources --------------------------------------------------------------------------------------------------


def tuned(**changes: Any) -> dict[str, Any]:
    schedule = scheduling_rule(RIG, (49.0, 50.0, 51.0))
    points = [
        {
            "frequency_hz": f,
            "limit_displacement_m": 0.0,
            "gains": dict(zip(COLUMNS[:3], schedule.at(f).as_tuple()[:3], strict=True)),
            "cutoffs": {"low_pass_hz": schedule.at(f).low_pass_hz, "high_pass_hz": 2.5},
            "solve_ms": 1.0,
        }
        for f in schedule.frequency_hz
    ]
    return {"points": points} | changes


def test_tuning_becomes_a_table_that_acts_between_its_ends(tmp_path: Path) -> None:
    file = tmp_path / "tuning.json"
    file.write_text(
        json.dumps(
            tuned(plant="rig", budget_w=4.0, budget_kind="joule_peak", excitation=3.0, loop_delay_s=2e-5)
        )
    )
    result = run_export(ExportOptions(out=tmp_path, file=file), quiet)
    found = read_export(tmp_path / "rig_schedule.json", RIG)
    expected = scheduling_rule(RIG, (49.0, 50.0, 51.0))
    assert found.schedule == expected
    assert found.loop.facts == FACTS
    assert found.excitation.amplitude == 3.0
    assert found.budget is not None
    assert (found.budget.power_w, found.budget.kind) == (4.0, "joule_peak")
    assert [p["frequency_hz"] for p in result["points"]] == [49.0, 50.0, 51.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rule": "thesis"}, "add --plant"),
        ({"rule": "thesis", "plant": "rig", "band": "55:45:1"}, "--band 55:45:1"),
        ({"rule": "thesis", "plant": "nope"}, "nope"),
        ({"rule": "guess", "plant": "rig"}, "known: thesis"),
        ({"file": Path("table.csv")}, "table.csv"),
        ({}, "give either a FILE"),
    ],
)
def test_request_that_names_no_schedule_says_what_to_give(
    tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        run_export(ExportOptions(out=tmp_path / "out", **options), quiet)


def unstable() -> dict[str, Any]:
    out = tuned()
    out["points"][2]["gains"]["beta_ns_m"] = -200.0
    return out


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        (tuned(), {}, "add --plant"),
        (tuned(fingerprint="0123456789abcdef"), {"plant": "rig"}, "fingerprint 0123456789abcdef, 'rig' has"),
        (tuned(plant="engine_vcm"), {"plant": "rig"}, "is for plant 'engine_vcm', not for 'rig'"),
        (
            tuned(points=[{"frequency_hz": 50.0, "gains": None, "cutoffs": None, "reason": "stroke"}]),
            {"plant": "rig"},
            r"no gains at 50 Hz \(stroke\)",
        ),
        (tuned(points=[]), {"plant": "rig"}, "points"),
        ({"points": [{"frequency_hz": 50.0}]}, {"plant": "rig"}, "points.0.gains"),
        (tuned(points=tuned()["points"][::-1]), {"plant": "rig"}, "must rise"),
        (tuned(), {"plant": "engine"}, "has no voice coil"),
        (tuned(), {"plant": "rig", "rule": "thesis"}, "give either a FILE"),
        (tuned(), {"plant": "rig", "delay_us": -1.0}, "--delay-us"),
        (tuned(), {"plant": "rig", "budget_kind": "joule_peak"}, "--budget-w"),
        (tuned(), {"plant": "rig", "budget_w": math.nan}, "--budget-w nan"),
        (tuned(), {"plant": "rig", "excitation": -1.0}, "--excitation -1"),
        (tuned(), {"plant": "rig", "most_lost_percent": 100.0}, "--margin-loss"),
    ],
)
def test_source_that_cannot_be_used_says_why_and_writes_nothing(
    tmp_path: Path, content: dict[str, Any], options: dict[str, Any], words: str
) -> None:
    file, out = tmp_path / "tuning.json", tmp_path / "out"
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        run_export(ExportOptions(out=out, file=file, **options), quiet)
    assert not out.exists()


def test_schedule_that_is_not_stable_is_not_handed_over(tmp_path: Path) -> None:
    file, out = tmp_path / "tuning.json", tmp_path / "out"
    file.write_text(json.dumps(unstable()))
    with pytest.raises(RunError, match="not stable at 51 Hz"):
        run_export(ExportOptions(out=out, file=file, plant="rig"), quiet)
    assert not out.exists()


def test_recording_gives_the_last_schedule_the_rig_took(tmp_path: Path) -> None:
    run_of = programme("test3", seconds=2.0, sweep_hz=(49.5, 50.5))
    rig = SimulatedRig(run_of)
    settings_of = SessionSettings(loop=FACTS, schedule=run_of.schedule)
    session = Session(run_of.plant, rig.channels, run_of.sample_rate_hz, settings_of)
    config = {"programme": run_of.model_dump(mode="json"), "session": session.configuration()}
    path = tmp_path / "run.rrd"
    taken = run_of.schedule.with_points({9: Gains(0.001, -13.0, -1500.0, 900.0, 2.5)})
    refused = run_of.schedule.with_points({9: Gains(0.5, -13.0, -1500.0, 900.0, 2.5)})
    with Recorder(
        path, plant=run_of.plant, sample_rate_hz=run_of.sample_rate_hz, channels=rig.channels,
        run_config_json=json.dumps(config), seed=0,
    ) as recorder:  # fmt: skip
        for number, schedule in enumerate((run_of.schedule, taken, refused), start=1):
            recorder.write_command(
                Command(command_id=number, apply_at_sample=5_000 * number, schedule=schedule)
            )
            answer = Acknowledgement(
                command_id=number,
                accepted=number < 3,
                applied_at_sample=5_000 * number if number < 3 else None,
            )
            recorder.write_acknowledgement(answer, 5_000 * number)
        while not rig.finished:
            first = rig.next_sample
            values, _, _ = rig.next_block()
            recorder.write_block(make_block(first, run_of.sample_rate_hz, values, rig.channels))
    run_export(ExportOptions(out=tmp_path / "out", file=path, solves=0), quiet)
    found = read_export(tmp_path / "out" / "rig_schedule.json", run_of.plant)
    assert found.schedule == taken
    assert "command 2 in force from 0.2 s" in found.source
    assert found.loop.facts == FACTS
    assert found.excitation.amplitude == 4.0
    # The damping of Test 2's fit was learned where the excitation went, not the open coil's 7 Ns/m.
    assert not isinstance(found.damping_ns_m, float)
    assert found.damping_ns_m.at(50.0) > 9.0


# --- the command ----------------------------------------------------------------------------------------------


def atmd(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "twin.station.cli", "export", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_command_writes_both_files_and_says_what_they_promise(tmp_path: Path) -> None:
    done = atmd(
        "--plant", "rig", "--rule", "thesis", "--band", "49:51:1", "--out", str(tmp_path / "a" / "b"),
        "--delay-us", "20", "--budget-w", "4", "--json", "-",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [Path(f).name for f in result["files"]] == ["rig_schedule.json", "rig_schedule.h"]
    assert all(Path(f).is_file() for f in result["files"])
    assert result["budget"] == {"power_w": 4.0, "kind": "joule_mean"}
    assert result["fixed_point"] == "Q15"
    assert result["transition"]["shown"]
    assert result["rounding"]["margin_lost"] < 0.05
    words = " ".join(done.stderr.split())
    assert "stable" in words
    assert "Q15: modulus margin" in words
    assert "…" not in words


@pytest.mark.parametrize(
    ("words", "code", "names"),
    [
        (["nothing.rrd"], 2, "nothing.rrd"),
        (["--plant", "rig", "--rule", "thesis", "--margin-loss", "0"], 3, "falls by"),
    ],
)
def test_command_that_cannot_be_obeyed_ends_with_its_code_and_names_what_is_wrong(
    tmp_path: Path, words: list[str], code: int, names: str
) -> None:
    out = tmp_path / "out"
    done = atmd(*words, "--fixed-point", "Q15", "--out", str(out))
    assert done.returncode == code
    assert names in " ".join(done.stderr.split())
    assert "Traceback" not in done.stderr
    assert not out.exists()
