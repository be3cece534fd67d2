"""Channels that share a plot of waveforms."""

from dataclasses import dataclass, field

from twin.plant.blocks import Channel
from twin.plant.config import Plant

_OF_UNIT = {
    "m/s²": "acceleration", "m/s": "velocity", "m": "displacement", "A": "current", "V": "voltage", "N": "force",
}  # fmt: skip


@dataclass(slots=True)
class Group:
    """Channels of one unit that share a plot; ``twin`` holds those the twin has too."""

    path: str
    channels: list[int] = field(default_factory=list)
    twin: list[str] = field(default_factory=list)


def groups_of(plant: Plant, channels: tuple[Channel, ...]) -> list[Group]:
    """Plots of waveforms: the channel that tells most of the primary body by itself, everything else by unit."""
    sensors = {s.name for s in plant.sensor}
    first = spectrum_column(plant, channels)
    groups: dict[str, Group] = {}
    order = [] if first is None else [first]
    for column in [*order, *(k for k in range(len(channels)) if k != first)]:
        channel = channels[column]
        key = plant.primary.name if column == first else _OF_UNIT.get(channel.unit, "other")
        group = groups.setdefault(key, Group(f"waveform/{key}"))
        group.channels.append(column)
        if channel.name in sensors:
            group.twin.append(channel.name)
    return list(groups.values())


def spectrum_column(plant: Plant, channels: tuple[Channel, ...]) -> int | None:
    """Channel whose spectrum is shown: the primary body's acceleration, or else its velocity or displacement."""
    names = [c.name for c in channels]
    for kind in ("acceleration", "velocity", "displacement"):
        for sensor in plant.sensor:
            if sensor.kind == kind and sensor.of == plant.primary.name and sensor.name in names:
                return names.index(sensor.name)
    return None
