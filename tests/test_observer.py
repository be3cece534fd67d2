"""The observer against filterpy sample by sample, and its own claims against Monte Carlo."""

import copy

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_discrete_are

from estimators.augmented import Disturbances, van_loan
from estimators.observer import Observer
from estimators.types import StateEstimate
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import ForceActuator, Plant, Sensor
from twin.plant.files import load_plant
from twin.plant.inputs import driven_model

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
DRIVEN = (
    "table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current", "shaker_voltage", "vcm",
)  # fmt: skip


def rig_observer(channels: tuple[str, ...] = DRIVEN, **options: int) -> Observer:
    return Observer(load_plant("rig"), channels, RATE_HZ, frequency_hz=50.0, **options)


def blocks_of(
    values: Array, channels: tuple[str, ...], rate_hz: float, cuts: list[int] | None = None
) -> list[Block]:
    names, first, blocks = tuple(Channel(c, "") for c in channels), 0, []
    for piece in np.split(values, sorted(cuts or [])):
        if len(piece):
            blocks.append(make_block(first, rate_hz, piece, names))
            first += len(piece)
    return blocks


def oracle_of(observer: Observer) -> KalmanFilter:
    """A filterpy filter of its own with the observer's matrices and present state."""
    return copy.deepcopy(observer.filter)


def by_filterpy(
    kf: KalmanFilter,
    feedthrough: Array,
    u: Array,
    z: Array,
    valid: NDArray[np.bool_] | None = None,
    before: Array | None = None,
) -> Array:
    """Means after each sample by filterpy's own predict and update; leaves P in ``kf``."""
    means, before = [], u[0] if before is None else before
    full_h, full_r = kf.H.copy(), kf.R.copy()
    for k in range(len(z)):
        kf.predict(u=np.concatenate([before, u[k]])[:, None])
        rows = np.arange(len(full_h)) if valid is None else np.flatnonzero(valid[k])
        if len(rows):
            kf.dim_z = len(rows)
            residue = (z[k] - feedthrough @ u[k])[rows]
            kf.update(residue[:, None], R=full_r[np.ix_(rows, rows)], H=full_h[rows])
        before = u[k]
        means.append(kf.x[:, 0].copy())
    return np.array(means)


def model_data(observer: Observer, u: Array, seed: int, *, start: Array | None = None) -> tuple[Array, Array]:
    """States and measurements of a plant that is exactly the observer's model, its noises included."""
    kf, rng = observer.filter, np.random.default_rng(seed)
    n = len(kf.F)
    # Q is far from full rank to working precision: its root from the eigenvalues.
    values, vectors = np.linalg.eigh(kf.Q)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    x = root_of(observer.steady_covariance) @ rng.standard_normal(n) if start is None else start.copy()
    w = rng.standard_normal((len(u), n)) @ root.T
    v = rng.standard_normal((len(u), len(kf.H))) * np.sqrt(np.diag(kf.R))
    states, z, before = np.empty((len(u), n)), np.empty((len(u), len(kf.H))), u[0]
    for k in range(len(u)):
        x = kf.F @ x + kf.B @ np.concatenate([before, u[k]]) + w[k]
        states[k], z[k], before = x, kf.H @ x + observer.feedthrough @ u[k] + v[k], u[k]
    return states, z


def root_of(P: Array) -> Array:
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def drives(n: int) -> Array:
    """Coil reference [A] in steps and shaker voltage [V], in the plant's order of actuators."""
    t = np.arange(n) / RATE_HZ
    return np.stack([0.5 * np.sign(np.sin(2 * np.pi * 80.0 * t)), 4.0 * np.sin(2 * np.pi * 50.0 * t)], axis=1)


def rig_values(u: Array, z: Array) -> Array:
    """Columns of `DRIVEN`: four measurements, then the shaker's voltage and the coil's reference."""
    return np.column_stack([z, u[:, 1], u[:, 0]])


def relative(got: Array, expected: Array) -> float:
    return float(np.max(np.abs(got - expected) / np.max(np.abs(expected), axis=0)))


def relative_covariance(got: Array, expected: Array) -> float:
    std = np.sqrt(np.diag(expected))
    return float(np.max(np.abs(got - expected) / np.outer(std, std)))


# --- against filterpy ---------------------------------------------------------------------------------------


def test_full_covariance_is_filterpys_sample_by_sample() -> None:
    observer = rig_observer(settle_samples=10**9)
    observer.filter.P = 30.0 * observer.steady_covariance  # from a state of less knowledge than steady
    observer._settled = False
    u = drives(1500)
    _, z = model_data(observer, u, seed=1)
    oracle = oracle_of(observer)
    expected = by_filterpy(oracle, observer.feedthrough, u, z)
    (block,) = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ)
    estimate = observer.advance(block)
    assert relative(estimate.mean, expected) <= 1e-8
    assert relative_covariance(estimate.covariance, oracle.P) <= 1e-8
    # The filterpy object holds the same: one may go on with it.
    np.testing.assert_array_equal(observer.filter.x[:, 0], estimate.mean[-1])


