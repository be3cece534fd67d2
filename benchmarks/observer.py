"""Observer and recursive least squares against filterpy, on the same data."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from filterpy.kalman import KalmanFilter

from benchmarks.report import Report, Row
from benchmarks.timing import side_by_side
from estimators.kernels import rls3_block
from estimators.observer import Observer
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.discrete import discretise, simulate_block
from twin.plant.inputs import driven_model
from twin.plant.linear import Array, linear_model

SAMPLE_RATE_HZ = 50_000.0
# States: bodies, measurements, wanted speed-up with full covariance.
SIZES = ((4, 4, 25.0), (6, 4, 10.0))
WANTED_CONSTANT, WANTED_RLS = 500.0, 500.0
EQUAL = {"full": 1e-8, "constant": 1e-10}


@dataclass(frozen=True, slots=True)
class Setting:
    """Samples for the kernels and for filterpy, which needs far fewer, and repetitions."""

    samples: int = 5_000
    filterpy_samples: int = 500
    compared_samples: int = 3_000
    repetitions: int = 41


SMALL = Setting(samples=600, filterpy_samples=60, compared_samples=300, repetitions=2)


def chain_of_bodies(bodies: int, sensors: int) -> Plant:
    """Bodies in a row, pushed at the first one, with accelerometers spread along the row."""
    body = [
        {
            "name": f"b{k}",
            "mass_kg": 1.0 + 0.1 * k,
            "attached_to": "ground" if k == 0 else f"b{k - 1}",
            "stiffness_n_m": 4e4 / (1.0 + k),
            "damping_ns_m": 5.0,
        }
        for k in range(bodies)
    ]
    sensor = [
        {"name": f"a{r}", "kind": "acceleration", "of": f"b{r * bodies // sensors}", "noise_density": 1e-3}
        for r in range(sensors)
    ]
    push = {"name": "push", "kind": "force", "on": "b0"}
    return Plant.model_validate({"name": "row", "body": body, "actuator": [push], "sensor": sensor})


def simulated_block(plant: Plant, samples: int) -> Block:
    """One block of the plant pushed by a sine and noise, its sensors' noise included."""
    rng = np.random.default_rng(1)
    model = linear_model(plant)
    d = discretise(model, SAMPLE_RATE_HZ, ["zoh"])
    t = np.arange(samples) / SAMPLE_RATE_HZ
    u = (10.0 * np.sin(2.0 * np.pi * 40.0 * t) + rng.standard_normal(samples))[:, None]
    y = np.empty((samples, len(model.outputs)))
    simulate_block(d.F, d.B0, d.B1, d.C, d.D, np.zeros(len(d.F)), u[0].copy(), u, y)
    y += rng.standard_normal(y.shape) * np.sqrt([s.noise_variance(SAMPLE_RATE_HZ) for s in plant.sensor])
    channels = (*(Channel(s.name, s.unit) for s in plant.sensor), Channel("push", "N"))
    return make_block(0, SAMPLE_RATE_HZ, np.hstack([y, u]), channels)


def observer_of(plant: Plant, block: Block, mode: str) -> Observer:
    """Return the program's observer, with full covariance for good or with a constant gain from the start."""
    names = [c.name for c in block.channels]
    observer = Observer(plant, names, SAMPLE_RATE_HZ, settle_samples=10**9)
    if mode == "full":
        # A model change is followed by settle_samples of full covariance.
        observer.set_model(plant, *driven_model(plant, observer.sources, SAMPLE_RATE_HZ, None))
    return observer


def by_filterpy(observer: Observer, z: Array, u: Array) -> Array:
    """Predict and update on the observer's own filterpy object, sample by sample; (N, n) filtered means."""
    kf, feedthrough = observer.filter, observer.feedthrough
    mean = np.empty((len(z), kf.dim_x))
    before = u[0]
    for k in range(len(z)):
        kf.predict(np.concatenate([before, u[k]])[:, None])
        kf.update((z[k] - feedthrough @ u[k])[:, None])
        before, mean[k] = u[k], kf.x[:, 0]
    return mean


