"""Whether a schedule in use is stable over its table, from where it is not, and what makes it so.

The law's position gain acts through filters and delay. Where these lag by phi, ``gamma x_r`` is felt as a stiffness
``gamma cos(phi)`` and a damping ``-gamma sin(phi)/w``: with a positive gain, above the absorber's own tuning, a lag
takes damping away (thesis 7.8, Test 1).
"""

import math
from dataclasses import dataclass

import numpy as np

from tuning.loop import LoopFacts, RigModel
from twin.control.schedule import GainSchedule
from twin.plant.config import Plant

EDGE_TOLERANCE_HZ = 0.01


@dataclass(frozen=True, slots=True)
class Instability:
    """Where a schedule's gains are unstable on a model.

    Attributes
    ----------
    from_hz, to_hz
        Excitation frequencies between which they are [Hz]; the table's end where it goes on to there.
    worst_hz, growth_1_s
        Where the slowest pole grows fastest, and how fast: its real part [1/s].
    damping_ns_m
        Of the absorber there, as the model has it.
    law_damping_ns_m
        What the law adds to it, through filters and delay; negative takes damping away.
    meant_damping_ns_m
        What it would add without them: beta.
    """

    from_hz: float
    to_hz: float
    worst_hz: float
    growth_1_s: float
    damping_ns_m: float
    law_damping_ns_m: float
    meant_damping_ns_m: float

    @property
    def explanation(self) -> str:
        """In words, for the log."""
        lost = self.meant_damping_ns_m - self.law_damping_ns_m
        return (
            f"the gains in use are unstable from {self.from_hz:.1f} to {self.to_hz:.1f} Hz: slowest pole "
            f"{self.growth_1_s:+.2f} 1/s at {self.worst_hz:.1f} Hz; there lag in filters and delay makes the law take "
            f"{lost:.1f} Ns/m of damping more than its gains say, {-self.law_damping_ns_m:.1f} Ns/m in all, and the "
            f"absorber has {self.damping_ns_m:.1f} Ns/m"
        )


class StabilityWatch:
    """Growth of a schedule's slowest pole over frequency; what was computed is kept until model or gains change.

    Parameters
    ----------
    facts
        Sampling and delay of the rig's loop.
    same_damping_ns_m
        A pole is not computed again for changes of damping smaller than this.
    """

    def __init__(self, facts: LoopFacts, same_damping_ns_m: float = 0.1) -> None:
        self._facts = facts
        self._same = same_damping_ns_m
        self._known: dict[tuple[float, tuple[float, ...]], tuple[float, float]] = {}

    def growth_1_s(self, plant: Plant, schedule: GainSchedule, frequency_hz: float) -> float:
        """Real part of the slowest pole [1/s] at one excitation frequency; below 0 is stable."""
        absorber = plant.absorber
        gains = schedule.at(frequency_hz)
        damping = absorber.damping_at(frequency_hz) if absorber is not None else 0.0
        key = (frequency_hz, gains.as_tuple())
        known = self._known.get(key)
        if known is not None and abs(known[0] - damping) <= self._same:
            return known[1]
        growth = RigModel(plant, self._facts, frequency_hz).decay_rate_1_s(gains)
        if len(self._known) > 1_000:
            self._known.clear()
        self._known[key] = (damping, growth)
        return growth

    def look(self, plant: Plant, schedule: GainSchedule, from_hz: float, to_hz: float) -> Instability | None:
        """Look for instability at the table's points in a range; where one is found, over the whole table.

        Parameters
        ----------
        from_hz, to_hz
            The excitation now and where it will be by the next look [Hz].
        """
        acting = [f for f in schedule.frequency_hz if schedule.acts_at(f)]
        near = [f for f in acting if from_hz <= f <= to_hz]
        if not any(self.growth_1_s(plant, schedule, f) >= 0.0 for f in near):
            return None
        growth = np.array([self.growth_1_s(plant, schedule, f) for f in acting])
        worst = int(np.argmax(growth))
        first, last = worst, worst
        while first > 0 and growth[first - 1] >= 0.0:
            first -= 1
        while last < len(acting) - 1 and growth[last + 1] >= 0.0:
            last += 1
        low = self._edge(plant, schedule, acting[first - 1], acting[first]) if first else acting[0]
        high = (
            self._edge(plant, schedule, acting[last + 1], acting[last])
            if last < len(acting) - 1
            else acting[-1]
        )
        return self._explained(plant, schedule, low, high, acting[worst], float(growth[worst]))

    def _edge(self, plant: Plant, schedule: GainSchedule, stable_hz: float, unstable_hz: float) -> float:
        """Bisect for where the slowest pole crosses zero [Hz]."""
        while abs(unstable_hz - stable_hz) > EDGE_TOLERANCE_HZ:
            middle = 0.5 * (stable_hz + unstable_hz)
            growth = RigModel(plant, self._facts, middle).decay_rate_1_s(schedule.at(middle))
            stable_hz, unstable_hz = (stable_hz, middle) if growth >= 0.0 else (middle, unstable_hz)
        return unstable_hz

    def _explained(
        self, plant: Plant, schedule: GainSchedule, low: float, high: float, worst: float, growth: float
    ) -> Instability:
        model, gains, w = RigModel(plant, self._facts, worst), schedule.at(worst), math.tau * worst
        path = model.paths(worst, gains.low_pass_hz, gains.high_pass_hz)[0]
        law = complex(path @ np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m]))
        # Force on the absorber per relative displacement x1 - x2; what damps it works against x2' - x1'.
        force = model.coil.force_constant_n_a * law * (1j * w) ** 2
        absorber = plant.absorber
        return Instability(
            from_hz=low,
            to_hz=high,
            worst_hz=worst,
            growth_1_s=growth,
            damping_ns_m=absorber.damping_at(worst) if absorber is not None else 0.0,
            law_damping_ns_m=force.imag / w,
            meant_damping_ns_m=gains.beta_ns_m,
        )
