"""One answer per excitation frequency: motion, what it asks of the coil, and how stable the loop is."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.control.continuous import build_loop
from twin.control.filters import Cutoffs
from twin.control.laws import Feedback, Law, Measurement, absorber_coil, scheduled_law
from twin.control.lq import force_model, lq_gain, table_6_2_weights
from twin.control.margins import delay_margin_s, modulus_margin, unstable_poles
from twin.plant.config import Plant
from twin.plant.linear import Array

Controller = Literal["passive", "gain_scheduling", "lq"]


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Steady state and stability at one excitation frequency. Amplitudes are peaks.

    Attributes
    ----------
    primary_displacement_m, stroke_m, actuator_force_n
        Motion of the first body, of the absorber against what its force pushes off, and that force.
    current_a, voltage_v
        Of the coil; None without one. A coil without a current loop is fed by an ideal current source. An open
        coil shows its back-EMF as voltage.
    joule_peak_w, joule_mean_w, electrical_mean_w
        R i_peak² (the thesis's "power"), R i_rms², and the mean of v i; None as the current is.
    stable
        With the delay that was given. The amplitudes of an unstable loop are those of the periodic motion that it
        runs away from.
    delay_margin_s
        Least pure delay that destabilises, counted from no delay; None if none below 8 ms does, 0 if the loop is
        unstable without any.
    modulus_margin
        min |1 + L| with the delay that was given.
    """

    frequency_hz: float
    primary_displacement_m: float
    stroke_m: float
    actuator_force_n: float
    current_a: float | None
    voltage_v: float | None
    joule_peak_w: float | None
    joule_mean_w: float | None
    electrical_mean_w: float | None
    stable: bool
    delay_margin_s: float | None
    modulus_margin: float


def choose_law(
    plant: Plant,
    controller: Controller,
    frequency_hz: float,
    feedback: Feedback = "position",
    measurement: Measurement = "relative",
) -> Law | Array | None:
    """Gains of a controller at one excitation frequency, for `build_loop`.

    ``passive``: None. ``gain_scheduling``: eq. 6-5 with beta = -c2. ``lq``: full-state feedback with the weights of
    Table 6-2 on the plant's mechanics; feedback and measurement do not concern it.

    Raises
    ------
    ValueError
        If the plant has no absorber, or the Riccati equation no solution.
    """
    if controller == "passive":
        return None
    if controller == "lq":
        return lq_gain(force_model(plant, frequency_hz), *table_6_2_weights(len(plant.body)))
    absorber = plant.absorber
    if absorber is None:
        raise ValueError(f"plant '{plant.name}' has no absorber to tune")
    return scheduled_law(absorber, frequency_hz, feedback, measurement)


def analyse_point(
    plant: Plant,
    law: Law | Array | None,
    frequency_hz: float,
    *,
    excitation: float = 1.0,
    delay_s: float = 0.0,
    filters: Cutoffs | None = None,
    excited_by: str | None = None,
) -> OperatingPoint:
    """Steady state, powers and margins of a plant under a law, in continuous time with the exact delay.

    Parameters
    ----------
    law, filters, excited_by
        As `build_loop`; damping given against frequency is read at ``frequency_hz``.
    excitation
        Peak of the sine, a force on the primary [N] or in the unit of the actuator ``excited_by``.
    delay_s
        Pure delay between measurement and force [s].

    Raises
    ------
    ValueError
        As `build_loop`; if plant or closed loop is in undamped resonance with the excitation; for a frequency
        that is not positive or a delay below zero.
    """
    if not (0.0 < frequency_hz < np.inf and 0.0 <= delay_s < np.inf):
        raise ValueError("the frequency must be above 0 Hz and the delay not below 0 s")
    loop = build_loop(plant, law, frequency_hz=frequency_hz, filters=filters, excited_by=excited_by)
    try:
        phasors = loop.steady(frequency_hz, delay_s, excitation)
    except np.linalg.LinAlgError as error:
        raise ValueError(f"at {frequency_hz:g} Hz there is a resonance without damping") from error
    coil = loop.coil
    if coil is None and (coil := absorber_coil(plant)) is not None:
        # Without a current loop the coil is fed by an ideal current source: the force is exact, the voltage follows.
        w, k = 2j * np.pi * frequency_hz, coil.force_constant_n_a
        phasors[3] = phasors[2] / k
        phasors[4] = (coil.resistance_ohm + w * coil.inductance_h) * phasors[3] - w * k * phasors[1]
    motion, stroke, force, current, voltage = (float(size) for size in np.abs(phasors))
    peak = None if coil is None else coil.resistance_ohm * current**2
    return OperatingPoint(
        frequency_hz=frequency_hz,
        primary_displacement_m=motion,
        stroke_m=stroke,
        actuator_force_n=force,
        current_a=None if coil is None else current,
        voltage_v=None if coil is None else voltage,
        joule_peak_w=peak,
        joule_mean_w=None if peak is None else 0.5 * peak,
        electrical_mean_w=None if coil is None else float(0.5 * (phasors[4] * phasors[3].conjugate()).real),
        stable=unstable_poles(loop, delay_s) == 0,
        delay_margin_s=delay_margin_s(loop),
        modulus_margin=modulus_margin(loop, delay_s),
    )


def analyse(
    plant: Plant,
    controller: Controller,
    frequencies_hz: list[float],
    *,
    feedback: Feedback = "position",
    measurement: Measurement = "relative",
    excitation_n: float = 1.0,
    delay_s: float = 0.0,
    filters: Cutoffs | None = None,
) -> list[OperatingPoint]:
    """`analyse_point` at each frequency, with the gains that the controller has there; force on the primary [N]."""
    return [
        analyse_point(
            plant,
            choose_law(plant, controller, f, feedback, measurement),
            f,
            excitation=excitation_n,
            delay_s=delay_s,
            filters=filters,
        )
        for f in frequencies_hz
    ]
