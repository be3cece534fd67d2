"""What every command of ``atmd`` says to people and to programs: messages, progress, tables, JSON."""

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from twin.plant.errors import InputError

people = Console(stderr=True)
"""Where people read: standard error, so that standard output is the command's result alone."""

JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE|-", help="Write the figures as JSON to a file, or - for here."),
]


def say(line: str) -> None:
    """Tell the person at the terminal, on standard error."""
    people.print(line, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show progress on a terminal from the first ``update(done, total)`` on; until then a person may be asked."""
    columns = (
        TextColumn(what), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(), TextColumn("left"),
        TimeRemainingColumn(),
    )  # fmt: skip
    bar = Progress(*columns, console=people, transient=True, disable=not people.is_terminal)
    task = bar.add_task(what, total=None)

    def update(done: int, total: int) -> None:
        bar.start()  # once started, this does nothing
        bar.update(task, completed=done, total=total)

    try:
        yield update
    finally:
        bar.stop()


def report(
    result: dict[str, Any], table: Callable[[dict[str, Any]], RenderableType], json_to: str | None
) -> None:
    """Print a result as a table, and as JSON where it was asked for."""
    (Console() if json_to is None else people).print(table(result))
    if json_to is None:
        return
    text = json.dumps(result, indent=2, allow_nan=False)
    if json_to == "-":
        sys.stdout.write(text + "\n")
        return
    try:
        Path(json_to).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"--json {json_to}: cannot be written ({error.strerror})") from error


def must_be_writable(json_to: str | None) -> None:
    """Say now, not after the run, that its figures could not be written."""
    if json_to is None or json_to == "-":
        return
    path = Path(json_to)
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise InputError(
            f"--json {json_to}: cannot be written; give a file in a folder that exists, or - for standard output"
        )


def channel_options(options: list[str]) -> dict[str, str]:
    """Read ``--channel NAME=ARRAY:UNIT`` options; raises InputError for another form."""
    pairs = {}
    for option in options:
        name, equals, array = option.partition("=")
        if not (name and equals and array):
            raise InputError(f"--channel {option}: write NAME=ARRAY:UNIT, such as tip_displacement=y:mm")
        pairs[name] = array
    return pairs


def percent(share: float | None) -> str:
    """Share in percent, or a dash."""
    return "-" if share is None else f"{100.0 * share:.1f} %"


def with_unit(value: float | None, unit: str) -> str:
    """Three figures with their unit, or a dash."""
    return "-" if value is None else f"{value:.3g} {unit}"


def number(value: float | None) -> str:
    """Three figures, or a dash."""
    return "-" if value is None else f"{value:.3g}"
