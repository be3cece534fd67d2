"""Channels that share a plot of waveforms."""

from dataclasses import dataclass, field

from twin.plant.blocks import Channel
from twin.plant.config import MOTION_UNITS, Plant

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
    """Plots of waveforms: the primary body's motion by itself, everything else by unit."""
    sensors = {s.name: s for s in plant.sensor}
    motion = set(MOTION_UNITS.values())
    groups: dict[str, Group] = {}
    for column, channel in enumerate(channels):
        sensor = sensors.get(channel.name)
        if sensor is not None and channel.unit in motion and sensor.of == plant.primary.name:
            key = plant.primary.name
        else:
            key = _OF_UNIT.get(channel.unit, "other")
        group = groups.setdefault(key, Group(f"waveform/{key}"))
        group.channels.append(column)
        if sensor is not None:
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
