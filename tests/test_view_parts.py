"""What the view draws is true: spectra by closed forms, instants that were, springs that hold on to their bodies."""

import math

import numpy as np
import pytest
import rerun as rr
from frames import RATE, channels, frames
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import trees

from tuning.types import Powers
from twin.plant.config import GROUND, Plant
from twin.plant.files import load_plant
from twin.station.alarms import POWER_BLOCKS, AlarmWatch
from twin.station.frame import Performance
from twin.station.view.drawing import draw
from twin.station.view.groups import groups_of, spectrum_column
from twin.station.view.scales import FollowingScale, in_words, rounded_up, ticks
from twin.station.view.spectrum import SlidingSpectrum, Waterfall
from twin.station.view.stroboscope import PICTURES_HZ, SEEN_HZ, Stroboscope, slower_by


def spectrum_of(signal: np.ndarray, rate: float, top_hz: float, pieces: list[int]) -> SlidingSpectrum:
    spectrum = SlidingSpectrum(rate, top_hz, 1)
    for part in np.split(signal[:, None], np.cumsum(pieces)):
        if len(part):
            spectrum.add(part)
    return spectrum


def test_a_sine_stands_at_its_frequency_with_its_amplitude() -> None:
    t = np.arange(150_000) / RATE
    signal = 30.0 * np.sin(2 * np.pi * 53.0 * t) + 0.02 * np.sin(2 * np.pi * 159.0 * t + 1.0) + 0.5
    spectrum = spectrum_of(signal, RATE, 250.0, [5_000] * 30)
    lines = spectrum.amplitudes()
    assert lines is not None
    assert spectrum.frequency_hz[1] == pytest.approx(1.0, rel=5e-3)
    nearest = {f: int(np.argmin(np.abs(spectrum.frequency_hz - f))) for f in (0.0, 53.0, 159.0)}
    assert lines[nearest[0.0], 0] == pytest.approx(0.5, rel=2e-2)
    assert lines[nearest[53.0], 0] == pytest.approx(30.0, rel=2e-2)
    assert lines[nearest[159.0], 0] == pytest.approx(0.02, rel=5e-2)


def test_what_lies_above_the_top_does_not_fold_back_below_it() -> None:
    t = np.arange(100_000) / RATE
    for hz in (400.0, 590.0, 1000.0, 3170.0):
        lines = spectrum_of(np.sin(2 * np.pi * hz * t), RATE, 250.0, [5_000] * 20).amplitudes()
        assert lines is not None
        assert np.max(lines) < 3e-3


@settings(max_examples=15, deadline=None)
@given(st.lists(st.integers(1, 7_000), min_size=12, max_size=30))
def test_a_spectrum_does_not_depend_on_how_the_samples_come(pieces: list[int]) -> None:
    rng = np.random.default_rng(1)
    signal = rng.standard_normal(60_000)
    pieces = [*pieces, *([1_000] * 60)]
    once = spectrum_of(signal, RATE, 250.0, []).amplitudes()
    often = spectrum_of(signal, RATE, 250.0, [p for k, p in enumerate(pieces) if sum(pieces[:k]) < 59_000])
    assert once is not None
    assert np.allclose(often.amplitudes(), once, atol=1e-12)


def test_a_window_with_a_hole_has_no_spectrum_until_the_hole_has_left_it() -> None:
    signal = np.ones(200_000)
    signal[60_000:65_000] = np.nan
    spectrum = SlidingSpectrum(RATE, 250.0, 1)
    known = []
    for k in range(40):
        spectrum.add(signal[5_000 * k : 5_000 * (k + 1), None])
        known.append(spectrum.amplitudes() is not None)
    assert known == [False] * 9 + [True] * 3 + [False] * 10 + [True] * 18


