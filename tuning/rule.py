"""The thesis's own scheduling rule, which a rig starts from before anything is learned."""

import math
from collections.abc import Sequence

from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant


def scheduled_stiffness(absorber_mass_kg: float, tuned_hz: float, excitation_hz: float) -> float:
    """Relative-position gain that moves the absorber's resonance to the excitation.

    gamma = m2 (w² - w2²), thesis eq. 6-5.

    Returns
    -------
    float
        Gain [N/m]; negative below the tuned frequency. The loop is stable for gamma > -k2.
    """
    return absorber_mass_kg * ((math.tau * excitation_hz) ** 2 - (math.tau * tuned_hz) ** 2)


def paired_low_pass_hz(excitation_hz: float, high_pass_hz: float) -> float:
    """Low-pass cutoff [Hz] whose lag one high-pass makes good: f_lp f_hp = f², thesis 7.9.3.

    It nulls the phase of the velocity path; the position path has two high-passes and keeps a lead.
    """
    return excitation_hz**2 / high_pass_hz


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
