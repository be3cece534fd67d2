"""Gains of the rig's own law that leave the least motion inside every limit: a row of quadratic programs.

    minimise  the motion (or the power)       over alpha, beta, gamma
    subject to  |s r + o| <= bound            for every limit of every operating condition, r the reference
                |1 + L(f) e^(-j w tau)| >= M  on a frequency grid, for every model and extra delay asked for
                the slowest poles decay fast enough

The loop gain is linear in the gains, L = T g; a margin's row ``Re(e^-jp (1 + T g)) >= M``, p the phase of 1 + T g now,
lies inside what is asked, so an iterate that keeps it keeps the margin, and started from no gains it can not get to
the far side of -1. What the law does to motion and current is a Möbius map of its response at the excitation. Each
round solves the quadratic model of the whole with exact curvatures (sequential quadratic programming), damped until
the step does what the model promised.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuning.active_set import Step, solve_step
from tuning.limit import Disc
from tuning.loop import RigModel
from tuning.steady import Pair
from twin.control.schedule import Gains
from twin.plant.linear import Array, ComplexArray

ITERATIONS = 20
FEASIBLE = 1e-6
SETTLED = 1e-5
TINY = 1e-9
NOTHING = 1e-8
POLES = 3
HEAVIEST = 1e3
RIDGE = 1e-6
"""Weight of the gains' own size: of gains that are equally good the smallest win."""

POCKET = 0.02
"""Share of the margin by which points of the grid may miss it; what lies between them is looked at by itself."""
NEAR, SAME_VALLEY = 0.5, 3
GRID, VALLEY, LIMIT, DECAY, RANGE = range(5)
NAMES = {GRID: "modulus margin", VALLEY: "modulus margin", DECAY: "decay", RANGE: "range of the gains"}


@dataclass(frozen=True, slots=True)
class Condition:
    """One excitation frequency on one model, and what must hold there.

    Attributes
    ----------
    law
        (3,) reference per measured acceleration and unit of each gain, filters and delay included.
    acceleration
        Measured relative acceleration (per ampere of reference, without it).
    target
        Pair whose magnitude is to be small.
    weight
        Of its square in the objective.
    bounds
        Limits on the reference.
    """

    law: ComplexArray
    acceleration: Pair
    target: Pair
    weight: float
    bounds: tuple[Disc, ...]


@dataclass(frozen=True, slots=True)
class Stability:
    """What the loop must keep: distances from -1, and the decay of its slowest poles.

    Attributes
    ----------
    terms
        (n, 3) loop gain per unit of each gain: all frequencies of all models and delays.
    margin
        (n,) least |1 + L| of each.
    first
        (n,) True where a new curve, a model with a delay, begins.
    decaying
        Models whose poles must decay, the filters' cutoffs in ``cutoffs_hz``.
    slowest_1_s
        How fast [1/s].
    """

    terms: ComplexArray
    margin: Array
    first: NDArray[np.bool_]
    decaying: tuple[RigModel, ...]
    slowest_1_s: float
    cutoffs_hz: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Found:
    """Where the search ended.

    Attributes
    ----------
    numbers
        (3,) alpha, beta, gamma in SI units.
    objective
        Weighted square of the targets, as a share of what it is at the start's scale.
    violation
        Largest share by which a constraint is broken; below `FEASIBLE` none is.
    worst
        Which one.
    binding
        Multipliers by name of what binds: objective per share of a limit, or per unit of margin.
    """

    numbers: Array
    objective: float
    violation: float
    worst: str
    binding: dict[str, float]
    iterations: int