def test_a_waterfall_of_the_whole_run_keeps_every_peak_and_a_rolling_one_the_last() -> None:
    whole, rolling = Waterfall(10, 4, 1.0, whole=True), Waterfall(10, 4, 1.0, whole=False)
    for k in range(37):
        row = np.zeros(4)
        row[k % 4] = 100.0 + k
        whole.add(float(k), row)
        rolling.add(float(k), row)
    assert whole.row_s == 4.0
    assert whole.length_s >= 36.0
    assert not np.isnan(whole.image()).any()
    assert np.nanmax(whole.image()[-1]) == 103.0  # the oldest four rows are one
    assert [np.max(r) for r in rolling.image()] == [136.0 - k for k in range(10)]


@pytest.mark.parametrize("hz", [8.2, 24.0, 50.0, 57.3, 180.0])
def test_the_stroboscope_shows_true_instants_that_seem_slow(hz: float) -> None:
    strobe, times, block_s = Stroboscope(), [], 0.1
    for k in range(200):
        found = strobe.flashes(k * block_s, (k + 1) * block_s, hz)
        assert ((found >= k * block_s) & (found < (k + 1) * block_s)).all()
        times.extend(found.tolist())
    steps = np.diff(times)
    assert np.max(steps) < 1.1 / min(hz, PICTURES_HZ / 2)
    assert len(times) / 20.0 <= PICTURES_HZ
    assert np.allclose(
        np.sin(2 * np.pi * hz * np.array(times)), np.sin(2 * np.pi * SEEN_HZ * np.array(times)), atol=1e-6
    )
    assert slower_by(hz) == pytest.approx(hz / SEEN_HZ)


def test_slow_motion_is_not_slowed_and_a_gap_in_the_data_not_caught_up_on() -> None:
    strobe = Stroboscope()
    assert np.allclose(np.diff(strobe.flashes(0.0, 1.0, 2.0)), 1.0 / PICTURES_HZ)
    assert slower_by(2.0) == slower_by(None) == 1.0
    after = strobe.flashes(500.0, 500.1, 50.0)
    assert after[0] == 500.0
    assert len(after) == 3


@settings(max_examples=60, deadline=None)
@given(trees())
def test_bodies_of_any_plant_have_a_place_of_their_own_beside_what_carries_them(plant: Plant) -> None:
    drawing = draw(plant)
    places = list(drawing.places.values())
    assert [p.name for p in places] == [b.name for b in plant.body]
    for k, one in enumerate(places):
        left, right = drawing.link(one.name)
        assert right - left >= 40.0
        assert left == (0.0 if one.parent == GROUND else drawing.right_of(one.parent))
        for other in places[:k]:
            apart_x = abs(one.x - other.x) - 0.5 * (one.width + other.width)
            apart_y = abs(one.y - other.y) - 0.5 * (one.height + other.height)
            assert max(apart_x, apart_y) > 0.0
    (x_low, x_high), (y_low, y_high) = drawing.bounds
    for p in places:
        assert x_low < p.left
        assert p.x + 0.5 * p.width < x_high
        assert y_low < p.y - 0.5 * p.height
        assert p.y + 0.5 * p.height < y_high


