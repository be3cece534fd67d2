"""Noise of measured frequency responses, read off the residuals of a fit."""

import numpy as np
from scipy.optimize import nnls

from twin.plant.linear import Array

KNOTS = 12


def noise_variance(residual_square: Array, kept: Array, level_square: Array, rounds: int = 6) -> Array:
    """Variance of each complex sample: a floor that changes slowly with frequency and a share of the response.

    ``v(f) = a(f) + b |H(f)|²``: electrical noise makes the first part, noise of the excitation and small departures
    from linearity the second. Fitted to squared residuals, whose standard deviation is their mean, by weighted
    non-negative least squares (the scores of a gamma distribution).

    Parameters
    ----------
    residual_square
        (n,) squared magnitudes of the residuals.
    kept
        (n,) share of each residual that the fit did not absorb, one minus its leverage.
    level_square
        (n,) squared magnitude of the fitted response.

    Returns
    -------
    Array
        (n,) variances, positive.
    """
    n = len(residual_square)
    kept = np.maximum(kept, 0.05)
    square = residual_square / kept
    knots = min(KNOTS, max(2, n // 25))
    at = np.linspace(0.0, knots - 1.0, n)
    hats = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(knots)))
    design = np.column_stack([hats, level_square])
    floor = max(1e-9 * float(np.mean(square)), float(np.finfo(np.float64).tiny) ** 0.5)
    variance = np.full(n, max(float(np.mean(square)), floor))
    scale = np.maximum(np.sqrt(np.mean(design**2, axis=0)), 1e-300)
    for _ in range(rounds):
        weight = np.sqrt(kept) / variance
        found = nnls(design / scale * weight[:, None], square * weight, maxiter=50 * design.shape[1])[0]
        variance = np.maximum(design @ (found / scale), floor)
    return variance
