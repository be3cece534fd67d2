"""Power-budgeted LQ control: the weights are the Lagrange multipliers of the limits.

    minimise E[v1²]   subject to   R E[u²]/k² <= P,   E[x_r²] <= stroke²/2,   E[v i] <= P_electrical

over all state feedbacks of an `ExcitedPlant`; the limits hold for its line as well as for pure sines at its frequency
and a drift beside it. The problem is convex in the second moments of state and force, and its multipliers make the
one quadratic cost whose LQ gain is the optimum. One binding limit is a secant on the logarithm of its multiplier,
several start from the semidefinite program in `budget_sdp`. What is deployed is always the LQ gain of the stated
weights.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tuning.budget_sdp import BudgetProgram
from tuning.excited import ExcitedPlant, Scaling, balance, excited_plant
from tuning.multipliers import BudgetProblem, Limit, LQPoint, meet_all, meet_one
from tuning.types import ActiveLimit
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.linear import Array, read_only

DISPLACEMENT_SCALE_M = 20e-6
EFFORT_FLOOR = 0.01


@dataclass(frozen=True)
class LQDesign:
    """LQ gain ``u = -K x`` [N] on the states of an `ExcitedPlant`, with the weights it follows from.

    All matrices are in SI units; the cost ``x'Q x + R u² + 2 u N'x`` is dimensionless, 1 for 20 µm
    rms of primary motion.
    N is zero unless electrical power binds. `control.lqr` with ``excited.A``, ``excited.b``, Q, R and N gives K.

    Attributes
    ----------
    excited
        The model the gain is for.
    Q, R, N, K
        (n, n), float, (n,), (n,).
    multipliers
        By limit, of each limit as a share of itself, in units of the cost; 0 where it does not bind.
    effort_floor
        Weight on the force that remains where power is slack, in the multipliers' units.
    achieved_displacement_m, stroke_m, current_peak_a
        Peaks under a pure sine at the nominal frequency.
    joule_mean_w, joule_peak_w, electrical_mean_w
        R i_rms², R i_peak² and the mean of v i under that sine [W].
    line_joule_mean_w
        R i_rms² under an excitation with the line's width [W].
    drift_joule_mean_w
        The largest R i_rms² under a sine that is off by the drift that was allowed for [W].
    duality_gap
        Primal less dual value over the primal, both recomputed from K and from the Riccati equation.
    prices
        Binding limits and what one more unit of each buys [m per unit].
    evaluations
        Riccati equations solved.
    """

    excited: ExcitedPlant
    Q: Array
    R: float
    N: Array
    K: Array
    multipliers: dict[str, float]
    effort_floor: float
    achieved_displacement_m: float
    stroke_m: float
    current_peak_a: float
    joule_mean_w: float
    joule_peak_w: float
    electrical_mean_w: float
    line_joule_mean_w: float
    drift_joule_mean_w: float
    duality_gap: float
    prices: tuple[ActiveLimit, ...]
    evaluations: int

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states that K acts on."""
        return self.excited.states

    def as_json(self) -> dict[str, Any]:
        """All that is needed to recompute K: states, A, B, Q, R, K, and N where it is not zero."""
        cross = {"N": self.N.tolist()} if self.N.any() else {}
        return {
            "states": list(self.states),
            "A": self.excited.A.tolist(),
            "B": self.excited.b.tolist(),
            "Q": self.Q.tolist(),
            "R": self.R,
            **cross,
            "K": self.K.tolist(),
            "input": "force_n",
            "relative_bandwidth": self.excited.relative_bandwidth,
        }


