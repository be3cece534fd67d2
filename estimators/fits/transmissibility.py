"""Natural frequency and damping of an absorber from its transmissibility (thesis eq. 5-4)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimators.fits.response_noise import noise_variance
from estimators.fits.separable import SeparableFit, fit_separable
from estimators.fits.types import Estimate, Mode
from twin.plant.errors import InputError
from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
ROUNDS = 4


@dataclass(frozen=True, slots=True)
class TransmissibilityFit:
    """An absorber on a moving table.

    Attributes
    ----------
    mode
        Natural frequency and damping ratio of the absorber.
    gain
        Ratio of the sensors' calibrations; 1 if both are right.
    model
        (n,) fitted transmissibility, complex or magnitude like the data.
    noise_std
        (n,) standard deviation of the data as the residuals show it.
    misfit
        Normalised squared residual per degree of freedom: about 1 if the model holds.
    """

    mode: Mode
    gain: Estimate
    model: ComplexArray
    noise_std: Array
    misfit: float


def transmissibility(frequency_hz: Array, natural_hz: float, damping_ratio: float) -> ComplexArray:
    """``(2 zeta wn s + wn²)/(s² + 2 zeta wn s + wn²)`` at ``s = jw``, thesis eq. 5-4 divided by m2.

    Returns
    -------
    ComplexArray
        (n,) absorber acceleration over table acceleration.
    """
    r = frequency_hz / natural_hz
    top = 1.0 + 2j * damping_ratio * r
    return np.asarray(top / (top - r**2), dtype=np.complex128)


def fit_transmissibility(frequency_hz: ArrayLike, ratio: ArrayLike) -> TransmissibilityFit:
    """Fit thesis eq. 5-4 to a measured transmissibility.

    Parameters
    ----------
    frequency_hz
        (n,) frequencies above 0.
    ratio
        (n,) complex transmissibility, or its magnitude.

    Raises
    ------
    InputError
        With fewer than 8 frequencies, or if there is no resonance among them.
    """
    f = np.asarray(frequency_hz, dtype=np.float64)
    h = np.asarray(ratio)
    data = h.astype(np.complex128) if np.iscomplexobj(h) else h.astype(np.float64)
    if len(f) < 8:
        raise InputError(f"{len(f)} frequencies are too few for a resonance; at least 8 are needed")
    if not np.ptp(np.abs(data)) > 0.0:
        raise InputError("the transmissibility is constant; check the columns")
    size = np.abs(data)
    peak = int(np.argmax(size))
    start_f = float(f[peak])
    start_z = float(
        np.clip(1.0 / (2.0 * max(size[peak] / max(float(size[np.argmin(f)]), 1e-12), 1.05)), 2e-5, 0.6)
    )
    variance = (0.1 * size) ** 2 + (0.02 * float(np.sqrt(np.mean(size**2)))) ** 2
    guesses = ((start_f, start_z), (1.1 * start_f, 0.3))
    found = min((_fit(f, data, guess, variance) for guess in guesses), key=lambda fit: fit.cost)
    for _ in range(ROUNDS):
        variance = _learn(f, data, found, variance)
        found = _fit(f, data, (float(found.theta[0]), float(found.theta[1])), variance)
    misfit = found.cost / found.freedom
    std = np.sqrt(np.diag(found.covariance(max(1.0, misfit))))
    gain = float(found.coefficients[0][0])
    model = gain * transmissibility(f, float(found.theta[0]), float(found.theta[1]))
    left = float(
        np.sqrt(np.mean(np.abs((data if np.iscomplexobj(data) else data + 0j) - _like(model, data)) ** 2))
    )
    if left > 0.7 * float(np.std(data)):
        raise InputError("the data do not look like a transmissibility with one resonance; choose its band")
    basis = found.bases[0][:, 0]
    return TransmissibilityFit(
        mode=Mode(float(found.theta[0]), float(found.theta[1]), float(std[0]), float(std[1])),
        gain=Estimate(gain, float(np.sqrt(max(1.0, misfit) / (basis @ basis)))),
        model=_like(model, data),
        noise_std=np.sqrt(variance),
        misfit=misfit,
    )


def _like(model: ComplexArray, data: Array | ComplexArray) -> ComplexArray:
    return model if np.iscomplexobj(data) else np.abs(model).astype(np.complex128)


def _stack(values: Array | ComplexArray) -> Array:
    return np.concatenate([values.real, values.imag]) if np.iscomplexobj(values) else np.asarray(values.real)


def _weights(data: Array | ComplexArray, variance: Array) -> Array:
    if np.iscomplexobj(data):
        return np.sqrt(2.0 / np.concatenate([variance, variance]))
    return 1.0 / np.sqrt(variance)


def _fit(f: Array, data: Array | ComplexArray, start: tuple[float, float], variance: Array) -> SeparableFit:
    weights = _weights(data, variance)
    complex_data = np.iscomplexobj(data)

    def bases(now: Array) -> list[Array]:
        model = transmissibility(f, now[0], now[1])
        return [(_stack(model if complex_data else np.abs(model)) * weights)[:, None]]

    spacing = float(np.median(np.diff(np.sort(f))))
    width = max(start[0] * start[1], 0.05 * spacing)
    low, high = [max(0.3 * start[0], 1e-9), -0.02], [3.0 * start[0], 2.0]
    return fit_separable(bases, [_stack(data) * weights], start, low, high, [width, width / start[0]])


def _learn(f: Array, data: Array | ComplexArray, found: SeparableFit, variance: Array) -> Array:
    weights = _weights(data, variance)
    residual, n = found.residuals[0] / weights, len(f)
    q = np.linalg.qr(np.column_stack([found.bases[0], found.jacobians[0]]))[0]
    leverage = np.sum(q**2, axis=1)
    if np.iscomplexobj(data):
        square, kept = residual[:n] ** 2 + residual[n:] ** 2, 1.0 - 0.5 * (leverage[:n] + leverage[n:])
    else:
        square, kept = residual**2, 1.0 - leverage
    level = np.abs(found.coefficients[0][0] * transmissibility(f, found.theta[0], found.theta[1])) ** 2
    return noise_variance(square, kept, level)
