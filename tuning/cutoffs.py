"""Filter cutoffs by geometric program, verified by a Lyapunov solve on the sampled closed loop.

    minimise   phase of the filters at the excitation, each term of the law weighted by its share of the force
    subject to (R/k²) n² [0.2777 gamma² f_hp^-3/(2 pi)^4 + 1.1107 beta² f_hp^-1/(2 pi)² + 1.1107 alpha² f_lp] <= P,
               box bounds

in the low-pass f_lp and high-pass f_hp; all terms are posynomials (Boyd et al., *A tutorial on geometric programming*,
2007). The left side is the Joule power that white acceleration noise n burns through the three paths, each alone and
open. What the closed loop burns is up to a quarter more or less: that is computed exactly, and the program asked
again until it holds.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np

from tuning.law_loop import LawLoop, rig_law
from tuning.loop import LoopFacts
from tuning.sampled import RELATIVE_ACCELERATION, relative_noise_density, sampled_plant
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError

SECOND_ORDER = math.pi / (2.0 * math.sqrt(2.0))
"""Noise bandwidth of a 2nd-order Butterworth low-pass over its cutoff; the same for one integral behind a high-pass."""
TWICE_INTEGRATED = math.pi / (8.0 * math.sqrt(2.0))
"""Of two integrals, each behind the high-pass: integral of x⁴/(1 + x⁴)² from 0."""
USED = 0.9
"""A noise budget that decides the cutoffs is used to at least this share."""
SETTLED = 0.02
SCANNED = 25
"""High-pass cutoffs that are tried where the program's own are unstable."""


@dataclass(frozen=True, slots=True)
class CutoffBounds:
    """Box of the cutoffs [Hz]; the upper bound of the low-pass is where spill-over begins."""

    low_pass_min_hz: float = 100.0
    low_pass_max_hz: float = 2000.0
    high_pass_min_hz: float = 0.2
    high_pass_max_hz: float = 20.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("low_pass", self.low_pass_min_hz, self.low_pass_max_hz),
            ("high_pass", self.high_pass_min_hz, self.high_pass_max_hz),
        ):
            if not 0.0 < low <= high < math.inf:
                raise InputError(
                    f"{name}_min_hz and {name}_max_hz must be above 0 and in order, got {low:g}, {high:g}"
                )


@dataclass(frozen=True, slots=True)
class Cutoffs:
    """Verified cutoffs.

    Attributes
    ----------
    low_pass_hz, high_pass_hz
        Of the 2nd-order Butterworth filters [Hz].
    phase_rad
        Phase of filters and delay at the excitation, weighted over the law's terms; leads and lags both count.
    noise_power_w, verified_noise_power_w
        Mean Joule power that sensor noise burns: as the program has it, and in the sampled closed loop [W].
    decay_rate_1_s
        Slowest pole of the closed loop [1/s], the slowest over the dampings that were verified.
    """

    low_pass_hz: float
    high_pass_hz: float
    phase_rad: float
    noise_power_w: float
    verified_noise_power_w: float
    decay_rate_1_s: float


