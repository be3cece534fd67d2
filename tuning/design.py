"""From a situation and what is asked of it to gains: start, search, tighten where the check grid sees more."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from tuning.gains import GainProgram
from tuning.limit import Disc, discs, electrical_square
from tuning.search import ITERATIONS, Condition, Found, GainSearch, Stability
from tuning.start import starts
from tuning.steady import Pair, SteadyPaths
from tuning.types import ActiveLimit, BudgetKind
from tuning.verify import DELAYS, Demands, Situation
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.plant.linear import Array, ComplexArray

INSIDE = 1e-5
"""Limits and margins are designed for by this share better than asked, so that rounding keeps them."""

LATE_MARGIN = 0.05
"""Distance from -1 that is designed for with the further delay in the loop."""

NEXT_TO_LIMIT = 1e-3
"""Nothing better is sought this near to the physical limit, as a share of it and of the passive motion."""

TIGHTENINGS, AGAIN = 5, 10
"""How often a search is repeated with the margin tightened, and its iterations then: it begins next to its end."""

FAILED = 1e-4


@dataclass(frozen=True, slots=True)
class Design:
    """Gains as searched, not verified; what binds the law beside the physical limits, and the price of it.

    ``grid`` are the frequencies [Hz] the search looked at in the end.
    """

    gains: Gains
    active: tuple[ActiveLimit, ...]
    found: Found
    grid: Array


@dataclass(frozen=True, slots=True)
class Start:
    """Where a search may begin: gains (3,) in SI units and, of a question in the same situation, what came of it.

    Attributes
    ----------
    design, demands
        What was found for which demands; None where gains and situation do not belong together.
    """

    numbers: Array
    design: Design | None = None
    demands: Demands | None = None

    def still_holds(self, demands: Demands) -> bool:
        """Whether other demands leave the design the best next to itself: none that changed binds it.

        What did not bind may do so now: the gains need verifying.
        """
        before = self.demands
        if self.design is None or before is None:
            return False
        if demands == before:
            return True
        if (demands.displacement_m is None) != (before.displacement_m is None):
            return False  # another thing is to be small
        ours, theirs = demands.limits, before.limits
        moved = {
            "power": ours.joule_mean_w != theirs.joule_mean_w,
            "electrical": ours.electrical_mean_w != theirs.electrical_mean_w,
            "current": ours.current_peak_a != theirs.current_peak_a,
            "stroke": ours.stroke_m != theirs.stroke_m,
            "voltage": ours.voltage_peak_v != theirs.voltage_peak_v,
            "displacement": demands.displacement_m != before.displacement_m,
            "modulus margin": (demands.modulus_margin, demands.delay_margin_s)
            != (before.modulus_margin, before.delay_margin_s),
            "decay": demands.slowest_decay_1_s != before.slowest_decay_1_s,
        }
        return not any(moved[name] for name in self.design.found.binding if name in moved)


def not_stopped() -> None:
    """Let a search go on; in its place a function may be given that raises when nobody waits for it any more."""


class Designer:
    """Design gains of the rig's law for any situation of a plant.

    Parameters
    ----------
    plant
        Its absorber gives the gains' scale and bounds.
    """

    def __init__(self, plant: Plant) -> None:
        absorber = plant.absorber
        if absorber is None:
            raise ValueError(f"plant '{plant.name}' has no absorber")
        w2 = math.sqrt(absorber.stiffness_n_m / absorber.mass_kg)
        self._scale = np.array([absorber.mass_kg, absorber.mass_kg * w2, absorber.stiffness_n_m])
        # alpha > -m2, gamma > -k2, beta free (thesis 6.2.3), with room to these bounds and far above.
        self._bounds = np.array([[-0.95, 3.0], [-1.0, 1.0], [-0.95, 5.0]]) * self._scale[:, None]
        self._program = GainProgram(self._scale, self._bounds)

    def design(
        self,
        situation: Situation,
        cutoffs_hz: tuple[float, float],
        demands: Demands,
        wish_a: complex,
        *,
        near: Start | None = None,
        go_on: Callable[[], None] = not_stopped,
    ) -> Design:
        """Gains with the least motion or, with a displacement asked for, the least power that reaches it.

        Parameters
        ----------
        wish_a
            Reference at the physical limit [A].
        near
            Where to start and nowhere else, such as at the gains of a slightly different question. Quick, but it may
            miss better gains farther off.
        go_on
            Called before each search; what it raises ends this.
        """
        if demands.displacement_m is not None:
            kind: BudgetKind = "electrical" if demands.limits.electrical_mean_w < math.inf else "joule_mean"
            return self._search(situation, cutoffs_hz, demands, wish_a, kind, near, go_on)
        return self._search(situation, cutoffs_hz, demands, wish_a, None, near, go_on)

    def least_power(
        self,
        situation: Situation,
        cutoffs_hz: tuple[float, float],
        demands: Demands,
        wish_a: complex,
        kind: BudgetKind,
        *,
        go_on: Callable[[], None] = not_stopped,
    ) -> Gains | None:
        """Gains that keep everything but the power with the least of it; None if there are none."""
        free = replace(demands.limits, joule_mean_w=math.inf, electrical_mean_w=math.inf)
        design = self._search(situation, cutoffs_hz, replace(demands, limits=free), wish_a, kind, go_on=go_on)
        return design.gains if design.found.violation < FAILED else None

    def _search(
        self,
        situation: Situation,
        cutoffs_hz: tuple[float, float],
        demands: Demands,
        wish_a: complex,
        kind: BudgetKind | None,
        near: Start | None = None,
        go_on: Callable[[], None] = not_stopped,
    ) -> Design:
        conditions, unit = self._conditions(situation, cutoffs_hz, demands, kind)
        left = abs(situation.paths.motion[0] * wish_a + situation.paths.motion[1]) / unit
        enough = 0.0 if kind is not None else left**2 * (1.0 + 2.0 * NEXT_TO_LIMIT) + NEXT_TO_LIMIT**2
        grid = situation.design_grid if near is None or near.design is None else near.design.grid
        margin, late = demands.modulus_margin * (1.0 + INSIDE) + 1e-6, LATE_MARGIN
        first: list[Array] | None = None if near is None else [near.numbers]
        for tightening in range(TIGHTENINGS):
            terms = situation.loop_terms(grid, cutoffs_hz)
            stability = self._stability(situation, grid, cutoffs_hz, demands, terms, margin, late)
            search = GainSearch(self._scale, self._bounds, conditions, stability, unit, enough)
            if first is None:
                curves = [terms[0], *self._late(grid, terms[0], demands)]
                first = self._starts(conditions[0], wish_a, curves, margin)
            found = self._best(
                search, first, ITERATIONS if tightening == 0 and near is None else AGAIN, go_on
            )
            alpha, beta, gamma = (float(x) for x in found.numbers)
            gains = Gains(alpha, beta, gamma, *cutoffs_hz)
            if found.violation > FAILED:
                break
            seen, valleys = situation.margins_and_valleys(gains, margin)
            short = demands.modulus_margin * (1.0 + INSIDE) - seen.modulus
            hasty = seen.delay_s is not None and seen.delay_s < demands.delay_margin_s
            if short <= 0.0 and not hasty:
                break
            if short > 0.0:
                # The grid is too coarse for that valley: denser there, and some more margin.
                grid = _halved(grid, valleys)
                margin += (0.5 if tightening == 0 else 1.5) * short + 1e-5
            late += LATE_MARGIN if hasty else 0.0
            first = [found.numbers, *first] if hasty else [found.numbers]
        active = _prices(found, conditions[0], gains, situation.paths, demands, unit, kind)
        return Design(gains, active, found, grid)

    def _conditions(
        self, situation: Situation, cutoffs_hz: tuple[float, float], demands: Demands, kind: BudgetKind | None
    ) -> tuple[list[Condition], float]:
        out = []
        laws = situation.laws(cutoffs_hz)
        for k, (law, (_, paths)) in enumerate(zip(laws, situation.cases, strict=True)):
            bounds = [_tighter(d) for d in discs(paths, demands.limits)]
            if k == 0 and demands.displacement_m is not None:
                bounds.append(_tighter(Disc("displacement", *paths.motion, demands.displacement_m)))
            weight = 1.0 if k == 0 else 0.0
            out.append(Condition(law, paths.acceleration, _target(paths, kind), weight, tuple(bounds)))
        if kind is None:
            return out, abs(situation.paths.motion[1])
        return out, max(
            demands.limits.current_peak_a * abs(out[0].target[0] / situation.paths.current[0]), 1e-30
        )

    def _stability(
        self,
        situation: Situation,
        grid: Array,
        cutoffs_hz: tuple[float, float],
        demands: Demands,
        terms: list[ComplexArray],
        margin: float,
        late: float,
    ) -> Stability:
        curves, least = list(terms), [margin] * len(terms)
        delayed = self._late(grid, terms[0], demands)
        curves += delayed
        least += [min(late, 0.5 + 0.5 * margin)] * len(delayed)
        n = len(grid)
        first = np.zeros(n * len(curves), dtype=np.bool_)
        first[::n] = True
        # Less damping is what makes a loop slow: of the models the one with the least of it.
        slow = situation.models[1 if len(situation.models) > 1 else 0]
        decaying = (slow,) if demands.slowest_decay_1_s > 0.0 else ()
        wanted = demands.slowest_decay_1_s * (1.0 + 1e-4)
        return Stability(np.vstack(curves), np.repeat(least, n), first, decaying, wanted, cutoffs_hz)

    @staticmethod
    def _late(grid: Array, terms: ComplexArray, demands: Demands) -> list[ComplexArray]:
        """The loop with parts of the further delay that it must stand, and with all of it."""
        if demands.delay_margin_s == 0.0:
            return []
        turn = -2j * np.pi * grid * demands.delay_margin_s
        return [terms * np.exp(turn * share)[:, None] for share in DELAYS]

    def _starts(
        self, condition: Condition, wish_a: complex, curves: list[ComplexArray], margin: float
    ) -> list[Array]:
        terms = curves[0]
        found = starts(condition, wish_a, curves, margin, self._scale, self._bounds)
        best = found[0]
        if float(np.min(np.abs(1.0 + terms @ best))) < margin:
            per_ampere, alone = condition.acceleration
            acceleration = per_ampere * wish_a + alone
            try:
                projected = self._program.solve(condition.law * acceleration, wish_a, terms, margin, best)
                found = [projected, *found]
            except RunError:
                pass  # The search itself will say what is in the way.
        return found

    @staticmethod
    def _best(search: GainSearch, first: list[Array], iterations: int, go_on: Callable[[], None]) -> Found:
        best: Found | None = None
        for start in first:
            go_on()
            if start is not first[-1] and not search.is_stable(start):
                continue  # From an unstable loop a search rarely comes back.
            found = search.run(start, iterations)
            if best is None or (found.violation > FAILED, found.objective) < (
                best.violation > FAILED,
                best.objective,
            ):
                best = found
            if best.violation <= FAILED:
                break
        if best is None:
            raise ValueError("no start was given")
        return best


def _halved(grid: Array, near: Array) -> Array:
    """A grid with points between those on either side of some frequencies."""
    at = np.searchsorted(grid, near)[:, None] + np.arange(-2, 2)
    at = np.unique(np.clip(at, 0, len(grid) - 2))
    return np.union1d(grid, 0.5 * (grid[at] + grid[at + 1]))


def _target(paths: SteadyPaths, kind: BudgetKind | None) -> Pair:
    """What is to be small: motion, current, or the root of the electrical power above its least."""
    if kind is None:
        return paths.motion
    if kind == "electrical":
        slope, offset, _ = electrical_square(paths)
        return slope, offset
    return paths.current


def _tighter(disc: Disc) -> Disc:
    return replace(disc, bound=disc.bound * (1.0 - INSIDE))


def _prices(
    found: Found,
    condition: Condition,
    gains: Gains,
    paths: SteadyPaths,
    demands: Demands,
    unit: float,
    kind: BudgetKind | None,
) -> tuple[ActiveLimit, ...]:
    """What binds the law beside the physical limits, at what it costs in motion."""
    if kind is not None:
        return ()
    law = complex(condition.law @ found.numbers)
    per_ampere, alone = condition.acceleration
    reference = law * alone / (1.0 - law * per_ampere)
    size = abs(paths.motion[0] * reference + paths.motion[1])
    if size < 1e-3 * unit:
        return ()  # Nothing is left to pay for.
    per_cost = unit**2 / (2.0 * size)
    out = []
    for name, weight in found.binding.items():
        if name == "modulus margin":
            out.append(ActiveLimit(name, weight * per_cost))
        elif name == "decay":
            out.append(ActiveLimit(name, weight * per_cost / demands.slowest_decay_1_s))
    return tuple(a for a in out if a.price > 1e-6 * unit)
