"""A run held against its plant's limits: each limit with the worst that was seen, when, and what was left.

A limit that nothing measures or estimates is not kept but unknown: it never passes.
"""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np

from tuning.types import BudgetKind
from twin.plant.config import ForceActuator, Plant, Shaker, VoiceCoil
from twin.plant.linear import Array
from twin.station.report.tracks import Tracks

Verdict = Literal["kept", "broken", "unknown"]

POWER_WINDOW_S = 1.0
"""Power is held against a budget as its mean over this long: what sensor noise burns differs from block to block."""


@dataclass(frozen=True, slots=True)
class Judged:
    """One limit and the worst that was seen of it.

    Attributes
    ----------
    key, what
        Name in the plant's file, and in words what was looked at.
    limit, worst, worst_std, unit
        ``worst_std`` is None where it is measured directly or not known.
    at_s, at_hz
        When the worst was, and the excitation then.
    worst_settled
        The worst from half a second after the controller came on; None if it never was.
    margin
        Share of the limit that was left; below 0 it was passed.
    verdict, verdict_settled
        Over the whole recording, and from half a second after the controller came on.
    """

    key: str
    what: str
    limit: float
    unit: str
    worst: float | None
    worst_std: float | None
    at_s: float | None
    at_hz: float | None
    worst_settled: float | None
    margin: float | None
    verdict: Verdict
    verdict_settled: Verdict

    def as_dict(self) -> dict[str, Any]:
        """Attributes by name."""
        return asdict(self)


def judge(plant: Plant, tracks: Tracks, budget_kind: BudgetKind | None = None) -> list[Judged]:
    """Hold a run against every limit its plant states, the tuner's budget and the sensors' ranges.

    Parameters
    ----------
    budget_kind
        Which power the tuner's budget bounds; None if there was no budget.
    """
    judged = [_limit(plant, tracks, key, value) for key, value in plant.limits.items()]
    if budget_kind is not None and np.isfinite(tracks["budget_w"]).any():
        judged.append(_budget(tracks, budget_kind))
    for sensor in plant.sensor:
        if sensor.range is not None and (column := _channel(tracks, sensor.name)) is not None:
            what = "largest valid sample; what reaches the range is masked"
            judged.append(_judged(f"{sensor.name} range", what, sensor.range, sensor.unit, column, tracks))
    return judged


def _limit(plant: Plant, tracks: Tracks, key: str, limit: float) -> Judged:
    unit = plant.limit_units[key]
    if key == "stroke_m":
        what = (
            "largest estimated distance between the coil's ends"
            if plant.voice_coil
            else "largest estimated stroke"
        )
        return _judged(key, what, limit, unit, tracks["stroke_peak_m"], tracks, tracks["stroke_std_m"])
    if key == "primary_displacement_m":
        motion, std = tracks["displacement_m"], tracks["displacement_std_m"]
        if np.isfinite(motion).any():
            return _judged(key, "peak at the excitation", limit, unit, motion, tracks, std)
        return _judged(key, "largest of the estimate", limit, unit, tracks["motion_peak_m"], tracks)
    actuator = next(
        a for a in plant.actuator if key.startswith(f"{a.name}_") and key[len(a.name) + 1 :].count("_") == 1
    )
    kind = key[len(actuator.name) + 1 :].split("_", maxsplit=1)[0]
    if kind == "power" and isinstance(actuator, VoiceCoil):
        what = f"mean Joule power R i_rms², largest mean of {POWER_WINDOW_S:g} s"
        mean = _running_mean(tracks["joule_mean_w"], tracks["duration_s"], POWER_WINDOW_S)
        return _judged(key, what, limit, unit, mean, tracks)
    for sensor in plant.sensor:
        if (
            sensor.of == actuator.name
            and sensor.kind == kind
            and (c := _channel(tracks, sensor.name)) is not None
        ):
            return _judged(key, f"largest sample of {sensor.name}", limit, unit, c, tracks)
    command = _channel(tracks, actuator.name)
    if command is not None and (scale := _command_as(actuator, kind)) is not None:
        return _judged(key, f"largest command to {actuator.name}", limit, unit, scale * command, tracks)
    if kind == "current" and actuator is plant.voice_coil:
        return _judged(key, "largest of the estimate", limit, unit, tracks["current_peak_a"], tracks)
    return _unknown(key, "nothing recorded tells", limit, unit)


def _unknown(key: str, what: str, limit: float, unit: str) -> Judged:
    return Judged(key, what, limit, unit, None, None, None, None, None, None, "unknown", "unknown")


