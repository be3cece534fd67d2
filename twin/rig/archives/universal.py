"""Universal files (UFF): the time responses of dataset 58, ASCII or binary (pyuff)."""

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pyuff
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive, guard_memory

TIME_RESPONSE = 1


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
        guard_memory(path, "all datasets", 2 * path.stat().st_size, "export it in parts, or as TDMS")
        try:
            with redirect_stdout(io.StringIO()):  # it talks
                read = pyuff.UFF(str(path)).read_sets()
        except Exception as error:  # it raises bare exceptions
            raise InputError(f"{path}: is cut short or damaged ({error}); copy or export it again") from error
        sets: list[dict[str, Any]] = read if isinstance(read, list) else [read]
        found = [s for s in sets if s and s.get("type") == 58 and s.get("func_type") == TIME_RESPONSE]
        if not found:
            raise InputError(f"{path}: holds no time responses (dataset 58, function type 1)")
        self._data: dict[str, NDArray[np.generic]] = {}
        self.units, self.rates_hz = {}, {}
        for s in found:
            name = _name(s, set(self._data))
            self._data[name] = np.asarray(s["data"])
            unit = str(s.get("ordinate_axis_units_lab", "")).strip()
            if unit and unit.upper() != "NONE":
                self.units[name] = unit
            step_s = float(s.get("abscissa_inc") or 0.0)
            if s.get("abscissa_spacing", 1) == 1 and step_s > 0.0:
                self.rates_hz[name] = float(f"{1.0 / step_s:.7g}")
        self.names = tuple(self._data)

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of samples."""
        return self._data[name].shape

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Samples of one response."""
        return self._data[name][first:stop]


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
