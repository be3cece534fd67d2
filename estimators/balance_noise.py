"""How noisy an equation between channels is, learned from where it holds with nothing to excite it.

A channel's residual is no measure of that: motion that all channels share obeys the equation and does not disturb it,
while what shakes a body without being seen by its sensor does. So each channel's share in the error is fitted to the
error's own power beside the excitation, over the last blocks, and read off at the excitation.
"""

import math

import numpy as np
from scipy.optimize import nnls

from twin.plant.compiled import kernel
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
        n = len(self._right)
        root, reduced = np.zeros((n, n)), np.empty(n)
        excess = fold_in(shares, powers, self.factors, self._normal, self._right, root, reduced)
        if math.isnan(excess):
            return 1.0
        # The normal equations by their root: non-negative least squares of as many rows as there are channels.
        found, _ = nnls(root, reduced)
        self.factors = np.maximum(found, LEAST)
        return excess if excess > SUDDEN else 1.0


@kernel
def fold_in(
    shares: Array, powers: Array, factors: Array, normal: Array, right: Array, root: Array, reduced: Array
) -> float:
    """Take a block's errors into the normal equations, in place.

    Parameters
    ----------
    shares, powers
        As `BalanceNoise.take`.
    factors
        (n,) so far.
    normal, right
        (n, n) and (n,) what is remembered.
    root, reduced
        (n, n) zeros and (n,): receive an upper triangular R and z with ``R'R = normal``, ``R'z = right``.

    Returns
    -------
    float
        Mean of the powers over what the factors say; NaN, and nothing is changed, where nothing can be compared.
    """
    n = len(right)
    expected = np.zeros(len(powers))
    used, excess = 0, 0.0
    for k in range(len(powers)):
        for c in range(n):
            expected[k] += shares[k, c] * factors[c]
        if expected[k] > 0.0 and np.isfinite(expected[k]) and np.isfinite(powers[k]):
            excess += powers[k] / expected[k]
            used += 1
    if not used:
        return np.nan
    excess /= used
    keep, calmed = np.exp(-1.0 / MEMORY_BLOCKS), SUDDEN / excess if excess > SUDDEN else 1.0
    for c in range(n):
        right[c] *= keep
        for d in range(n):
            normal[c, d] *= keep
    for k in range(len(powers)):
        if not (expected[k] > 0.0 and np.isfinite(expected[k]) and np.isfinite(powers[k])):
            continue
        # A power estimated from one block scatters by its own size: weights by the inverse of that.
        seen = powers[k] / expected[k] * calmed
        for c in range(n):
            right[c] += shares[k, c] / expected[k] * seen
            for d in range(n):
                normal[c, d] += (shares[k, c] / expected[k]) * (shares[k, d] / expected[k])
    for j in range(n):
        for i in range(j + 1):
            total = normal[i, j] * (1.0 + 1e-12) if i == j else normal[i, j]
            for q in range(i):
                total -= root[q, i] * root[q, j]
            root[i, j] = np.sqrt(total) if i == j else total / root[i, i]
    for i in range(n):
        total = right[i]
        for q in range(i):
            total -= root[q, i] * reduced[q]
        reduced[i] = total / root[i, i]
    return excess
