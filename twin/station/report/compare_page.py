"""Runs side by side, as a page and as tables in the terminal."""

from collections.abc import Callable, Iterable
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from twin.station.report.compare_plots import comparison_plots
from twin.station.report.compared import SIGNIFICANT, Comparison
from twin.station.report.differences import shown
from twin.station.report.figures import HOVER, all_as_html, no_progress
from twin.station.report.page import Html, badge, element, join, page, section, table
from twin.station.report.words import quantity, seconds, share, size

SECTIONS = (
    ("figures", "Figures"), ("plots", "Plots"), ("runs", "Runs"), ("configuration", "Configuration"),
    ("gains", "Gains"), ("decisions", "Decisions"), ("events", "Events"), ("cells", "Numbers"),
)  # fmt: skip
MOST_SETTINGS = 40
"""More of them are on the page alone."""

MOST_ROWS = 1200
LEVELS = {"error": "bad", "warning": "warn", "info": "open"}


def comparison_page(
    c: Comparison, said: dict[str, Any], progress: Callable[[int, int], None] = no_progress
) -> str:
    """The whole page.

    Parameters
    ----------
    said
        `twin.station.report.compared.as_data` of the comparison.
    progress
        Takes plots drawn and plots in all.
    """
    names = [run.name for run in c.runs]
    title = " and ".join(names) if len(names) == 2 else f"{len(names)} runs"
    unit = "Hz" if c.by == "frequency" else "s"
    lead = (
        f"Reference: {names[0]}. Aligned by {'excitation frequency' if c.by == 'frequency' else 'time'} in cells of "
        f"{c.step:g} {unit}, {c.grid[0]:g} to {c.grid[-1]:g} {unit}. Every run was replayed through the same loop; "
        "± is one standard deviation, where it is known."
    )
    links = join(element("a", name, href=f"#{anchor}") for anchor, name in SECTIONS)
    body = join((
        element("h1", f"Compared: {title}"),
        element("p", lead, class_="dim"),
        *(_not_whole(run) for run in said["runs"]),
        element("nav", links, aria_label="Sections"),
        section("Figures", "figures", _figures(said, names), _differences(c, said)),
        section("Plots", "plots", all_as_html(comparison_plots(c), progress)),
        section("Runs", "runs", _runs(said)),
        section("Configuration", "configuration", _configuration(said, names)),
        section("Gains in use in the end", "gains", _gains(said, names)),
        section("Decisions and commands", "decisions", _decisions(said, names)),
        section("Events", "events", _events(said, names)),
        section("Numbers", "cells", _cells(c, said, names)),
    ))  # fmt: skip
    return page(f"Compared: {title}", body, HOVER)


def value_of(value: float | None, unit: str, std: float | None = None) -> str:
    """A figure as people read it."""
    return share(value, std) if unit == "%" else quantity(value, unit, std)


def _not_whole(run: dict[str, Any]) -> Html:
    return join(
        element("p", f"{run['name']} is not whole: {damage}.", class_="notice")
        for damage in run["verify"]["damage"]
    )


def _figures(said: dict[str, Any], names: list[str]) -> Html:
    rows = [
        [row["title"], *_beside(row)]
        for row in said["figures"]
    ]  # fmt: skip
    heads = ["figure", names[0]]
    for name in names[1:]:
        heads += [name, "difference"]
    return table(heads, rows, range(1, len(heads)))


def _beside(row: dict[str, Any]) -> list[str]:
    """The reference's value, then each other run's with its difference."""
    unit, out = row["unit"], [value_of(row["values"][0], row["unit"], row["std"][0])]
    for k in range(1, len(row["values"])):
        out.append(value_of(row["values"][k], unit, row["std"][k]))
        out.append(value_of(row["differences"][k], unit, row["differences_std"][k]))
    return out


