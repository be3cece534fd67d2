"""An archive of recordings as a campaign: each is replayed by the loop, its figures kept like those of a case."""

import hashlib
import json
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.plant.errors import InputError, RunError
from twin.station.campaign.spec import CampaignSpec
from twin.station.campaign.store import Store

if TYPE_CHECKING:
    from twin.station.campaign.run import CampaignOptions

FIGURES = (
    "attenuation_mean", "attenuation_worst", "current_peak_a", "joule_mean_w", "joule_peak_w", "electrical_mean_w",
    "nis_median", "nrmse", "blocks", "masked_samples", "commands", "decisions_repeated",
)  # fmt: skip


def run_archive(
    spec: CampaignSpec,
    options: "CampaignOptions",
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Replay every recording of an archive and keep its figures; one that cannot be replayed keeps the reason.

    Returns
    -------
    dict
        ``recordings``, ``failed``, ``rows`` and where the results are.

    Raises
    ------
    InputError
        If there are no recordings, or the folder or a cluster cannot be used.
    """
    from twin.station.campaign.run import recordings_of

    if spec.archive is None:
        raise InputError("archive: missing")
    if options.scheduler is not None:
        raise InputError(
            "--scheduler: recordings lie on this machine; leave it out to replay them on its threads"
        )
    paths = recordings_of(spec.archive.recordings, options.spec.parent)
    listed = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
    text = json.dumps([spec.model_dump(mode="json"), listed], sort_keys=True)
    store = Store(options.folder, spec.name, hashlib.sha256(text.encode()).hexdigest()[:16])
    missing = [k for k in range(len(paths)) if k not in store.done()]
    progress(len(paths) - len(missing), len(paths))
    stop = threading.Event()
    pool = ThreadPoolExecutor(options.threads or os.cpu_count() or 1)
    try:
        futures = {pool.submit(_replayed, paths[k], k, stop): k for k in missing}
        for count, future in enumerate(as_completed(futures), len(paths) - len(missing) + 1):
            row = future.result()
            if row:
                store.keep(futures[future], [row])
            progress(count, len(paths))
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)
    rows = store.rows()
    for row in rows:
        if row["trouble"]:
            say(f"{row['recording']}: {row['trouble']}")
    return {
        "name": spec.name,
        "recordings": len(rows),
        "failed": sum(bool(row["trouble"]) for row in rows),
        "rows": rows,
        "results": str(store.gather(rows)),
    }


def _replayed(path: Path, number: int, stop: threading.Event) -> dict[str, Any]:
    """Figures of one recording; nothing if it was told to stop."""
    from twin.station.replay import ReplayOptions, run_replay

    def on_progress(_done: int, _total: int) -> None:
        if stop.is_set():
            raise _StoppedError

    row: dict[str, Any] = {"case": number, "recording": str(path)}
    try:
        found = run_replay(path, ReplayOptions(), lambda _line: None, on_progress)
    except _StoppedError:
        return {}
    except (InputError, RunError) as error:
        return row | dict.fromkeys(("plant", *FIGURES)) | {"trouble": str(error)}
    return row | {key: found[key] for key in ("plant", *FIGURES)} | {"trouble": ""}


class _StoppedError(Exception):
    """The person wants no more of it."""
