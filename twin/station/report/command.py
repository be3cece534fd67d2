"""``atmd report`` on the command line."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Column, Table

from twin.plant.errors import InputError
from twin.station.confirm import YesOption, accept_recording
from twin.station.terminal import JsonOption, channel_options, must_be_writable, progress_bar, say
from twin.station.terminal import report as write_result

if TYPE_CHECKING:
    from twin.station.opened import ReplayOptions

PlantOption = Annotated[
    str | None,
    typer.Option(metavar="PRESET|FILE", help="Plant of a recording that carries none."),
]
ChannelOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=ARRAY[:UNIT]",
        help="Where a sensor or command lies in it, as for replay; may be repeated.",
    ),
]
SampleRateOption = Annotated[
    float | None, typer.Option(min=1e-6, metavar="HZ", help="Its sample rate in Hz, if it does not say.")
]
SidecarOption = Annotated[
    Path | None, typer.Option(metavar="FILE", help="TOML or JSON with its rate, units and channels.")
]
HtmlOption = Annotated[
    Path | None, typer.Option("--html", metavar="FILE.html", help="Write one page that stands alone.")
]
PlotOption = Annotated[
    Path | None,
    typer.Option("--plot", metavar="FILE", help="Draw the plots: .png, .svg, or .pdf with a page each."),
]
RecomputeOption = Annotated[
    bool,
    typer.Option("--recompute", help="Work the tuner's answers out again, also where they are recorded."),
]


def report(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A recording of any format.", show_default=False)
    ],
    html: HtmlOption = None,
    plot: PlotOption = None,
    plant: PlantOption = None,
    channel: ChannelOption = None,
    sample_rate: SampleRateOption = None,
    sidecar: SidecarOption = None,
    recompute: RecomputeOption = False,
    yes: YesOption = False,
    json_to: JsonOption = None,
) -> None:
    """Write the page to file after a test: what was run, how it went against the limits, what was proposed.

    The recording is replayed through the same loop; its figures are those of `atmd replay`. The page, one file that
    loads nothing and prints well, holds the set-up with date, checksums and versions, every limit of the plant with the
    worst that was seen, plots that read out values under the pointer or arrow keys, proposals with what became of them,
    predicted against achieved, alarms and faults, and what the recording cannot tell. Without --html, --plot or --json
    it is written beside the recording as FILE.html.

    JSON keys: setup, verify, figures (those of replay), hindsight (attenuation against the model with the damping known
    in the end, with standard deviation), limits (key, limit, worst, worst_std, at_s, at_hz, margin, verdict, and the
    same settled), damping, gains, proposals, commands, audit, events, faults, cannot_say, tracks (columns, one row per
    block).
    """
    from twin.station.report.document import document
    from twin.station.report.figures import must_be_a_plot, save_plots
    from twin.station.report.filed import filed_page
    from twin.station.report.page import write_page
    from twin.station.report.plots import plots_of
    from twin.station.report.replayed import replayed

    must_be_writable(json_to)
    if html is None and plot is None and json_to is None:
        html = (file if file.is_dir() else file.parent) / f"{file.stem or file.name}.html"
    must_be_a_page(html, [file])
    if plot is not None:
        must_be_a_plot(plot)
    options = replay_options(plant, channel, sample_rate, sidecar, recompute=recompute, yes=yes)
    with progress_bar("report") as progress:
        run = replayed(file, options, say, progress, name_of(file))
    said = document(run)
    with progress_bar("page") as progress:
        if html is not None:
            write_page(html, filed_page(run, said, progress))
        if plot is not None:
            save_plots(plots_of(run), plot)
    write_result(said, report_table, json_to)
    for path in (html, plot):
        if path is not None:
            say(f"written: {path}")


def report_table(said: dict[str, Any]) -> Table:
    """Limits and headline figures for the terminal."""
    from twin.station.report.words import quantity, seconds, share

    v, h, f = said["verify"], said["hindsight"], said["figures"]
    whole = {True: "whole", False: "[red]not whole[/]", None: "no checksums"}[v["whole"]]
    table = Table(
        Column("figure", overflow="fold"), "limit", "worst seen", "when", "margin", "verdict",
        title=f"{escape(said['setup']['file'])}: {said['setup']['plant']}, {said['setup']['seconds']:.1f} s, {whole}",
        title_justify="left",
    )  # fmt: skip
    for e in said["limits"]:
        colour = {"kept": "green", "broken": "red", "unknown": "dim"}[e["verdict"]]
        verdict = f"[{colour}]{e['verdict']}[/]"
        if e["verdict_settled"] not in ("unknown", e["verdict"]):
            verdict += f", settled {e['verdict_settled']}"
        worst = quantity(e["worst"], e["unit"], e["worst_std"])
        when = "–" if e["at_s"] is None else seconds(e["at_s"])
        table.add_row(e["key"], quantity(e["limit"], e["unit"]), worst, when, share(e["margin"]), verdict)
    table.add_section()
    if h["attenuation_mean"] is not None:
        mean = share(h["attenuation_mean"], h["attenuation_std"])
        table.add_row("mean attenuation", "", mean, "", "", f"{h['from_hz']:.1f} to {h['to_hz']:.1f} Hz")
        table.add_row(
            "worst attenuation",
            "",
            share(h["attenuation_worst"]),
            seconds(h["worst_at_s"]),
            "",
            f"{h['worst_at_hz']:.1f} Hz",
        )
    else:
        table.add_row("attenuation", "", "–", "", "", escape(h["why_not"]))
    table.add_row("model consistent", "", share(f["estimation"]["consistent_share"]), "", "", "of the run")
    table.add_row("masked values", "", str(v["masked"]["values"]), "", "", share(v["masked"]["share"]))
    for damage in v["damage"]:
        table.add_row("[red]not whole[/]", "", "", "", "", escape(damage))
    return table


def replay_options(
    plant: str | None,
    channel: list[str] | None,
    sample_rate: float | None,
    sidecar: Path | None,
    *,
    recompute: bool,
    yes: bool,
) -> "ReplayOptions":
    """Options of a replay, as the command line of `atmd replay` has them."""
    from twin.station.opened import ReplayOptions

    return ReplayOptions(
        plant=plant,
        channels=channel_options(channel or []),
        sample_rate_hz=sample_rate,
        sidecar=sidecar,
        recompute=recompute,
        accept=partial(accept_recording, yes=yes),
    )


def must_be_a_page(html: Path | None, inputs: list[Path]) -> None:
    """Say before the run that a page cannot be written, or would be written over a recording; raises InputError."""
    if html is None:
        return
    if html.is_dir() or not html.absolute().parent.is_dir():
        raise InputError(f"--html {html}: cannot be written; give a file in a folder that exists")
    if html.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--html {html}: the name of a page ends in .html")
    if any(html.exists() and path.exists() and html.samefile(path) for path in inputs):
        raise InputError(f"--html {html}: is a recording; give another name")


def name_of(file: Path) -> str:
    """What a run is called: its file without ending; where all files are called alike, with its folder."""
    stem = file.stem or file.name
    return f"{file.absolute().parent.name}/{stem}" if stem in ("recording", "run", "live", "data") else stem
