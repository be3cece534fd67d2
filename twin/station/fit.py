"""``atmd fit``: parameters from separate tests, each with its standard deviation, a table and a picture."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from twin.plant.errors import InputError
from twin.station.confirm import YesOption, confirm_guesses
from twin.station.terminal import JsonOption, must_be_writable, report, say

if TYPE_CHECKING:
    from twin.station.fit_data import TestFile

fit_app = typer.Typer(
    name="fit",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    help="Fit modes, springs and dampers to recordings of separate tests, with standard deviations. What is guessed "
    "about a file is shown, confirmed at a terminal, and listed in the JSON under guesses.",
)

FileArgument = Annotated[
    Path, typer.Argument(help="Measured data: .npz, .csv or another known format.", show_default=False)
]
ChannelOption = Annotated[
    list[str] | None,
    typer.Option(
        "--channel", metavar="NAME=ARRAY[:UNIT]", help="Where a quantity lies in the file; may be repeated."
    ),
]
RateOption = Annotated[
    float | None,
    typer.Option(
        "--sample-rate", min=1e-9, metavar="HZ", help="Sample rate in Hz, if the file does not say."
    ),
]
SidecarOption = Annotated[
    Path | None,
    typer.Option(
        "--sidecar",
        metavar="FILE",
        help="JSON or TOML with rate, units and channels; else the one beside the file.",
    ),
]
BandOption = Annotated[
    str | None, typer.Option("--band", metavar="LO:HI", help="Frequencies to look at, in Hz.")
]
ModesOption = Annotated[
    int | None,
    typer.Option(
        "--modes", min=1, max=40, metavar="N", help="Number of modes; as many as stand out unless given."
    ),
]
PlotOption = Annotated[
    Path | None, typer.Option("--plot", metavar="FILE.png|svg", help="Draw data, fit and what is left.")
]


@fit_app.command(
    "added-mass", epilog="Example: atmd fit added-mass spring.csv --tune-to 50 --plot spring.png"
)
def added_mass(
    file: FileArgument,
    channel: ChannelOption = None,
    sidecar: SidecarOption = None,
    tune_to: Annotated[
        float | None,
        typer.Option(min=1e-6, metavar="HZ", help="Also say what mass to add for this frequency."),
    ] = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Stiffness and moving mass of a spring from its resonance against added mass (thesis eq. 7-1).

    The file has two columns, such as `added_mass_g,frequency_hz`, and perhaps `frequency_std_hz`. Two estimates stand
    side by side: the minimum of eq. 7-1, and the maximum likelihood with errors in the frequencies, which is the one
    to trust. JSON keys: stiffness_n_m, moving_mass_kg, both with _std and in interval_95, and eq_7_1 with the same.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_added_mass

    _check(plot, json_to)
    test = open_test(file, channel or [], None, sidecar)
    result, draw = run_added_mass(test, tune_to)
    _finish(test, result, draw, plot, json_to, yes=yes)


@fit_app.command(epilog="Example: atmd fit transmissibility absorber.csv --band 30:58 --json -")
def transmissibility(
    file: FileArgument,
    channel: ChannelOption = None,
    sidecar: SidecarOption = None,
    band: BandOption = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Natural frequency and damping of an absorber from its transmissibility (thesis eq. 5-4).

    Columns: frequency, and a complex ratio of absorber to table acceleration, or its real and imaginary part, or
    magnitude (also in dB) with or without phase. Leave a second resonance out with --band. JSON keys: modes, gain.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_transmissibility

    _check(plot, json_to)
    test = open_test(file, channel or [], None, sidecar, "response")
    result, draw = run_transmissibility(test, _pair(band))
    _finish(test, result, draw, plot, json_to, yes=yes)


@fit_app.command(epilog="Example: atmd fit frf structure.npz --modes 3 --plot structure.png")
def frf(
    file: FileArgument,
    channel: ChannelOption = None,
    sidecar: SidecarOption = None,
    band: BandOption = None,
    modes: ModesOption = None,
    window: Annotated[
        str | None,
        typer.Option(
            metavar="KIND", help="How the records were cut: none, rectangular, hann or exponential:SECONDS."
        ),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(metavar="KIND", help="receptance, mobility or accelerance, if the file does not say."),
    ] = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Modal parameters from measured frequency responses, all responses together.

    Poles that stay put as the model order grows are refined by least squares on the whole shape of their peaks, which
    gives damping also far below the frequency resolution. Modes whose peak acceleration is below 5 % of the strongest
    one's everywhere are listed apart, as minor_modes. JSON keys: modes, minor_modes, residues, misfit.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_frf

    _check(plot, json_to)
    test = open_test(file, channel or [], None, sidecar, "response")
    result, draw = run_frf(test, _pair(band), modes, window, kind)
    _finish(test, result, draw, plot, json_to, yes=yes)


@fit_app.command(epilog="Example: atmd fit decay beam.npz --channel y:mm --plot beam.png")
def decay(
    file: FileArgument,
    channel: Annotated[
        list[str] | None, typer.Option("--channel", metavar="ARRAY[:UNIT]", help="The signal that decays.")
    ] = None,
    sample_rate: RateOption = None,
    sidecar: SidecarOption = None,
    band: BandOption = None,
    modes: ModesOption = None,
    amplitudes: Annotated[
        str | None,
        typer.Option(
            metavar="A,B,...",
            help="Edges of the amplitude bands, in the signal's unit; 1, 2, 5, 10 ... unless given.",
        ),
    ] = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Frequency and damping by amplitude from free decays, which are found in the record.

    JSON keys: modes (the strongest first), bands (amplitude_from, amplitude_to, unit, frequency_hz, damping_ratio,
    frequency_std_hz, damping_std, decays), decays, amplitude_dependent.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_decay

    _check(plot, json_to)
    test = open_test(file, channel or [], sample_rate, sidecar, "signal")
    result, draw = run_decay(test, _pair(band), _edges(amplitudes), modes)
    _finish(test, result, draw, plot, json_to, yes=yes)


@fit_app.command(epilog="Example: atmd fit step circuit.npz --channel input=u:V --channel output=y:V")
def step(
    file: FileArgument,
    channel: ChannelOption = None,
    sample_rate: RateOption = None,
    sidecar: SidecarOption = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Natural frequency and damping from second-order step responses, all steps of all records together.

    With an input channel the steps are where it jumps; without one the response shows them. JSON keys: modes, steps,
    method (forced: the response to the input fits; free: only the ringing after the edge was used), delay_s, each.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_step

    _check(plot, json_to)
    test = open_test(file, channel or [], sample_rate, sidecar, "output")
    result, draw = run_step(test)
    _finish(test, result, draw, plot, json_to, yes=yes)


@fit_app.command(epilog="Example: atmd fit damper damper.npz --channel force=F:N --channel velocity=v:mm/s")
def damper(
    file: FileArgument,
    channel: ChannelOption = None,
    sample_rate: RateOption = None,
    sidecar: SidecarOption = None,
    plot: PlotOption = None,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Equivalent damping from force and motion, and whether a linear damper describes the data at all.

    Force balance by least squares, energy per cycle, dry friction beside viscous damping. In SI units where the force
    has a known unit, else as recorded (c_eq_unit says which). JSON keys: c_eq, c_eq_std, c_eq_unit, k, m, linear_nrmse,
    linear_adequate, reason, not_identifiable, records.
    """
    from twin.station.fit_data import open_test
    from twin.station.fit_runs import run_damper

    _check(plot, json_to)
    test = open_test(file, channel or [], sample_rate, sidecar, "velocity")
    result, draw = run_damper(test)
    _finish(test, result, draw, plot, json_to, yes=yes)


