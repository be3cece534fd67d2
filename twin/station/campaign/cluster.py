"""A campaign on a Dask cluster: the same jobs, by address; what a lost worker had is given to another."""

from collections.abc import Iterator, Sequence
from typing import Any

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
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); start one with 'dask scheduler' and "
            "give its address, such as tcp://127.0.0.1:8786"
        ) from error
    with client:
        try:
            client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError as error:
            raise RunError(
                f"--scheduler {address}: no worker came within {FIRST_WORKER_S:g} s; start some with "
                f"'dask worker {address} --nthreads 1'"
            ) from error
        name, futures = campaign.fingerprint, {}
        for job in jobs:
            key = f"{name}-{job.number}"
            futures[client.submit(run_job, campaign, job, pure=False, retries=LIVES, key=key)] = job
        for future in in_turn(list(futures), loop=client.loop):
            if future.status != "finished":
                raise RunError(
                    f"--scheduler {address}: job {futures[future].number} failed ({future.exception()!r})"
                )
            rows = future.result()
            yield futures[future], rows
            future.release()
