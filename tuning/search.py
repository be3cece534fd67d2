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
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuning.active_set import Step, solve_step
from tuning.limit import Disc
from tuning.look import (
    DECAY,
    GRID,
    LIMIT,
    RANGE,
    VALLEY,
    look_at_grid,
    look_at_limits,
    look_at_motion,
    look_into_valleys,
)
from tuning.loop import RigModel
from tuning.steady import Pair
from twin.control.schedule import Gains
from twin.plant.linear import Array, ComplexArray

ITERATIONS = 20
FEASIBLE = 1e-6
SETTLED = 1e-4
TINY = 1e-9
ACCEPTED = 0.1
NOTHING = 1e-8
POLES = 3
HEAVIEST = 1e3
RIDGE = 1e-6
"""Weight of the gains' own size: of gains that are equally good the smallest win."""

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
        self._terms = np.ascontiguousarray(stability.terms * scale)
        self._margin = stability.margin
        self._inner = ~(stability.first | np.roll(stability.first, -1))
        self._stability = stability
        self._law: ComplexArray = np.array([c.law for c in conditions], dtype=np.complex128) * scale
        self._acceleration: ComplexArray = np.array([c.acceleration for c in conditions], dtype=np.complex128)
        self._target = np.array([c.target for c in conditions], dtype=np.complex128) / unit
        self._weight = np.array([c.weight for c in conditions])
        self._of = np.array([k for k, c in enumerate(conditions) for _ in c.bounds], dtype=np.int64)
        limits = [d for c in conditions for d in c.bounds]
        self._limit_names = [d.name for d in limits]
        self._slope = np.array([d.slope / d.bound for d in limits], dtype=np.complex128)
        self._offset = np.array([d.offset / d.bound for d in limits], dtype=np.complex128)
        self._enough = enough

    def is_stable(self, start: Array) -> bool:
        """Whether the loop decays with gains (3,) in SI units, however slowly."""
        return bool(np.all(self._decay(start / self._scale)[0] < 1.0))

    def run(self, start: Array, iterations: int = ITERATIONS) -> Found:
        """Search from a start (3,) in SI units, for so many iterations at most."""
        y = np.clip(start / self._scale, self._bounds[:, 0], self._bounds[:, 1])
        damping, penalty = 1e-3, 1e-2
        here = self._look(y, FREE)
        taken = 0
        while taken < iterations:
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
            binding, wanted = here.binding(step), ACCEPTED * float(promised)
            there = self._try(y, s, here, binding, penalty, wanted)
            gained = self._gained(here, there, penalty)
            if gained < wanted:
                # What binds bends, or its valley lies elsewhere: the same step once more, by the slopes found there.
                again = self._step_by(hessian, here, there, s)
                if again is not None:
                    elsewhere = self._try(y, again.step, here, there.binding(again), penalty, wanted)
                    if self._gained(here, elsewhere, penalty) > gained:
                        s, there = again.step, elsewhere
                        gained = self._gained(here, there, penalty)
            if gained >= wanted:
                y, here = y + s, there
                damping = max(0.2 * damping, 1e-7)
            elif float(np.max(np.abs(s))) < TINY:
                break
            else:
                # From a damping that is felt on, each one shortens the step.
                damping = max(5.0 * damping, 0.5 * float(s @ hessian @ s) / float(s @ s))
                # The curvature of what binds belongs to the model even where the step is not taken.
                here = self._look(y, binding, here.decay)
        return self._found(y, here, taken)

    def _try(
        self, y: Array, s: Array, here: "_Look", binding: "_Binding", penalty: float, wanted: float
    ) -> "_Look":
        """Look at the end of a step; its poles, which cost most, only if nothing else speaks against it."""
        values, slopes = here.decay
        there = self._look(y + s, binding, (values + slopes @ s, slopes))
        if self._gained(here, there, penalty) < wanted:
            return there
        return there.with_decay(self._decay(y + s))

    @staticmethod
    def _gained(here: "_Look", there: "_Look", penalty: float) -> float:
        """How much less objective and breach there is at another point."""
        return here.objective - there.objective + penalty * (here.broken - there.broken)

    @staticmethod
    def _step_by(hessian: Array, here: "_Look", there: "_Look", s: Array) -> Step | None:
        """The step that keeps what is seen at the end of a step ``s`` (second-order correction)."""
        return solve_step(hessian, here.gradient, there.slopes, there.slopes @ s - there.values)

    def _found(self, y: Array, here: "_Look", iterations: int) -> Found:
        step = self._step(_convex(here.hessian, 1e-7), here)
        binding: dict[str, float] = {}
        if step is not None:
            what = here.binding(step)
            for kind, place, weight in zip(
                what.kinds.tolist(), what.places.tolist(), what.weights.tolist(), strict=True
            ):
                name = self._name(kind, place)
                binding[name] = binding.get(name, 0.0) + weight
        worst = self._name(int(here.kinds[here.worst]), int(here.places[here.worst]))
        return Found(y * self._scale, here.objective, here.broken, worst, binding, iterations)

    def _step(self, hessian: Array, here: "_Look") -> Step | None:
        """Step to what is asked or, where that leaves no room, part of the way, or at least no farther off."""
        for share in (1.0, 0.3, 0.0):
            upper = np.where(here.values > 0.0, -share * here.values, -here.values)
            step = solve_step(hessian, here.gradient, here.slopes, upper)
            if step is not None:
                return step
        return None

    def _look(self, y: Array, binding: "_Binding", decay: tuple[Array, Array] | None = None) -> "_Look":
        """Values, slopes and the Lagrangian's curvature at a point, for given multipliers of some constraints."""
        n, conditions, limits = len(self._margin), len(self._weight), len(self._of)
        gradient, hessian = np.empty(3), np.empty((3, 3))
        reference, first, second = (np.empty(conditions, dtype=np.complex128) for _ in range(3))
        objective = look_at_motion(
            y, self._law, self._acceleration, self._target, self._weight, RIDGE, gradient, hessian,
            reference, first, second,
        )  # fmt: skip
        if decay is None:
            decay = self._decay(y)
        room = n + n // 2 + limits + len(decay[0]) + 2 * len(y)
        values, slopes, distance = np.empty(room), np.empty((room, 3)), np.empty(n)
        kinds, places = np.zeros(room, dtype=np.int64), np.empty(room, dtype=np.int64)
        # Points of the grid only keep long steps from jumping over a valley; at rest its very bottom decides, and
        # not the pocket between two points.
        look_at_grid(self._terms, self._margin, y, distance, values, slopes)
        places[:n] = np.arange(n)
        valleys = look_into_valleys(
            self._terms, self._margin, self._inner, y, distance, *binding.of(VALLEY), values[n:], slopes[n:],
            places[n:], hessian,
        )  # fmt: skip
        at, end = n + valleys, n + valleys + limits
        look_at_limits(
            self._law, self._of, self._slope, self._offset, reference, first, second, *binding.of(LIMIT),
            values[at:], slopes[at:], hessian,
        )  # fmt: skip
        kinds[n:at], kinds[at:end], places[at:end] = VALLEY, LIMIT, np.arange(limits)
        for kind, value, slope in (
            (DECAY, *decay), (RANGE, y - self._bounds[:, 1], np.eye(3)), (RANGE, self._bounds[:, 0] - y, -np.eye(3)),
        ):  # fmt: skip
            begin, end = end, end + len(value)
            values[begin:end], slopes[begin:end] = value, slope
            kinds[begin:end], places[begin:end] = kind, np.arange(len(value))
        values = values[:end]
        return _Look(
            objective,
            gradient,
            hessian,
            values,
            slopes[:end],
            kinds[:end],
            places[:end],
            decay,
            *_worst(values),
        )

    def _decay(self, y: Array) -> tuple[Array, Array]:
        """How far the slowest poles are from decaying fast enough, as a share of it."""
        wanted, (low, high) = self._stability.slowest_1_s, self._stability.cutoffs_hz
        alpha, beta, gamma = (float(x) for x in y * self._scale)
        gains = Gains(alpha, beta, gamma, low, high)
        values, slopes = [np.zeros(0)], [np.zeros((0, 3))]
        for model in self._stability.decaying:
            rates, turns = model.slowest_poles(gains, POLES)
            values.append(rates / wanted + 1.0)
            slopes.append(turns * self._scale / wanted)
        return np.concatenate(values), np.concatenate(slopes)

    def _name(self, kind: int, place: int) -> str:
        return self._limit_names[place] if kind == LIMIT else NAMES[kind]


