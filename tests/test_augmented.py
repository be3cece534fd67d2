"""What the observer estimates beside the plant: an unknown force, and input stages that hold constant values back."""

import copy
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from estimators.augmented import Disturbances, UnknownForce, van_loan
from estimators.observer import SETTLED, Observer
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import ForceActuator, Plant, Sensor, Shaker
from twin.plant.discrete import discretise, simulate_block
from twin.plant.files import load_plant
from twin.plant.linear import linear_model

Array = NDArray[np.float64]
RATE_HZ, BLOCK = 5_000.0, 500
ENGINE = ("case_displacement", "absorber_displacement", "case_velocity", "absorber_velocity")


# --- unknown force ------------------------------------------------------------------------------------------


def shaken(plant: Plant, force_n: Array, inputs: tuple[str, ...], rng: np.random.Generator) -> Array:
    """What the sensors of `ENGINE` and the coil's show under a force on the case; the coil has steps to follow."""
    model = linear_model(plant)
    u = np.zeros((len(force_n), len(model.inputs)))
    u[:, model.inputs.index("excitation")] = force_n
    if "vcm" in model.inputs:
        u[:, model.inputs.index("vcm")] = 2.0 * np.sign(np.sin(0.004 * np.arange(len(force_n))))
    holds = ["foh" if name == "excitation" else "zoh" for name in model.inputs]
    d = discretise(model, RATE_HZ, holds)  # type: ignore[arg-type]
    y = np.empty((len(u), len(model.outputs)))
    simulate_block(d.F, d.B0, d.B1, d.C, d.D, np.zeros(len(d.F)), u[0].copy(), u, y)
    y += rng.standard_normal(y.shape) * np.sqrt([s.noise_variance(RATE_HZ) for s in plant.sensor])
    columns = {name: y[:, k] for k, name in enumerate(model.outputs)} | {
        name: u[:, k] for k, name in enumerate(model.inputs)
    }
    return np.column_stack([columns[name] for name in inputs])


def cut(values: Array, channels: tuple[str, ...]) -> list[Block]:
    names = tuple(Channel(c, "") for c in channels)
    return [
        make_block(k, RATE_HZ, values[k : k + BLOCK], names) for k in range(0, len(values) - BLOCK + 1, BLOCK)
    ]


@pytest.mark.parametrize(
    ("preset", "channels"), [("engine", ENGINE), ("engine_vcm", (*ENGINE, "vcm_current", "vcm"))]
)
def test_force_of_the_engine_is_recovered_within_its_standard_deviation(
    preset: str, channels: tuple[str, ...]
) -> None:
    plant, errors, stds = load_plant(preset), [], []
    t = np.arange(3000) / RATE_HZ
    for seed in range(40):
        rng = np.random.default_rng(seed)
        force = 1000.0 * np.cos(2.0 * np.pi * 50.0 * t + rng.uniform(0.0, 6.28))
        # Told 1.5 times the size: it must not matter.
        observer = Observer(plant, channels, RATE_HZ, unknown_force=UnknownForce("case", 50.0, 1500.0))
        estimates = [observer.advance(b) for b in cut(shaken(plant, force, channels, rng), channels)]
        unknown = observer.unknown_force
        assert unknown is not None
        amplitude, std = unknown.amplitude(estimates[-1])
        errors.append((amplitude - 1000.0) / std)
        stds.append(std)
        # Force itself, sample by sample, and the innovations.
        last = estimates[-1].mean[:, observer.states.index("f_case")]
        spread = math.sqrt(estimates[-1].covariance[(observer.states.index("f_case"),) * 2])
        assert np.sqrt(np.mean((last - force[-BLOCK:]) ** 2)) < 2.0 * spread
        assert np.mean([e.nis for e in estimates[1:]]) == pytest.approx(1.0, abs=0.06)
    assert 0.5 < stds[0] < 10.0  # of 1000 N
    # This force does not wander as it is allowed to: the errors may be smaller than stated, never larger.
    assert np.sqrt(np.mean(np.square(errors))) < 1.15
    assert np.max(np.abs(errors)) < 3.5
    assert np.abs(np.mean(errors)) < 0.5


