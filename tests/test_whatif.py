"""What-if: curves that obey their changes, branches that come true within what they say of themselves."""

import dataclasses
import json
import multiprocessing
from pathlib import Path

import numpy as np
import pytest

from tests.test_cli import atmd
from tuning.branch import Brancher, _over
from tuning.changes import KEYS, Changes, parse_changes
from tuning.design import Design, Start
from tuning.retune import Retuner, TuningGoal
from tuning.search import Found
from tuning.stability import StabilityWatch
from tuning.verify import Demands, Situation
from tuning.whatif import Curves, WhatIf
from twin.plant.blocks import make_block
from twin.plant.errors import InputError
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import programme
from twin.station.demo import demo_programme, facts_of, session_for
from twin.station.frame import Frame
from twin.station.given_gains import split_given
from twin.station.instant import instant_at
from twin.station.whatif import WhatIfOptions, coil_of, run_whatif
from twin.station.whatif_process import Asked, Base, _SupersededError, _Worker, coarse_to_fine
from twin.station.whatif_source import from_recording

TEST_1, TEST_3 = programme("test1"), programme("test3")
FACTS = facts_of(TEST_3)
TEST_3_RECORDING = Path(__file__).parents[1] / "recordings" / "test3" / "recording.rrd"
BAND = [46.0, 49.0, 52.0, 54.0]
GOAL = TuningGoal()


@pytest.fixture(scope="module")
def what_if() -> WhatIf:
    return WhatIf(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)


@pytest.fixture(scope="module")
def as_is(what_if: WhatIf) -> Curves:
    return what_if.curves(BAND)


def moved(curves: Curves) -> list[float]:
    return [p.proposed.displacement_m or 0.0 for p in curves.points if p.proposed is not None]


def test_nothing_proposed_beats_the_limit_or_is_worse_than_passive(as_is: Curves) -> None:
    assert len(moved(as_is)) == len(BAND)
    for p in as_is.points:
        assert p.proposed is not None
        assert p.limit_m is not None
        assert p.proposed.stable
        assert p.limit_m <= (p.proposed.displacement_m or 0.0) * (1.0 + 1e-6) + 1e-12
        assert (p.proposed.displacement_m or 0.0) < p.passive_m


def test_a_proposal_is_the_tuners_own(as_is: Curves) -> None:
    goal = TuningGoal(reach_hz=1e-6)
    tuner = Retuner(TEST_3.true_plant, FACTS, goal)
    table = Changes().table(TEST_3.schedule, BAND)
    for p in as_is.points:
        ((_, point),) = tuner.propose(0, TEST_3.true_plant, 0.05, p.frequency_hz, 4.0, table).points
        assert p.proposed is not None
        assert p.proposed.gains == point.gains
        assert p.limit_m == point.limit_displacement_m


def test_a_tight_budget_is_kept_moves_the_proposal_and_leaves_the_gains_in_use(
    what_if: WhatIf, as_is: Curves
) -> None:
    tight = what_if.curves(BAND, Changes(budget_w=0.2))
    for before, after in zip(as_is.points, tight.points, strict=True):
        assert after.in_use == before.in_use
        assert after.passive_m == before.passive_m
        assert (after.limit_m or 0.0) >= (before.limit_m or 0.0)
        assert after.proposed is not None
        assert after.proposed.powers is not None
        assert after.proposed.powers.joule_mean_w <= 0.2 * 1.001
    assert sum(moved(tight)) > 1.5 * sum(moved(as_is))


SLIDES = [Changes(budget_w=4.0 * 0.8**k) for k in range(1, 11)] + [
    Changes(budget_w=0.5, modulus_margin=0.15 + 0.04 * k) for k in range(6)
]


@pytest.fixture(scope="module")
def followed() -> tuple[WhatIf, list[tuple[Changes, Curves]]]:
    """A slider followed: quick answers only, as a person moves budget and margin without a pause."""
    what_if = WhatIf(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)
    what_if.curves(BAND)
    return what_if, [(changes, what_if.curves(BAND, changes, quick=True)) for changes in SLIDES]


