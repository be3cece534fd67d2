"""Damped sinusoids in recorded segments: maximum likelihood, with a covariance that holds in coloured noise."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, rfft

from estimators.fits.separable import SeparableFit, fit_separable, invert
from estimators.fits.types import Mode
from twin.plant.linear import Array

TAU = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class RingingFit:
    """Damped sinusoids that several segments share.

    Attributes
    ----------
    modes
        In the order of the first guess.
    covariance
        (2 n_modes, 2 n_modes) of natural frequency [Hz] and damping ratio, mode by mode.
    model
        Per segment (n_samples,) fitted values with offset and drift.
    drift
        Per segment (n_samples,) fitted offset and drift alone.
    amplitude
        (n_segments, n_modes) amplitude at the first sample, in the unit of the data.
    residual_rms
        Root mean square of what is left.
    """

    modes: tuple[Mode, ...]
    covariance: Array
    model: tuple[Array, ...]
    drift: tuple[Array, ...]
    amplitude: Array
    residual_rms: float


def damped_pair(time_s: Array, frequency_hz: float, damping_ratio: float) -> tuple[Array, Array]:
    """``e^(-zeta w t)`` times ``cos(w_d t)`` and ``sin(w_d t)/w_d``; hyperbolic above critical damping."""
    w = TAU * frequency_hz
    decay = np.exp(-np.clip(damping_ratio * w * time_s, -50.0, None))
    inside = 1.0 - damping_ratio**2
    if abs(inside) < 1e-12:
        return decay, time_s * decay
    wd = w * np.sqrt(abs(inside))
    if inside > 0.0:
        return decay * np.cos(wd * time_s), decay * np.sin(wd * time_s) / wd
    # Written with decaying exponentials only: cosh alone overflows.
    slow = np.exp(-np.clip((damping_ratio * w - wd) * time_s, -50.0, None))
    fast = np.exp(-np.clip((damping_ratio * w + wd) * time_s, -50.0, None))
    return 0.5 * (slow + fast), 0.5 * (slow - fast) / wd


def fit_ringing(
    segments: Sequence[Array],
    sample_rate_hz: float,
    start: Sequence[tuple[float, float]],
    *,
    drift_order: int = 1,
) -> RingingFit:
    """Fit damped sinusoids with common frequencies and damping ratios to segments of free vibration.

    Parameters
    ----------
    segments
        (n_samples,) each, any length from a few samples on; amplitudes, phases, offset and drift are its own.
    sample_rate_hz
        Samples per second.
    start
        First guess of (natural frequency [Hz], damping ratio) of each mode.
    drift_order
        Degree of the polynomial that takes offset and drift.

    Returns
    -------
    RingingFit
        With standard deviations from the residual's spectrum where the modes lie.
    """
    times = [np.arange(len(s)) / sample_rate_hz for s in segments]
    trends = [np.vander(np.linspace(-1.0, 1.0, len(t)), drift_order + 1, increasing=True) for t in times]
    theta, low, high, steps = _parameters(start, sample_rate_hz, max(len(s) for s in segments))

    def bases(now: Array) -> list[Array]:
        out = []
        for t, trend in zip(times, trends, strict=True):
            pairs = [p for f, zeta in now.reshape(-1, 2) for p in _scaled_pair(t, f, zeta)]
            out.append(np.column_stack([trend, *pairs]))
        return out

    found = fit_separable(bases, segments, theta, low, high, steps)
    covariance = spectral_covariance(found)
    std = np.sqrt(np.diag(covariance)).reshape(-1, 2)
    modes = tuple(
        Mode(float(f), float(z), float(fs), float(zs))
        for (f, z), (fs, zs) in zip(found.theta.reshape(-1, 2), std, strict=True)
    )
    amplitude = np.array([
        [float(np.hypot(*c[drift_order + 1 + 2 * m : drift_order + 3 + 2 * m])) for m in range(len(modes))]
        for c in found.coefficients
    ])  # fmt: skip
    drift = tuple(trend @ c[: drift_order + 1] for trend, c in zip(trends, found.coefficients, strict=True))
    model = tuple(s - r for s, r in zip(segments, found.residuals, strict=True))
    return RingingFit(modes, covariance, model, drift, amplitude, float(np.sqrt(found.cost / found.freedom)))


def spectral_covariance(found: SeparableFit) -> Array:
    """Covariance of the nonlinear parameters when the noise is not white.

    Least squares picks up noise only where its Jacobian has content, near the modes. The noise spectrum is read
    off the residuals, averaged over neighbouring frequencies, and passed through the estimator (the sandwich
    ``(J'J)^-1 J'SJ (J'J)^-1``). For white noise this is the usual covariance.
    """
    bread = invert(np.asarray(sum(j.T @ j for j in found.jacobians)))
    meat = np.zeros_like(bread)
    total = sum(len(r) for r in found.residuals)
    for residual, jacobian in zip(found.residuals, found.jacobians, strict=True):
        meat += _coloured(residual, jacobian) * total / found.freedom
    return bread @ meat @ bread


def _coloured(residual: Array, jacobian: Array) -> Array:
    n = len(residual)
    bins = n // 2 + 1
    spectrum = np.abs(rfft(residual)) ** 2 / n
    half = max(6, n // 40)
    if bins <= 2 * half + 1:
        return float(residual @ residual) / n * jacobian.T @ jacobian
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    smooth = np.convolve(np.pad(spectrum, half, mode="reflect"), kernel, mode="valid")
    # Twice the length, so that the product in frequency is a convolution and not a circular one.
    fine = np.interp(np.arange(n + 1) / (2.0 * n), np.arange(bins) / n, smooth)
    passed = irfft(fine[:, None] * rfft(jacobian, 2 * n, axis=0), 2 * n, axis=0)[:n]
    return np.asarray(jacobian.T @ passed)


def _scaled_pair(t: Array, frequency_hz: float, damping_ratio: float) -> tuple[Array, Array]:
    cosine, sine = damped_pair(t, frequency_hz, damping_ratio)
    return cosine, sine * TAU * frequency_hz * np.sqrt(max(abs(1.0 - damping_ratio**2), 1e-12))


def _parameters(
    start: Sequence[tuple[float, float]], sample_rate_hz: float, longest: int
) -> tuple[Array, Array, Array, Array]:
    theta = np.array(start, dtype=np.float64).reshape(-1, 2)
    f, zeta = theta[:, 0], theta[:, 1]
    width = np.maximum(f * np.maximum(np.abs(zeta), 1e-5), 0.1 * sample_rate_hz / longest)
    low = np.column_stack([0.5 * f, np.full(len(f), -0.2)])
    high = np.column_stack([np.minimum(1.6 * f, 0.55 * sample_rate_hz), np.full(len(f), 0.98)])
    steps = np.column_stack([width, width / f])
    return theta.ravel(), low.ravel(), high.ravel(), steps.ravel()
