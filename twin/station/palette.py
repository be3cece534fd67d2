"""Colours that mean the same thing in every view and in the drawn summary."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

MEASURED = 0xF2B84BFF
TWIN = 0x4FC3F7FF
PASSIVE = 0x90A4AEFF
LIMIT = 0xEF5350FF
LEARNED = 0x81C784FF
IN_USE = 0xECEFF1FF
GOOD, WAITING, POOR, OFF = 0x388E3CFF, 0x1976D2FF, 0xC62828FF, 0x455A64FF
WARNING = 0xF57C00FF

PRIMARY, BODY = 0x546E7AFF, 0x3F6B8AFF
SPRING, MAGNET, COPPER, FORCE = 0xB0BEC5FF, 0x90A4AEFF, 0xFF8A65FF, 0xE57399FF

SERIES = (MEASURED, TWIN, 0xBA68C8FF, LEARNED, 0xFF8A65FF, 0xE57399FF, 0x9FA8DAFF, 0xDCE775FF)


def hex_of(colour: int) -> str:
    """``#rrggbb`` of a colour with alpha."""
    return f"#{colour >> 8:06x}"


def array(colours: Iterable[int]) -> NDArray[np.uint32]:
    """Colours as Rerun takes them; a list of three or four integers it would read as one colour."""
    return np.array(list(colours), dtype=np.uint32)
