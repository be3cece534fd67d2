"""What the tuner hands on: a proposal that carries its own proof."""

from dataclasses import dataclass
from typing import Literal

from twin.control.schedule import Gains

BudgetKind = Literal["joule_mean", "joule_peak"]


@dataclass(frozen=True, slots=True)
class Powers:
    """Power of the coil in steady state [W]: R i_rms², R i_peak², and mean of v i."""

    joule_mean_w: float
    joule_peak_w: float
    electrical_mean_w: float


@dataclass(frozen=True, slots=True)
class ActiveLimit:
    """A limit that binds, and what one more unit of it would buy [m per unit of the limit]."""

    name: str
    price: float


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Gains for one excitation frequency with what the full model predicts of them.

    Displacements are peaks [m] of the primary body; ``limit`` is the least that any linear controller can
    reach inside the limits, ``passive`` is without control.
    """

    frequency_hz: float
    gains: Gains
    predicted_displacement_m: float
    passive_displacement_m: float
    limit_displacement_m: float
    stroke_m: float
    current_peak_a: float
    powers: Powers
    modulus_margin: float
    delay_margin_s: float | None
    active_limits: tuple[ActiveLimit, ...]


@dataclass(frozen=True, slots=True)
class Proposal:
    """Better gains for part of the schedule, verified on the full model, or the reason there are none.

    Attributes
    ----------
    made_at_sample
        Last sample the model behind it had seen.
    model_id
        Fingerprint of that model.
    feasible
        False if nothing better may be deployed; ``reason`` names the binding limit and the remedy.
    points
        (row of the schedule's table, operating point) pairs.
    """

    made_at_sample: int
    model_id: str
    feasible: bool
    reason: str
    budget_w: float
    budget_kind: BudgetKind
    points: tuple[tuple[int, OperatingPoint], ...]
