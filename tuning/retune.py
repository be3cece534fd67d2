"""Verify, then propose: gains for the operating points around the present excitation, inside a power budget.

Per point: the physical limit (`limit`), the gains of the rig's own law nearest to it with a modulus margin
(`gains`), and then, from the deployed numbers alone on the full sampled model, everything a proposal states:
poles, margins, motion, powers, at the excitation and beside it, at the damping and two standard deviations off.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tuning.gains import GainProgram
from tuning.limit import CoilLimits, LimitProblem, LimitResult
from tuning.loop import LoopFacts, Margins, RigModel, margin_grid, margins
from tuning.types import BudgetKind, OperatingPoint, Powers, Proposal
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.linear import ComplexArray, natural_frequencies_hz

SAME_DAMPING_NS_M = 0.06
SAME_AMPLITUDE = 5e-3
"""A point is not solved again for changes smaller than these: gains would move by less than a thousandth."""


@dataclass(frozen=True, slots=True)
class TuningGoal:
    """What the operator asks of the tuner.

    Attributes
    ----------
    budget_w, budget_kind
        Coil power that may be spent, and which power that is: ``joule_mean`` is R i_rms², ``joule_peak`` R i_peak².
    modulus_margin
        Least distance of the loop gain from -1.
    reach_hz
        Table points this near to the excitation are retuned.
    drift_hz
        The budget holds with the excitation this much off the point's.
    slowest_decay_1_s
        Every closed-loop pole decays at least this fast.
    """

    budget_w: float = 4.0
    budget_kind: BudgetKind = "joule_mean"
    modulus_margin: float = 0.15
    reach_hz: float = 1.0
    drift_hz: float = 0.25
    slowest_decay_1_s: float = 0.5

    @property
    def joule_mean_w(self) -> float:
        """The budget as mean Joule power: half of the peak for a sine."""
        return 0.5 * self.budget_w if self.budget_kind == "joule_peak" else self.budget_w


@dataclass(frozen=True, slots=True)
class Prediction:
    """Steady state of one set of gains at one frequency on one model."""

    displacement_m: float
    stroke_m: float
    current_peak_a: float
    powers: Powers


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
    limit
        Compiled limit problem of another tuner in the same thread, to share; a new one takes a while to set up.

    Raises
    ------
    InputError
        If the plant states no limit on the coil's current or stroke: without them nothing may be proposed.
    """

    def __init__(
        self, plant: Plant, facts: LoopFacts, goal: TuningGoal, limit: LimitProblem | None = None
    ) -> None:
        coil, absorber = plant.voice_coil, plant.absorber
        if coil is None or absorber is None:
            raise InputError(
                f"plant '{plant.name}' has no voice coil on an absorber: there is nothing to retune"
            )
        current = f"{coil.name}_current_a"
        for key in (current, "stroke_m"):
            if key not in plant.limits:
                raise InputError(
                    f"plant '{plant.name}': limits.{key} [{plant.limit_units[key]}] is missing; without it no gains "
                    "are proposed; add it to the plant file"
                )
        if not goal.budget_w > 0.0:
            raise InputError(f"budget_w must be greater than 0 W, got {goal.budget_w}")
        self.plant, self.facts, self.goal = plant, facts, goal
        self._coil = coil
        power = min(goal.joule_mean_w, plant.limits.get(f"{coil.name}_power_w", math.inf))
        self._limits = CoilLimits(power, plant.limits[current], plant.limits["stroke_m"], coil.resistance_ohm)
        self._limit = limit or LimitProblem()
        modes = natural_frequencies_hz(plant)
        self._check_grid = margin_grid(facts.sample_rate_hz, modes, 200)
        self._design_rows = slice(None, None, 4)
        w2 = math.sqrt(absorber.stiffness_n_m / absorber.mass_kg)
        scale = np.array([absorber.mass_kg, absorber.mass_kg * w2, absorber.stiffness_n_m])
        # gamma > -k2, alpha > -m2, beta free (thesis 6.2.3), with room to the bounds.
        bounds = np.array([[-0.5, 1.0], [-1.0, 1.0], [-0.8, 2.0]]) * scale[:, None]
        self._program = GainProgram(len(self._check_grid[self._design_rows]), scale, bounds)
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
        troubles: list[str] = []
        for row, frequency in enumerate(schedule.frequency_hz):
            if not low - self.goal.reach_hz <= frequency <= high + self.goal.reach_hz:
                continue
            question = self._question(plant, damping_std_ns_m, frequency, excitation_amplitude, schedule)
            known = self._solved.get(row)
            if known is not None and known.answers(question):
                points.append((row, known.point))
                continue
            try:
                point = self._tune(
                    plant, damping_std_ns_m, frequency, excitation_amplitude, schedule.at(frequency)
                )
                points.append((row, point))
                self._solved[row] = _Solved(question, point)
            except RunError as error:
                troubles.append(f"{frequency:g} Hz: {error}")
        reason = "; ".join(troubles)
        if not points and not troubles:
            reason = f"no point of the table lies within {self.goal.reach_hz:g} Hz of {excitation_hz:.2f} Hz"
        return Proposal(
            made_at_sample=sample,
            model_id=plant.fingerprint,
            feasible=bool(points),
            reason=reason,
            budget_w=self.goal.budget_w,
            budget_kind=self.goal.budget_kind,
            points=tuple(points),
        )

    @staticmethod
    def _question(
        plant: Plant, damping_std: float, frequency: float, amplitude: float, schedule: GainSchedule
    ) -> "_Question":
        absorber = plant.absorber
        gains = schedule.at(frequency)
        return _Question(
            frequency_hz=frequency,
            damping_ns_m=absorber.damping_at(frequency) if absorber is not None else 0.0,
            damping_std_ns_m=damping_std,
            amplitude=amplitude,
            cutoffs_hz=(gains.low_pass_hz, gains.high_pass_hz),
        )

    def limit_at(self, plant: Plant, frequency_hz: float, amplitude: float) -> LimitResult:
        """Physical limit at one frequency; see `LimitProblem.solve`."""
        model = RigModel(plant, self.facts, frequency_hz)
        return self._solve_limit(model.response(frequency_hz)[0], amplitude, self._limits)

    def _solve_limit(self, response: ComplexArray, amplitude: float, limits: CoilLimits) -> LimitResult:
        motion, stroke, _, current = ((complex(row[0]), complex(row[1]) * amplitude) for row in response)
        return self._limit.solve(motion, current, stroke, limits)

    def _tune(
        self, plant: Plant, damping_std: float, frequency: float, amplitude: float, in_use: Gains
    ) -> OperatingPoint:
        absorber = plant.absorber
        damping = absorber.damping_at(frequency) if absorber is not None else 0.0
        model = RigModel(plant, self.facts, frequency)
        response = model.response(frequency)[0]
        cutoffs = in_use.low_pass_hz, in_use.high_pass_hz
        path = model.paths(frequency, in_use.low_pass_hz, in_use.high_pass_hz)[0]
        low, high = max(0.0, damping - 2.0 * damping_std), damping + 2.0 * damping_std
        models = [model, *(RigModel(plant, self.facts, frequency, c) for c in (low, high))]
        loops = [m.loop_terms(self._check_grid, *cutoffs) for m in models]
        terms = loops[0][self._design_rows]

        limits, margin = self._limits, self.goal.modulus_margin
        best = self._solve_limit(response, amplitude, limits)
        trouble = ""
        for _ in range(4):
            wanted = best if limits is self._limits else self._solve_limit(response, amplitude, limits)
            acceleration = response[2, 0] * wanted.reference_a + response[2, 1] * amplitude
            numbers = self._program.solve(path * acceleration, wanted.reference_a, terms, margin, np.zeros(3))
            gains = replace(
                in_use, alpha_kg=float(numbers[0]), beta_ns_m=float(numbers[1]), gamma_n_m=float(numbers[2])
            )
            trouble, found = self._verify(models, loops, gains, frequency, amplitude)
            if not trouble:
                prediction = predict(model, gains, frequency, amplitude)
                return OperatingPoint(
                    frequency_hz=frequency,
                    gains=gains,
                    predicted_displacement_m=prediction.displacement_m,
                    passive_displacement_m=abs(response[0, 1]) * amplitude,
                    limit_displacement_m=best.displacement_m,
                    stroke_m=prediction.stroke_m,
                    current_peak_a=prediction.current_peak_a,
                    powers=prediction.powers,
                    modulus_margin=found.modulus,
                    delay_margin_s=found.delay_s,
                    active_limits=best.active,
                )
            if trouble.startswith(("power", "current", "stroke")):
                limits = replace(
                    limits,
                    joule_mean_w=0.8 * limits.joule_mean_w,
                    current_peak_a=0.9 * limits.current_peak_a,
                    stroke_m=0.9 * limits.stroke_m,
                )
            else:
                # Ask for more by what was missing: between the grid's points, or at the other dampings.
                margin = min(0.9, margin + max(0.01, 1.5 * (self.goal.modulus_margin - found.modulus)))
        raise RunError(trouble)

    def _verify(
        self,
        models: list[RigModel],
        loops: list[ComplexArray],
        gains: Gains,
        frequency: float,
        amplitude: float,
    ) -> tuple[str, Margins]:
        """What is wrong with these gains (empty: nothing), and the least margins found."""
        goal, least = self.goal, Margins(math.inf, None)
        for candidate, terms in zip(models, loops, strict=True):
            decay = candidate.decay_rate_1_s(gains)
            if not decay < -goal.slowest_decay_1_s:
                return (
                    f"slowest pole at {decay:+.2f} 1/s, wanted below -{goal.slowest_decay_1_s:g} 1/s",
                    least,
                )
            found = margins(terms, self._check_grid, gains)
            delay = min((d for d in (found.delay_s, least.delay_s) if d is not None), default=None)
            least = Margins(min(found.modulus, least.modulus), delay)
        if least.modulus < 0.95 * goal.modulus_margin:
            return f"modulus margin {least.modulus:.3f}, wanted {goal.modulus_margin:g}", least
        for f in (frequency - goal.drift_hz, frequency, frequency + goal.drift_hz):
            p = predict(models[0], gains, f, amplitude)
            if p.powers.joule_mean_w > self._limits.joule_mean_w * 1.001:
                return (
                    f"power {p.powers.joule_mean_w:.2f} W mean Joule at {f:.2f} Hz is over the budget",
                    least,
                )
            if p.current_peak_a > self._limits.current_peak_a * 1.001:
                return f"current {p.current_peak_a:.2f} A at {f:.2f} Hz is over the limit", least
            if p.stroke_m > self._limits.stroke_m * 1.001:
                return f"stroke {p.stroke_m * 1e3:.2f} mm at {f:.2f} Hz is over the limit", least
        return "", least


def predict(model: RigModel, gains: Gains, frequency_hz: float, amplitude: float) -> Prediction:
    """Steady state under a set of gains, from the sampled model with delay and filters.

    Parameters
    ----------
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    """
    response = model.response(frequency_hz)[0]
    law = complex(
        model.paths(frequency_hz, gains.low_pass_hz, gains.high_pass_hz)[0]
        @ np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
    )
    reference = law * response[2, 1] * amplitude / (1.0 - law * response[2, 0])
    displacement, stroke, _, current = response @ np.array([reference, amplitude])
    coil = model.coil
    # Terminal voltage behind the current loop; its product with the current is what the amplifier delivers.
    voltage = (coil.current_loop_kp_v_a or 0.0) * (reference - current)
    return Prediction(
        displacement_m=float(abs(displacement)),
        stroke_m=float(abs(stroke)),
        current_peak_a=float(abs(current)),
        powers=Powers(
            joule_mean_w=float(0.5 * coil.resistance_ohm * abs(current) ** 2),
            joule_peak_w=float(coil.resistance_ohm * abs(current) ** 2),
            electrical_mean_w=float(0.5 * (voltage * np.conj(current)).real),
        ),
    )
