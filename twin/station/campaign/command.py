"""``atmd campaign`` on the command line."""

from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.table import Table

from twin.plant.errors import InputError
from twin.station.terminal import (
    JsonOption,
    must_be_writable,
    number,
    percent,
    progress_bar,
    report,
    say,
    with_unit,
)


def campaign(
    spec: Annotated[
        Path, typer.Argument(metavar="SPEC.toml", help="What is asked, see docs/examples/campaign.toml.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Folder of the results; SPEC.campaign beside the specification if not given."
        ),
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads; one per core if not given.")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, such as tcp://10.0.0.5:8786."
        ),
    ] = None,
    replay: Annotated[
        int | None,
        typer.Option(min=0, metavar="CASE", help="Run this one case on the simulated rig instead."),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="With --replay: record the case here.")
    ] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Draw no plots, write no page.")] = False,
    json_to: JsonOption = None,
) -> None:
    """Put the same question to thousands of cases: parameters scattered at random, budgets, coils, excitations.

    Each case is a rig of its own, run sample by sample through the excitation under the schedule in question: the
    thesis's rule, gains of a file, or retuned. Its row holds attenuation against the passive rig, power, current,
    stroke, the exact poles and margins on the grid of frequencies, and the limit it broke first.

    Rows are kept in Parquet as cases finish. The same command goes on where it was interrupted. The report shows the
    yield against the budget, the worst cases and what the result depends on; any case can be run again alone with
    `--replay`, with the twin beside it and a recording to look at.

    An `[archive]` in the specification replays recordings instead, as they were or with other plants, budgets and
    margins for the tuner. `--scheduler` needs the extra `cluster`; whoever reaches a Dask scheduler can run programs on
    its workers, so give it TLS (`tls://` and Dask's own settings, see docs/examples/campaign-cluster.md) or keep it on
    a network of your own.
    """
    from twin.station.campaign.run import CampaignOptions, run_campaign

    must_be_writable(json_to)
    if recording is not None and replay is None:
        raise InputError("--recording: belongs to --replay CASE; add that, or leave it out")
    if replay is not None:
        report(_replay(spec, replay, recording), _case_table, json_to)
        return
    with progress_bar("campaign") as progress:
        options = CampaignOptions(spec, out, threads, scheduler, plots=not no_report)
        result = run_campaign(options, say, progress)
    report(result, _archive_table if "recordings" in result else _table, json_to)


def _replay(spec_path: Path, case: int, recording: Path | None) -> dict[str, Any]:
    from twin.plant.files import read_toml
    from twin.station.campaign.cases import prepare
    from twin.station.campaign.replay import replay_case
    from twin.station.campaign.spec import CampaignSpec

    spec = read_toml(spec_path, CampaignSpec)
    if spec.archive is not None:
        raise InputError(f"{spec_path}: holds an archive; replay a recording of it with 'atmd replay FILE'")
    with progress_bar(f"case {case}") as progress:
        return replay_case(prepare(spec, spec_path.parent, say), case, recording, say, progress)


def _table(r: dict[str, Any]) -> Table:
    table = Table(
        "", "", box=box.SIMPLE, show_header=False, title=f"Campaign {r['name']}", title_justify="left"
    )
    table.add_row("cases", f"{r['cases']}, {r['computed']} of them now in {r['seconds']:.1f} s")
    table.add_row("keep everything", f"{r['meeting']}  ({percent(r['meeting'] / max(r['cases'], 1))})")
    table.add_row("stable on the whole grid", str(r["stable"]))
    table.add_row("limit broken first", ", ".join(f"{k} {v}" for k, v in r["first_limits"].items()))
    for point in r["yields"] if len(r["yields"]) <= 12 else []:
        what = f"yield, {point['plant']}, {point['budget_w']:g} W"
        table.add_row(
            what, f"{percent(point['share'])}  ({percent(point['low'])} to {percent(point['high'])})"
        )
    for result, found in r["sensitivities"].items():
        ranked = sorted((k for k in found if k), key=lambda k: -abs(found[k]["regression"]))[:3]
        table.add_row(f"{result} depends on", ", ".join(f"{k} {found[k]['regression']:+.2f}" for k in ranked))
    for row in r["worst"][:3]:
        words = f"{percent(row['attenuation_worst'])} attenuation at worst, first limit {row['first_limit'] or '-'}"
        if not row["stable"]:
            words += f", unstable {number(row['growth_1_s'])} 1/s"
        table.add_row(f"worst: case {row['case']}", words)
    table.add_row("results", r["results"])
    if "report" in r:
        table.add_row("report", r["report"])
    return table


def _archive_table(r: dict[str, Any]) -> Table:
    table = Table(
        "recording", "plant", "budget", "margin", "attenuation", "worst", "power", "proposed", "at power", "median NIS",
        "", box=box.SIMPLE, title=f"Archive {r['name']}: {r['recordings']} recordings, {r['replays']} replays",
        title_justify="left",
    )  # fmt: skip
    for row in r["rows"]:
        table.add_row(
            Path(row["recording"]).name, row["plant"] or "-", with_unit(row["budget_w"], "W"),
            number(row["modulus_margin"]), percent(row["attenuation_mean"]), percent(row["attenuation_worst"]),
            with_unit(row["joule_mean_w"], "W"), percent(row["proposed_attenuation"]),
            with_unit(row["proposed_joule_mean_w"], "W"), number(row["nis_median"]), row["trouble"],
        )  # fmt: skip
    return table


def _case_table(r: dict[str, Any]) -> Table:
    row, session = r["row"], r["session"]
    table = Table("", "campaign", "twin", box=box.SIMPLE, title=f"Case {r['case']}", title_justify="left")
    for key, unit in (
        ("attenuation_mean", "%"), ("attenuation_worst", "%"), ("current_peak_a", "A"), ("joule_mean_w", "W"),
        ("joule_peak_w", "W"), ("electrical_mean_w", "W"),
    ):  # fmt: skip
        both = (percent(x) if unit == "%" else with_unit(x, unit) for x in (row[key], session[key]))
        table.add_row(key, *both)
    for key in ("displacement_m", "stroke_m", "growth_1_s", "modulus_margin", "delay_margin_s"):
        table.add_row(key, number(row[key]), "-")
    table.add_row("first limit", row["first_limit"] or "-", r["tripped"] or "-")
    for key, value in row.items():
        if key.startswith("drawn "):
            table.add_row(key, number(value), "")
    if r["recording"]:
        table.add_row("recording", r["recording"], "")
    return table