def test_all_that_a_followed_slider_shows_is_verified(
    followed: tuple[WhatIf, list[tuple[Changes, Curves]]],
) -> None:
    shown = 0
    for changes, curves in followed[1]:
        for p in curves.points:
            assert p.provisional
            if p.proposed is None:
                assert p.reason
                continue
            assert p.proposed.gains is not None
            situation = Situation(TEST_3.true_plant, FACTS, p.frequency_hz, 4.0, 0.05, GOAL.drift_hz)
            assert situation.decay_rate_1_s(p.proposed.gains) < -GOAL.slowest_decay_1_s * 0.999
            assert situation.margins(p.proposed.gains).modulus >= changes.goal(GOAL).modulus_margin * 0.999
            found = situation.predictions(p.proposed.gains)
            assert max(q.powers.joule_mean_w for q in found) <= changes.goal(GOAL).budget_w * 1.001
            assert found[0].displacement_m == pytest.approx(p.proposed.displacement_m, rel=1e-9)
            assert (p.limit_m or 0.0) <= found[0].displacement_m * (1.0 + 1e-6) + 1e-12
            shown += 1
    assert shown > 0.9 * len(SLIDES) * len(BAND)


def test_whole_search_confirms_what_a_followed_slider_showed_and_is_not_coloured_by_it(
    followed: tuple[WhatIf, list[tuple[Changes, Curves]]],
) -> None:
    what_if, shown = followed
    fresh = WhatIf(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)
    off = []
    for changes, quick in shown[::3]:
        whole = what_if.curves(BAND, changes)
        assert whole == fresh.curves(BAND, changes)  # to the bit
        assert not any(p.provisional for p in whole.points)
        for a, b in zip(quick.points, whole.points, strict=True):
            if a.proposed is not None and b.proposed is not None:
                off.append(
                    abs((a.proposed.displacement_m or 0.0) - (b.proposed.displacement_m or 0.0)) / b.passive_m
                )
        assert what_if.curves(BAND, changes, quick=True) == whole  # once known it is not asked for again
    assert np.quantile(off, 0.8) < 2e-3


def test_gains_that_a_changed_limit_does_not_bind_are_not_sought_again() -> None:
    situation = Situation(TEST_3.true_plant, FACTS, 49.0, 4.0, 0.05, GOAL.drift_hz)
    demands = Retuner(TEST_3.true_plant, FACTS, GOAL).demands
    found = Found(np.zeros(3), 0.1, 0.0, "modulus margin", {"modulus margin": 0.2}, 3)
    design = Design(TEST_3.schedule.at(49.0), (), found, situation.design_grid)
    start = Start(found.numbers, design, demands)

    def asked(**goal: object) -> Demands:
        return Retuner(TEST_3.true_plant, FACTS, TuningGoal(**goal)).demands  # type: ignore[arg-type]

    assert start.still_holds(asked(budget_w=0.3))
    assert not start.still_holds(asked(modulus_margin=0.2))
    assert not start.still_holds(asked(displacement_m=1e-5))
    assert not Start(found.numbers).still_holds(demands)


def test_another_size_of_excitation_changes_nothing_but_the_sizes() -> None:
    gains = TEST_3.schedule.at(52.0)
    small, large = (Situation(TEST_3.true_plant, FACTS, 52.0, a, 0.05, 0.25) for a in (1.5, 4.0))
    for a, b in zip(large.scaled(1.5).predictions(gains), small.predictions(gains), strict=True):
        assert a.displacement_m == pytest.approx(b.displacement_m, rel=1e-12)
        assert a.powers.electrical_mean_w == pytest.approx(b.powers.electrical_mean_w, rel=1e-12)
        assert a.voltage_peak_v == pytest.approx(b.voltage_peak_v, rel=1e-12)
    assert large.amplitude == 4.0


def test_a_search_that_is_stopped_loses_nothing_of_what_was_found() -> None:
    what_if = WhatIf(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)
    calls = 0

    def go_on() -> None:
        nonlocal calls
        calls += 1
        if calls > 2:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        what_if.curves(BAND, Changes(budget_w=1.0), go_on=go_on)
    fresh = WhatIf(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)
    assert what_if.curves(BAND, Changes(budget_w=1.0)) == fresh.curves(BAND, Changes(budget_w=1.0))


