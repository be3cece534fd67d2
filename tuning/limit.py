"""The physical limit: the least primary motion any linear controller can reach inside the coil's limits.

Everything is affine in the complex current reference r (`steady`), so every limit is a disc in its plane:

    |y_r r + y_0| <= bound      for current, Joule power (|i| <= sqrt(2 P/R)), stroke and voltage

and so is the mean electrical power ``½ Re(v i*)``. Its quadratic part is ``|i_r|² (R + k² Re Y)/2``, Y the mobility
between the coil's ends, which is not negative for bodies on springs and dampers; completing the square leaves a disc.
The least motion is then the point of the discs' intersection next to the one that stills the body: a second-order
cone program of two real variables, at whose solution at most two discs bind. Trying these is exact and quick; the
cone program (`LimitProgram`) is what it is checked against. A certificate, not a controller: no linear
time-invariant law does better in steady state.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from tuning.steady import Pair, SteadyPaths
from tuning.types import ActiveLimit, BudgetKind
from twin.plant.errors import RunError

INSIDE = 1e-9
"""Share of a disc's radius by which a point on its rim may lie outside: rounding."""

SLOTS = 6
"""Constraints of the cone program, unused ones included."""


@dataclass(frozen=True, slots=True)
class CoilLimits:
    """Bounds on the coil in steady state: mean powers [W], peak current [A], stroke [m], terminal voltage [V]."""

    joule_mean_w: float
    current_peak_a: float
    stroke_m: float
    resistance_ohm: float
    voltage_peak_v: float = math.inf
    electrical_mean_w: float = math.inf


@dataclass(frozen=True, slots=True)
class Disc:
    """``|slope r + offset| <= bound``, and how much the bound grows per unit of the limit it stands for."""

    name: str
    slope: complex
    offset: complex
    bound: float
    per_unit: float = 1.0

    @property
    def centre(self) -> complex:
        """Reference [A] at which the bounded quantity is least."""
        return -self.offset / self.slope

    @property
    def radius(self) -> float:
        """How far from the centre the reference may be [A]."""
        return self.bound / abs(self.slope)

    def excess(self, reference_a: complex) -> float:
        """By how much a reference is outside, as a share of the radius; below 0 inside."""
        return abs(self.slope * reference_a + self.offset) / self.bound - 1.0


@dataclass(frozen=True, slots=True)
class LimitResult:
    """Reference phasor [A] at the limit, the displacement it leaves [m], and what binds."""

    reference_a: complex
    displacement_m: float
    active: tuple[ActiveLimit, ...]


@dataclass(frozen=True, slots=True)
class LeastPower:
    """Least power [W] that meets a displacement, at which reference [A], and what binds [W per unit]."""

    power_w: float
    reference_a: complex
    active: tuple[ActiveLimit, ...]


def discs(paths: SteadyPaths, limits: CoilLimits) -> list[Disc]:
    """Limits as discs; infinite ones are left out.

    Raises
    ------
    RunError
        If no reference at all keeps the electrical power, whose name the message gives.
    """
    i_power = math.sqrt(2.0 * limits.joule_mean_w / limits.resistance_ohm)
    out = [
        Disc("power", *paths.current, i_power, 1.0 / (limits.resistance_ohm * i_power)),
        Disc("current", *paths.current, limits.current_peak_a),
        Disc("stroke", *paths.stroke, limits.stroke_m),
        Disc("voltage", *paths.voltage, limits.voltage_peak_v),
    ]
    if limits.electrical_mean_w < math.inf:
        slope, offset, least_w = electrical_square(paths)
        if limits.electrical_mean_w <= least_w:
            raise RunError(
                f"electrical: no current keeps {limits.electrical_mean_w:.3g} W, the least is {least_w:.3g} W"
            )
        bound = math.sqrt(limits.electrical_mean_w - least_w)
        out.append(Disc("electrical", slope, offset, bound, 0.5 / bound))
    return [d for d in out if d.bound < math.inf]


