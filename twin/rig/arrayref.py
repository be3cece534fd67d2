"""Where a channel lies in a recording, as a person writes it: ``y``, ``y:mm``, ``data[3,1,:]:V``."""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError

_FORM = re.compile(r"^(?P<array>[^\[\]:]+)(?P<index>\[[^\[\]]*\])?\s*(?::(?P<unit>[^:]+))?$")
_PART = re.compile(r"^(:|[+-]?\d{1,9})$")


@dataclass(frozen=True, slots=True)
class ArrayRef:
    """A series in a recording: an array, which row or column of it, and its unit where one is stated.

    Attributes
    ----------
    array
        Name of the array.
    index
        One entry per dimension, a position or None for the dimension that runs in time; None where the
        array has one dimension only.
    unit
        Unit as written, or None.
    """

    array: str
    index: tuple[int | None, ...] | None = None
    unit: str | None = None

    def __str__(self) -> str:
        """Array and index as they are written, without the unit."""
        if self.index is None:
            return self.array
        return f"{self.array}[{','.join(':' if i is None else str(i) for i in self.index)}]"

    def take(self, array: NDArray[np.generic], where: str) -> NDArray[np.generic]:
        """Cut the one-dimensional series out of an array.

        Without an index, dimensions of length one are dropped: a column vector is a series.

        Raises
        ------
        InputError
            If the index does not fit the array, or there is none and the array has several columns.
        """
        shape = "x".join(map(str, array.shape)) or "single number"
        if self.index is None:
            series = array.reshape(-1) if array.size == max(array.shape, default=0) else array
            if series.ndim == 1 and array.ndim > 0:
                return series
            example = ",".join([":", *["0"] * (array.ndim - 1)])
            remedy = f"; say which series in it, such as {self.array}[{example}]" if array.ndim > 1 else ""
            raise InputError(f"{where}: array '{self.array}' is {shape}, not one series of samples{remedy}")
        if len(self.index) != array.ndim:
            raise InputError(
                f"{where}: {self} has {len(self.index)} indices, but array '{self.array}' is {shape}; "
                "give one per dimension"
            )
        for position, length in zip(self.index, array.shape, strict=True):
            if position is not None and not -length <= position < length:
                raise InputError(
                    f"{where}: {self} is outside array '{self.array}', which is {shape}; "
                    "positions count from 0"
                )
        series = array[tuple(slice(None) if i is None else i for i in self.index)]
        return np.asarray(series)


def parse_array_ref(text: str, where: str) -> ArrayRef:
    """Read ``array``, ``array:unit``, ``array[:,2]`` or ``array[3,1,:]:unit``.

    Parameters
    ----------
    text
        What the person wrote.
    where
        Where it was written, for messages.

    Raises
    ------
    InputError
        If it has another form, or its index does not leave exactly one dimension.
    """
    match = _FORM.match(text.strip())
    if match is None:
        raise InputError(f"{where}: cannot read {text!r}; write array, array:unit or array[:,2]:unit")
    unit = match["unit"].strip() if match["unit"] else None
    if match["index"] is None:
        return ArrayRef(match["array"].strip(), None, unit)
    parts = [part.strip() for part in match["index"][1:-1].split(",")]
    if not all(_PART.match(part) for part in parts) or parts.count(":") != 1:
        raise InputError(
            f"{where}: cannot read the index {match['index']}; give a position for each dimension and one "
            "':' for time, such as [:,2]"
        )
    return ArrayRef(match["array"].strip(), tuple(None if p == ":" else int(p) for p in parts), unit)
