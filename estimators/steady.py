"""The observer with its gain frozen: modal coordinates, and the kernel that runs a block in them.

With a constant gain the filter is ``x <- (F - K H F) x + W s``, s the inputs before and now and the measurements.
In the coordinates of its own modes (pairs of states that know nothing of the others) the recursion costs two
products per state instead of n; all else has no memory and is worked out for many samples at once.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.kernels import COUNT, LAGGED, NIS, NORMALISED, PAIRS, PREDICTION, SQUARES, SUM, VARIANCES
from twin.plant.compiled import kernel
from twin.plant.linear import Array, read_only
from twin.plant.modal import inverse_of_shapes, modal_recursion, modes
from twin.plant.stretches import STRETCH, add_product

WORST_CONDITION = 1e5
"""Modes nearer to each other than this, by the condition number of their shapes, are not taken apart: rounding is
multiplied by it."""


@dataclass(frozen=True, slots=True)
class SteadyFilter:
    """A Kalman filter with constant gain, as `constant_gain_block` wants it. Arrays are read-only.

    With y the modal coordinates, padded to a multiple of four, and s the signals (inputs before, inputs now,
    measurements): ``y_k = A y_{k-1} + W s_k``, ``x_k = T y_k``, and the normalised sequential innovations are
    ``w_k = N y_{k-1} + M s_k``.

    Attributes
    ----------
    pairs
        (n_y / 2, 4) rows a, b, c, d of the blocks [[a, b], [c, d]] of A; empty where A is not taken apart.
    columns
        (n_y, n_y) A transposed, for that case.
    of_signals
        (n_y, 2m + p) W.
    shapes, inverse
        (n, n_y) T and (n_y, n) its inverse, on the states.
    normalised_of_modes, normalised_of_signals
        (p, n_y) N and (p, 2m + p) M.
    root
        (p, p) lower triangular root of the innovations' covariance.
    """

    pairs: Array
    columns: Array
    of_signals: Array
    shapes: Array
    inverse: Array
    normalised_of_modes: Array
    normalised_of_signals: Array
    root: Array


def steady_filter(
    F: Array,
    B0: Array,
    B1: Array,
    H: Array,
    D: Array,
    gain: Array,
    residual: Array,
    scale: Array,
    worst_condition: float = WORST_CONDITION,
) -> SteadyFilter:
    """Take a constant-gain filter apart into its modes.

    Parameters
    ----------
    F, B0, B1, H, D
        As `estimators.kernels.full_covariance_block`.
    gain, residual
        (n, p) steady gain and (p, p) covariance of the joint innovations.
    scale
        (n,) what is a usual size of each state, in its unit: shapes are compared in these units.
    worst_condition
        Above it the recursion keeps the states as they are.
    """
    n, p, m = len(F), len(H), B0.shape[1]
    root = np.linalg.cholesky(residual)
    whitening = np.linalg.inv(root)
    innovation_of_signals = np.zeros((p, 2 * m + p))
    innovation_of_signals[:, :m] = -H @ B0
    innovation_of_signals[:, m : 2 * m] = -H @ B1 - D
    innovation_of_signals[:, 2 * m :] = np.eye(p)
    closed = F - gain @ H @ F
    of_signals = gain @ innovation_of_signals
    of_signals[:, :m] += B0
    of_signals[:, m : 2 * m] += B1
    scaled_shapes, blocks = modes(closed / scale[:, None] * scale)
    back = inverse_of_shapes(scaled_shapes, worst_condition)
    separate = back is not None
    if back is None:
        scaled_shapes, back, blocks = np.eye(n), np.eye(n), np.zeros((0, 4))
    size = -(-n // 4) * 4
    shapes, inverse = np.zeros((n, size)), np.zeros((size, n))
    shapes[:, :n] = scale[:, None] * scaled_shapes
    inverse[:n] = back / scale
    pairs = np.zeros((size // 2 if separate else 0, 4))
    pairs[: len(blocks)] = blocks
    columns = np.zeros((size, size))
    columns[:n, :n] = (inverse[:n] @ closed @ shapes[:, :n]).T
    return SteadyFilter(
        pairs=read_only(pairs),
        columns=read_only(columns),
        of_signals=read_only(inverse @ of_signals),
        shapes=read_only(shapes),
        inverse=read_only(inverse),
        normalised_of_modes=read_only(-whitening @ H @ F @ shapes),
        normalised_of_signals=read_only(whitening @ innovation_of_signals),
        root=read_only(root),
    )


@kernel
def dense_recursion(columns: Array, y: Array, count: int) -> None:
    """As `modal_recursion`, with the whole matrix, given by ``columns`` (its transpose)."""
    n = len(columns)
    state = y[:, 0].copy()
    fresh = np.empty(n)
    for k in range(1, count + 1):
        for i in range(n):
            fresh[i] = y[i, k]
        for j in range(n):
            value = state[j]
            for i in range(n):
                fresh[i] += columns[j, i] * value
        for i in range(n):
            state[i] = fresh[i]
            y[i, k] = fresh[i]


@kernel
def constant_gain_block(
    pairs: Array,
    columns: Array,
    of_signals: Array,
    shapes: Array,
    normalised_of_modes: Array,
    normalised_of_signals: Array,
    root: Array,
    limits: Array,
    modes: Array,
    u_before: Array,
    u: Array,
    values: Array,
    sensors: NDArray[np.intp],
    last: Array,
    mean: Array,
    statistics: Array,
) -> bool:
    """Run a `SteadyFilter` through samples that are all valid, in place; give up at the first that is not.

    Parameters
    ----------
    pairs, columns, of_signals, shapes, normalised_of_modes, normalised_of_signals, root
        The `SteadyFilter`.
    limits
        (2 m + p,) each signal must stay below this magnitude; no number does not.
    modes, u_before
        (n_y,) modal coordinates and (m,) inputs at the sample before; on return, at the last one.
    u
        (N, m) inputs.
    values, sensors
        (N, channels) samples and (p,) which of their columns are the measurements.
    last, statistics
        As `full_covariance_block`.
    mean
        (N, n) receives the filtered mean.

    Returns
    -------
    bool
        False where a signal passed its limit: everything in place is then to be thrown away.
    """
    m, p, n_samples, n_y = u.shape[1], len(sensors), len(u), len(modes)
    signals, y = np.zeros((2 * m + p, STRETCH)), np.zeros((n_y, STRETCH + 1))
    n, states = len(shapes), np.zeros((len(shapes), STRETCH))
    # The first column of ``normalised`` is the last one of the stretch before.
    normalised = np.zeros((p, STRETCH + 1))
    products, sums, lagged = np.zeros((p, p, STRETCH)), np.zeros((p, STRETCH)), np.zeros((p, STRETCH))
    for i in range(n_y):
        y[i, 0] = modes[i]
    for r in range(p):
        normalised[r, 0] = 0.0 if np.isnan(last[r]) else last[r]
        statistics[PAIRS, r] += n_samples - (1 if np.isnan(last[r]) else 0)
    for first in range(0, n_samples, STRETCH):
        count = min(STRETCH, n_samples - first)
        for j in range(m):
            signals[j, 0] = u_before[j]
            for k in range(count):
                signals[m + j, k] = u[first + k, j]
            for k in range(1, count):
                signals[j, k] = signals[m + j, k - 1]
            u_before[j] = signals[m + j, count - 1]
        for r in range(p):
            column = sensors[r]
            for k in range(count):
                signals[2 * m + r, k] = values[first + k, column]
        passed = 0
        for r in range(m, 2 * m + p):
            limit = limits[r]
            for k in range(count):
                passed += 0 if abs(signals[r, k]) < limit else 1
        if passed:
            return False
        add_product(of_signals, signals, y, count, 0, 1, False)
        if len(pairs):
            modal_recursion(pairs, y, count)
        else:
            dense_recursion(columns, y, count)
        add_product(shapes, y, states, count, 1, 0, False)
        for k in range(count):
            for i in range(n):
                mean[first + k, i] = states[i, k]
        add_product(normalised_of_signals, signals, normalised, count, 0, 1, False)
        add_product(normalised_of_modes, y, normalised, count, 0, 1)
        for r in range(p):
            for k in range(count):
                sums[r, k] += normalised[r, k + 1]
                lagged[r, k] += normalised[r, k + 1] * normalised[r, k]
            for q in range(r + 1):
                for k in range(count):
                    products[r, q, k] += normalised[r, k + 1] * normalised[q, k + 1]
            normalised[r, 0] = last[r] = normalised[r, count]
        for i in range(n_y):
            y[i, 0] = y[i, count]
    for i in range(n_y):
        modes[i] = y[i, 0]
    gram = np.zeros((p, p))
    for r in range(p):
        for q in range(r + 1):
            gram[r, q] = gram[q, r] = np.sum(products[r, q])
    for r in range(p):
        std, total = root[r, r], np.sum(sums[r])
        statistics[COUNT, r] += n_samples
        statistics[SUM, r] += std * total
        statistics[SQUARES, r] += std * std * gram[r, r]
        statistics[VARIANCES, r] += std * std * n_samples
        statistics[NIS, r] += gram[r, r]
        statistics[NORMALISED, r] += total
        statistics[LAGGED, r] += np.sum(lagged[r])
        for q in range(r + 1):
            for j in range(r + 1):
                statistics[PREDICTION, r] += root[r, q] * root[r, j] * gram[q, j]
    return True
