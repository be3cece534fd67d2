"""Gain scheduling with zero placement: the law that moves the absorber's resonance to the excitation (thesis 6.2).

``f = alpha x_r'' + beta x_r' + gamma x_r`` with ``x_r = x1 - x2``: alpha acts like mass on the absorber, beta like
damping, gamma like stiffness. With absolute measurement (thesis eq. 6-6) the absorber's own motion stands for the
relative one, ``x_r -> -x2``: the primary's zero stays where it was, because there ``x1 = 0``; the poles move.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.plant.config import GROUND, Body, Plant, VoiceCoil
from twin.plant.linear import Array

Feedback = Literal["position", "acceleration"]
Measurement = Literal["relative", "absolute"]


@dataclass(frozen=True, slots=True)
class Law:
    """One operating point of ``f = alpha x_r'' + beta x_r' + gamma x_r`` (thesis eq. 6-2, 6-6).

    Attributes
    ----------
    alpha_kg, beta_ns_m, gamma_n_m
        Gains [kg, Ns/m, N/m].
    measurement
        ``relative``: x_r is measured; ``absolute``: the absorber's motion alone stands for it, with its sign.
    """

    alpha_kg: float = 0.0
    beta_ns_m: float = 0.0
    gamma_n_m: float = 0.0
    measurement: Measurement = "relative"


def scheduled_stiffness(absorber_mass_kg: float, tuned_hz: float, excitation_hz: float) -> float:
    """Relative-position gain that moves the absorber's resonance to the excitation.

    gamma = m2 (w² - w2²), thesis eq. 6-5.

    Returns
    -------
    float
        Gain [N/m]; negative below the tuned frequency. The loop is stable for gamma > -k2.
    """
    return absorber_mass_kg * ((math.tau * excitation_hz) ** 2 - (math.tau * tuned_hz) ** 2)


def scheduled_mass(absorber_mass_kg: float, tuned_hz: float, excitation_hz: float) -> float:
    """Relative-acceleration gain that moves the absorber's resonance to the excitation.

    alpha = m2 (w2²/w² - 1), thesis eq. 6-5.

    Returns
    -------
    float
        Gain [kg]; positive below the tuned frequency.
    """
    return absorber_mass_kg * ((tuned_hz / excitation_hz) ** 2 - 1.0)


def scheduled_law(
    absorber: Body,
    excitation_hz: float,
    feedback: Feedback = "position",
    measurement: Measurement = "relative",
) -> Law:
    """Gains of eq. 6-5 for an absorber, with beta that takes its damping away (thesis 6.2.4).

    Parameters
    ----------
    absorber
        Mass, spring and damping; damping against frequency is read at the excitation.
    excitation_hz
        Where the primary is to be quiet [Hz].
    """
    beta = -absorber.damping_at(excitation_hz)
    tuned_hz = math.sqrt(absorber.stiffness_n_m / absorber.mass_kg) / math.tau
    if feedback == "acceleration":
        alpha = scheduled_mass(absorber.mass_kg, tuned_hz, excitation_hz)
        return Law(alpha_kg=alpha, beta_ns_m=beta, measurement=measurement)
    gamma = scheduled_stiffness(absorber.mass_kg, tuned_hz, excitation_hz)
    return Law(beta_ns_m=beta, gamma_n_m=gamma, measurement=measurement)


def absorber_coil(plant: Plant) -> VoiceCoil | None:
    """Return the voice coil that pushes the plant's absorber; None if there is none."""
    coil, absorber = plant.voice_coil, plant.absorber
    if coil is None or absorber is None or coil.pushes[-1][0] != absorber.name:
        return None
    return coil


def actuated_pair(plant: Plant) -> tuple[str, str]:
    """Names of what the law's force pushes off and of the absorber it pushes.

    The coil's two ends; without a coil on the absorber, primary and absorber. A coil between the absorber and the
    ground pushes off ``ground``.

    Raises
    ------
    ValueError
        If the plant has no absorber.
    """
    absorber, coil = plant.absorber, absorber_coil(plant)
    if absorber is None:
        raise ValueError(
            f"plant '{plant.name}' has no absorber: give it a [[body]] with attached_to = \"{plant.primary.name}\""
        )
    if coil is None:
        return plant.primary.name, absorber.name
    return (coil.between[0] if coil.between is not None else GROUND), absorber.name


def measured_motion(plant: Plant, measurement: Measurement) -> Array:
    """Weights of the bodies' displacements in what the law takes for ``x_r``, (n_bodies,)."""
    first, absorber = actuated_pair(plant)
    row = np.zeros(len(plant.body))
    for column, body in enumerate(plant.body):
        if body.name == absorber:
            row[column] = -1.0
        elif body.name == first and measurement == "relative":
            row[column] = 1.0
    return row
