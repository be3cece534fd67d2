"""What differs between runs besides what was measured: configuration, events, decisions, gains in use."""

import math
import re
from typing import Any

import numpy as np

from twin.plant.linear import Array
from twin.station.report.document import hindsight
from twin.station.report.replayed import Replayed
from twin.station.report.words import some

GAINS = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
LONG_LIST = 6


def figure_rows(runs: list[Replayed]) -> list[dict[str, Any]]:
    """Figures of whole runs side by side, with differences from the first and their standard deviation where known."""
    rows = []
    columns = [_figures(run) for run in runs]
    for key, (title, unit, _, _) in columns[0].items():
        values = [c[key][2] for c in columns]
        stds = [c[key][3] for c in columns]
        if all(v is None for v in values):
            continue
        rows.append({
            "key": key,
            "title": title,
            "unit": unit,
            "values": values,
            "std": stds,
            "differences": [_difference(values[0], v) for v in values],
            "differences_std": [_together(stds[0], s) for s in stds],
        })  # fmt: skip
    return rows


def _figures(run: Replayed) -> dict[str, tuple[str, str, float | None, float | None]]:
    """(title, unit, value, standard deviation) by key."""
    f, e, h = run.figures, run.figures["estimation"], hindsight(run)
    worst = (h.get("attenuation_worst"), h.get("attenuation_worst_std"))
    audit = f["audit"] or {}
    levels = [event["level"] for event in run.history.events]
    return {
        "attenuation_mean": ("mean attenuation, settled", "%", h["attenuation_mean"], h.get("attenuation_std")),
        "attenuation_worst": ("worst attenuation, settled", "%", *worst),
        "attenuation_live": ("mean attenuation as known live", "%", f["attenuation_mean"], None),
        "joule_mean_w": ("mean Joule power, worst block", "W", f["joule_mean_w"], None),
        "joule_peak_w": ("peak Joule power, worst block", "W", f["joule_peak_w"], None),
        "electrical_mean_w": ("mean electrical power, worst block", "W", f["electrical_mean_w"], None),
        "current_peak_a": ("peak current", "A", f["current_peak_a"], None),
        "stiffness_n_m": ("absorber stiffness", "N/m", e["stiffness_n_m"], e["stiffness_std_n_m"]),
        "force_n": ("exciting force, estimated", "N", e["force_n"], e["force_std_n"]),
        "consistent_share": ("model consistent", "%", e["consistent_share"], None),
        "nis_median": ("NIS, median", "1", f["nis_median"], None),
        "nrmse": ("prediction NRMSE", "1", f["nrmse"], None),
        "displacement_error_rms": ("predicted - achieved motion, rms", "%", audit.get("displacement_error_rms"), None),
        "power_error_rms": ("predicted - achieved power, rms", "%", audit.get("power_error_rms"), None),
        "limits_broken": ("limits passed", "", float(sum(j.verdict == "broken" for j in run.limits)), None),
        "warnings": ("warnings", "", float(levels.count("warning")), None),
        "errors": ("errors", "", float(levels.count("error")), None),
        "taken": ("decisions taken", "", float(sum(p["accepted"] for p in run.history.proposals)), None),
        "declined": ("decisions declined", "", float(sum(not p["accepted"] for p in run.history.proposals)), None),
        "commands": ("commands", "", float(f["commands"]), None),
        "masked_samples": ("values masked", "", float(f["masked_samples"]), None),
        "seconds": ("length", "s", run.seconds, None),
    }  # fmt: skip


