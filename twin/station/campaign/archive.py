"""An archive of recordings as a campaign: each is replayed, as it was or with other questions to the tuner."""

import hashlib
import json
import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuning.types import BudgetKind, OperatingPoint
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.station.answers import NOTHING_KNOWN
from twin.station.campaign.cases import place
from twin.station.campaign.spec import Archive, CampaignSpec
from twin.station.campaign.store import Store
from twin.station.frame import Frame
from twin.station.opened import Opened, ReplayOptions, open_any
from twin.station.replay import run_replay
from twin.station.session import Session

if TYPE_CHECKING:
    from twin.station.campaign.run import CampaignOptions

PROPOSED = (
    "proposals", "proposals_feasible", "proposed_attenuation", "proposed_displacement_m", "proposed_joule_mean_w",
    "proposed_modulus_margin",
)  # fmt: skip
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
    variants = _variants(spec.archive, paths, options.spec.parent)
    listed = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
    text = json.dumps([spec.model_dump(mode="json"), listed], sort_keys=True)
    store = Store(options.folder, spec.name, hashlib.sha256(text.encode()).hexdigest()[:16])
    kept = store.done()
    missing = [k for k in range(len(variants)) if k not in kept]
    progress(len(variants) - len(missing), len(variants))
    stop = threading.Event()
    pool = ThreadPoolExecutor(options.threads or os.cpu_count() or 1)
    try:
        futures = {pool.submit(_replayed, variants[k], k, stop): k for k in missing}
        for count, future in enumerate(as_completed(futures), len(variants) - len(missing) + 1):
            row = future.result()
            if row:
                store.keep(futures[future], [row])
            progress(count, len(variants))
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)
    rows = store.rows()
    for row in rows:
        if row["trouble"]:
            say(f"{row['recording']}: {row['trouble']}")
    return {
        "name": spec.name,
        "recordings": len(paths),
        "replays": len(rows),
        "failed": sum(bool(row["trouble"]) for row in rows),
        "rows": rows,
        "results": str(store.gather(rows)),
    }


@dataclass(frozen=True, slots=True)
class _Variant:
    """One recording, and what is other than it was; None for what is not."""

    path: Path
    plant: str | None
    budget_w: float | None
    kind: BudgetKind
    modulus_margin: float | None

    @property
    def as_it_was(self) -> bool:
        """Whether the recording's own session is repeated."""
        return self.plant is None and self.budget_w is None and self.modulus_margin is None

    def opened(self) -> Opened:
        """The recording with this variant's question to the tuner."""
        opened = open_any(self.path, ReplayOptions(plant=self.plant))
        if self.as_it_was:
            return opened
        if opened.settings.loop is None and (self.budget_w is not None or self.modulus_margin is not None):
            raise InputError(
                f"{self.path}: says nothing of the rig's controller, so that there is nothing to tune: budgets_w and "
                "modulus_margins do nothing here; leave this recording out of archive.recordings"
            )
        goal = opened.settings.goal
        if self.budget_w is not None:
            goal = replace(goal, budget_w=self.budget_w, budget_kind=self.kind)
        if self.modulus_margin is not None:
            goal = replace(goal, modulus_margin=self.modulus_margin)
        # Another question: what was answered then, and when, says nothing here.
        return replace(
            opened,
            settings=replace(opened.settings, goal=goal),
            known=NOTHING_KNOWN,
            timing=None,
            decisions=None,
        )


def _variants(archive: Archive, paths: Sequence[Path], folder: Path) -> list[_Variant]:
    """Every recording with every combination of what is to be other than it was."""
    plants: list[str | None] = [place(folder, name) for name in archive.plants]
    for name in plants:
        load_plant(str(name))
    return [
        _Variant(path, plant, budget, archive.budget_kind, margin)
        for path in paths
        for plant in plants or [None]
        for budget in archive.budgets_w or (None,)
        for margin in archive.modulus_margins or (None,)
    ]


def _replayed(variant: _Variant, number: int, stop: threading.Event) -> dict[str, Any]:
    """Figures of one replay; nothing if it was told to stop."""
    points: dict[int, OperatingPoint] = {}
    made = {True: 0, False: 0}

    def on_progress(_done: int, _total: int) -> None:
        if stop.is_set():
            raise _StoppedError

    def watch(_session: Session, frame: Frame) -> None:
        if frame.proposal is not None:
            made[frame.proposal.feasible] += 1
            points.update(dict(frame.proposal.points) if frame.proposal.feasible else {})

    row: dict[str, Any] = {
        "case": number,
        "recording": str(variant.path),
        "budget_w": variant.budget_w,
        "modulus_margin": variant.modulus_margin,
    }
    try:
        found = run_replay(
            variant.path,
            ReplayOptions(),
            lambda _line: None,
            on_progress,
            watch=watch,
            opened=variant.opened(),
        )
    except _StoppedError:
        return {}
    except (InputError, RunError) as error:
        return row | dict.fromkeys(("plant", *FIGURES, *PROPOSED)) | {"trouble": str(error)}
    return (
        row
        | {key: found[key] for key in ("plant", *FIGURES)}
        | _proposed(made, list(points.values()))
        | {"trouble": ""}
    )


def _proposed(made: dict[bool, int], points: Sequence[OperatingPoint]) -> dict[str, Any]:
    """What the tuner would have had the rig do: the last proposal for each frequency, over all frequencies."""
    if not points:
        return dict.fromkeys(PROPOSED) | {"proposals": sum(made.values()), "proposals_feasible": made[True]}
    left = [p.predicted_displacement_m / p.passive_displacement_m for p in points]
    return {
        "proposals": sum(made.values()),
        "proposals_feasible": made[True],
        "proposed_attenuation": 1.0 - sum(left) / len(left),
        "proposed_displacement_m": max(p.predicted_displacement_m for p in points),
        "proposed_joule_mean_w": max(p.powers.joule_mean_w for p in points),
        "proposed_modulus_margin": min(p.modulus_margin for p in points),
    }


class _StoppedError(Exception):
    """The person wants no more of it."""
