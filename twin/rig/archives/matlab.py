"""MATLAB files: v5 (SciPy) and v7.3, which is HDF5 (h5py); plain HDF5 files are read likewise."""

import math
import struct
import zlib
from pathlib import Path

import h5py
import numpy as np
import scipy.io
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import WHOLE_BYTES, Archive, damaged, guard_memory, refuse_absurd
from twin.rig.archives.hdf_walk import datasets, elsewhere, survives

UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError,
              MemoryError, RuntimeError, NotImplementedError, struct.error, zlib.error,
              scipy.io.matlab.MatReadError)  # fmt: skip
NUMERIC = ("double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")


class Mat5Archive(Archive):
    """The numeric variables of a MATLAB file up to v7; each is read whole.

    Raises
    ------
    InputError
        If the file is damaged or holds no variables of numbers.
    """

    format = "MATLAB v5"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            listed = scipy.io.whosmat(path)
        except UNREADABLE as error:
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        self._shapes = {name: tuple(shape) for name, shape, kind in listed if kind in NUMERIC}
        self.names = tuple(self._shapes)
        if not self.names:
            others = ", ".join(f"{name} ({kind})" for name, _, kind in listed) or "nothing"
            raise InputError(
                f"{path}: holds no variables of numbers, only {others}; save the samples as plain arrays"
            )
        self._loaded: tuple[str, NDArray[np.generic]] | None = None

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of a variable; a row or column vector counts as one series."""
        shape = self._shapes[name]
        return (max(shape),) if len(shape) == 2 and 1 in shape else shape

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of one variable."""
        return self._load(name)[first:stop]

    def _load(self, name: str) -> NDArray[np.generic]:
        if self._loaded is not None and self._loaded[0] == name:
            return self._loaded[1]
        claimed = 8 * math.prod(self._shapes[name])
        refuse_absurd(self.path, name, claimed)
        guard_memory(
            self.path, f"variable '{name}'", 3 * claimed, "save it with -v7.3, which is read in parts"
        )
        self._loaded = None
        try:
            value = scipy.io.loadmat(self.path, variable_names=[name])[name]
        except UNREADABLE as error:
            raise damaged(self.path, name, error) from error
        array = np.asarray(value)
        if array.ndim == 2 and 1 in array.shape:
            array = array.reshape(-1)
        self._loaded = (name, array)
        return array


class HdfArchive(Archive):
    """The numeric datasets of an HDF5 file, MATLAB v7.3 among them, whose arrays lie transposed in it.

    Raises
    ------
    InputError
        If the file is damaged or holds no datasets of numbers.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        if why := survives(path):
            raise InputError(f"{path}: is cut short or damaged ({why}); copy or export it again")
        try:
            self._file = h5py.File(path, "r")
            found = [(name, d) for name, d in datasets(self._file) if _is_numeric(d)]
            self._sets = dict(found)
            self._matlab = any("MATLAB_class" in d.attrs for _, d in found)
            units = {name: d.attrs.get("unit", d.attrs.get("units")) for name, d in found}
            for name, dataset in found:
                self._refuse_to_be_led_astray(name, dataset)
        except InputError:
            self._file.close()
            raise
        except UNREADABLE as error:
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        self.format = "MATLAB v7.3" if self._matlab else "HDF5"
        self.names = tuple(self._sets)
        if not self.names:
            raise InputError(f"{path}: holds no datasets of numbers; save the samples as plain arrays")
        self.units = {
            n: u.decode(errors="replace") if isinstance(u, bytes) else str(u)
            for n, u in units.items()
            if u is not None
        }

    def _refuse_to_be_led_astray(self, name: str, dataset: h5py.Dataset) -> None:
        """Complain of samples in other files, and of pieces that would fill the memory."""
        if elsewhere(dataset):
            raise InputError(
                f"{self.path}: dataset '{name}' lies in other files, which are not followed; save it into one file"
            )
        refuse_absurd(self.path, name, dataset.size * dataset.dtype.itemsize)
        piece = math.prod(dataset.chunks or (0,)) * dataset.dtype.itemsize
        if piece > WHOLE_BYTES:
            guard_memory(
                self.path,
                f"a chunk of dataset '{name}'",
                2 * piece,
                f"save it in chunks of up to {WHOLE_BYTES // 1_000_000} MB",
            )

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape as MATLAB or the file's maker has it; a row or column vector counts as one series."""
        shape = tuple(self._sets[name].shape)
        if len(shape) == 2 and 1 in shape:
            return (max(shape),)
        return shape[::-1] if self._matlab else shape

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of one dataset."""
        dataset = self._sets[name]
        shape = tuple(dataset.shape)
        try:
            if len(shape) == 2 and 1 in shape:
                rows = dataset[0, first:stop] if shape[0] == 1 else dataset[first:stop, 0]
                return np.asarray(rows)
            if self._matlab:
                return np.asarray(dataset[..., first:stop]).T
            return np.asarray(dataset[first:stop] if shape else dataset[()])
        except UNREADABLE as error:
            raise damaged(self.path, name, error) from error

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _is_numeric(dataset: h5py.Dataset) -> bool:
    kind = dataset.attrs.get("MATLAB_class", b"double")
    return (kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)) in NUMERIC
