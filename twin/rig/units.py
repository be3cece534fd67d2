"""Units in which recordings state their channels, and what makes them SI (by pint).

``g`` is what accelerometers are calibrated in, standard gravity, unless a mass is expected: then it is the gram. Units
with an offset (degC) and logarithmic ones (dB) have no factor to SI and are refused. Before pint sees a text it must
look like a unit: powers of powers in the name of a channel are nobody's unit.
"""

import re
from functools import cache, lru_cache
from typing import Any

_SI = {
    "meter": "m", "meter / second": "m/s", "meter / second ** 2": "m/s²",
    "kilogram * meter ** 2 / ampere / second ** 3": "V", "ampere": "A", "kilogram * meter / second ** 2": "N",
    "second": "s", "1 / second": "Hz", "radian / second": "rad/s", "radian": "rad", "kilogram": "kg",
}  # fmt: skip
"""What pint calls a quantity in base units, and what it is called here."""

COMMON = {
    "m": ("m", "nm", "um", "mm", "cm"),
    "m/s": ("m/s", "um/s", "mm/s", "cm/s"),
    "m/s²": ("m/s²", "mm/s²", "mg", "g", "gn", "g_n"),
    "V": ("V", "uV", "mV", "kV"),
    "A": ("A", "uA", "mA"),
    "N": ("N", "mN", "lbf", "kN"),
    "s": ("s", "us", "ms"),
    "Hz": ("Hz", "kHz"),
    "rad/s": ("rad/s",),
    "rad": ("rad", "deg"),
    "kg": ("kg", "gram"),
}
"""Spellings that are taken for a unit also in the middle of a text; SI first."""

_ALL_COMMON = frozenset(spelling for spellings in COMMON.values() for spelling in spellings)
_NAME = r"(?:[A-Za-zµμΩ%_]+|°)(?:[²³]|(?:\*\*|\^)?-?[1-9])?"
_FORM = re.compile(rf"(?:1\s*/\s*)?\(?{_NAME}\)?(?:\s*(?:[*/·]|\s)\s*\(?{_NAME}\)?){{0,6}}")
_NUMBER = re.compile(r"\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*\*?\s*(?=[A-Za-zµμΩ°%])")
_GRAVITY = re.compile(r"(?<![A-Za-z_µμ])(?P<prefix>[muµμ]?)g(?:n|0|_0)?(?![A-Za-z0-9_])")
_LONGEST = 60


@lru_cache(maxsize=512)
def to_si(unit: str, expected: str = "") -> tuple[str, float] | None:
    """SI unit and the factor to it, such as ``("m", 0.001)`` for ``mm``; None where there is none.

    Parameters
    ----------
    unit
        As a person writes it: ``µm``, ``m/s^2``, ``m/s2``, ``mm/s/s``, ``inch``, ``lbf``, ``g``; also so many of them:
        ``50 g``.
    expected
        SI unit that is wanted. ``g`` is gram where that is kg; turns per time become Hz where that is Hz.
    """
    plain = unit.strip()
    if plain in COMMON:
        return plain, 1.0
    known = _base(_in_gravities(plain)) if expected != "kg" else None
    if known is None or (expected and known[0] != expected):
        known = _base(plain) or known
    if known is not None and known[0] == "rad/s" and expected == "Hz":
        turn = _base("turn")
        return None if turn is None else ("Hz", known[1] / turn[1])
    return known


def sensitivity_to_si(unit: str, sensitivity: str, expected: str) -> float | None:
    """Factor that makes ``expected`` of samples in ``unit``, taken by a sensor of a sensitivity such as ``100 mV/g``.

    None where the two do not give that unit.
    """
    output, _, per = sensitivity.partition("/")
    one, raised, each = to_si(unit), to_si(output), to_si(per.strip().strip("()"), expected)
    if one is None or each is None or raised is None or each[0] != expected or one[0] != raised[0]:
        return None
    return one[1] * each[1] / raised[1]


def why_not(unit: str, si_unit: str) -> str:
    """What keeps a unit from being made into an SI unit, in words that follow it."""
    known = to_si(unit, si_unit)
    if known is not None:
        return f"is {known[0]}, the channel is {si_unit}"
    try:
        _registry().parse_units(unit.strip() if _FORM.fullmatch(unit.strip()) else "no unit")
    except Exception:
        return "is not known"
    return "is logarithmic or has an offset: there is no factor to SI"


def is_common(unit: str) -> bool:
    """Whether a word is so usual a unit that it is taken for one wherever it stands."""
    plain = unit.strip().replace("µ", "u").replace("μ", "u")
    return re.sub(r"s(?:\^|\*\*)?2$", "s²", plain) in _ALL_COMMON


def units_for(si_unit: str) -> tuple[str, ...]:
    """Usual units of the same dimension as an SI unit, the SI unit itself first."""
    return COMMON.get(si_unit, (si_unit,))


def _in_gravities(text: str) -> str:
    return _GRAVITY.sub(r"\g<prefix>g_n", text)


@lru_cache(maxsize=512)
def _base(text: str) -> tuple[str, float] | None:
    """Unit in base units and factor, by pint; None unless it is one and has a factor."""
    number = _NUMBER.match(text)
    times, rest = (float(number["number"]), text[number.end() :]) if number else (1.0, text)
    if len(rest) > _LONGEST or _FORM.fullmatch(rest) is None:
        return None
    rest = re.sub(r"(?i)\b(k?)hz\b", lambda m: f"{m[1].lower()}Hz", rest).replace("·", "*").replace("^", "**")
    rest = re.sub(r"(?<=[A-Za-zµμ])(-?[1-9])(?!\d)", r"**\1", rest)
    registry = _registry()
    try:
        parsed = registry.parse_units(rest)
        nothing, one, two = (registry.Quantity(n, parsed).to_base_units() for n in (0.0, 1.0, 2.0))
    except Exception:  # it raises whatever its parser stumbles over
        return None
    factor = times * float(one.magnitude)
    linear = nothing.magnitude == 0.0 and two.magnitude == 2.0 * one.magnitude
    if not linear or not 0.0 < abs(factor) < float("inf"):
        return None
    base = str(one.units)
    return _SI.get(base, base), factor


@cache
def _registry() -> Any:
    """Everybody's registry; made when a unit is asked for, for that takes half a second."""
    import pint  # noqa: PLC0415

    return pint.UnitRegistry()
