"""Figures of a case: what its run came to, how stable its loop is, and which limit it broke first."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuning.campaign.batch import Case, Excitation
from tuning.campaign.kernel import (
    CONTROLLED,
    CURRENT_PEAK,
    CURRENT_SQUARES,
    MOTION_WORK,
    POWER_WINDOW_BLOCKS,
    SATURATED,
    STORED,
    STROKE_PEAK,
    X_PEAK,
)
from tuning.campaign.loops import least_margins, loop_models, slowest_pole
from tuning.types import BudgetKind
from twin.plant.config import DampingTable
from twin.plant.linear import Array, linear_model

Flags = NDArray[np.bool_]

WELL_CONDITIONED = 1e9
"""Eigenvectors worse than this are not trusted; the equations are then solved frequency by frequency."""


@dataclass(frozen=True, slots=True)
class Goal:
    """What a case must keep to count, beside the plant's own limits.

    Attributes
    ----------
    displacement_m, attenuation
        Most motion of the primary body [m] and least attenuation in the controlled, settled part of the run; None
        where it is not asked for.
    budget_w, budget_kind
        Power of the coil, averaged over the rig's window of a second; None for no budget.
    settle_s
        Motion counts from this long after the start, a jump of the frequency, or switching of the controller.
    """

    displacement_m: float | None = None
    attenuation: float | None = None
    budget_w: float | None = None
    budget_kind: BudgetKind = "joule_mean"
    settle_s: float = 1.0


@dataclass(frozen=True, slots=True)
class CaseFigures:
    """What became of one case; SI units, None where it cannot be told.

    Attributes
    ----------
    attenuation_mean, attenuation_worst
        1 - largest |x1| over the passive rig's in steady state, over the settled spans in which the schedule acts.
    displacement_m
        Largest |x1| of these spans.
    current_peak_a, stroke_m
        Largest of the run.
    joule_mean_w, joule_peak_w, electrical_mean_w
        R i² and v i averaged over the worst second, and R i² at its largest.
    saturated
        Share of samples with the current reference at its clamp.
    stable, growth_1_s, growth_hz
        Whether every closed-loop pole decays at every frequency of the grid; the largest real part [1/s] and where,
        None if the schedule acts nowhere on it.
    modulus_margin, delay_margin_s
        The least over the grid; of an unstable loop 0, and no delay below 8 ms destabilising is None.
    tripped_at_s
        When the rig switched control off by itself; None if it did not.
    first_limit, first_limit_s
        Limit broken first and when, empty and None for none: ``stroke``, ``current`` (the reference reaches its
        clamp), ``power``, ``budget``, ``displacement``, ``attenuation``.
    meets
        Whether no limit was broken and the loop is stable.
    """

    attenuation_mean: float | None
    attenuation_worst: float | None
    displacement_m: float | None
    current_peak_a: float
    stroke_m: float
    joule_mean_w: float
    joule_peak_w: float
    electrical_mean_w: float
    saturated: float
    stable: bool
    growth_1_s: float | None
    growth_hz: float | None
    modulus_margin: float
    delay_margin_s: float | None
    tripped_at_s: float | None
    first_limit: str
    first_limit_s: float | None
    meets: bool


class Judge:
    """Turns what the kernel hands back into figures.

    Parameters
    ----------
    excitation
        That the cases ran through.
    goal
        What they must keep.
    grid_hz
        Frequencies at which poles and margins are looked at; those at which the schedule does not act are left out.
    """

    def __init__(self, excitation: Excitation, goal: Goal, grid_hz: Sequence[float]) -> None:
        self._excitation, self._goal, self._grid = excitation, goal, tuple(grid_hz)
        fs = excitation.sample_rate_hz
        self._count = excitation.spans[:, 1] - excitation.spans[:, 0]
        self._end_s = excitation.spans[:, 1] / fs
        edges = excitation.edges_hz
        self._jump = np.concatenate([[True], edges[1:, 0] != edges[:-1, 1]])

    def figures(self, case: Case, run: Array, tripped_at_s: float) -> CaseFigures:
        """Figures of one case.

        Parameters
        ----------
        run
            (S, FIGURES) of the case.
        tripped_at_s
            -1 if the rig did not switch off.
        """
        models = loop_models(case, [f for f in self._grid if case.schedule.acts_at(f)])
        growth, at_hz = slowest_pole(case, models)
        modulus, delay = least_margins(case, models) if growth < 0.0 else (0.0, 0.0)
        acting = (self._excitation.middle_hz >= case.schedule.on_from_hz) & (
            self._excitation.middle_hz <= case.schedule.on_to_hz
        )
        settled = self._settled(run[:, CONTROLLED], acting)
        passive = self._passive(case, settled)
        moved = run[settled, X_PEAK]
        reduced = 1.0 - moved / passive
        coil, fs = case.coil, self._excitation.sample_rate_hz
        joule = coil.resistance_ohm * run[:, CURRENT_SQUARES]
        taken = joule + run[:, MOTION_WORK] + run[:, STORED] * fs
        peak = coil.resistance_ohm * run[:, CURRENT_PEAK] ** 2
        mean_joule, mean_taken = self._windowed(joule), self._windowed(taken)
        spent = {"joule_mean": mean_joule, "joule_peak": peak, "electrical": mean_taken}[
            self._goal.budget_kind
        ]
        first, when = self._first_limit(case, run, spent, mean_joule, settled, reduced)
        return CaseFigures(
            attenuation_mean=float(reduced.mean()) if len(reduced) else None,
            attenuation_worst=float(reduced.min()) if len(reduced) else None,
            displacement_m=float(moved.max()) if len(moved) else None,
            current_peak_a=float(run[:, CURRENT_PEAK].max()),
            stroke_m=float(run[:, STROKE_PEAK].max()),
            joule_mean_w=float(mean_joule.max()),
            joule_peak_w=float(peak.max()),
            electrical_mean_w=float(mean_taken.max()),
            saturated=float(run[:, SATURATED].sum() / self._count.sum()),
            stable=growth < 0.0,
            growth_1_s=growth if math.isfinite(growth) else None,
            growth_hz=at_hz,
            modulus_margin=modulus,
            delay_margin_s=delay,
            tripped_at_s=None if tripped_at_s < 0.0 else tripped_at_s,
            first_limit=first,
            first_limit_s=when,
            meets=not first and growth < 0.0,
        )

    def _settled(self, controlled: Array, acting: Flags) -> Flags:
        """(S,) whether a span's motion counts: the schedule acts, and nothing was switched or jumped lately."""
        switched = np.concatenate([[True], controlled[1:] != controlled[:-1]]) | self._jump
        begin_s = self._excitation.spans[:, 0] / self._excitation.sample_rate_hz
        since = begin_s - np.maximum.accumulate(np.where(switched, begin_s, -math.inf))
        return np.asarray(acting & (since >= self._goal.settle_s - 1e-9))

    def _windowed(self, sums: Array) -> Array:
        """Mean over the latest spans, as many as the rig's window has blocks, (S,)."""
        total = np.concatenate([[0.0], np.cumsum(sums)])
        count = np.concatenate([[0.0], np.cumsum(self._count)])
        k = np.arange(1, len(total))
        begin = np.maximum(0, k - POWER_WINDOW_BLOCKS)
        return np.asarray((total[k] - total[begin]) / (count[k] - count[begin]))

    def _passive(self, case: Case, settled: Flags) -> Array:
        """Motion of the passive rig in steady state at the settled spans [m]."""
        return passive_motion(case, self._excitation.middle_hz[settled])

    def _first_limit(
        self, case: Case, run: Array, spent: Array, mean_joule: Array, settled: Flags, reduced: Array
    ) -> tuple[str, float | None]:
        goal, limits, coil = self._goal, case.plant.limits, case.coil
        broken = {
            "stroke": run[:, STROKE_PEAK] > case.limit("stroke_m"),
            "current": run[:, SATURATED] > 0.0,
            "power": mean_joule > limits.get(f"{coil.name}_power_w", math.inf),
            "budget": spent > (math.inf if goal.budget_w is None else goal.budget_w),
        }
        loud, weak = np.zeros(len(run), dtype=np.bool_), np.zeros(len(run), dtype=np.bool_)
        if goal.displacement_m is not None:
            loud[settled] = run[settled, X_PEAK] > goal.displacement_m
        if goal.attenuation is not None:
            weak[settled] = reduced < goal.attenuation
        broken |= {"displacement": loud, "attenuation": weak}
        firsts = {name: int(np.argmax(where)) for name, where in broken.items() if where.any()}
        if not firsts:
            return "", None
        name = min(firsts, key=lambda key: firsts[key])
        return name, float(self._end_s[firsts[name]])


