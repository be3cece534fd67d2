"""Everything a proposal states, recomputed from the deployed numbers alone on the full sampled model.

No solver's word is taken: poles, modulus and delay margin, motion, stroke, current, voltage and powers, at the
excitation and beside it, at the damping and two standard deviations off.
"""

import copy
import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from tuning.limit import CoilLimits
from tuning.loop import LoopFacts, Margins, RigModel, loop_margins, mode_grid
from tuning.steady import Prediction, SteadyPaths, paths_from
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.linear import Array, ComplexArray

Found = TypeVar("Found")

ROUNDING = 1e-9
CHECK_POINTS = 150
DESIGN_POINTS = 40
DELAYS = (0.5, 1.0)
VALLEYS, BETWEEN = 3, np.linspace(0.0, 1.0, 41)
KEPT_FINDINGS = 100
"""Sets of gains whose poles and margins a situation remembers."""


class Situation:
    """One operating point: the models it may turn out to be, and the frequencies it may drift to.

    Parameters
    ----------
    plant
        As identified.
    frequency_hz, amplitude
        Of the excitation; peak, in the exciting actuator's unit.
    damping_std_ns_m
        Standard deviation of the absorber's damping [Ns/m]; the models have it two of them off.
    drift_hz
        How far the excitation may be off.
    """

    def __init__(
        self,
        plant: Plant,
        facts: LoopFacts,
        frequency_hz: float,
        amplitude: float,
        damping_std_ns_m: float,
        drift_hz: float,
    ) -> None:
        absorber = plant.absorber
        damping = absorber.damping_at(frequency_hz) if absorber is not None else 0.0
        off = 2.0 * damping_std_ns_m
        dampings = [damping] if off == 0.0 else [damping, max(0.0, damping - off), damping + off]
        self.facts, self.frequency_hz, self.amplitude = facts, frequency_hz, amplitude
        self.damping_std_ns_m = damping_std_ns_m
        self._chains: dict[str, tuple[tuple[float, float], ComplexArray]] = {}
        self._terms: tuple[Array, tuple[float, float], list[ComplexArray]] | None = None
        # What does not depend on the excitation's size, and is asked again of the same gains.
        self._decays: dict[Gains, tuple[float, ...]] = {}
        self._margins: dict[Gains, Margins] = {}
        self.models = [RigModel(plant, facts, frequency_hz, c) for c in dampings]
        nominal = self.models[0]
        beside = [frequency_hz - drift_hz, frequency_hz + drift_hz] if drift_hz > 0.0 else []
        f = np.array([frequency_hz, *beside])
        self.cases: list[tuple[RigModel, SteadyPaths]] = [
            (nominal, paths_from(nominal, float(x), r, amplitude))
            for x, r in zip(f, nominal.response(f), strict=True)
        ]
        for model in self.models[1:]:
            response = model.response(frequency_hz)[0]
            self.cases.append((model, paths_from(model, frequency_hz, response, amplitude)))

    def scaled(self, amplitude: float) -> "Situation":
        """The same under another size of excitation, with what is known of models and gains."""
        new = copy.copy(self)
        share, new.amplitude = amplitude / self.amplitude, amplitude
        new.cases = [(model, paths.scaled(share)) for model, paths in self.cases]
        return new

    @property
    def paths(self) -> SteadyPaths:
        """Of the nominal model at the excitation."""
        return self.cases[0][1]

    @cached_property
    def design_grid(self) -> Array:
        """Frequencies the search looks at first [Hz]."""
        return mode_grid(self.models[0], DESIGN_POINTS)

    @cached_property
    def _check_grid(self) -> Array:
        return mode_grid(self.models[0], CHECK_POINTS)

    @cached_property
    def _check_accelerations(self) -> list[ComplexArray]:
        return [m.acceleration(self._check_grid) for m in self.models]

    def loop_terms(self, grid: Array, cutoffs_hz: tuple[float, float]) -> list[ComplexArray]:
        """Loop gain per unit of each gain on a grid [Hz], one (n, 3) per model."""
        known = self._terms
        if known is None or known[0] is not grid or known[1] != cutoffs_hz:
            chain = self._chain(grid, cutoffs_hz)
            terms = [-m.acceleration(grid)[:, None] * chain for m in self.models]
            known = self._terms = grid, cutoffs_hz, terms
        return known[2]

    def laws(self, cutoffs_hz: tuple[float, float]) -> ComplexArray:
        """Reference per measured acceleration and unit of each gain, (cases, 3)."""
        return self._kept("laws", cutoffs_hz, np.array([paths.frequency_hz for _, paths in self.cases]))

    def _chain(self, grid: Array, cutoffs_hz: tuple[float, float]) -> ComplexArray:
        return self.models[0].paths(grid, *cutoffs_hz)

    def _kept(self, name: str, cutoffs_hz: tuple[float, float], grid: Array) -> ComplexArray:
        """The chain on a grid that is asked for again with the same cutoffs."""
        known = self._chains.get(name)
        if known is None or known[0] != cutoffs_hz:
            known = self._chains[name] = cutoffs_hz, self._chain(grid, cutoffs_hz)
        return known[1]

    def predictions(self, gains: Gains) -> list[Prediction]:
        """Steady state of every case, the nominal one at the excitation first."""
        responses = self.laws((gains.low_pass_hz, gains.high_pass_hz)) @ _numbers(gains)
        out = []
        for response, (_, paths) in zip(responses.tolist(), self.cases, strict=True):
            per_ampere, alone = paths.acceleration
            out.append(paths.at(response * alone / (1.0 - response * per_ampere)))
        return out

    def margins(self, gains: Gains) -> Margins:
        """The least margins of all models."""
        known = self._margins.get(gains)
        return self.margins_and_valleys(gains, 0.0)[0] if known is None else known

    def margins_and_valleys(self, gains: Gains, below: float) -> tuple[Margins, Array]:
        """The least margins of all models, and where |1 + L| has its deepest bottoms below some distance [Hz].

        The deepest valleys are looked at again between the grid's points.
        """
        cutoffs = gains.low_pass_hz, gains.high_pass_hz
        grid, law = self._check_grid, _numbers(gains)
        chain = self._kept("check", cutoffs, grid) @ law
        modulus, delay = math.inf, math.inf
        fine: list[Array] = []
        for acceleration in self._check_accelerations:
            L = -acceleration * chain
            found = loop_margins(L, grid)
            modulus = min(modulus, found.modulus)
            delay = min(delay, math.inf if found.delay_s is None else found.delay_s)
            distance = np.abs(1.0 + L)
            inner = np.nonzero((distance[1:-1] <= distance[:-2]) & (distance[1:-1] <= distance[2:]))[0] + 1
            deepest = inner[np.argsort(distance[inner], kind="stable")[:VALLEYS]]
            between = grid[deepest - 1] + BETWEEN[:, None] * (grid[deepest + 1] - grid[deepest - 1])
            fine.append(between)
        path = self._chain(np.concatenate([f.ravel() for f in fine]), cutoffs) @ law
        end, bottoms = 0, [np.zeros(0)]
        for model, between in zip(self.models, fine, strict=True):
            begin, end = end, end + between.size
            distance = np.abs(1.0 - model.acceleration(between.ravel()) * path[begin:end])
            modulus = min(modulus, float(distance.min(initial=math.inf)))
            distance = distance.reshape(between.shape)
            at = np.argmin(distance, axis=0), np.arange(between.shape[1])
            bottoms.append(between[at][distance[at] < below])
        least = Margins(modulus, delay if delay < math.inf else None)
        _remember(self._margins, gains, least)
        return least, np.unique(np.concatenate(bottoms))

    def decay_rate_1_s(self, gains: Gains) -> float:
        """Slowest decay of all models [1/s]; below 0 is stable."""
        return max(self.decay_rates_1_s(gains))

    def decay_rates_1_s(self, gains: Gains) -> tuple[float, ...]:
        """Slowest decay of each model [1/s], the nominal one first."""
        known = self._decays.get(gains)
        if known is None:
            known = tuple(m.decay_rate_1_s(gains) for m in self.models)
            _remember(self._decays, gains, known)
        return known


