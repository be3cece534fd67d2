"""The smoother against filterpy's Rauch-Tung-Striebel smoother, against brute force, and its claims by Monte Carlo."""

import copy

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from estimators.observer import Observer
from estimators.smoother import RecordingSmoother, SmoothedEstimate, smoothed
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.files import load_plant
from twin.plant.inputs import driven_model

Array = NDArray[np.float64]
RATE_HZ = 5_000.0
CHANNELS = (
    "table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current", "shaker_voltage", "vcm",
)  # fmt: skip


def rig(damping_ns_m: float = 7.0) -> Observer:
    plant = load_plant("rig").with_damping("absorber", damping_ns_m)
    return Observer(plant, CHANNELS, RATE_HZ, frequency_hz=50.0)


def root_of(P: Array) -> Array:
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def recording(observer: Observer, n: int, seed: int, lost: float = 0.0) -> tuple[Array, Array]:
    """True states, and columns of `CHANNELS` from a plant that is the observer's model; some samples are NaN."""
    kf, rng = observer.filter, np.random.default_rng(seed)
    t = np.arange(n) / RATE_HZ
    u = np.stack([0.5 * np.sign(np.sin(500.0 * t)), 4.0 * np.sin(314.0 * t)], axis=1)
    x, before = root_of(kf.P) @ rng.standard_normal(len(kf.F)), u[0]
    w = rng.standard_normal((n, len(kf.F))) @ root_of(kf.Q).T
    states, z = np.empty((n, len(kf.F))), np.empty((n, 4))
    for k in range(n):
        x = kf.F @ x + kf.B @ np.concatenate([before, u[k]]) + w[k]
        z[k] = kf.H @ x + observer.feedthrough @ u[k] + np.sqrt(np.diag(kf.R)) * rng.standard_normal(4)
        states[k], before = x, u[k]
    z[rng.random(z.shape) < lost] = np.nan
    return states, np.column_stack([z, u[:, 1], u[:, 0]])


def cut(values: Array, cuts: list[int]) -> list[Block]:
    names = tuple(Channel(c, "") for c in CHANNELS)
    starts = [0, *cuts]
    return [make_block(a, RATE_HZ, p, names) for a, p in zip(starts, np.split(values, cuts), strict=True)]


def run(observer: Observer, blocks: list[Block]) -> tuple[Array, Array, Array, list[SmoothedEstimate]]:
    pieces = list(smoothed(observer, blocks))[::-1]
    joined = (np.concatenate([getattr(p, name) for p in pieces]) for name in ("mean", "std", "filtered_std"))
    mean, std, filtered_std = joined
    return mean, std, filtered_std, pieces


def by_filterpy(observer: Observer, values: Array) -> tuple[Array, Array]:
    """Means and covariances of filterpy's own filter and smoother, in units in which its inverses are exact."""
    theirs = observer.filter
    scale = np.sqrt(np.diag(observer.steady_covariance))
    kf = KalmanFilter(dim_x=len(scale), dim_z=4)
    kf.F, kf.H = theirs.F / scale[:, None] * scale, theirs.H * scale
    kf.Q, kf.P = theirs.Q / np.outer(scale, scale), theirs.P / np.outer(scale, scale)
    kf.B, kf.x, R = theirs.B / scale[:, None], theirs.x / scale[:, None], np.array(theirs.R)
    u, means, covariances = values[:, [5, 4]], [], []
    H, before, drift = kf.H.copy(), u[0], []
    for k, z in enumerate(values[:, :4]):
        drift.append(kf.B @ np.concatenate([before, u[k]]))
        kf.predict(u=np.concatenate([before, u[k]])[:, None])
        rows = np.flatnonzero(np.isfinite(z))
        if len(rows):
            kf.dim_z = len(rows)
            seen = (z - observer.feedthrough @ u[k])[rows]
            kf.update(seen[:, None], R=R[np.ix_(rows, rows)], H=H[rows])
        before = u[k]
        means.append(kf.x[:, 0].copy())
        covariances.append(kf.P.copy())
    # Its smoother knows no inputs: smoothed errors of the filter are what it can work out, with x_pred moved out.
    path = np.zeros(len(scale))
    free = []
    for mean, moved in zip(means, drift, strict=True):
        path = kf.F @ path + moved
        free.append(mean - path)
    # What the inputs alone do is taken off before and put back after: the smoother is linear.
    x, P, _, _ = kf.rts_smoother(np.array(free)[:, :, None], np.array(covariances))
    back, path = [], np.zeros(len(scale))
    for row, moved in zip(x[:, :, 0], drift, strict=True):
        path = kf.F @ path + moved
        back.append(row + path)
    return np.array(back) * scale, np.array(P) * np.outer(scale, scale)


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_smoothed_states_are_those_of_filterpys_smoother(lost: float) -> None:
    _, values = recording(rig(), 600, seed=1, lost=lost)
    expected, covariances = by_filterpy(rig(), values)
    mean, std, _, pieces = run(rig(), cut(values, [200, 250]))
    assert np.max(np.abs(mean - expected) / np.max(np.abs(expected), axis=0)) <= 1e-8
    steady = np.sqrt(np.diag(rig().steady_covariance))
    assert np.max(np.abs(std - np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))) / steady) <= 1e-8
    first = [0, 200, 250]
    for piece, k in zip(pieces, first, strict=True):
        assert np.max(np.abs(piece.first_covariance - covariances[k]) / np.outer(steady, steady)) <= 1e-8


