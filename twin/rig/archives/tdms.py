"""LabVIEW's TDMS, read in parts (npTDMS)."""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from nptdms import TdmsChannel, TdmsFile
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, damaged

UNREADABLE = (OSError, EOFError, ValueError, KeyError, TypeError, IndexError, AttributeError, ArithmeticError,
              MemoryError, RuntimeError, struct.error, AssertionError)  # fmt: skip
UNIT_KEYS = ("unit_string", "NI_UnitDescription", "Unit", "unit")


class TdmsArchive(Archive):
    """The numeric channels of one TDMS file: by their own name where that is unique, else as ``group/channel``.

    Raises
    ------
    InputError
        If the file is damaged or holds no channels of numbers.
    """

    format = "LabVIEW TDMS"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._file = path.open("rb")  # ours, so that it is closed whatever the reader makes of it
        try:
            channels = [c for group in TdmsFile.open(self._file).groups() for c in group.channels()]
            found = [
                c for c in channels if c.dtype is not None and np.dtype(c.dtype).kind in "fiu" and len(c)
            ]
        except UNREADABLE as error:
            self._file.close()
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        once = [c.name for c in found]
        self._channels: dict[str, TdmsChannel] = {
            c.name if once.count(c.name) == 1 else f"{c.group_name}/{c.name}": c for c in found
        }
        self.names = tuple(self._channels)
        if not self.names:
            raise InputError(f"{path}: holds no channels of numbers")
        self.units, self.rates_hz = {}, {}
        for name, channel in self._channels.items():
            unit = next((str(channel.properties[k]) for k in UNIT_KEYS if channel.properties.get(k)), "")
            step_s = channel.properties.get("wf_increment")
            if unit:
                self.units[name] = unit
            if isinstance(step_s, float | int) and step_s > 0.0:
                self.rates_hz[name] = float(f"{1.0 / step_s:.12g}")
        self.starts_s = _starts(self._channels)

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of samples."""
        return (len(self._channels[name]),)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Samples of one channel, scaled as the file says."""
        stop = len(self._channels[name]) if stop is None else stop
        try:
            return np.asarray(self._channels[name].read_data(offset=first, length=max(0, stop - first)))
        except UNREADABLE as error:
            raise damaged(self.path, name, error) from error

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def _starts(channels: Mapping[str, TdmsChannel]) -> dict[str, float]:
    """First instants [s] from the earliest on, of the channels that state any."""
    zero = np.datetime64("1904-01-01T00:00:00")
    found = {}
    for name, channel in channels.items():
        at, offset = channel.properties.get("wf_start_time"), channel.properties.get("wf_start_offset", 0.0)
        if isinstance(at, np.datetime64) and not np.isnat(at) and isinstance(offset, int | float):
            found[name] = (int((at - zero) / np.timedelta64(1, "us")), float(offset))
    begin = min((us for us, _ in found.values()), default=0)
    return {name: (us - begin) * 1e-6 + offset for name, (us, offset) in found.items()}
