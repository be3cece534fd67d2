"""The rig's filter chain against SciPy's Butterworth filters and trapezoidal integrators."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import butter, freqs, lfilter

from twin.control.chain import chain_matrices, chain_response, chain_step

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
DT = 1.0 / RATE_HZ


def warped(cutoff_hz: float) -> float:
    return math.tan(math.pi * cutoff_hz * DT)


def run(a_in: Array, low_hz: Array | float, high_hz: Array | float, state: Array | None = None) -> Array:
    """The chain's (a, v, x) over a signal; cutoffs may differ from sample to sample."""
    low, high = np.broadcast_to(low_hz, a_in.shape), np.broadcast_to(high_hz, a_in.shape)
    s = np.zeros(6) if state is None else state
    return np.array([
        chain_step(s, float(a), warped(lo), warped(hi), DT)
        for a, lo, hi in zip(a_in, low, high, strict=True)
    ])  # fmt: skip


@pytest.mark.parametrize(("low_hz", "high_hz"), [(200.0, 1.0), (1000.0, 2.5), (40.0, 10.0)])
def test_chain_is_butterworth_by_prewarped_bilinear_transform_with_trapezoidal_integrators(
    low_hz: float, high_hz: float
) -> None:
    a_in = np.random.default_rng(1).normal(size=6000)
    low = lfilter(*butter(2, low_hz, fs=RATE_HZ), a_in)
    high_b, high_a = butter(2, high_hz, "highpass", fs=RATE_HZ)

    def integrate(signal: Array) -> Array:
        return np.asarray(lfilter([0.5 * DT, 0.5 * DT], [1.0, -1.0], signal))

    v = lfilter(high_b, high_a, integrate(low))
    x = lfilter(high_b, high_a, integrate(v))
    got = run(a_in, low_hz, high_hz)
    for column, expected in enumerate((low, v, x)):
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(got[:, column] / scale, expected / scale, atol=1e-8)


@pytest.mark.parametrize("hz", [45.0, 50.0, 55.0])
def test_response_is_what_the_chain_settles_to(hz: float) -> None:
    # With a 20 Hz high-pass the chain settles within a quarter of a second, to 1e-9.
    t = np.arange(20_000) * DT
    a_in = np.cos(2.0 * np.pi * hz * t)
    got = run(a_in, 200.0, 20.0)[-5000:]
    expected = chain_response(hz, 200.0, 20.0, RATE_HZ)[0]
    turning = np.exp(2j * np.pi * hz * t[-5000:])
    np.testing.assert_allclose(
        got / np.abs(expected), (turning[:, None] * expected).real / np.abs(expected), atol=1e-8
    )


@settings(deadline=None, max_examples=30)
@given(
    low=st.floats(20.0, 20_000.0), high=st.floats(0.2, 20.0), hz=st.floats(0.5, 2000.0)
)  # fmt: skip
def test_matrices_and_response_are_the_same_chain(low: float, high: float, hz: float) -> None:
    A, B, C, D = chain_matrices(low, high, RATE_HZ)
    z = np.exp(2j * np.pi * hz * DT)
    by_matrices = (C @ np.linalg.solve(z * np.eye(6) - A, B) + D)[:, 0]
    np.testing.assert_allclose(by_matrices, chain_response(hz, low, high, RATE_HZ)[0], rtol=1e-7)
    assert np.abs(np.linalg.eigvals(A)).max() < 1.0


