"""Monte Carlo: the observer's own claims about its errors, against plants simulated from physical causes.

The truth is simulated apart from the observer: forces and voltages shake it, inputs are measured with noise, sensors
have theirs. Only the densities are shared. Seeds are fixed: one in twenty sound samples lies outside a 95 % band.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import chi2

from estimators.augmented import Disturbances
from estimators.observer import Observer
from twin.plant.blocks import Channel, make_block
from twin.plant.config import ForceActuator, Plant, Sensor
from twin.plant.discrete import discretise
from twin.plant.files import load_plant
from twin.plant.inputs import InputSource
from twin.plant.linear import linear_model

Array = NDArray[np.float64]
RATE_HZ, SAMPLES, RUNS = 5_000.0, 1_200, 200
FORCE_N, VOLTAGE_V = 0.02, 1e-3


def white_over_a_sample(A: Array, intensity: Array, dt: float) -> Array:
    """Root of the covariance of white noise over one sample, by Simpson's rule on the integral itself."""
    steps = 4000
    weights = np.ones(steps + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    step, E, total = expm(A * dt / steps), np.eye(len(A)), np.zeros_like(A)
    for weight in weights:
        total += weight * E @ intensity @ E.T
        E = step @ E
    values, vectors = np.linalg.eigh(total * dt / steps / 3.0)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def simulated(plant: Plant, sources: tuple[InputSource, ...], runs: int, seed: int) -> dict[str, Array]:
    """Runs of a plant at rest to begin with, (runs, SAMPLES, ...) by channel, and its states under ``states``."""
    rng, dt = np.random.default_rng(seed), 1.0 / RATE_HZ
    model = linear_model(
        plant, frequency_hz=50.0, current_driven=[s.actuator for s in sources if s.by_current]
    )
    d = discretise(model, RATE_HZ, [s.hold for s in sources])
    intensity = np.zeros_like(model.A)
    for row, state in enumerate(model.states):
        kind, name = state.split("_", 1)
        if kind == "v":
            intensity[row, row] = (FORCE_N / plant.find_body(name).mass_kg) ** 2 / 2.0
        elif kind == "i":
            intensity[row, row] = (VOLTAGE_V / plant.find_actuator(name).inductance_h) ** 2 / 2.0
    root = white_over_a_sample(model.A, intensity, dt)
    t = np.arange(SAMPLES) * dt
    u = np.stack([3.0 * np.sin(2.0 * np.pi * (40.0 + 9.0 * j) * t + j) for j in range(len(sources))], axis=1)
    u[:, [s.hold == "zoh" for s in sources]] = np.round(u[:, [s.hold == "zoh" for s in sources]])
    x, before = np.zeros((runs, len(model.A))), u[0]
    states, outputs = np.empty((runs, SAMPLES, len(model.A))), np.empty((runs, SAMPLES, len(model.outputs)))
    for k in range(SAMPLES):
        x = x @ d.F.T + d.B0 @ before + d.B1 @ u[k] + rng.standard_normal(x.shape) @ root.T
        states[:, k], outputs[:, k], before = x, x @ d.C.T + d.D @ u[k], u[k]
    found = {"states": states}
    for column, name in enumerate(model.outputs):
        sensor = next(s for s in plant.sensor if s.name == name)
        noise = rng.standard_normal((runs, SAMPLES)) * np.sqrt(sensor.noise_variance(RATE_HZ))
        found[name] = outputs[:, :, column] + noise
    for j, source in enumerate(sources):
        noise = rng.standard_normal((runs, SAMPLES)) * source.noise_density * np.sqrt(RATE_HZ / 2.0)
        found[str(source.channel)] = u[:, j] + noise
    return found


def consistency(
    plant: Plant, channels: tuple[str, ...], *, frozen: bool, seed: int
) -> tuple[Array, Array, Array]:
    """NEES (times, RUNS) of the linear model's states, NIS sums (RUNS,) and how many innovations each sums."""

    def observer() -> Observer:
        return Observer(
            plant, channels, RATE_HZ, frequency_hz=50.0, disturbances=Disturbances(FORCE_N, VOLTAGE_V)
        )  # fmt: skip

    first = observer()
    data = simulated(plant, first.sources, RUNS, seed)
    n = data["states"].shape[2]
    names, cuts = tuple(Channel(c, "") for c in channels), range(300, SAMPLES + 1, 300)
    nees, nis, count = np.empty((len(cuts), RUNS)), np.zeros(RUNS), np.zeros(RUNS)
    for run in range(RUNS):
        one = observer()
        values = np.column_stack([data[c][run] for c in channels])
        # At rest for certain at the start: what the filter says of that is made true by drawing its first guess.
        rng = np.random.default_rng(seed + 1 + run)
        scale = np.sqrt(np.diag(one.steady_covariance))
        root = np.linalg.cholesky(one.steady_covariance / np.outer(scale, scale) + 1e-12 * np.eye(len(scale)))
        guess = scale * (root @ rng.standard_normal(len(scale)))
        for j, state in enumerate(one.states):
            guess[j] = 0.0 if state.startswith("n_") else guess[j]
        one.filter.x[:, 0] = guess
        for k, end in enumerate(cuts):
            block = make_block(end - 300, RATE_HZ, values[end - 300 : end], names)
            got = one.advance(block, freeze=frozen)
            assert (one._modes is not None) == frozen
            e = (got.mean[-1, :n] - data["states"][run, end - 1]) / scale[:n]
            P = got.covariance[:n, :n] / np.outer(scale[:n], scale[:n])
            nees[k, run] = e @ np.linalg.solve(P, e)
            nis[run] += float(got.nis_per_sensor @ got.innovation_count)
            count[run] += got.innovation_count.sum()
    return nees, nis, count


def assert_in_band(sums: float, degrees: float) -> None:
    low, high = chi2.ppf([0.025, 0.975], degrees)
    assert low < sums < high, (sums, low, high)


RIG = (
    "table_acceleration",
    "absorber_acceleration",
    "vcm_current",
    "shaker_current",
    "shaker_voltage",
    "vcm",
)


@pytest.mark.parametrize("frozen", [False, True])
def test_rigs_errors_and_innovations_lie_in_their_bands(frozen: bool) -> None:
    nees, nis, count = consistency(load_plant("rig"), RIG, frozen=frozen, seed=20 + frozen)
    for errors in nees:
        assert_in_band(float(errors.sum()), 6.0 * RUNS)
    assert_in_band(float(nis.sum()), float(count.sum()))
    low, high = chi2.ppf([0.025, 0.975], count[0])
    # 95 % of the runs, within three standard deviations of such a share.
    assert abs(np.mean((nis > low) & (nis < high)) - 0.95) < 3.0 * np.sqrt(0.95 * 0.05 / RUNS)


def pushed_mass() -> Plant:
    """Two masses, a measured force that an accelerometer feels at once, its load cell noisier than anything else."""
    return Plant(
        name="pushed",
        body=load_plant("rig").with_damping("absorber", 7.0).body,
        actuator=(ForceActuator(name="push", kind="force", on="table"),),
        sensor=(
            Sensor(name="a", kind="acceleration", of="table", noise_density=1e-3),
            Sensor(name="x", kind="displacement", of="absorber", noise_density=1e-6),
            Sensor(name="cell", kind="force", of="push", noise_density=5e-2),
        ),
    )


@pytest.mark.parametrize("frozen", [False, True])
def test_noise_of_a_measured_force_that_an_accelerometer_feels_is_accounted_for_exactly(frozen: bool) -> None:
    nees, nis, count = consistency(pushed_mass(), ("a", "x", "cell"), frozen=frozen, seed=80 + frozen)
    for errors in nees:
        assert_in_band(float(errors.sum()), 4.0 * RUNS)
    assert_in_band(float(nis.sum()), float(count.sum()))


def test_a_measured_force_taken_for_exact_would_fail_that() -> None:
    plant = pushed_mass()
    silent = plant.model_copy(
        update={
            "sensor": tuple(
                s.model_copy(update={"noise_density": 1e-9}) if s.name == "cell" else s for s in plant.sensor
            )
        }
    )
    first = Observer(plant, ("a", "x", "cell"), RATE_HZ, disturbances=Disturbances(FORCE_N, VOLTAGE_V))
    assert first.states[-1] == "n_push"
    data = simulated(plant, first.sources, 1, 50)
    believing = Observer(silent, ("a", "x", "cell"), RATE_HZ, disturbances=Disturbances(FORCE_N, VOLTAGE_V))
    values = np.column_stack([data[c][0] for c in ("a", "x", "cell")])
    block = make_block(0, RATE_HZ, values, tuple(Channel(c, "") for c in ("a", "x", "cell")))
    assert first.advance(block).nis < 1.2
    assert believing.advance(block).nis > 10.0


def test_a_current_that_drives_the_model_has_its_noise_in_both_accelerations() -> None:
    plant = load_plant("rig")
    loud = tuple(
        s.model_copy(update={"noise_density": 3e-3}) if s.kind == "current" else s for s in plant.sensor
    )
    channels = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_current")
    nees, nis, count = consistency(plant.model_copy(update={"sensor": loud}), channels, frozen=True, seed=61)
    for errors in nees:
        assert_in_band(float(errors.sum()), 4.0 * RUNS)
    assert_in_band(float(nis.sum()), float(count.sum()))
