"""Which array of a foreign recording is which channel of the plant, and how that was decided."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.rig.arrayref import ArrayRef, parse_array_ref
from twin.rig.sidecar import NOT_RECORDED, Sidecar
from twin.rig.units import sensitivity_to_si, to_si, units_for, why_not

TIME_NAMES = ("t", "time")
BY_PLANT = "the plant's recorded_as"
AS_GIVEN = "as given"
_BARE_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")


@dataclass(frozen=True, slots=True)
class ChannelMapping:
    """One channel of the plant found in a recording.

    Attributes
    ----------
    channel
        Sensor, or actuator whose command was recorded.
    ref
        The array, and which series in it.
    unit
        Unit the array is in.
    si_unit
        Unit of the channel.
    factor
        What turns the one into the other.
    decided
        How it was decided, in words for a person.
    guess
        What of it nobody has said, in words; empty where all of it was.
    """

    channel: str
    ref: ArrayRef
    unit: str
    si_unit: str
    factor: float
    decided: str
    guess: str = ""

    @property
    def array(self) -> str:
        """Array and index as a person writes them."""
        return str(self.ref)

    def __str__(self) -> str:
        """One line for a person: ``tip <- y [mm -> m, x 0.001]: equal names``."""
        return (
            f"{self.channel} <- {self.ref} [{self.unit} -> {self.si_unit}, x {self.factor:g}]: {self.decided}"
        )


def plant_channels(plant: Plant) -> dict[str, str]:
    """Name and SI unit of everything a recording may hold: sensors, then actuators' commands."""
    units = {s.name: s.unit for s in plant.sensor}
    return units | {a.name: a.input_unit for a in plant.actuator}


def map_channels(
    path: Path,
    plant: Plant,
    arrays: Sequence[str],
    options: Mapping[str, str],
    beside: Sidecar,
    shares: frozenset[str] = frozenset(),
) -> tuple[tuple[ChannelMapping, ...], tuple[str, ...]]:
    """Find every channel of the plant in a recording.

    Options come first, then the sidecar, then the plant's ``recorded_as``, then equal names. For a channel that is left
    over, an unused array is guessed if it alone is of its dimension, by a stated unit, and no other such channel is
    left; among several of that dimension, if it alone has words of the channel's name in its own. A unit comes from
    where the array was named, else from the sidecar or the file; else it is taken as SI, which is a guess unless a
    person named the array. What is guessed says so in `ChannelMapping.guess`: it is for a person to confirm.

    Parameters
    ----------
    shares
        Arrays that hold shares of a full scale: their unit must say how much that is, ``50 g``.

    Returns
    -------
    tuple of ChannelMapping
        In the order of `plant_channels`.
    tuple of str
        Notes: channels that were not recorded, entries of the sidecar that this plant has no use for.

    Raises
    ------
    InputError
        If a channel stays without an array, or an array or unit does not exist or is of another dimension.
    """
    units = plant_channels(plant)
    if not units:
        raise InputError(
            f"{path}: plant '{plant.name}' has no sensors or actuators; there is nothing to read"
        )
    for name in options:
        if name not in units:
            raise InputError(
                f"--channel {name}={options[name]}: plant '{plant.name}' has no channel '{name}'; "
                f"its channels are {', '.join(units)}"
            )
    recorded_as = {x.name: x.recorded_as for x in (*plant.sensor, *plant.actuator)}
    notes = [
        f"{beside.channels_from} names channel '{name}', which plant '{plant.name}' has not: not used"
        for name in beside.channels
        if name not in units
    ]
    found: dict[str, tuple[ArrayRef, str]] = {}
    missing: list[str] = []
    for name in units:
        if name in options:
            if options[name].strip() == NOT_RECORDED:
                notes.append(f"{name}: not recorded (as given)")
            else:
                found[name] = (parse_array_ref(options[name], f"--channel {name}"), AS_GIVEN)
        elif name in beside.channels:
            place = beside.channels[name]
            if place is None:
                notes.append(f"{name}: not recorded (from {beside.channels_from})")
            else:
                found[name] = (place, f"from {beside.channels_from}")
        elif (text := recorded_as[name]) and (
            ref := parse_array_ref(text, f"'{name}' recorded_as")
        ).array in arrays:
            found[name] = (ref, BY_PLANT)
        elif name in arrays:
            found[name] = (ArrayRef(name), "equal names")
        else:
            missing.append(name)
    for name in [m for m in missing if _measured_drive(plant, m, found)]:
        measured = _measured_drive(plant, name, found)
        missing.remove(name)
        notes.append(f"{name}: its command is not recorded; '{measured}' tells what drove it")
    time = beside.time.array if beside.time else None
    free = [
        a for a in arrays if a not in (*TIME_NAMES, time) and a not in {r.array for r, _ in found.values()}
    ]
    guesses = _guesses(missing, units, free, beside.units)
    if len(guesses) < len(missing):
        raise InputError(
            _explain_missing(
                path,
                missing=[m for m in missing if m not in guesses],
                units=units,
                arrays=arrays,
                free=free,
                stated=beside.units,
            )
        )
    for name, (array, why) in guesses.items():
        found[name] = (ArrayRef(array), f"guessed: {why}")
    if not any(s.name in found for s in plant.sensor):
        raise InputError(
            f"{path}: no sensor of plant '{plant.name}' is in it; there is nothing to compare with"
        )
    mapping = tuple(
        _with_unit(path, name, *found[name], si_unit=units[name], arrays=arrays, beside=beside, shares=shares)
        for name in units
        if name in found
    )
    return mapping, tuple(notes)


