"""``atmd export``: a schedule from a recording, a tuning or a rule, verified and written for a rig's firmware."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from tuning.firmware import (
    FixedTable,
    RoundingEffect,
    WordFormat,
    fixed_table,
    point_figures,
    rounding_effect,
)
from tuning.loop import LoopFacts, RigModel
from tuning.transition import check_transition
from twin.plant.config import Actuator, Plant, Shaker
from twin.plant.errors import InputError, RunError
from twin.station.export_source import ExportOptions, Source, check_options, read_source
from twin.station.firmware_header import c_header
from twin.station.handover import Budget, CoilData, ExcitationData, Handover, LoopTiming, TransitionData

DRIVE_V, FORCE_N = 4.0, 1000.0
ENOUGH_HZ_S = 5.0
"""Sweeps faster than this are of no interest: a grid moves by a few Hz/s at worst."""


def run_export(options: ExportOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Verify the schedule, round it, write JSON and C header.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        If the source or an option cannot be used, or the folder cannot be written.
    RunError
        If the loop is not stable, or rounding costs more of a margin than may be lost.
    """
    check_options(options)
    source = read_source(options, say)
    handover = hand_over(source, options, say)
    paths = write(handover, options.out)
    for line in [*_summary(handover), *(f"written: {path}" for path in paths)]:
        say(line)
    return {
        **handover.model_dump(mode="json", exclude={"schedule", "fixed_point", "format", "version"}),
        "fixed_point": None if handover.fixed_point is None else handover.fixed_point.word,
        "files": [str(path) for path in paths],
    }


def hand_over(source: Source, options: ExportOptions, say: Callable[[str], None]) -> Handover:
    """Verify a schedule on the full model and put together what is handed over; raises as `run_export`."""
    plant, facts, schedule = source.plant, source.facts, source.schedule
    coil, exciter = _coil_data(plant), _exciter(plant, facts)
    default = DRIVE_V if isinstance(exciter, Shaker) else FORCE_N
    amplitude = options.excitation or source.amplitude or default
    if options.excitation is None and source.amplitude is None:
        say(
            f"figures are for {amplitude:g} {exciter.input_unit} on '{exciter.name}'; --excitation changes that"
        )
    budget = source.budget
    if options.budget_w is not None:
        kind = options.budget_kind or (budget.kind if budget is not None else "joule_mean")
        budget = Budget(power_w=options.budget_w, kind=kind)
    watt, kind = (None, "joule_mean") if budget is None else (budget.power_w, budget.kind)
    points = point_figures(plant, facts, schedule, amplitude, watt, kind)
    table, effect = _rounded(source, amplitude, options, say)
    proof = check_transition(plant, facts, schedule, most_solves=options.solves, enough_hz_s=ENOUGH_HZ_S)
    absorber = plant.absorber
    return Handover(
        plant=source.configured.name,
        fingerprint=source.configured.fingerprint,
        damping_ns_m=0.0 if absorber is None else absorber.damping_ns_m,
        source=source.words,
        made=options.made,
        budget=budget,
        excitation=ExcitationData(amplitude=amplitude, unit=exciter.input_unit, actuator=exciter.name),
        loop=LoopTiming(
            sample_rate_hz=facts.sample_rate_hz,
            delay_samples=facts.delay_samples,
            delay_fraction=facts.delay_fraction,
            delay_s=facts.delay_s,
            measurement="relative" if facts.relative else "absolute",
        ),
        coil=coil,
        schedule=schedule,
        points=points,
        transition=TransitionData(
            shown=proof.shown,
            method=proof.method,
            fastest_sweep_hz_s=None if math.isinf(proof.fastest_sweep_hz_s) else proof.fastest_sweep_hz_s,
            worst_margin_1_s=proof.worst_margin_1_s,
            reason=proof.reason,
        ),
        fixed_point=table,
        rounding=effect,
    )