class GainSearch:
    """One operating point's search.

    Parameters
    ----------
    scale, bounds
        (3,) typical size of the gains, (3, 2) their bounds, in SI units.
    unit
        What the targets are measured in: their size without control, or their limit.
    enough
        Objective that is as good as any: the search ends there.
    """

    def __init__(
        self,
        scale: Array,
        bounds: Array,
        conditions: Sequence[Condition],
        stability: Stability,
        unit: float,
        enough: float = 0.0,
    ) -> None:
        self._scale = scale
        self._bounds = bounds / scale[:, None]
        self._terms = stability.terms * scale
        self._inner = ~(stability.first | np.roll(stability.first, -1))
        self._stability = stability
        self._law = np.array([c.law for c in conditions]) * scale
        self._per_ampere, self._alone = (np.array([c.acceleration[k] for c in conditions]) for k in (0, 1))
        self._target = np.array([c.target for c in conditions])
        self._weight = np.array([c.weight for c in conditions])
        self._of = np.array([k for k, c in enumerate(conditions) for _ in c.bounds], dtype=np.int64)
        limits = [d for c in conditions for d in c.bounds]
        self._limit_names = [d.name for d in limits]
        self._slope = np.array([d.slope / d.bound for d in limits])
        self._offset = np.array([d.offset / d.bound for d in limits])
        self._unit, self._enough = unit**2, enough

    def run(self, start: Array) -> Found:
        """Search from a start (3,) in SI units."""
        y = np.clip(start / self._scale, self._bounds[:, 0], self._bounds[:, 1])
        damping, penalty = 1e-3, 1e-2
        here = self._look(y, {})
        taken = 0
        while taken < ITERATIONS:
            taken += 1
            if here.broken < FEASIBLE and here.objective - RIDGE * float(y @ y) < self._enough:
                break
            hessian = _convex(here.hessian, damping)
            step = self._step(hessian, here)
            if step is None:
                break
            s = step.step
            penalty = min(max(penalty, 2.0 * float(step.multipliers.sum())), HEAVIEST)
            left = max(0.0, float(np.max(here.values + here.slopes @ s)))
            promised = -(here.gradient @ s + 0.5 * s @ hessian @ s) + penalty * (here.broken - left)
            if here.broken < FEASIBLE and promised < SETTLED * here.objective + NOTHING:
                break
            weights = here.weights(step)
            there = self._look(y + s, weights)
            gained = here.objective - there.objective + penalty * (here.broken - there.broken)
            if gained >= 0.1 * promised:
                y, here = y + s, there
                damping = max(0.2 * damping, 1e-7)
            elif float(np.max(np.abs(s))) < TINY:
                break
            else:
                damping = 5.0 * damping + 1e-5
                # The curvature of what binds belongs to the model even where the step is not taken.
                here = self._look(y, weights)
        return self._found(y, here, taken)

    def _found(self, y: Array, here: "_Look", iterations: int) -> Found:
        step = self._step(_convex(here.hessian, 1e-7), here)
        binding: dict[str, float] = {}
        if step is not None:
            for (kind, k), weight in here.weights(step).items():
                name = self._limit_names[k] if kind == LIMIT else NAMES[kind]
                binding[name] = binding.get(name, 0.0) + weight
        return Found(y * self._scale, here.objective, here.broken, here.worst, binding, iterations)

    def _step(self, hessian: Array, here: "_Look") -> Step | None:
        """Step to what is asked or, where that leaves no room, part of the way, or at least no farther off."""
        for share in (1.0, 0.3, 0.0):
            upper = np.where(here.values > 0.0, -share * here.values, -here.values)
            step = solve_step(hessian, here.gradient, here.slopes, upper)
            if step is not None:
                return step
        return None

    def _look(self, y: Array, weights: dict[tuple[int, int], float]) -> "_Look":
        """Values, slopes and the Lagrangian's curvature at a point, for given multipliers of some constraints."""
        response = self._law @ y
        rest = 1.0 - response * self._per_ampere
        reference = response * self._alone / rest
        # Slope and curvature of the reference over the law's response.
        first = self._alone / rest**2
        second = 2.0 * self._per_ampere * self._alone / rest**3
        motion = self._target[:, 0] * reference + self._target[:, 1]
        along = (self._target[:, 0] * first)[:, None] * self._law
        bend = motion.conj() * self._target[:, 0] * second * self._weight
        objective = float(self._weight @ np.abs(motion) ** 2) / self._unit + RIDGE * float(y @ y)
        gradient = 2.0 * ((self._weight * motion.conj()) @ along).real / self._unit + 2.0 * RIDGE * y
        hessian = (along.conj().T @ (self._weight[:, None] * along)).real
        hessian = 2.0 * (hessian + (self._law.T @ (bend[:, None] * self._law)).real) / self._unit

        hessian += 2.0 * RIDGE * np.eye(3)
        one_plus = 1.0 + self._terms @ y
        distance = np.abs(one_plus)
        toward = ((one_plus.conj() / np.maximum(distance, 1e-12))[:, None] * self._terms).real
        valleys = self._valleys(y, distance, weights, hessian)
        quantity = self._slope * reference[self._of] + self._offset
        size = np.maximum(np.abs(quantity), 1e-12)
        moving = (self._slope * first[self._of])[:, None] * self._law[self._of]
        leaning = ((quantity.conj() / size)[:, None] * moving).real
        for (kind, k), weight in weights.items():
            if kind == LIMIT:
                law = self._law[self._of[k]]
                curved = np.outer(moving[k].conj(), moving[k]).real - np.outer(leaning[k], leaning[k])
                bent = quantity[k].conj() * self._slope[k] * second[self._of[k]] * np.outer(law, law)
                hessian += weight / size[k] * (curved + bent.real)
        decay, decay_slopes = self._decay(y)
        # Points of the grid only keep long steps from jumping over a valley; at rest its very bottom decides, and
        # not the pocket between two points.
        values = [
            self._stability.margin * (1.0 - POCKET) - distance, valleys.values, size - 1.0, decay,
            y - self._bounds[:, 1], self._bounds[:, 0] - y,
        ]  # fmt: skip
        slopes = [-toward, valleys.slopes, leaning, decay_slopes, np.eye(3), -np.eye(3)]
        keys = [
            *((VALLEY, int(k)) for k in valleys.rows), *((LIMIT, k) for k in range(len(size))),
            *((DECAY, k) for k in range(len(decay))), *((RANGE, k) for k in range(6)),
        ]  # fmt: skip
        return _Look(
            objective, gradient, hessian, np.concatenate(values), np.concatenate(slopes), len(distance), keys,
            self._limit_names,
        )  # fmt: skip

    def _valleys(
        self, y: Array, distance: Array, weights: dict[tuple[int, int], float], hessian: Array
    ) -> "_Valleys":
        """Where |1 + L| is least between the points of the grid; curvature of the weighed ones goes into hessian."""
        inner = self._inner.copy()
        inner[1:] &= distance[1:] <= distance[:-1]
        inner[:-1] &= distance[:-1] < distance[1:]
        rows = np.nonzero(inner & (distance < self._stability.margin + NEAR))[0]
        before, at, after = (self._terms[rows + k] for k in (-1, 0, 1))
        # A parabola through three points of the curve, in a parameter from -1 to 1.
        tilt, curve = 0.5 * (after - before), 0.5 * (after + before) - at
        t = np.zeros(len(rows))
        for _ in range(3):
            q = 1.0 + (at + t[:, None] * (tilt + t[:, None] * curve)) @ y
            turn, bend = (tilt + 2.0 * t[:, None] * curve) @ y, 2.0 * (curve @ y)
            slope, steep = (q.conj() * turn).real, np.abs(turn) ** 2 + (q.conj() * bend).real
            t = np.clip(t - slope / np.where(steep > 0.0, steep, np.inf), -1.0, 1.0)
        terms = at + t[:, None] * (tilt + t[:, None] * curve)
        moving = tilt + 2.0 * t[:, None] * curve
        q, turn = 1.0 + terms @ y, moving @ y
        size = np.maximum(np.abs(q), 1e-12)
        toward = ((q.conj() / size)[:, None] * terms).real
        steep = (np.abs(turn) ** 2 + 2.0 * (q.conj() * (curve @ y)).real) / size
        for (kind, k), weight in weights.items():
            if kind != VALLEY or not len(rows):
                continue
            v = int(np.argmin(np.abs(rows - k)))
            if abs(int(rows[v]) - k) > SAME_VALLEY:
                continue
            curved = np.outer(terms[v].conj(), terms[v]).real - np.outer(toward[v], toward[v])
            hessian -= weight / size[v] * curved
            if abs(t[v]) < 1.0 and steep[v] > 0.0:
                # The valley's bottom moves along with the gains.
                shift = (turn[v].conj() * terms[v] + q[v].conj() * moving[v]).real / size[v]
                hessian += weight / steep[v] * np.outer(shift, shift)
        return _Valleys(rows, self._stability.margin[rows] - size, -toward)

    def _decay(self, y: Array) -> tuple[Array, Array]:
        """How far the slowest poles are from decaying fast enough, as a share of it."""
        wanted, (low, high) = self._stability.slowest_1_s, self._stability.cutoffs_hz
        alpha, beta, gamma = (float(x) for x in y * self._scale)
        gains = Gains(alpha, beta, gamma, low, high)
        values, slopes = [], []
        for model in self._stability.decaying:
            rates, turns = model.slowest_poles(gains, POLES)
            values.append(rates / wanted + 1.0)
            slopes.append(turns * self._scale / wanted)
        if not values:
            return np.zeros(0), np.zeros((0, 3))
        return np.concatenate(values), np.concatenate(slopes)


