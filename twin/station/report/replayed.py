"""A recording taken once through the session, with everything that reports and comparisons say of it."""

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimators.types import DampingCurve
from tuning.types import BudgetKind
from twin.control.schedule import GainSchedule
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.station.frame import Frame
from twin.station.opened import BlockSource, ReplayOptions, open_any
from twin.station.replay import run_replay
from twin.station.report.history import History
from twin.station.report.limits import Judged, judge
from twin.station.report.origin import origin
from twin.station.report.passive import Hindsight, in_hindsight
from twin.station.report.tracks import TrackLog, Tracks
from twin.station.session import Session


@dataclass(frozen=True, slots=True)
class Replayed:
    """One run, replayed.

    Attributes
    ----------
    name
        What it is called beside others.
    figures
        As ``atmd replay --json`` has them.
    origin
        See `twin.station.report.origin`.
    plant
        As it was before anything was learned.
    curve
        The damping as known in the end.
    schedule
        Gains in use in the end; None if nothing is known of them.
    budget_kind
        Which power the tuner's budget bounded; None without a tuner.
    estimates
        In words, what was computed anew and what was taken from the recording.
    """

    name: str
    path: Path
    figures: dict[str, Any]
    origin: dict[str, Any]
    plant: Plant
    sample_rate_hz: float
    tracks: Tracks
    hindsight: Hindsight
    history: History
    limits: tuple[Judged, ...]
    curve: DampingCurve | None
    schedule: GainSchedule | None
    budget_kind: BudgetKind | None
    estimates: str

    @property
    def seconds(self) -> float:
        """Time from the recording's first sample to its last [s]."""
        return float(self.tracks["time_s"][-1])


def replayed(
    path: Path,
    options: ReplayOptions,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
    name: str = "",
) -> Replayed:
    """Replay a recording and keep what it comes to.

    Parameters
    ----------
    say
        Takes lines for the person.
    progress
        Takes what is done and all there is: bytes of the files, then samples.

    Raises
    ------
    InputError
        If the recording cannot be used, or holds no whole block.
    """
    opened = open_any(path, options)
    update = _not_too_often(progress)
    came_from = origin(path, opened, update)
    if came_from["verify"]["damage"]:
        opened = replace(opened, blocks=_until_damage(opened.blocks))
    log, history = TrackLog(opened.plant, opened.channels), History()
    latest: dict[str, Any] = {"curve": None, "schedule": None, "kind": None}

    def watch(session: Session, frame: Frame) -> None:
        log.add(frame)
        history.add(session, frame)
        latest["curve"] = frame.curve or latest["curve"]
        latest["schedule"] = session.schedule
        if session.retuning is not None:
            latest["kind"] = session.retuning.goal.budget_kind

    began = time.perf_counter()
    figures = run_replay(path, options, say, update, watch=watch, opened=opened)
    tracks = log.tracks()
    if not len(tracks):
        raise InputError(f"{path}: holds no whole block; there is nothing to report")
    schedule = latest["schedule"]
    if schedule is None and (stated := (came_from["config"].get("programme") or {}).get("schedule")):
        schedule = GainSchedule.model_validate(stated, strict=False)
    figures["replay_s"] = time.perf_counter() - began
    return Replayed(
        name=name or path.stem,
        path=path,
        figures=figures,
        origin=came_from,
        plant=opened.plant,
        sample_rate_hz=opened.sample_rate_hz,
        tracks=tracks,
        hindsight=in_hindsight(opened.plant, tracks, latest["curve"]),
        history=history,
        limits=tuple(judge(opened.plant, tracks, latest["kind"])),
        curve=latest["curve"],
        schedule=schedule,
        budget_kind=latest["kind"],
        estimates=_estimates(figures, opened.known.by_chain),
    )


def _estimates(figures: dict[str, Any], known: Any) -> str:
    """What was computed and what was taken over."""
    computed = "All estimates were computed anew from the recorded samples, by the code that runs live."
    n = figures["answers_recomputed"]
    if n is None:
        return computed + " Nothing was retuned."
    if n == 0 and len(known):
        return (
            f"{computed} The tuner's {len(known)} answers were taken from the recording: question and program are "
            "the same to the bit."
        )
    return f"{computed} The tuner's answers were worked out again: {n}; taken from the recording: " + (
        f"{max(0, len(known) - n)}." if len(known) else "none (another program, or asked to)."
    )


def _until_damage(blocks: BlockSource) -> BlockSource:
    """Blocks before the first that cannot be read; that there are no more is for the report to say."""

    def whole(from_sample: int = 0) -> Iterator[Block]:
        with suppress(InputError):
            yield from blocks(from_sample)

    return whole


def _not_too_often(progress: Callable[[int, int], None]) -> Callable[[int, int], None]:
    """A bar is redrawn at most ten times a second: a minute of data is replayed in two."""
    last = [-np.inf]

    def update(done: int, total: int) -> None:
        now = time.monotonic()
        if done >= total or now - last[0] > 0.1:
            last[0] = now
            progress(done, total)

    return update
