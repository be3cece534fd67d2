"""A current-driven shaker: one mass on a spring, and the current it takes to hold a level (thesis 5.3).

A sweep holds the table's displacement first, then its velocity, then its acceleration, because each of the three
has a limit and the tightest one rules: ``|x| = min(d, v/w, a/w²)``. The regimes change where two limits
meet, at v/(2 pi d) and a/(2 pi v). The thesis gives 25.4 mm, 0.7 m/s and 66 g; they meet at its 8.8 and about 150 Hz if
25.4 mm is the stroke from end to end, not an amplitude. The current that holds a level is the level over the
response of the table (eq. 5-3), which is why it falls towards the resonance of 13.5 Hz inside the middle regime.
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.plant.config import Body, Frozen, Plant, Positive, Shaker
from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi


class Regime(StrEnum):
    """What a sweep holds constant."""

    POSITION = "position"
    VELOCITY = "velocity"
    ACCELERATION = "acceleration"


class SweepLimits(Frozen):
    """Amplitudes (peak) that a sweep keeps to; the defaults are those of the V721 (thesis 5.3)."""

    displacement_m: Positive = 0.0127
    velocity_m_s: Positive = 0.7
    acceleration_m_s2: Positive = 66.0 * 9.80665

    @property
    def crossovers_hz(self) -> tuple[float, float]:
        """Where velocity takes over from position and acceleration from velocity [Hz].

        Raises
        ------
        ValueError
            If velocity is never the tightest limit, d a <= v²: there is then no middle regime.
        """
        if self.displacement_m * self.acceleration_m_s2 <= self.velocity_m_s**2:
            raise ValueError(
                f"velocity_m_s {self.velocity_m_s:g} m/s is never reached: displacement times acceleration "
                "stays below its square; lower it"
            )
        return (
            self.velocity_m_s / (TAU * self.displacement_m),
            self.acceleration_m_s2 / (TAU * self.velocity_m_s),
        )


class Sweep(NamedTuple):
    """A sweep's levels: displacement, velocity, acceleration and current amplitudes, and what is held."""

    displacement_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    current_a: Array
    regime: NDArray[np.str_]


class TableMotion(NamedTuple):
    """Table motion per ampere: position [m/A], velocity [m/(s A)], acceleration [m/(s² A)]."""

    position: ComplexArray
    velocity: ComplexArray
    acceleration: ComplexArray


def table_motion(plant: Plant, frequency_hz: ArrayLike) -> TableMotion:
    """Response of the table to the shaker's current (thesis eq. 5-2, 5-3).

    Raises
    ------
    ValueError
        If the plant is not one body on the ground with one shaker on it.
    """
    body, shaker = _table(plant)
    s = 1j * TAU * np.asarray(frequency_hz, dtype=np.float64)
    dynamics = body.mass_kg * s**2 + body.damping_at(None) * s + body.stiffness_n_m
    position: ComplexArray = np.asarray(shaker.force_constant_n_a / dynamics, dtype=np.complex128)
    return TableMotion(position, np.asarray(s * position), np.asarray(s**2 * position))


def sweep(plant: Plant, frequency_hz: ArrayLike, limits: SweepLimits | None = None) -> Sweep:
    """Levels of a sine sweep at the tightest limit, and the current amplitude it takes.

    The current in each regime is the held level times the regime's transfer function of thesis 5.3:
    ``(m s² + c s + k)/k_s`` for position, over s for velocity, over s² for acceleration.

    Parameters
    ----------
    frequency_hz
        Above 0 Hz, any shape.

    Raises
    ------
    ValueError
        As `table_motion`.
    """
    limits = limits or SweepLimits()
    w = TAU * np.asarray(frequency_hz, dtype=np.float64)
    allowed = np.stack(
        [
            np.broadcast_to(limits.displacement_m, w.shape),
            limits.velocity_m_s / w,
            limits.acceleration_m_s2 / w**2,
        ]
    )
    displacement = allowed.min(axis=0)
    current = displacement / np.abs(table_motion(plant, frequency_hz).position)
    regime = np.array(list(Regime))[allowed.argmin(axis=0)]
    return Sweep(displacement, w * displacement, w**2 * displacement, current, regime)


def _table(plant: Plant) -> tuple[Body, Shaker]:
    shakers = [a for a in plant.actuator if isinstance(a, Shaker)]
    if len(plant.body) != 1 or len(shakers) != 1 or len(plant.actuator) != 1 or shakers[0].on is None:
        raise ValueError(
            f"plant '{plant.name}' is no bare shaker; it needs one body and one shaker on it, nothing else"
        )
    return plant.body[0], shakers[0]
