"""The beam preset against the recordings it was fitted on, and against the half it has not seen."""

from pathlib import Path

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import least_squares, minimize_scalar

from estimators.observer import Observer
from twin.plant.blocks import Channel, make_block
from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.rig.foreign import open_foreign

Array = NDArray[np.float64]
STEP_S = 0.01
FITTED, HELD_OUT = slice(0, 1200), slice(1200, 2400)
RELEASED = slice(824, 1100)  # the hand has let go; until 1100 the motion is above the laser's noise
BEAM_KG = 2700.0 * 0.550 * 0.040 * 0.003


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_plant("beam")


@pytest.fixture(scope="module")
def recorded(realdata: Path, plant: Plant) -> tuple[Array, Array]:
    recording = open_foreign(realdata / "beam_closed_lq.npz", plant)
    assert [c.name for c in recording.channels] == ["tip_displacement", "piezo"]
    return recording.values[:, 0], recording.values[:, 1]


def held_step(hz: float, ratio: float, gain: float) -> tuple[Array, Array]:
    """One step of x'' + 2 ratio w x' + w² x = gain u with u held (gain in m/s² per V)."""
    w = 2.0 * np.pi * hz
    block = np.zeros((3, 3))
    block[:2] = [[0.0, 1.0, 0.0], [-w * w, -2.0 * ratio * w, gain]]
    full = expm(block * STEP_S)
    return full[:2, :2], full[:2, 2:]


def fit_free_run(y: Array, u: Array) -> Array:
    """Frequency [Hz], damping ratio and gain [m/s² per V] of a free run, by output error.

    The model runs on its own from a fitted first state with a fitted offset; only its output is compared, so
    neither the laser's noise nor the feedback behind u biases it (an equation-error fit would double the
    damping).
    """

    def residual(p: Array) -> Array:
        F, G = held_step(p[0], p[1], p[2])
        x, out = np.array([p[3] * 1e-3, p[4] * 0.1]), np.empty(len(y))
        for k in range(len(y)):
            out[k] = x[0]
            x = F @ x + G[:, 0] * u[k]
        return np.asarray((out - y) * 1e3 + p[5])

    first = [8.2, 0.005, -0.004, y[0] * 1e3, 0.0, 0.0]
    return np.asarray(least_squares(residual, first, x_scale=[0.01, 0.001, 0.01, 1.0, 1.0, 0.1]).x[:3])


def innovations(
    plant: Plant, y: Array, u: Array, *, density_n: float, drift_n_s: float = 0.0, delay: int = 0
) -> tuple[Array, Array]:
    """Innovations [m] of a Kalman filter of the beam and their predicted variances [m²].

    ``density_n`` is a white force on the tip [N/sqrt(Hz), one-sided]; ``drift_n_s`` makes a third state, a
    force whose rate is white [N/s/sqrt(Hz), one-sided].
    """
    body, piezo, laser = plant.body[0], plant.find_actuator("piezo"), plant.sensor[0]
    m = body.mass_kg
    A = np.array(
        [[0.0, 1.0, 0.0], [-body.stiffness_n_m / m, -float(body.damping_ns_m) / m, 1.0 / m], [0.0, 0.0, 0.0]]  # type: ignore[arg-type]
    )
    B = np.array([[0.0], [-piezo.force_constant_n_v / m], [0.0]])  # type: ignore[union-attr, operator]
    W = np.diag([0.0, (density_n / m) ** 2, drift_n_s**2]) / 2.0
    held = expm(np.block([[A, B], [np.zeros((1, 4))]]) * STEP_S)
    loan = expm(np.block([[-A, W], [np.zeros((3, 3)), A.T]]) * STEP_S)
    n = 3 if drift_n_s else 2
    kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=1)
    kf.F, kf.B, kf.Q = held[:n, :n], held[:n, 3:], (loan[3:, 3:].T @ loan[:3, 3:])[:n, :n]
    kf.H, kf.R = np.eye(1, n), np.array([[laser.noise_variance(1.0 / STEP_S)]])
    kf.P = np.diag([1e-4, 1.0, 1.0])[:n, :n]
    out, variance = np.empty(len(y)), np.empty(len(y))
    for k, sample in enumerate(y):
        if k:
            kf.predict(u=np.array([[u[k - 1 - delay] if k > delay else 0.0]]))
        kf.update(sample)
        out[k], variance[k] = kf.y.item(), kf.S.item()
    return out, variance


def nrmse(innovation: Array, y: Array) -> float:
    return float(np.sqrt(np.mean(innovation**2)) / np.std(y))


def test_plant_file_carries_what_a_refit_of_the_fitted_rows_gives(
    plant: Plant, recorded: tuple[Array, Array]
) -> None:
    y, u = (column[RELEASED] for column in recorded)
    hz, ratio, gain = fit_free_run(y, u)
    body, piezo = plant.body[0], plant.find_actuator("piezo")
    w = 2.0 * np.pi * hz
    assert body.mass_kg == pytest.approx(BEAM_KG / 4.0, rel=1e-3)
    assert body.stiffness_n_m == pytest.approx(body.mass_kg * w * w, rel=1e-3)
    assert body.damping_ns_m == pytest.approx(2.0 * ratio * w * body.mass_kg, rel=5e-3)
    assert gain < 0.0
    assert piezo.pushes[0] == ("tip", -1.0)
    assert piezo.force_constant_n_v == pytest.approx(-gain * body.mass_kg, rel=5e-3)  # type: ignore[union-attr]


