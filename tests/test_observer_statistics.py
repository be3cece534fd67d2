"""What an estimate says about its innovations, against the same worked out sample by sample with filterpy."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from estimators.kernels import rls3_block
from estimators.observer import Observer
from estimators.types import StateEstimate
from twin.plant.blocks import Channel, make_block
from twin.plant.files import load_plant

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
CHANNELS = (
    "table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current", "shaker_voltage", "vcm",
)  # fmt: skip


def rig(**options: int) -> Observer:
    return Observer(load_plant("rig"), CHANNELS, RATE_HZ, frequency_hz=50.0, **options)


def noisy_values(n: int, seed: int, offset: float = 0.0) -> Array:
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((n, 6)) * np.array([0.2, 0.2, 3e-3, 3e-3, 0.002, 0.0])
    values[:, 0] += offset
    return values


def advance(observer: Observer, values: Array) -> StateEstimate:
    return observer.advance(make_block(0, RATE_HZ, values, tuple(Channel(c, "") for c in CHANNELS)))


def sequential_innovations(
    observer: Observer, values: Array
) -> Iterator[tuple[int, int, float, float, float]]:
    """Sample, sensor, innovation given the sensors before, its variance, joint prediction error; textbook form."""
    kf = observer.filter
    F, B, H, Q, R = (np.array(M) for M in (kf.F, kf.B, kf.H, kf.Q, kf.R))
    x, P = kf.x[:, 0].copy(), kf.P.copy()
    u = np.nan_to_num(values[:, [5, 4]])
    before = u[0]
    for k, z in enumerate(values[:, :4]):
        x, P = F @ x + B @ np.concatenate([before, u[k]]), F @ P @ F.T + Q
        before, prior = u[k], x.copy()
        for r in np.flatnonzero(np.isfinite(z)):
            h = H[r]
            s = float(h @ P @ h) + R[r, r]
            e = float(z[r] - h @ x)
            yield k, int(r), e, s, float(z[r] - h @ prior)
            x, P = x + P @ h * (e / s), P - np.outer(P @ h, P @ h) / s


@pytest.mark.parametrize("mode", ["full", "frozen", "gaps"])
def test_statistics_of_both_kernels_are_those_of_sequential_innovations(mode: str) -> None:
    values = noisy_values(700, seed=1, offset=0.05)
    if mode == "gaps":
        values[np.random.default_rng(2).random(values.shape) < 0.2] = np.nan
        values[:, 4:] = np.nan_to_num(values[:, 4:])
    expected = list(sequential_innovations(rig(), values))
    observer = rig(settle_samples=10**9)
    observer._settled = mode == "frozen"
    got = advance(observer, values)
    for r in range(4):
        k, e, s, joint = (np.array([row[i] for row in expected if row[1] == r]) for i in (0, 2, 3, 4))
        w = e / np.sqrt(s)
        mean, nis = np.mean(w), np.mean(w**2)
        follows = np.flatnonzero(np.diff(k) == 1)
        lag1 = (np.mean(w[follows + 1] * w[follows]) - mean**2) / (nis - mean**2)
        assert got.innovation_count[r] == len(e)
        assert got.innovation_mean[r] == pytest.approx(np.mean(e), rel=1e-6)
        assert got.innovation_rms[r] == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-6)
        assert got.innovation_std[r] == pytest.approx(np.sqrt(np.mean(s)), rel=1e-6)
        assert got.innovation_lag1[r] == pytest.approx(lag1, rel=1e-6)
        assert got.nis_per_sensor[r] == pytest.approx(nis, rel=1e-6)
        assert got.prediction_rms[r] == pytest.approx(np.sqrt(np.mean(joint**2)), rel=1e-6)
    assert got.nis == pytest.approx(np.mean([row[2] ** 2 / row[3] for row in expected]), rel=1e-6)


def test_a_block_cut_between_the_kernels_counts_the_pair_across_the_cut() -> None:
    values = noisy_values(500, seed=3)
    frozen, both = rig(), rig()
    both._settled = False  # 200 samples with the full covariance, then frozen
    a, b = advance(frozen, values), advance(both, values)
    np.testing.assert_allclose(a.innovation_lag1, b.innovation_lag1, rtol=1e-6)


def test_sensor_without_a_sample_has_no_statistics_and_the_others_have() -> None:
    values = noisy_values(300, seed=4)
    values[:, 2] = np.nan
    values[1:, 3] = np.nan
    got = advance(rig(), values)
    assert got.innovation_count.tolist() == [300.0, 300.0, 0.0, 1.0]
    for name in ("innovation_mean", "innovation_rms", "innovation_std", "nis_per_sensor", "prediction_rms"):
        assert np.isfinite(getattr(got, name)).tolist() == [True, True, False, True], name
    assert np.isfinite(got.innovation_lag1).tolist() == [True, True, False, False]


@pytest.mark.parametrize("forgetting", [1.0, 0.98])
def test_least_squares_of_three_parameters_is_filterpys_with_fading_memory(forgetting: float) -> None:
    from filterpy.kalman import KalmanFilter

    rng = np.random.default_rng(5)
    truth = np.array([7.0, 4.0, -0.5])
    phi, variance = rng.standard_normal((400, 3)), rng.uniform(0.5, 2.0, 400)
    z = phi @ truth + rng.standard_normal(400) * np.sqrt(variance)
    kf = KalmanFilter(dim_x=3, dim_z=1)
    kf.P, kf.Q, kf.alpha = 100.0 * np.eye(3), np.zeros((3, 3)), forgetting**-0.5
    theta, P = np.zeros(3), 100.0 * np.eye(3)
    for piece in np.split(np.arange(400), [1, 2, 50]):
        for k in piece:
            kf.predict()
            kf.update(z[k : k + 1, None], R=np.array([[variance[k]]]), H=phi[k : k + 1])
        rls3_block(theta, P, phi[piece], z[piece], variance[piece], forgetting)
        np.testing.assert_allclose(theta, kf.x[:, 0], rtol=1e-9)
        np.testing.assert_allclose(P, kf.P, rtol=1e-9, atol=1e-9 * np.max(np.abs(kf.P)))


def test_least_squares_leaves_out_what_is_no_measurement() -> None:
    rng = np.random.default_rng(6)
    phi, z, variance = rng.standard_normal((60, 3)), rng.standard_normal(60), np.ones(60)
    bad = np.zeros(60, dtype=bool)
    bad[[0, 7, 20, 33, 59]] = True
    z[0], phi[7, 1], variance[20], variance[33], z[59] = np.nan, np.inf, 0.0, np.nan, -np.inf
    theta, P = np.zeros(3), np.eye(3)
    clean, clean_P = np.zeros(3), np.eye(3)
    rls3_block(theta, P, phi, z, variance, 0.99)
    rls3_block(clean, clean_P, phi[~bad], z[~bad], variance[~bad], 0.99)
    np.testing.assert_array_equal(theta, clean)
    np.testing.assert_array_equal(P, clean_P)