def write(handover: Handover, folder: Path) -> tuple[Path, Path]:
    """Write JSON and C header into a folder, which is made if need be; raises InputError if it cannot be written."""
    name = f"{handover.plant}_schedule"
    paths = folder / f"{name}.json", folder / f"{name}.h"
    texts = handover.model_dump_json(indent=2) + "\n", c_header(handover)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, text in zip(paths, texts, strict=True):
            path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"--out {folder}: cannot be written ({error.strerror}); give another folder"
        ) from error
    return paths


def _rounded(
    source: Source, amplitude: float, options: ExportOptions, say: Callable[[str], None]
) -> tuple[FixedTable | None, RoundingEffect | None]:
    if options.fixed_point == "none":
        return None, None
    words: tuple[WordFormat, ...] = (
        ("Q15", "Q31") if options.fixed_point == "auto" else (options.fixed_point,)
    )
    for word in words:
        try:
            table = fixed_table(source.schedule, source.facts.sample_rate_hz, word)
            share = 0.01 * options.most_lost_percent
            return table, rounding_effect(
                source.plant, source.facts, source.schedule, table, amplitude, share
            )
        except RunError as error:
            if word == words[-1]:
                raise
            say(str(error))
    raise RunError("no fixed-point format was tried")


def _coil_data(plant: Plant) -> CoilData:
    coil = plant.voice_coil
    if coil is None:
        raise InputError(
            f"plant '{plant.name}' has no voice coil: there is no controller to hand a schedule to"
        )
    key = f"{coil.name}_current_a"
    if key not in plant.limits:
        raise InputError(
            f"plant '{plant.name}': limits.{key} [A] is missing; without it no clamp can be handed over; add it"
        )
    return CoilData(
        name=coil.name, force_constant_n_a=coil.force_constant_n_a, current_limit_a=plant.limits[key]
    )


def _exciter(plant: Plant, facts: LoopFacts) -> Actuator:
    try:
        model = RigModel(plant, facts, 50.0)
    except ValueError as error:
        raise InputError(f"{error}; change the plant file") from error
    return plant.actuator[model.excitation_input]


def export_table(result: dict[str, Any]) -> Table:
    """Table for people."""
    loop, excitation = result["loop"], result["excitation"]
    table = Table(
        title=f"{result['plant']}, {excitation['amplitude']:g} {excitation['unit']}, "
        f"{1e6 * loop['delay_s']:g} µs delay",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0),
    )
    for head in ("f\nHz", "passive\nµm", "limit\nµm", "reached\nµm", "coil\nA", "R i²\nW avg", "v i\nW avg"):
        table.add_column(head, justify="right", no_wrap=True)
    for head in ("1+L\nmin", "delay\nµs max"):
        table.add_column(head, justify="right", no_wrap=True)
    for p in result["points"]:
        least, delay = p["limit_displacement_m"], p["delay_margin_s"]
        table.add_row(
            f"{p['frequency_hz']:g}",
            _um(p["passive_displacement_m"]),
            _um(least),
            _um(p["achieved_displacement_m"]),
            f"{p['current_peak_a']:.3g}",
            f"{p['joule_mean_w']:.3g}",
            f"{p['electrical_mean_w']:.3g}",
            f"{p['modulus_margin']:.3g}",
            ">8000" if delay is None else f"{1e6 * delay:.0f}",
        )
    return table


def _summary(handover: Handover) -> list[str]:
    t, r = handover.transition, handover.rounding
    lines = []
    if t.shown and t.fastest_sweep_hz_s is None:
        lines.append("stable however fast the frequency moves inside the band")
    elif t.shown:
        lines.append(
            f"stable while the frequency moves by up to {t.fastest_sweep_hz_s:.3g} Hz/s inside the band"
        )
    else:
        lines.append(f"stability while the frequency moves: {t.reason}")
    if r is not None and handover.fixed_point is not None:
        lines.append(
            f"{handover.fixed_point.word}: modulus margin {r.modulus_margin:.4f}, rounded "
            f"{r.modulus_margin_rounded:.4f}; "
            f"at most {100.0 * r.margin_lost:.2g} % of a margin lost, at {r.worst_hz:g} Hz"
        )
    return lines


def _um(metres: float | None) -> str:
    return "-" if metres is None else "~0" if metres < 1e-10 else f"{1e6 * metres:.3g}"
