"""The rig's filter chain, sample by sample with moving cutoffs, against SciPy."""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from benchmarks.report import Report, Row
from benchmarks.timing import side_by_side
from twin.control.chain import CHAIN_STATES, chain_matrices, chain_step
from twin.plant.compiled import kernel
from twin.plant.linear import Array

SAMPLE_RATE_HZ = 50_000.0
LOW_PASS_HZ, HIGH_PASS_HZ = 1_000.0, 2.5


@dataclass(frozen=True, slots=True)
class Setting:
    """Samples for the kernel and for SciPy, and repetitions."""

    samples: int = 50_000
    library_samples: int = 2_000
    repetitions: int = 21


SMALL = Setting(samples=1_000, library_samples=500, repetitions=2)


@kernel
def chain_block(state: Array, signal_in: Array, g_low: float, g_high: float, dt: float, out: Array) -> None:
    """`chain_step` for every sample; (N, 3) acceleration, velocity, displacement into ``out``."""
    for k in range(len(signal_in)):
        out[k, 0], out[k, 1], out[k, 2] = chain_step(state, signal_in[k], g_low, g_high, dt)


def run_filters(setting: Setting) -> Report:
    """Speed-up and difference against `scipy.signal.dlsim` on the same chain with fixed cutoffs."""
    rng = np.random.default_rng(5)
    x = rng.standard_normal(setting.samples)
    out, few = np.empty((setting.samples, 3)), x[: setting.library_samples, None]
    dt = 1.0 / SAMPLE_RATE_HZ
    g_low, g_high = (float(np.tan(np.pi * f * dt)) for f in (LOW_PASS_HZ, HIGH_PASS_HZ))
    system = (*chain_matrices(LOW_PASS_HZ, HIGH_PASS_HZ, SAMPLE_RATE_HZ), dt)

    def own() -> None:
        chain_block(np.zeros(CHAIN_STATES), x, g_low, g_high, dt, out)

    timings = side_by_side(
        {"own": (own, len(x)), "dlsim": (lambda: signal.dlsim(system, few), len(few))}, setting.repetitions
    )
    reference = signal.dlsim(system, few)[1]
    scale = np.max(np.abs(reference), axis=0)
    difference = float(np.max(np.max(np.abs(out[: len(few)] - reference), axis=0) / scale))
    speed_up = timings["dlsim"].median_s / timings["own"].median_s
    figures = {
        "speedup_vs_dlsim": speed_up,
        "max_relative_difference": difference,
        "samples_per_s": 1.0 / timings["own"].median_s,
    }
    rows = [
        Row("filter chain: against dlsim", speed_up, "x", spread=timings["own"].spread),
        Row("filter chain: largest relative difference", difference, "", 1e-9, "less"),
    ]
    return Report({"filters": figures}, rows)
