"""What lies beside a foreign recording and says what is in it: rate, units, and which channel is which.

Two forms are read. ``FILE.toml`` is written for this program::

    sample_rate_hz = 100.0        # or: time = "t"
    [channels]
    tip = { array = "y", unit = "mm" }
    piezo = "u:V"                 # the short form; "none" for what was not recorded
    table = { array = "channel1", unit = "g", scale = 50.0 }              # a sample of 1 is 50 g
    shaker = { array = "ai0", unit = "mV", sensitivity = "22.5 mV/N" }    # volts of a sensor

``FILE.json`` is the form in which measured data sets are often published: ``fs_hz``, and under ``channels``
one text for each array that begins with its unit, ``{"y": "mm tip laser"}``.
"""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from twin.plant.config import Frozen, Positive
from twin.plant.errors import InputError
from twin.plant.files import read_toml
from twin.rig.arrayref import ArrayRef, parse_array_ref
from twin.rig.units import is_common

NOT_RECORDED = "none"
_Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


@dataclass(frozen=True, slots=True)
class Sidecar:
    """What is known about a recording from beside it.

    Attributes
    ----------
    sample_rate_hz
        Nominal sample rate, or None.
    time
        The array that holds the time stamps, or None.
    channels
        Plant channel to array; None for a channel that was not recorded.
    units
        Array name to unit, for arrays whose text begins with a known unit.
    rate_from
        File that stated the rate.
    channels_from
        File that stated the channels.
    units_from
        File that stated the units.
    notes
        What a person should know about how it was read.
    """

    sample_rate_hz: float | None = None
    time: ArrayRef | None = None
    channels: Mapping[str, ArrayRef | None] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    rate_from: str = ""
    channels_from: str = ""
    units_from: str = ""
    notes: tuple[str, ...] = ()


class _Place(Frozen):
    """Where a channel lies."""

    array: str = Field(min_length=1)
    unit: str | None = None
    scale: _Finite | None = None
    sensitivity: str | None = None


def _from_short_form(value: Any) -> Any:
    return {"array": value} if isinstance(value, str) else value


class _SidecarFile(Frozen):
    """The TOML form."""

    sample_rate_hz: Positive | None = None
    time: Annotated[_Place, BeforeValidator(_from_short_form)] | None = None
    channels: dict[str, Annotated[_Place, BeforeValidator(_from_short_form)]] = Field(default_factory=dict)


def find_sidecar(recording: Path, given: Path | None) -> Sidecar:
    """Read what lies beside a recording.

    Parameters
    ----------
    recording
        The recording; ``NAME.toml`` and ``NAME.json`` beside it are read, the first before the second.
    given
        A sidecar named by the person; then only this one is read.

    Raises
    ------
    InputError
        If a sidecar cannot be read or has another form.
    """
    if given is not None:
        return _read_json(given) if given.suffix.lower() == ".json" else _read_toml(given)
    toml, notes = recording.with_suffix(".toml"), []
    first = Sidecar()
    if toml.is_file():
        if _is_plant(toml):
            notes.append(f"{toml.name} beside the recording is a plant, not a sidecar: not used")
        else:
            first = _read_toml(toml)
    beside = recording.with_suffix(".json")
    second = _read_json(beside) if beside.is_file() else Sidecar()
    return Sidecar(
        sample_rate_hz=first.sample_rate_hz or second.sample_rate_hz,
        time=first.time,
        channels=first.channels,
        units=second.units,
        rate_from=first.rate_from or second.rate_from,
        channels_from=first.channels_from,
        units_from=second.units_from,
        notes=(*notes, *first.notes, *second.notes),
    )


def _is_plant(path: Path) -> bool:
    try:
        return re.search(r"(?m)^\s*\[\[\s*body\s*\]\]", path.read_text(encoding="utf-8")) is not None
    except (OSError, UnicodeDecodeError):
        return False


def _read_toml(path: Path) -> Sidecar:
    parsed = read_toml(path, _SidecarFile)
    where = {name: f"{path}: channels {name}" for name in parsed.channels}
    return Sidecar(
        sample_rate_hz=parsed.sample_rate_hz,
        time=None if parsed.time is None else _ref(parsed.time, f"{path}: time"),
        channels={
            name: None if place.array == NOT_RECORDED else _ref(place, where[name])
            for name, place in parsed.channels.items()
        },
        rate_from=path.name if parsed.sample_rate_hz else "",
        channels_from=path.name,
    )


def _ref(place: _Place, where: str) -> ArrayRef:
    ref = parse_array_ref(place.array, where)
    if place.unit is not None and ref.unit is not None and ref.unit != place.unit:
        raise InputError(f"{where}: array says {ref.unit!r} and unit says {place.unit!r}; keep one")
    unit = place.unit or ref.unit
    if place.scale is not None:
        if place.scale == 0.0:
            raise InputError(f"{where}: a scale of 0 leaves nothing; give what a sample of 1 stands for")
        unit = f"{place.scale!r} {unit or ''}".strip()
    if place.sensitivity is not None:
        if unit is None:
            raise InputError(f'{where}: sensitivity needs the unit of what was sampled, such as unit = "V"')
        unit = f"{unit}@{place.sensitivity}"
    return ArrayRef(ref.array, ref.index, unit)


def sidecar_text(
    sample_rate_hz: float | None, time: ArrayRef | None, channels: Mapping[str, ArrayRef | None]
) -> str:
    """The TOML form of what is known about a recording; a channel of None was not recorded."""
    lines = [] if sample_rate_hz is None else [f"sample_rate_hz = {float(sample_rate_hz)!r}"]
    lines += [] if time is None else [f"time = {_place(time)}"]
    lines += ["", "[channels]"]
    lines += [f"{_text(k)} = {_text(NOT_RECORDED) if r is None else _place(r)}" for k, r in channels.items()]
    return "\n".join(lines).lstrip("\n") + "\n"


def _place(ref: ArrayRef) -> str:
    return _text(str(ref) if ref.unit is None else f"{ref}:{ref.unit}")


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)  # a basic string of TOML is one of JSON


def _read_json(path: Path) -> Sidecar:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
    except (ValueError, RecursionError) as error:  # JSON and UTF-8 errors are both of this kind
        raise InputError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(data, dict):
        raise InputError(f'{path}: expected an object with "fs_hz" and "channels", got something else')
    rate = data.get("fs_hz", data.get("sample_rate_hz"))
    if rate is not None and not (
        isinstance(rate, int | float) and not isinstance(rate, bool) and math.isfinite(rate) and rate > 0
    ):
        raise InputError(f"{path}: fs_hz [Hz]: must be a positive number of Hz, got {rate!r}")
    texts = data.get("channels", {})
    if not isinstance(texts, dict):
        raise InputError(f'{path}: channels: expected one text for each array, such as {{"y": "mm tip"}}')
    units = {name: unit for name, text in texts.items() if (unit := _leading_unit(text)) is not None}
    return Sidecar(
        sample_rate_hz=None if rate is None else float(rate),
        units=units,
        rate_from=path.name if rate is not None else "",
        units_from=path.name,
    )


def _leading_unit(text: object) -> str | None:
    """Return the first word of an array's description, where it is a unit."""
    if not isinstance(text, str) or not text.split():
        return None
    word = text.split()[0].rstrip(",;:.")
    return word if is_common(word) else None
