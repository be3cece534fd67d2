"""Frequency by zero crossings: exact without noise, its error with it, and how noise adds crossings."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.zero_crossing import frequency_std_hz, zero_crossing_frequency_hz

RATE_HZ = 50_000.0


def tone(hz: float, seconds: float, phase: float = 0.3) -> np.ndarray:
    return np.sin(2 * np.pi * hz * np.arange(int(seconds * RATE_HZ)) / RATE_HZ + phase)


@settings(deadline=None, max_examples=50)
@given(st.floats(20.0, 500.0), st.floats(0.0, 6.28), st.sampled_from([0.0, 0.1]))
def test_clean_tone_is_told_exactly(hz, phase, hysteresis):
    found = zero_crossing_frequency_hz(tone(hz, 0.3, phase), RATE_HZ, hysteresis)
    assert found == pytest.approx(hz, rel=2e-5)


def test_noise_without_hysteresis_adds_crossings_and_with_it_does_not():
    rng = np.random.default_rng(3)
    noisy = tone(50.0, 1.0) + 0.05 * rng.normal(size=int(RATE_HZ))
    assert zero_crossing_frequency_hz(noisy, RATE_HZ) > 80.0
    assert zero_crossing_frequency_hz(noisy, RATE_HZ, 4 * 0.05) == pytest.approx(50.0, abs=0.05)


def test_scatter_is_that_of_the_formula_while_noise_adds_no_crossings():
    # fewer samples per period, less noise: one sign change per crossing
    rate, hz, noise = 2000.0, 50.0, 0.01
    rng = np.random.default_rng(4)
    found = []
    for _ in range(2000):
        t = np.arange(400) / rate + rng.uniform(0.0, 1.0)
        found.append(
            zero_crossing_frequency_hz(np.sin(2 * np.pi * hz * t) + noise * rng.normal(size=400), rate, 0.05)
        )
    predicted = frequency_std_hz(1.0, noise, hz, 10, rate)
    assert np.std(found) == pytest.approx(predicted, rel=0.15)
    assert abs(np.mean(found) - hz) < 0.1 * predicted


def test_scatter_grows_with_noise():
    rng = np.random.default_rng(5)
    spread = []
    for noise in (0.001, 0.01, 0.1):
        runs = [
            zero_crossing_frequency_hz(tone(50.0, 0.2) + noise * rng.normal(size=10_000), RATE_HZ, 4 * noise)
            for _ in range(100)
        ]
        spread.append(np.std(runs))
    assert spread[0] < spread[1] < spread[2]


@pytest.mark.parametrize("values", [np.zeros(100), np.ones(100), tone(50.0, 0.02), []])
def test_too_few_crossings_tell_nothing(values):
    assert zero_crossing_frequency_hz(values, RATE_HZ) is None


def test_what_is_no_signal_is_refused():
    with pytest.raises(ValueError, match="finite"):
        zero_crossing_frequency_hz([0.0, np.nan], RATE_HZ)
    with pytest.raises(ValueError, match="hysteresis"):
        zero_crossing_frequency_hz([0.0, 1.0], RATE_HZ, -1.0)
    with pytest.raises(ValueError, match="eight samples"):
        frequency_std_hz(1.0, 0.1, 50.0, 5, 100.0)
