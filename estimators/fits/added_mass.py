"""Mass and stiffness of a spring from its resonance against added mass (thesis 7.2)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.stats import t as student

from estimators.fits.separable import invert
from estimators.fits.types import Estimate
from twin.plant.errors import InputError
from twin.plant.linear import Array

TAU = 2.0 * np.pi


class AbsorberFit(NamedTuple):
    """Stiffness and moving mass of a spring."""

    stiffness_n_m: float
    mass_kg: float


@dataclass(frozen=True, slots=True)
class AddedMassFit:
    """Stiffness and moving mass by two estimators from the same tests.

    Attributes
    ----------
    stiffness_n_m, mass_kg
        Maximum likelihood: errors are in the frequencies, the masses are known.
    printed_stiffness_n_m, printed_mass_kg
        Minimum of thesis eq. 7-1, with the standard deviations that the same frequency errors give it.
    correlation
        Between stiffness and mass of the first.
    quantile
        Standard deviations in a two-sided 95 % interval; more than 1.96 because few tests tell their own noise.
    frequency_std_hz
        (n_tests,) standard deviation of the resonances, stated or read off the residuals.
    model_hz
        (n_tests,) resonances of the fitted spring.
    """

    stiffness_n_m: Estimate
    mass_kg: Estimate
    printed_stiffness_n_m: Estimate
    printed_mass_kg: Estimate
    correlation: float
    quantile: float
    frequency_std_hz: Array
    model_hz: Array
    covariance: Array


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
    square = (TAU * hz) ** 2
    i, j = np.triu_indices(len(hz), 1)
    apart = square[i] - square[j]
    mass = -np.sum(apart * (square[i] * added[i] - square[j] * added[j])) / np.sum(apart**2)
    compliance = 1.0 / square[i] - 1.0 / square[j]
    stiffness = np.sum(compliance * (added[i] - added[j])) / np.sum(compliance**2)
    return AbsorberFit(float(stiffness), float(mass))


def fit_added_mass(
    added_mass_kg: ArrayLike, resonance_hz: ArrayLike, frequency_std_hz: ArrayLike | None = None
) -> AddedMassFit:
    """Stiffness and moving mass with their standard deviations.

    Eq. 7-1 multiplies measured frequencies with each other, so its minimum is biased by their noise and weighs the
    highest resonances most. The maximum likelihood estimate compares measured with modelled frequencies,
    ``f = sqrt(k/(m + m_i))/2π``, and is the one to trust.

    Parameters
    ----------
    added_mass_kg, resonance_hz
        (n_tests,) tests.
    frequency_std_hz
        (n_tests,) standard deviations of the resonances; the same for all, read off the residuals, unless given.

    Raises
    ------
    InputError
        With fewer than three tests (two if the standard deviations are given), or if no spring fits them.
    """
    added, hz = np.asarray(added_mass_kg, dtype=np.float64), np.asarray(resonance_hz, dtype=np.float64)
    known = frequency_std_hz is not None
    std = np.asarray(frequency_std_hz, dtype=np.float64) if known else np.ones(len(hz))
    if len(hz) < (2 if known else 3) or len(np.unique(added)) < 2:
        raise InputError(
            f"{len(hz)} tests with {len(np.unique(added))} different masses: stiffness, mass and their errors need "
            "at least three tests with at least two different masses"
        )
    if not np.all(std > 0.0):
        raise InputError("standard deviations of the resonances must be positive")
    try:
        printed = fit_absorber(added, hz)
    except ValueError as error:
        raise InputError(str(error)) from error
    slope, level = np.polyfit(added, 1.0 / (TAU * hz) ** 2, 1)
    if slope <= 0.0 or level + slope * float(added.min()) <= 0.0:
        raise InputError("the resonance does not fall as mass is added; check the columns and their units")
    first = np.log(
        [1.0 / slope, max(level / slope, -float(added.min()) + 1e-6 * np.ptp(added)) + _shift(added)]
    )

    def model(log: Array) -> Array:
        stiffness, mass = np.exp(log[0]), np.exp(log[1]) - _shift(added)
        return np.asarray(np.sqrt(stiffness / (mass + added)) / TAU)

    def residual(log: Array) -> Array:
        return np.asarray((hz - model(log)) / std)

    found = least_squares(residual, first, x_scale=[0.01, 0.01], ftol=1e-14, xtol=1e-14)
    stiffness, mass = float(np.exp(found.x[0])), float(np.exp(found.x[1]) - _shift(added))
    at = model(found.x)
    jacobian = np.column_stack([at / (2.0 * stiffness), -at / (2.0 * (mass + added))]) / std[:, None]
    degrees = len(hz) - 2
    scale = 1.0 if known else 2.0 * found.cost / degrees
    covariance = scale * invert(jacobian.T @ jacobian)
    noise = std if known else np.full(len(hz), float(np.sqrt(scale)))
    errors = np.sqrt(np.diag(covariance))
    k7, m7 = _printed_std(added, at, noise)
    return AddedMassFit(
        stiffness_n_m=Estimate(stiffness, float(errors[0])),
        mass_kg=Estimate(mass, float(errors[1])),
        printed_stiffness_n_m=Estimate(printed.stiffness_n_m, k7),
        printed_mass_kg=Estimate(printed.mass_kg, m7),
        correlation=float(covariance[0, 1] / max(errors[0] * errors[1], 1e-300)),
        quantile=1.96 if known else float(student.ppf(0.975, degrees)),
        frequency_std_hz=noise,
        model_hz=at,
        covariance=covariance,
    )


def _shift(added: Array) -> float:
    """Keeps the logarithm defined where masses were taken away."""
    return max(0.0, -float(added.min()))


def _printed_std(added: Array, hz: Array, noise: Array) -> tuple[float, float]:
    """Standard deviations of the minimum of eq. 7-1, by its derivatives at the fitted resonances."""
    total = np.zeros(2)
    for k, std in enumerate(noise):
        shift = np.zeros(len(hz))
        shift[k] = 1e-5 * hz[k]
        change = np.array(fit_absorber(added, hz + shift)) - np.array(fit_absorber(added, hz - shift))
        total += (change / (2e-5 * hz[k]) * std) ** 2
    return float(np.sqrt(total[0])), float(np.sqrt(total[1]))
