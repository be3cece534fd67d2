"""WAV files: integers are shares of full scale, floats stand as they are."""

import struct
import warnings
from pathlib import Path

import numpy as np
import scipy.io.wavfile
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, guard_memory

UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, TypeError, ArithmeticError, MemoryError, RuntimeError, UnboundLocalError,
    struct.error,
)  # fmt: skip
FULL_SCALE = {"u1": 128.0, "i2": 2.0**15, "i4": 2.0**31}


class WaveArchive(Archive):
    """The channels of one WAV file as ``channel1``, ``channel2`` and so on.

    A file of integers holds shares of the converter's full scale, -1 to 1: its sidecar says with ``scale`` how much
    of the unit that is.

    Raises
    ------
    InputError
        If the file is damaged or of a coding other than PCM and float.
    """

    format = "WAV"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._rate, self._data = _open(path)
        except UNREADABLE as error:
            raise InputError(f"{path}: is cut short, damaged or no PCM or float WAV ({error})") from error
        if self._data.ndim == 1:
            self._data = self._data[:, None]
        self.names = tuple(f"channel{k + 1}" for k in range(self._data.shape[1]))
        self.rates_hz = dict.fromkeys(self.names, float(self._rate))

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of samples."""
        return (len(self._data),)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Samples of one channel."""
        samples = np.asarray(self._data[first:stop, self.names.index(name)])
        kind = f"{samples.dtype.kind}{samples.dtype.itemsize}"
        if kind == "u1":
            return samples.astype(np.float64) / 128.0 - 1.0
        return samples.astype(np.float64) / FULL_SCALE[kind] if kind in FULL_SCALE else samples


def _open(path: Path) -> tuple[int, NDArray[np.generic]]:
    with warnings.catch_warnings(action="ignore"):  # chunks it does not know are of no interest
        try:
            rate, data = scipy.io.wavfile.read(path, mmap=True)
        except ValueError as error:
            if "mmap" not in str(error):
                raise
            guard_memory(path, "samples", 2 * path.stat().st_size, "save it with 16 or 32 bits a sample")
            rate, data = scipy.io.wavfile.read(path)
    return int(rate), data
