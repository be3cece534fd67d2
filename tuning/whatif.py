"""What if: the curves over the band for another budget, filter, margin, excitation, damping or coil.

Four lines at every frequency: without control, with the gains in use, with the gains the tuner would propose, and
the least any linear controller could reach. They come from the very functions that tune a rig (`retune`), with what is
costly to set up kept from one change to the next. To follow a slider, gains are first sought next to those of the
question before only: they are verified as all others, and called provisional until the tuner's whole search has
confirmed or bettered them.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from tuning.changes import Changes
from tuning.design import Designer, Start, not_stopped
from tuning.limit import LimitResult, physical_limit
from tuning.loop import LoopFacts, RigModel, margin_grid, margins
from tuning.retune import NoGainsError, Retuner, TuningGoal, predict
from tuning.types import ActiveLimit, OperatingPoint, Powers
from tuning.verify import Situation
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.linear import Array, natural_frequencies_hz

Key = TypeVar("Key")
Value = TypeVar("Value")

MARGIN_POINTS = 200
KEPT_PLANTS, KEPT_TUNERS, KEPT_SITUATIONS, KEPT_ANSWERS = 4, 50, 60, 2_000

NEAREST = 2
"""Places next to which gains are sought when a slider is followed: the question before, the frequency before."""


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
    provisional
        Whether ``proposed`` was sought next to the gains of the last question only: what it states is verified, but
        the tuner's whole search may find better, or any.
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
    provisional: bool = False


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
        self._designers: dict[str, Designer] = {}
        self._tuners: dict[tuple[str, TuningGoal], Retuner] = {}
        self._grids: dict[str, Array] = {}
        self._situations: dict[_Place, Situation] = {}
        self._as_used: dict[tuple[_Place, Gains | None], Design] = {}
        self._answers: dict[_Asked, _Answer] = {}
        self._last: dict[float, tuple[_Place, tuple[float, float], Start]] = {}
        self._tuner(plant, plant.fingerprint, goal)

    def begin_like(self, other: "WhatIf") -> None:
        """Seek quick answers next to what another one found last, of a rig that differs little."""
        self._last = dict(other._last)

    def curves(
        self,
        frequencies_hz: Sequence[float],
        changes: Changes | None = None,
        *,
        propose: bool = True,
        quick: bool = False,
        go_on: Callable[[], None] = not_stopped,
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
        quick
            Seek the proposed gains next to those of the question before; such points are ``provisional``.
        go_on
            Called between searches; what it raises ends this, and nothing of what was worked out is lost.

        Raises
        ------
        InputError
            If a change is not possible with this plant.
        """
        changes = changes or Changes()
        plant = changes.plant(self.plant)
        fingerprint = plant.fingerprint
        goal = changes.goal(self.goal)
        asked = _Band(
            plant,
            fingerprint,
            goal,
            changes.amplitude or self.amplitude,
            changes,
            changes.table(self.schedule, frequencies_hz),
            self._tuner(plant, fingerprint, goal),
        )
        points = [self._point(asked, f, propose, quick, go_on) for f in frequencies_hz]
        return Curves(tuple(points), goal, asked.amplitude)

    def _point(
        self, asked: "_Band", f: float, propose: bool, quick: bool, go_on: Callable[[], None]
    ) -> CurvePoint:
        plant, changes = asked.plant, asked.changes
        place = _Place(asked.fingerprint, f, asked.amplitude, asked.goal.drift_hz)
        situation = self._situation(plant, place)
        acts = changes.acts(self.schedule, f)
        in_use = self._design_in_use(plant, place, situation, self.schedule.at(f) if acts else None)
        found = _Answer(None, None, "")
        if propose and acts:
            found = self._proposed(asked, place, situation, quick, go_on)
        elif propose:
            found = _Answer(in_use, None, "")
        best: OperatingPoint | LimitResult | None = found.point
        reason = found.reason
        if best is None or changes.power_price_um_w is not None:
            try:
                best = physical_limit(situation.paths, asked.tuner.limits)
            except RunError as error:
                reason = reason or str(error)
        limit_m, active = _limit_of(best)
        return CurvePoint(
            frequency_hz=f,
            damping_ns_m=plant.absorber.damping_at(f) if plant.absorber is not None else 0.0,
            passive_m=abs(situation.paths.motion[1]),
            limit_m=limit_m,
            in_use=in_use,
            proposed=found.design,
            active_limits=active,
            reason=reason,
            provisional=found.provisional,
        )

    def _proposed(
        self, asked: "_Band", place: "_Place", situation: Situation, quick: bool, go_on: Callable[[], None]
    ) -> "_Answer":
        f, price = place.frequency_hz, asked.changes.power_price_um_w
        tuner = asked.tuner if price is None else self._priced(asked, situation, f, price)
        meant = asked.table.at(f)
        question = _Asked(place, tuner.goal, meant)
        known = self._answers.get(question)
        if known is not None and (quick or not known.provisional):
            return known
        cutoffs = meant.low_pass_hz, meant.high_pass_hz
        near = self._near(place, meant) if quick else None
        try:
            point, searched = tuner.settle(situation, meant, near, go_on)
        except NoGainsError as error:
            answer = _Answer(None, None, f"{f:g} Hz: {error}", quick)
        else:
            answer = _Answer(self._design_of(situation, point), point, "", quick)
            if searched is not None:
                self._last[f] = place, cutoffs, Start(searched.found.numbers, searched, tuner.demands)
        _keep(self._answers, question, answer, KEPT_ANSWERS)
        return answer

    def _near(self, place: "_Place", meant: Gains) -> list[Start]:
        """What was found last at this frequency, and next to it; the gains in use where nothing was."""
        out = []
        for f in sorted(self._last, key=lambda f: abs(f - place.frequency_hz))[:NEAREST]:
            where, cutoffs, start = self._last[f]
            same = where == place and cutoffs == (meant.low_pass_hz, meant.high_pass_hz)
            out.append(start if same else Start(start.numbers))
        if place.frequency_hz not in self._last:
            out.append(Start(np.array([meant.alpha_kg, meant.beta_ns_m, meant.gamma_n_m])))
        return out

    def _design_in_use(
        self, plant: Plant, place: "_Place", situation: Situation, gains: Gains | None
    ) -> Design:
        known = self._as_used.get((place, gains))
        if known is None:
            grid = self._grids.get(place.fingerprint)
            if grid is None:
                modes = natural_frequencies_hz(plant)
                grid = margin_grid(self.facts.sample_rate_hz, modes, MARGIN_POINTS)
                _keep(self._grids, place.fingerprint, grid, KEPT_PLANTS)
            known = design_at(situation.models[0], gains, place.frequency_hz, place.amplitude, grid)
            _keep(self._as_used, (place, gains), known, KEPT_ANSWERS)
        return known

    @staticmethod
    def _design_of(situation: Situation, point: OperatingPoint) -> Design:
        return Design(
            gains=point.gains,
            growth_1_s=situation.decay_rates_1_s(point.gains)[0],
            modulus_margin=point.modulus_margin,
            delay_margin_s=point.delay_margin_s,
            displacement_m=point.predicted_displacement_m,
            current_peak_a=point.current_peak_a,
            powers=point.powers,
        )

    def _priced(self, asked: "_Band", situation: Situation, f: float, price: float) -> Retuner:
        """Tuner whose budget ends where another watt would buy less than the price [µm/W]."""
        motion, current = situation.paths.motion, situation.paths.current
        per_ampere = abs(motion[0] / current[0])
        resistance = situation.paths.resistance_ohm
        # |x1| falls by |g| per ampere of peak current, and P = R i²/2: a watt buys |g|/(R i).
        ampere = per_ampere / (resistance * 1e-6 * price)
        watt = max(0.5 * resistance * ampere**2, 1e-6)
        if watt >= asked.goal.joule_mean_w:
            return asked.tuner
        priced = replace(asked.goal, budget_w=watt, budget_kind="joule_mean")
        return self._tuner(asked.plant, asked.fingerprint, priced)

    def _tuner(self, plant: Plant, fingerprint: str, goal: TuningGoal) -> Retuner:
        known = self._tuners.get((fingerprint, goal))
        if known is None:
            known = Retuner(plant, self.facts, goal, self._designers.get(fingerprint))
            _keep(self._designers, fingerprint, known.designer, KEPT_PLANTS)
            _keep(self._tuners, (fingerprint, goal), known, KEPT_TUNERS)
        return known

    def _situation(self, plant: Plant, place: "_Place") -> Situation:
        known = self._situations.get(place)
        if known is None:
            alike = next((s for p, s in self._situations.items() if p.is_like(place)), None)
            known = (
                alike.scaled(place.amplitude)
                if alike is not None
                else Situation(
                    plant,
                    self.facts,
                    place.frequency_hz,
                    place.amplitude,
                    self.damping_std_ns_m,
                    place.drift_hz,
                )
            )
            _keep(self._situations, place, known, KEPT_SITUATIONS)
        return known


@dataclass(frozen=True, slots=True)
class _Place:
    """What a `Situation` depends on: plant, excitation and drift."""

    fingerprint: str
    frequency_hz: float
    amplitude: float
    drift_hz: float

    def is_like(self, other: "_Place") -> bool:
        """Whether nothing but the excitation's size differs."""
        return replace(self, amplitude=other.amplitude) == other


@dataclass(frozen=True, slots=True)
class _Asked:
    place: _Place
    goal: TuningGoal
    meant: Gains


@dataclass(frozen=True, slots=True)
class _Answer:
    design: Design | None
    point: OperatingPoint | None
    reason: str
    provisional: bool = False


@dataclass(frozen=True, slots=True)
class _Band:
    """What is the same at all frequencies of a question."""

    plant: Plant
    fingerprint: str
    goal: TuningGoal
    amplitude: float
    changes: Changes
    table: GainSchedule
    tuner: Retuner


def _keep(known: dict[Key, Value], key: Key, value: Value, most: int) -> None:
    """Remember something; the oldest goes."""
    if key not in known and len(known) >= most:
        known.pop(next(iter(known)))
    known[key] = value


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
