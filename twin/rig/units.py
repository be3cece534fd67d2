"""Units in which foreign recordings state their channels, and what makes them SI."""

import math

# unit: (SI unit, factor to it)
_TO_SI: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0), "mm": ("m", 1e-3), "um": ("m", 1e-6), "nm": ("m", 1e-9),
    "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3), "um/s": ("m/s", 1e-6),
    "m/s²": ("m/s²", 1.0), "mm/s²": ("m/s²", 1e-3), "g": ("m/s²", 9.80665), "mg": ("m/s²", 9.80665e-3),
    "V": ("V", 1.0), "mV": ("V", 1e-3), "uV": ("V", 1e-6), "kV": ("V", 1e3),
    "A": ("A", 1.0), "mA": ("A", 1e-3), "uA": ("A", 1e-6),
    "N": ("N", 1.0), "mN": ("N", 1e-3), "kN": ("N", 1e3),
    "s": ("s", 1.0), "ms": ("s", 1e-3), "us": ("s", 1e-6),
}  # fmt: skip


def to_si(unit: str) -> tuple[str, float] | None:
    """SI unit and the factor to it, such as ``("m", 0.001)`` for ``mm``; None for a unit not known here.

    Micro may be written µ, μ or u, a square ², ^2 or 2: ``µm``, ``m/s^2``, ``m/s2``.
    """
    plain = unit.strip().replace("µ", "u").replace("μ", "u")
    for square in ("s^2", "s**2", "s2"):
        if plain.endswith(square):
            plain = plain.removesuffix(square) + "s²"
    return _TO_SI.get(plain)


def units_for(si_unit: str) -> tuple[str, ...]:
    """Every known unit of the same dimension as an SI unit, the SI unit itself first."""
    known = [unit for unit, (base, _) in _TO_SI.items() if base == si_unit]
    return tuple(sorted(known, key=lambda unit: (unit != si_unit, math.log(_TO_SI[unit][1]))))
