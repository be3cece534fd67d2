"""The physical limit: the least primary motion any linear controller can reach inside the coil's limits.

A second-order cone program per frequency in the complex current reference r. It is a certificate, not a
controller: no linear time-invariant law does better in steady state.
"""

import math
from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from tuning.types import ActiveLimit
from twin.plant.errors import RunError

DISPLACEMENT_SCALE_M = 20e-6
ACTIVE_SHARE = 1e-4


@dataclass(frozen=True, slots=True)
class CoilLimits:
    """Bounds on the coil in steady state: mean Joule power [W], peak current [A], peak stroke [m]."""

    joule_mean_w: float
    current_peak_a: float
    stroke_m: float
    resistance_ohm: float


@dataclass(frozen=True, slots=True)
class LimitResult:
    """Reference phasor [A] at the limit, the displacement it leaves [m], and what binds."""

    reference_a: complex
    displacement_m: float
    active: tuple[ActiveLimit, ...]


class LimitProblem:
    """Minimise |g0 + g r| subject to bounds on |i0 + i r| and |s0 + s r|, built once and parametrised (DPP)."""

    def __init__(self) -> None:
        self._r = cp.Variable(2)
        self._motion, self._motion0 = cp.Parameter((2, 2)), cp.Parameter(2)
        self._current, self._current0 = cp.Parameter((2, 2)), cp.Parameter(2)
        self._stroke, self._stroke0 = cp.Parameter((2, 2)), cp.Parameter(2)
        self._power_bound = cp.Parameter(nonneg=True)
        current = self._current @ self._r + self._current0
        self._constraints = {
            "power": cp.norm(current) <= self._power_bound,
            "current": cp.norm(current) <= 1.0,
            "stroke": cp.norm(self._stroke @ self._r + self._stroke0) <= 1.0,
        }
        objective = cp.Minimize(cp.norm(self._motion @ self._r + self._motion0))
        self._problem = cp.Problem(objective, list(self._constraints.values()))
        if not self._problem.is_dcp(dpp=True):
            raise RuntimeError("the limit problem lost its DPP form")
        # The first solve compiles, and rounds its last bit otherwise than those after it: get it over with.
        self.solve((1.0, 1.0), (1.0, 0.0), (1.0, 0.0), CoilLimits(1.0, 1.0, 1.0, 1.0))

    def solve(
        self,
        motion: tuple[complex, complex],
        current: tuple[complex, complex],
        stroke: tuple[complex, complex],
        limits: CoilLimits,
    ) -> LimitResult:
        """Solve for one frequency.

        Parameters
        ----------
        motion, current, stroke
            (per ampere of reference, without it): primary motion [m], coil current [A], stroke [m].

        Returns
        -------
        LimitResult
            ``displacement_m`` is recomputed from the reference, not read off the solver. The price of a
            limit is the gain in displacement per unit of it: m/W, m/A, m/m.

        Raises
        ------
        RunError
            If no reference keeps the limits (excitation alone already breaks one).
        """
        i_peak = limits.current_peak_a
        i_power = math.sqrt(2.0 * limits.joule_mean_w / limits.resistance_ohm)
        _fill(self._motion, self._motion0, motion, DISPLACEMENT_SCALE_M, i_peak)
        _fill(self._current, self._current0, current, i_peak, i_peak)
        _fill(self._stroke, self._stroke0, stroke, limits.stroke_m, i_peak)
        self._power_bound.value = i_power / i_peak
        try:
            self._problem.solve(solver=cp.CLARABEL)
        except cp.SolverError as error:
            raise RunError(f"the limit could not be solved: {error}") from error
        if self._problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or self._r.value is None:
            raise RunError(
                "no current keeps the limits: the excitation alone breaks one of current or stroke"
            )
        r = complex(self._r.value[0], self._r.value[1]) * i_peak
        r = _inside(r, current, min(i_peak, i_power))
        return LimitResult(
            reference_a=r,
            displacement_m=abs(motion[0] * r + motion[1]),
            active=self._active(limits, i_power),
        )

    def _active(self, limits: CoilLimits, i_power: float) -> tuple[ActiveLimit, ...]:
        # Multipliers are per unit of the scaled right-hand side: i_peak amperes, one stroke limit.
        scale = {
            "power": limits.current_peak_a * limits.resistance_ohm * i_power,  # dP = R i di
            "current": limits.current_peak_a,
            "stroke": limits.stroke_m,
        }
        active = []
        for name, constraint in self._constraints.items():
            multiplier = float(np.max(constraint.dual_value)) if constraint.dual_value is not None else 0.0
            if multiplier > ACTIVE_SHARE:
                active.append(ActiveLimit(name, multiplier * DISPLACEMENT_SCALE_M / scale[name]))
        return tuple(active)


def least_motion_closed_form(
    motion: tuple[complex, complex], current: tuple[complex, complex], current_bound_a: float
) -> float:
    """Least |g0 + g r| [m] with only |i0 + i r| bounded: closed form, the oracle of the cone program.

    In terms of the coil's current u: ``u* = u0 min(1, u_max/|u0|)`` with ``u0`` the current that nulls the motion.
    """
    per_current = motion[0] / current[0]
    passive = motion[1] - per_current * current[1]
    wanted = abs(passive / per_current)
    return float(abs(per_current) * max(0.0, wanted - current_bound_a))


def _fill(
    matrix: cp.Parameter, offset: cp.Parameter, pair: tuple[complex, complex], scale: float, unit: float
) -> None:
    per, alone = pair[0] * unit / scale, pair[1] / scale
    matrix.value = np.array([[per.real, -per.imag], [per.imag, per.real]])
    offset.value = np.array([alone.real, alone.imag])


def _inside(r: complex, current: tuple[complex, complex], bound_a: float) -> complex:
    """Pull a reference back onto the current bound where the solver's tolerance left it outside."""
    i = current[0] * r + current[1]
    return r if abs(i) <= bound_a else (i * (bound_a / abs(i)) - current[1]) / current[0]
