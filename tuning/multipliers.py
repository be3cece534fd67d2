"""Multipliers that make an LQ design meet its limits: one by a secant, several by dual ascent.

For any multipliers the LQ optimum of the summed cost gives the dual function, which is concave, and its gradient: what
each limit's quantity exceeds its bound by. Where it is flat and no multiplier is wasted, the design is optimal.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from tuning.lq_kernels import lq_point
from twin.plant.errors import RunError
from twin.plant.linear import Array

TIGHT = 1e-9
"""A limit that binds alone is used to within this share."""
SLACK = 1e-8
"""Limits that bind together are used to within this share."""
LARGEST_MULTIPLIER = 1e9
LARGEST_RESIDUAL = 1e-7
CONFLICT = "no control keeps all limits at once"


@dataclass(frozen=True)
class Limit:
    """A bound on a quadratic form of (x, u): mean of the form at most 1; in SI at most ``value``."""

    name: str
    form: Array
    value: float
    per_unit: float  # how much of the bound's share one SI unit of the limit is


@dataclass
class BudgetProblem:
    """One operating point in scaled units; counts its evaluations."""

    A: Array
    b: Array
    noise: Array
    objective: Array
    limits: tuple[Limit, ...]
    ratios: Array
    steepness: float
    evaluations: int = 0

    def at(self, multipliers: Array) -> "LQPoint":
        """LQ optimum for some multipliers."""
        form = self.objective.copy()
        for weight, limit in zip(multipliers, self.limits, strict=True):
            form += weight * limit.form
        self.evaluations += 1
        K, moments, value, error = lq_point(self.A, self.b, form, self.noise, self.ratios)
        if not (error < LARGEST_RESIDUAL and np.isfinite(moments).all()):
            raise RunError(f"the Riccati equation could not be solved (relative residual {error:.1e})")
        spent = np.array([[np.sum(m * limit.form) for limit in self.limits] for m in moments])
        cost = float(np.sum(moments[0] * self.objective))
        return LQPoint(multipliers, form, K, moments, spent[0], spent.max(axis=0), cost, value)


@dataclass(frozen=True)
class LQPoint:
    """Gain, moments and what the limits see: over the line's width, and at worst, the sines counted in."""

    multipliers: Array
    form: Array
    K: Array
    moments: Array
    spent: Array
    worst: Array
    cost: float
    value: float

    @property
    def gap(self) -> float:
        """Relative duality gap, for the bounds that the worst case leaves to the mean over the line."""
        allowed = np.where(self.worst > 0.0, self.spent / np.where(self.worst > 0.0, self.worst, 1.0), 1.0)
        dual = self.value - float(self.multipliers @ allowed)
        return abs(self.cost - dual) / self.cost if self.cost > 0.0 else 0.0


def meet_one(problem: BudgetProblem, k: int, start: LQPoint, floor: float) -> LQPoint | None:
    """Multiplier of one limit that just meets it, by a bracketed secant on logarithms; None if none does."""

    def at(log_weight: float) -> tuple[LQPoint, float]:
        weights = np.zeros(len(problem.limits))
        weights[k] = math.exp(log_weight) - floor
        point = problem.at(weights)
        # The logarithm of what is spent is nearly straight in that of the weight; what is not positive has none.
        return point, math.log(max(float(point.worst[k]), 1e-3)) + 0.5 * TIGHT

    low, above = math.log(floor), math.log(float(start.worst[k]))
    # With a narrow line |x1| falls in proportion to the force added; that gives the slope, so the multiplier.
    high = math.log(floor + problem.steepness * max(math.sqrt(float(start.worst[k])) - 1.0, 1e-3))
    high = max(high, low + 0.1)
    point, level = at(high)
    while level > 0.0:
        low, above = high, level
        high += 1.0
        if high > math.log(LARGEST_MULTIPLIER):
            return None
        point, level = at(high)
    best, below = point, level
    older, newer = (low, above), (high, below)
    for _ in range(80):
        if best.worst[k] >= 1.0 - TIGHT:
            break
        slope = (newer[1] - older[1]) / (newer[0] - older[0]) if newer[0] != older[0] else 0.0
        weight = newer[0] - newer[1] / slope if slope < 0.0 else low
        if not low < weight < high:
            weight = 0.5 * (low + high)
            if weight in (low, high):
                break
        point, level = at(weight)
        older, newer = newer, (weight, level)
        if level > 0.5 * TIGHT:
            low = weight
        else:
            high, best = weight, point
    return best


def meet_all(problem: BudgetProblem, start: Array) -> LQPoint:
    """Multipliers that meet several limits at once, from a start.

    The bounds on the means over the line are lowered until the sines keep the limits, too.
    """
    bounds = np.full(len(start), 1.0 - 0.5 * TIGHT)
    weights = start
    for _ in range(30):
        point = _dual_ascent(problem, weights, bounds)
        weights = point.multipliers
        active = weights > 0.0
        if np.all(point.worst <= 1.0) and np.all(point.worst[active] >= 1.0 - SLACK):
            return point
        share = (1.0 - 0.5 * TIGHT) / np.where(point.worst > 0.0, point.worst, 1.0)
        bounds = np.where(
            active | (point.worst > 1.0), np.minimum(point.spent * share, 1.0 - 0.5 * TIGHT), bounds
        )
    raise RunError(CONFLICT)


def _dual_ascent(problem: BudgetProblem, start: Array, bounds: Array) -> LQPoint:
    """Maximise the concave dual function over multipliers not below zero.

    Newton's method: each step maximises the quadratic model with the multipliers kept from falling below zero
    (non-negative least squares), then a line search.
    """
    weights, point = start, problem.at(start)
    for _ in range(60):
        rest = point.spent - bounds
        if np.all(np.where(weights > 0.0, np.abs(rest), rest) <= 0.2 * TIGHT):
            break
        if weights.max() > LARGEST_MULTIPLIER:
            raise RunError(CONFLICT)
        unit = np.maximum(weights, 1e-3 * max(weights.max(), 1e-2))
        curve = np.empty((len(weights), len(weights)))
        for k in range(len(weights)):
            moved = weights.copy()
            moved[k] += 1e-4 * unit[k]
            curve[:, k] = (point.spent - problem.at(moved).spent) * unit / 1e-4
        values, vectors = np.linalg.eigh(0.5 * (curve + curve.T))
        values = np.maximum(values, max(1e-9 * values.max(), 1e-300))  # what rounding adds is cut off
        root = np.sqrt(values)[:, None] * vectors.T
        aim = (vectors.T @ (rest * unit)) / np.sqrt(values) + root @ (weights / unit)
        step = nnls(root, aim)[0] * unit - weights
        reach = float(np.max(step / (weights + unit)))
        gain = point.value - float(weights @ bounds)
        share = min(1.0, 10.0 / reach) if reach > 0.0 else 1.0
        for _ in range(12):
            tried = np.maximum(weights + share * step, 0.0)
            after = problem.at(tried)
            over = np.where(tried > 0.0, np.abs(after.spent - bounds), after.spent - bounds).max()
            better = after.value - float(tried @ bounds) > gain
            if better or over < 0.5 * np.where(weights > 0.0, np.abs(rest), rest).max():
                break
            share *= 0.3
        else:
            break
        weights, point = tried, after
    return point