class CutoffProgram:
    """Cutoffs for given gains; the geometric program is built once and parametrised (DPP).

    Parameters
    ----------
    plant, facts
        What the closed loop is verified on.
    noise_density
        One-sided, of the acceleration the law uses [m/s² per sqrt(Hz)]; None takes the plant's accelerometers.
    """

    def __init__(self, plant: Plant, facts: LoopFacts, noise_density: float | None = None) -> None:
        if noise_density is not None and not 0.0 < noise_density < math.inf:
            raise InputError(f"noise_density must be greater than 0 m/s² per sqrt(Hz), got {noise_density}")
        coil = plant.voice_coil
        if coil is None:
            raise InputError(f"plant '{plant.name}' has no voice coil: there are no cutoffs to choose")
        self.plant, self.facts, self._coil = plant, facts, coil
        self._density = noise_density
        self._low, self._high = cp.Variable(pos=True), cp.Variable(pos=True)
        names = ["lead", "lag", "position", "velocity", "acceleration"]
        names += ["low_min", "low_max", "high_min", "high_max"]
        self._parameter = {name: cp.Parameter(pos=True) for name in names}
        p = self._parameter
        noise = p["position"] * self._high**-3 + p["velocity"] / self._high + p["acceleration"] * self._low
        constraints = [
            noise <= 1.0,
            self._low >= p["low_min"],
            self._low <= p["low_max"],
            self._high >= p["high_min"],
            self._high <= p["high_max"],
        ]
        self._problem = cp.Problem(cp.Minimize(p["lead"] * self._high + p["lag"] / self._low), constraints)
        if not self._problem.is_dgp(dpp=True):
            raise RuntimeError("the cutoff program lost its DGP form")

    def solve(
        self,
        gains: Gains,
        frequency_hz: float,
        *,
        noise_budget_w: float,
        bounds: CutoffBounds | None = None,
        damping_ns_m: tuple[float, ...] | None = None,
        slowest_decay_1_s: float = 0.5,
    ) -> Cutoffs:
        """Least filter phase within the noise budget, stable on the sampled rig.

        Parameters
        ----------
        gains
            Of the law; its cutoffs are not used.
        frequency_hz
            Of the excitation [Hz].
        noise_budget_w
            Mean Joule power that sensor noise may burn [W].
        bounds
            Box of the cutoffs.
        damping_ns_m
            Absorber dampings at which the loop must be stable, the first of which the noise is for; None takes the
            plant's own [Ns/m].
        slowest_decay_1_s
            Every closed-loop pole decays at least this fast.

        Raises
        ------
        InputError
            For a budget or a frequency that is not above zero.
        RunError
            If no cutoffs in the box keep budget and stability; the message names which, and what would do.
        """
        if not (0.0 < noise_budget_w < math.inf and 0.0 < frequency_hz < math.inf):
            raise InputError("noise_budget_w and frequency_hz must be numbers greater than 0")
        box = bounds or CutoffBounds()
        cap, scanned = noise_budget_w, False
        best: Cutoffs | None = None
        for _ in range(20):
            pair = self._program(gains, frequency_hz, cap, box)
            if pair is None:
                break
            found = self.verify(
                replace(gains, low_pass_hz=pair[0], high_pass_hz=pair[1]), frequency_hz, damping_ns_m
            )
            if not found.decay_rate_1_s < -slowest_decay_1_s:
                if scanned:
                    break
                box = self._stable_part(
                    gains, frequency_hz, noise_budget_w, box, damping_ns_m, slowest_decay_1_s
                )
                scanned, best = True, None
                continue
            share = found.verified_noise_power_w / noise_budget_w
            if share <= 1.0:
                if best is None or found.phase_rad < best.phase_rad:
                    best = found
                limited = found.high_pass_hz > 1.001 * box.high_pass_min_hz
                limited = limited or found.low_pass_hz < 0.999 * box.low_pass_max_hz
                if share >= USED or not limited:
                    return best
            cap *= 0.97 / max(share, 0.3)
        if best is not None:
            return best
        # The program found none: the scan knows why, or finds some in spite of it.
        part = self._stable_part(gains, frequency_hz, noise_budget_w, box, damping_ns_m, slowest_decay_1_s)
        return self.verify(
            replace(gains, low_pass_hz=part.low_pass_max_hz, high_pass_hz=part.high_pass_min_hz),
            frequency_hz,
            damping_ns_m,
        )

    def _stable_part(
        self,
        gains: Gains,
        frequency_hz: float,
        budget_w: float,
        box: CutoffBounds,
        damping_ns_m: tuple[float, ...] | None,
        slowest_decay_1_s: float,
    ) -> CutoffBounds:
        """Narrow the box to high-pass cutoffs that are stable, the lowest of which keeps the noise budget.

        The high-pass has bounds on either side: its lead at the excitation destabilises from above, and where it
        comes near to a low mode of the plant from below.
        """
        low = box.low_pass_max_hz
        if gains.alpha_kg != 0.0:
            _, _, noise = self._terms(gains, frequency_hz, budget_w)
            low = min(low, max(box.low_pass_min_hz, 0.3 / noise[2]))
        scan = [
            self.verify(replace(gains, low_pass_hz=low, high_pass_hz=float(f)), frequency_hz, damping_ns_m)
            for f in np.geomspace(box.high_pass_min_hz, box.high_pass_max_hz, SCANNED)
        ]
        stable = [c.decay_rate_1_s < -slowest_decay_1_s for c in scan]
        if not any(stable):
            calmest = min(scan, key=lambda c: c.decay_rate_1_s)
            raise RunError(
                f"these gains do not settle at {frequency_hz:g} Hz with any high-pass from {box.high_pass_min_hz:g} to "
                f"{box.high_pass_max_hz:g} Hz: slowest pole {calmest.decay_rate_1_s:+.2f} 1/s at best, with "
                f"{calmest.high_pass_hz:.3g} Hz, wanted below -{slowest_decay_1_s:g} 1/s; other gains are needed"
            )
        fit = [k for k, c in enumerate(scan) if stable[k] and c.verified_noise_power_w <= budget_w]
        if not fit:
            least = min(c.verified_noise_power_w for k, c in enumerate(scan) if stable[k])
            raise RunError(
                f"sensor noise burns at least {least:.3g} W at {frequency_hz:g} Hz where the loop is stable, and "
                f"{budget_w:.3g} W are allowed; allow more, or smaller gains"
            )
        first = last = fit[0]
        while last + 1 < len(scan) and stable[last + 1]:
            last += 1
        return replace(
            box,
            low_pass_max_hz=low,
            high_pass_min_hz=scan[first].high_pass_hz,
            high_pass_max_hz=scan[last].high_pass_hz,
        )

    def verify(
        self, gains: Gains, frequency_hz: float, damping_ns_m: tuple[float, ...] | None = None
    ) -> Cutoffs:
        """Phase, noise and slowest pole of gains with their cutoffs, from the deployed numbers alone."""
        dampings: tuple[float | None, ...] = damping_ns_m or (None,)
        law = rig_law(gains, self._coil.force_constant_n_a, self.facts.sample_rate_hz)
        loops = [
            LawLoop(sampled_plant(self.plant, self.facts, frequency_hz, c, (RELATIVE_ACCELERATION,)), law)
            for c in dampings
        ]
        density = None if self._density is None else [self._density]
        lead, lag, noise = self._terms(gains, frequency_hz, 1.0)
        f_lp, f_hp = gains.low_pass_hz, gains.high_pass_hz
        return Cutoffs(
            low_pass_hz=f_lp,
            high_pass_hz=f_hp,
            phase_rad=lead * f_hp + lag / f_lp + math.tau * frequency_hz * self.facts.delay_s,
            noise_power_w=noise[0] * f_hp**-3 + noise[1] / f_hp + noise[2] * f_lp,
            verified_noise_power_w=loops[0].noise_power_w(density),
            decay_rate_1_s=max(loop.decay_rate_1_s() for loop in loops),
        )

    def _terms(
        self, gains: Gains, frequency_hz: float, budget_w: float
    ) -> tuple[float, float, tuple[float, float, float]]:
        """Phase [rad] per f_hp and per 1/f_lp, and the three noise terms as shares of a budget."""
        w = math.tau * frequency_hz
        stiffness = np.abs([gains.alpha_kg * w**2, gains.beta_ns_m * w, gains.gamma_n_m])
        total = float(stiffness.sum())
        shares = stiffness / total if total > 0.0 else np.array([0.0, 0.0, 1.0])
        lead = math.sqrt(2.0) * float(shares[1] + 2.0 * shares[2]) / frequency_hz
        lag = math.sqrt(2.0) * frequency_hz
        density = self._density or relative_noise_density(self.plant, self.facts.relative)
        unit = self._coil.resistance_ohm * (density / self._coil.force_constant_n_a) ** 2 / budget_w
        return (
            lead,
            lag,
            (
                unit * TWICE_INTEGRATED * gains.gamma_n_m**2 / math.tau**4,
                unit * SECOND_ORDER * gains.beta_ns_m**2 / math.tau**2,
                unit * SECOND_ORDER * gains.alpha_kg**2,
            ),
        )

    def _program(
        self, gains: Gains, frequency_hz: float, cap_w: float, box: CutoffBounds
    ) -> tuple[float, float] | None:
        """Optimal (low-pass, high-pass) [Hz], or None if the noise does not fit in the box."""
        lead, lag, noise = self._terms(gains, frequency_hz, cap_w)
        at_best = (
            noise[0] * box.high_pass_max_hz**-3
            + noise[1] / box.high_pass_max_hz
            + noise[2] * box.low_pass_min_hz
        )
        if at_best > 1.0:
            return None
        values = dict(zip(("position", "velocity", "acceleration"), noise, strict=True))
        values |= {"lead": lead, "lag": lag, "low_min": box.low_pass_min_hz, "low_max": box.low_pass_max_hz}
        values |= {"high_min": box.high_pass_min_hz, "high_max": box.high_pass_max_hz}
        for name, value in values.items():
            # A geometric program knows no zero.
            self._parameter[name].value = max(value, 1e-12)
        try:
            self._problem.solve(gp=True, solver=cp.CLARABEL)
        except cp.SolverError:
            return None
        if self._problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or self._low.value is None:
            return None
        low = min(max(float(self._low.value), box.low_pass_min_hz), box.low_pass_max_hz)
        high = min(max(float(self._high.value), box.high_pass_min_hz), box.high_pass_max_hz)
        return low, high


