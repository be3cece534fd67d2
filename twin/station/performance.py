"""How a block went: motion of the primary body at the excitation, current and powers of the coil."""

import math

import numpy as np

from estimators.types import Phasors, StateEstimate
from tuning.types import Powers
from twin.plant.blocks import Block
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
        current = _current_of(coil, estimate)
        return Performance(
            displacement_m=self.displacement(phasors),
            passive_m=passive,
            limit_m=limit,
            current_peak_a=float(np.max(np.abs(current))) if current is not None else math.nan,
            powers=_powers(coil, current, estimate, block),
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


def _current_of(coil: VoiceCoil, estimate: StateEstimate) -> Array | None:
    name = f"i_{coil.name}"
    return estimate.mean[:, estimate.states.index(name)] if name in estimate.states else None


def _powers(coil: VoiceCoil, current: Array | None, estimate: StateEstimate, block: Block) -> Powers:
    """Powers over a block from the estimated states: v i = R i² + d/dt(L i²/2) + k i (v2 - v1)."""
    if current is None or coil.between is None:
        return Powers(math.nan, math.nan, math.nan)
    velocity = {b: estimate.mean[:, estimate.states.index(f"v_{b}")] for b in coil.between}
    first, second = coil.between
    joule = coil.resistance_ohm * current**2
    stored = 0.5 * coil.inductance_h * (current[-1] ** 2 - current[0] ** 2)
    mechanical = coil.force_constant_n_a * np.mean(current * (velocity[second] - velocity[first]))
    return Powers(
        joule_mean_w=float(np.mean(joule)),
        joule_peak_w=float(np.max(joule)),
        electrical_mean_w=float(
            np.mean(joule) + mechanical + stored * block.sample_rate_hz / max(block.n_samples - 1, 1)
        ),
    )
