"""A campaign on a Dask cluster: the same jobs, by address; what a lost worker had is given to another."""

import hashlib
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from tuning.campaign import batch, figures, kernel, loops, sampling, scatter
from twin.plant.errors import InputError, RunError
from twin.station.campaign.cases import Campaign, Job, run_job

CONNECT_S, FIRST_WORKER_S = 10.0, 60.0
LIVES = 3
"""A job is given to another worker when its own dies, and tried so often again if it fails."""


def run_on_cluster(
    address: str, campaign: Campaign, jobs: Sequence[Job]
) -> Iterator[tuple[Job, list[dict[str, Any]]]]:
    """Run jobs on a cluster and yield them with their rows as they finish.

    Raises
    ------
    InputError
        If the cluster's library is not installed, or there is no scheduler at the address.
    RunError
        If the cluster loses its workers, or a job fails on it.
    """
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            '--scheduler: needs the library "distributed"; install it with pip install "atmd-twin[cluster]"'
        ) from error
    connect: Any = distributed.Client
    in_turn: Any = distributed.as_completed
    try:
        client: Any = connect(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); start one with 'dask scheduler' and "
            "give its address, such as tcp://127.0.0.1:8786; a tls:// address needs Dask's certificates, see "
            "docs/examples/campaign-cluster.md"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise RunError(
                f"--scheduler {address}: no worker came within {FIRST_WORKER_S:g} s; start some with "
                f"'dask worker {address} --nthreads 1'"
            ) from error
        _same_everywhere(address, client)
        name, futures = campaign.fingerprint, {}
        for job in jobs:
            key = f"{name}-{job.number}"
            futures[client.submit(run_job, campaign, job, pure=False, retries=LIVES, key=key)] = job
        for future in in_turn(list(futures), loop=client.loop):
            if future.status != "finished":
                raise RunError(
                    f"--scheduler {address}: job {futures[future].number} failed ({_reason(future)}); what is finished "
                    "is kept, and the same command goes on from there"
                )
            rows = future.result()
            yield futures[future], rows
            future.release()


def _same_everywhere(address: str, client: Any) -> None:
    """Raise InputError if a worker would compute something else: another version of the program or of its numerics."""
    here, there = versions(), client.run(versions, on_error="return")
    for worker, found in there.items():
        if isinstance(found, Exception):
            raise InputError(
                f"--scheduler {address}: worker {worker} cannot run campaigns ({type(found).__name__}: {found}); "
                f"install the same atmd-twin there ({here['atmd-twin']})"
            )
        other = [
            f"{key} {found.get(key)} instead of {here[key]}" for key in here if found.get(key) != here[key]
        ]
        if other:
            raise InputError(
                f"--scheduler {address}: worker {worker} has {', '.join(other)}: its results would not be the same; "
                "install the same versions on all machines"
            )


def versions() -> dict[str, str]:
    """What results depend on besides the specification."""
    found = {}
    for name in ("atmd-twin", "numpy", "scipy", "numba"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "unknown"
    return found | {"campaign kernels": _CODE}


def _reason(future: Any) -> str:
    """Why a job failed, for a person."""
    error = future.exception()
    if type(error).__name__ == "KilledWorker":
        return "the workers that had it died one after the other; look at their logs, they may lack memory"
    return str(error) if isinstance(error, InputError | RunError) else f"{type(error).__name__}: {error}"


def _code() -> str:
    """Of the files that make a case's figures: two checkouts of one version may differ."""
    digest = hashlib.sha256()
    for module in (batch, figures, kernel, loops, sampling, scatter):
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:12]


_CODE = _code()