def test_constant_gain_is_filterpys_at_the_riccati_solution() -> None:
    observer = rig_observer()
    u = drives(2000)
    _, z = model_data(observer, u, seed=2)
    oracle = oracle_of(observer)
    expected = by_filterpy(oracle, observer.feedthrough, u, z)
    (block,) = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ)
    estimate = observer.advance(block)
    assert relative(estimate.mean, expected) <= 1e-10
    assert relative_covariance(estimate.covariance, oracle.P) <= 1e-7


def test_steady_covariance_solves_the_riccati_equation() -> None:
    observer = rig_observer()
    kf = observer.filter
    scale = np.sqrt(np.diag(observer.steady_covariance))
    prior = kf.F @ observer.steady_covariance @ kf.F.T + kf.Q
    gain = prior @ kf.H.T @ np.linalg.inv(kf.H @ prior @ kf.H.T + kf.R)
    posterior = prior - gain @ kf.H @ prior
    np.testing.assert_allclose(
        posterior / np.outer(scale, scale), observer.steady_covariance / np.outer(scale, scale), atol=1e-9
    )
    by_scipy = solve_discrete_are(kf.F.T, kf.H.T, kf.Q, kf.R)
    std = np.sqrt(np.diag(prior))
    np.testing.assert_allclose(prior / np.outer(std, std), by_scipy / np.outer(std, std), atol=1e-6)


@settings(deadline=None, max_examples=15)
@given(share=st.floats(0.0, 0.9), seed=st.integers(0, 10_000))
def test_invalid_samples_are_skipped_as_if_never_taken(share: float, seed: int) -> None:
    observer = rig_observer()
    u = drives(300)
    _, z = model_data(observer, u, seed=seed)
    valid = np.random.default_rng(seed).random(z.shape) >= share
    oracle = oracle_of(observer)
    expected = by_filterpy(oracle, observer.feedthrough, u, z, valid)
    (block,) = blocks_of(rig_values(u, np.where(valid, z, np.nan)), DRIVEN, RATE_HZ)
    estimate = observer.advance(block)
    assert relative(estimate.mean, expected) <= 1e-8
    assert relative_covariance(estimate.covariance, oracle.P) <= 1e-7


@pytest.mark.parametrize("full_samples", [0, 10**9])
def test_force_that_an_accelerometer_feels_at_once_is_fed_through(full_samples: int) -> None:
    # a = (f - c v - k x)/m: without D u the innovation would hold the whole force.
    plant = Plant(
        name="mass",
        body=load_plant("rig").body[:1],
        actuator=(ForceActuator(name="push", kind="force", on="table"),),
        sensor=(Sensor(name="a", kind="acceleration", of="table", noise_density=1e-3),),
    )
    observer = Observer(plant, ("a", "push"), 1000.0)
    assert observer.feedthrough == pytest.approx(np.array([[1.0 / plant.body[0].mass_kg]]))
    observer._settled = full_samples == 0  # both kernels
    u = np.where(np.arange(400) % 40 < 20, 5.0, -5.0)[:, None]
    _, z = model_data(observer, u, seed=4)
    expected = by_filterpy(oracle_of(observer), observer.feedthrough, u, z)
    estimate = observer.advance(
        make_block(0, 1000.0, np.column_stack([z, u]), (Channel("a", ""), Channel("push", "")))
    )
    assert relative(estimate.mean, expected) <= 1e-10
    assert estimate.nis == pytest.approx(1.0, abs=6.0 * np.sqrt(2.0 / 400.0))


@settings(deadline=None, max_examples=15)
@given(cuts=st.lists(st.integers(1, 999), max_size=6, unique=True))
def test_where_a_run_is_cut_into_blocks_changes_no_bit_of_the_estimate(cuts: list[int]) -> None:
    u = drives(1000)
    _, z = model_data(rig_observer(), u, seed=5)

    def run(where: list[int]) -> bytes:
        observer = rig_observer()
        observer._settled = False
        pieces = [observer.advance(b).mean for b in blocks_of(rig_values(u, z), DRIVEN, RATE_HZ, where)]
        return np.concatenate(pieces).tobytes() + observer.filter.P.tobytes()

    assert run(cuts) == run([])


