"""The plant in parallel: the model stepped from the recorded inputs alone, never corrected by a measurement."""

import numpy as np

from twin.plant.blocks import Block
from twin.plant.discrete import DiscreteModel, simulate_block
from twin.plant.inputs import DriveReader
from twin.plant.linear import Array, LinearModel, read_only


class ParallelPlant:
    """A plant model that runs beside the rig.

    Parameters
    ----------
    drive
        Where its inputs come from.
    model, discrete
        See `twin.plant.inputs.driven_model`.
    """

    def __init__(self, drive: DriveReader, model: LinearModel, discrete: DiscreteModel) -> None:
        self._drive = drive
        self.outputs = model.outputs
        self._x = np.zeros(len(model.states))
        self._u_before: Array | None = None
        self.set_model(discrete)

    def set_model(self, discrete: DiscreteModel) -> None:
        """Put another model of the same structure in place; the state is carried over."""
        self._discrete = discrete

    def advance(self, block: Block) -> Array:
        """Step through a block; returns (n_samples, n_outputs) in the order of ``outputs``."""
        u = self._drive.gather(block)
        if self._u_before is None:
            self._u_before = u[0].copy()
        y = np.empty((len(u), len(self.outputs)))
        d = self._discrete
        simulate_block(d.F, d.B0, d.B1, d.C, d.D, self._x, self._u_before, u, y)
        return read_only(y)