def _differences(c: Comparison, said: dict[str, Any]) -> Html:
    rows = [
        [title, name, *words]
        for title, name, words in _difference_rows(c, said)
    ]  # fmt: skip
    heads = (
        "quantity",
        "run",
        "mean difference",
        "share",
        "largest",
        "at",
        f"beyond {SIGNIFICANT:g} σ",
        "cells",
    )
    return join((
        element("h3", f"Differences from {c.runs[0].name}, cell by cell", class_="sub"),
        table(heads, rows, (2, 3, 4, 5, 6, 7)) if rows else element("p", "Nothing is known of both runs at any place."),
    ))  # fmt: skip


def _difference_rows(c: Comparison, said: dict[str, Any]) -> Iterable[tuple[str, str, list[str]]]:
    parts = [(d["title"], d["unit"], d["differences"], c.by) for d in said["quantities"].values()]
    if said["damping"] is not None:
        parts.append(("c2(f), where known", "Ns/m", said["damping"]["differences"], "frequency"))
    for title, unit, differences, by in parts:
        for k in range(1, len(c.runs)):
            s = differences[k]["summary"]
            if s is None:
                continue
            unit_shown = "%" if title == "attenuation" else unit
            place = f"{s['worst_at']:g} {'Hz' if by == 'frequency' else 's'}"
            beyond = "–" if not s["judged"] else f"{s['significant']} of {s['judged']}"
            yield (
                title,
                c.runs[k].name,
                [
                    value_of(s["mean"], unit_shown, s["mean_std"]),
                    ""
                    if differences[k].get("relative") is None
                    else f"{100.0 * differences[k]['relative']:+.1f} %",
                    value_of(s["worst"], unit_shown, s["worst_std"]),
                    place,
                    beyond,
                    str(s["cells"]),
                ],
            )


def _runs(said: dict[str, Any]) -> Html:
    rows = []
    for run in said["runs"]:
        v = run["verify"]
        whole = {
            True: badge("whole", "good"),
            False: badge("not whole", "bad"),
            None: badge("no checksums", "open"),
        }
        files = join(
            join((f"{f['name']}, {size(f['bytes'])} ", element("code", f["sha256"]), Html("<br>")))
            for f in run["files"]
        )
        when = (
            "–"
            if run["recorded_at"] is None
            else run["recorded_at"].replace("T", " ").replace("+00:00", " UTC")
        )
        rate = f"{run['sample_rate_hz']:g} Hz"
        rows.append(
            [
                run["name"],
                files,
                when,
                run["plant"],
                rate,
                f"{run['seconds']:.1f} s",
                whole[v["whole"]],
                run["estimates"],
            ]
        )
    heads = ("run", "file and SHA-256", "recorded", "plant", "samples", "length", "verified", "estimates")
    return table(heads, rows, (4, 5))


def _configuration(said: dict[str, Any], names: list[str]) -> Html:
    rows = [
        [element("code", row["key"].replace(".", "\u200b.")), *(shown(v) for v in row["values"])]
        for row in said["configuration"]
    ]
    if not rows:
        return element("p", "The same in all runs.")
    return join(
        (element("p", f"{len(rows)} settings differ.", class_="dim"), table(("setting", *names), rows))
    )


def _gains(said: dict[str, Any], names: list[str]) -> Html:
    gains = said["gains"]
    if gains is None:
        return element("p", "Fewer than two runs tell their gains at common frequencies.")
    if gains["same"]:
        return element("p", "The same in all runs that tell theirs.")
    rows = []
    for k, hz in enumerate(gains["frequency_hz"]):
        rows.append([f"{hz:g}", *(_gains_at(g, k) for g in gains["runs"])])
    words = "Linear between the schedules' points: α [kg], β [Ns/m], γ [N/m]; low-pass and high-pass."
    return join((element("p", words, class_="dim"), table(("Hz", *names), rows, (0,))))


def _gains_at(g: dict[str, list[float]] | None, k: int) -> str:
    if g is None:
        return "–"
    return (
        f"α {g['alpha_kg'][k]:.3g}, β {g['beta_ns_m'][k]:.4g}, γ {g['gamma_n_m'][k]:.5g}; "
        f"{g['low_pass_hz'][k]:.4g}/{g['high_pass_hz'][k]:.3g} Hz"
    )