def test_gain_frozen_after_a_model_change_is_within_a_millionth_of_the_exact_filter() -> None:
    observer = rig_observer()
    plant = load_plant("rig").with_damping("absorber", 8.0)
    u = drives(6000)
    _, z = model_data(observer, u, seed=6)
    first, second = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ, [1000])
    observer.advance(first)
    observer.set_model(plant, *driven_model(plant, observer.sources, RATE_HZ, 50.0))
    oracle = oracle_of(observer)
    expected = by_filterpy(oracle, observer.feedthrough, u[1000:], z[1000:], before=u[999])
    got = observer.advance(second).mean
    assert relative(got, expected) <= 1e-6
    assert relative_covariance(observer.filter.P, oracle.P) <= 1e-3


def test_after_a_gap_the_full_covariance_takes_over_again() -> None:
    observer = rig_observer()
    u = drives(1500)
    _, z = model_data(observer, u, seed=7)
    valid = np.ones(z.shape, dtype=bool)
    valid[600:900] = False
    expected = by_filterpy(oracle_of(observer), observer.feedthrough, u, z, valid)
    means = [
        observer.advance(b).mean
        for b in blocks_of(rig_values(u, np.where(valid, z, np.nan)), DRIVEN, RATE_HZ, [500, 1000, 1200])
    ]
    assert relative(np.concatenate(means)[:1200], expected[:1200]) <= 1e-8


# --- process noise ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_white_noise_over_a_sample_adds_the_integral_of_van_loan(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(4, 4))
    root = rng.normal(size=(4, 2))
    W, dt = root @ root.T, 0.3
    expected, _ = quad_vec(lambda s: expm(A * s) @ W @ expm(A * s).T, 0.0, dt, epsabs=1e-13, epsrel=1e-12)
    np.testing.assert_allclose(van_loan(A, W, dt), expected, rtol=1e-10, atol=1e-13)


def test_white_force_shakes_a_free_mass_as_an_integrated_wiener_process() -> None:
    # density S one-sided, S²/2 two-sided: q [dt³/3, dt²/2; dt²/2, dt]
    q, dt = (0.5 / 2.0) ** 2 / 2.0, 0.01
    Q = van_loan(np.array([[0.0, 1.0], [0.0, 0.0]]), np.diag([0.0, q]), dt)
    np.testing.assert_allclose(Q, q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), rtol=1e-9)


def test_disturbances_enter_with_half_their_one_sided_density() -> None:
    plant = load_plant("engine")
    observer = Observer(
        plant, ("case_displacement",), 1000.0, disturbances=Disturbances(force_n=3.0, voltage_v=0.2)
    )
    for row, body in enumerate(plant.body):
        # Over a sample short against the body's period the velocity walks by S²/2 dt/m².
        walked = 3.0**2 / 2.0 / 1000.0 / body.mass_kg**2
        assert observer.filter.Q[2 + row, 2 + row] == pytest.approx(walked, rel=0.15)
    rig = Observer(load_plant("rig"), DRIVEN, 5e6, frequency_hz=50.0, disturbances=Disturbances(0.0, 0.2))
    row = rig.states.index("i_shaker")
    walked = rig.filter.B[:, 1] + rig.filter.F @ rig.filter.B[:, 3]
    measured = (1e-5**2 * 5e6 / 2.0) * walked[row] ** 2
    assert rig.filter.Q[row, row] - measured == pytest.approx(0.2**2 / 2.0 / 5e6 / 0.0018**2, rel=1e-3)


def test_noise_of_a_measured_drive_enters_as_uncertainty_of_the_state() -> None:
    commanded = rig_observer((*DRIVEN[:4], "shaker", "vcm"))
    measured = rig_observer()
    row = measured.states.index("i_shaker")
    added = measured.filter.Q[row, row] - commanded.filter.Q[row, row]
    variance = 1e-5**2 * RATE_HZ / 2.0
    # One sample of noise acts over two intervals, the one it ends and the one it begins.
    walked = measured.filter.B[:, 1] + measured.filter.F @ measured.filter.B[:, 3]
    assert added == pytest.approx(variance * walked[row] ** 2, rel=1e-6)


# --- its claims ---------------------------------------------------------------------------------------------


def test_innovations_of_a_true_model_are_as_large_as_expected() -> None:
    observer = rig_observer()
    u = drives(15_000)
    _, z = model_data(observer, u, seed=8)
    estimates = [observer.advance(b) for b in blocks_of(rig_values(u, z), DRIVEN, RATE_HZ, [5000, 10_000])]
    # 60,000 independent squares of a standard normal: 1 within four of its standard deviations.
    nis = float(np.mean([e.nis for e in estimates]))
    assert nis == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 60_000.0))
    for e in estimates:
        assert e.innovation_rms / e.innovation_std == pytest.approx(1.0, abs=5.0 * np.sqrt(0.5 / 5000.0))


