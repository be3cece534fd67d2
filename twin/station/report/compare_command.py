"""``atmd compare`` on the command line."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from twin.plant.errors import InputError
from twin.station.confirm import YesOption
from twin.station.report.command import (
    ChannelOption,
    HtmlOption,
    PlantOption,
    PlotOption,
    RecomputeOption,
    SampleRateOption,
    SidecarOption,
    must_be_a_page,
    name_of,
    replay_options,
)
from twin.station.terminal import JsonOption, must_be_writable, progress_bar, say
from twin.station.terminal import report as write_result


class ByName(StrEnum):
    """What blocks of different runs are brought together by."""

    FREQUENCY = "frequency"
    TIME = "time"


def compare(
    files: Annotated[
        list[Path], typer.Argument(metavar="A B [...]", help="Recordings of any format.", show_default=False)
    ],
    by: Annotated[
        ByName, typer.Option(help="Align by excitation frequency, or by time from the beginning.")
    ] = (ByName.FREQUENCY),
    reference: Annotated[
        str | None,
        typer.Option(metavar="FILE|NUMBER", help="What others are compared with; the first unless given."),
    ] = None,
    step: Annotated[
        float | None,
        typer.Option(min=1e-6, metavar="HZ|S", help="Width of a cell: 0.5 Hz, or one block, unless given."),
    ] = None,
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
    """Lay runs side by side: attenuation, power, damping, health, events, decisions, settings.

    Every recording is replayed through the same loop. Blocks are brought together in cells of excitation frequency or
    time, by a straight line in each cell, so that runs of other lengths, sweep rates and sample rates compare;
    differences carry their standard deviation where it is known: by the blocks' own noise and scatter, and the
    damping's. Attenuation is of each run against its own model without control, with the damping known in its end.
    Settings that are not the same are listed with each run's value.

    JSON keys: reference, by, step, grid, runs (file, sha256, verify, figures as of replay), figures (values, std,
    differences, differences_std), quantities (by name: runs with value, std, blocks; differences with value, std,
    summary, relative), damping, health, configuration (key, values), events, decisions, gains.
    """
    from twin.station.report.compare_page import comparison_page, comparison_tables
    from twin.station.report.compare_plots import comparison_plots
    from twin.station.report.compared import as_data
    from twin.station.report.compared import compare as compare_runs
    from twin.station.report.figures import must_be_a_plot, save_plots
    from twin.station.report.origin import is_own
    from twin.station.report.page import write_page
    from twin.station.report.replayed import replayed

    must_be_writable(json_to)
    must_be_a_page(html, files)
    if plot is not None:
        must_be_a_plot(plot)
    if len(files) < 2:
        raise InputError("give two recordings or more; for a single one there is atmd report")
    files = _reference_first(files, reference)
    options = replay_options(plant, channel, sample_rate, sidecar, recompute=recompute, yes=yes)
    own = replay_options(None, None, None, None, recompute=recompute, yes=False)
    runs = []
    for file, name in zip(files, _names(files), strict=True):
        with progress_bar(name) as progress:
            runs.append(replayed(file, own if plant and is_own(file) else options, say, progress, name))
    found = compare_runs(runs, by.value, step)
    said = as_data(found)
    with progress_bar("page") as progress:
        if html is not None:
            write_page(html, comparison_page(found, said, progress))
        if plot is not None:
            save_plots(comparison_plots(found), plot)
    write_result(said, lambda result: comparison_tables(found, result), json_to)
    for path in (html, plot):
        if path is not None:
            say(f"written: {path}")


def _reference_first(files: list[Path], reference: str | None) -> list[Path]:
    if reference is None:
        return files
    if reference.isdigit() and 1 <= int(reference) <= len(files):
        chosen = files[int(reference) - 1]
    elif Path(reference) in files:
        chosen = Path(reference)
    else:
        raise InputError(
            f"--reference {reference}: is none of the recordings; give one of them, or its number from 1 to "
            f"{len(files)}"
        )
    k = files.index(chosen)
    return [chosen, *files[:k], *files[k + 1 :]]


def _names(files: list[Path]) -> list[str]:
    """Short names that tell the runs apart."""
    short = [name_of(file) for file in files]
    folders = [file.absolute().parent.name for file in files]
    if len(set(short)) < len(short) or all(file.stem == files[0].stem for file in files):
        short = folders if len(set(folders)) == len(folders) else short
    return [
        name if short.count(name) == 1 else f"{name} ({short[: k + 1].count(name)})"
        for k, name in enumerate(short)
    ]