def electrical_square(paths: SteadyPaths) -> tuple[complex, complex, float]:
    """Mean electrical power [W] as ``|slope r + offset|² + least``.

    Raises
    ------
    RunError
        If it is not convex in r: the bodies would give out energy of their own.
    """
    (v, v_0), (i, i_0) = paths.voltage, paths.current
    curvature = 0.5 * (v * i.conjugate()).real
    if not curvature > 0.0:
        raise RunError("electrical power is not convex: the plant's dampers give out energy")
    linear = 0.5 * (v * i_0.conjugate() + v_0.conjugate() * i)
    root = math.sqrt(curvature)
    offset = linear.conjugate() / (2.0 * root)
    return complex(root), offset, 0.5 * (v_0 * i_0.conjugate()).real - abs(offset) ** 2


def physical_limit(paths: SteadyPaths, limits: CoilLimits) -> LimitResult:
    """Least primary motion at one frequency, in closed form.

    Returns
    -------
    LimitResult
        The price of a limit is the gain in displacement per unit of it: m/W, m/A, m/m, m/V.

    Raises
    ------
    RunError
        If no reference keeps the limits; the message begins with the names of those that exclude each other.
    """
    bounds = discs(paths, limits)
    reference, prices = nearest(paths.motion, bounds)
    return LimitResult(
        reference,
        abs(paths.motion[0] * reference + paths.motion[1]),
        tuple(ActiveLimit(name, price) for name, price in prices),
    )


def least_power(
    paths: SteadyPaths, limits: CoilLimits, displacement_m: float, kind: BudgetKind = "joule_mean"
) -> LeastPower:
    """Least power of a kind that meets a displacement: the dual question, in closed form.

    With nothing but the displacement bounding it is ``|u|_min = |u0| - x_max/|Gu|``. ``displacement_m`` may be
    infinite: then it is the power that the other limits alone take. The limits' own powers are left aside.

    Raises
    ------
    RunError
        If no power meets it; the message begins with the names of the limits that exclude each other.
    """
    free = CoilLimits(
        math.inf, limits.current_peak_a, limits.stroke_m, limits.resistance_ohm, limits.voltage_peak_v
    )
    bounds = [d for d in discs(paths, free) if d.name != "power"]
    if displacement_m < math.inf:
        # Nothing is ever at rest to the last bit: a wish for zero is one for next to nothing.
        bounds.append(Disc("displacement", *paths.motion, max(displacement_m, 1e-9 * abs(paths.motion[1]))))
    if kind == "electrical":
        slope, offset, floor = electrical_square(paths)
        scale = 1.0
    else:
        (slope, offset), floor = paths.current, 0.0
        scale = limits.resistance_ohm * (1.0 if kind == "joule_peak" else 0.5)
    reference, prices = nearest((slope, offset), bounds)
    size = abs(slope * reference + offset)
    per_size = 2.0 * scale * size
    return LeastPower(
        floor + scale * size**2, reference, tuple(ActiveLimit(name, p * per_size) for name, p in prices)
    )


def nearest(target: Pair, bounds: Sequence[Disc]) -> tuple[complex, list[tuple[str, float]]]:
    """Reference inside all discs with the least ``|slope r + offset|`` of a target, and the prices of what binds.

    Raises
    ------
    RunError
        If the discs have no point in common.
    """
    wish = -target[1] / target[0]
    tried: list[tuple[complex, tuple[Disc, ...]]] = [(wish, ())]
    for d in bounds:
        away = wish - d.centre
        if abs(away) > 0.0:
            tried.append((d.centre + away * (d.radius / abs(away)), (d,)))
    tried += [(point, (a, b)) for k, a in enumerate(bounds) for b in bounds[k + 1 :] for point in _meet(a, b)]
    inside = [(z, on) for z, on in tried if all(d in on or d.excess(z) <= INSIDE for d in bounds)]
    if not inside:
        raise RunError(_conflict(bounds))
    best, on = min(inside, key=lambda pair: abs(pair[0] - wish))
    return best, _prices(target, wish, best, on)