def test_where_the_recording_is_cut_makes_no_difference() -> None:
    _, values = recording(rig(), 500, seed=2, lost=0.1)
    one, many = run(rig(), cut(values, [])), run(rig(), cut(values, [1, 2, 77, 300, 499]))
    for a, b in zip(one[:3], many[:3], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * np.max(np.abs(a)))


def test_smoothing_is_least_squares_over_all_samples_at_once() -> None:
    # Brute force: the posterior of a jointly Gaussian trajectory, with no recursion at all.
    observer = rig()
    kf = observer.filter
    _, values = recording(rig(), 12, seed=3, lost=0.2)
    n, N = len(kf.F), 12
    scale = np.sqrt(np.diag(observer.steady_covariance))
    F, Q = kf.F / scale[:, None] * scale, kf.Q / np.outer(scale, scale)
    blocks = [kf.P / np.outer(scale, scale)]
    mean_path, before, x = [], values[0, [5, 4]], np.zeros(n)
    for k in range(N):
        blocks.append(F @ blocks[-1] @ F.T + Q)
        u = values[k, [5, 4]]
        x = F @ x + (kf.B / scale[:, None]) @ np.concatenate([before, u])
        mean_path.append(x)
        before = u
    joint = np.zeros((N * n, N * n))
    for i in range(N):
        joint[i * n : (i + 1) * n, i * n : (i + 1) * n] = blocks[i + 1]
        step = blocks[i + 1]
        for j in range(i + 1, N):
            step = F @ step
            joint[j * n : (j + 1) * n, i * n : (i + 1) * n] = step
            joint[i * n : (i + 1) * n, j * n : (j + 1) * n] = step.T
    rows, residue, variance = [], [], []
    for k in range(N):
        for r in np.flatnonzero(np.isfinite(values[k, :4])):
            row = np.zeros(N * n)
            row[k * n : (k + 1) * n] = kf.H[r] * scale
            rows.append(row)
            residue.append(values[k, r] - row @ np.concatenate(mean_path))
            variance.append(kf.R[r, r])
    H = np.array(rows)
    gain = np.linalg.solve(H @ joint @ H.T + np.diag(variance), H @ joint).T
    expected = (np.concatenate(mean_path) + gain @ np.array(residue)).reshape(N, n) * scale
    spread = np.sqrt(np.diag(joint - gain @ H @ joint)).reshape(N, n) * scale
    mean, std, _, _ = run(observer, cut(values, [5]))
    np.testing.assert_allclose(mean / scale, expected / scale, atol=1e-6)
    np.testing.assert_allclose(std / scale, spread / scale, atol=1e-6)


def test_later_samples_never_make_an_estimate_worse() -> None:
    _, values = recording(rig(), 800, seed=4, lost=0.2)
    _, std, filtered_std, pieces = run(rig(), cut(values, [400]))
    assert np.all(std <= filtered_std)
    assert np.mean(std / filtered_std) < 0.9
    np.testing.assert_allclose(std[-1], filtered_std[-1])  # nothing comes after the last
    assert np.all(np.linalg.eigvalsh(pieces[0].first_covariance / np.outer(std[0], std[0])) > -1e-9)


def test_smoothed_errors_are_as_large_as_they_are_said_to_be() -> None:
    runs, squares = 100, []
    for seed in range(runs):
        observer = rig()
        states, values = recording(observer, 240, seed=1000 + seed, lost=0.1)
        pieces = list(smoothed(observer, cut(values, [120])))
        error = pieces[0].mean[0] - states[120]
        scale = pieces[0].std[0]
        P = pieces[0].first_covariance / np.outer(scale, scale)
        squares.append(float((error / scale) @ np.linalg.solve(P, error / scale)))
    n = len(scale)
    # Chi-squared with n degrees of freedom: the mean of 100 within its 99.9 % band.
    assert np.mean(squares) == pytest.approx(n, abs=3.3 * np.sqrt(2.0 * n / runs))


def test_each_block_is_smoothed_with_the_model_it_was_filtered_with() -> None:
    _, values = recording(rig(), 400, seed=5)
    blocks = cut(values, [200])
    observer = rig()
    smoother = RecordingSmoother(observer)
    smoother.filter(blocks[0])
    plant = load_plant("rig").with_damping("absorber", 20.0)
    observer.set_model(plant, *driven_model(plant, observer.sources, RATE_HZ, 50.0))
    smoother.filter(blocks[1])
    late, early = smoother.smooth(blocks[1]), smoother.smooth(blocks[0])
    same = [copy.deepcopy(e) for e in smoothed(rig(), blocks)]
    assert np.max(np.abs(late.mean - same[0].mean) / np.std(same[0].mean, axis=0)) > 1e-3
    # At the border both blocks speak of neighbouring samples of one trajectory.
    assert np.all(np.abs(late.mean[0] - early.mean[-1]) < 0.1 * np.ptp(early.mean, axis=0))


def test_blocks_in_another_order_are_refused() -> None:
    _, values = recording(rig(), 90, seed=6)
    blocks = cut(values, [30, 60])
    smoother = RecordingSmoother(rig())
    for block in blocks:
        smoother.filter(block)
    with pytest.raises(ValueError, match="from sample 60 is due, not that from sample 0"):
        smoother.smooth(blocks[0])
    for block in reversed(blocks):
        smoother.smooth(block)
    with pytest.raises(ValueError, match="none is due"):
        smoother.smooth(blocks[0])
    with pytest.raises(ValueError, match="on its way back"):
        smoother.filter(blocks[0])