def _decisions(said: dict[str, Any], names: list[str]) -> Html:
    rows = [
        [
            seconds(d["time_s"]),
            names[d["run"]],
            "–" if d["frequency_hz"] is None else f"{d['frequency_hz']:.2f}",
            d["what"],
            badge("taken" if d["accepted"] else "declined", "good" if d["accepted"] else "warn"),
            f"{d['by']}: {d['reason']}",
            "–" if d["command_id"] is None else f"command {d['command_id']}",
        ]
        for d in said["decisions"]
    ]
    if not rows:
        return element("p", "None in any run.")
    listed = table(("time", "run", "Hz", "what", "decision", "why", "became"), rows, (0, 2))
    return (
        listed if len(rows) < 40 else element("details", element("summary", f"{len(rows)} decisions"), listed)
    )


def _events(said: dict[str, Any], names: list[str]) -> Html:
    def when(times: list[float]) -> str:
        return (
            "–"
            if not times
            else seconds(times[0]) + (f" and {len(times) - 1} more" if len(times) > 1 else "")
        )

    rows = [
        [badge(e["level"], LEVELS[e["level"]]), e["text"], *(when(times) for times in e["times_s"])]
        for e in said["events"]
    ]
    if not rows:
        return element("p", "None in any run.")
    note = element(
        "p", "Events that differ in numbers alone are one row, in the words of the first.", class_="dim"
    )
    return join((note, table(("level", "what", *names), rows)))


def _cells(c: Comparison, said: dict[str, Any], names: list[str]) -> Html:
    if len(c.grid) > MOST_ROWS:
        return element("p", f"{len(c.grid)} cells: with --json.")
    parts = []
    unit = "Hz" if c.by == "frequency" else "s"
    for q in said["quantities"].values():
        rows = []
        for k, place in enumerate(said["grid"]):
            values = [run["value"][k] for run in q["runs"]]
            if all(v is None for v in values):
                continue
            shown_unit = "%" if q["title"] == "attenuation" else q["unit"]
            rows.append(
                [f"{place:g}", *(value_of(run["value"][k], shown_unit, run["std"][k]) for run in q["runs"])]
            )
        inside = table((unit, *names), rows, range(len(names) + 1))
        parts.append(
            element(
                "details", element("summary", f"{q['title']}, {len(rows)} cells"), inside, class_="screen"
            )
        )
    return join(parts)


def comparison_tables(c: Comparison, said: dict[str, Any]) -> Group:
    """Figures, differences and settings for the terminal."""
    names = [escape(run.name) for run in c.runs]
    first = Table("figure", title=f"Compared with {names[0]}", title_justify="left")
    first.add_column(names[0], justify="right")
    for name in names[1:]:
        first.add_column(name, justify="right")
        first.add_column("difference", justify="right")
    for row in said["figures"]:
        first.add_row(row["title"], *_beside(row))
    unit = "Hz" if c.by == "frequency" else "s"
    second = Table(
        "quantity", "run", "mean difference", "share", "largest", "at", f"beyond {SIGNIFICANT:g} σ", "cells",
        title=f"Cell by cell, {c.grid[0]:g} to {c.grid[-1]:g} {unit}", title_justify="left",
    )  # fmt: skip
    for title, name, words in _difference_rows(c, said):
        second.add_row(title, escape(name), *words)
    rows = said["configuration"]
    third = Table("setting", *names, title=f"{len(rows)} settings differ", title_justify="left")
    for row in rows[:MOST_SETTINGS]:
        third.add_row(escape(row["key"]), *(escape(shown(v)) for v in row["values"]))
    if len(rows) > MOST_SETTINGS:
        third.add_row(f"and {len(rows) - MOST_SETTINGS} more: --html or --json", *[""] * len(names))
    return Group(first, second, third)
