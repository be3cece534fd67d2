"""Running a campaign: what is not kept yet, on threads or a cluster, kept piece by piece; then its summary."""

import glob
import os
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tuning.campaign.statistics import sensitivities, worst_first, yields
from twin.plant.errors import InputError
from twin.plant.files import read_toml
from twin.station.campaign.cases import Campaign, Job, prepare, run_job
from twin.station.campaign.spec import CampaignSpec
from twin.station.campaign.store import Store

WORST = 10
"""So many of the worst cases are listed."""

LISTED = (
    "case", "plant", "budget_w", "stable", "growth_1_s", "attenuation_worst", "attenuation_mean", "displacement_m",
    "first_limit", "first_limit_s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CampaignOptions:
    """What the person asked for.

    Attributes
    ----------
    out
        Folder of the results; None for ``<name of the specification>.campaign`` beside it.
    threads
        None for one per core.
    scheduler
        Address of a Dask scheduler in place of threads.
    """

    spec: Path
    out: Path | None = None
    threads: int | None = None
    scheduler: str | None = None
    plots: bool = True

    @property
    def folder(self) -> Path:
        """Folder of the results."""
        return self.out if self.out is not None else self.spec.with_suffix(".campaign")


def run_campaign(
    options: CampaignOptions, say: Callable[[str], None], progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Run what is missing of a campaign and sum it up.

    Parameters
    ----------
    say
        Takes lines for the person.
    progress
        Takes cases done and cases in all.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        If the specification, the folder or the cluster cannot be used.
    RunError
        If results cannot be written, or the cluster fails.
    """
    spec = read_toml(options.spec, CampaignSpec)
    if spec.archive is not None:
        from twin.station.campaign.archive import run_archive

        return run_archive(spec, options, say, progress)
    campaign = prepare(spec, options.spec.parent, say)
    store = Store(options.folder, spec.name, campaign.fingerprint)
    jobs = campaign.jobs
    kept = store.done()
    missing = [job for job in jobs if kept.get(job.number) != job.last - job.first]
    already = spec.cases - sum(job.last - job.first for job in missing)
    if already:
        say(f"{already} of {spec.cases} cases are there already; going on with the others")
    done, began = already, time.perf_counter()
    progress(done, spec.cases)
    with closing(_finished(options, campaign, missing)) as finished:
        for job, rows in finished:
            store.keep(job.number, rows)
            done += len(rows)
            progress(done, spec.cases)
    seconds = time.perf_counter() - began
    rows = store.rows()
    path = store.gather(rows)
    result = {**summary(spec, rows), "seconds": seconds, "computed": done - already, "results": str(path)}
    if options.plots:
        from twin.station.campaign.plots import write_report

        result |= write_report(spec, rows, result, options.folder, options.spec)
    return result


def summary(spec: CampaignSpec, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over all cases."""
    limits: dict[str, int] = {}
    for row in rows:
        limits[row["first_limit"]] = limits.get(row["first_limit"], 0) + 1
    return {
        "name": spec.name,
        "cases": len(rows),
        "meeting": sum(row["meets"] for row in rows),
        "stable": sum(row["stable"] for row in rows),
        "first_limits": {key or "none": limits[key] for key in sorted(limits)},
        "yields": yields(rows, spec.budget_kind, bool(spec.budgets_w)),
        "sensitivities": sensitivities(rows),
        "worst": [{key: row[key] for key in LISTED} for row in worst_first(rows)[:WORST]],
    }


def _finished(
    options: CampaignOptions, campaign: Campaign, jobs: Sequence[Job]
) -> Generator[tuple[Job, list[dict[str, Any]]], None, None]:
    """Jobs with their rows, as they finish."""
    if not jobs:
        return
    if options.scheduler is not None:
        from twin.station.campaign.cluster import run_on_cluster

        yield from run_on_cluster(options.scheduler, campaign, jobs)
        return
    stop = threading.Event()
    pool = ThreadPoolExecutor(options.threads or os.cpu_count() or 1)
    try:
        futures = {pool.submit(run_job, campaign, job, stop.is_set): job for job in jobs}
        for future in as_completed(futures):
            yield futures[future], future.result()
    finally:
        # Whoever is interrupted waits for the pieces at hand, not for those that wait.
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


def recordings_of(pattern: str, folder: Path) -> list[Path]:
    """Recordings that an archive's pattern names, sorted.

    Raises
    ------
    InputError
        If there are none.
    """
    found = sorted(Path(p) for p in glob.glob(str(folder / pattern), recursive=True) if Path(p).is_file())
    if not found:
        raise InputError(f'archive.recordings = "{pattern}": no such file in {folder}; check the pattern')
    return found
