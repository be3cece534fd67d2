"""Which input of an NI-DAQmx device is which channel of the plant: a TOML file, checked before any device is touched.

sample_rate_hz = 50000.0
block_samples = 5000

[channels]
table_acceleration = { physical = "cDAQ1Mod1/ai0", sensitivity = "100 mV/g", iepe_ma = 2.0 }
vcm_current = { physical = "cDAQ1Mod2/ai0", sensitivity = "0.1 V/A", range_v = 10.0 }
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from twin.plant.blocks import Channel
from twin.plant.config import Frozen, Plant, Positive
from twin.plant.errors import InputError
from twin.plant.files import read_toml
from twin.rig.mapping import plant_channels
from twin.rig.messages import MAX_BLOCK_SAMPLES
from twin.rig.units import sensitivity_to_si

Terminal = Literal["default", "differential", "pseudo_differential", "rse", "nrse"]


class PhysicalChannel(Frozen):
    """One analogue input.

    Attributes
    ----------
    physical
        Device and channel as NI's own tools name them.
    sensitivity
        What the sensor gives: volts per unit of the plant's channel, such as ``100 mV/g`` or ``0.1 V/A``; negative
        for a sensor mounted the other way round.
    range_v
        Largest voltage that is measured [V]; a value at its end is masked.
    offset_v
        Voltage at zero [V].
    iepe_ma
        Current that feeds the sensor [mA]; accelerometers with IEPE need it.
    """

    physical: str = Field(min_length=4, max_length=200, pattern=r"^[^/\s]+/ai\d+$")
    sensitivity: str = Field(min_length=3, max_length=60)
    range_v: Positive = 5.0
    offset_v: float = 0.0
    terminal: Terminal = "default"
    iepe_ma: Positive | None = None


class DaqmxSetup(Frozen):
    """The file. A plant's channel that is not named is not recorded."""

    sample_rate_hz: Positive = 50_000.0
    block_samples: int = Field(default=5_000, ge=10, le=MAX_BLOCK_SAMPLES)
    channels: dict[str, PhysicalChannel] = Field(min_length=1)


@dataclass(frozen=True, slots=True)
class Input:
    """One channel of the plant at one physical channel.

    Attributes
    ----------
    factor
        What makes SI of volts.
    """

    channel: Channel
    kind: str
    place: PhysicalChannel
    factor: float


def read_setup(path: Path, plant: Plant) -> tuple[DaqmxSetup, tuple[Input, ...]]:
    """Read the file and hold it against the plant.

    Returns
    -------
    DaqmxSetup
        As it stands in the file.
    tuple of Input
        In the plant's order.

    Raises
    ------
    InputError
        If it names a channel the plant has not, one place twice, or a sensitivity of another unit; or no sensor.
    """
    setup = read_toml(path, DaqmxSetup)
    units = plant_channels(plant)
    for name in setup.channels:
        if name not in units:
            raise InputError(
                f"{path}: channels {name}: plant '{plant.name}' has no such channel; it has {', '.join(units)}"
            )
    taken: dict[str, str] = {}
    for name, place in setup.channels.items():
        if place.physical in taken:
            raise InputError(
                f"{path}: channels {name}: {place.physical} is that of '{taken[place.physical]}' already; "
                "give each its own"
            )
        taken[place.physical] = name
    kinds = {s.name: s.kind for s in plant.sensor}
    if not any(name in kinds for name in setup.channels):
        raise InputError(
            f"{path}: channels: no sensor of plant '{plant.name}' is named; there is nothing to watch"
        )
    found = []
    for name, unit in units.items():
        if name not in setup.channels:
            continue
        place = setup.channels[name]
        factor = sensitivity_to_si("V", place.sensitivity, unit)
        if factor is None:
            raise InputError(
                f"{path}: channels {name}: sensitivity '{place.sensitivity}' does not give {unit}; "
                f"write volts per unit of it, such as '0.1 V/({unit})'"
            )
        kind = kinds.get(name, "command")
        if place.iepe_ma is not None and kind != "acceleration":
            raise InputError(
                f"{path}: channels {name}: iepe_ma feeds accelerometers, this is a {kind}; leave it out"
            )
        found.append(Input(Channel(name, unit), kind, place, factor))
    return setup, tuple(found)
