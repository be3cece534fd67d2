"""A curve learned from scattered readings, and how well it is known."""

import math
from typing import Any

import numpy as np

from estimators.curve_basis import CurveBasis
from estimators.kernels import rls3_block, scalar_update
from twin.plant.linear import Array

DELAYS = 3


class CurveFilter:
    """Kalman filter on a basis's coefficients, which also keeps account of what delays would have done.

    A delay error is the same in every reading and averages away in none of them. So the estimate's sensitivity to it
    is carried along (a considered parameter: Schmidt 1966), and its doubt adds to the standard deviation.

    Parameters
    ----------
    values
        (n_knots,) curve to start from.
    prior_std, length_hz
        It may be off by so much, alike over about so many hertz.
    """

    def __init__(self, basis: CurveBasis, values: Array, prior_std: float, length_hz: float) -> None:
        self.basis = basis
        self._at_knots = np.array([basis.weights(float(f)) for f in basis.knots_hz])
        self._is_knots = np.array_equal(self._at_knots, np.eye(basis.size))
        self._mean = basis.start(values)
        self._prior_std = prior_std
        self._covariance = basis.prior(prior_std, length_hz)
        self._prior_variance = self._spread(self._covariance)
        self._per_delay = np.zeros((basis.size, DELAYS))
        self._seen: tuple[float, Array] = (math.nan, np.zeros(basis.size))

    @property
    def values(self) -> Array:
        """(n_knots,) the curve."""
        return np.array(self._mean if self._is_knots else self._at_knots @ self._mean)

    @property
    def noise_std(self) -> Array:
        """(n_knots,) standard deviation without that of delays."""
        return np.sqrt(self._spread(self._covariance))

    def std(self, delay_std_s: float) -> Array:
        """(n_knots,) standard deviation, with delays doubted by so much."""
        late = self._per_delay if self._is_knots else self._at_knots @ self._per_delay
        variance: Array = self._spread(self._covariance) + np.einsum("kd,kd->k", late, late) * delay_std_s**2
        return np.sqrt(variance)

    @property
    def coverage(self) -> Array:
        """(n_knots,) share of the prior variance that readings have removed, 0 to 1."""
        return np.clip(1.0 - self._spread(self._covariance) / self._prior_variance, 0.0, 1.0)

    def at(self, frequency_hz: float) -> float:
        """Curve at a frequency."""
        return float(self._weights(frequency_hz) @ self._mean)

    def _weights(self, frequency_hz: float) -> Array:
        """The basis's weights, remembered for the frequency last asked for: a block asks several times."""
        if self._seen[0] != frequency_hz:
            self._seen = frequency_hz, self.basis.weights(frequency_hz)
        return self._seen[1]

    def std_at(self, frequency_hz: float, delay_std_s: float) -> float:
        """Standard deviation at a frequency, with delays doubted by so much."""
        h = self._weights(frequency_hz)
        late = h @ self._per_delay
        return math.sqrt(max(float(h @ self._covariance @ h), 0.0) + float(late @ late) * delay_std_s**2)

    def surprise(
        self, frequency_hz: float, value: float, variance: float, per_delay: Array, delay: float
    ) -> float:
        """Distance of a reading from the curve in the standard deviations it should have."""
        h = self._weights(frequency_hz)
        late = per_delay - h @ self._per_delay
        s = max(float(h @ self._covariance @ h), 0.0) + variance + float(late @ late) * delay**2
        return (value - float(h @ self._mean)) / math.sqrt(s)

    def take(self, frequency_hz: float, value: float, variance: float, per_delay: Array) -> None:
        """Take a reading in.

        Parameters
        ----------
        variance
            Of the reading's own noise.
        per_delay
            (3,) what a second of each delay would add to it.
        """
        h = self._weights(frequency_hz)
        P = self._covariance
        late_before = h @ self._per_delay
        g = P @ h
        gain = g / (float(h @ g) + variance)
        self._per_delay += gain[:, None] * (per_delay - late_before)
        if self.basis.size == 3:
            rls3_block(self._mean, P, h[None, :], np.array([value]), np.array([variance]), 1.0)
        else:
            scalar_update(
                self._mean, P, h, variance, value
            )  # leaves what was symmetric symmetric, to the bit

    def forget(self, frequency_hz: float, variance: float) -> None:
        """Let the curve be less certain at a frequency, up to where it started."""
        self._covariance = self._covariance + self.basis.forgetting(
            frequency_hz, min(variance, self._prior_std**2)
        )

    def warm_up(self) -> None:
        """Compile what a reading needs, on copies."""
        h = np.zeros(self.basis.size)
        mean, covariance = self._mean.copy(), self._covariance.copy()
        if self.basis.size == 3:
            rls3_block(mean, covariance, h[None, :], np.zeros(1), np.ones(1), 1.0)
        else:
            scalar_update(mean, covariance, h, 1.0, 0.0)

    def state(self) -> dict[str, Any]:
        """What has been learned, as plain data."""
        return {
            "mean": self._mean.tolist(),
            "covariance": self._covariance.tolist(),
            "per_delay": self._per_delay.tolist(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave.

        Raises
        ------
        ValueError
            If it is not that of such a curve: other sizes, numbers that are not finite, no covariance.
        """
        n = self.basis.size
        mean, covariance, per_delay = (
            np.array(state[key], dtype=np.float64) for key in ("mean", "covariance", "per_delay")
        )
        if mean.shape != (n,) or covariance.shape != (n, n) or per_delay.shape != (n, DELAYS):
            raise ValueError(f"a curve of {n} coefficients was expected")
        if not all(np.isfinite(part).all() for part in (mean, covariance, per_delay)):
            raise ValueError("numbers that are not finite")
        scale = float(np.abs(covariance).max())
        if np.abs(covariance - covariance.T).max() > 1e-9 * scale:
            raise ValueError("the covariance is not symmetric")
        if float(np.linalg.eigvalsh(covariance).min()) < -1e-9 * scale:
            raise ValueError("the covariance has a negative variance")
        self._mean, self._per_delay = mean, per_delay
        self._covariance = 0.5 * (covariance + covariance.T)

    def _spread(self, covariance: Array) -> Array:
        """(n_knots,) variance of the curve."""
        if self._is_knots:
            return np.maximum(covariance.diagonal(), 0.0)
        rows = self._at_knots
        variance: Array = np.einsum("ki,ij,kj->k", rows, covariance, rows)
        return np.maximum(variance, 0.0)
