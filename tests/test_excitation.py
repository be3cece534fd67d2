"""The excitation tracker on signals whose frequency and phasors are known in closed form."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.excitation import ExcitationTracker, choose_reference
from estimators.types import Phasors
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.files import load_plant

Array = NDArray[np.float64]
RATE_HZ = 5_000.0
BLOCK = 500
SIZES = np.array([1.0, 0.3, 20.0])
ANGLES = np.array([0.0, 1.1, -2.0])
OFFSETS = np.array([0.0, 0.05, -3.0])
NAMES = ("drive", "small", "large")
CHANNELS = tuple(Channel(n, "V") for n in NAMES)


def blocks_of(values: Array, channels: tuple[Channel, ...] = CHANNELS) -> list[Block]:
    return [
        make_block(k, RATE_HZ, values[k : k + BLOCK], channels) for k in range(0, len(values), BLOCK)
    ]  # fmt: skip


def signals(phase: Array, noise: float = 0.0, seed: int = 0) -> Array:
    """All three channels over a common phase, with their own sizes, angles, offsets and noise."""
    rng = np.random.default_rng(seed)
    clean = SIZES * np.cos(phase[:, None] + ANGLES) + OFFSETS
    return np.asarray(clean + noise * SIZES * rng.standard_normal(clean.shape))


def times(n_blocks: int) -> Array:
    return np.arange(n_blocks * BLOCK) / RATE_HZ


def track(values: Array) -> list[Phasors | None]:
    tracker = ExcitationTracker("drive", NAMES)
    return [tracker.advance(b) for b in blocks_of(values)]


def found(phasors: Phasors | None) -> Phasors:
    assert phasors is not None
    return phasors


# --- frequency ----------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=25)
@given(hz=st.floats(20.0, 400.0), start=st.floats(0.0, 6.28))
def test_constant_tone_is_found_wherever_it_is_and_followed_exactly(hz: float, start: float) -> None:
    results = track(signals(2 * np.pi * hz * times(5) + start))
    for phasors in results[1:]:
        assert found(phasors).frequency_hz == pytest.approx(hz, abs=1e-5)
        np.testing.assert_allclose(np.abs(found(phasors).amplitude), SIZES, rtol=1e-6)


@settings(deadline=None, max_examples=40)
@given(hz=st.floats(5.0, 12.0), start=st.floats(0.0, 6.28))
def test_tone_with_less_than_a_cycle_and_a_half_per_block_is_not_guessed_at(hz: float, start: float) -> None:
    # Near 15 Hz it is a matter of phase whether a block tells; well below it nothing is made up.
    assert track(signals(2 * np.pi * hz * times(5) + start)) == [None] * 5


def test_chirp_of_20_hz_in_60_s_is_followed_within_its_own_uncertainty() -> None:
    t = times(600)
    rate = 20.0 / 60.0
    values = signals(2 * np.pi * (40.0 * t + 0.5 * rate * t**2), noise=0.02, seed=1)
    errors, stds = [], []
    for k, phasors in enumerate(track(values)):
        if k < 20:
            continue
        middle = (k * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ
        errors.append(found(phasors).frequency_hz - (40.0 + rate * middle))
        stds.append(found(phasors).frequency_std_hz)
    scaled = np.array(errors) / np.array(stds)
    assert np.max(np.abs(scaled)) < 5.0
    assert 0.8 < np.std(scaled) < 1.25
    assert abs(np.mean(errors)) < 1e-3


def test_noiseless_chirp_is_followed_to_a_millihertz() -> None:
    t = times(100)
    rate = 20.0 / 60.0
    results = track(signals(2 * np.pi * (40.0 * t + 0.5 * rate * t**2)))
    for k, phasors in enumerate(results[20:], start=20):
        middle = (k * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ
        assert found(phasors).frequency_hz == pytest.approx(40.0 + rate * middle, abs=1e-3)


def test_uncertainty_of_the_frequency_is_that_of_repeated_trials() -> None:
    scaled = []
    for seed in range(60):
        results = track(signals(2 * np.pi * 50.0 * times(3), noise=0.1, seed=seed))
        last = found(results[-1])
        scaled.append((last.frequency_hz - 50.0) / last.frequency_std_hz)
    assert 0.8 < np.std(scaled) < 1.25


# --- phasors ------------------------------------------------------------------------------------------------


def test_phasors_of_all_channels_stand_to_each_other_as_the_signals_do() -> None:
    last = found(track(signals(2 * np.pi * 47.3 * times(4) + 0.4))[-1])
    np.testing.assert_allclose(
        last.amplitude / last.amplitude[0], SIZES * np.exp(1j * ANGLES), rtol=1e-6, atol=1e-7
    )
    assert (last.reference, last.channels) == ("drive", NAMES)


def test_growing_amplitude_is_told_as_its_middle_value_and_slope() -> None:
    t = times(6)
    growth = 1.0 + 0.5 * t
    clean = growth[:, None] * SIZES * np.cos(2 * np.pi * 50.0 * t[:, None] + ANGLES)
    for k, phasors in enumerate(track(clean)[2:], start=2):
        middle = 1.0 + 0.5 * (k * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ
        got = found(phasors)
        np.testing.assert_allclose(np.abs(got.amplitude), SIZES * middle, rtol=1e-5)
        np.testing.assert_allclose((got.slope / got.amplitude).real, 0.5 / middle, rtol=1e-3)


def test_uncertainty_of_the_phasors_is_that_of_repeated_trials() -> None:
    # Of ratios to the reference, since the tracked phase is the reference's own.
    ratios, variances = [], []
    for seed in range(80):
        last = found(track(signals(2 * np.pi * 50.0 * times(2), noise=0.05, seed=seed))[-1])
        ratios.append(last.amplitude / last.amplitude[0])
        relative = last.variance / np.abs(last.amplitude) ** 2
        variances.append((relative + relative[0]) * np.abs(ratios[-1]) ** 2)
    spread = np.std(np.array(ratios), axis=0)[1:]
    claimed = np.sqrt(np.mean(variances, axis=0))[1:]
    assert np.all((spread / claimed > 0.8) & (spread / claimed < 1.25))


def test_third_harmonic_of_the_drive_moves_no_phasor_by_a_thousandth() -> None:
    phase = 2 * np.pi * 50.0 * times(4)
    values = signals(phase) + 0.2 * SIZES * np.cos(3 * phase[:, None])
    last = found(track(values)[-1])
    np.testing.assert_allclose(last.amplitude / last.amplitude[0], SIZES * np.exp(1j * ANGLES), rtol=2e-3)


def test_phase_of_a_chirp_is_followed_from_block_to_block_its_sweep_rate_included() -> None:
    # At 5 Hz/s a block's phase differs by 0.04 rad from what its frequency at the start alone would give.
    t = times(60)
    results = track(signals(2 * np.pi * (45.0 * t + 0.5 * 5.0 * t**2)))
    angles = np.unwrap([np.angle(found(p).amplitude[0]) for p in results[40:]])
    assert np.max(np.abs(np.diff(angles))) < 1e-3


# --- gaps, jumps, silence -----------------------------------------------------------------------------------


def test_tracker_coasts_over_a_gap_of_three_blocks_and_is_back_at_once() -> None:
    t = times(60)
    rate = 20.0 / 60.0
    values = signals(2 * np.pi * (45.0 * t + 0.5 * rate * t**2))
    values[30 * BLOCK : 33 * BLOCK] = np.nan
    results = track(values)
    assert results[30:33] == [None] * 3
    for k in range(33, 60):
        middle = (k * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ
        assert found(results[k]).frequency_hz == pytest.approx(45.0 + rate * middle, abs=1e-3)
    # And the phase is continued, not begun anew: it turns by what a straight continuation says.
    before, after = found(results[29]), found(results[33])
    assert abs(np.angle(after.amplitude[0] / before.amplitude[0])) < 0.01


def test_tracker_finds_the_excitation_again_after_a_jump_of_2_hz() -> None:
    n = 40 * BLOCK
    hz = np.where(np.arange(n) < 20 * BLOCK, 48.0, 50.0)
    phase = 2 * np.pi * np.cumsum(hz) / RATE_HZ
    results = track(signals(phase, noise=0.01))
    for phasors in results[28:]:
        assert found(phasors).frequency_hz == pytest.approx(50.0, abs=0.02)


def test_scattered_invalid_samples_leave_the_phasors_where_they_are() -> None:
    values = signals(2 * np.pi * 50.0 * times(4))
    values[np.random.default_rng(0).random(values.shape) < 0.1] = np.nan
    last = found(track(values)[-1])
    np.testing.assert_allclose(np.abs(last.amplitude), SIZES, rtol=1e-6)


@pytest.mark.parametrize("level", [0.0, 1e-3])
def test_silence_or_noise_alone_is_no_excitation_and_no_number_is_made_up(level: float) -> None:
    noise = level * np.random.default_rng(2).standard_normal((10 * BLOCK, 3))
    assert track(noise) == [None] * 10


def test_excitation_that_ends_is_lost_and_one_that_begins_is_found() -> None:
    values = signals(2 * np.pi * 50.0 * times(30), noise=0.01)
    values[10 * BLOCK : 20 * BLOCK] = 0.01 * np.random.default_rng(3).standard_normal((10 * BLOCK, 3))
    results = track(values)
    assert results[11:20] == [None] * 9
    for phasors in results[21:]:
        assert found(phasors).frequency_hz == pytest.approx(50.0, abs=0.05)


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), share=st.floats(0.0, 1.0), scale=st.floats(1e-9, 1e9))
def test_whatever_comes_in_the_phasors_are_numbers_or_none(seed: int, share: float, scale: float) -> None:
    rng = np.random.default_rng(seed)
    values = scale * rng.standard_normal((3 * BLOCK, 3)) ** 3
    values[rng.random(values.shape) < 0.3 * share] = np.nan
    for phasors in track(values):
        if phasors is not None:
            assert math.isfinite(phasors.frequency_hz)
            assert math.isfinite(phasors.frequency_std_hz)
            assert np.all(np.isfinite(phasors.amplitude))
            assert np.all(phasors.variance >= 0.0)


def test_shakers_voltage_is_the_reference_before_its_current_and_the_tables_motion() -> None:
    rig = load_plant("rig")
    names = [s.name for s in rig.sensor]
    assert choose_reference(rig, names) == "shaker_voltage"
    assert choose_reference(rig, [*names, "shaker"]) == "shaker_voltage"
    assert choose_reference(rig, ["table_acceleration", "shaker_current", "shaker"]) == "shaker"
    assert choose_reference(rig, ["table_acceleration", "shaker_current"]) == "shaker_current"
    # The table may be quiet; the absorber never is.
    assert choose_reference(rig, ["table_acceleration", "absorber_acceleration"]) == "absorber_acceleration"
    assert choose_reference(rig, ["table_acceleration"]) == "table_acceleration"
    assert choose_reference(rig, ["vcm_current"]) is None
    engine = load_plant("engine_vcm")
    assert choose_reference(engine, [s.name for s in engine.sensor]) == "absorber_velocity"
    assert choose_reference(engine, [*(s.name for s in engine.sensor), "excitation"]) == "excitation"