def test_wrong_damping_shows_in_the_innovations() -> None:
    observer = rig_observer()
    truth = Observer(load_plant("rig").with_damping("absorber", 25.0), DRIVEN, RATE_HZ, frequency_hz=50.0)
    u = drives(10_000)
    _, z = model_data(truth, u, seed=9)
    (block,) = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ)
    assert observer.advance(block).nis > 1.05


def test_errors_of_the_state_are_as_large_as_the_covariance_says() -> None:
    runs, errors, estimate = 50, [], None
    u = drives(400)
    for seed in range(runs):
        observer = rig_observer()
        states, z = model_data(observer, u, seed=100 + seed)
        (block,) = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ)
        estimate = observer.advance(block)
        errors.append(estimate.mean[-1] - states[-1])
    assert isinstance(estimate, StateEstimate)
    e, P = np.array(errors), estimate.covariance
    n = e.shape[1]
    assert np.mean(np.abs(e) > 3.0 * np.sqrt(np.diag(P))) < 0.02  # 0.3 % expected
    # Normalised squared error: chi-squared with n degrees in each run.
    scale = np.sqrt(np.diag(P))
    squares = np.einsum("ri,ij,rj->r", e / scale, np.linalg.inv(P / np.outer(scale, scale)), e / scale)
    assert np.mean(squares) == pytest.approx(n, abs=4.0 * np.sqrt(2.0 * n / runs))


def test_observer_works_with_every_input_unknown() -> None:
    channels = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current")
    observer = Observer(
        load_plant("rig"), channels, RATE_HZ, frequency_hz=50.0,
        disturbances=Disturbances(force_n=0.3, voltage_v=0.3),
    )  # fmt: skip
    # Current of the shaker is its only record: it drives the model and is no measurement.
    assert observer.sensors == ("table_acceleration", "absorber_acceleration")
    sensors_only = Observer(
        load_plant("engine"),
        ("case_displacement", "case_velocity"),
        1000.0,
        disturbances=Disturbances(force_n=50.0),
    )
    assert [s.channel for s in sensors_only.sources] == [None]
    truth, z = model_data(sensors_only, np.zeros((4000, 1)), seed=12)
    block = make_block(0, 1000.0, z, (Channel("case_displacement", ""), Channel("case_velocity", "")))
    estimate = sensors_only.advance(block)
    assert estimate.nis == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 8000.0))
    row = sensors_only.states.index("v_absorber")  # measured by nothing
    error = (estimate.mean - truth)[:, row]
    assert np.std(error) < 0.5 * np.std(truth[:, row])


def test_beam_is_observed_better_when_its_drive_is_known() -> None:
    beam = load_plant("beam")
    quiet = {"disturbance_density_n": 0.0005, "disturbance_drift_n_s": None}
    beam = beam.model_copy(update={"body": tuple(b.model_copy(update=quiet) for b in beam.body)})
    actuator, sensor = beam.actuator[0].name, beam.sensor[0].name
    knows = Observer(beam, (sensor, actuator), 100.0)
    t = np.arange(3000) / 100.0
    u = (200.0 * np.sin(2 * np.pi * 8.0 * t))[:, None]
    truth, z = model_data(knows, u, seed=13)
    values = np.column_stack([z, u])
    ignorant = Observer(beam, (sensor,), 100.0)
    by_knowing = knows.advance(make_block(0, 100.0, values, (Channel(sensor, ""), Channel(actuator, ""))))
    by_guessing = ignorant.advance(make_block(0, 100.0, z, (Channel(sensor, ""),)))
    speed = knows.states.index("v_beam") if "v_beam" in knows.states else 1
    errors = [np.std((e.mean - truth)[500:, speed]) for e in (by_knowing, by_guessing)]
    assert errors[0] < 0.7 * errors[1]
    assert by_knowing.nis == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 3000.0))
    assert by_guessing.nis > 1.2


def test_block_without_a_valid_sample_leaves_the_prediction_and_says_so() -> None:
    observer = rig_observer()
    u = drives(1000)
    _, z = model_data(observer, u, seed=14)
    first, second = blocks_of(rig_values(u, z), DRIVEN, RATE_HZ, [500])
    observer.advance(first)
    lost = make_block(500, RATE_HZ, np.full((500, 6), np.nan), second.channels)
    estimate = observer.advance(lost)
    assert np.all(np.isfinite(estimate.mean))
    assert np.isnan(estimate.nis)
    assert np.all(np.isnan(estimate.innovation_rms))
    assert np.all(np.diag(estimate.covariance) > np.diag(observer.steady_covariance))


def test_channels_that_are_no_sensor_of_the_plant_are_refused_with_what_it_knows() -> None:
    with pytest.raises(ValueError, match=r"none of the channels speed .* it knows table_acceleration"):
        Observer(load_plant("rig"), ("speed",), RATE_HZ, frequency_hz=50.0)
