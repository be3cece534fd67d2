"""The thesis's own scheduling rule, which a rig starts from before anything is learned."""

import math
from collections.abc import Sequence

from twin.control.filters import paired_low_pass_hz
from twin.control.laws import scheduled_stiffness
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant

__all__ = ["paired_low_pass_hz", "scheduled_stiffness", "scheduling_rule"]


def scheduling_rule(
    plant: Plant,
    frequency_hz: Sequence[float],
    *,
    high_pass_hz: float = 2.5,
    low_pass_hz: float | None = None,
) -> GainSchedule:
    """Gain schedule of thesis Test 3: gamma from eq. 6-5, beta = -c2, cutoffs paired (or a fixed low-pass).

    Parameters
    ----------
    frequency_hz
        Table of excitation frequencies [Hz], ascending; the controller acts between its ends.
    """
    absorber = plant.absorber
    if absorber is None:
        raise ValueError("the scheduling rule needs an absorber")
    tuned_hz = math.sqrt(absorber.stiffness_n_m / absorber.mass_kg) / math.tau
    points = [
        Gains(
            alpha_kg=0.0,
            beta_ns_m=-absorber.damping_at(f),
            gamma_n_m=scheduled_stiffness(absorber.mass_kg, tuned_hz, f),
            low_pass_hz=low_pass_hz or paired_low_pass_hz(f, high_pass_hz),
            high_pass_hz=high_pass_hz,
        )
        for f in frequency_hz
    ]
    return GainSchedule(
        frequency_hz=tuple(frequency_hz),
        alpha_kg=tuple(g.alpha_kg for g in points),
        beta_ns_m=tuple(g.beta_ns_m for g in points),
        gamma_n_m=tuple(g.gamma_n_m for g in points),
        low_pass_hz=tuple(g.low_pass_hz for g in points),
        high_pass_hz=tuple(g.high_pass_hz for g in points),
        on_from_hz=frequency_hz[0],
        on_to_hz=frequency_hz[-1],
    )