@dataclass(frozen=True, slots=True)
class JointTuning:
    """Gains and cutoffs that were found for each other; ``settled`` if another round would hardly change them."""

    gains: Gains
    cutoffs: Cutoffs
    rounds: int
    settled: bool


def tune_jointly(
    solve_gains: Callable[[float, float], Gains],
    program: CutoffProgram,
    frequency_hz: float,
    start_hz: tuple[float, float],
    *,
    noise_budget_w: float,
    bounds: CutoffBounds | None = None,
    damping_ns_m: tuple[float, ...] | None = None,
    slowest_decay_1_s: float = 0.5,
    rounds: int = 8,
) -> JointTuning:
    """Gains for the cutoffs, cutoffs for the gains, in turn, until both hold together.

    Parameters
    ----------
    solve_gains
        Of low-pass and high-pass [Hz]; the gains it returns carry these cutoffs. It may raise `RunError` where
        there are none with enough margin.
    start_hz
        Low-pass and high-pass in use [Hz].
    noise_budget_w, bounds, damping_ns_m, slowest_decay_1_s
        As `CutoffProgram.solve`.

    Raises
    ------
    RunError
        If no round ends with gains and cutoffs that are stable and keep the noise budget together.
    """
    box = bounds or CutoffBounds()
    trouble = ""
    # Gains for lagging filters may be unstable behind any others: then begin again with those that lag least.
    best: JointTuning | None = None
    for begin in (start_hz, (box.low_pass_max_hz, box.high_pass_min_hz)):
        try:
            gains, budget = solve_gains(*begin), noise_budget_w
            for done in range(1, rounds + 1):
                wanted = program.solve(
                    gains,
                    frequency_hz,
                    noise_budget_w=budget,
                    bounds=box,
                    damping_ns_m=damping_ns_m,
                    slowest_decay_1_s=slowest_decay_1_s,
                )
                gains = solve_gains(wanted.low_pass_hz, wanted.high_pass_hz)
                held = program.verify(gains, frequency_hz, damping_ns_m)
                if not (
                    held.verified_noise_power_w <= noise_budget_w and held.decay_rate_1_s < -slowest_decay_1_s
                ):
                    # The new gains burn more than those the cutoffs were for: leave them room.
                    trouble = f"sensor noise would burn {held.verified_noise_power_w:.3g} W, slowest pole "
                    trouble += f"{held.decay_rate_1_s:+.2f} 1/s"
                    budget *= min(0.9, 0.9 * noise_budget_w / held.verified_noise_power_w)
                    continue
                settled = best is not None and _apart(held, best.cutoffs) <= SETTLED
                best = JointTuning(gains, held, done, settled)
                if settled:
                    return best
        except RunError as error:
            trouble = str(error)
        if best is not None:
            return best
    raise RunError(f"gains and cutoffs do not come together at {frequency_hz:g} Hz: {trouble}")


def _apart(one: Cutoffs, other: Cutoffs) -> float:
    """Largest relative difference of the cutoffs."""
    return max(
        abs(math.log(one.low_pass_hz / other.low_pass_hz)),
        abs(math.log(one.high_pass_hz / other.high_pass_hz)),
    )
