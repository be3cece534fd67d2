"""``atmd whatif``: predicted curves for changed settings, and branches of the twin from an instant of a recording."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from tuning.branch import Brancher, BranchTrace
from tuning.changes import Changes, parse_changes
from tuning.loop import RigModel, margin_grid
from tuning.whatif import MARGIN_POINTS, Curves, Design, WhatIf, design_at
from twin.control.schedule import GainSchedule
from twin.plant.config import VoiceCoil
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.plant.linear import natural_frequencies_hz
from twin.station.analyse import parse_frequencies
from twin.station.given_gains import split_given
from twin.station.instant import instant_at
from twin.station.terminal import number
from twin.station.whatif_source import (
    DELAY_US,
    Known,
    from_plant,
    from_recording,
    measured_displacement,
    proposed_schedule,
)

TRACE_STEP = 50


@dataclass(frozen=True, slots=True)
class WhatIfOptions:
    """What the person asked for."""

    file: Path | None = None
    plant: str | None = None
    settings: Sequence[str] = ()
    band: str = "45:55:1"
    at_s: float | None = None
    branch_s: float = 1.0
    delay_us: float = DELAY_US
    plot: Path | None = None


def coil_of(name: str) -> VoiceCoil:
    """Coil of a preset or plant file.

    Raises
    ------
    InputError
        If there is no such plant, or it has no voice coil.
    """
    coil = load_plant(name).voice_coil
    if coil is None:
        raise InputError(f"--set coil={name}: that plant has no voice coil")
    return coil


def run_whatif(options: WhatIfOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Compute curves, and branches where an instant of a recording is given.

    Parameters
    ----------
    say
        Takes lines for the person.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        For options that cannot be used, settings that do not exist, and files that do not tell what is needed.
    """
    if (options.file is None) == (options.plant is None):
        raise InputError("give either a FILE (a recording, .rrd) or --plant PRESET|FILE.toml")
    given, others = split_given(options.settings)
    changes = parse_changes(others, coil_of)
    try:
        band = parse_frequencies(options.band)
    except InputError as error:
        raise InputError(str(error).replace("--at", "--band")) from None
    if sorted(set(band)) != band:
        raise InputError(f"--band {options.band}: frequencies must rise [Hz]")
    if options.file is not None:
        say(f"replaying {options.file}")
        known = from_recording(options.file, options.at_s, options.branch_s if options.at_s else 0.0)
    else:
        if options.at_s is not None:
            raise InputError("--at: a plant alone has no instants; give a recording")
        known = from_plant(str(options.plant), band, options.delay_us)
    what_if = WhatIf(
        known.plant, known.facts, known.schedule, known.goal, known.amplitude, known.damping_std_ns_m
    )
    curves = what_if.curves(band, changes)
    own = None if given is None else given.schedule(known.schedule, changes)
    designs = [
        None if own is None else _design_of_own(known, changes, own, p.frequency_hz) for p in curves.points
    ]
    traces = _branches(known, changes, curves, own, options.branch_s) if options.at_s is not None else ()
    for point in curves.points:
        if point.reason:
            say(f"nothing proposed: {point.reason}")
    measured = measured_displacement(known, TRACE_STEP)
    result: dict[str, Any] = {
        "source": known.source,
        "at_s": known.at_s,
        "changes": list(options.settings),
        "budget_w": curves.goal.budget_w,
        "budget_kind": curves.goal.budget_kind,
        "excitation": curves.amplitude,
        "damping_std_ns_m": known.damping_std_ns_m,
        "points": _points(curves, designs),
        "branches": [_branch(t, measured) for t in traces],
        "plot": None,
    }
    if options.plot is not None:
        from twin.station.whatif_plot import draw_whatif

        draw_whatif(curves, traces, measured, options.plot, designs)
        result["plot"] = str(options.plot)
        say(f"plot: {options.plot}")
    return result


def _design_of_own(known: Known, changes: Changes, own: GainSchedule, frequency_hz: float) -> Design:
    """What the gains that were given would do, on the changed plant."""
    plant = changes.plant(known.plant)
    grid = margin_grid(known.facts.sample_rate_hz, natural_frequencies_hz(plant), MARGIN_POINTS)
    gains = own.at(frequency_hz) if own.acts_at(frequency_hz) else None
    model = RigModel(plant, known.facts, frequency_hz)
    return design_at(model, gains, frequency_hz, changes.amplitude or known.amplitude, grid)


