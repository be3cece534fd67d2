"""Universal files (UFF): the time responses of dataset 58, binary ones read in parts, headers and text by pyuff."""

import io
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyuff
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, damaged, guard_memory

TIME_RESPONSE, EVEN, IEEE = 1, 1, 2
KINDS = {2: "f4", 4: "f8"}
"""Real ordinates by their data type; responses in time are never complex."""

HEAD_LINES = 11
LONGEST_LINE = 4096
TEXT_IN_MEMORY = 20
"""Reading numbers written as text takes so many times their size in the file."""


@dataclass(frozen=True, slots=True)
class _Response:
    """One dataset: what its header says, and where its samples lie."""

    head: dict[str, Any]
    start: int
    at_byte: int
    end: int
    kind: str | None  # None: written as text

    @property
    def n_samples(self) -> int:
        return int(self.head["num_pts"])


class UniversalArchive(Archive):
    """The evenly sampled time responses of a universal file.

    Each is named by the first line of its description, or ``node_direction`` where that is empty.

    Raises
    ------
    InputError
        If the file is damaged or holds no time responses.
    """

    format = "universal file (58)"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            with path.open("rb") as file:
                found = list(_responses(file))
        except Exception as error:  # pyuff raises bare exceptions
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        uneven = [r for r in found if r.head.get("abscissa_spacing") != EVEN]
        found = [r for r in found if r.head.get("abscissa_spacing") == EVEN]
        if not found:
            why = (
                "only unevenly sampled ones; resample them"
                if uneven
                else "expected dataset 58, function type 1"
            )
            raise InputError(f"{path}: holds no evenly sampled time responses ({why})")
        self._responses: dict[str, _Response] = {}
        self._texts: dict[str, NDArray[np.generic]] = {}
        self.units, self.rates_hz, self.starts_s = {}, {}, {}
        for response in found:
            head = response.head
            name = _name(head, set(self._responses))
            self._responses[name] = response
            unit = str(head.get("ordinate_axis_units_lab", "")).strip()
            if unit and unit.upper() != "NONE":
                self.units[name] = unit
            step_s = float(head.get("abscissa_inc") or 0.0)
            if 0.0 < step_s < np.inf:
                self.rates_hz[name] = float(
                    f"{1.0 / step_s:.7g}"
                )  # five decimals are all that is written of it
                self.starts_s[name] = float(head.get("abscissa_min") or 0.0)
        self.names = tuple(self._responses)

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of samples."""
        return (self._responses[name].n_samples,)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Samples of one response."""
        response = self._responses[name]
        n = response.n_samples
        first, stop = min(first, n), n if stop is None else min(stop, n)
        if response.kind is None:
            return self._text(name)[first:stop]
        dtype = np.dtype(response.kind)
        try:
            with self.path.open("rb") as file:
                file.seek(response.at_byte + first * dtype.itemsize)
                content = file.read((stop - first) * dtype.itemsize)
            return np.frombuffer(content, dtype)
        except (OSError, ValueError) as error:
            raise damaged(self.path, name, error) from error

    def _text(self, name: str) -> NDArray[np.generic]:
        if name in self._texts:
            return self._texts[name]
        response = self._responses[name]
        size = response.end - response.start
        guard_memory(
            self.path,
            f"response '{name}', written as text,",
            TEXT_IN_MEMORY * size,
            "save it as binary (58b)",
        )
        try:
            with self.path.open("rb") as file:
                file.seek(response.start)
                values = np.asarray(_pyuff(file.read(size), header_only=False)["data"])
            if values.shape != (response.n_samples,):
                raise ValueError(f"it has {values.size} of its {response.n_samples} samples")
        except Exception as error:
            raise damaged(self.path, name, error) from error
        self._texts[name] = values
        return values


def _responses(file: IO[bytes]) -> Iterator[_Response]:
    """Time responses with where they lie; whatever else is in the file is passed over."""
    while True:
        start = file.tell()
        line = file.readline(LONGEST_LINE)
        if not line:
            return
        if line.strip() != b"-1":
            continue
        kind = file.readline(LONGEST_LINE)
        if kind[:6].strip() != b"58":
            _to_end(file)
            continue
        binary = kind[6:7].lower() == b"b"
        lines = [line, kind, *(file.readline(LONGEST_LINE) for _ in range(HEAD_LINES))]
        head = _pyuff(b"".join(lines), header_only=True)
        at = file.tell()
        if binary:
            file.seek(at + max(0, int(head["n_bytes"])))
        end = _to_end(file)
        if head.get("func_type") == TIME_RESPONSE:
            yield _Response(head, start, at, end, _layout(head) if binary else None)


def _to_end(file: IO[bytes]) -> int:
    """Go on behind the line that ends a dataset; where that line began."""
    while True:
        at = file.tell()
        line = file.readline(LONGEST_LINE)
        if not line:
            raise ValueError("a dataset has no end")
        if line.strip() == b"-1":
            return at


def _layout(head: dict[str, Any]) -> str:
    kind = KINDS.get(int(head["ord_data_type"]))
    if kind is None:
        raise ValueError("a time response of complex numbers")
    if head.get("fp_format") != IEEE:
        raise ValueError("its numbers are not IEEE floats")
    n = int(head["num_pts"])
    width = int(kind[1]) if head.get("abscissa_spacing") == EVEN else 0
    if n < 0 or (width and n * width != int(head["n_bytes"])):
        raise ValueError(f"{n} samples do not take {head['n_bytes']} bytes")
    return ("<" if head.get("byte_ordering") == 1 else ">") + kind


def _pyuff(content: bytes, *, header_only: bool) -> dict[str, Any]:
    """One dataset, without the line that ends it, through pyuff, which reads files only."""
    with tempfile.TemporaryDirectory(prefix="atmd-") as folder:
        path = Path(folder, "one.uff")
        path.write_bytes(content.rstrip() + b"\n    -1\n")
        with redirect_stdout(io.StringIO()), warnings.catch_warnings(action="ignore"):  # it talks
            found = pyuff.UFF(str(path)).read_sets(0, header_only=header_only)
    if not isinstance(found, dict) or "num_pts" not in found:
        raise ValueError("a dataset 58 with a header of another form")
    return found


def _name(dataset: dict[str, Any], taken: set[str]) -> str:
    stated = str(dataset.get("id1", "")).strip()
    place = f"{dataset.get('rsp_node', 0)}_{dataset.get('rsp_dir', 0)}"
    name = place if not stated or stated.upper() == "NONE" else stated
    for mark in "[]:":
        name = name.replace(mark, " ")
    return (
        name
        if name not in taken
        else next(f"{name}_{k}" for k in range(2, 10_000) if f"{name}_{k}" not in taken)
    )