def relative_difference(found: Array, reference: Array) -> float:
    """Largest difference of any state, relative to the largest magnitude that state takes."""
    return float(np.max(np.max(np.abs(found - reference), axis=0) / np.max(np.abs(reference), axis=0)))


def head(block: Block, samples: int) -> Block:
    """First samples of a block."""
    return make_block(0, block.sample_rate_hz, block.values[:samples], block.channels)


def run_observer(setting: Setting) -> Report:
    """Speed-up and equality, full covariance and constant gain, at 8 and 12 states; recursive least squares."""
    figures, rows = [], []
    for bodies, sensors, wanted_full in SIZES:
        plant = chain_of_bodies(bodies, sensors)
        block = simulated_block(plant, setting.samples)
        compared = head(block, setting.compared_samples)
        z, u = compared.values[:, :sensors], compared.values[:, sensors:]
        reference = by_filterpy(observer_of(plant, block, "full"), z, u)
        kept = {mode: observer_of(plant, block, mode) for mode in EQUAL}
        slow = observer_of(plant, block, "full")
        n = len(slow.states)
        few_z, few_u = z[: setting.filterpy_samples], u[: setting.filterpy_samples]
        timings = side_by_side(
            {
                "filterpy": (partial(by_filterpy, slow, few_z, few_u), len(few_z)),
                **{mode: (partial(o.advance, block), setting.samples) for mode, o in kept.items()},
            },
            setting.repetitions,
        )
        for mode, wanted in (("full", wanted_full), ("constant", WANTED_CONSTANT if n == 8 else None)):
            speed_up = timings["filterpy"].median_s / timings[mode].median_s
            mean = observer_of(plant, block, mode).advance(compared).mean
            difference = relative_difference(mean, reference)
            figures.append(
                {
                    "states": n,
                    "measurements": sensors,
                    "mode": mode,
                    "speedup_vs_filterpy": speed_up,
                    "max_relative_difference": difference,
                }
            )
            what = f"observer, {n} states, {sensors} measurements, {mode}"
            rows.append(Row(f"{what}: against filterpy", speed_up, "x", wanted, spread=timings[mode].spread))
            rows.append(Row(f"{what}: largest relative difference", difference, "", EQUAL[mode], "less"))
    rls, difference, spread = _recursive_least_squares(setting)
    rows.append(Row("least squares, 3 parameters: against filterpy", rls, "x", WANTED_RLS, spread=spread))
    rows.append(
        Row("least squares, 3 parameters: largest relative difference", difference, "", 1e-10, "less")
    )
    return Report({"observer": figures, "damping_rls_speedup_vs_filterpy": rls}, rows)


def _recursive_least_squares(setting: Setting) -> tuple[float, float, float]:
    """Speed-up, largest relative difference, spread; both update three parameters by scalar measurements."""
    rng = np.random.default_rng(2)
    truth = np.array([7.0, 40714.0, 0.5])
    n = 10 * setting.samples
    rows = rng.standard_normal((n, 3)) / truth
    z = rows @ truth + 0.01 * rng.standard_normal(n)
    variance, start = np.full(n, 1e-4), np.diag(truth**2)

    def compiled(cuts: int, count: int) -> Array:
        theta, P, out = np.zeros(3), start.copy(), []
        for piece in np.array_split(np.arange(count), cuts):
            part = slice(piece[0], piece[-1] + 1)
            rls3_block(theta, P, rows[part], z[part], variance[part], 1.0)
            out.append(theta.copy())
        return np.array(out)

    count = min(setting.filterpy_samples, n)
    reference = np.empty((count, 3))

    def reference_path() -> None:
        kf = KalmanFilter(dim_x=3, dim_z=1)
        kf.P, kf.R = start.copy(), np.array([[1e-4]])
        for k in range(count):
            kf.update(z[k : k + 1, None], H=rows[k : k + 1])
            reference[k] = kf.x[:, 0]

    timings = side_by_side(
        {"filterpy": (reference_path, count), "compiled": (partial(compiled, 1, n), n)}, setting.repetitions
    )
    return (
        timings["filterpy"].median_s / timings["compiled"].median_s,
        relative_difference(compiled(count, count), reference),
        timings["compiled"].spread,
    )
