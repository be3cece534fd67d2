"""Text tables: CSV and its relatives, with a headline of names and units, read as a stream."""

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive
from twin.rig.units import is_common

COMMENTS = ("#", "%", "//")
DELIMITERS = (";", "\t", ",", "|")
HEAD_LINES, HEAD_BYTES = 200, 1 << 18
MISSING = [
    "",
    "NaN",
    "nan",
    "NAN",
    "NA",
    "N/A",
    "null",
    "NULL",
    "-",
    "Inf",
    "inf",
    "-Inf",
    "-inf",
    "-NaN",
    "-nan",
]
_WITH_UNIT = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\[\]()]*)[\])]\s*$")


class TextArchive(Archive):
    """The columns of one text table.

    Decimal commas are understood where the columns are separated by something else. A headline may give units,
    ``tip [mm]`` or ``tip (mm)``, or have them in a line of their own; lines that begin with ``#``, ``%`` or ``//`` are
    comments. A cell that is empty or no number is missing.

    Raises
    ------
    InputError
        If the file is no table.
    """

    format = "text table"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        lines, self._encoding = _head(path)
        first = next((k for k, line in enumerate(lines) if _says_something(line)), None)
        if first is None:
            raise InputError(f"{path}: holds no table; expected a headline and rows of numbers")
        start = _first_row(lines, first)
        if start is None:
            raise InputError(
                f"{path}: no row of numbers in its first {len(lines)} lines; expected a headline and rows of numbers"
            )
        self._delimiter, self._decimal = _separators(path, lines[start : start + 50])
        headlines = [line for line in lines[:start] if _says_something(line)]
        width = len(self._cells(lines[start]))
        self.names, self.units = self._columns(headlines, width)
        self._skip = start
        self._length: int | None = None

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of rows, counted once."""
        if self._length is None:
            self._length = sum(len(batch) for batch in self._batches([self.names[0]]))
        return (self._length,)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of one column."""
        parts, at = [], 0
        for batch in self._batches([name]):
            column = _floats(batch.column(0))
            parts.append(column[max(0, first - at) : None if stop is None else max(0, stop - at)])
            at += len(column)
            if stop is not None and at >= stop:
                break
        return np.concatenate(parts) if parts else np.empty(0)

    def chunks(self, names: Sequence[str], rows: int) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Go through several columns in one pass over the file."""
        wanted = list(dict.fromkeys(names))
        waiting: list[NDArray[np.float64]] = [np.empty(0)] * len(wanted)
        for batch in self._batches(wanted):
            fresh = [_floats(batch.column(k)) for k in range(len(wanted))]
            waiting = [np.concatenate(pair) for pair in zip(waiting, fresh, strict=True)]
            while len(waiting[0]) >= rows:
                yield {name: column[:rows] for name, column in zip(wanted, waiting, strict=True)}
                waiting = [column[rows:] for column in waiting]
        if len(waiting[0]):
            yield dict(zip(wanted, waiting, strict=True))

    def _batches(self, names: Sequence[str]) -> Iterator[pa.RecordBatch]:
        broken: list[str] = []

        def note(row: pacsv.InvalidRow) -> str:
            broken.append(
                f"a row of {row.actual_columns} cells, where there should be {row.expected_columns}: {row.text!r}"
            )
            return "error"

        try:
            reader = pacsv.open_csv(
                self.path,
                read_options=pacsv.ReadOptions(
                    column_names=list(self.names), skip_rows=self._skip, encoding=self._encoding,
                    block_size=1 << 20, use_threads=False,
                ),
                parse_options=pacsv.ParseOptions(delimiter=self._delimiter, invalid_row_handler=note),
                convert_options=pacsv.ConvertOptions(
                    column_types={name: pa.string() for name in names}, include_columns=list(names),
                    strings_can_be_null=True, null_values=MISSING,
                ),
            )  # fmt: skip
            for batch in reader:
                yield self._converted(batch)
        except pa.ArrowInvalid as error:
            raise InputError(f"{self.path}: {broken[0] if broken else error}; correct the file") from error
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error})") from error

    def _converted(self, batch: pa.RecordBatch) -> pa.RecordBatch:
        columns = []
        for column, name in zip(batch.columns, batch.schema.names, strict=True):
            trimmed = pc.utf8_trim_whitespace(column)
            if self._decimal == ",":
                trimmed = pc.replace_substring(trimmed, ",", ".")
            try:
                columns.append(trimmed.cast(pa.float64()))
            except pa.ArrowInvalid as error:
                raise InputError(f"{self.path}: column '{name}': {error}; correct the file") from error
        return pa.RecordBatch.from_arrays(columns, names=batch.schema.names)

    def _cells(self, line: str) -> list[str]:
        return [
            cell.strip()
            for cell in next(csv.reader(io.StringIO(line.strip("\r\n")), delimiter=self._delimiter))
        ]

    def _columns(self, headlines: list[str], width: int) -> tuple[tuple[str, ...], dict[str, str]]:
        rows = [self._cells(line) for line in headlines]
        rows = [row for row in rows if len(row) == width]
        units: dict[str, str] = {}
        if not rows:
            return tuple(f"column{k + 1}" for k in range(width)), units
        below: list[str] = []
        if len(rows) > 1 and all(is_common(c.strip("[]() ")) or c.strip("[]() -") == "" for c in rows[-1]):
            below = [cell.strip("[]() ") for cell in rows[-1]]
            rows = rows[:-1]
        names: dict[str, None] = {}
        for k, cell in enumerate(rows[-1]):
            match = _WITH_UNIT.match(cell)
            name = (match["name"] if match else cell).strip() or f"column{k + 1}"
            name = name if name not in names else f"{name}_{k + 1}"
            names[name] = None
            unit = match["unit"].strip() if match else below[k] if below else ""
            if unit:
                units[name] = unit
        return tuple(names), units


def _head(path: Path) -> tuple[list[str], str]:
    """First lines of the file, and the encoding they are in."""
    try:
        with path.open("rb") as file:
            start = file.read(HEAD_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    if len(start) == HEAD_BYTES and b"\n" not in start and b"\r" not in start:
        raise InputError(
            f"{path}: its first line goes on beyond {HEAD_BYTES >> 10} kB; no recording has so many columns: export "
            "the channels you need"
        )
    if b"\0" in start and not start.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is neither a text table nor any other known format of recordings")
    encoding = "utf16" if start.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf8"
    try:
        text = start.decode("utf-16" if encoding == "utf16" else "utf-8-sig", errors="strict")
    except UnicodeDecodeError as error:
        if encoding == "utf8" and error.start > len(start) - 4:
            text = start[: error.start].decode("utf-8-sig")
        else:
            text, encoding = start.decode("latin-1"), "latin-1"
    return text.splitlines()[:HEAD_LINES], encoding


def _says_something(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith(COMMENTS)


def _first_row(lines: list[str], first: int) -> int | None:
    """The first line whose cells are numbers."""
    for k in range(first, len(lines)):
        if _says_something(lines[k]) and _share_of_numbers(lines[k]) > 0.5:
            return k
    return None


def _share_of_numbers(line: str) -> float:
    cells = [c for c in re.split(r"[;\t|]|,(?=\s|[^\d])|(?<=\D),|\s+|,", line.strip()) if c.strip()]
    return sum(_is_number(c) for c in cells) / len(cells) if cells else 0.0


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"').replace(",", "."))
    except ValueError:
        return False
    return True


def _separators(path: Path, rows: list[str]) -> tuple[str, str]:
    """Delimiter and decimal mark; a comma is the decimal mark where something else separates."""
    rows = [row for row in rows if _says_something(row)]
    for delimiter in DELIMITERS:
        counts = {row.count(delimiter) for row in rows}
        if counts != {0} and len(counts) <= 2:
            cells = [cell for row in rows for cell in row.split(delimiter)]
            decimal = "," if delimiter != "," and any("," in cell for cell in cells) else "."
            return delimiter, decimal
    if all(_is_number(row) for row in rows):
        return ",", "," if any("," in row for row in rows) else "."
    raise InputError(
        f"{path}: its columns are separated by neither {', '.join(repr(d) for d in DELIMITERS)}; "
        "export the table with one of them"
    )


def _floats(column: pa.Array) -> NDArray[np.float64]:
    return np.asarray(column.to_numpy(zero_copy_only=False), dtype=np.float64)