@dataclass(frozen=True, slots=True)
class _Binding:
    """Which constraints bind: kind, place and multiplier of each, (m,)."""

    kinds: NDArray[np.int64]
    places: NDArray[np.int64]
    weights: Array

    def of(self, kind: int) -> tuple[NDArray[np.int64], Array]:
        """Places and multipliers of those of one kind."""
        chosen = self.kinds == kind
        return self.places[chosen], self.weights[chosen]


FREE = _Binding(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))


@dataclass(frozen=True, slots=True)
class _Look:
    """What the search sees at one point: constraints are kept where ``values <= 0``.

    Attributes
    ----------
    decay
        Values and slopes of the decay's rows.
    worst, broken
        Row of the constraint that is broken most, and by how much.
    """

    objective: float
    gradient: Array
    hessian: Array
    values: Array
    slopes: Array
    kinds: NDArray[np.int64]
    places: NDArray[np.int64]
    decay: tuple[Array, Array]
    worst: int
    broken: float

    def with_decay(self, decay: tuple[Array, Array]) -> "_Look":
        """The same point with other poles."""
        rows, values, slopes = self.kinds == DECAY, self.values.copy(), self.slopes.copy()
        values[rows], slopes[rows] = decay
        worst, broken = _worst(values)
        return replace(self, values=values, slopes=slopes, decay=decay, worst=worst, broken=broken)

    def binding(self, step: Step) -> _Binding:
        """What a step leans on."""
        return _Binding(self.kinds[step.rows], self.places[step.rows], np.minimum(step.multipliers, HEAVIEST))


def _worst(values: Array) -> tuple[int, float]:
    row = int(values.argmax())
    return row, max(0.0, float(values[row]))


def _convex(hessian: Array, damping: float) -> Array:
    """The nearest matrix without negative curvature, damped: every program is convex."""
    values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
    floor = damping + 1e-9 * float(np.max(np.abs(values)))
    return np.asarray((vectors * (np.maximum(values, 0.0) + floor)) @ vectors.T)
