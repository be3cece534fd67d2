"""``atmd validate``: every figure of the thesis beside the computed one, as table, JSON and web page."""

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from twin.plant.errors import InputError
from twin.station.validation.catalogue import all_rows, counts
from twin.station.validation.report import number, write_report
from twin.station.validation.rows import Row

_MARK = {"reproduced": ("✓", "green"), "differs": ("✗", "red"), "not reproducible": ("·", "dim")}


def run_validation(
    report: Path | None,
    say: Callable[[str], None] = lambda _line: None,
    progress: Callable[[int, int], None] = lambda _done, _of: None,
) -> dict[str, Any]:
    """Compute and judge all figures.

    Parameters
    ----------
    report
        Folder for the web page; None for none.

    Returns
    -------
    dict
        ``rows`` and ``counts``, as JSON takes them.

    Raises
    ------
    InputError
        If the report's folder is a file or cannot be written to.
    """
    if report is not None and report.exists() and not report.is_dir():
        raise InputError(f"--report {report}: is a file; give a folder")
    rows = all_rows(progress)
    if report is not None:
        say(f"drawing into {report}")
        say(f"report: {write_report(rows, report, progress)}")
    return {"rows": [_plain(row) for row in rows], "counts": counts(rows)}


def validation_table(result: dict[str, Any]) -> Table:
    """Table for people, no wider than 80 columns; sources and notes are in JSON and report."""
    found = result["counts"]
    legend = ", ".join(f"{found[name]} [{colour}]{mark}[/] {name}" for name, (mark, colour) in _MARK.items())
    table = Table(
        title=f"The thesis, recomputed: {legend}",
        caption="Source, tolerance and reason of every row: --report DIR or --json FILE",
        title_justify="left",
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    table.add_column("", no_wrap=True)
    table.add_column("figure", no_wrap=True)
    table.add_column("thesis", justify="right", no_wrap=True)
    table.add_column("computed", justify="right", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for entry in result["rows"]:
        row = Row(**entry)
        mark, colour = _MARK[row.verdict]
        unit = "" if row.unit in ("1", "true/false") else row.unit
        values = (number(row.thesis, 4), number(row.computed, 4))
        table.add_row(f"[{colour}]{mark}[/]", row.id, *values, unit)
    return table


def _plain(row: Row) -> dict[str, Any]:
    """A row as JSON takes it: a figure without bound is no number there."""
    plain = asdict(row)
    for key in ("thesis", "computed", "relative_error"):
        value = plain[key]
        if isinstance(value, float) and not math.isfinite(value):
            plain[key] = None
    return plain
