"""Consistency: each statistic leaves its band as often as stated, errors are traced to their sensor, signals judged."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats
from scipy.signal import lfilter

from estimators.consistency import (
    FadingStatistics,
    Statistics,
    bias_band,
    independent_samples,
    nis_band,
    statistics_of,
    whiteness_band,
)
from estimators.health import HealthMonitor
from estimators.isolation import innovation_signatures, suspect_of_excess, suspect_of_offset
from estimators.observer import Observer
from estimators.signal_check import SignalCheck
from estimators.types import StateEstimate
from tests.faults import WrongModel
from tuning.retune import TuningGoal
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.plant.linear import Array
from twin.rig.foreign import open_foreign
from twin.rig.simulated import SimulatedRig
from twin.station.demo import demo_programme, session_for

RATE_HZ = 50_000.0
SENSORS = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current")


# --- statistics -------------------------------------------------------------------------------------------


def inside(outside: Array, level: float) -> None:
    """A share of failures is the stated one, as far as so many trials can tell (five standard deviations)."""
    n = outside.size
    assert abs(outside.mean() - level) < 5.0 * math.sqrt(level * (1.0 - level) / n)


@functools.cache
def white(n: int, trials: int = 20_000) -> Array:
    return np.random.default_rng(n).standard_normal((trials, n))


@pytest.mark.parametrize("level", [0.05, 0.01])
@pytest.mark.parametrize("n", [10, 60, 400])
def test_nis_of_white_innovations_leaves_its_band_as_often_as_stated(n: int, level: float) -> None:
    nis = np.mean(white(n) ** 2, axis=1)
    low, high = nis_band(n, level)
    inside(nis < low, level / 2.0)
    inside(nis > high, level / 2.0)


@pytest.mark.parametrize("level", [0.05, 0.01])
@pytest.mark.parametrize("n", [10, 60, 400])
def test_mean_of_white_innovations_leaves_its_band_as_often_as_stated(n: int, level: float) -> None:
    inside(np.abs(np.mean(white(n), axis=1)) > bias_band(n, level), level)


@pytest.mark.parametrize("level", [0.05, 0.01])
@pytest.mark.parametrize("n", [400, 2000])
def test_autocorrelation_of_white_innovations_leaves_its_band_as_often_as_stated(
    n: int, level: float
) -> None:
    e = white(n, 20_000 if n == 400 else 6_000)
    e = e - e.mean(axis=1, keepdims=True)
    lag1 = np.sum(e[:, 1:] * e[:, :-1], axis=1) / np.sum(e**2, axis=1)
    # The estimate's own bias of -1/n is a fiftieth to a twentieth of its standard deviation.
    outside = np.mean(np.abs(lag1) > whiteness_band(n - 1, level))
    assert outside == pytest.approx(level, rel=0.15)


@pytest.mark.parametrize("rho", [0.3, 0.5, -0.4])
def test_correlated_innovations_leave_bands_of_their_independent_number_as_often_as_stated(
    rho: float,
) -> None:
    n, level = 1000, 0.05
    # An autoregression of variance 1, from its stationary state on.
    e = lfilter(
        [math.sqrt(1.0 - rho**2)], [1.0, -rho], np.random.default_rng(3).standard_normal((6000, n + 100))
    )
    e = e[:, 100:]
    for squares, statistic in ((True, np.mean(e**2, axis=1)), (False, np.mean(e, axis=1))):
        count = independent_samples(float(n), rho, squares)
        if squares:
            low, high = nis_band(count, level)
            outside = np.mean((statistic < low) | (statistic > high))
        else:
            outside = np.mean(np.abs(statistic) > bias_band(count, level))
        # Negative correlation makes a mean surer than taken: that band may be left less often, never more.
        assert outside < 1.25 * level
        if squares or rho > 0.0:
            assert outside > 0.75 * level


@pytest.mark.parametrize(("count", "level"), [(1.0, 0.05), (10.0, 1e-7), (99.0, 0.01)])
def test_nis_band_is_the_chi_square_quantile(count: float, level: float) -> None:
    expected = stats.chi2.ppf([level / 2.0, 1.0 - level / 2.0], count) / count
    np.testing.assert_allclose(nis_band(count, level), expected, rtol=1e-6)


def test_large_counts_are_rounded_without_moving_the_band_noticeably() -> None:
    low, high = nis_band(20_049.0, 0.05)
    expected = stats.chi2.ppf([0.025, 0.975], 20_049.0) / 20_049.0
    np.testing.assert_allclose([low - 1.0, high - 1.0], expected - 1.0, rtol=3e-3)


def test_fading_memory_is_as_certain_as_it_says() -> None:
    rng = np.random.default_rng(8)
    memory, ends = FadingStatistics(2000), []
    for _ in range(60):
        e = rng.standard_normal((20, 2000))
        count = np.full((3, 2000), 20.0)
        memory.add(Statistics(count, np.vstack([np.mean(e**2, 0), np.mean(e, 0), np.zeros(2000)])), 0.9)
    s = memory.statistics()
    assert np.allclose(s.samples, 20.0 * 1.9 / 0.1, rtol=2e-2)  # n (1 + f) / (1 - f) in the long run
    ends = np.abs(s.value[1]) > bias_band(float(s.samples[1, 0]), 0.05)
    inside(ends, 0.05)
    assert np.std(s.value[0]) == pytest.approx(math.sqrt(2.0 / s.samples[0, 0]), rel=0.1)


# --- the verdict ------------------------------------------------------------------------------------------


@functools.cache
def rig_observer() -> tuple[Observer, StateEstimate, tuple[Channel, ...]]:
    programme = demo_programme(1.0, 3)
    rig = SimulatedRig(programme)
    observer = Observer(programme.plant, tuple(c.name for c in rig.channels), RATE_HZ, frequency_hz=50.0)
    estimate = observer.advance(make_block(0, RATE_HZ, rig.next_block()[0], rig.channels))
    return observer, estimate, rig.channels


def estimate_of(e: Array) -> StateEstimate:
    """Estimate whose normalised innovations were (n, 4) ``e``."""
    _, template, _ = rig_observer()
    n = len(e)
    centred = e - e.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        lag1 = np.sum(centred[1:] * centred[:-1], axis=0) / np.sum(centred**2, axis=0)
    return dataclasses.replace(
        template,
        nis=float(np.mean(e**2)),
        nis_per_sensor=np.mean(e**2, axis=0),
        innovation_mean=np.mean(e, axis=0) * template.innovation_std,
        innovation_lag1=lag1,
        innovation_count=np.full(4, float(n)),
    )


def watch(e: Array, n: int, rate_hz: float) -> list[str]:
    """Verdicts over normalised innovations cut into blocks of n."""
    observer, _, channels = rig_observer()
    monitor, verdicts = HealthMonitor(channels), []
    empty = np.zeros((n, len(channels)))
    for first in range(0, len(e), n):
        block = Block(first, rate_hz, empty, np.ones_like(empty, dtype=np.bool_), channels)
        health = monitor.advance(block, estimate_of(e[first : first + n]), (), observer, 50.0)
        verdicts.append(health.verdict)
    return verdicts


@pytest.mark.parametrize(("n", "rate_hz", "blocks"), [(10, 100.0, 6000), (500, 5000.0, 2000)])
def test_white_innovations_are_consistent_for_minutes_in_blocks_of_any_size(
    n: int, rate_hz: float, blocks: int
) -> None:
    e = np.random.default_rng(n).standard_normal((n * blocks, 4))
    assert set(watch(e, n, rate_hz)) == {"consistent"}


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda e: 1.6 * e, "diverged"),
        (lambda e: 1.25 * e, "drifting"),
        (lambda e: 0.5 * e, "drifting"),
        (lambda e: e + 0.3, "drifting"),
        (lambda e: e + 1.0, "diverged"),
        (lambda e: lfilter([0.8], [1.0, -0.6], e, axis=0), "drifting"),
    ],
    ids=["much too strong", "too strong", "too weak", "biased", "much biased", "coloured"],
)
def test_each_departure_has_its_verdict(change: object, verdict: str) -> None:
    e = np.random.default_rng(2).standard_normal((500 * 60, 4))
    e[500 * 20 :, 1] = change(e[500 * 20 :, 1])  # type: ignore[operator]
    verdicts = watch(e, 500, 5000.0)
    assert set(verdicts[:20]) == {"consistent"}
    assert verdicts[30] == verdict


def test_a_slow_drift_is_seen_in_data_too_sparse_for_a_single_block_to_tell() -> None:
    # 10 samples a block: chance alone carries a block's mean to 1.7; the memory sees half of that.
    e = np.random.default_rng(4).standard_normal((10 * 400, 4))
    e[10 * 200 :, 2] += 0.85
    verdicts = watch(e, 10, 100.0)
    assert set(verdicts[:200]) == {"consistent"}
    assert verdicts[230] != "consistent"


@pytest.mark.parametrize("seed", [11])
def test_a_minute_of_a_consistent_rig_raises_no_alarm(seed: int) -> None:
    # Damping learned from 7 Ns/m to about 14, gains retuned, control on and off: all in order.
    programme = demo_programme(60.0, seed)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    while not rig.finished:
        first = rig.next_sample
        values, on, answers = rig.next_block()
        applied = tuple(a.command_id for a in answers)
        frame = session.advance(
            make_block(first, RATE_HZ, values, rig.channels, control_on=on, commands_applied=applied)
        )
        if frame.command is not None:
            rig.accept(frame.command)
        assert frame.health.verdict == "consistent", frame.health.reason
        assert not frame.checked.findings


@settings(max_examples=150, deadline=None)
@given(
    numbers=arrays(np.float64, (4, 4), elements=st.floats(allow_nan=True, allow_infinity=True)),
    counts=arrays(np.float64, 4, elements=st.sampled_from([0.0, 1.0, 2.0, 10.0, 5000.0])),
)
def test_whatever_the_innovations_the_verdict_is_one_and_says_why(numbers: Array, counts: Array) -> None:
    observer, template, channels = rig_observer()
    estimate = dataclasses.replace(
        template,
        innovation_count=counts,
        nis_per_sensor=np.abs(numbers[0]),
        innovation_mean=numbers[1],
        innovation_lag1=np.clip(numbers[2], -1.0, 1.0),
        innovation_std=np.abs(numbers[3]),
    )
    monitor = HealthMonitor(channels)
    empty = np.zeros((10, len(channels)))
    block = Block(0, RATE_HZ, empty, np.ones_like(empty, dtype=np.bool_), channels)
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(3):
            health = monitor.advance(block, estimate, (), observer, 50.0)
            assert (health.verdict == "consistent") == (not health.reason) == (not health.channel)
            memory = statistics_of(estimate)
            assert np.isfinite(memory.samples).all()
    healthy = monitor.advance(block, estimate_of(white(10, 40)[:, :4]), (), observer, 50.0)
    assert math.isfinite(healthy.bias)


# --- isolation --------------------------------------------------------------------------------------------


def filtered_response(observer: Observer, error: Array) -> Array:
    """Normalised innovations that errors (n, p) of the sensors alone cause, sample by sample."""
    kf = observer.filter
    R = np.asarray(kf.R)
    K = observer.steady_covariance @ kf.H.T @ np.linalg.inv(R)
    prior = kf.F @ observer.steady_covariance @ kf.F.T + kf.Q
    root = np.linalg.cholesky(kf.H @ prior @ kf.H.T + R)
    x, out = np.zeros(len(kf.F)), np.empty_like(error)
    for k, f in enumerate(error):
        e = f - kf.H @ kf.F @ x
        x = kf.F @ x + K @ e
        out[k] = np.linalg.solve(root, e)
    return out


def test_signatures_are_the_filters_response_to_errors_of_its_sensors() -> None:
    observer, _, _ = rig_observer()
    hz, n = 500.0, 12_000
    std = np.sqrt(np.diag(observer.filter.R))
    turns = np.exp(2j * np.pi * hz * np.arange(n) / RATE_HZ)
    expected = innovation_signatures(observer, hz)
    for sensor in range(4):
        error = np.zeros((n, 4))
        error[:, sensor] = std[sensor] * turns.real
        last = slice(n - 1000, n)  # ten periods
        got = 2.0 * np.mean(filtered_response(observer, error)[last] * turns[last].conj()[:, None], axis=0)
        np.testing.assert_allclose(got, expected[:, sensor], atol=2e-3)


@pytest.mark.parametrize("sensor", range(4))
def test_an_offset_is_traced_to_its_sensor_and_its_size_told(sensor: int) -> None:
    observer, _, _ = rig_observer()
    signatures = innovation_signatures(observer, 0.0)
    rng = np.random.default_rng(sensor)
    pattern = signatures[:, sensor].real
    size = float(np.linalg.norm(pattern))
    found = suspect_of_offset(-0.4 * pattern / size + 0.01 * rng.standard_normal(4), signatures)
    assert found.sensor == sensor
    assert found.likeness > 0.8
    assert found.error == pytest.approx(-0.4 / size, rel=0.1)


@pytest.mark.parametrize("sensor", range(4))
def test_an_oscillating_error_is_traced_to_its_sensor(sensor: int) -> None:
    observer, _, _ = rig_observer()
    signatures = innovation_signatures(observer, 50.0)
    found = suspect_of_excess(0.5 * 3.0**2 * np.abs(signatures[:, sensor]) ** 2, signatures)
    assert found.sensor == sensor
    assert found.likeness == pytest.approx(1.0)
    assert found.error == pytest.approx(3.0)


def test_no_pattern_has_no_suspect() -> None:
    observer, _, _ = rig_observer()
    assert suspect_of_offset(np.zeros(4), innovation_signatures(observer, 0.0)).likeness == 0.0


def test_wrong_model_helper_changes_what_it_names_and_nothing_else() -> None:
    plant = load_plant("rig")
    heavier = WrongModel("absorber", "mass_kg", 1.2)(plant)
    assert heavier.body[1].mass_kg == pytest.approx(1.2 * plant.body[1].mass_kg)
    assert heavier.actuator == plant.actuator
    stronger = WrongModel("vcm", "force_constant_n_a", 1.2)(plant)
    assert stronger.voice_coil is not None
    assert stronger.voice_coil.force_constant_n_a == pytest.approx(9.6)
    assert stronger.body == plant.body


# --- signals ----------------------------------------------------------------------------------------------

STD = 1e-3 * math.sqrt(RATE_HZ / 2.0)


@functools.cache
def two_sensors() -> Plant:
    rig = load_plant("rig")
    return rig.model_copy(update={"sensor": rig.sensor[:2]})


def channels_of(plant: Plant) -> tuple[Channel, ...]:
    return tuple(Channel(s.name, s.unit) for s in plant.sensor)


def moving(seed: int = 1, blocks: int = 6, n: int = 5000) -> Array:
    """(blocks * n, 2) of 50 Hz in noise, as the rig gives it."""
    t = np.arange(blocks * n) / RATE_HZ
    wave = np.column_stack([3.0 * np.sin(314.0 * t), 80.0 * np.sin(314.0 * t + 1.0)])
    return wave + STD * np.random.default_rng(seed).standard_normal(wave.shape)


def masks(
    values: Array, n: int = 5000, plant: Plant | None = None, rate_hz: float = RATE_HZ
) -> tuple[Array, set[str]]:
    """What a check masks of (N, p) samples in blocks of n, and the kinds it calls it."""
    plant = plant or two_sensors()
    check = SignalCheck(plant, [s.name for s in plant.sensor], rate_hz)
    valid, kinds = [], set()
    for first in range(0, len(values), n):
        checked = check.advance(make_block(first, rate_hz, values[first : first + n], channels_of(plant)))
        valid.append(checked.block.valid)
        kinds |= {f.kind for f in checked.findings}
        assert np.isfinite(checked.block.values).all()
        for f in checked.findings:
            column = [s.name for s in plant.sensor].index(f.channel)
            assert f.samples <= (~checked.block.valid[:, column]).sum()
    return ~np.concatenate(valid), kinds


def test_sound_signals_are_left_alone_and_the_block_is_passed_through() -> None:
    assert not masks(moving(blocks=40))[0].any()
    plant = two_sensors()
    check = SignalCheck(plant, [s.name for s in plant.sensor], RATE_HZ)
    block = make_block(0, RATE_HZ, moving(blocks=1), channels_of(plant))
    assert check.advance(block).block is block


@pytest.mark.parametrize("value", [0.0, 12.5, -0.1])
def test_stuck_channel_is_masked_from_its_first_sample_in_a_block_to_its_last(value: float) -> None:
    values = moving()
    values[12_000:23_000, 1] = value
    masked, kinds = masks(values)
    assert kinds == {"stuck"}
    assert masked[12_000:23_000, 1].all()
    masked[12_000:23_000, 1] = False
    assert not masked.any()


def test_channel_dead_from_the_start_is_found_once_another_one_shows_that_the_rig_moves() -> None:
    values = moving()
    values[:, 0] = 0.0
    masked, kinds = masks(values)
    assert kinds == {"stuck"}
    assert masked[5000:, 0].all()
    assert not masked[:, 1].any()


def test_spikes_are_masked_one_by_one_even_at_steep_slopes_and_at_a_blocks_ends() -> None:
    values = moving()
    rows = np.array([7, 8, 4999, 9000, 9002, 14_444, 20_000, 24_997, 29_999])
    values[rows, 1] += np.where(np.arange(len(rows)) % 2, 1.0, -1.0) * 40.0 * STD
    masked, kinds = masks(values)
    assert kinds == {"spiking"}
    np.testing.assert_array_equal(np.flatnonzero(masked[:, 1]), rows)
    assert not masked[:, 0].any()


def test_steps_and_onsets_are_not_spikes() -> None:
    values = STD * np.random.default_rng(2).standard_normal((30_000, 2))
    values[8_003:, 0] += 50.0  # a step
    t = np.arange(20_000) / RATE_HZ
    values[10_000:, 1] += 60.0 * np.exp(-20.0 * t) * np.sin(2 * np.pi * 400.0 * t)  # a knock that rings
    assert not masks(values)[0].any()


def test_flat_tops_are_called_saturated_without_a_stated_range() -> None:
    values = np.clip(moving(), -60.0, 60.0)
    masked, kinds = masks(values)
    assert kinds == {"saturated"}
    assert masked[np.abs(values) == 60.0].mean() > 0.99
    assert not masked[np.abs(values) < 60.0].any()


def test_stated_range_and_missing_samples_are_told_apart() -> None:
    values = moving()
    values[100:110, 0] = 700.0  # beyond 71 g
    values[200:210, 0] = np.nan
    values[300, 1] = np.inf
    masked, kinds = masks(values)
    assert kinds == {"saturated", "missing"}
    assert masked.sum() == 21


@settings(max_examples=20, deadline=None)
@given(
    code=st.floats(0.1, 40.0),
    rest=st.floats(-1.0, 1.0),
    seed=st.integers(0, 2**16),
    n=st.sampled_from([100, 1000]),
)
def test_codes_of_a_coarse_converter_repeat_rightfully(code: float, rest: float, seed: int, n: int) -> None:
    """Motion, then rest in the middle of a code or at its edge: repetitions are no fault."""
    rng = np.random.default_rng(seed)
    t = np.arange(4000) / RATE_HZ
    wave = np.column_stack([80.0 * np.sin(314.0 * t)] * 2)
    still = np.full((8_000, 2), rest)
    values = np.vstack([wave, still])
    values += STD * rng.standard_normal(values.shape)
    values = np.round(values / (code * STD)) * code * STD
    assert not masks(values, n)[0].any()


@pytest.mark.parametrize("overstated", [1.0, 3.0])
def test_a_stated_noise_up_to_three_times_the_real_one_calls_nothing_stuck(overstated: float) -> None:
    values = moving(blocks=30)
    quiet = values[:, 1] - 80.0 * np.sin(314.0 * np.arange(len(values)) / RATE_HZ + 1.0)
    values[50_000:, 1] = quiet[50_000:] / overstated
    values = np.round(values / STD) * STD
    assert not masks(values)[0].any()


@pytest.mark.parametrize("stride", [2, 7, 100])
def test_channel_that_is_sampled_more_slowly_is_not_missing(stride: int) -> None:
    values = moving()
    slow = np.ones(len(values), dtype=np.bool_)
    slow[3 % stride :: stride] = False
    values[slow, 0] = np.nan
    plant = two_sensors()
    check = SignalCheck(plant, [s.name for s in plant.sensor], RATE_HZ)
    # Blocks so short that some of them hold a single sample of the slow channel, or none.
    for first in range(0, len(values), 250):
        part = values[first : first + 250]
        checked = check.advance(make_block(first, RATE_HZ, part, channels_of(plant)))
        assert not checked.findings
        np.testing.assert_array_equal(checked.block.valid[:, 0], np.isfinite(part[:, 0]))


def test_channel_that_is_sampled_more_slowly_can_still_be_missing() -> None:
    values = moving()
    values[np.arange(len(values)) % 10 != 0, 0] = np.nan
    values[10_000:20_000, 0] = np.nan
    assert masks(values)[1] == {"missing"}


@pytest.mark.parametrize("name", ["beam_open", "beam_closed_lq"])
def test_measured_recordings_of_a_beam_hold_no_stuck_or_spiking_samples(realdata, name: str) -> None:
    plant = load_plant("beam")
    mapping = {"piezo": "none"} if name == "beam_open" else {}
    recording = open_foreign(realdata / f"{name}.npz", plant, channels=mapping)
    check = SignalCheck(plant, [c.name for c in recording.channels], recording.sample_rate_hz)
    assert not any(check.advance(b).findings for b in recording.blocks())


def test_measured_steps_of_a_scope_hold_no_stuck_samples(realdata) -> None:
    """Eight-bit codes, flat for hundreds of samples once the ringing is over."""
    data = np.load(realdata / "rlc_20221130_0001.npz")["data"].astype(np.float64)
    sensor = two_sensors().sensor[0]
    for record in data[:, :2]:
        for signal in record:
            # What such a scope would be stated with: a fifth of a code.
            steps = np.abs(np.diff(signal))
            noise = 0.2 * float(np.quantile(steps[steps > 1e-5], 0.05))
            rate = 892_857.0
            stated = sensor.model_copy(update={"noise_density": noise / math.sqrt(rate / 2.0), "range": None})
            plant = two_sensors().model_copy(update={"sensor": (stated,)})
            _, kinds = masks(signal[:, None], 500, plant, rate)
            # Its driver switches: where the noise stated is this small, glitches of several codes are spikes.
            assert kinds <= {"spiking"}


@settings(max_examples=60, deadline=None)
@given(
    values=arrays(np.float64, st.tuples(st.integers(1, 30), st.just(2)), elements=st.floats(width=64)),
    data=st.data(),
)
def test_whatever_comes_is_finite_afterwards_and_nothing_masked_becomes_valid(
    values: Array, data: st.DataObject
) -> None:
    valid = data.draw(arrays(np.bool_, values.shape))
    plant = two_sensors()
    check = SignalCheck(plant, [s.name for s in plant.sensor], RATE_HZ)
    with np.errstate(all="ignore"):
        for _ in range(3):
            checked = check.advance(Block(0, RATE_HZ, values, valid, channels_of(plant)))
            assert np.isfinite(checked.block.values).all()
            assert not (checked.block.valid & ~valid).any()
            assert not (checked.block.valid & ~np.isfinite(values)).any()
            kept = checked.block.valid
            np.testing.assert_array_equal(checked.block.values[kept], values[kept])
            channels = {f.channel for f in checked.findings}
            for column, channel in enumerate(channels_of(plant)):
                if (valid & ~checked.block.valid)[:, column].any():
                    assert channel.name in channels


@settings(max_examples=15, deadline=None)
@given(mask=arrays(np.bool_, (60, 7)), scale=st.floats(1e-3, 1e6), seed=st.integers(0, 999))
def test_no_mask_and_no_measurement_makes_the_loop_produce_nan(mask: Array, scale: float, seed: int) -> None:
    programme = demo_programme(1.0, 0)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    rng = np.random.default_rng(seed)
    for k in range(3):
        values = scale * rng.standard_normal(mask.shape)
        values[~mask] = [np.nan, np.inf, -np.inf][k]
        frame = session.advance(make_block(60 * k, RATE_HZ, values, rig.channels))
        assert np.isfinite(frame.estimate.mean).all()
        assert np.isfinite(frame.estimate.covariance).all()
        assert np.isfinite(frame.twin).all()
        assert frame.curve is not None
        assert np.isfinite(frame.curve.in_use_ns_m).all()
