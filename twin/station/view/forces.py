"""What the actuators of a plant do in a block, from the estimate or, where it has no such state, from the channels."""

import numpy as np

from twin.plant.config import GROUND, Actuator, ForceActuator, Plant, Shaker, VoiceCoil
from twin.plant.linear import Array
from twin.station.frame import Frame


def pushes(plant: Plant) -> list[tuple[Actuator, str, float]]:
    """Actuator, body and sign of every force on a body."""
    return [(a, body, sign) for a in plant.actuator for body, sign in a.pushes if body != GROUND]


def drive_of(actuator: Actuator, frame: Frame) -> Array | None:
    """(n_samples,) current of a coil [A], or what commands an ideal force in its own unit; None if nothing tells."""
    estimate, block = frame.estimate, frame.block
    ideal = isinstance(actuator, ForceActuator)
    wanted = [f"f_{body}" for body, _ in actuator.pushes] if ideal else [f"i_{actuator.name}"]
    for name in wanted:
        if name in estimate.states:
            found = estimate.mean[:, estimate.states.index(name)]
            if isinstance(actuator, ForceActuator):
                return np.asarray(found / (actuator.force_constant_n_v or 1.0))
            return found
    names = [c.name for c in block.channels]
    if actuator.name in names and (ideal or actuator.input_unit == "A"):
        k = names.index(actuator.name)
        return np.where(block.valid[:, k], block.values[:, k], np.nan)
    return None


def force_of(actuator: Actuator, drive: Array | None) -> Array | None:
    """(n_samples,) force of an actuator [N] from what `drive_of` tells."""
    if drive is None:
        return None
    if isinstance(actuator, VoiceCoil | Shaker):
        return actuator.force_constant_n_a * drive
    return drive * (actuator.force_constant_n_v or 1.0)
