"""The plant's block kernel against scipy.signal.dlsim and python-control's forced_response."""

from dataclasses import dataclass

import control
import numpy as np
from scipy import signal

from benchmarks.report import Report, Row
from benchmarks.timing import side_by_side
from twin.plant.discrete import discretise, simulate_block
from twin.plant.files import load_plant
from twin.plant.linear import linear_model

SAMPLE_RATE_HZ = 50_000.0
WANTED, EQUAL = 100.0, 1e-12


@dataclass(frozen=True, slots=True)
class Setting:
    """Samples for the kernel and for the libraries, and repetitions."""

    samples: int = 50_000
    library_samples: int = 2_000
    repetitions: int = 21


SMALL = Setting(samples=2_000, library_samples=500, repetitions=2)


def run_plant(setting: Setting) -> Report:
    """Speed-up and largest relative difference on the test rig, commands held between samples."""
    model = linear_model(load_plant("rig"))
    d = discretise(model, SAMPLE_RATE_HZ, ["zoh"] * len(model.inputs))
    n, m, p = len(model.states), len(model.inputs), len(model.outputs)
    rng = np.random.default_rng(3)
    t = np.arange(setting.samples) / SAMPLE_RATE_HZ
    u = np.column_stack([np.sin(2.0 * np.pi * 50.0 * t), 4.0 * np.sin(2.0 * np.pi * 45.0 * t)])
    u += 0.01 * rng.standard_normal(u.shape)
    y = np.empty((setting.samples, p))
    few = u[: setting.library_samples]

    def kernel() -> None:
        simulate_block(d.F, d.B0, d.B1, d.C, d.D, np.zeros(n), np.zeros(m), u, y)

    dt = 1.0 / SAMPLE_RATE_HZ
    of_scipy = (d.F, d.B0, d.C, d.D, dt)
    of_control = control.ss(d.F, d.B0, d.C, d.D, dt)
    timings = side_by_side(
        {
            "kernel": (kernel, setting.samples),
            "dlsim": (lambda: signal.dlsim(of_scipy, few), len(few)),
            "control": (lambda: control.forced_response(of_control, inputs=few.T), len(few)),
        },
        setting.repetitions,
    )
    figures: dict[str, float] = {"states": n, "samples_per_s": 1.0 / timings["kernel"].median_s}
    rows = []
    references = {
        "dlsim": signal.dlsim(of_scipy, few)[1],
        "control": control.forced_response(of_control, inputs=few.T).outputs.T,
    }
    for name, reference in references.items():
        speed_up = timings[name].median_s / timings["kernel"].median_s
        scale = np.max(np.abs(reference), axis=0)
        difference = float(np.max(np.max(np.abs(y[: len(few)] - reference), axis=0) / scale))
        figures[f"speedup_vs_{name}"] = speed_up
        figures[f"max_relative_difference_{name}"] = difference
        wanted = WANTED if name == "dlsim" else None
        rows.append(
            Row(f"plant, {n} states: against {name}", speed_up, "x", wanted, spread=timings[name].spread)
        )
        rows.append(Row(f"plant, {n} states: largest difference from {name}", difference, "", EQUAL, "less"))
    return Report({"plant": figures}, rows)