@dataclass(frozen=True, slots=True)
class Demands:
    """What gains must keep."""

    limits: CoilLimits
    modulus_margin: float
    delay_margin_s: float
    slowest_decay_1_s: float
    displacement_m: float | None = None


@dataclass(frozen=True, slots=True)
class Verdict:
    """What was found of a set of gains; ``trouble`` says what is wrong, empty if nothing is.

    Attributes
    ----------
    broken
        Name of what is broken first.
    margins, decay_rate_1_s
        The worst of all models; margins of an unstable loop are none.
    predictions
        Of every case of the `Situation`.
    """

    trouble: str
    broken: str
    margins: Margins
    decay_rate_1_s: float
    predictions: tuple[Prediction, ...]


def _remember(known: dict[Gains, Found], gains: Gains, found: Found) -> None:
    if len(known) >= KEPT_FINDINGS:
        known.pop(next(iter(known)))
    known[gains] = found


def _numbers(gains: Gains) -> Array:
    return np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])


def verify(situation: Situation, gains: Gains, demands: Demands) -> Verdict:
    """Check a set of gains against everything that is asked."""
    decay = situation.decay_rate_1_s(gains)
    none = Margins(0.0, 0.0)
    if not decay < -demands.slowest_decay_1_s * (1.0 - ROUNDING):
        wanted = f"wanted below -{demands.slowest_decay_1_s:g} 1/s"
        return Verdict(f"slowest pole at {decay:+.2f} 1/s, {wanted}", "decay", none, decay, ())
    found = situation.margins(gains)
    predictions = tuple(situation.predictions(gains))
    trouble, broken = _broken(situation, predictions, found, demands)
    return Verdict(trouble, broken, found, decay, predictions)


