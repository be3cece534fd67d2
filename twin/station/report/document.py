"""The report of one run: its figures as data, and what cannot be said of it."""

import math
from typing import Any

import numpy as np

from twin.station.audit import Audit
from twin.station.report.history import History
from twin.station.report.origin import plain
from twin.station.report.replayed import Replayed
from twin.station.report.tracks import COLUMNS


def document(run: Replayed) -> dict[str, Any]:
    """Everything a report says, as JSON takes it.

    Returns
    -------
    dict
        ``setup`` (file, files with sha256, recorded_at, plant, plant_fingerprint, config_id, channels, law, seed,
        versions, seconds, sample_rate_hz, estimates), ``verify``, ``figures`` (those of ``atmd replay --json``),
        ``hindsight`` (attenuation against the model with the damping known in the end), ``limits``, ``damping``,
        ``gains``, ``proposals``, ``commands``, ``audit``, ``events``, ``faults``, ``cannot_say``, ``tracks``.
    """
    origin, t = run.origin, run.tracks
    hz = t["frequency_hz"][np.isfinite(t["frequency_hz"])]
    curve = run.curve
    return dict(plain({
        "setup": {
            "file": str(run.path),
            "files": origin["files"],
            "recorded_at": origin["recorded_at"],
            "date_from": origin["date_from"],
            "own": origin["own"],
            "plant": run.plant.name,
            "plant_fingerprint": origin["plant_fingerprint"],
            "config_id": origin["config_id"],
            "bodies": [b.model_dump(mode="json") for b in run.plant.body],
            "actuators": [a.model_dump(mode="json") for a in run.plant.actuator],
            "channels": [{"name": c.name, "unit": c.unit} for c in t.channels],
            "sample_rate_hz": run.sample_rate_hz,
            "seconds": run.seconds,
            "excitation_hz": [hz.min(), hz.max()] if len(hz) else None,
            "excitation_tracked": t.reference or None,
            "seed": origin["seed"],
            "law": origin["law"],
            "program_version": origin["program_version"],
            "software": origin["software"],
            "remarks": origin["remarks"],
            "estimates": run.estimates,
        },
        "verify": origin["verify"] | {"masked": masked(run)},
        "figures": run.figures,
        "hindsight": hindsight(run),
        "limits": [entry.as_dict() for entry in run.limits],
        "damping": None if curve is None else {
            "frequency_hz": curve.frequency_hz,
            "damping_ns_m": curve.damping_ns_m,
            "std_ns_m": curve.std_ns_m,
            "in_use_ns_m": curve.in_use_ns_m,
            "status": curve.status,
            "reason": curve.reason,
        },
        "gains": None if run.schedule is None else run.schedule.model_dump(mode="json"),
        "proposals": run.history.proposals,
        "proposals_not_listed": dict(run.history.routine),
        "commands": list(run.history.commands.values()),
        "audit": {
            "summary": Audit(run.history.audit).summary() if run.history.audit else None,
            "points": run.history.audit_rows(run.sample_rate_hz),
        },
        "events": run.history.events,
        "faults": list(run.history.faults.values()),
        "cannot_say": cannot_say(run),
        "tracks": {name: t[name] for name in COLUMNS}
        | {"model": t.verdict, "learner": t.learner, "passive_m": run.hindsight.passive_m,
           "passive_std_m": run.hindsight.passive_std_m, "attenuation": run.hindsight.attenuation,
           "attenuation_std": run.hindsight.attenuation_std},
    }))  # fmt: skip


def hindsight(run: Replayed) -> dict[str, Any]:
    """Attenuation of the settled blocks against the model with the damping known in the end."""
    h = run.hindsight
    known = np.isfinite(h.attenuation)
    if not known.any():
        return {
            "attenuation_mean": None,
            "why_not": h.why_not or "the control was never on for half a second",
        }
    worst = int(np.nanargmin(h.attenuation))
    return {
        "attenuation_mean": float(h.attenuation[known].mean()),
        # The damping's error is common to all blocks: it does not average away.
        "attenuation_std": float(h.attenuation_std[known].mean()),
        "attenuation_worst": float(h.attenuation[worst]),
        "attenuation_worst_std": float(h.attenuation_std[worst]),
        "worst_at_hz": float(run.tracks["frequency_hz"][worst]),
        "worst_at_s": float(run.tracks["time_s"][worst]),
        "blocks": int(known.sum()),
        "from_hz": float(run.tracks["frequency_hz"][known].min()),
        "to_hz": float(run.tracks["frequency_hz"][known].max()),
        "why_not": "",
    }


def masked(run: Replayed) -> dict[str, Any]:
    """Samples that were not used, in all and as a share of all values."""
    n = int(run.figures["masked_samples"])
    values = int(run.figures["samples"]) * len(run.tracks.channels)
    return {"values": n, "share": n / values if values else None}


def alarms(run: Replayed) -> list[dict[str, Any]]:
    """Warnings and errors of the log, the same words in a row told once with their number."""
    told: list[dict[str, Any]] = []
    for event in run.history.events:
        if event["level"] == "info":
            continue
        same = next((a for a in told if (a["level"], a["text"]) == (event["level"], event["text"])), None)
        if same is not None:
            same["times"] += 1
            same["last_s"] = event["time_s"]
        else:
            told.append({**event, "times": 1, "last_s": event["time_s"]})
    return told


def cannot_say(run: Replayed) -> list[str]:
    """What a reader might look for and does not find, with the reason."""
    t, told = run.tracks, []
    history: History = run.history
    if run.origin["verify"]["whole"] is None:
        told.append(
            "Whether the file is as it was recorded: its format has no checksums. The SHA-256 above says what was read."
        )
    if run.origin["verify"]["damage"]:
        told.append("What follows where the recording is damaged or cut: it is in none of these figures.")
    if not t.reference and not t.force_estimated:
        told.append(
            "Motion, attenuation and power at the excitation: the plant and its channels show none "
            "(an absorber with both accelerations and the coil's current are needed)."
        )
    elif not np.isfinite(run.hindsight.attenuation).any():
        reason = run.hindsight.why_not or (
            "the file does not say when the controller acted"
            if not np.isfinite(t["control_on"]).any()
            else "the controller was never on for half a second with an excitation"
        )
        told.append(f"Attenuation: {reason}.")
    if run.curve is None:
        told.append("c2(f): nothing recorded lets the damping be identified.")
    if not history.proposals and not history.routine:
        told.append("Proposals: nothing was retuned in this run.")
    if not history.audit and history.commands:
        told.append(
            "Predicted against achieved: no question was asked while the motion was settled under proposed gains."
        )
    told += [
        f"Limit {e.key} ({e.limit:g} {e.unit}): nothing recorded tells."
        for e in run.limits
        if e.verdict == "unknown"
    ]
    if not run.plant.limits:
        told.append("Limits: the plant states none.")
    if run.figures["decisions_repeated"] is False:
        told.append("The run itself decided otherwise than this replay: figures are the replay's.")
    if math.isfinite(run.seconds) and run.origin["seed"] is None and run.origin["own"]:
        told.append("Seeds: none was recorded; nothing was simulated, or the recorder was not told.")
    return told
