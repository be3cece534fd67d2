"""Verify, then propose: gains for the operating points around the present excitation, inside a power budget.

Per point: the physical limit (`limit`), the gains of the rig's own law that come nearest to it (`search`), and then,
from the deployed numbers alone on the full sampled model, everything a proposal states (`verify`). Gains in use that
keep all of it stay unless the new ones are better by more than a stated amount.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from tuning.design import Design, Designer, Start, not_stopped
from tuning.limit import CoilLimits, LimitResult, least_power, physical_limit
from tuning.loop import LoopFacts, Margins
from tuning.steady import Prediction, SteadyPaths, predict
from tuning.types import ActiveLimit, BudgetKind, OperatingPoint, Proposal, Refusal
from tuning.verify import Demands, Situation, Verdict, verify
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError

__all__ = ["Prediction", "Retuner", "TuningGoal", "predict"]

SAME_DAMPING_NS_M = 0.06
SAME_AMPLITUDE = 5e-3
"""A point is not solved again for changes smaller than these: gains would move by less than a thousandth."""

BETTER_SHARE, BETTER_OF_PASSIVE = 0.01, 1e-3
"""New gains replace sound ones in use only for so much less motion, of what is left and of the passive one."""


@dataclass(frozen=True, slots=True)
class TuningGoal:
    """What the operator asks of the tuner.

    Attributes
    ----------
    budget_w, budget_kind
        Coil power that may be spent, and which power that is: ``joule_mean`` is R i_rms², ``joule_peak`` R i_peak²,
        ``electrical`` the mean of v i at the coil's terminals.
    modulus_margin
        Least distance of the loop gain from -1.
    reach_hz
        Table points this near to the excitation are retuned.
    drift_hz
        The budget holds with the excitation this much off the point's.
    slowest_decay_1_s
        Every closed-loop pole decays at least this fast.
    delay_margin_s
        Further delay the loop must stand, beside its own [s].
    displacement_m
        Primary motion that is enough [m]: reached with the least power, instead of the least motion for the budget.
    """

    budget_w: float = 4.0
    budget_kind: BudgetKind = "joule_mean"
    modulus_margin: float = 0.15
    reach_hz: float = 1.0
    drift_hz: float = 0.25
    slowest_decay_1_s: float = 0.5
    delay_margin_s: float = 0.0
    displacement_m: float | None = None

    @property
    def joule_mean_w(self) -> float:
        """The budget as mean Joule power, half of the peak for a sine; infinite if it bounds another power."""
        if self.budget_kind == "electrical":
            return math.inf
        return 0.5 * self.budget_w if self.budget_kind == "joule_peak" else self.budget_w


@dataclass(frozen=True, slots=True)
class _Question:
    """What the answer for one point of the table depends on."""

    frequency_hz: float
    damping_ns_m: float
    damping_std_ns_m: float
    amplitude: float
    cutoffs_hz: tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Solved:
    """A verified point and the question it answers."""

    question: _Question
    point: OperatingPoint

    def answers(self, new: _Question) -> bool:
        """Whether the new question differs by less than would change the answer noticeably."""
        old = self.question
        return (
            new.frequency_hz == old.frequency_hz
            and new.cutoffs_hz == old.cutoffs_hz
            and abs(new.damping_ns_m - old.damping_ns_m) <= SAME_DAMPING_NS_M
            and new.damping_std_ns_m <= old.damping_std_ns_m + SAME_DAMPING_NS_M
            and abs(new.amplitude / old.amplitude - 1.0) <= SAME_AMPLITUDE
        )


class NoGainsError(RunError):
    """No gains may be proposed at a point."""

    def __init__(self, reason: str, binding: tuple[str, ...], least_budget_w: float | None = None) -> None:
        super().__init__(reason)
        self.binding, self.least_budget_w = binding, least_budget_w


class Retuner:
    """Propose gains for the points of a schedule's table.

    Parameters
    ----------
    plant
        Gives bodies, coil and the limits the proposals keep.
    facts
        Sampling and delay of the rig's loop.
    goal
        Budget and margin.
    designer
        Of the same plant, shared between goals; None makes one.

    Raises
    ------
    InputError
        If the plant states no limit on the coil's current or stroke: without them nothing may be proposed.
    """

    def __init__(
        self, plant: Plant, facts: LoopFacts, goal: TuningGoal, designer: Designer | None = None
    ) -> None:
        _check(plant, goal)
        coil = plant.voice_coil
        if coil is None:
            raise InputError(f"plant '{plant.name}' has no voice coil")
        self.plant, self.facts, self.goal = plant, facts, goal
        self._limits = CoilLimits(
            joule_mean_w=min(goal.joule_mean_w, plant.limits.get(f"{coil.name}_power_w", math.inf)),
            current_peak_a=plant.limits[f"{coil.name}_current_a"],
            stroke_m=plant.limits["stroke_m"],
            resistance_ohm=coil.resistance_ohm,
            voltage_peak_v=plant.limits.get(f"{coil.name}_voltage_v", math.inf),
            electrical_mean_w=goal.budget_w if goal.budget_kind == "electrical" else math.inf,
        )
        self._demands = Demands(
            self._limits,
            goal.modulus_margin,
            goal.delay_margin_s,
            goal.slowest_decay_1_s,
            goal.displacement_m,
        )
        self._designer = Designer(plant) if designer is None else designer
        self._solved: dict[int, _Solved] = {}

    def propose(
        self,
        sample: int,
        plant: Plant,
        damping_std_ns_m: float,
        excitation_hz: float,
        excitation_amplitude: float,
        schedule: GainSchedule,
        ahead_hz: float = 0.0,
    ) -> Proposal:
        """Retune the table's points around the excitation, and those it is about to pass.

        Parameters
        ----------
        sample
            Last sample the model has seen.
        plant
            The plant as identified, damping in use included.
        damping_std_ns_m
            Standard deviation of its damping near the excitation [Ns/m].
        excitation_hz, excitation_amplitude
            Of the excitation: frequency [Hz] and peak, in the exciting actuator's unit.
        schedule
            The one in use; cutoffs are kept.
        ahead_hz
            How far the excitation will have moved when the next proposal could take effect [Hz].
        """
        low, high = sorted((excitation_hz, excitation_hz + ahead_hz))
        points: list[tuple[int, OperatingPoint]] = []
        refusals: list[tuple[int, Refusal]] = []
        for row, frequency in enumerate(schedule.frequency_hz):
            if not low - self.goal.reach_hz <= frequency <= high + self.goal.reach_hz:
                continue
            in_use = schedule.at(frequency)
            situation = self._situation(plant, damping_std_ns_m, frequency, excitation_amplitude)
            question = _question(plant, damping_std_ns_m, frequency, excitation_amplitude, in_use)
            known = self._solved.get(row)
            try:
                if known is not None and known.answers(question):
                    point = known.point
                else:
                    point, _ = self._point(situation, in_use)
                    self._solved[row] = _Solved(question, point)
            except NoGainsError as error:
                stays = self._in_use_without_better(situation, in_use)
                if stays is not None:
                    points.append((row, stays))
                    continue
                reason = f"{frequency:g} Hz: {error}"
                refusals.append((row, Refusal(frequency, error.binding, reason, error.least_budget_w)))
                continue
            points.append((row, self._or_in_use(situation, in_use, point)))
        reason = "; ".join(r.reason for _, r in refusals)
        if not points and not refusals:
            reason = f"no point of the table lies within {self.goal.reach_hz:g} Hz of {excitation_hz:.2f} Hz"
        return Proposal(
            made_at_sample=sample,
            model_id=plant.fingerprint,
            feasible=bool(points),
            reason=reason,
            budget_w=self.goal.budget_w,
            budget_kind=self.goal.budget_kind,
            points=tuple(points),
            refusals=tuple(refusals),
        )

    @property
    def demands(self) -> Demands:
        """What gains must keep."""
        return self._demands

    @property
    def designer(self) -> Designer:
        """Of this plant; what it answers depends on nothing it was asked before."""
        return self._designer

    @property
    def limits(self) -> CoilLimits:
        """What the coil must keep: the plant's limits and the budget."""
        return self._limits

    def passive_m(self, plant: Plant, frequency_hz: float, amplitude: float) -> float:
        """Motion of the primary without control [m]."""
        return abs(Situation(plant, self.facts, frequency_hz, amplitude, 0.0, 0.0).paths.motion[1])

    def limit_at(self, plant: Plant, frequency_hz: float, amplitude: float) -> LimitResult:
        """Physical limit at one frequency.

        Raises
        ------
        RunError
            If no current keeps the limits.
        """
        situation = Situation(plant, self.facts, frequency_hz, amplitude, 0.0, 0.0)
        return physical_limit(situation.paths, self._limits)

    def point(
        self, plant: Plant, damping_std_ns_m: float, frequency_hz: float, amplitude: float, in_use: Gains
    ) -> OperatingPoint:
        """Verified gains for one operating point, with the cutoffs of those in use.

        Parameters
        ----------
        plant, damping_std_ns_m, frequency_hz, amplitude
            As `propose`.
        in_use
            Gives the cutoffs; its gains do not matter here.

        Raises
        ------
        NoGainsError
            If nothing may be proposed; it names what binds, and the least budget that would do.
        """
        return self._point(self._situation(plant, damping_std_ns_m, frequency_hz, amplitude), in_use)[0]

    def settle(
        self,
        situation: Situation,
        in_use: Gains,
        near: Sequence[Start] | None = None,
        go_on: Callable[[], None] = not_stopped,
    ) -> tuple[OperatingPoint, Design | None]:
        """What `propose` proposes for one operating point, in a situation that is there already.

        Parameters
        ----------
        situation
            With the goal's drift.
        in_use
            Gains in use, behind the cutoffs that are meant.
        near
            Where to search and nowhere else, such as at the gains of questions that differ little: the first start with
            verified gains in its neighbourhood is taken. Better ones farther off may be missed.
        go_on
            Called between searches; what it raises ends this.

        Returns
        -------
        tuple
            The point, and the design behind it; None where the gains in use stay because nothing was found.

        Raises
        ------
        NoGainsError
            If nothing may be proposed; with ``near`` only: if nothing is known yet.
        """
        try:
            if near is None:
                point, design = self._point(situation, in_use, go_on)
            else:
                point, design = self._nearby(situation, in_use, near, go_on)
        except NoGainsError:
            stays = self._in_use_without_better(situation, in_use)
            if stays is None:
                raise
            return stays, None
        return self._or_in_use(situation, in_use, point), design

    def _nearby(
        self, situation: Situation, in_use: Gains, near: Sequence[Start], go_on: Callable[[], None]
    ) -> tuple[OperatingPoint, Design]:
        try:
            best = physical_limit(situation.paths, self._limits)
        except RunError as error:
            raise NoGainsError(str(error), ()) from error
        cutoffs, trouble = (in_use.low_pass_hz, in_use.high_pass_hz), "not worked out yet"
        for start in near:
            known = start.design
            if known is not None and start.still_holds(self._demands):
                verdict = verify(situation, known.gains, self._demands)
                if not verdict.trouble:
                    active = (*best.active, *known.active)
                    return self._describe(situation, known.gains, best, verdict, active, kept=False), known
            # The poles cost the search most and seldom bind: they are looked at afterwards, and if need be on the way.
            for slowest in (0.0, self._demands.slowest_decay_1_s):
                demands = replace(self._demands, slowest_decay_1_s=slowest)
                design = self._designer.design(
                    situation, cutoffs, demands, best.reference_a, near=start, go_on=go_on
                )
                verdict = verify(situation, design.gains, self._demands)
                if verdict.broken != "decay":
                    break
            if not verdict.trouble:
                active = (*best.active, *design.active)
                return self._describe(situation, design.gains, best, verdict, active, kept=False), design
            trouble = verdict.trouble
        raise NoGainsError(trouble, ())

    def _point(
        self, situation: Situation, in_use: Gains, go_on: Callable[[], None] = not_stopped
    ) -> tuple[OperatingPoint, Design]:
        try:
            best = physical_limit(situation.paths, self._limits)
        except RunError as error:
            raise self._without_a_limit(situation, str(error)) from error
        cutoffs = in_use.low_pass_hz, in_use.high_pass_hz
        wanted = self.goal.displacement_m
        if wanted is not None and wanted < best.displacement_m:
            reason = f"displacement {1e6 * wanted:.4g} µm: no linear controller leaves less than "
            reason += f"{1e6 * best.displacement_m:.4g} µm inside the limits"
            names = tuple(a.name for a in best.active)
            raise self._unsolved(
                situation, cutoffs, best, Verdict(reason, "displacement", Margins(0.0, None), 0.0, ()), names
            )
        design = self._designer.design(situation, cutoffs, self._demands, best.reference_a, go_on=go_on)
        verdict = verify(situation, design.gains, self._demands)
        if verdict.trouble:
            raise self._unsolved(situation, cutoffs, best, verdict, go_on=go_on)
        active = (*best.active, *design.active)
        return self._describe(situation, design.gains, best, verdict, active, kept=False), design

    def _situation(self, plant: Plant, std: float, frequency: float, amplitude: float) -> Situation:
        return Situation(plant, self.facts, frequency, amplitude, std, self.goal.drift_hz)

    def _describe(
        self,
        situation: Situation,
        gains: Gains,
        best: LimitResult,
        verdict: Verdict,
        active: tuple[ActiveLimit, ...],
        *,
        kept: bool,
    ) -> OperatingPoint:
        p, kind = verdict.predictions[0], self.goal.budget_kind
        # The excitation's own frequency on every model: what not knowing the damping leaves open.
        alike = [
            q
            for (_, paths), q in zip(situation.cases, verdict.predictions, strict=True)
            if paths.frequency_hz == situation.frequency_hz
        ]
        sizes = [q.displacement_m for q in alike]
        spent = [q.powers.of_kind(kind) for q in alike]
        least = None
        if self.goal.displacement_m is not None:
            least = least_power(situation.paths, self._limits, self.goal.displacement_m, kind).power_w
        return OperatingPoint(
            frequency_hz=situation.frequency_hz,
            gains=gains,
            predicted_displacement_m=p.displacement_m,
            passive_displacement_m=abs(situation.paths.motion[1]),
            limit_displacement_m=best.displacement_m,
            stroke_m=p.stroke_m,
            current_peak_a=p.current_peak_a,
            powers=p.powers,
            modulus_margin=verdict.margins.modulus,
            delay_margin_s=verdict.margins.delay_s,
            active_limits=active,
            voltage_peak_v=p.voltage_peak_v,
            decay_rate_1_s=verdict.decay_rate_1_s,
            damping_std_ns_m=situation.damping_std_ns_m,
            displacement_range_m=(min(sizes), max(sizes)),
            power_range_w=(min(spent), max(spent)),
            kept=kept,
            least_power_w=least,
        )

    def _or_in_use(self, situation: Situation, in_use: Gains, point: OperatingPoint) -> OperatingPoint:
        """Return the point or, if they are sound and hardly worse, the gains in use with what is predicted of them."""
        if in_use == point.gains:
            return replace(point, kept=True)
        verdict = verify(situation, in_use, self._demands)
        if verdict.trouble:
            return point
        now, new = verdict.predictions[0], situation.predictions(point.gains)[0]
        if self.goal.displacement_m is None:
            gained = now.displacement_m - new.displacement_m
            enough = BETTER_SHARE * now.displacement_m, BETTER_OF_PASSIVE * abs(situation.paths.motion[1])
        else:
            kind = self.goal.budget_kind
            gained = now.powers.of_kind(kind) - new.powers.of_kind(kind)
            enough = BETTER_SHARE * abs(now.powers.of_kind(kind)), BETTER_OF_PASSIVE * self.goal.budget_w
        if gained > max(enough):
            return point
        best = LimitResult(0j, point.limit_displacement_m, ())
        return self._describe(situation, in_use, best, verdict, point.active_limits, kept=True)

    def _in_use_without_better(self, situation: Situation, in_use: Gains) -> OperatingPoint | None:
        """Gains in use that keep everything, where the search found none that do; None if they do not."""
        verdict = verify(situation, in_use, self._demands)
        if verdict.trouble:
            return None
        best = physical_limit(situation.paths, self._limits)
        return self._describe(situation, in_use, best, verdict, best.active, kept=True)

    def _without_a_limit(self, situation: Situation, reason: str) -> NoGainsError:
        """The limits exclude each other: say which, and what power would do."""
        names = tuple(re.split(r" and |, ", reason.split(":", maxsplit=1)[0]))
        needed = self._least_for_limits(situation.paths, math.inf)
        return NoGainsError(reason + self._remedy(needed), names, needed)

    def _least_for_limits(self, paths: SteadyPaths, displacement_m: float) -> float | None:
        try:
            found = least_power(paths, self._limits, displacement_m, self.goal.budget_kind)
        except RunError:
            return None
        return found.power_w

    def _unsolved(
        self,
        situation: Situation,
        cutoffs: tuple[float, float],
        best: LimitResult,
        verdict: Verdict,
        binding: tuple[str, ...] = (),
        go_on: Callable[[], None] = not_stopped,
    ) -> NoGainsError:
        """No gains of the law keep everything: say what binds, and the least budget with which some do."""
        if verdict.broken not in ("power", "electrical", "displacement", "stroke", "current", "voltage"):
            return NoGainsError(verdict.trouble, (verdict.broken,))
        frugal = self._designer.least_power(
            situation, cutoffs, self._demands, best.reference_a, self.goal.budget_kind, go_on=go_on
        )
        needed: float | None = None
        if frugal is not None:
            free = replace(self._limits, joule_mean_w=math.inf, electrical_mean_w=math.inf)
            check = verify(situation, frugal, replace(self._demands, limits=free))
            if not check.trouble:
                needed = max(p.powers.of_kind(self.goal.budget_kind) for p in check.predictions)
        return NoGainsError(verdict.trouble + self._remedy(needed), binding or (verdict.broken,), needed)

    def _remedy(self, needed: float | None) -> str:
        kind = self.goal.budget_kind.replace("_", " ")
        if needed is None:
            return "; no budget alone would do"
        if needed <= self.goal.budget_w:
            return ""
        return f"; the least budget that would do is {needed:.3g} W {kind}"