def _check(plot: Path | None, json_to: str | None) -> None:
    must_be_writable(json_to)
    if plot is None:
        return
    if plot.suffix.lower() not in (".png", ".svg"):
        raise InputError(f"--plot {plot}: a plot's name ends in .png or .svg")
    if not plot.absolute().parent.is_dir():
        raise InputError(f"--plot {plot}: cannot be written; give a file in a folder that exists")


def _finish(
    test: "TestFile", result: dict[str, Any], draw: Any, plot: Path | None, json_to: str | None, *, yes: bool
) -> None:
    for note in test.notes:
        say(note)
    confirm_guesses(test.guesses, yes=yes)
    result["guesses"] = test.guesses
    if plot is not None:
        from twin.station.fit_plots import save_plot

        save_plot(draw, plot)
        result["plot"] = str(plot)
    report(result, fit_table, json_to)


def _pair(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        pair = float(low), float(high)
    except ValueError as error:
        raise InputError(f"--band {text}: write two frequencies in Hz, such as 5:30") from error
    if not 0.0 <= pair[0] < pair[1] < float("inf"):
        raise InputError(f"--band {text}: the lower frequency comes first, both in Hz, such as 5:30")
    return pair


def _edges(text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        found = sorted({float(part) for part in text.split(",")})
    except ValueError as error:
        raise InputError(f"--amplitudes {text}: write numbers such as 0.5,1,2,5,10") from error
    if len(found) < 2 or not found[0] >= 0.0 or not found[-1] < float("inf"):
        raise InputError(f"--amplitudes {text}: at least two different edges, none below 0")
    return found


def fit_table(r: dict[str, Any]) -> Table:
    """Figures of any fit as a table."""
    table = Table("figure", "value", "", title=f"Fit of {r['file']}", title_justify="left")
    for title, key in (("mode", "modes"), ("minor mode", "minor_modes")):
        for number, m in enumerate(r.get(key, []), start=1):
            table.add_row(f"{title} {number}", *_mode(m))
    for b in r.get("bands", []):
        name = f"{b['amplitude_from']:.3g} to {b['amplitude_to']:.3g} {b['unit']}"
        table.add_row(name, _mode(b)[0], f"{_mode(b)[1]}; {b['decays']} decays")
    for name, key, std, unit in (
        ("stiffness", "stiffness_n_m", "stiffness_std_n_m", "N/m"),
        ("moving mass", "moving_mass_kg", "moving_mass_std_kg", "kg"),
    ):
        if key in r:
            table.add_row(name, plus_minus(r[key], r[std], unit), "maximum likelihood: trust this one")
            old = r["eq_7_1"]
            table.add_row("", plus_minus(old[key], old[std], unit), "thesis eq. 7-1")
    if r.get("mass_to_add_kg") is not None:
        table.add_row("mass to add", f"{r['mass_to_add_kg']:.4g} kg", "")
    if "c_eq" in r:
        table.add_row(
            "c", plus_minus(r["c_eq"], r["c_eq_std"], r["c_eq_unit"]), f"{len(r['records'])} records"
        )
        table.add_row("k", plus_minus(r["k"], r["k_std"], r["k_unit"]), "")
        table.add_row(
            "NRMSE of a linear damper",
            f"{r['linear_nrmse']:.3f}",
            f"of it with the motion {r['systematic_nrmse']:.3f}",
        )
        table.add_row(
            "a linear damper", "is adequate" if r["linear_adequate"] else "is NOT adequate", r["reason"]
        )
        for name, why in r["not_identifiable"].items():
            table.add_row(f"{name} not identifiable", "", why)
    for name, key in (("gain", "gain"), ("steps", "steps"), ("method", "method"), ("misfit", "misfit")):
        if key in r:
            table.add_row(name, f"{r[key]:.4g}" if isinstance(r[key], float) else str(r[key]), "")
    if r.get("amplitude_dependent"):
        table.add_row("amplitude", "matters", "the bands differ by more than their errors")
    return table


def plus_minus(value: float, std: float, unit: str) -> str:
    """Value and standard deviation to the digits that the latter allows."""
    import math

    if not std > 0.0 or not math.isfinite(std):
        return f"{value:.5g} {unit}"
    places = max(0, 1 - math.floor(math.log10(std)))
    return f"{value:.{places}f} ± {std:.{places}f} {unit}"


def _mode(m: dict[str, Any]) -> tuple[str, str]:
    return (
        plus_minus(m["frequency_hz"], m["frequency_std_hz"], "Hz"),
        f"damping ratio {plus_minus(m['damping_ratio'], m['damping_std'], '')}".rstrip(),
    )
