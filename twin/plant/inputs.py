"""Which recorded channel drives each actuator of the model, and how it is held between samples."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.plant.blocks import Block
from twin.plant.config import DampingTable, ForceActuator, Plant
from twin.plant.discrete import DiscreteModel, Hold, discretise
from twin.plant.linear import Array, LinearModel, linear_model, read_only


@dataclass(frozen=True, slots=True)
class InputSource:
    """Where an actuator's input comes from.

    Attributes
    ----------
    actuator
        The actuator's name.
    channel
        The recorded channel; None if nothing recorded tells, and the input is taken as zero.
    hold
        A command from a converter is held; a measured signal is joined linearly.
    by_current
        True if the channel is the coil's measured current, so that its circuit leaves the model.
    noise_density
        One-sided, of the channel [unit/sqrt(Hz)]; 0 for a command.
    """

    actuator: str
    channel: str | None
    hold: Hold
    by_current: bool = False
    noise_density: float = 0.0


def choose_inputs(plant: Plant, channels: Sequence[str]) -> tuple[InputSource, ...]:
    """For each actuator: its recorded command, else its measured voltage, else its measured current.

    The command comes first because the rig holds it exactly as the model does. A voice coil's terminal
    voltage behind a current loop does not: it jumps within a sample and its samples miss that, so there the
    current is the better second choice.
    """
    sources = []
    for actuator in plant.actuator:
        source = InputSource(actuator.name, None, "zoh")
        if actuator.name in channels:
            source = InputSource(actuator.name, actuator.name, "zoh")
        elif not isinstance(actuator, ForceActuator):
            wanted = ["current"] if actuator.input_unit == "A" else ["voltage", "current"]
            measured = {s.kind: s for s in plant.sensor if s.of == actuator.name and s.name in channels}
            for kind in wanted:
                if kind in measured:
                    sensor = measured[kind]
                    source = InputSource(
                        actuator.name, sensor.name, "foh", kind == "current", sensor.noise_density
                    )
                    break
        else:
            forces = [
                s for s in plant.sensor if s.kind == "force" and s.of == actuator.name and s.name in channels
            ]
            if forces and actuator.force_constant_n_v is None:
                source = InputSource(actuator.name, forces[0].name, "foh", False, forces[0].noise_density)
        sources.append(source)
    return tuple(sources)


def driven_model(
    plant: Plant, sources: Sequence[InputSource], sample_rate_hz: float, frequency_hz: float | None
) -> tuple[LinearModel, DiscreteModel]:
    """Continuous and exactly discretised model of a plant driven by recorded channels.

    Parameters
    ----------
    frequency_hz
        Where damping given against frequency is read [Hz].
    """
    by_current = [s.actuator for s in sources if s.by_current]
    model = linear_model(plant, frequency_hz=frequency_hz, current_driven=by_current)
    return model, discretise(model, sample_rate_hz, [s.hold for s in sources])


class DampedModels:
    """`driven_model` of a plant for one damping of its absorber after another, at a tenth of the cost.

    Damping forces are linear in the damping, and so are states and measurements: ``A = A0 + c A1``, ``C = C0 + c C1``.

    Parameters
    ----------
    plant, sources, sample_rate_hz
        As `driven_model`.

    Raises
    ------
    ValueError
        If the plant has no absorber.
    """

    def __init__(self, plant: Plant, sources: Sequence[InputSource], sample_rate_hz: float) -> None:
        if plant.absorber is None:
            raise ValueError(f"plant '{plant.name}' has no absorber")
        self._plant, self._sources, self._rate_hz = plant, tuple(sources), sample_rate_hz
        self._absorber = plant.absorber.name
        self._others_vary = any(
            isinstance(b.damping_ns_m, DampingTable) for b in plant.body if b.name != self._absorber
        )
        self._read_at_hz: float | None = None
        self._ends: tuple[LinearModel, LinearModel] | None = None

    def at(self, damping_ns_m: float, frequency_hz: float) -> tuple[LinearModel, DiscreteModel]:
        """Continuous and exactly discretised model.

        Parameters
        ----------
        frequency_hz
            Where damping of other bodies that is given against frequency is read [Hz].
        """
        if self._ends is None or (self._others_vary and frequency_hz != self._read_at_hz):
            self._read_at_hz = frequency_hz
            by_current = [s.actuator for s in self._sources if s.by_current]
            none, one = (
                linear_model(
                    self._plant,
                    frequency_hz=frequency_hz,
                    damping_ns_m={self._absorber: value},
                    current_driven=by_current,
                )
                for value in (0.0, 1.0)
            )
            self._ends = none, one
        none, one = self._ends
        model = replace(
            none,
            A=read_only(none.A + damping_ns_m * (one.A - none.A)),
            C=read_only(none.C + damping_ns_m * (one.C - none.C)),
        )
        return model, discretise(model, self._rate_hz, [s.hold for s in self._sources])


class DriveReader:
    """Read the actuators' inputs out of blocks.

    A model must be driven by something: an input that is not recorded is zero, and one whose sample is invalid
    keeps its last valid value, across blocks too.
    """

    def __init__(self, sources: Sequence[InputSource], channels: Sequence[str]) -> None:
        names = list(channels)
        self._columns = [names.index(s.channel) if s.channel is not None else -1 for s in sources]
        self._last = np.zeros(len(self._columns))

    def gather(self, block: Block) -> Array:
        """Inputs of a block, (n_samples, n_inputs) in the actuators' input units."""
        u = np.zeros((block.n_samples, len(self._columns)))
        whole = bool(block.valid.all())  # a look at all of it is cheaper than one at each column
        for j, column in enumerate(self._columns):
            if column < 0:
                continue
            u[:, j] = block.values[:, column]
            if whole:
                continue
            valid = block.valid[:, column]
            if not valid.all():
                latest = np.maximum.accumulate(np.where(valid, np.arange(len(u)), -1))
                u[:, j] = np.where(latest >= 0, u[latest, j], self._last[j])
        if len(u):
            self._last = u[-1].copy()
        return u
