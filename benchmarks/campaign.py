"""Thousands of cases: the batch kernel beside the single case's and SciPy, and a whole campaign on threads and Dask."""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import dlsim

from benchmarks.report import Report, Row
from benchmarks.timing import side_by_side
from tuning.campaign.batch import run_cases
from tuning.campaign.kernel import TILE
from tuning.loop import RigModel
from twin.plant.files import parse_toml
from twin.station.campaign.cases import Campaign, drawn_case, prepare, shape_of
from twin.station.campaign.replay import CaseRig, case_programme
from twin.station.campaign.run import CampaignOptions, run_campaign
from twin.station.campaign.spec import CampaignSpec

WANTED_S = 6.0
DLSIM_SAMPLES = 20_000

TEXT = """
name = "benchmark"
seed = 1
draws = {scenarios}
sample_rate_hz = 10000.0
delay_us = 100.0
[[excitation]]
from_hz = 45.0
to_hz = 55.0
duration_s = {seconds}
amplitude_v = 4.0
[schedule]
kind = "thesis"
[[scatter]]
parameter = "absorber.mass_kg"
distribution = "normal"
std = 0.005
[[scatter]]
parameter = "absorber.stiffness_n_m"
distribution = "normal"
std = 0.01
[[scatter]]
parameter = "absorber.damping_ns_m"
distribution = "log_normal"
sigma = 0.2
"""


@dataclass(frozen=True, slots=True)
class Setting:
    """How many cases run how long, how often the kernels are compared, and whether a cluster is started."""

    scenarios: int = 1000
    seconds: float = 55.0
    compared_s: float = 55.0
    repetitions: int = 3
    cluster: bool = True


SMALL = Setting(scenarios=4, seconds=0.3, compared_s=0.3, repetitions=1, cluster=False)


def run_campaign_case(setting: Setting) -> Report:
    """Seconds of a campaign from specification to Parquet, poles and margins included, and the kernels' ratios."""
    campaign = _campaign(TILE, setting.compared_s)
    shape, samples = shape_of(campaign.spec, 0), int(setting.compared_s * 10_000)
    cases = [drawn_case(campaign, k).case for k in range(TILE)]
    first = drawn_case(campaign, 0)
    programme = case_programme(campaign, first)
    model = RigModel(first.case.plant, first.case.facts, 50.0).discrete
    count = min(samples, DLSIM_SAMPLES)
    u = np.zeros((count, model.B0.shape[1]))
    u[:, -1] = shape.samples[:count]

    def single() -> None:
        rig = CaseRig(programme, first)
        while not rig.finished:
            rig.next_block()

    timed = side_by_side(
        {
            "batch": (lambda: run_cases(cases, shape), TILE * samples),
            "single": (single, samples),
            "scipy": (lambda: dlsim((model.F, model.B0 + model.B1, model.C, model.D, 1e-4), u), count),
        },
        setting.repetitions,
    )
    batch = timed["batch"].median_s
    with tempfile.TemporaryDirectory() as folder:
        _warm()
        cpu = time.process_time()
        seconds = _seconds(setting, Path(folder) / "threads", None)
        cpu = time.process_time() - cpu
        seconds_dask = _seconds(setting, Path(folder) / "dask", "here") if setting.cluster else None
    figures = {
        "scenarios": setting.scenarios,
        "seconds": seconds,
        "seconds_dask": seconds_dask,
        "processor_seconds": cpu,
        "kernel_ns_per_sample": 1e9 * batch,
        "single_case_factor": timed["single"].median_s / batch,
        "dlsim_factor": timed["scipy"].median_s / batch,
    }
    what = f"{setting.scenarios} cases of {setting.seconds:g} s at 10 kS/s"
    wanted = WANTED_S if setting.scenarios == 1000 else None
    rows = [
        Row(f"{what}, threads", seconds, "s", wanted, "less"),
        Row("  processor time of it, all threads", cpu, "s"),
        Row("  batch kernel, one thread", 1e9 * batch, "ns/sample", spread=timed["batch"].spread),
        Row("  against the single-case rig", figures["single_case_factor"]),
        Row("  against scipy.signal.dlsim of the plant alone", figures["dlsim_factor"]),
    ]
    if seconds_dask is not None:
        rows.insert(1, Row(f"{what}, Dask", seconds_dask, "s"))
    return Report({"campaign": figures}, rows)


def _campaign(scenarios: int, seconds: float) -> Campaign:
    text = TEXT.format(scenarios=scenarios, seconds=seconds)
    return prepare(parse_toml(text, CampaignSpec, "benchmark"), Path(), lambda _line: None)


def _seconds(setting: Setting, folder: Path, where: str | None) -> float:
    """Seconds a whole campaign takes; the cluster is started and its workers warm before the clock."""
    folder.mkdir()
    spec = folder / "benchmark.toml"
    spec.write_text(TEXT.format(scenarios=setting.scenarios, seconds=setting.seconds), encoding="utf-8")

    def run(scheduler: str | None, out: str) -> float:
        options = CampaignOptions(spec, out=folder / out, scheduler=scheduler, plots=False)
        began = time.perf_counter()
        run_campaign(options, lambda _line: None, lambda _done, _total: None)
        return time.perf_counter() - began

    if where is None:
        return run(None, "results")
    from distributed import Client, LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1") as cluster,
        Client(cluster) as client,
    ):
        client.run(_warm)
        return run(cluster.scheduler_address, "results")


def _warm() -> None:
    """Load the compiled kernels in a worker."""
    campaign = _campaign(1, 0.1)
    run_cases([drawn_case(campaign, 0).case], shape_of(campaign.spec, 0))