def passive_motion(case: Case, frequency_hz: Array) -> Array:
    """Largest |x1| of the plant in steady state without control [m], (n,): the coil's reference is zero."""
    plant, absorber = case.plant, case.plant.absorber
    if absorber is None or not isinstance(absorber.damping_ns_m, DampingTable):
        model = linear_model(plant, frequency_hz=50.0)
        decays, vectors = np.linalg.eig(model.A)
        if np.linalg.cond(vectors) < WELL_CONDITIONED:
            # In modes one product for each frequency.
            moved, shaken = model.states.index(f"x_{plant.primary.name}"), model.inputs.index(case.exciter)
            shares = vectors[moved] * np.linalg.solve(vectors, model.B[:, shaken].astype(np.complex128))
            return np.asarray(
                case.amplitude * np.abs((1.0 / (2j * np.pi * frequency_hz[:, None] - decays)) @ shares)
            )
    name = "" if absorber is None else absorber.name
    own = [linear_model(plant, frequency_hz=50.0, damping_ns_m={name: c} if name else {}) for c in (0.0, 1.0)]
    damping = np.array([0.0 if absorber is None else absorber.damping_at(float(f)) for f in frequency_hz])
    # The equations of motion are linear in the damping.
    A = own[0].A + damping[:, None, None] * (own[1].A - own[0].A)
    resolvent = 2j * np.pi * frequency_hz[:, None, None] * np.eye(A.shape[1]) - A
    into = own[0].B[:, own[0].inputs.index(case.exciter)]
    states = np.linalg.solve(resolvent, np.broadcast_to(into[:, None], (len(A), len(into), 1)))
    row = own[0].states.index(f"x_{plant.primary.name}")
    return np.asarray(case.amplitude * np.abs(states[:, row, 0]))
