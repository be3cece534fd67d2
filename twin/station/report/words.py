"""Numbers as engineers read them, the same in page and terminal."""

import math
from typing import Any

PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))
SCALED = ("m", "V", "A", "W", "N", "m/s²", "s")
"""Units that take a prefix where a number is small."""


def quantity(value: float | None, unit: str = "", std: float | None = None, digits: int = 4) -> str:
    """A value with its unit, and with ± where its standard deviation is known; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    scale, prefix = prefix_for(value, unit)
    scaled, known = value / scale, std is not None and math.isfinite(std) and std > 0.0
    if known and std is not None and std < abs(value):
        decimals = max(0, 1 - math.floor(math.log10(std / scale)))
        body = f"{scaled:.{decimals}f} ± {std / scale:.{decimals}f}"
    elif known and std is not None:
        body = f"{scaled:.2g} ± {std / scale:.2g}"
    else:
        body = f"{scaled:.0f}" if 10.0**digits <= abs(scaled) < 1e7 else f"{scaled:.{digits}g}"
    shown = f"{prefix}{unit}" if unit not in ("", "1") else ""
    return f"{body} {shown}".rstrip()


def prefix_for(value: float, unit: str) -> tuple[float, str]:
    """What a value is divided by to be read in a unit with which prefix."""
    if unit not in SCALED or value == 0.0 or not math.isfinite(value):
        return 1.0, ""
    return next(((s, p) for s, p in PREFIXES if abs(value) >= 0.999 * s), PREFIXES[-1])


def share(value: float | None, std: float | None = None) -> str:
    """A share in percent, to as many digits as its standard deviation leaves; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if std is None or not math.isfinite(std) or std <= 0.0:
        return f"{100.0 * value:.1f} %"
    digits = min(4, max(1, -math.floor(math.log10(100.0 * std))))
    return f"{100.0 * value:.{digits}f} ± {100.0 * std:.{digits}f} %"


def seconds(value: float | None) -> str:
    """A moment of a recording."""
    return "–" if value is None else f"{value:.2f} s"


def size(n_bytes: int) -> str:
    """The size of a file."""
    for scale, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if n_bytes >= scale:
            return f"{n_bytes / scale:.1f} {unit}"
    return f"{n_bytes} bytes"


def span(low: float, high: float, unit: str) -> str:
    """From one value to another; one value if they are the same."""
    first, last = f"{low:.5g}", f"{high:.5g}"
    return f"{first} {unit}" if first == last else f"{first} to {last} {unit}"


def some(values: list[Any], most: int = 6) -> str:
    """A list in few words."""
    words = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values[:most])
    return words + (f" and {len(values) - most} more" if len(values) > most else "")