def _meet(a: Disc, b: Disc) -> tuple[complex, ...]:
    """Points in which two rims cross."""
    between = b.centre - a.centre
    gap = abs(between)
    if gap == 0.0 or gap > a.radius + b.radius or gap < abs(a.radius - b.radius):
        return ()
    along = 0.5 * (gap + (a.radius - b.radius) * (a.radius + b.radius) / gap)
    across = math.sqrt(max(0.0, a.radius**2 - along**2))
    unit = between / gap
    return a.centre + unit * complex(along, across), a.centre + unit * complex(along, -across)


def _prices(target: Pair, wish: complex, best: complex, on: tuple[Disc, ...]) -> list[tuple[str, float]]:
    """Multipliers: the pull towards the wish is what the binding discs' outward normals add up to."""
    if not on or best == wish:
        return []
    pull = (wish - best) / abs(wish - best)
    normals = [(best - d.centre) / d.radius for d in on]
    columns = np.array([[n.real for n in normals], [n.imag for n in normals]])
    shares = np.linalg.lstsq(columns, np.array([pull.real, pull.imag]), rcond=None)[0]
    return [
        (d.name, float(share) * abs(target[0]) / abs(d.slope) * d.per_unit)
        for d, share in zip(on, shares, strict=True)
        if share > INSIDE
    ]


def _conflict(bounds: Sequence[Disc]) -> str:
    """Which limits exclude each other; the excitation alone breaks them and no current mends it."""
    for k, a in enumerate(bounds):
        for b in bounds[k + 1 :]:
            if abs(a.centre - b.centre) > a.radius + b.radius:
                return f"{a.name} and {b.name}: no current keeps the limits on both"
    names = ", ".join(d.name for d in bounds)
    return f"{names}: no current keeps the limits on all of them"


class LimitProgram:
    """The same question as a second-order cone program (CVXPY), built once and parametrised (DPP)."""

    def __init__(self) -> None:
        self._r = cp.Variable(2)
        self._target, self._target0 = cp.Parameter((2, 2)), cp.Parameter(2)
        self._slopes = [cp.Parameter((2, 2)) for _ in range(SLOTS)]
        self._offsets = [cp.Parameter(2) for _ in range(SLOTS)]
        constraints = [
            cp.norm(slope @ self._r + offset) <= 1.0
            for slope, offset in zip(self._slopes, self._offsets, strict=True)
        ]
        self._problem = cp.Problem(cp.Minimize(cp.norm(self._target @ self._r + self._target0)), constraints)
        if not self._problem.is_dcp(dpp=True):
            raise RuntimeError("the limit program lost its DPP form")

    def nearest(self, target: Pair, bounds: Sequence[Disc]) -> tuple[complex, list[tuple[str, float]]]:
        """See the function `nearest`.

        Raises
        ------
        RunError
            If the discs have no point in common.
        """
        unit = max((abs(d.centre) + min(d.radius, 1e6) for d in bounds), default=1.0)
        size = max(abs(target[1]), abs(target[0]) * unit)
        _fill(self._target, self._target0, target, size, unit)
        for k in range(SLOTS):
            if k < len(bounds):
                d = bounds[k]
                _fill(self._slopes[k], self._offsets[k], (d.slope, d.offset), d.bound, unit)
            else:
                _fill(self._slopes[k], self._offsets[k], (0j, 0j), 1.0, unit)
        try:
            self._problem.solve(solver=cp.CLARABEL)
        except cp.SolverError as error:
            raise RunError(f"the limit could not be solved: {error}") from error
        if self._problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or self._r.value is None:
            raise RunError(_conflict(bounds))
        prices = []
        for d, constraint in zip(bounds, self._problem.constraints, strict=False):
            multiplier = float(np.max(constraint.dual_value)) if constraint.dual_value is not None else 0.0
            if multiplier > 1e-6:
                prices.append((d.name, multiplier * size / d.bound * d.per_unit))
        return complex(self._r.value[0], self._r.value[1]) * unit, prices


def _fill(matrix: cp.Parameter, offset: cp.Parameter, pair: Pair, scale: float, unit: float) -> None:
    per, alone = pair[0] * unit / scale, pair[1] / scale
    matrix.value = np.array([[per.real, -per.imag], [per.imag, per.real]])
    offset.value = np.array([alone.real, alone.imag])
