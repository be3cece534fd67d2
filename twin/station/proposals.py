"""A proposal as the operator reviews it: what changes, what is predicted, what binds, and the order it would become."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from tuning.types import ActiveLimit
from twin.control.schedule import Gains, GainSchedule
from twin.station.orders import Order
from twin.station.panel import finite, goal_figures, power_figures
from twin.station.retuning import Standing
from twin.station.whatif_process import Base, WhatIfProposal

REVIEW_S = 120.0
"""A proposal older than this has to be made again."""


@dataclass(slots=True)
class Reviewed:
    """One proposal under review.

    Attributes
    ----------
    figures
        For the page.
    base
        Model and gains it was made for; None if the loop itself checks that.
    """

    figures: dict[str, Any]
    order: Order
    made_at_sample: int
    base: Base | None
    number: int = 0


def review_of_what_if(proposal: WhatIfProposal, sample: int) -> Reviewed:
    """Review of a schedule that a what-if came to."""
    base, meant = proposal.base, proposal.schedules[-1]
    rows = []
    for p in proposal.curves.points:
        new, old = p.proposed, p.in_use
        now = base.schedule.at(p.frequency_hz)
        rows.append({
            "frequency_hz": p.frequency_hz,
            "gains": _changes(now, None if new is None else new.gains),
            "in_use_m": finite(old.displacement_m),
            "in_use_w": None if old.powers is None else finite(old.powers.of_kind(proposal.goal.budget_kind)),
            "passive_m": finite(p.passive_m),
            "limit_m": finite(p.limit_m),
            "displacement_m": None if new is None else finite(new.displacement_m),
            "power_w": None
            if new is None or new.powers is None
            else finite(new.powers.of_kind(proposal.goal.budget_kind)),
            "modulus_margin": None if new is None else finite(new.modulus_margin),
            "delay_margin_s": None if new is None else finite(new.delay_margin_s),
            "limits": _limits(p.active_limits),
            "reason": p.reason,
        })  # fmt: skip
    changed = meant != base.schedule or proposal.goal != base.goal
    figures = _figures(
        rows, base.plant.fingerprint, goal_figures(proposal.goal), (meant.on_from_hz, meant.on_to_hz), sample
    )
    figures |= {
        "source": "what-if",
        "steps": len(proposal.schedules),
        "goal_before": goal_figures(base.goal),
        "window_before_hz": [base.schedule.on_from_hz, base.schedule.on_to_hz],
        "changes_anything": changed,
    }
    order = Order(kind="schedule", schedules=proposal.schedules, goal=proposal.goal)
    return Reviewed(figures, order, sample, base)


def review_of_standing(number: int, standing: Standing, sample: int) -> Reviewed:
    """Review of a proposal of the twin's own."""
    question, proposal = standing.question, standing.proposal
    kind = proposal.budget_kind
    rows = []
    for row, p in proposal.points:
        if row not in standing.steps:
            continue
        rows.append({
            "frequency_hz": p.frequency_hz,
            "gains": _changes(question.schedule.at(p.frequency_hz), standing.steps[row]),
            "passive_m": finite(p.passive_displacement_m),
            "limit_m": finite(p.limit_displacement_m),
            "displacement_m": finite(p.predicted_displacement_m),
            "power_w": finite(p.powers.of_kind(kind)),
            **power_figures(p.powers),
            "modulus_margin": finite(p.modulus_margin),
            "delay_margin_s": finite(p.delay_margin_s),
            "limits": _limits(p.active_limits),
            "reason": "",
        })  # fmt: skip
    schedule: GainSchedule = question.schedule
    window = (schedule.on_from_hz, schedule.on_to_hz)
    figures = _figures(rows, proposal.model_id, goal_figures(question.goal), window, sample)
    figures |= {
        "source": f"the twin's own, number {number}",
        "steps": 1,
        "goal_before": goal_figures(question.goal),
        "window_before_hz": list(window),
        "changes_anything": bool(rows),
    }
    return Reviewed(figures, Order(kind="accept", number=number), sample, None)


def _figures(
    rows: list[dict[str, Any]],
    model_id: str,
    goal: dict[str, Any],
    window_hz: tuple[float, float],
    sample: int,
) -> dict[str, Any]:
    def known(key: str) -> list[float]:
        return [r[key] for r in rows if r.get(key) is not None]

    return {
        "rows": rows,
        "model_id": model_id,
        "goal": goal,
        "window_hz": list(window_hz),
        "made_at_sample": sample,
        "worst_m": max(known("displacement_m"), default=None),
        "worst_w": max(known("power_w"), default=None),
        "least_modulus_margin": min(known("modulus_margin"), default=None),
        "least_delay_margin_s": min(known("delay_margin_s"), default=None),
        "without": [r["frequency_hz"] for r in rows if r["displacement_m"] is None],
    }


def _changes(old: Gains, new: Gains | None) -> dict[str, list[float | None]]:
    names = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
    later = old if new is None else new
    return {name: [finite(getattr(old, name), 5), finite(getattr(later, name), 5)] for name in names}


def _limits(found: Sequence[ActiveLimit]) -> list[dict[str, Any]]:
    return [{"name": a.name, "price": finite(a.price, 3)} for a in found]