def _branches(
    known: Known, changes: Changes, curves: Curves, own: GainSchedule | None, seconds: float
) -> tuple[BranchTrace, ...]:
    """The twin run on from the instant with the parameters changed: states and phases go on as they were."""
    plant = changes.plant(known.plant)
    instant = instant_at(known.plant, known.facts, known.frames)
    if changes.amplitude is not None:
        instant = replace(instant, drive=instant.drive * (changes.amplitude / abs(instant.drive)))
    low = known.schedule.on_from_hz if changes.on_from_hz is None else changes.on_from_hz
    high = known.schedule.on_to_hz if changes.on_to_hz is None else changes.on_to_hz
    gains = [(p.frequency_hz, p.proposed.gains) for p in curves.points if p.proposed and p.proposed.gains]
    proposed = proposed_schedule(known.schedule, gains, (low, high))
    brancher = Brancher(plant, known.facts, instant, known.damping_std_ns_m)
    traces = [brancher.run("passive", None, seconds, TRACE_STEP)]
    traces.append(brancher.run("in use", known.schedule, seconds, TRACE_STEP))
    if proposed is not None:
        traces.append(brancher.run("proposed", proposed, seconds, TRACE_STEP))
    if own is not None:
        traces.append(brancher.run("given", own, seconds, TRACE_STEP))
    return tuple(traces)


def _points(curves: Curves, own: Sequence[Design | None]) -> list[dict[str, Any]]:
    return [
        {
            "frequency_hz": p.frequency_hz,
            "damping_ns_m": p.damping_ns_m,
            "passive_displacement_m": p.passive_m,
            "limit_displacement_m": p.limit_m,
            "in_use": _design(p.in_use),
            "proposed": None if p.proposed is None else _design(p.proposed),
            "given": None if given is None else _design(given),
            "active_limits": [{"name": a.name, "price": a.price} for a in p.active_limits],
            "reason": p.reason,
        }
        for p, given in zip(curves.points, own, strict=True)
    ]


def _design(d: Design) -> dict[str, Any]:
    g, powers = d.gains, d.powers
    return {
        "control_on": g is not None,
        "stable": d.stable,
        "slowest_pole_1_s": d.growth_1_s,
        "displacement_m": d.displacement_m,
        "current_peak_a": d.current_peak_a,
        "joule_mean_w": None if powers is None else powers.joule_mean_w,
        "joule_peak_w": None if powers is None else powers.joule_peak_w,
        "electrical_mean_w": None if powers is None else powers.electrical_mean_w,
        "modulus_margin": d.modulus_margin,
        "delay_margin_s": d.delay_margin_s,
        "gains": None
        if g is None
        else {"alpha_kg": g.alpha_kg, "beta_ns_m": g.beta_ns_m, "gamma_n_m": g.gamma_n_m},
        "cutoffs": None if g is None else {"low_pass_hz": g.low_pass_hz, "high_pass_hz": g.high_pass_hz},
    }


def _branch(trace: BranchTrace, measured: tuple[np.ndarray, np.ndarray]) -> dict[str, Any]:
    n = min(len(trace.displacement_m), len(measured[1]))
    off = trace.displacement_m[:n] - measured[1][:n]
    return {
        "name": trace.name,
        "step_s": float(trace.time_s[0]),
        "displacement_m": trace.displacement_m.tolist(),
        "displacement_std_m": trace.displacement_std_m.tolist(),
        "current_a": trace.current_a.tolist(),
        "displacement_rms_m": float(np.sqrt(np.mean(trace.displacement_m**2))),
        "joule_mean_w": trace.joule_mean_w,
        "stopped": trace.stopped,
        "off_measured_rms_m": float(np.sqrt(np.mean(off**2))) if n else None,
    }


def whatif_table(r: dict[str, Any]) -> Table:
    """Table for people: displacements in µm, powers as mean Joule power."""
    changes = ", ".join(r["changes"]) or "as it is"
    title = f"What if: {changes} ({r['source']})\nmotion in µm, c2 in Ns/m; power and margin are the proposed gains'"
    table = Table(title=title, title_justify="left")
    own = any(p["given"] is not None for p in r["points"])
    columns = ["Hz", "c2", "passive", "in use", "proposed", "limit", "W", "margin", ""]
    if own:
        columns[5:5] = ["given"]
    for name in columns:
        table.add_column(name, justify="left" if not name else "right")
    for p in r["points"]:
        used, new = p["in_use"], p["proposed"]
        remark = "in use: unstable" if not used["stable"] else ""
        given = p["given"]
        if given is not None and not given["stable"]:
            remark = "given: unstable"
        elif new is None:
            remark = "nothing proposed"
        elif not new["control_on"]:
            remark = "control off"
        table.add_row(
            f"{p['frequency_hz']:g}",
            number(p["damping_ns_m"]),
            _micro(p["passive_displacement_m"]),
            _micro(used["displacement_m"]),
            _micro(new and new["displacement_m"]),
            *([_micro(given and given["displacement_m"])] if own else []),
            _micro(p["limit_displacement_m"]),
            number(new and new["joule_mean_w"]),
            number(new and new["modulus_margin"]),
            remark,
        )
    for b in r["branches"]:
        off = f", {_micro(b['off_measured_rms_m'])} µm off the measured" if b["off_measured_rms_m"] else ""
        motion = f"{_micro(b['displacement_rms_m'])} µm rms{off}"
        table.caption = f"{table.caption or ''}branch {b['name']}: {motion} {b['stopped']}\n"
    return table


def _micro(metres: float | None) -> str:
    return "-" if metres is None else f"{1e6 * metres:.2f}" if metres > 5e-9 else "0"
