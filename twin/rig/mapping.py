"""Which array of a foreign recording is which channel of the plant, and how that was decided."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.rig.arrayref import ArrayRef, parse_array_ref
from twin.rig.sidecar import NOT_RECORDED, Sidecar
from twin.rig.units import to_si, units_for, why_not

TIME_NAMES = ("t", "time")
BY_PLANT = "the plant's recorded_as"


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
    """

    channel: str
    ref: ArrayRef
    unit: str
    si_unit: str
    factor: float
    decided: str

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
    path: Path, plant: Plant, arrays: Sequence[str], options: Mapping[str, str], beside: Sidecar
) -> tuple[tuple[ChannelMapping, ...], tuple[str, ...]]:
    """Find every channel of the plant in a recording.

    Options come first, then the sidecar, then the plant's ``recorded_as``, then equal names. If exactly one
    channel is left over and exactly one unused array has a stated unit of its dimension, that one is guessed
    and called so. A unit comes from where the array was named, else from the sidecar, else it is taken as SI.

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
                found[name] = (parse_array_ref(options[name], f"--channel {name}"), "as given")
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
    if missing:
        guess = _guess(missing, units, free, beside.units)
        if guess is None:
            raise InputError(
                _explain_missing(
                    path, missing=missing, units=units, arrays=arrays, free=free, stated=beside.units
                )
            )
        found[missing[0]] = (ArrayRef(guess), f"guessed: the only array left in {beside.units[guess]}")
    if not any(s.name in found for s in plant.sensor):
        raise InputError(
            f"{path}: no sensor of plant '{plant.name}' is in it; there is nothing to compare with"
        )
    mapping = tuple(
        _with_unit(path, name, *found[name], si_unit=units[name], arrays=arrays, beside=beside)
        for name in units
        if name in found
    )
    return mapping, tuple(notes)


def _measured_drive(plant: Plant, actuator: str, found: Mapping[str, object]) -> str:
    """Sensor that measured what drove an actuator; empty if none did, or it is no actuator."""
    measured = (s for s in plant.sensor if s.of == actuator and s.kind in ("voltage", "current"))
    return next((s.name for s in measured if s.name in found), "")


def _guess(
    missing: Sequence[str], units: Mapping[str, str], free: Sequence[str], stated: Mapping[str, str]
) -> str | None:
    """Return the one array that can be the one missing channel, or None where there is any choice."""
    if len(missing) != 1:
        return None
    candidates = _candidates(units[missing[0]], free, stated)
    return candidates[0] if len(candidates) == 1 else None


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
) -> ChannelMapping:
    if ref.array not in arrays:
        raise InputError(
            f"{path}: channel '{name}': no array '{ref.array}' in the file ({decided}); "
            f"arrays: {', '.join(arrays)}"
        )
    stated = beside.units.get(ref.array)
    # The sidecar was written for this recording, the plant's recorded_as for all of them.
    unit = stated if ref.unit is None or (stated and decided == BY_PLANT) else ref.unit
    if unit is None:
        return ChannelMapping(name, ref, si_unit, si_unit, 1.0, f"{decided}; no unit stated, taken as SI")
    known = to_si(unit, si_unit)
    if known is None or known[0] != si_unit:
        raise InputError(
            f"{path}: channel '{name}' <- {ref}: unit '{unit}' {why_not(unit, si_unit)}; "
            f"give --channel {name}={ref}:UNIT with one of {', '.join(units_for(si_unit))}"
        )
    if ref.unit is None or unit != ref.unit:
        decided += f"; unit from {beside.units_from}"
    elif stated and to_si(stated, si_unit) != known:
        decided += f"; {beside.units_from} says {stated}"
    return ChannelMapping(name, ref, unit, si_unit, known[1], decided)
