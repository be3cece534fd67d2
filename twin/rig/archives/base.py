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

WHOLE_SHARE = 0.4
"""An array that can only be read whole may take this share of the memory that is free."""


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


def guard_memory(path: Path, name: str, n_bytes: int, remedy: str) -> None:
    """Refuse to read an array whole that would not leave the machine room to breathe.

    Raises
    ------
    InputError
        With the remedy.
    """
    free = int(psutil.virtual_memory().available)
    if n_bytes > WHOLE_SHARE * free:
        raise InputError(
            f"{path}: array '{name}' has {n_bytes / 1e9:.1f} GB and this format can only be read whole, with "
            f"{free / 1e9:.1f} GB of memory free; {remedy}"
        )


def damaged(path: Path, name: str, error: BaseException) -> InputError:
    """Say that one array of a file cannot be read."""
    why = str(error) or type(error).__name__
    return InputError(f"{path}: array '{name}' is damaged ({why}); copy or export the recording again")