def test_voltage_acts_from_its_own_row_on(recorded: tuple[Array, Array]) -> None:
    y, u = recorded
    fits = {}
    for delay in (0, 1):
        p = fit_free_run(y[RELEASED], u[RELEASED.start - delay : RELEASED.stop - delay])
        F, G = held_step(*p)
        columns = _responses(F, G, u[RELEASED.start - delay : RELEASED.stop - delay])
        fits[delay] = float(np.sqrt(np.mean(_left_over(columns, y[RELEASED]) ** 2)))
    assert fits[0] == pytest.approx(0.141e-3, rel=0.02)
    assert fits[1] > 1.3 * fits[0]


def _responses(F: Array, G: Array, u: Array) -> Array:
    """Free response to either initial state, response to u, and a constant, as columns."""
    x = np.column_stack([np.eye(2), np.zeros(2)])
    rows = []
    for sample in u:
        rows.append([*x[0], 1.0])
        x = F @ x
        x[:, 2] += G[:, 0] * sample
    return np.array(rows)


def _left_over(columns: Array, y: Array) -> Array:
    y = y - columns[:, 2]  # the gain is fitted already
    free = columns[:, [0, 1, 3]]
    return np.asarray(y - free @ np.linalg.lstsq(free, y)[0])


def test_sensor_noise_is_that_of_the_quiet_beam(plant: Plant, realdata: Path) -> None:
    with np.load(realdata / "beam_open.npz") as arrays:
        quiet_m = arrays["y"][:800].std() * 1e-3
    assert plant.sensor[0].noise_density == pytest.approx(quiet_m / np.sqrt(1.0 / STEP_S / 2.0), rel=0.01)


def test_wandering_force_is_the_likeliest_on_the_fitted_rows(
    plant: Plant, recorded: tuple[Array, Array]
) -> None:
    y, u = (column[FITTED] for column in recorded)

    def cost(log_drift: float) -> float:
        e, s = innovations(plant, y, u, density_n=0.0, drift_n_s=float(np.exp(log_drift)))
        return float(np.mean(np.log(s) + e**2 / s))

    best = minimize_scalar(cost, bracket=(np.log(0.2), np.log(1.0)), tol=1e-3)
    assert plant.body[0].disturbance_drift_n_s == pytest.approx(np.exp(best.x), rel=0.02)


def test_known_voltage_improves_prediction_of_rows_it_was_not_fitted_on(
    plant: Plant, recorded: tuple[Array, Array]
) -> None:
    y, u = (column[HELD_OUT] for column in recorded)
    drift = plant.body[0].disturbance_drift_n_s
    assert drift is not None
    informed, _ = innovations(plant, y, u, density_n=0.0, drift_n_s=drift)
    blind, _ = innovations(plant, y, 0.0 * u, density_n=0.0, drift_n_s=drift)
    assert nrmse(informed, y) == pytest.approx(0.0681, abs=0.0005)
    assert nrmse(informed, y) < nrmse(blind, y)


def test_a_held_beam_needs_a_force_that_lasts(plant: Plant, recorded: tuple[Array, Array]) -> None:
    # The hand holds the tip 14 mm out for a second: no white force explains that, a drifting one does.
    y, u = (column[HELD_OUT] for column in recorded)
    drifting, _ = innovations(plant, y, u, density_n=0.0, drift_n_s=0.53)
    white, _ = innovations(plant, y, u, density_n=0.0629)
    straight_on = y[2:] - 2.0 * y[1:-1] + y[:-2]
    assert nrmse(drifting, y) < nrmse(straight_on, y) < nrmse(white, y)


def test_observer_predicts_the_beam_as_the_reference_filter_does(
    plant: Plant, recorded: tuple[Array, Array]
) -> None:
    y, u = recorded
    channels = ("tip_displacement", "piezo")
    columns = tuple(Channel(name, unit) for name, unit in zip(channels, ("m", "V"), strict=True))
    observer = Observer(plant, channels, 1.0 / STEP_S)
    block = make_block(1200, 1.0 / STEP_S, np.column_stack([y, u])[HELD_OUT], columns)
    estimate = observer.advance(block)
    informed, _ = innovations(
        plant, y[HELD_OUT], u[HELD_OUT], density_n=0.0, drift_n_s=plant.body[0].disturbance_drift_n_s or 0.0
    )
    # The two start from different covariances; that is forgotten within a few rows.
    assert estimate.innovation_rms[0] == pytest.approx(float(np.sqrt(np.mean(informed**2))), rel=0.01)


def test_offset_of_the_laser_does_not_matter(plant: Plant, recorded: tuple[Array, Array]) -> None:
    y, u = (column[HELD_OUT] for column in recorded)
    with_offset, _ = innovations(plant, y, u, density_n=0.0629)
    without, _ = innovations(plant, y + 0.0165e-3, u, density_n=0.0629)
    assert nrmse(with_offset, y) == pytest.approx(nrmse(without, y), rel=2e-3)
