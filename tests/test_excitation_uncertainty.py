"""Stated uncertainty of frequency, phasors and harmonics against the truth; sweeps, ramps and jumps of a grid."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimators.excitation import ExcitationTracker
from estimators.types import UNKNOWN_ANGLE_STD_RAD, Phasors
from twin.plant.blocks import Channel, make_block

Array = NDArray[np.float64]
RATE_HZ, BLOCK = 5_000.0, 500
NAMES = ("drive", "response")
CHANNELS = tuple(Channel(n, "V") for n in NAMES)
RESPONSE = 0.3 * np.exp(1.1j)


def track(values: Array, rate_hz: float = RATE_HZ, block: int = BLOCK) -> list[Phasors | None]:
    tracker = ExcitationTracker("drive", NAMES)
    return [
        tracker.advance(make_block(k, rate_hz, values[k : k + block], CHANNELS))
        for k in range(0, len(values), block)
    ]


def signals(phase: Array, noise: float, seed: int) -> Array:
    rng = np.random.default_rng(seed)
    clean = np.column_stack([np.cos(phase), (RESPONSE * np.exp(1j * phase)).real])
    return np.asarray(clean + noise * rng.standard_normal(clean.shape))


def middles(n_blocks: int) -> Array:
    """Time at the middle of each block [s]."""
    return (np.arange(n_blocks) * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ


def found(phasors: Phasors | None) -> Phasors:
    assert phasors is not None
    return phasors


def cramer_rao_hz(noise: float, hz: float, orders: tuple[int, ...] = ()) -> float:
    """Least standard deviation of the frequency: Fisher information of a tone's samples, amplitude 1.

    Unknown beside it are amplitude, phase, offset and, where named, the harmonics; the Jacobian is in closed form.
    """
    t = (np.arange(BLOCK) - 0.5 * (BLOCK - 1)) / RATE_HZ
    phase = 2 * np.pi * hz * t
    columns = [-2 * np.pi * t * np.sin(phase), np.cos(phase), np.sin(phase), np.ones(BLOCK)]
    for h in orders:
        columns += [np.cos(h * phase), np.sin(h * phase)]
    jacobian = np.column_stack(columns) / noise
    return float(np.sqrt(np.linalg.inv(jacobian.T @ jacobian)[0, 0]))


# --- white noise --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-3, 0.05])
@pytest.mark.parametrize("course", ["tone", "sweep", "ramp"])
def test_frequency_reaches_the_cramer_rao_bound_and_its_std_covers_the_truth(
    noise: float, course: str
) -> None:
    rate = {"tone": 0.0, "sweep": 20.0 / 60.0, "ramp": 1.0}[course]
    n = 400 if course != "ramp" else 120
    runs = 1 if course != "ramp" else 4
    errors, stds, bounds = [], [], []
    for seed in range(runs):
        t = np.arange(n * BLOCK) / RATE_HZ
        values = signals(2 * np.pi * (44.0 * t + 0.5 * rate * t**2), noise, seed)
        for k, (middle, phasors) in enumerate(zip(middles(n), track(values), strict=True)):
            if k < 10:
                continue
            truth = 44.0 + rate * middle
            errors.append(found(phasors).frequency_hz - truth)
            stds.append(found(phasors).frequency_std_hz)
            bounds.append(cramer_rao_hz(noise, truth) if k % 40 == 10 else bounds[-1])
    error, std = np.array(errors), np.array(stds)
    assert 0.9 < math.sqrt(np.mean(error**2)) / np.mean(bounds) < 1.25
    assert 0.92 <= np.mean(np.abs(error) < 1.96 * std) <= 0.98


def test_amplitude_and_phase_are_as_uncertain_as_they_say() -> None:
    n, noise = 400, 0.1
    t = np.arange(n * BLOCK) / RATE_HZ
    inside_size, inside_angle = [], []
    for phasors in track(signals(2 * np.pi * 49.3 * t, noise, 3))[5:]:
        p = found(phasors)
        inside_size.append(np.abs(np.abs(p.amplitude) - [1.0, abs(RESPONSE)]) < 1.96 * p.amplitude_std)
        # Of the response against the drive: both phases are uncertain.
        angle = np.angle(p.amplitude[1] / p.amplitude[0] / RESPONSE)
        inside_angle.append(abs(angle) < 1.96 * math.hypot(*p.phase_std_rad))
    assert np.all(np.abs(np.mean(inside_size, axis=0) - 0.95) <= 0.03)
    assert np.mean(inside_angle) == pytest.approx(0.95, abs=0.03)


def test_angle_of_nothing_is_anywhere() -> None:
    t = np.arange(3 * BLOCK) / RATE_HZ
    values = signals(2 * np.pi * 50.0 * t, 0.0, 0)
    values[:, 1] = 0.0
    assert found(track(values)[-1]).phase_std_rad[1] == pytest.approx(UNKNOWN_ANGLE_STD_RAD)


# --- noise of another colour, harmonics ---------------------------------------------------------------------


@pytest.mark.parametrize("pole", [0.98, -0.9])
def test_coloured_noise_does_not_make_the_std_wrong(pole: float) -> None:
    # First-order noise that is ten times stronger at low frequencies, or a fraction at 50 Hz of what it is above.
    n = 500
    rng = np.random.default_rng(7)
    t = np.arange(n * BLOCK) / RATE_HZ
    clean = np.column_stack([np.cos(2 * np.pi * 50.0 * t), (RESPONSE * np.exp(2j * np.pi * 50.0 * t)).real])
    noise = np.zeros(clean.shape)
    white = 0.02 * rng.standard_normal(clean.shape)
    for k in range(1, len(t)):
        noise[k] = pole * noise[k - 1] + white[k]
    scaled, sizes = [], []
    for phasors in track(clean + noise)[40:]:
        p = found(phasors)
        scaled.append((p.frequency_hz - 50.0) / p.frequency_std_hz)
        sizes.append((np.abs(p.amplitude) - [1.0, abs(RESPONSE)]) / p.amplitude_std)
    assert 0.7 < np.std(scaled) < 1.3
    assert np.all((np.std(sizes, axis=0) > 0.7) & (np.std(sizes, axis=0) < 1.3))


def test_harmonics_are_told_with_their_phase_and_what_they_are_worth() -> None:
    n, noise = 300, 0.02
    t = np.arange(n * BLOCK) / RATE_HZ
    phase = 2 * np.pi * 48.7 * t
    parts = {2: 0.05 * np.exp(0.4j), 3: 0.2 * np.exp(-1.0j), 4: 0.0, 5: 0.01j}
    values = signals(phase, noise, 5)
    for h, part in parts.items():
        values[:, 0] += (part * np.exp(1j * h * phase)).real
    inside, distortion = [], []
    truth = math.sqrt(sum(abs(p) ** 2 for p in parts.values()))
    frequency = []
    for phasors in track(values)[5:]:
        p = found(phasors)
        assert p.harmonic_orders == (2, 3, 4, 5)
        turned = p.harmonics[:, 0] * np.exp(-1j * np.array(p.harmonic_orders) * np.angle(p.amplitude[0]))
        # The drive's own phase error counts h times in a harmonic's.
        std = np.sqrt(0.5 * p.harmonic_variance[:, 0])
        error = np.abs(np.abs(turned) - np.abs(list(parts.values())))
        inside.append(error[[0, 1, 3]] < 1.96 * std[[0, 1, 3]])
        thd, thd_std = p.distortion()
        assert p.distortion_of(p.channels[0]) == pytest.approx(float(thd[0]), rel=1e-12)
        distortion.append((thd[0] - truth) / thd_std[0])
        frequency.append((p.frequency_hz - 48.7) / p.frequency_std_hz)
        assert np.all(np.isfinite(thd))
        assert np.all(thd >= 0.0)
        assert abs(np.angle(turned[1] / parts[3])) < 0.05
    assert np.all(np.mean(inside, axis=0) > 0.9)
    assert 0.8 < np.std(distortion) < 1.25
    assert abs(np.mean(distortion)) < 0.3
    assert 0.85 < np.std(frequency) < 1.15


def test_harmonics_beyond_the_sample_rate_are_not_made_up() -> None:
    t = np.arange(5 * BLOCK) / RATE_HZ
    assert found(track(signals(2 * np.pi * 400.0 * t, 1e-3, 0))[-1]).harmonic_orders == (2, 3, 4, 5)
    assert found(track(signals(2 * np.pi * 480.0 * t, 1e-3, 0))[-1]).harmonic_orders == (2, 3, 4)


def test_samples_averaged_in_groups_tell_the_same_as_all_of_them() -> None:
    # At 50 kS/s ten samples are averaged; what that does to amplitudes is undone.
    rate, block = 50_000.0, 5_000
    t = np.arange(4 * block) / rate
    phase = 2 * np.pi * 50.0 * t
    values = signals(phase, 0.0, 0)
    values[:, 0] += 0.1 * np.cos(5 * phase)
    p = found(track(values, rate, block)[-1])
    assert len(p.samples) < block
    np.testing.assert_allclose(np.abs(p.amplitude), [1.0, abs(RESPONSE)], rtol=1e-8)
    assert abs(p.harmonics[3, 0]) == pytest.approx(0.1, rel=1e-7)


# --- courses of a grid --------------------------------------------------------------------------------------


def phase_of(hz: Array) -> Array:
    return np.asarray(2 * np.pi * np.cumsum(hz) / RATE_HZ)


@settings(deadline=None, max_examples=25)
@given(
    jump=st.sampled_from([(47.0, 53.0), (53.0, 47.0), (50.0, 49.8), (50.0, 50.5), (45.0, 55.0)]),
    inside=st.integers(0, BLOCK - 1),
    seed=st.integers(0, 1000),
)
def test_jump_is_noticed_and_over_with_the_block_it_happens_in(
    jump: tuple[float, float], inside: int, seed: int
) -> None:
    n, at = 30, 15
    hz = np.where(np.arange(n * BLOCK) < at * BLOCK + inside, *jump)
    results = track(signals(phase_of(hz), 1e-3, seed))
    for k, phasors in enumerate(results):
        if k == at:
            continue
        p = found(phasors)
        truth = jump[0] if k < at else jump[1]
        assert abs(p.frequency_hz - truth) < 5.0 * p.frequency_std_hz
    # What a jump leaves behind within its block is the phase it turns the tone by, before or after.
    turn_rad = 2 * np.pi * abs(jump[1] - jump[0]) * min(inside, BLOCK - inside) / RATE_HZ
    if turn_rad > 0.03 and BLOCK // 10 < inside < BLOCK - BLOCK // 10:
        broken = results[at]
        assert broken is None or not broken.steady
    assert not all(p is not None and p.steady for p in results[at : at + 2]) or abs(jump[1] - jump[0]) < 1.0
    assert all(found(p).steady for p in results[at + 3 :])


def test_ramps_of_1_to_2_hz_per_second_are_followed_within_the_stated_std() -> None:
    ramps = [0.0] * 20 + [2.0] * 20 + [0.0] * 20 + [-1.0] * 30 + [0.0] * 10
    hz = 49.0 + np.cumsum(np.repeat(ramps, BLOCK)) / RATE_HZ
    scaled = []
    for seed in range(5):
        results = track(signals(phase_of(hz), 1e-2, seed))
        for k, phasors in enumerate(results[2:], start=2):
            p = found(phasors)
            scaled.append((p.frequency_hz - hz[k * BLOCK : (k + 1) * BLOCK].mean()) / p.frequency_std_hz)
    assert np.max(np.abs(scaled)) < 5.0
    assert 0.92 <= np.mean(np.abs(scaled) < 1.96) <= 0.98
    rates = [found(p).sweep_rate_hz_s for p in results[30:39]]
    assert np.mean(rates) == pytest.approx(2.0, abs=0.2)


def test_phase_goes_on_through_blocks_that_never_came() -> None:
    t = np.arange(80 * BLOCK) / RATE_HZ
    rate = 20.0 / 60.0
    values = signals(2 * np.pi * (45.0 * t + 0.5 * rate * t**2), 1e-3, 2)
    rng = np.random.default_rng(9)
    lost = set(rng.choice(np.arange(20, 75), 8, replace=False).tolist())
    tracker = ExcitationTracker("drive", NAMES)
    angles = []
    for k in range(80):
        if k in lost:
            continue
        p = tracker.advance(make_block(k * BLOCK, RATE_HZ, values[k * BLOCK : (k + 1) * BLOCK], CHANNELS))
        if k >= 15:
            middle = (k * BLOCK + 0.5 * (BLOCK - 1)) / RATE_HZ
            assert abs(found(p).frequency_hz - (45.0 + rate * middle)) < 5.0 * found(p).frequency_std_hz
            assert found(p).steady
            angles.append(np.angle(found(p).amplitude[0]))
    assert np.max(np.abs(np.diff(np.unwrap(angles)))) < 0.02


def test_dead_channel_leaves_the_others_alone_and_claims_nothing() -> None:
    t = np.arange(10 * BLOCK) / RATE_HZ
    values = signals(2 * np.pi * 50.0 * t, 1e-3, 0)
    values[5 * BLOCK :, 1] = np.nan
    p = found(track(values)[-1])
    assert p.frequency_hz == pytest.approx(50.0, abs=1e-3)
    assert p.amplitude[1] == 0.0
    assert math.isinf(p.variance[1])
    assert math.isinf(p.slope_variance[1])
    thd, std = p.distortion()
    assert thd[1] == 0.0
    assert math.isinf(std[1])
    values[5 * BLOCK :, 0] = np.nan
    assert track(values)[-1] is None


def test_recording_that_begins_again_is_searched_anew() -> None:
    t = np.arange(5 * BLOCK) / RATE_HZ
    tracker = ExcitationTracker("drive", NAMES)
    for hz in (47.0, 53.0):
        values = signals(2 * np.pi * hz * t, 1e-3, 0)
        for k in range(0, len(values), BLOCK):
            p = tracker.advance(make_block(k, RATE_HZ, values[k : k + BLOCK], CHANNELS))
        assert found(p).frequency_hz == pytest.approx(hz, abs=1e-3)
