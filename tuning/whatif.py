"""What if: the curves over the band for another budget, filter, margin, excitation, damping or coil.

Four lines at every frequency: without control, with the gains in use, with the gains the tuner would propose, and
the least any linear controller could reach. They come from the very functions that tune a rig (`retune`), with what is
costly to set up kept from one change to the next, so that a slider can be followed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from tuning.changes import Changes
from tuning.limit import LimitResult
from tuning.loop import LoopFacts, RigModel, margin_grid, margins
from tuning.retune import Retuner, TuningGoal, predict
from tuning.types import ActiveLimit, OperatingPoint, Powers
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.linear import Array, natural_frequencies_hz

MARGIN_POINTS = 200
KEPT_MODELS = 400
KEPT_TUNERS = 20


@dataclass(frozen=True, slots=True)
class Design:
    """One set of gains at one frequency, as the full model has it.

    Attributes
    ----------
    gains
        None where the controller is off.
    growth_1_s
        Real part of the slowest pole [1/s]; below 0 is stable.
    displacement_m, current_peak_a, powers
        In steady state; None where there is none, the loop being unstable.
    """

    gains: Gains | None
    growth_1_s: float
    modulus_margin: float | None
    delay_margin_s: float | None
    displacement_m: float | None
    current_peak_a: float | None
    powers: Powers | None

    @property
    def stable(self) -> bool:
        """Whether every pole decays."""
        return self.growth_1_s < 0.0


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """All lines at one excitation frequency.

    Attributes
    ----------
    damping_ns_m
        Of the absorber, as used.
    limit_m
        None if no current keeps the limits.
    proposed
        None where nothing may be deployed, or nothing was asked for; ``reason`` says why.
    active_limits
        Limits that bind, with their price [m per unit of the limit].
    """

    frequency_hz: float
    damping_ns_m: float
    passive_m: float
    limit_m: float | None
    in_use: Design
    proposed: Design | None
    active_limits: tuple[ActiveLimit, ...]
    reason: str


@dataclass(frozen=True, slots=True)
class Curves:
    """What-if over a band, with the goal it was asked for."""

    points: tuple[CurvePoint, ...]
    goal: TuningGoal
    amplitude: float


class WhatIf:
    """Answers what-if questions about one rig.

    Parameters
    ----------
    plant
        As identified, the damping in use included.
    facts
        Sampling and delay of the rig's loop.
    schedule
        Gains in use.
    goal
        In use.
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    damping_std_ns_m
        Standard deviation of the damping [Ns/m]; proposals hold two of them off.

    Raises
    ------
    InputError
        If the plant has no voice coil on an absorber or misses limits.
    """

    def __init__(
        self,
        plant: Plant,
        facts: LoopFacts,
        schedule: GainSchedule,
        goal: TuningGoal,
        amplitude: float,
        damping_std_ns_m: float = 0.0,
    ) -> None:
        if not (math.isfinite(amplitude) and amplitude > 0.0):
            raise InputError(f"the excitation's peak must be greater than 0, got {amplitude}")
        self.plant, self.facts, self.schedule, self.goal = plant, facts, schedule, goal
        self.amplitude, self.damping_std_ns_m = amplitude, damping_std_ns_m
        self._tuners: dict[tuple[str, TuningGoal], Retuner] = {}
        self._models: dict[tuple[str, float], RigModel] = {}
        self._tuner(plant, goal)

    def curves(
        self, frequencies_hz: Sequence[float], changes: Changes | None = None, *, propose: bool = True
    ) -> Curves:
        """All lines over a band.

        Parameters
        ----------
        frequencies_hz
            (n,) ascending [Hz].
        changes
            What is different; None for things as they are.
        propose
            False leaves the proposed gains out, which take most of the time.

        Raises
        ------
        InputError
            If a change is not possible with this plant.
        """
        changes = changes or Changes()
        plant = changes.plant(self.plant)
        goal = changes.goal(self.goal)
        amplitude = changes.amplitude or self.amplitude
        fingerprint = plant.fingerprint
        table = changes.table(self.schedule, frequencies_hz)
        grid = margin_grid(self.facts.sample_rate_hz, natural_frequencies_hz(plant), MARGIN_POINTS)
        tuner = self._tuner(plant, goal)
        points = []
        for f in frequencies_hz:
            model = self._model(plant, fingerprint, f)
            acts = changes.acts(self.schedule, f)
            in_use = design_at(model, self.schedule.at(f) if acts else None, f, amplitude, grid)
            proposed, reason = None, ""
            best: OperatingPoint | LimitResult | None = None
            if propose and acts:
                price = changes.power_price_um_w
                at = tuner if price is None else self._priced(plant, goal, model, f, amplitude, price)
                proposed, best, reason = self._proposed(at, plant, model, table, f, amplitude)
            elif propose:
                proposed = in_use
            if best is None or changes.power_price_um_w is not None:
                try:
                    best = tuner.limit_at(plant, f, amplitude)
                except RunError as error:
                    reason = reason or str(error)
            limit_m, active = _limit_of(best)
            points.append(
                CurvePoint(
                    frequency_hz=f,
                    damping_ns_m=plant.absorber.damping_at(f) if plant.absorber is not None else 0.0,
                    passive_m=float(abs(model.response(f)[0, 0, 1]) * amplitude),
                    limit_m=limit_m,
                    in_use=in_use,
                    proposed=proposed,
                    active_limits=active,
                    reason=reason,
                )
            )
        return Curves(tuple(points), goal, amplitude)

    def _proposed(
        self, tuner: Retuner, plant: Plant, model: RigModel, table: GainSchedule, f: float, amplitude: float
    ) -> tuple[Design | None, OperatingPoint | None, str]:
        proposal = tuner.propose(0, plant, self.damping_std_ns_m, f, amplitude, table)
        for _, point in proposal.points:
            if point.frequency_hz == f:
                return (
                    Design(
                        gains=point.gains,
                        growth_1_s=model.decay_rate_1_s(point.gains),
                        modulus_margin=point.modulus_margin,
                        delay_margin_s=point.delay_margin_s,
                        displacement_m=point.predicted_displacement_m,
                        current_peak_a=point.current_peak_a,
                        powers=point.powers,
                    ),
                    point,
                    "",
                )
        return None, None, proposal.reason

    def _priced(
        self, plant: Plant, goal: TuningGoal, model: RigModel, f: float, amplitude: float, price: float
    ) -> Retuner:
        """Tuner whose budget ends where another watt would buy less than the price [µm/W]."""
        motion, _, _, current = model.response(f)[0]
        per_ampere = abs(motion[0] / current[0])
        resistance = model.coil.resistance_ohm
        # |x1| falls by |g| per ampere of peak current, and P = R i²/2: a watt buys |g|/(R i).
        ampere = per_ampere / (resistance * 1e-6 * price)
        watt = max(0.5 * resistance * ampere**2, 1e-6)
        if watt >= goal.joule_mean_w:
            return self._tuner(plant, goal)
        return self._tuner(plant, replace(goal, budget_w=watt, budget_kind="joule_mean"))

    def _tuner(self, plant: Plant, goal: TuningGoal) -> Retuner:
        # One point at a time: the others are asked for in their turn.
        goal = replace(goal, reach_hz=1e-6)
        key = (plant.fingerprint, goal)
        if key not in self._tuners:
            if len(self._tuners) >= KEPT_TUNERS:
                self._tuners.pop(next(iter(self._tuners)))
            self._tuners[key] = Retuner(plant, self.facts, goal)
        return self._tuners[key]

    def _model(self, plant: Plant, fingerprint: str, f: float) -> RigModel:
        key = (fingerprint, f)
        if key not in self._models:
            if len(self._models) >= KEPT_MODELS:
                self._models.pop(next(iter(self._models)))
            self._models[key] = RigModel(plant, self.facts, f)
        return self._models[key]


def _limit_of(
    best: OperatingPoint | LimitResult | None,
) -> tuple[float | None, tuple[ActiveLimit, ...]]:
    match best:
        case OperatingPoint():
            return best.limit_displacement_m, best.active_limits
        case LimitResult():
            return best.displacement_m, best.active
        case None:
            return None, ()


def design_at(
    model: RigModel, gains: Gains | None, frequency_hz: float, amplitude: float, grid: Array
) -> Design:
    """Steady state, poles and margins of a set of gains, or of the controller off.

    Parameters
    ----------
    grid
        (n,) frequencies for the margins [Hz], see `margin_grid`.
    """
    off = Gains(0.0, 0.0, 0.0, 200.0, 1.0)
    growth = model.decay_rate_1_s(gains or off)
    if not growth < 0.0:
        return Design(gains, growth, None, None, None, None, None)
    now = predict(model, gains or off, frequency_hz, amplitude)
    modulus: float | None = None
    delay: float | None = None
    if gains is not None:
        found = margins(model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid, gains)
        modulus, delay = found.modulus, found.delay_s
    return Design(gains, growth, modulus, delay, now.displacement_m, now.current_peak_a, now.powers)
