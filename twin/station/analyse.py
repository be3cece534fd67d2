"""``atmd analyse``: a control law on any plant file, frequency by frequency."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from rich import box
from rich.table import Table

from twin.control.analysis import Controller
from twin.control.analysis import analyse as analyse_plant
from twin.control.filters import Cutoffs
from twin.control.laws import Feedback, Measurement
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.plant.linear import natural_frequencies_hz

MOST_POINTS = 2001


@dataclass(frozen=True, slots=True)
class AnalyseOptions:
    """What the person asked for; text as it was typed."""

    plant: str
    controller: Controller
    feedback: Feedback
    measurement: Measurement
    at: str
    excitation_n: float
    delay_us: float
    filters: str | None


def run_analysis(options: AnalyseOptions) -> dict[str, Any]:
    """Figures of the analysis as JSON.

    Raises
    ------
    InputError
        For an option that cannot be used; the message names it and the remedy.
    """
    frequencies = parse_frequencies(options.at)
    cutoffs = parse_cutoffs(options.filters)
    _check_numbers(options)
    if cutoffs is not None and options.controller == "lq":
        raise InputError(
            "--filters: the chain feeds gain scheduling on relative acceleration; lq feeds back all states: "
            "leave --filters out or use --controller gain_scheduling"
        )
    try:
        plant = load_plant(options.plant)
    except InputError as error:
        raise InputError(f"--plant {error}") from error
    if plant.absorber is None:
        raise InputError(
            f"--plant {options.plant}: has no absorber; "
            f'add a [[body]] with attached_to = "{plant.primary.name}" or choose another plant'
        )
    try:
        points = analyse_plant(
            plant,
            options.controller,
            frequencies,
            feedback=options.feedback,
            measurement=options.measurement,
            excitation_n=options.excitation_n,
            delay_s=1e-6 * options.delay_us,
            filters=cutoffs,
        )
    except ValueError as error:
        raise InputError(
            f"--plant {options.plant} --controller {options.controller}: {error}; "
            "change the plant, the controller or --at"
        ) from error
    rows = [asdict(p) for p in points]
    for row in rows:
        if not all(math.isfinite(x) for x in row.values() if isinstance(x, float)):
            raise InputError(
                f"--at {options.at}: at {row['frequency_hz']:g} Hz the motion has no bound (undamped resonance); "
                "leave that frequency out or give the plant damping"
            )
    return {"natural_frequencies_hz": [float(f) for f in natural_frequencies_hz(plant)], "points": rows}


def parse_frequencies(text: str) -> list[float]:
    """Frequencies [Hz] from ``45:55:1`` (ends included) or ``47,50,53``.

    Raises
    ------
    InputError
        If they cannot be read, are not positive, or the range is empty or endless.
    """
    remedy = "write FROM:TO:STEP such as 45:55:1, or a list such as 47,50,53, in Hz above 0"
    try:
        if ":" in text:
            first, last, step = (float(word) for word in text.split(":"))
            if not (0.0 < first <= last < math.inf and 0.0 < step < math.inf):
                raise ValueError
            count = math.floor((last - first) / step + 1e-9) + 1
            if count > MOST_POINTS:
                raise InputError(
                    f"--at {text}: {count} frequencies are more than {MOST_POINTS}; take a longer step"
                )
            return [round(first + k * step, 9) for k in range(count)]
        values = [float(word) for word in text.split(",")]
    except InputError:
        raise
    except (ValueError, OverflowError) as error:
        raise InputError(f"--at {text}: is no range of frequencies; {remedy}") from error
    if not all(0.0 < f < math.inf for f in values):
        raise InputError(f"--at {text}: a frequency is not above 0; {remedy}")
    if len(values) > MOST_POINTS:
        raise InputError(f"--at: {len(values)} frequencies are more than {MOST_POINTS}; give fewer")
    return values


def parse_cutoffs(text: str | None) -> Cutoffs | None:
    """Cutoffs from ``200,1``: low-pass, high-pass [Hz]; None from None.

    Raises
    ------
    InputError
        If they cannot be read or are not in order.
    """
    if text is None:
        return None
    try:
        low, high = (float(word) for word in text.split(","))
    except ValueError as error:
        raise InputError(
            f"--filters {text}: write the low-pass and the high-pass in Hz, LP,HP, such as 200,1"
        ) from error
    try:
        return Cutoffs(low, high)
    except ValueError as error:
        raise InputError(f"--filters {text}: {error}; write LP,HP such as 200,1") from error


def _check_numbers(options: AnalyseOptions) -> None:
    if not 0.0 < options.excitation_n < math.inf:
        raise InputError(
            f"--excitation-n {options.excitation_n:g}: give the peak of the force in N, above 0, such as 1000"
        )
    if not 0.0 <= options.delay_us <= 1e6:
        raise InputError(f"--delay-us {options.delay_us:g}: give the delay in µs, from 0 to 1e6, such as 30")


def analysis_table(result: dict[str, Any], options: AnalyseOptions) -> Table:
    """Table for people."""
    modes = ", ".join(f"{f:.2f}" for f in result["natural_frequencies_hz"])
    how = options.controller.replace("_", " ")
    if options.controller == "gain_scheduling":
        how += f", {options.measurement} {options.feedback}"
    table = Table(
        title=f"{options.plant}, {how}; modes at {modes} Hz",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 0),
    )
    electrical = any(p["current_a"] is not None for p in result["points"])
    heads = ["f|Hz", "prim.|µm", "stroke|mm", "force|N"]
    heads += ["curr.|A", "volt|V", "R i²|W pk", "v i|W avg"] if electrical else []
    for head in [*heads, "stable|", "delay|µs max", "1+L|min"]:
        table.add_column(head.replace("|", "\n"), justify="right", no_wrap=True)
    for p in result["points"]:
        sizes = [1e6 * p["primary_displacement_m"], 1e3 * p["stroke_m"], p["actuator_force_n"]]
        if electrical:
            sizes += [p[key] for key in ("current_a", "voltage_v", "joule_peak_w", "electrical_mean_w")]
        margin = p["delay_margin_s"]
        table.add_row(
            f"{p['frequency_hz']:g}",
            *map(_short, sizes),
            "yes" if p["stable"] else "[red]no[/red]",
            ">8000" if margin is None else _short(1e6 * margin),
            _short(p["modulus_margin"]),
        )
    return table


def _short(value: float) -> str:
    """Three figures without an exponent, for a narrow column."""
    if value != 0.0 and abs(value) < 5e-4:
        return "~0"
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"
