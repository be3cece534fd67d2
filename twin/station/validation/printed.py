"""Thesis eq. 8-3 to 8-5 as they are printed, with the back-EMF's sign that creates energy: for comparison only."""

import numpy as np

from twin.control.analysis import choose_law
from twin.control.laws import Law
from twin.plant.config import Plant
from twin.station.validation.models import absorber_of, coil_of


def printed_current(plant: Plant, frequency_hz: float, force_n: float) -> float:
    """Peak coil current [A] by eq. 8-4: gain scheduling by position and velocity, current loop, two bodies.

    The denominator is built from the equations of motion and the printed voltage law ``v = R i + L i' + k (x1' - x2')``
    instead of the printed coefficients, in which the scan lost indices.
    """
    one, two, coil = plant.primary, absorber_of(plant), coil_of(plant)
    law = choose_law(plant, "gain_scheduling", frequency_hz)
    if not isinstance(law, Law):
        raise TypeError("gain scheduling gives a law")
    s = 2j * np.pi * frequency_hz
    k, kp = coil.force_constant_n_a, coil.current_loop_kp_v_a or 0.0
    link = two.damping_at(frequency_hz) * s + two.stiffness_n_m
    ground = one.mass_kg * s**2 + one.damping_at(frequency_hz) * s + one.stiffness_n_m
    # Unknowns x1, x2, i: two bodies, then (R + kp + L s) i = kp i_ref - k s (x1 - x2).
    asked = kp * (law.beta_ns_m * s + law.gamma_n_m) / k - k * s
    matrix = np.array(
        [
            [ground + link, -link, k],
            [-link, two.mass_kg * s**2 + link, -k],
            [-asked, asked, coil.resistance_ohm + kp + coil.inductance_h * s],
        ]
    )
    return float(abs(np.linalg.solve(matrix, [force_n, 0.0, 0.0])[2]))
