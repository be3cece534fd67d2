"""Steady state at one frequency: what a current reference does to motion, stroke, current, voltage and power.

Everything is affine in the complex reference r: ``y = y_r r + y_0``, y_0 what the excitation does alone. A control law
only chooses r, which is why the best r is a limit for all of them (`limit`).
"""

import math
from dataclasses import dataclass

import numpy as np

from tuning.loop import RigModel
from tuning.types import Powers
from twin.control.schedule import Gains
from twin.plant.linear import ComplexArray

Pair = tuple[complex, complex]
"""(Per ampere of reference, without reference)."""


@dataclass(frozen=True, slots=True)
class SteadyPaths:
    """Peak phasors at one frequency as pairs (per ampere of reference, without it).

    Attributes
    ----------
    motion, stroke
        Of the primary body, and between the coil's ends [m].
    current, voltage
        At the coil's terminals [A], [V].
    acceleration
        Relative acceleration as the law measures it [m/s²].
    resistance_ohm
        Of the coil.
    """

    frequency_hz: float
    motion: Pair
    stroke: Pair
    acceleration: Pair
    current: Pair
    voltage: Pair
    resistance_ohm: float

    def scaled(self, share: float) -> "SteadyPaths":
        """The same under an excitation of another size, as a share of this one."""
        motion, stroke, acceleration, current, voltage = (
            (pair[0], share * pair[1])
            for pair in (self.motion, self.stroke, self.acceleration, self.current, self.voltage)
        )
        return SteadyPaths(
            self.frequency_hz, motion, stroke, acceleration, current, voltage, self.resistance_ohm
        )

    def at(self, reference_a: complex) -> "Prediction":
        """Steady state with a reference phasor [A]."""
        motion, stroke, current, voltage = (
            pair[0] * reference_a + pair[1] for pair in (self.motion, self.stroke, self.current, self.voltage)
        )
        return Prediction(
            displacement_m=float(abs(motion)),
            stroke_m=float(abs(stroke)),
            current_peak_a=float(abs(current)),
            powers=Powers(
                joule_mean_w=float(0.5 * self.resistance_ohm * abs(current) ** 2),
                joule_peak_w=float(self.resistance_ohm * abs(current) ** 2),
                electrical_mean_w=float(0.5 * (voltage * current.conjugate()).real),
            ),
            voltage_peak_v=float(abs(voltage)),
        )


@dataclass(frozen=True, slots=True)
class Prediction:
    """Steady state of one set of gains at one frequency on one model; peaks but for the mean powers."""

    displacement_m: float
    stroke_m: float
    current_peak_a: float
    powers: Powers
    voltage_peak_v: float = math.nan


def steady_paths(model: RigModel, frequency_hz: float, amplitude: float) -> SteadyPaths:
    """Steady state of a sampled rig as a function of its reference.

    Parameters
    ----------
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    """
    return paths_from(model, frequency_hz, model.response(frequency_hz)[0], amplitude)


def paths_from(model: RigModel, frequency_hz: float, response: ComplexArray, amplitude: float) -> SteadyPaths:
    """`steady_paths` from a response (4, 2) that is known already."""
    motion, stroke, acceleration, current = (
        (complex(row[0]), complex(row[1]) * amplitude) for row in response
    )
    coil, jw = model.coil, 2j * math.pi * frequency_hz
    # At the terminals: v = R i + L i' + k (x2' - x1'). The current loop's kp (i_ref - i) is the same but for the hold,
    # which a difference of nearly equal numbers would not forgive.
    circuit = coil.resistance_ohm + jw * coil.inductance_h
    voltage = tuple(
        circuit * i - jw * coil.force_constant_n_a * x for i, x in zip(current, stroke, strict=True)
    )
    return SteadyPaths(
        frequency_hz, motion, stroke, acceleration, current, (voltage[0], voltage[1]), coil.resistance_ohm
    )


def reference_under(model: RigModel, gains: Gains, paths: SteadyPaths) -> complex:
    """Reference phasor [A] that a set of gains settles to."""
    law = complex(
        model.paths(paths.frequency_hz, gains.low_pass_hz, gains.high_pass_hz)[0]
        @ np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
    )
    per_ampere, alone = paths.acceleration
    return law * alone / (1.0 - law * per_ampere)


def predict(model: RigModel, gains: Gains, frequency_hz: float, amplitude: float) -> Prediction:
    """Steady state under a set of gains, from the sampled model with delay and filters.

    Parameters
    ----------
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    """
    paths = steady_paths(model, frequency_hz, amplitude)
    return paths.at(reference_under(model, gains, paths))
