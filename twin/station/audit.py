"""Predicted against achieved: what the tuner promised of the gains in use, beside what the rig then did.

The promise is made by the model that proposed the gains, for the excitation as it turned out to be. It is held against
a block at which the motion has settled. A point counts where the motion stands out from what nobody could have
promised: the block's own noise, and the damping's standard deviation.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tuning.retune import Prediction
from twin.station.frame import Performance

SETTLED_BLOCKS = 1
"""Whole blocks under the same gains before the motion may count as settled; what follows says whether it is."""

SETTLED_1_S = 0.5
"""Nor may the absorber's amplitude or phase move faster than this, or the primary's, |A'/A|."""

SETTLED_SHARE = 0.05
"""And no more than this share of the coil's power may be at other frequencies than the excitation's."""

FLOOR_SIGMAS = 20.0
"""Motion below so many standard deviations of what is unknown is no test at five per cent."""

POWER_FLOOR_W = 0.01


@dataclass(frozen=True, slots=True)
class AuditPoint:
    """One comparison.

    Attributes
    ----------
    displacement_m, joule_mean_w, electrical_mean_w
        (predicted, achieved) each.
    floor_m
        Displacement below which the comparison says nothing.
    """

    sample: int
    frequency_hz: float
    displacement_m: tuple[float, float]
    joule_mean_w: tuple[float, float]
    electrical_mean_w: tuple[float, float]
    floor_m: float

    @property
    def displacement_error(self) -> float | None:
        """Predicted over achieved less one; None where the motion is below the floor."""
        predicted, achieved = self.displacement_m
        return predicted / achieved - 1.0 if achieved > self.floor_m else None

    @property
    def power_error(self) -> float | None:
        """Likewise for the mean Joule power; None where there is next to none."""
        predicted, achieved = self.joule_mean_w
        return predicted / achieved - 1.0 if achieved > POWER_FLOOR_W else None


def audit_point(
    promise: Prediction,
    promise_std_m: float,
    sample: int,
    frequency_hz: float,
    achieved: Performance,
    noise_std_m: float,
    rate_m_s: float,
) -> AuditPoint:
    """Hold a promise against what was achieved.

    Parameters
    ----------
    promise_std_m
        Standard deviation of the promised displacement by the damping's own.
    noise_std_m
        Of the achieved displacement, by the block's noise.
    rate_m_s
        How fast the achieved displacement still moves: below the floor is also what has not settled.
    """
    powers = achieved.powers
    return AuditPoint(
        sample=sample,
        frequency_hz=frequency_hz,
        displacement_m=(promise.displacement_m, achieved.displacement_m),
        joule_mean_w=(promise.powers.joule_mean_w, powers.joule_mean_w),
        electrical_mean_w=(promise.powers.electrical_mean_w, powers.electrical_mean_w),
        floor_m=max(FLOOR_SIGMAS * math.hypot(promise_std_m, noise_std_m), rate_m_s / SETTLED_1_S),
    )


@dataclass(slots=True)
class Audit:
    """All comparisons of a run."""

    points: list[AuditPoint] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Figures by name; errors are shares of the achieved value, None where no point counts."""
        motion = [(e, p) for p in self.points if (e := p.displacement_error) is not None]
        power = [(e, p) for p in self.points if (e := p.power_error) is not None]
        floors = [p.floor_m for p in self.points]
        return {
            "points": len(self.points),
            "displacement_points": len(motion),
            "displacement_floor_m": float(np.median(floors)) if floors else None,
            "displacement_error_rms": _rms([e for e, _ in motion]),
            "displacement_error_worst": _worst(motion),
            "power_points": len(power),
            "power_error_rms": _rms([e for e, _ in power]),
            "power_error_worst": _worst(power),
        }


def _rms(errors: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def _worst(found: list[tuple[float, AuditPoint]]) -> dict[str, float] | None:
    if not found:
        return None
    error, point = max(found, key=lambda pair: abs(pair[0]))
    return {"error": error, "frequency_hz": point.frequency_hz, "sample": point.sample}