@dataclass(frozen=True, slots=True)
class _Valleys:
    """Bottoms of |1 + L|: grid rows they are at, what the margin lacks, slopes."""

    rows: NDArray[np.int64]
    values: Array
    slopes: Array


class _Look:
    """What the search sees at one point: constraints are kept where ``values <= 0``."""

    def __init__(
        self, objective: float, gradient: Array, hessian: Array, values: Array, slopes: Array, grid: int,
        keys: list[tuple[int, int]], limit_names: list[str],
    ) -> None:  # fmt: skip
        self.objective, self.gradient, self.hessian = objective, gradient, hessian
        self.values, self.slopes = values, slopes
        self._grid, self._keys = grid, keys
        worst = int(np.argmax(values))
        self.broken = max(0.0, float(values[worst]))
        kind, k = self._key(worst)
        self.worst = limit_names[k] if kind == LIMIT else NAMES[kind]

    def _key(self, row: int) -> tuple[int, int]:
        return (GRID, row) if row < self._grid else self._keys[row - self._grid]

    def weights(self, step: Step) -> dict[tuple[int, int], float]:
        """Multipliers of a step by kind and place of the constraint."""
        return {
            self._key(row): min(weight, HEAVIEST)
            for row, weight in zip(step.rows.tolist(), step.multipliers.tolist(), strict=True)
        }


def _convex(hessian: Array, damping: float) -> Array:
    """The nearest matrix without negative curvature, damped: every program is convex."""
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    floor = damping + 1e-9 * float(np.max(np.abs(values)))
    return np.asarray((vectors * (np.maximum(values, 0.0) + floor)) @ vectors.T)