def test_page_gets_all_curves_at_once_then_each_point_confirmed_until_a_newer_question_comes() -> None:
    base = Base(TEST_3.true_plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05)
    asked = Asked("curves", base, Changes(budget_w=0.7), tuple(BAND))
    ours, theirs = multiprocessing.Pipe()
    worker = _Worker(theirs)
    first, *rest = worker.answer(asked)
    assert [p.proposed is not None for p in first.points] == [True] * len(BAND)
    assert sorted(k for k, _ in rest) == list(range(len(BAND)))
    assert not any(p.provisional for _, p in rest)
    ours.send("a newer question")
    parts = worker.answer(Asked("curves", base, Changes(budget_w=0.6), tuple(BAND)))
    assert len(next(parts).points) == len(BAND)
    with pytest.raises(_SupersededError):
        next(parts)


def test_first_curves_do_not_wait_for_a_model_that_moved_on_a_little_and_say_so() -> None:
    absorber = TEST_3.true_plant.absorber
    assert absorber is not None

    def asked(damping_ns_m: float) -> Asked:
        plant = TEST_3.true_plant.with_damping(absorber.name, damping_ns_m)
        return Asked("curves", Base(plant, FACTS, TEST_3.schedule, GOAL, 4.0, 0.05), Changes(), tuple(BAND))

    _ours, theirs = multiprocessing.Pipe()
    worker = _Worker(theirs)
    list(worker.answer(asked(9.0)))
    first, *rest = worker.answer(asked(9.2))
    assert {(p.damping_ns_m, p.provisional) for p in first.points} == {(9.0, True)}
    assert {(p.damping_ns_m, p.provisional) for _, p in rest} == {(9.2, False)}
    assert len(rest) == len(BAND)
    far, *_ = worker.answer(asked(11.0))
    assert {p.damping_ns_m for p in far.points} == {11.0}


def test_coarse_to_fine_is_every_point_once_and_both_ends_first() -> None:
    for n in (1, 2, 5, 11, 16):
        order = coarse_to_fine(n)
        assert sorted(order) == list(range(n))
        assert order[: min(n, 2)] == [0, n - 1][: min(n, 2)]


def test_peak_budget_is_half_the_mean_one(what_if: WhatIf) -> None:
    peak = what_if.curves(BAND[:2], Changes(budget_w=0.4, budget_kind="joule_peak"))
    mean = what_if.curves(BAND[:2], Changes(budget_w=0.2))
    for a, b in zip(peak.points, mean.points, strict=True):
        assert a.limit_m == pytest.approx(b.limit_m, rel=1e-6)


def test_a_price_on_power_buys_less_of_it(what_if: WhatIf, as_is: Curves) -> None:
    dear = what_if.curves(BAND, Changes(power_price_um_w=200.0))
    spent = [
        (d.proposed.powers.joule_mean_w, c.proposed.powers.joule_mean_w)
        for c, d in zip(as_is.points, dear.points, strict=True)
        if c.proposed and c.proposed.powers and d.proposed and d.proposed.powers
    ]
    assert len(spent) == len(BAND)
    assert sum(d for d, _ in spent) < 0.8 * sum(c for _, c in spent)
    assert [p.limit_m for p in dear.points] == pytest.approx([p.limit_m for p in as_is.points])


def test_more_excitation_scales_every_linear_line(what_if: WhatIf, as_is: Curves) -> None:
    half = what_if.curves(BAND, Changes(excitation=2.0), propose=False)
    for a, b in zip(as_is.points, half.points, strict=True):
        assert b.passive_m == pytest.approx(0.5 * a.passive_m)
        assert b.in_use.displacement_m == pytest.approx(0.5 * (a.in_use.displacement_m or 0.0))
        assert b.proposed is None


def test_coils_resistance_costs_power_and_hardly_moves_what_a_current_loop_drives(
    what_if: WhatIf, as_is: Curves
) -> None:
    hot = what_if.curves(BAND, Changes(resistance_ohm=5.4), propose=False)
    for a, b in zip(as_is.points, hot.points, strict=True):
        assert a.in_use.powers is not None
        assert b.in_use.powers is not None
        assert b.in_use.powers.joule_mean_w == pytest.approx(2.0 * a.in_use.powers.joule_mean_w, rel=0.1)


def test_another_presets_coil_brings_its_constants() -> None:
    changes = parse_changes(["coil=engine_vcm"], coil_of)
    plant = changes.plant(TEST_3.plant)
    assert plant.voice_coil is not None
    assert (plant.voice_coil.resistance_ohm, plant.voice_coil.force_constant_n_a) == (3.0, 22.2)
    assert plant.voice_coil.name == "vcm"
    assert plant.limits == TEST_3.plant.limits