def test_force_that_wanders_as_supposed_lies_in_its_band() -> None:
    plant, squares = load_plant("engine"), []
    unknown = UnknownForce("case", 50.0, 1000.0, amplitude_wander=0.3, frequency_std_hz=0.1)
    w, dt = 2.0 * np.pi * 50.0, 1.0 / RATE_HZ
    turn = np.array([[math.cos(w * dt), math.sin(w * dt)], [-math.sin(w * dt), math.cos(w * dt)]])
    for seed in range(100):
        rng = np.random.default_rng(seed)
        f = np.empty((1500, 2))
        f[0] = 1000.0 * rng.standard_normal(2)
        steps = math.sqrt(unknown.intensity_n2_s * dt) * rng.standard_normal(f.shape)
        for k in range(1, len(f)):
            f[k] = turn @ f[k - 1] + steps[k]
        observer = Observer(plant, ENGINE, RATE_HZ, unknown_force=unknown)
        for block in cut(shaken(plant, f[:, 0], ENGINE, rng), ENGINE):
            estimate = observer.advance(block)
        rows = [observer.states.index(name) for name in unknown.states]
        error = estimate.mean[-1, rows] - f[-1]
        squares.append(float(error @ np.linalg.solve(estimate.covariance[np.ix_(rows, rows)], error)))
    # Chi-squared with 2 degrees in each of 100 runs.
    assert 162.7 < np.sum(squares) < 241.1