def test_everything_moves_with_the_estimate_and_springs_hold_on(tmp_path) -> None:
    from test_rerun_view import a_view, read_back

    plant, path = load_plant("rig"), tmp_path / "motion.rrd"
    stream = rr.RecordingStream("test")
    stream.save(path)
    view = a_view(stream, plant)
    made = list(frames(plant, 1.0))
    for frame in made:
        view.show(frame)
    view.send()
    stream.disconnect()
    rows = read_back(path)
    drawing = draw(plant)
    times, _ = rows["/schematic/body/absorber", "Transform3D:translation"]
    assert 20 <= len(times) <= PICTURES_HZ + 1
    samples = np.round(times * RATE).astype(int)
    x = {
        n: np.concatenate([f.estimate.mean[:, k] for f in made])[samples]
        for k, n in enumerate(("table", "absorber"))
    }
    moved = {
        n: np.array([c[0][0] for c in rows[f"/schematic/body/{n}", "Transform3D:translation"][1]]) for n in x
    }
    scale = (moved["absorber"] - drawing.places["absorber"].x) / x["absorber"]
    assert np.ptp(scale[-10:]) < 1e-3 * scale[-1]  # one scale for all bodies, round in itself
    assert np.allclose(moved["table"] - drawing.places["table"].x, scale * x["table"], atol=1e-4)
    assert rounded_up(10.0 / scale[-1]) == pytest.approx(10.0 / scale[-1], rel=1e-3)
    left, right = drawing.link("absorber")
    start = np.array([c[0][0] for c in rows["/schematic/spring/absorber", "Transform3D:translation"][1]])
    stretch = np.array([c[0][0] for c in rows["/schematic/spring/absorber", "Transform3D:scale"][1]])
    assert np.allclose(start, left + moved["table"] - drawing.places["table"].x, atol=1e-4)
    assert np.allclose(
        start + stretch * (right - left), right + moved["absorber"] - drawing.places["absorber"].x, atol=1e-3
    )
    _, arrows = rows["/schematic/force", "Arrows2D:vectors"]
    on_table, on_absorber, shaker = np.array(arrows)[:, :, 0].T
    assert np.allclose(on_table, -on_absorber)
    current = np.concatenate([f.estimate.mean[:, 5] for f in made])[samples]
    assert np.corrcoef(shaker, current)[0, 1] == pytest.approx(1.0, abs=1e-3)
    _, texts = rows["/schematic/figures", "Points2D:labels"]
    said = " | ".join(texts[-1])
    for part in ("bar ", "ruler ±", "× slower", " N"):
        assert part in said


def test_scales_are_round_hold_their_values_and_do_not_twitch() -> None:
    scale = FollowingScale(1e-6)
    changes = [scale.follow(v) for v in (0.7, 0.9, 1.01, 1.9, 1.2, 0.7)]
    assert changes == [True, False, True, False, False, False]
    assert scale.full == 2.0
    assert not any(scale.follow(0.1) for _ in range(19))
    assert scale.follow(0.1)
    assert scale.full == 0.2
    assert not scale.follow(math.nan)
    assert np.allclose(ticks(-3.0, 11.0, 5), [-2.0, 0.0, 2.0, 4.0, 6.0, 8.0, 10.0])
    assert [in_words(v, "m") for v in (0.0, 1.23456e-6, 0.0999, 1234.0, -2e-3, 999.96)] == [
        "0 m", "1.23 µm", "99.9 mm", "1.23 km", "-2 mm", "1 km",
    ]  # fmt: skip


def test_alarms_are_for_lasting_power_and_for_current_at_its_limit_at_once() -> None:
    plant = load_plant("rig")
    watch = AlarmWatch(plant)

    def block(watts: float, ampere: float = 1.0) -> Performance:
        return Performance(1e-6, 1e-5, 1e-6, ampere, Powers(watts, 2 * watts, watts), 4.0)

    assert watch.take(block(4.0)) == ("none", "")
    states = [watch.take(block(8.0))[0] for _ in range(POWER_BLOCKS)]
    assert states[0] == "over budget"  # the mean of 4 and 8 W is
    assert watch.take(block(1.0, 1.99)) == ("at a limit", "vcm: 1.99 A, limit 2 A")
    assert watch.take(None) == ("none", "")
    assert watch.take(block(4.5)) == ("none", "")


def test_every_channel_has_one_plot_and_no_plot_mixes_units() -> None:
    for name in ("rig", "engine_vcm", "beam", "engine", "shaker_v721"):
        plant = load_plant(name)
        named = channels(plant)
        groups = groups_of(plant, named)
        assert sorted(c for g in groups for c in g.channels) == list(range(len(named)))
        for group in groups:
            assert len({named[c].unit for c in group.channels}) == 1
        first = spectrum_column(plant, named)
        assert first is None or groups[0].channels == [first]