def _broken(
    situation: Situation, predictions: tuple[Prediction, ...], found: Margins, demands: Demands
) -> tuple[str, str]:
    if found.modulus < demands.modulus_margin * (1.0 - ROUNDING):
        return f"modulus margin {found.modulus:.3f}, wanted {demands.modulus_margin:g}", "modulus margin"
    if found.delay_s is not None and found.delay_s < demands.delay_margin_s:
        wanted = f"wanted {1e6 * demands.delay_margin_s:.0f} µs"
        return f"delay margin {1e6 * found.delay_s:.0f} µs, {wanted}", "delay margin"
    limits = demands.limits
    for (_, paths), p in zip(situation.cases, predictions, strict=True):
        values = (
            ("power", "W mean Joule", p.powers.joule_mean_w, limits.joule_mean_w),
            ("electrical", "W mean electrical power", p.powers.electrical_mean_w, limits.electrical_mean_w),
            ("current", "A", p.current_peak_a, limits.current_peak_a),
            ("stroke", "m", p.stroke_m, limits.stroke_m),
            ("voltage", "V", p.voltage_peak_v, limits.voltage_peak_v),
        )
        for name, unit, value, limit in values:
            if not value <= limit * (1.0 + ROUNDING):
                return (
                    f"{name} {value:.4g} {unit} at {paths.frequency_hz:.2f} Hz is over the limit {limit:.4g}",
                    name,
                )
    wanted_m = demands.displacement_m
    if wanted_m is not None and not predictions[0].displacement_m <= wanted_m * (1.0 + 1e-6):
        return (
            f"displacement {1e6 * predictions[0].displacement_m:.4g} µm, wanted {1e6 * wanted_m:.4g} µm",
            "displacement",
        )
    if not all(math.isfinite(p.displacement_m) for p in predictions):
        return "the motion has no bound", "displacement"
    return "", ""