def _difference(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else b - a


def _together(a: float | None, b: float | None) -> float | None:
    return None if a is None or b is None else math.hypot(a, b)


def configuration_rows(runs: list[Replayed]) -> list[dict[str, Any]]:
    """Settings that are not the same in all runs: key and each run's value, None where it has none."""
    flat = [_flat(_settings(run)) for run in runs]
    keys = dict.fromkeys(key for one in flat for key in one)
    return [
        {"key": key, "values": [one.get(key) for one in flat]}
        for key in keys
        if any(one.get(key) != flat[0].get(key) for one in flat[1:])
    ]


def _settings(run: Replayed) -> dict[str, Any]:
    """Everything that a run was told, the same thing under the same key whatever made the recording."""
    config = {k: v for k, v in run.origin["config"].items() if k != "rig"}
    told = dict(config.get("programme") or run.origin["config"].get("rig") or {})
    session = dict(config.pop("session", None) or {})
    config.pop("programme", None)
    for dropped in ("plant", "run_id"):
        told.pop(dropped, None)
    schedule = session.pop("schedule", None) or told.pop("schedule", None)
    told.pop("schedule", None)
    return {
        "plant": run.plant.model_dump(mode="json"),
        "rig": told,
        "session": session,
        "schedule": schedule or {},
        "other": config,
        "sample_rate_hz": run.sample_rate_hz,
        "block_s": float(np.median(run.tracks["duration_s"])),
        "channels": [f"{c.name} [{c.unit}]" for c in run.tracks.channels],
        "config_id": run.origin["config_id"],
        "program_version": run.origin["program_version"],
        "software": run.origin["software"],
    }


def _flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted keys; things with a name go by it, long lists are one value."""
    if isinstance(value, dict):
        found: dict[str, Any] = {}
        for key, inner in value.items():
            found |= _flat(inner, f"{prefix}.{key}" if prefix else str(key))
        return found
    if isinstance(value, list | tuple):
        if value and all(isinstance(v, dict) and "name" in v for v in value):
            named = {v["name"]: {k: w for k, w in v.items() if k != "name"} for v in value}
            return _flat(named, prefix)
        return {prefix: list(value)}
    return {prefix: value}


def shown(value: Any) -> str:
    """A setting in few words; lists of numbers by their range."""
    if value is None:
        return "–"
    if isinstance(value, list):
        if len(value) > LONG_LIST and all(isinstance(v, int | float) for v in value):
            low, high = min(value), max(value)
            return f"{len(value)} values, {low:.5g}" + ("" if low == high else f" to {high:.5g}")
        return some(value, 12)
    return f"{value:.8g}" if isinstance(value, float) else str(value)


def event_rows(runs: list[Replayed]) -> list[dict[str, Any]]:
    """Events of all runs; those that differ in numbers alone are one row, with each run's times.

    Returns
    -------
    list of dict
        ``level``, ``text`` (as first told), ``times_s``: a list for each run.
    """
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    for k, run in enumerate(runs):
        for event in run.history.events:
            key = (event["level"], re.sub(r"[-+]?\d+(\.\d+)?", "#", event["text"]))
            row = rows.setdefault(
                key, {"level": event["level"], "text": event["text"], "times_s": [[] for _ in runs]}
            )
            row["times_s"][k].append(event["time_s"])
    return sorted(rows.values(), key=lambda row: min(t for times in row["times_s"] for t in times))


def decision_rows(runs: list[Replayed]) -> list[dict[str, Any]]:
    """Decisions and commands of all runs in the order of time."""
    rows = []
    for k, run in enumerate(runs):
        rows += [
            {"run": k, "time_s": p["time_s"], "frequency_hz": p["frequency_hz"], "what": p["what"],
             "accepted": p["accepted"], "by": p["by"], "reason": p["reason"], "command_id": p["command_id"]}
            for p in run.history.proposals
        ]  # fmt: skip
    return sorted(rows, key=lambda row: row["time_s"])


def gain_rows(runs: list[Replayed], frequency_hz: Array) -> dict[str, Any] | None:
    """Gains in use in the end at some frequencies; None where fewer than two runs tell theirs."""
    if sum(run.schedule is not None for run in runs) < 2:
        return None
    columns: list[dict[str, list[float]] | None] = []
    for run in runs:
        if run.schedule is None:
            columns.append(None)
            continue
        gains = [run.schedule.at(float(f)) for f in frequency_hz]
        columns.append({name: [float(getattr(g, name)) for g in gains] for name in GAINS})
    known = [c for c in columns if c is not None]
    return {
        "frequency_hz": frequency_hz.tolist(),
        "runs": columns,
        "same": all(c == known[0] for c in known[1:]),
    }
