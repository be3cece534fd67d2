"""How well the observer predicts: one-step errors on rows the parameters were not fitted on.

The known input must earn its place: a second observer that knows no input runs beside the first.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.observer import Observer
from estimators.types import StateEstimate
from twin.plant.blocks import Block, Channel
from twin.plant.compiled import kernel
from twin.plant.config import Plant
from twin.plant.inputs import InputSource
from twin.plant.linear import Array


@dataclass(frozen=True, slots=True)
class Score:
    """One sensor's normalised root mean square error of the one-step prediction.

    Attributes
    ----------
    nrmse
        rms(prediction error) / std(measured), over the scored rows.
    nrmse_without_input
        The same for an observer that knows no input; None where no input is recorded.
    rows
        Valid rows that were scored.
    """

    sensor: str
    nrmse: float
    nrmse_without_input: float | None
    rows: int


class PredictionScore:
    """Collect one-step errors of a run.

    Parameters
    ----------
    plant, channels, sample_rate_hz
        As the observer's.
    sources
        Its inputs; where any is recorded, a second observer without inputs runs beside it.
    fitted_rows
        Ranges (first, end) of rows that do not count.
    """

    def __init__(
        self,
        plant: Plant,
        channels: Sequence[Channel],
        sample_rate_hz: float,
        sources: Sequence[InputSource],
        fitted_rows: Sequence[tuple[int, int]],
    ) -> None:
        names = tuple(c.name for c in channels)
        self._fitted = tuple(fitted_rows)
        self._blind: Observer | None = None
        commanded = [s for s in sources if s.channel is not None and not s.by_current]
        if commanded and len(commanded) == len([s for s in sources if s.channel is not None]):
            unknown = [InputSource(s.actuator, None, s.hold) for s in sources]
            self._blind = Observer(plant, names, sample_rate_hz, sources=unknown)
        self._columns: dict[str, int] = {name: names.index(name) for name in names}
        self._sums: dict[str, list[float]] = {}

    def add(self, block: Block, estimate: StateEstimate) -> None:
        """Score one block, unless any of its rows was fitted on."""
        blind = self._blind.advance(block) if self._blind is not None else None
        if any(block.first_sample < end and first < block.end_sample for first, end in self._fitted):
            return
        for row, sensor in enumerate(estimate.sensors):
            n, total, squares = column_sums(block.values, block.valid, self._columns[sensor])
            if n == 0:
                continue
            sums = self._sums.setdefault(sensor, [0.0] * 5)
            sums[0] += n
            sums[1] += total
            sums[2] += squares
            sums[3] += n * float(estimate.prediction_rms[row]) ** 2
            if blind is not None and sensor in blind.sensors:
                sums[4] += n * float(blind.prediction_rms[blind.sensors.index(sensor)]) ** 2

    def scores(self) -> tuple[Score, ...]:
        """One score per sensor that was seen."""
        out = []
        for sensor, (n, total, squares, informed, blind) in self._sums.items():
            spread = math.sqrt(max(squares / n - (total / n) ** 2, 0.0))
            if spread == 0.0:
                continue
            without = math.sqrt(blind / n) / spread if self._blind is not None else None
            out.append(Score(sensor, math.sqrt(informed / n) / spread, without, int(n)))
        return tuple(out)


@kernel
def column_sums(values: Array, valid: NDArray[np.bool_], column: int) -> tuple[int, float, float]:
    """How many valid samples a column has, their sum and the sum of their squares."""
    count, total, squares = 0, np.zeros(4), np.zeros(4)
    for k in range(len(values)):
        if valid[k, column]:
            y = values[k, column]
            count += 1
            total[k % 4] += y
            squares[k % 4] += y * y
    return count, total.sum(), squares.sum()