def _measured_drive(plant: Plant, actuator: str, found: Mapping[str, object]) -> str:
    """Sensor that measured what drove an actuator; empty if none did, or it is no actuator."""
    measured = (s for s in plant.sensor if s.of == actuator and s.kind in ("voltage", "current"))
    return next((s.name for s in measured if s.name in found), "")


def _guesses(
    missing: Sequence[str], units: Mapping[str, str], free: Sequence[str], stated: Mapping[str, str]
) -> dict[str, tuple[str, str]]:
    """Array and reason for each missing channel that only one array can be, or only one is called like."""
    could = {name: _candidates(units[name], free, stated) for name in missing}
    found = {}
    for name, candidates in could.items():
        rivals = [other for other in missing if other != name and units[other] == units[name]]
        if len(candidates) == 1 and not rivals:
            found[name] = (candidates[0], f"the only array left in {stated[candidates[0]]}")
            continue
        alike = [(len(_words(name) & _words(a)), a) for a in candidates]
        best = max((n for n, _ in alike), default=0)
        called = [a for n, a in alike if n == best > 0]
        contested = [r for r in rivals if called and len(_words(r) & _words(called[0])) >= best]
        if len(called) == 1 and not contested:
            shared = ", ".join(sorted(_words(name) & _words(called[0])))
            found[name] = (
                called[0],
                f"the only array in {stated[called[0]]} that is called '{shared}' like it",
            )
    taken = [array for array, _ in found.values()]
    return {name: (array, why) for name, (array, why) in found.items() if taken.count(array) == 1}


def _words(name: str) -> frozenset[str]:
    split = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return frozenset(word for word in re.split(r"[^a-z]+", split.lower()) if len(word) > 2)


def _candidates(si_unit: str, free: Sequence[str], stated: Mapping[str, str]) -> list[str]:
    return [a for a in free if a in stated and (to_si(stated[a], si_unit) or ("",))[0] == si_unit]


def _explain_missing(
    path: Path,
    *,
    missing: Sequence[str],
    units: Mapping[str, str],
    arrays: Sequence[str],
    free: Sequence[str],
    stated: Mapping[str, str],
) -> str:
    lines = []
    for name in missing:
        candidates = _candidates(units[name], free, stated)
        which = f" (could be {' or '.join(candidates)})" if candidates else ""
        lines.append(
            f"{path}: no array for channel '{name}' [{units[name]}]{which}; give "
            f"--channel {name}=ARRAY:UNIT, or --channel {name}={NOT_RECORDED} if it was not recorded"
        )
    lines.append(f"{path}: arrays in the file: {', '.join(arrays)}")
    return "\n".join(lines)


def _with_unit(
    path: Path,
    name: str,
    ref: ArrayRef,
    decided: str,
    *,
    si_unit: str,
    arrays: Sequence[str],
    beside: Sidecar,
    shares: frozenset[str],
) -> ChannelMapping:
    if ref.array not in arrays:
        raise InputError(
            f"{path}: channel '{name}': no array '{ref.array}' in the file ({decided}); "
            f"arrays: {', '.join(arrays)}"
        )
    stated = beside.units.get(ref.array)
    # The sidecar was written for this recording, the plant's recorded_as for all of them.
    unit = stated if ref.unit is None or (stated and decided == BY_PLANT) else ref.unit
    guess = decided if decided.startswith("guessed") else ""
    if ref.array in shares and re.match(r"\s*[-+.]?\d", unit or "") is None:
        raise InputError(
            f"{path}: channel '{name}' <- {ref}: its integers are shares of the converter's full scale; say how much "
            f"that is, in a sidecar with scale, or such as --channel '{name}={ref}:50 {unit or si_unit}'"
        )
    if unit is None:
        if decided not in (AS_GIVEN, f"from {beside.channels_from}"):
            guess = f"{guess or decided}; no unit stated, taken as SI"
        decided = f"{decided}; no unit stated, taken as SI"
        return ChannelMapping(name, ref, si_unit, si_unit, 1.0, decided, guess)
    factor = _factor(unit, si_unit)
    if factor is None:
        raise InputError(
            f"{path}: channel '{name}' <- {ref}: unit '{unit}' {why_not(unit.split('@')[0], si_unit)}; "
            f"give --channel {name}={ref}:UNIT with one of {', '.join(units_for(si_unit))}"
        )
    if ref.unit is None or unit != ref.unit:
        decided += f"; unit from {beside.units_from}"
    elif stated and to_si(stated, si_unit) != (si_unit, factor):
        decided += f"; {beside.units_from} says {stated}"
    return ChannelMapping(name, ref, unit, si_unit, factor, decided, guess)


def _factor(unit: str, si_unit: str) -> float | None:
    """From ``mm``, ``50 g``, ``50`` (of the SI unit) or ``mV@100 mV/g`` to the SI unit; None where it does not fit."""
    raw, _, sensitivity = (part.strip() for part in unit.partition("@"))
    if sensitivity:
        return sensitivity_to_si(raw, sensitivity, si_unit)
    if _BARE_NUMBER.fullmatch(raw):
        raw = f"{raw} {si_unit}"
    known = to_si(raw, si_unit)
    return known[1] if known is not None and known[0] == si_unit else None