class PowerBudgetedLQ:
    """Solve the power-budgeted LQ problem for one plant at any operating point.

    Parameters
    ----------
    plant
        With a voice coil on an absorber and one further actuator, which excites.
    relative_bandwidth
        zeta of the excitation's line; the optimum goes to the physical limit as it goes to zero.
    effort_floor
        Least weight on the force, where 1 weighs full force like 20 µm. Without it the gain grows without bound
        where power is slack.
    """

    def __init__(
        self, plant: Plant, *, relative_bandwidth: float = 1e-5, effort_floor: float = EFFORT_FLOOR
    ) -> None:
        if not 0.0 < effort_floor < math.inf:
            raise InputError(f"effort_floor must be a number greater than 0, got {effort_floor}")
        self.plant, self.relative_bandwidth, self.effort_floor = plant, relative_bandwidth, effort_floor
        self._programs: dict[tuple[int, int], BudgetProgram] = {}

    def solve(
        self,
        frequency_hz: float,
        excitation_amplitude: float,
        damping_ns_m: float | None = None,
        *,
        joule_mean_w: float = math.inf,
        current_peak_a: float = math.inf,
        electrical_mean_w: float = math.inf,
        stroke_m: float = math.inf,
        drift_hz: float = 0.0,
    ) -> LQDesign:
        """Weights and gain for one operating point.

        Parameters
        ----------
        frequency_hz, excitation_amplitude, damping_ns_m
            As `excited_plant`.
        joule_mean_w, current_peak_a, electrical_mean_w, stroke_m
            Limits: R i_rms² [W], peak current [A], mean of v i [W], peak stroke [m]; infinite is none.
        drift_hz
            The limits hold with the excitation this much off the frequency as well.

        Raises
        ------
        InputError
            As `excited_plant`; if a limit is not positive or none bounds the coil's power or current.
        RunError
            If no gain keeps the limits.
        """
        bounds = {
            "joule_mean_w": joule_mean_w, "current_peak_a": current_peak_a,
            "electrical_mean_w": electrical_mean_w, "stroke_m": stroke_m,
        }  # fmt: skip
        for name, value in bounds.items():
            if not value > 0.0:
                raise InputError(f"{name} must be greater than 0, got {value}")
        if not 0.0 <= drift_hz < frequency_hz:
            raise InputError(f"drift_hz must be from 0 to below frequency_hz, got {drift_hz}")
        excited = excited_plant(
            self.plant,
            frequency_hz,
            excitation_amplitude,
            damping_ns_m,
            relative_bandwidth=self.relative_bandwidth,
        )
        scaling, limits = self._limits(excited, bounds)
        A, b = scaling.model(excited)
        objective = np.zeros((len(A) + 1,) * 2)
        row = np.append(excited.velocity * scaling.scale, 0.0)
        objective += np.outer(row, row) / (scaling.angular_frequency * DISPLACEMENT_SCALE_M) ** 2
        objective[-1, -1] = self.effort_floor
        drift = drift_hz / frequency_hz
        problem = BudgetProblem(
            A=A,
            b=b,
            noise=np.ascontiguousarray(excited.noise[-2:]) / math.sqrt(scaling.angular_frequency),
            objective=objective,
            limits=limits,
            ratios=np.array([1.0, 1.0 - drift, 1.0 + drift] if drift else [1.0]),
            steepness=self._steepness(excited, scaling),
        )
        return self._design(excited, scaling, problem, self._solve(problem, excited, bounds))

    def _limits(self, excited: ExcitedPlant, bounds: dict[str, float]) -> tuple[Scaling, tuple[Limit, ...]]:
        coil = excited.coil
        k, ohm = coil.force_constant_n_a, coil.resistance_ohm
        thermal, peak = bounds["joule_mean_w"], bounds["current_peak_a"]
        # Both bound the same mean square: that of the current.
        power = min(thermal, 0.5 * ohm * peak**2)
        largest = min(power, bounds["electrical_mean_w"])
        if not math.isfinite(largest):
            raise InputError(
                "give a limit on the coil: joule_mean_w [W], current_peak_a [A] or electrical_mean_w [W]"
            )
        scaling = balance(excited, math.sqrt(largest / ohm) * k)
        size = len(excited.states) + 1
        stretch = np.append(scaling.scale, scaling.force_n)

        def form(left: Array, right: Array) -> Array:
            product = np.outer(left * stretch, right * stretch)
            return np.asarray(0.5 * (product + product.T))

        force = np.zeros(size)
        force[-1] = 1.0
        limits = []
        if math.isfinite(power):
            heat = form(force, force) * ohm / k**2 / power
            if thermal <= 0.5 * ohm * peak**2:
                limits.append(Limit("power", heat, thermal, 1.0 / thermal))
            else:
                limits.append(Limit("current", heat, peak, 2.0 / peak))
        if math.isfinite(electrical := bounds["electrical_mean_w"]):
            drawn = form(force, force) * ohm / k**2 - form(force, np.append(excited.stroke_rate, 0.0))
            limits.append(Limit("electrical", drawn / electrical, electrical, 1.0 / electrical))
        if math.isfinite(stroke := bounds["stroke_m"]):
            travel = np.append(excited.stroke, 0.0)
            limits.append(Limit("stroke", form(travel, travel) * 2.0 / stroke**2, stroke, 2.0 / stroke))
        return scaling, tuple(limits)

    @staticmethod
    def _steepness(excited: ExcitedPlant, scaling: Scaling) -> float:
        """Squared motion per squared force, in scaled units: how fast the cost falls with the force."""
        n = excited.own_states
        per_newton = excited.phasors()[0] @ excited.velocity[:n] / excited.angular_frequency
        return float(per_newton * scaling.force_n / DISPLACEMENT_SCALE_M) ** 2

    def _solve(self, problem: BudgetProblem, excited: ExcitedPlant, bounds: dict[str, float]) -> LQPoint:
        point = problem.at(np.zeros(len(problem.limits)))
        broken = np.nonzero(point.worst > 1.0)[0]
        # A design that meets every limit with the multiplier of one alone is optimal: try those first.
        for k in sorted(broken, key=lambda i: -point.worst[i]):
            alone = meet_one(problem, int(k), point, self.effort_floor)
            if alone is not None and np.all(alone.worst <= 1.0):
                return alone
        if not len(broken):
            return point
        size = len(problem.A), len(problem.limits)
        if size not in self._programs:
            self._programs[size] = BudgetProgram(*size)
        noise = np.concatenate([np.zeros(len(problem.A) - 2), problem.noise])
        forms = [limit.form for limit in problem.limits]
        try:
            start = self._programs[size].multipliers(problem.A, problem.b, noise, problem.objective, forms)
            # No solver status is trusted, neither a good nor a bad one: what counts is what the start leads to.
            return meet_all(problem, np.ones(len(forms)) if start is None else start)
        except RunError as error:
            raise RunError(f"{error}{_stroke_needs(excited, bounds)}") from error

    def _design(
        self, excited: ExcitedPlant, scaling: Scaling, problem: BudgetProblem, point: LQPoint
    ) -> LQDesign:
        stretch = np.append(scaling.scale, scaling.force_n)
        form = point.form / np.outer(stretch, stretch)
        moments = point.moments * np.outer(stretch, stretch)
        coil, w = excited.coil, excited.angular_frequency
        k, ohm = coil.force_constant_n_a, coil.resistance_ohm
        sine = moments[1]
        speed = math.sqrt(2.0 * max(0.0, float(excited.velocity @ sine[:-1, :-1] @ excited.velocity)))
        stroke = math.sqrt(2.0 * max(0.0, float(excited.stroke @ sine[:-1, :-1] @ excited.stroke)))
        joule = ohm * float(sine[-1, -1]) / k**2
        # The cost is half the squared peak over 20 µm squared, and falls by the multiplier per share of the limit.
        per_share = DISPLACEMENT_SCALE_M**2 / (speed / w) if speed > 0.0 else 0.0
        prices = tuple(
            ActiveLimit(limit.name, float(weight) * per_share * limit.per_unit)
            for limit, weight in zip(problem.limits, point.multipliers, strict=True)
            if weight > 0.0
        )
        return LQDesign(
            excited=excited,
            Q=read_only(form[:-1, :-1]),
            R=float(form[-1, -1]),
            N=read_only(form[:-1, -1]),
            K=read_only(point.K * scaling.force_n / scaling.scale),
            multipliers={
                limit.name: float(m) for limit, m in zip(problem.limits, point.multipliers, strict=True)
            },
            effort_floor=self.effort_floor,
            achieved_displacement_m=speed / w,
            stroke_m=stroke,
            current_peak_a=math.sqrt(2.0 * joule / ohm),
            joule_mean_w=joule,
            joule_peak_w=2.0 * joule,
            electrical_mean_w=joule - float(excited.stroke_rate @ sine[:-1, -1]),
            line_joule_mean_w=ohm * float(moments[0, -1, -1]) / k**2,
            drift_joule_mean_w=ohm * float(moments[1:, -1, -1].max()) / k**2,
            duality_gap=point.gap,
            prices=prices,
            evaluations=problem.evaluations,
        )


def _stroke_needs(excited: ExcitedPlant, bounds: dict[str, float]) -> str:
    """What the stroke limit alone takes of current and power, for the message that it cannot be kept."""
    n = excited.own_states
    inputs = np.column_stack([excited.b[:n], math.sqrt(2.0) * excited.A[:n, n + 1]])
    resolvent = 1j * excited.angular_frequency * np.eye(n) - excited.A[:n, :n]
    per_newton, alone = np.abs(excited.stroke[:n] @ np.linalg.solve(resolvent, inputs))
    missing = alone - bounds["stroke_m"]
    if not 0.0 < missing < math.inf:
        return ""
    amperes = float(missing / per_newton) / excited.coil.force_constant_n_a
    return (
        f": without control the stroke is {1e3 * alone:.3g} mm, and to hold it to {1e3 * bounds['stroke_m']:.3g} mm "
        f"takes at least {amperes:.3g} A peak, {0.5 * excited.coil.resistance_ohm * amperes**2:.3g} W mean Joule"
    )
