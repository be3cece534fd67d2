"""The plant in parallel: the model stepped from the recorded inputs alone, never corrected by a measurement."""

from collections.abc import Sequence

import numpy as np

from twin.plant.blocks import Block
from twin.plant.discrete import DiscreteModel, simulate_block
from twin.plant.inputs import DriveReader
from twin.plant.linear import Array, LinearModel
from twin.plant.modal import ModalModel, modal_model, simulate_modes


class ParallelPlant:
    """A plant model that runs beside the rig.

    Parameters
    ----------
    drive
        Where its inputs come from.
    model, discrete
        See `twin.plant.inputs.driven_model`.
    outputs
        Names of those of its outputs that are wanted; None for all.
    """

    def __init__(
        self,
        drive: DriveReader,
        model: LinearModel,
        discrete: DiscreteModel,
        outputs: Sequence[str] | None = None,
    ) -> None:
        self._drive = drive
        self.outputs = model.outputs if outputs is None else tuple(outputs)
        self._rows = [model.outputs.index(name) for name in self.outputs]
        self._x = np.zeros(len(model.states))
        self._u_before: Array | None = None
        self._modes: Array | None = None
        self._modal: ModalModel | None = None
        self.set_model(discrete)

    def set_model(self, discrete: DiscreteModel) -> None:
        """Put another model of the same structure in place; the state is carried over."""
        if self._modal is not None and self._modes is not None:
            self._x = self._modal.shapes @ self._modes
        self._discrete = discrete
        self._C, self._D = discrete.C[self._rows], discrete.D[self._rows]
        self._modal = modal_model(discrete, self._C, self._D)
        self._modes = None if self._modal is None else self._modal.inverse @ self._x

    def advance(self, block: Block) -> Array:
        """Step through a block; returns (n_samples, n_outputs) in the order of ``outputs``, read-only."""
        u = self._drive.gather(block)
        if self._u_before is None:
            self._u_before = u[0].copy()
        y = np.empty((len(u), len(self.outputs)))
        d, modal = self._discrete, self._modal
        if modal is None or self._modes is None:
            simulate_block(d.F, d.B0, d.B1, self._C, self._D, self._x, self._u_before, u, y)
        else:
            simulate_modes(
                modal.pairs, modal.of_inputs, modal.outputs, modal.feedthrough, self._modes, self._u_before, u, y
            )  # fmt: skip
        y.flags.writeable = False
        return y