def test_control_is_off_outside_its_window(what_if: WhatIf) -> None:
    narrow = what_if.curves(BAND, Changes(on_from_hz=48.0, on_to_hz=53.0))
    for p in narrow.points:
        acts = 48.0 <= p.frequency_hz <= 53.0
        assert (p.in_use.gains is not None) == acts
        if not acts:
            assert p.in_use.displacement_m == pytest.approx(p.passive_m)


def test_damping_may_be_given_or_scaled(what_if: WhatIf, as_is: Curves) -> None:
    scaled = what_if.curves(BAND, Changes(damping_scale=0.5), propose=False)
    fixed = what_if.curves(BAND, Changes(damping_ns_m=7.0), propose=False)
    for a, b, c in zip(as_is.points, scaled.points, fixed.points, strict=True):
        assert b.damping_ns_m == pytest.approx(0.5 * a.damping_ns_m)
        assert c.damping_ns_m == 7.0


def test_gains_of_test_1_show_as_unstable_from_52_hz() -> None:
    curves = WhatIf(TEST_1.true_plant, FACTS, TEST_1.schedule, GOAL, 4.0).curves(
        [51.0, 52.0, 55.0], propose=False
    )
    assert [p.in_use.stable for p in curves.points] == [True, False, False]
    assert curves.points[1].in_use.growth_1_s == pytest.approx(1.18, abs=0.02)
    assert curves.points[2].in_use.growth_1_s == pytest.approx(14.35, abs=0.05)
    assert curves.points[1].in_use.displacement_m is None