def _command_as(actuator: VoiceCoil | Shaker | ForceActuator, kind: str) -> float | None:
    """What a recorded command is multiplied by to be the limited quantity; None if it is another quantity."""
    if kind == "force" and isinstance(actuator, ForceActuator):
        return 1.0 if actuator.force_constant_n_v is None else actuator.force_constant_n_v
    return 1.0 if {"current": "A", "voltage": "V"}.get(kind) == actuator.input_unit else None


def _budget(tracks: Tracks, kind: BudgetKind) -> Judged:
    """The worst share of the budget at the time; after an order that changes it, time counts anew."""
    name, words = {
        "joule_mean": ("joule_mean_w", "mean Joule power R i_rms²"),
        "joule_peak": ("joule_peak_w", "peak Joule power R i_peak²"),
        "electrical": ("electrical_mean_w", "mean electrical power v i"),
    }[kind]
    budget = tracks["budget_w"]
    spent = _running_mean(tracks[name], tracks["duration_s"], POWER_WINDOW_S, budget)
    share = spent / budget
    what = f"{words}, largest mean of {POWER_WINDOW_S:g} s"
    if not np.isfinite(share).any():
        return _unknown("budget", what, float(np.nanmax(budget)), "W")
    at = int(np.nanargmax(share))
    changed = np.unique(budget[np.isfinite(budget)])
    if len(changed) > 1:
        what += f"; of the budgets {', '.join(f'{b:g}' for b in changed)} W the one that was nearest"
    settled = (tracks["settled"] > 0.0) & np.isfinite(share)
    found = _judged("budget", what, float(budget[at]), "W", spent, tracks, at=at)
    verdict: Verdict = "unknown" if not settled.any() else "kept" if share[settled].max() <= 1.0 else "broken"
    worst = float(spent[settled][np.argmax(share[settled])]) if settled.any() else None
    return replace(found, worst_settled=worst, verdict_settled=verdict)


def _judged(
    key: str,
    what: str,
    limit: float,
    unit: str,
    seen: Array,
    tracks: Tracks,
    std: Array | None = None,
    at: int | None = None,
) -> Judged:
    if not np.isfinite(seen).any():
        return _unknown(key, "nothing recorded tells", limit, unit)
    at = int(np.nanargmax(seen)) if at is None else at
    worst = float(seen[at])
    settled = seen[(tracks["settled"] > 0.0) & np.isfinite(seen)]
    hz = float(tracks["frequency_hz"][at])
    spread = None if std is None or not math.isfinite(std[at]) else float(std[at])
    return Judged(
        key=key,
        what=what,
        limit=limit,
        unit=unit,
        worst=worst,
        worst_std=spread,
        at_s=float(tracks["time_s"][at]),
        at_hz=hz if math.isfinite(hz) else None,
        worst_settled=float(settled.max()) if len(settled) else None,
        margin=1.0 - worst / limit,
        verdict="kept" if worst <= limit else "broken",
        verdict_settled="unknown" if not len(settled) else "kept" if settled.max() <= limit else "broken",
    )


def _running_mean(values: Array, duration_s: Array, window_s: float, alike: Array | None = None) -> Array:
    """Mean over the last so many seconds, by the blocks' lengths; NaN until there are as many.

    Parameters
    ----------
    alike
        Time counts anew wherever this changes. The longest stretch counts where none is long enough.
    """
    out = np.full(len(values), np.nan)
    known = np.isfinite(values)
    weight = np.concatenate([[0.0], np.cumsum(np.where(known, duration_s, 0.0))])
    weighted = np.concatenate([[0.0], np.cumsum(np.where(known, duration_s * values, 0.0))])
    first, spent = 0, 0.0
    partial = (0.0, -1, math.nan)
    for k in range(len(values)):
        if alike is not None and k and alike[k] != alike[k - 1]:
            first, spent = k, 0.0
        spent += float(duration_s[k])
        while first < k and spent - float(duration_s[first]) >= window_s * (1.0 - 1e-9):
            spent -= float(duration_s[first])
            first += 1
        if not weight[k + 1] > weight[first]:
            continue
        mean = float((weighted[k + 1] - weighted[first]) / (weight[k + 1] - weight[first]))
        if spent >= window_s * (1.0 - 1e-9):
            out[k] = mean
        elif spent > partial[0]:
            partial = (spent, k, mean)
    if partial[1] >= 0 and not np.isfinite(out).any():
        out[partial[1]] = partial[2]
    return out


def _channel(tracks: Tracks, name: str) -> Array | None:
    names = [c.name for c in tracks.channels]
    return tracks.channel_peak[:, names.index(name)] if name in names else None
