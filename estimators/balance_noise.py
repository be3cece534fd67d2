"""How noisy an equation between channels is, learned from where it holds with nothing to excite it.

A channel's residual is no measure of that: motion that all channels share obeys the equation and does not disturb it,
while what shakes a body without being seen by its sensor does. So each channel's share in the error is fitted to the
error's own power beside the excitation, over the last blocks, and read off at the excitation.
"""

import numpy as np
from scipy.optimize import nnls

from twin.plant.linear import Array

MEMORY_BLOCKS = 30.0
PRIOR_WEIGHT = 2.0
"""Frequencies beside the excitation that the sensors' stated noise counts as, at the start."""

SUDDEN = 10.0
"""A block whose errors have this many times the expected power is judged by itself."""

LEAST = 1e-12
"""Keeps a channel's factor above 0."""


class BalanceNoise:
    """Factors on the channels' stated variances that explain the power of the equation's errors.

    Parameters
    ----------
    n_channels
        That the equation uses.
    """

    def __init__(self, n_channels: int) -> None:
        self._normal = PRIOR_WEIGHT * np.eye(n_channels)
        self._right = np.full(n_channels, PRIOR_WEIGHT)
        self.factors: Array = np.ones(n_channels)

    def take(self, shares: Array, powers: Array) -> float:
        """Take a block in.

        Parameters
        ----------
        shares
            (n, n_channels) power that each channel's stated variance would give the error at each of n
            frequencies.
        powers
            (n,) power it has.

        Returns
        -------
        float
            At least 1: by how much this block is noisier than `factors` say.
        """
        expected = shares @ self.factors
        usable = (expected > 0.0) & np.isfinite(expected) & np.isfinite(powers)
        if not usable.any():
            return 1.0
        excess = float(np.mean(powers[usable] / expected[usable]))
        sudden = excess > SUDDEN
        # A power estimated from one block scatters by its own size: weights by the inverse of that.
        rows = shares[usable] / expected[usable, None]
        seen = powers[usable] / expected[usable] * (SUDDEN / excess if sudden else 1.0)
        keep = np.exp(-1.0 / MEMORY_BLOCKS)
        self._normal = keep * self._normal + rows.T @ rows
        self._right = keep * self._right + rows.T @ seen
        root = np.linalg.cholesky(self._normal + 1e-12 * np.diag(np.diag(self._normal)))
        found, _ = nnls(root.T, np.linalg.solve(root, self._right))
        self.factors = np.maximum(found, LEAST)
        return excess if sudden else 1.0