def test_instability_is_bracketed_and_explained_by_damping_taken_away() -> None:
    watch = StabilityWatch(FACTS)
    found = watch.look(TEST_1.true_plant, TEST_1.schedule, 51.8, 52.6)
    assert found is not None
    assert watch.growth_1_s(TEST_1.true_plant, TEST_1.schedule, found.from_hz) > 0.0
    assert watch.growth_1_s(TEST_1.true_plant, TEST_1.schedule, found.from_hz - 0.02) < 0.0
    assert (found.to_hz, found.worst_hz) == (55.0, 55.0)
    # The low-pass's lag at 55 Hz is that of the facts, and gamma sin(lag)/w what it takes besides beta.
    lag = np.radians(22.82 + 360.0 * 55.0 * 20e-6 - 2 * 1.473)
    gamma = TEST_1.schedule.at(55.0).gamma_n_m
    taken = gamma * np.sin(lag) / (2.0 * np.pi * 55.0) + 14.0 * np.cos(lag - np.radians(1.473))
    assert -found.law_damping_ns_m == pytest.approx(taken, rel=0.05)
    assert found.law_damping_ns_m + found.damping_ns_m < 0.0
    assert watch.look(TEST_1.true_plant, TEST_1.schedule, 46.0, 49.0) is None
    assert watch.look(TEST_3.true_plant, TEST_3.schedule, 45.0, 55.0) is None


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        (["bogus=2"], r"there is no 'bogus'; known: budget_w \[W\]"),
        (["budget_w"], "write KEY=VALUE"),
        (["budget_w=ten"], "'ten' is no number in W"),
        (["budget_w=1", "budget_w=2"], "given twice"),
        (["budget_w=-1"], "budget_w must be greater than 0 W"),
        (["budget_w=nan"], "budget_w must be greater than 0 W"),
        (["budget_kind=peak"], "must be one of joule_mean, joule_peak"),
        (["modulus_margin=1.5"], "below 1"),
        (["damping_ns_m=3", "damping_scale=2"], "either"),
        (["coil=rig_no_vcm"], "has no voice coil"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_with_what_can(settings: list[str], complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        parse_changes(settings, coil_of)


def test_every_key_is_a_change_and_has_a_meaning() -> None:
    values = {k: "joule_mean" if k == "budget_kind" else "0.5" for k in KEYS if k != "damping_scale"}
    changes = parse_changes([f"{k}={v}" for k, v in values.items()])
    assert all(getattr(changes, k) is not None for k in values)
    assert all(meaning for _, meaning in KEYS.values())


def test_noise_over_several_samples_is_that_of_each_in_turn() -> None:
    rng = np.random.default_rng(0)
    A, Q = 0.4 * rng.normal(size=(4, 4)), np.diag(rng.uniform(size=4))
    for samples in (1, 2, 3, 7, 50):
        whole, noise = np.eye(4), np.zeros((4, 4))
        for _ in range(samples):
            whole, noise = A @ whole, A @ noise @ A.T + Q
        quick = _over(A, Q, samples)
        np.testing.assert_allclose(quick[0], whole, atol=1e-14)
        np.testing.assert_allclose(quick[1], noise, rtol=1e-12, atol=1e-15)


@pytest.fixture(scope="module")
def running() -> tuple[object, list[Frame], np.ndarray]:
    """A rig that sweeps under control, its twin's last frames, and the primary's true motion in the second after."""
    run = demo_programme(20.0, 7)
    rig = SimulatedRig(run, keep_truth=True)
    twin = session_for(run, rig.channels, GOAL)
    frames: list[Frame] = []
    while rig.next_sample < 650_000:
        first = rig.next_sample
        values, on, answers = rig.next_block()
        applied = tuple(a.command_id for a in answers)
        block = make_block(first, 50_000.0, values, rig.channels, control_on=on, commands_applied=applied)
        frames.append(twin.advance(block))
        if (command := frames[-1].command) is not None and rig.next_sample < 600_000:
            rig.accept(command)
    truth = []
    for _ in range(10):
        rig.next_block()
        truth += [part.states[1:, part.model.states.index("x_table")] for part in rig.truth]
    return twin, frames, np.concatenate(truth)[49::50]


def test_branch_comes_true_within_its_own_standard_deviation(running) -> None:  # type: ignore[no-untyped-def]
    twin, frames, truth = running
    plant = twin.identified_plant()
    instant = instant_at(plant, FACTS, frames[-10:])
    assert instant.rate_hz_s == pytest.approx(1.0, abs=0.02)
    brancher = Brancher(plant, FACTS, instant, twin.damping_std_at(instant.frequency_hz))
    in_use = brancher.run("in use", twin.schedule, 1.0)
    error = in_use.displacement_m - truth
    ratio = np.sqrt(np.mean((error / in_use.displacement_std_m) ** 2))
    assert 0.2 < ratio < 2.0
    off = brancher.run("passive", None, 1.0)
    assert np.std(off.displacement_m) > 5.0 * np.std(in_use.displacement_m)
    assert (
        off.joule_mean_w < 0.2 * in_use.joule_mean_w
    )  # the open loop still carries what it induces, no more


def test_branch_settles_to_the_curves_steady_state(running) -> None:  # type: ignore[no-untyped-def]
    twin, frames, _ = running
    plant = twin.identified_plant()
    instant = instant_at(plant, FACTS, frames[-10:])
    still = type(instant)(**{n: getattr(instant, n) for n in instant.__slots__} | {"rate_hz_s": 0.0})
    trace = Brancher(plant, FACTS, still).run("passive", None, 4.0)
    curves = WhatIf(plant, FACTS, twin.schedule, GOAL, abs(still.drive)).curves(
        [still.frequency_hz], propose=False
    )
    # The table's own mode at 11 Hz rings on; the excitation's share is told from it by projection.
    late = trace.displacement_m[-1000:]
    wave = np.exp(-2j * np.pi * still.frequency_hz * trace.time_s[-1000:])
    amplitude = 2.0 * abs(np.mean(late * wave * np.hanning(1000))) / np.mean(np.hanning(1000))
    assert amplitude == pytest.approx(curves.points[0].passive_m, rel=0.02)


def test_branch_without_excitation_is_refused(running) -> None:  # type: ignore[no-untyped-def]
    twin, frames, _ = running
    silent = dataclasses.replace(frames[-1], phasors=None)
    with pytest.raises(InputError, match="no excitation is tracked"):
        instant_at(twin.plant, FACTS, [silent])


def test_command_answers_for_a_plant_and_for_an_instant_of_a_recording(tmp_path: Path) -> None:
    done = atmd(
        "whatif", "--plant", "rig", "--set", "budget_w=1", "--band", "47,53", "--json", "-",
        "--plot", "w.png", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [p["frequency_hz"] for p in result["points"]] == [47.0, 53.0]
    assert result["points"][0]["proposed"]["joule_mean_w"] <= 1.001
    assert (tmp_path / "w.png").stat().st_size > 10_000
    done = atmd(
        "whatif", str(TEST_3_RECORDING), "--at", "2.5", "--band", "50:53:1", "--json", "-", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    branches = {b["name"]: b for b in json.loads(done.stdout)["branches"]}
    assert set(branches) == {"passive", "in use", "proposed"}
    assert branches["in use"]["off_measured_rms_m"] < 0.5 * branches["passive"]["off_measured_rms_m"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (WhatIfOptions(plant="rig", settings=("bogus=1",)), "there is no 'bogus'"),
        (WhatIfOptions(), "give either a FILE"),
        (WhatIfOptions(plant="rig", at_s=3.0), "has no instants"),
        (WhatIfOptions(plant="rig_no_vcm"), "no voice coil"),
        (WhatIfOptions(plant="rig", band="x"), "--band x"),
        (WhatIfOptions(plant="rig", band="50,49"), "must rise"),
        (WhatIfOptions(file=Path("no.npz")), "needs a recording of this program"),
        (WhatIfOptions(file=TEST_3_RECORDING, at_s=9.0), "lasts from 0 to 4 s"),
        (WhatIfOptions(plant="rig", settings=("gamma_n_m=x",)), "no number in N/m"),
        (WhatIfOptions(plant="rig", settings=("beta_ns_m=-7@0",)), "above 0 Hz"),
        (WhatIfOptions(plant="rig", settings=("beta_ns_m=-7@48", "beta_ns_m=-8@48")), "given twice"),
        (WhatIfOptions(plant="rig", settings=("alpha_kg=0", "on_to_hz=70")), "add points or narrow the band"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_the_remedy(options: WhatIfOptions, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        run_whatif(options, lambda _: None)


def test_gains_of_ones_own_are_laid_beside_those_in_use() -> None:
    """What the rig has already, given by hand, is what the rig has; a point of its own changes that point."""
    known = from_recording(TEST_3_RECORDING, 2.5)
    used = known.schedule.at(known.schedule.frequency_hz[3])
    here = known.schedule.frequency_hz[3]
    same = tuple(f"{key}={getattr(used, key)}@{here}" for key in ("alpha_kg", "beta_ns_m", "gamma_n_m"))
    options = WhatIfOptions(file=TEST_3_RECORDING, at_s=2.5, band=f"{here:g}", settings=same, branch_s=0.5)
    result = run_whatif(options, lambda _: None)
    (point,), branches = result["points"], {b["name"]: b for b in result["branches"]}
    assert point["given"] == point["in_use"]
    assert branches["given"]["displacement_m"] == branches["in use"]["displacement_m"]
    given, others = split_given(["gamma_n_m=-3000@48.3", "low_pass_hz=500", "beta_ns_m=-9"])
    assert given is not None
    assert others == ("low_pass_hz=500",)
    table = given.schedule(known.schedule, parse_changes(others))
    assert table.at(48.3).gamma_n_m == -3000.0
    assert table.at(here) == dataclasses.replace(used, beta_ns_m=-9.0, low_pass_hz=500.0)


def test_a_branch_goes_on_with_other_parameters_from_the_same_start() -> None:
    """At first nothing differs but what the force does; a heavier absorber then answers more slowly."""
    traces = {}
    for settings in ((), ("absorber_mass_kg=0.5",), ("resistance_ohm=3.5",), ("excitation=8",)):
        options = WhatIfOptions(file=TEST_3_RECORDING, at_s=2.5, band="50", settings=settings, branch_s=0.5)
        found = run_whatif(options, lambda _: None)["branches"]
        traces[settings] = {b["name"]: np.array(b["displacement_m"]) for b in found}
    plain = traces[()]["in use"]
    size = float(np.abs(traces[()]["passive"]).max())
    for settings, changed in traces.items():
        assert abs(changed["in use"][0] - plain[0]) < 0.1 * size
        assert settings == () or np.abs(changed["in use"] - plain).max() > 1e-9
    ratio = np.std(traces[("excitation=8",)]["passive"][-200:]) / np.std(traces[()]["passive"][-200:])
    assert 1.5 < ratio < 2.5


def test_command_ends_with_2_for_a_key_that_does_not_exist(tmp_path: Path) -> None:
    done = atmd("whatif", "--plant", "rig", "--set", "bogus=1", cwd=tmp_path)
    assert done.returncode == 2
    assert "there is no 'bogus'" in " ".join(done.stderr.split())