def test_force_is_followed_through_a_sweep_without_losing_its_state() -> None:
    plant = load_plant("engine")
    seconds, rate = 9.0, 20.0 / 60.0  # 20 Hz in a minute
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    frequency = 48.5 + rate * t
    force = 1000.0 * np.sin(2.0 * np.pi * (48.5 * t + 0.5 * rate * t**2))
    blocks = cut(shaken(plant, force, ENGINE, np.random.default_rng(3)), ENGINE)
    observer = Observer(plant, ENGINE, RATE_HZ, unknown_force=UnknownForce("case", 48.5, 1000.0))
    errors = []
    for k, block in enumerate(blocks):
        x, P = observer.filter.x.copy(), observer.filter.P.copy()
        observer.set_excitation_frequency(float(frequency[k * BLOCK + BLOCK // 2]))
        np.testing.assert_array_equal(observer.filter.x, x)
        np.testing.assert_array_equal(observer.filter.P, P)
        estimate = observer.advance(block)
        assert observer.unknown_force is not None
        amplitude, std = observer.unknown_force.amplitude(estimate)
        if k >= 5:
            errors.append((amplitude - 1000.0) / std)
            assert std < 10.0
            assert estimate.nis == pytest.approx(1.0, abs=0.15)
    assert np.sqrt(np.mean(np.square(errors))) < 1.15
    left = Observer(plant, ENGINE, RATE_HZ, unknown_force=UnknownForce("case", 48.5, 1000.0))
    stale = [left.advance(block) for block in blocks]
    assert stale[-1].nis > 1.5  # a frequency that is not moved along does show


def test_unknown_force_is_refused_where_it_cannot_be() -> None:
    plant = load_plant("engine")
    with pytest.raises(ValueError, match="no body 'piston'; it has case, absorber"):
        Observer(plant, ENGINE, RATE_HZ, unknown_force=UnknownForce("piston", 50.0, 1000.0))
    for wrong in (
        {"frequency_hz": 0.0},
        {"amplitude_n": math.nan},
        {"hold_s": -1.0},
        {"amplitude_wander": -0.1},
    ):
        with pytest.raises(ValueError, match=f"unknown force on 'case': {next(iter(wrong))} is"):
            UnknownForce(**({"body": "case", "frequency_hz": 50.0, "amplitude_n": 1.0} | wrong))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no later change noticed"):
        UnknownForce("case", 50.0, 1000.0, amplitude_wander=0.0, frequency_std_hz=0.0)
    with pytest.raises(ValueError, match="has no unknown force"):
        Observer(plant, ENGINE, RATE_HZ).set_excitation_frequency(51.0)
    with pytest.raises(ValueError, match="frequency_hz is -1"):
        Observer(
            plant, ENGINE, RATE_HZ, unknown_force=UnknownForce("case", 50.0, 1.0)
        ).set_excitation_frequency(-1.0)


# --- sensors ------------------------------------------------------------------------------------------------


def by_filterpy(observer: Observer, u: Array, z: Array) -> Array:
    kf, means, before = copy.deepcopy(observer.filter), [], u[0]
    for k in range(len(z)):
        kf.predict(u=np.concatenate([before, u[k]])[:, None])
        kf.update((z[k] - observer.feedthrough @ u[k])[:, None])
        before = u[k]
        means.append(kf.x[:, 0].copy())
    return np.array(means)


def a_plant_with_everything(coupled_hz: float | None) -> Plant:
    """Every kind of sensor, a pair among them, a coil driven by its measured current, a force with a load cell."""
    sensors = [
        Sensor(name="x", kind="displacement", of="table", noise_density=1e-7, ac_coupled_hz=coupled_hz),
        Sensor(name="v", kind="velocity", of="absorber", noise_density=1e-5, ac_coupled_hz=coupled_hz),
        Sensor(name="a", kind="acceleration", of=("table", "absorber"), noise_density=1e-3),
        Sensor(name="a1", kind="acceleration", of="table", noise_density=1e-3, ac_coupled_hz=coupled_hz),
        Sensor(name="i", kind="current", of="shaker", noise_density=1e-4),
        Sensor(name="drive", kind="current", of="source", noise_density=1e-3),
        Sensor(name="cell", kind="force", of="push", noise_density=1e-2),
    ]
    rig = load_plant("rig").with_damping("absorber", 7.0)
    return Plant(
        name="everything",
        body=rig.body,
        actuator=(
            rig.find_actuator("shaker"),
            Shaker(name="source", kind="shaker", drive="current", on="absorber", force_constant_n_a=5.0),
            ForceActuator(name="push", kind="force", on="table"),
        ),
        sensor=tuple(sensors),
    )


CHANNELS = ("x", "v", "a", "a1", "i", "drive", "cell", "shaker")


@pytest.mark.parametrize("frozen", [False, True])
@pytest.mark.parametrize("coupled_hz", [None, 0.5])
def test_every_kind_of_sensor_is_filtered_as_by_filterpy(coupled_hz: float | None, frozen: bool) -> None:
    observer = Observer(a_plant_with_everything(coupled_hz), CHANNELS, RATE_HZ)
    assert observer.sensors == ("x", "v", "a", "a1", "i")
    coupled = ("h_x", "h_v", "h_a1") if coupled_hz else ()
    assert observer.states[5:] == (*coupled, "n_source", "n_push")
    rng = np.random.default_rng(7)
    u = np.column_stack([np.sign(rng.standard_normal(900)), *rng.standard_normal((2, 900))])
    z = rng.standard_normal((900, 5)) * np.sqrt(np.diag(observer.filter.R)) * 3.0
    expected = by_filterpy(observer, u, z)
    # Columns in the order of the channels: measurements, the measured current and force, the shaker's voltage.
    values = np.column_stack([z, u[:, 1], u[:, 2], u[:, 0]])
    (block,) = [make_block(0, RATE_HZ, values, tuple(Channel(c, "") for c in CHANNELS))]
    got = observer.advance(block, freeze=frozen)
    assert (observer._modes is not None) == frozen
    difference = np.max(np.abs(got.mean - expected) / np.max(np.abs(expected), axis=0))
    assert difference <= (1e-10 if frozen else 1e-8)


def test_coupled_sensor_shows_a_high_pass_of_what_the_sensor_alone_would() -> None:
    plain, coupled = (linear_model(a_plant_with_everything(hz)) for hz in (None, 2.0))
    f = np.geomspace(0.05, 500.0, 60)
    seen, raw = coupled.response(f), plain.response(f)
    high_pass = 1j * f / (2.0 + 1j * f)
    for row, name in enumerate(coupled.outputs):
        factor = high_pass if name in ("x", "v", "a1") else np.ones(len(f))
        expected = raw[:, row] * factor[:, None]
        np.testing.assert_allclose(seen[:, row], expected, rtol=1e-7, atol=1e-9 * np.max(np.abs(expected)))
    assert coupled.states[-3:] == ("h_x", "h_v", "h_a1")


def test_a_constant_force_leaves_a_coupled_sensor_and_stays_in_the_state() -> None:
    plant = a_plant_with_everything(2.0)
    model = linear_model(plant)
    d = discretise(model, RATE_HZ, ["zoh"] * 3)
    u = np.zeros((20_000, 3))
    u[:, 2] = 10.0
    y = np.empty((len(u), len(model.outputs)))
    x = np.zeros(len(d.F))
    simulate_block(d.F, d.B0, d.B1, d.C, d.D, x, np.zeros(3), u, y)
    assert abs(y[-1, 0]) < 1e-3 * abs(x[0])
    assert x[0] == pytest.approx(10.0 / 12300.0, rel=1e-3)
    # First-order step response, exact at the samples: SciPy on the raw sensor's samples agrees where it is slow.
    raw = linear_model(a_plant_with_everything(None))
    dr = discretise(raw, RATE_HZ, ["zoh"] * 3)
    bare = np.empty_like(y)
    simulate_block(dr.F, dr.B0, dr.B1, dr.C, dr.D, np.zeros(len(dr.F)), np.zeros(3), u, bare)
    b, a = signal.bilinear([1.0, 0.0], [1.0, 2.0 * np.pi * 2.0], RATE_HZ)
    np.testing.assert_allclose(
        y[:, 0], signal.lfilter(b, a, bare[:, 0]), atol=1e-5 * np.max(np.abs(bare[:, 0]))
    )


def test_slow_coupling_starts_settled() -> None:
    observer = Observer(a_plant_with_everything(0.01), CHANNELS, RATE_HZ)
    block = make_block(0, RATE_HZ, np.zeros((400, 8)), tuple(Channel(c, "") for c in CHANNELS))
    estimate = observer.advance(block, freeze=False)
    steady = np.diag(observer.steady_covariance)
    np.testing.assert_allclose(np.diag(estimate.covariance), steady, rtol=1e-6)


def test_plants_without_coupling_keep_their_fingerprint_and_those_with_it_have_their_own() -> None:
    plain, coupled = a_plant_with_everything(None), a_plant_with_everything(0.5)
    assert "ac_coupled_hz" not in str(plain.model_dump(mode="json"))
    assert plain.fingerprint != coupled.fingerprint
    assert Plant.model_validate(coupled.model_dump(mode="json"), strict=False) == coupled


# --- what must not come in ----------------------------------------------------------------------------------


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf, 1e200, 700.0])
@pytest.mark.parametrize("frozen", [False, True])
def test_value_that_is_no_number_or_beyond_the_range_counts_as_missing_though_called_valid(
    poison: float, frozen: bool
) -> None:
    channels = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_voltage", "vcm")

    def run(value: float, valid: bool) -> tuple[Array, Array, float]:
        observer = Observer(load_plant("rig"), channels, 50_000.0, frequency_hz=50.0)
        values = np.random.default_rng(9).standard_normal((300, 5)) * 0.1
        mask = np.ones(values.shape, dtype=bool)
        values[140:150, 0], mask[140:150, 0] = value, valid
        names = tuple(Channel(c, "") for c in channels)
        estimate = observer.advance(Block(0, 50_000.0, values, mask, names), freeze=frozen)
        assert estimate.innovation_count[0] == 290
        return estimate.mean, estimate.covariance, estimate.nis

    for got, expected in zip(run(poison, True), run(0.0, False), strict=True):
        np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("frozen", [False, True])
def test_input_that_is_no_number_repeats_the_one_before(frozen: bool) -> None:
    channels = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_voltage", "vcm")
    values = np.random.default_rng(10).standard_normal((300, 5)) * 0.1
    repeated = values.copy()
    values[50:60, 3], repeated[50:60, 3] = np.nan, values[49, 3]
    values[0, 4], repeated[0, 4] = np.inf, 0.0
    means = []
    for columns in (values, repeated):
        observer = Observer(load_plant("rig"), channels, 50_000.0, frequency_hz=50.0)
        block = Block(
            0, 50_000.0, columns, np.ones(columns.shape, dtype=bool), tuple(Channel(c, "") for c in channels)
        )
        means.append(observer.advance(block, freeze=frozen).mean)
    np.testing.assert_allclose(means[0], means[1], rtol=1e-9, atol=1e-12 * np.max(np.abs(means[1])))


# --- when the gain is frozen --------------------------------------------------------------------------------


def test_gain_is_frozen_at_the_end_of_the_first_stretch_with_every_variance_near_the_steady_one() -> None:
    channels = ("table_acceleration", "absorber_acceleration", "vcm_current", "shaker_voltage", "vcm")
    plant = load_plant("rig")
    observer, always = (
        Observer(plant, channels, 50_000.0, frequency_hz=50.0, settle_samples=100) for _ in range(2)
    )
    steady = np.diag(observer.steady_covariance)
    for one in (observer, always):
        one.filter.P = 4.0 * observer.steady_covariance
        one._settled = False
    values, frozen_at = np.random.default_rng(11).standard_normal((6000, 5)) * 0.1, None
    names, due = tuple(Channel(c, "") for c in channels), None
    for k in range(0, 6000, 50):  # two blocks to a stretch
        block = make_block(k, 50_000.0, values[k : k + 50], names)
        exact = always.advance(block, freeze=False)
        observer.advance(block)
        if frozen_at is None and observer._modes is not None:
            frozen_at = k
        near = np.max(np.abs(np.diag(exact.covariance) / steady - 1.0)) <= SETTLED
        if due is None and near and (k + 50) % 100 == 0:
            due = k + 50
    assert due is not None
    assert due > 200
    assert frozen_at == due
    # A block with a lost sample runs with the full covariance, and afterwards it must settle anew.
    values[0, 0] = np.nan
    before = observer._modes
    observer.advance(make_block(6000, 50_000.0, values[:50], names))
    assert observer._modes is before
    assert not observer._settled
    assert observer.filter.P[0, 0] != observer.steady_covariance[0, 0]


def test_stiff_circuit_leaves_van_loans_integral_exact() -> None:
    # A current loop decays by e^-79 within a sample: the inverse of that must not spoil the other states.
    A, W = np.diag([-79_000.0, -3.0]), np.diag([5.0, 2.0])
    expected = np.diag([5.0 / (2.0 * 79_000.0), 2.0 * (1.0 - math.exp(-2.0 * 3.0 * 1e-3)) / 6.0])
    np.testing.assert_allclose(van_loan(A, W, 1e-3), expected, rtol=1e-12, atol=1e-20)


def test_density_of_the_unknown_force_is_what_its_wander_says() -> None:
    unknown = UnknownForce("case", 50.0, 200.0, amplitude_wander=0.1, frequency_std_hz=0.0)
    observer = Observer(
        load_plant("engine"), ENGINE, RATE_HZ, disturbances=Disturbances(1.0), unknown_force=unknown
    )
    row = observer.states.index("f_case")
    # Amplitude by 10 % of 200 N in a second, shared by both components.
    assert observer.filter.Q[row, row] * RATE_HZ == pytest.approx(0.5 * 20.0**2, rel=1e-9)
