"""Signals of an absorber that obeys its force balance, for tests that need no whole rig."""

import numpy as np
from numpy.typing import NDArray

from estimators.excitation import ExcitationTracker
from estimators.types import Phasors
from twin.plant.blocks import Block, Channel, make_block

Array = NDArray[np.float64]
MASS_KG, FORCE_CONSTANT_N_A, STIFFNESS_N_M = 0.4125, 8.0, 40714.0
NAMES = ("table_acceleration", "absorber_acceleration", "vcm_current")
WITH_DRIVE = (*NAMES, "drive")
CHANNELS = tuple(Channel(c, "") for c in WITH_DRIVE)


def amplitudes(
    s: complex, table: complex, absorber: complex, damping: float, stiffness: float = STIFFNESS_N_M
) -> NDArray[np.complex128]:
    """Amplitudes of `NAMES` for motions ``Re{X e^(st)}`` under the current that the absorber's equation asks for."""
    force = MASS_KG * s**2 * absorber + (stiffness + damping * s) * (absorber - table)
    return np.array([s**2 * table, s**2 * absorber, force / FORCE_CONSTANT_N_A])


def measured(s: complex, amplitude: NDArray[np.complex128], t: Array) -> Array:
    """(N, 4) samples of `WITH_DRIVE`."""
    turning = np.exp(s * t)[:, None]
    return np.column_stack([(turning * amplitude).real, np.cos(s.imag * t)])


def blocks(values: Array, rate_hz: float, size: int) -> list[Block]:
    return [make_block(k, rate_hz, values[k : k + size], CHANNELS) for k in range(0, len(values), size)]


def last_phasors(values: Array, rate_hz: float, size: int) -> Phasors:
    """Phasors of the last block."""
    tracker = ExcitationTracker("drive", WITH_DRIVE)
    found = [tracker.advance(block) for block in blocks(values, rate_hz, size)][-1]
    assert found is not None
    return found
