"""How a block went: motion of the primary body at the excitation, current and powers of the coil."""

import math

import numpy as np

from estimators.types import Phasors, StateEstimate
from tuning.types import Powers
from twin.plant.blocks import Block
from twin.plant.compiled import kernel
from twin.plant.config import Plant, VoiceCoil
from twin.plant.linear import Array
from twin.station.frame import Performance


class PerformanceMeter:
    """Reads the performance of one plant off its phasors and estimated states.

    Parameters
    ----------
    plant
        Gives the primary body, its sensors and the coil.
    channels
        Names of a block's columns.
    """

    def __init__(self, plant: Plant, channels: tuple[str, ...]) -> None:
        self._coil = plant.voice_coil
        self._column, self._order, self._absorber, self._current = -1, 0, -1, -1
        absorber = plant.absorber
        for sensor in plant.sensor:
            if sensor.name not in channels:
                continue
            if absorber is not None and sensor.kind == "acceleration" and sensor.of == absorber.name:
                self._absorber = channels.index(sensor.name)
            if self._coil is not None and sensor.kind == "current" and sensor.of == self._coil.name:
                self._current = channels.index(sensor.name)
        for sensor in plant.sensor:
            order = {"displacement": 0, "velocity": 1, "acceleration": 2}.get(sensor.kind)
            if order is not None and sensor.of == plant.primary.name and sensor.name in channels:
                self._column, self._order = channels.index(sensor.name), order
                break

    def measure(
        self,
        block: Block,
        phasors: Phasors | None,
        estimate: StateEstimate,
        bounds_m: tuple[float, float],
        budget_w: float,
    ) -> Performance | None:
        """Performance over one block; None where there is no coil or no excitation.

        Parameters
        ----------
        bounds_m
            Motion without control and the physical limit [m].
        """
        coil = self._coil
        if coil is None or phasors is None:
            return None
        passive, limit = bounds_m
        powers, peak = _powers(coil, estimate, block)
        return Performance(
            displacement_m=self.displacement(phasors),
            passive_m=passive,
            limit_m=limit,
            current_peak_a=peak,
            powers=powers,
            budget_w=budget_w,
        )

    def displacement(self, phasors: Phasors) -> float:
        """Peak displacement of the primary body at the excitation [m]; NaN if nothing measures it."""
        if self._column < 0:
            return math.nan
        a = abs(phasors.amplitude[self._column])
        return float(a / (math.tau * phasors.frequency_hz) ** self._order)

    def displacement_std(self, phasors: Phasors) -> float:
        """Standard deviation of `displacement` by the block's own noise [m]: root of E|error|²."""
        if self._column < 0:
            return math.nan
        variance = float(phasors.variance[self._column])
        return math.sqrt(variance) / (math.tau * phasors.frequency_hz) ** self._order

    def displacement_rate(self, phasors: Phasors) -> float:
        """How fast amplitude or phase of `displacement` move [m/s]; NaN if nothing measures it."""
        if self._column < 0:
            return math.nan
        return float(abs(phasors.slope[self._column]) / (math.tau * phasors.frequency_hz) ** self._order)

    def absorber_drift_1_s(self, phasors: Phasors) -> float:
        """How fast the absorber's amplitude or phase moves, |A'/A|; infinite if nothing measures it."""
        if self._absorber < 0 or phasors.amplitude[self._absorber] == 0.0:
            return math.inf
        return float(abs(phasors.slope[self._absorber] / phasors.amplitude[self._absorber]))

    def elsewhere(self, phasors: Phasors, performance: Performance) -> float:
        """Share of the mean Joule power that the coil's current at the excitation does not account for.

        What still rings after a step has its own frequency; NaN if no sensor measures the current.
        """
        power = performance.powers.joule_mean_w
        if self._coil is None or self._current < 0 or not power > 0.0:
            return math.nan
        at_excitation = 0.5 * self._coil.resistance_ohm * abs(phasors.amplitude[self._current]) ** 2
        return float(abs(1.0 - at_excitation / power))


def _powers(coil: VoiceCoil, estimate: StateEstimate, block: Block) -> tuple[Powers, float]:
    """Powers over a block by the estimated states, v i = R i² + d/dt(L i²/2) + k i (v2 - v1); the peak current."""
    name = f"i_{coil.name}"
    if coil.between is None or name not in estimate.states:
        return Powers(math.nan, math.nan, math.nan), math.nan
    first, second = (estimate.states.index(f"v_{body}") for body in coil.between)
    mean = estimate.mean
    at = estimate.states.index(name)
    square, largest, through = current_sums(mean, at, first, second)
    n = len(mean)
    joule = coil.resistance_ohm * square / n
    stored = 0.5 * coil.inductance_h * float(mean[-1, at] ** 2 - mean[0, at] ** 2)
    electrical = joule + coil.force_constant_n_a * through / n + stored * block.sample_rate_hz / max(n - 1, 1)
    return Powers(joule, coil.resistance_ohm * largest * largest, electrical), largest


@kernel
def current_sums(mean: Array, current: int, first: int, second: int) -> tuple[float, float, float]:
    """Sum of the current's squares, its largest magnitude, and the sum of current times relative velocity.

    Parameters
    ----------
    mean
        (N, n) states.
    current, first, second
        Their columns.
    """
    squares, largest, through = np.zeros(4), 0.0, np.zeros(4)
    for k in range(len(mean)):
        i = mean[k, current]
        squares[k % 4] += i * i
        through[k % 4] += i * (mean[k, second] - mean[k, first])
        largest = max(largest, abs(i))
    return squares.sum(), largest, through.sum()
