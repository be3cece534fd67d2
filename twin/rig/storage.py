"""How much of the disk a recording may take, when it goes on in another file, and what its files are called."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from twin.plant.errors import InputError

KEEP_FREE_BYTES = 100_000_000
"""Recording ends, whole, while the disk has this much left: a full disk stops more than a recording."""

_UNITS = {
    "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "tb": 10**12,
    "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0,
}  # fmt: skip
_PART = re.compile(r"(?P<stem>.+)\.part(?P<number>\d+)")


@dataclass(frozen=True, slots=True)
class Storage:
    """What the person allows.

    Attributes
    ----------
    rotate_bytes, rotate_s
        A file that has grown so large, or holds so many seconds of data, is followed by another; None for never.
    budget_bytes
        All files of the run together; None for as much as there is.
    drop_oldest
        Make room by removing the run's oldest files; else recording stops when there is none.
    keep_free_bytes
        What must stay free on the disk.

    Raises
    ------
    InputError
        If old files are to go and there is only ever one, or a figure is not above zero.
    """

    rotate_bytes: int | None = None
    rotate_s: float | None = None
    budget_bytes: int | None = None
    drop_oldest: bool = False
    keep_free_bytes: int = KEEP_FREE_BYTES

    def __post_init__(self) -> None:
        for value in (self.rotate_bytes, self.rotate_s, self.budget_bytes):
            if value is not None and not value > 0:
                raise InputError(f"a size or time of {value:g} cannot be kept; give one above zero")
        rotates = self.rotate_bytes is not None or self.rotate_s is not None
        if self.drop_oldest and not rotates:
            raise InputError(
                "old files can only be dropped if there are several: say when to start a new one"
            )
        if self.rotate_bytes and self.budget_bytes and self.budget_bytes < 2 * self.rotate_bytes:
            raise InputError(
                f"a budget of {as_size(self.budget_bytes)} does not hold two files of "
                f"{as_size(self.rotate_bytes)}; start new ones sooner or allow more"
            )


def storage(rotate: str | None, budget: str | None, *, drop_oldest: bool = False) -> Storage:
    """Read what a person wrote.

    Parameters
    ----------
    rotate
        A size such as ``500MB``, a time such as ``10min``, or both with a comma between them.
    budget
        A size.

    Raises
    ------
    InputError
        If it is neither size nor time, or cannot be kept.
    """
    size: int | None = None
    seconds: float | None = None
    for text in (rotate or "").split(","):
        if not text.strip():
            continue
        value, unit = _quantity(text, "--rotate", "a size such as 500MB or a time such as 10min")
        if unit in ("s", "min", "h", "d"):
            seconds = value
        else:
            size = round(value)
    total = None
    if budget is not None:
        value, unit = _quantity(budget, "--disk-budget", "a size such as 20GB")
        if unit in ("s", "min", "h", "d"):
            raise InputError(f"--disk-budget {budget}: is a time; write a size such as 20GB")
        total = round(value)
    return Storage(size, seconds, total, drop_oldest)


def part_path(path: Path, number: int) -> Path:
    """Name of the run's n-th file: ``NAME.rrd``, ``NAME.part2.rrd``, ..."""
    return path if number == 1 else path.with_name(f"{path.stem}.part{number}{path.suffix}")


def part_of(path: Path) -> tuple[Path, int]:
    """First file's name and the number of a file of a run."""
    match = _PART.fullmatch(path.stem)
    if match is None:
        return path, 1
    return path.with_name(match["stem"] + path.suffix), int(match["number"])


def parts_beside(path: Path) -> dict[int, Path]:
    """Files there are of the run that a file belongs to by its name, by number."""
    first, _ = part_of(path)
    found = (p for p in first.parent.glob(f"*{first.suffix}") if part_of(p)[0] == first)
    return {part_of(p)[1]: p for p in sorted(found)}


def free_bytes(folder: Path) -> int:
    """What the disk under a folder has left for us."""
    return shutil.disk_usage(folder).free


def as_size(n_bytes: float) -> str:
    """A size for people: decimal units, three digits."""
    for unit, name in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if n_bytes >= unit:
            return f"{n_bytes / unit:.3g} {name}"
    return f"{n_bytes:.0f} B"


def _quantity(text: str, option: str, wanted: str) -> tuple[float, str]:
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-zA-Z]+)\s*", text)
    unit = match[2].lower() if match else ""
    if match is None or unit not in _UNITS:
        raise InputError(f"{option} {text}: write {wanted}")
    return float(match[1]) * _UNITS[unit], unit
