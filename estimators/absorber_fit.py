"""Mass and stiffness of a spring from its resonance against added mass (thesis 7.2)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class AbsorberFit(NamedTuple):
    """Stiffness and moving mass of a spring."""

    stiffness_n_m: float
    mass_kg: float


def fit_absorber(added_mass_kg: ArrayLike, resonance_hz: ArrayLike) -> AbsorberFit:
    """Minimise thesis eq. 7-1 over all pairs of tests.

    Its first square holds the mass alone, ``w_i² (m + m_i) - w_j² (m + m_j)``, its second the stiffness alone,
    ``(k/w_i² - m_i) - (k/w_j² - m_j)``: both minima are in closed form and no search is needed.

    Parameters
    ----------
    added_mass_kg, resonance_hz
        (n_tests,) mass added and frequency of the largest transmissibility.

    Raises
    ------
    ValueError
        With fewer than two different resonances, or unless all are positive and finite.
    """
    added, hz = np.asarray(added_mass_kg, dtype=np.float64), np.asarray(resonance_hz, dtype=np.float64)
    if added.shape != hz.shape or added.ndim != 1:
        raise ValueError("give one resonance per added mass")
    if not (np.isfinite(added).all() and np.isfinite(hz).all() and (hz > 0.0).all()):
        raise ValueError("added masses must be finite and resonances above 0 Hz")
    if len(np.unique(hz)) < 2:
        raise ValueError("the fit needs at least two tests with different resonances")
    square = (2.0 * np.pi * hz) ** 2
    i, j = np.triu_indices(len(hz), 1)
    apart = square[i] - square[j]
    mass = -np.sum(apart * (square[i] * added[i] - square[j] * added[j])) / np.sum(apart**2)
    compliance = 1.0 / square[i] - 1.0 / square[j]
    stiffness = np.sum(compliance * (added[i] - added[j])) / np.sum(compliance**2)
    return AbsorberFit(float(stiffness), float(mass))
