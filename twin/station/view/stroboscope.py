"""When to look at a machine that shakes too fast for the eye: flashes a little slower than it shakes.

A view of 25 pictures a second of something that moves at 50 Hz shows nothing that is true. Lit by a stroboscope at just
under a whole fraction of its frequency, it seems to move slowly, and every picture is a moment that was.
"""

from dataclasses import dataclass

import numpy as np

from twin.plant.linear import Array

PICTURES_HZ = 25.0
"""No more pictures than this each second."""

SEEN_HZ = 0.6
"""What moves at the excitation frequency seems to move at this one."""

AS_IT_IS_HZ = 4.0
"""Up to this excitation frequency nothing is slowed down: there are six pictures and more to a period."""


@dataclass(slots=True)
class Stroboscope:
    """Instants to look at, one block after the other."""

    _next_s: float = -np.inf
    _end_s: float = -np.inf

    def flashes(self, begin_s: float, end_s: float, excitation_hz: float | None) -> Array:
        """Instants [s] within ``begin_s <= t < end_s``, going on from the block before.

        Parameters
        ----------
        excitation_hz
            How fast it shakes; None where that is not known.
        """
        period = flash_period_s(excitation_hz)
        if abs(begin_s - self._end_s) > 1e-6 or self._next_s > begin_s + period:
            self._next_s = begin_s
        self._end_s = end_s
        found = np.arange(max(self._next_s, begin_s), end_s - 1e-12, period)
        if len(found):
            self._next_s = float(found[-1]) + period
        return found


def flash_period_s(excitation_hz: float | None) -> float:
    """Time between flashes [s]: whole periods of the excitation and a little more."""
    if excitation_hz is None or excitation_hz <= AS_IT_IS_HZ:
        return 1.0 / PICTURES_HZ
    periods = int(np.ceil(excitation_hz / PICTURES_HZ))
    return periods / (excitation_hz - SEEN_HZ)


def slower_by(excitation_hz: float | None) -> float:
    """How many times slower it seems to move; 1 where it is shown as it is."""
    return 1.0 if excitation_hz is None or excitation_hz <= AS_IT_IS_HZ else excitation_hz / SEEN_HZ