def test_matrices_step_as_the_chain_does() -> None:
    rng = np.random.default_rng(5)
    A, B, C, D = chain_matrices(300.0, 2.5, RATE_HZ)
    s = rng.normal(size=6)
    other = s.copy()
    for a in rng.normal(size=50):
        out = chain_step(s, float(a), warped(300.0), warped(2.5), DT)
        np.testing.assert_allclose(out, C @ other + D[:, 0] * a, rtol=1e-10, atol=1e-12)
        other = A @ other + B[:, 0] * a
        np.testing.assert_allclose(s, other, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("hz", "low_pass_deg", "high_pass_deg"), [(45.0, -18.53, 1.801), (55.0, -22.82, 1.473)]
)
def test_200_hz_low_pass_lags_and_1_hz_high_pass_leads_as_in_the_thesis(
    hz: float, low_pass_deg: float, high_pass_deg: float
) -> None:
    low, v, x = chain_response(hz, 200.0, 1.0, RATE_HZ)[0]
    s = 2j * np.pi * hz
    assert math.degrees(np.angle(low)) == pytest.approx(low_pass_deg, abs=0.005)
    # What is left of each integration after the ideal 1/s is one high-pass.
    assert math.degrees(np.angle(v / low * s)) == pytest.approx(high_pass_deg, abs=0.0006)
    assert math.degrees(np.angle(x / v * s)) == pytest.approx(high_pass_deg, abs=0.0006)
    # The same from the analogue filters.
    for kind, cutoff, got in (("lowpass", 200.0, low), ("highpass", 1.0, v / low * s)):
        _, analogue = freqs(*butter(2, 2 * np.pi * cutoff, kind, analog=True), worN=[2 * np.pi * hz])
        assert abs(got / analogue[0] - 1.0) < 2e-4


def test_paired_cutoffs_null_the_velocity_phase_and_leave_the_position_a_lead() -> None:
    # thesis 7.9.3: f_lp f_hp = f²
    for hz in (45.0, 50.0, 55.0):
        _, v, x = chain_response(hz, hz**2 / 2.5, 2.5, RATE_HZ)[0]
        s = 2j * np.pi * hz
        assert abs(math.degrees(np.angle(v * s))) < 0.02
        assert math.degrees(np.angle(x * s**2)) == pytest.approx(
            math.degrees(math.sqrt(2.0) * 2.5 / hz), rel=0.01
        )


def test_cutoff_that_moves_with_the_state_carried_disturbs_far_less_than_a_reset() -> None:
    hz = 50.0
    n = 40_000
    t = np.arange(n) * DT
    a_in = np.cos(2.0 * np.pi * hz * t)
    change = n // 2
    low = np.where(np.arange(n) < change, 1000.0, 1050.0)
    s = np.zeros(6)
    run(a_in[:change], 1000.0, 20.0, s)
    carried = run(a_in[change:], low[change:], 20.0, s.copy())
    reset = run(a_in[change:], low[change:], 20.0)
    settled = (
        np.exp(2j * np.pi * hz * t[change:])[:, None] * chain_response(hz, 1050.0, 20.0, RATE_HZ)[0]
    ).real
    sizes = np.abs(chain_response(hz, 1050.0, 20.0, RATE_HZ)[0])
    by_carrying = np.max(np.abs(carried - settled), axis=0) / sizes
    by_reset = np.max(np.abs(reset - settled), axis=0) / sizes
    assert np.all(by_carrying < 0.03)
    assert np.all(by_reset > 0.3)


def test_offset_of_an_accelerometer_does_not_run_away() -> None:
    # An integrator before the high-pass would carry 0.5 m/s² to 2.5 m/s in these 5 s, and its square to the stop.
    # The section passes no constant: its answer dies with the high-pass and is zero within a second at 2.5 Hz.
    A, B, C, D = chain_matrices(1000.0, 2.5, RATE_HZ)
    settled = (C @ np.linalg.solve(np.eye(6) - A, B) + D)[:, 0] * 0.5
    np.testing.assert_allclose(settled, [0.5, 0.0, 0.0], atol=1e-9)
    out = run(np.full(100_000, 0.5), 1000.0, 2.5)
    assert np.max(np.abs(out[:, 1])) < 0.5 / (2 * np.pi * 2.5)
    assert np.max(np.abs(out[-1, 1:])) < 1e-6
