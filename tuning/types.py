"""What the tuner hands on: a proposal that carries its own proof."""

import math
from dataclasses import dataclass
from typing import Literal

from twin.control.schedule import Gains

BudgetKind = Literal["joule_mean", "joule_peak", "electrical"]


@dataclass(frozen=True, slots=True)
class Powers:
    """Power of the coil in steady state [W]: R i_rms², R i_peak², and mean of v i."""

    joule_mean_w: float
    joule_peak_w: float
    electrical_mean_w: float

    def of_kind(self, kind: BudgetKind) -> float:
        """The power that a budget of a kind bounds [W]."""
        return {
            "joule_mean": self.joule_mean_w,
            "joule_peak": self.joule_peak_w,
            "electrical": self.electrical_mean_w,
        }[kind]


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

    Attributes
    ----------
    active_limits
        What keeps any linear controller from less motion, at the prices of the physical limit; then what binds this
        law beside it: ``modulus margin`` [m per unit of margin], ``decay`` [m per 1/s].
    voltage_peak_v
        At the coil's terminals.
    decay_rate_1_s
        Largest real part of the closed loop's poles, at the worst of the dampings checked; below 0 is stable.
    damping_std_ns_m
        Standard deviation of the absorber's damping that was allowed for.
    displacement_range_m, power_range_w
        Least and largest with the damping up to two standard deviations off; power of the budget's kind.
    kept
        True if these are the gains in use, and nothing better enough was found.
    least_power_w
        Least power of the budget's kind that meets the wanted displacement under any linear controller; None where no
        displacement is asked for.
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
    voltage_peak_v: float = math.nan
    decay_rate_1_s: float = math.nan
    damping_std_ns_m: float = 0.0
    displacement_range_m: tuple[float, float] = (math.nan, math.nan)
    power_range_w: tuple[float, float] = (math.nan, math.nan)
    kept: bool = False
    least_power_w: float | None = None


@dataclass(frozen=True, slots=True)
class Refusal:
    """Why no gains may be proposed at a frequency.

    Attributes
    ----------
    binding
        Names of the limits that exclude each other or could not be kept.
    reason
        In words.
    least_budget_w
        Least power of the budget's kind with which there are gains; None if no budget helps.
    """

    frequency_hz: float
    binding: tuple[str, ...]
    reason: str
    least_budget_w: float | None = None


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
    refusals
        (row of the table, why nothing may be proposed there).
    """

    made_at_sample: int
    model_id: str
    feasible: bool
    reason: str
    budget_w: float
    budget_kind: BudgetKind
    points: tuple[tuple[int, OperatingPoint], ...]
    refusals: tuple[tuple[int, Refusal], ...] = ()
