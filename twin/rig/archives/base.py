"""What every format of measured data is read as: named arrays, each of which can be read in parts."""

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import psutil
from numpy.typing import NDArray

from twin.plant.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

WHOLE_SHARE = 0.4
"""What can only be read whole may take this share of the memory that is free."""

WHOLE_BYTES = 64_000_000
"""Up to this size an array is read at once also where it could be read in parts."""

MOST_PACKED = 5000
"""So many times its size in the file is the most a measured array may be; deflate reaches 1032 with zeros."""


class Archive(ABC):
    """The arrays of one file.

    Attributes
    ----------
    path
        The file.
    format
        What it is, in words: ``NumPy .npz``.
    names
        Its arrays, in the file's order.
    units
        Array name to unit, as the file itself states it.
    rates_hz
        Array name to its sample rate [Hz], as the file itself states it.
    starts_s
        Array name to the instant of its first sample [s], as the file itself states it, from any common zero.
    shares
        Arrays of integers that are read as shares of a converter's full scale, -1 to 1: the file does not say how much
        of what that is.
    """

    format = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names: tuple[str, ...] = ()
        self.units: Mapping[str, str] = MappingProxyType({})
        self.rates_hz: Mapping[str, float] = MappingProxyType({})
        self.starts_s: Mapping[str, float] = MappingProxyType({})
        self.shares: frozenset[str] = frozenset()

    @abstractmethod
    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an array; time runs along its first dimension where it can be read in parts."""

    @abstractmethod
    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows ``first`` to ``stop`` of an array, the whole of it unless told otherwise.

        Raises
        ------
        InputError
            If that part of the file is damaged or holds no numbers.
        """

    def chunks(self, names: Sequence[str], rows: int) -> Iterator[dict[str, NDArray[np.generic]]]:
        """Go through several arrays of one length together, so many rows at a time."""
        length = min(self.shape(name)[0] for name in names)
        for first in range(0, length, rows):
            yield {name: self.read(name, first, min(first + rows, length)) for name in names}

    def close(self) -> None:  # noqa: B027 - most formats hold nothing open
        """Let go of the file."""

    def __del__(self) -> None:
        """Nobody reads it any more."""
        with contextlib.suppress(Exception):  # it may not have come so far as to open anything
            self.close()


def free_memory() -> int:
    """Bytes that may still be taken: of the machine, of the control group we are in, of the limit we were given."""
    free = int(psutil.virtual_memory().available)
    for folder, of, now, cached in (
        ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with contextlib.suppress(OSError, ValueError):  # none there, or "max"
            most, taken = (int(Path(folder, name).read_text(encoding="ascii")) for name in (of, now))
            lines = Path(folder, "memory.stat").read_text(encoding="ascii").splitlines()
            given_back = sum(int(line.split()[1]) for line in lines if line.startswith(f"{cached} "))
            free = min(free, most - taken + given_back)
    if resource is not None:
        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            free = min(free, most - int(psutil.Process().memory_info().vms))
    return max(0, free)


def guard_memory(path: Path, name: str, n_bytes: int, remedy: str) -> None:
    """Refuse to read an array whole that would not leave the machine room to breathe.

    Parameters
    ----------
    n_bytes
        What reading it takes at its most.

    Raises
    ------
    InputError
        With the remedy.
    """
    free = free_memory()
    if n_bytes > WHOLE_SHARE * free:
        raise InputError(
            f"{path}: {name} can only be had whole in this format, which takes {n_bytes / 1e9:.3g} GB, with "
            f"{free / 1e9:.3g} GB of memory free; {remedy}"
        )


def refuse_absurd(path: Path, name: str, n_bytes: float) -> None:
    """Refuse an array that claims to be larger than anything that was measured can be in a file of this size.

    Raises
    ------
    InputError
        If no packing known makes so much of so little.
    """
    size = path.stat().st_size
    if n_bytes > MOST_PACKED * size + WHOLE_BYTES:
        raise InputError(
            f"{path}: array '{name}' claims {n_bytes / 1e9:.3g} GB in a file of {size / 1e6:.3g} MB: damaged, or "
            "made to do harm; export it again"
        )


def damaged(path: Path, name: str, error: BaseException) -> InputError:
    """Say that one array of a file cannot be read."""
    why = str(error) or type(error).__name__
    return InputError(f"{path}: array '{name}' is damaged ({why}); copy or export the recording again")
