"""Where a recording comes from and in what state it is: files, date, checksums, program, law, seeds."""

import contextlib
import hashlib
import json
import math
import warnings
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twin.plant.errors import InputError
from twin.station.opened import Opened

if TYPE_CHECKING:
    from twin.rig.recorded import Recording

_PIECE = 1 << 20


def origin(path: Path, opened: Opened, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Facts of a recording's files, for people and programs.

    Parameters
    ----------
    progress
        Takes bytes read and bytes in all.

    Returns
    -------
    dict
        ``files`` (name, bytes, sha256), ``recorded_at`` (ISO 8601, UTC; None if unknown) and ``date_from``, ``verify``
        (whole: True, False or None where the format has no checksums; damage, gaps, masked_samples, blocks),
        ``program_version``, ``software``, ``seed``, ``own`` (whether this program recorded it), ``law``, ``config``.

    Raises
    ------
    InputError
        If a file can no longer be read.
    """
    recording = _recording(path)
    config = _object(opened.config_json)
    facts: dict[str, Any] = {
        "own": recording is not None,
        "seed": opened.seed,
        "config": config,
        "law": _law(config),
        "plant_fingerprint": opened.plant.fingerprint,
        "remarks": list(opened.remarks),
    }
    if recording is not None:
        return facts | _own(path, recording, progress)
    changed = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    return facts | {
        "files": _files([path], progress),
        "recorded_at": changed.isoformat(timespec="seconds"),
        "date_from": "when the file was last written; the recording itself does not say",
        "verify": {"whole": None, "damage": [], "gaps": [], "masked_samples": None, "blocks": None},
        "program_version": None,
        "software": {},
        "config_id": None,
    }


def is_own(path: Path) -> bool:
    """Whether this program's recorder made a file, or may have: of other programs there are .rrd files, too."""
    return _recording(path) is not None


def _recording(path: Path) -> "Recording | None":
    from twin.rig.recorded import open_recording

    if not path.is_dir() and path.suffix.lower() != ".rrd":
        return None
    try:
        return open_recording(path)
    except InputError:
        return None


def _own(path: Path, recording: "Recording", progress: Callable[[int, int], None]) -> dict[str, Any]:
    from twin.station.library import inspect

    found = inspect(path)
    damage = list(found.damage)
    if recording.missing_parts:
        damage.append(f"files {', '.join(map(str, recording.missing_parts))} of the run are missing")
    if not recording.finished and not recording.repaired:
        damage.append("its recorder did not finish it: it was killed, or is still recording")
    started = _started(recording.source)
    return {
        "files": _files(recording.parts, progress),
        "recorded_at": started,
        "date_from": "the recorder's clock when the recording was begun"
        if started
        else "the recording does not say",
        "verify": {
            "whole": not damage,
            "damage": damage,
            "gaps": [list(gap) for gap in found.gaps],
            "masked_samples": found.masked,
            "blocks": found.good_blocks,
        },
        "program_version": recording.program_version,
        "software": recording.software,
        "config_id": recording.config_id,
    }


def _files(paths: Sequence[Path], progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
    try:
        sizes = [path.stat().st_size for path in paths]
        done, out = 0, []
        for path, n_bytes in zip(paths, sizes, strict=True):
            digest = hashlib.sha256()
            with path.open("rb") as file:
                while piece := file.read(_PIECE):
                    digest.update(piece)
                    done += len(piece)
                    progress(done, sum(sizes))
            out.append({"name": path.name, "bytes": n_bytes, "sha256": digest.hexdigest()})
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    return out


def _started(path: Path) -> str | None:
    """When the stream was begun, which Rerun notes first; None if it is not there."""
    from rerun.chunk import RrdReader
    from rerun.error_utils import RerunWarning

    with warnings.catch_warnings(), contextlib.suppress(RuntimeError, ValueError):
        warnings.simplefilter("ignore", RerunWarning)
        for chunk in RrdReader(path).stream().filter(content="/__properties"):
            batch = chunk.to_record_batch()
            if "RecordingInfo:start_time" in batch.schema.names:
                nanoseconds = batch.column("RecordingInfo:start_time")[0].as_py()[0]
                return datetime.fromtimestamp(nanoseconds / 1e9, UTC).isoformat(timespec="seconds")
    return None


def _law(config: dict[str, Any]) -> dict[str, Any]:
    """The control law as the configuration has it: what was measured, delay, gains' band."""
    session = config.get("session") or {}
    programme = config.get("programme") or config.get("rig") or {}  # simulated, or what a rig said of itself
    schedule = session.get("schedule") or programme.get("schedule")
    loop = session.get("loop") or {}
    law: dict[str, Any] = {}
    if programme.get("measurement") or "relative" in loop:
        relative = loop.get("relative", programme.get("measurement") == "relative")
        law["feedback"] = "relative acceleration" if relative else "absorber's acceleration alone"
    delay = loop.get("delay_samples", programme.get("loop_delay_samples"))
    rate = loop.get("sample_rate_hz", programme.get("sample_rate_hz"))
    if delay is not None and rate:
        law["loop_delay_s"] = (delay + loop.get("delay_fraction", 0.0)) / rate
    if schedule:
        law |= {
            "on_from_hz": schedule["on_from_hz"],
            "on_to_hz": schedule["on_to_hz"],
            "table_points": len(schedule["frequency_hz"]),
        }
        for name in ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz"):
            law[name] = [min(schedule[name]), max(schedule[name])]
    if session:
        law["retuned"] = session.get("loop") is not None and session.get("schedule") is not None
    return law


def _object(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


def plain(value: Any) -> Any:
    """As JSON takes it: arrays as lists, what is no finite number as None."""
    if isinstance(value, np.ndarray):
        return [plain(v) for v in value.tolist()]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    return value