def _question(
    plant: Plant, damping_std: float, frequency: float, amplitude: float, gains: Gains
) -> _Question:
    absorber = plant.absorber
    return _Question(
        frequency_hz=frequency,
        damping_ns_m=absorber.damping_at(frequency) if absorber is not None else 0.0,
        damping_std_ns_m=damping_std,
        amplitude=amplitude,
        cutoffs_hz=(gains.low_pass_hz, gains.high_pass_hz),
    )


def _check(plant: Plant, goal: TuningGoal) -> None:
    coil, absorber = plant.voice_coil, plant.absorber
    if coil is None or absorber is None:
        raise InputError(
            f"plant '{plant.name}' has no voice coil on an absorber: there is nothing to retune; give it an "
            '[[actuator]] with kind = "voice_coil" between two bodies'
        )
    if coil.current_loop_kp_v_a is None:
        raise InputError(
            f"plant '{plant.name}': actuator '{coil.name}' needs current_loop_kp_v_a [V/A]: the rig's law commands a "
            "current; add it to the plant file"
        )
    if len(plant.actuator) < 2:
        raise InputError(
            f"plant '{plant.name}' has no actuator that excites it; add an [[actuator]] such as kind = \"force\""
        )
    for key in (f"{coil.name}_current_a", "stroke_m"):
        if key not in plant.limits:
            raise InputError(
                f"plant '{plant.name}': limits.{key} [{plant.limit_units[key]}] is missing; without it no gains "
                "are proposed; add it to the plant file"
            )
    for name, value, unit in (
        ("budget_w", goal.budget_w, "W"),
        ("displacement_m", 1.0 if goal.displacement_m is None else goal.displacement_m, "m"),
    ):
        if not 0.0 < value < math.inf:
            raise InputError(f"{name} must be greater than 0 {unit}, got {value}")
    if not 0.0 <= goal.modulus_margin < 1.0:
        raise InputError(f"modulus_margin must be from 0 to below 1, got {goal.modulus_margin}")
    for name, value in (
        ("slowest_decay_1_s", goal.slowest_decay_1_s),
        ("delay_margin_s", goal.delay_margin_s),
        ("drift_hz", goal.drift_hz),
    ):
        if not 0.0 <= value < math.inf:
            raise InputError(f"{name} must not be below 0, got {value}")
