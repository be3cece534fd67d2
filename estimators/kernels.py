"""Compiled kernels of the estimators: what runs per sample."""

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array
from twin.plant.stretches import STRETCH, add_product, recursion


@kernel
def full_covariance_block(
    F: Array,
    B0: Array,
    B1: Array,
    H: Array,
    D: Array,
    Q: Array,
    variance: Array,
    x: Array,
    P: Array,
    u_before: Array,
    u: Array,
    z: Array,
    valid: NDArray[np.bool_],
    mean: Array,
    statistics: Array,
) -> None:
    """Kalman filter with the full covariance, sequential scalar updates (Bierman 1977, ch. II), in place.

    Parameters
    ----------
    F, B0, B1
        ``x_k = F x_{k-1} + B0 u_{k-1} + B1 u_k``; (n, n), (n, m), (n, m).
    H, D
        ``z = H x + D u``; (p, n), (p, m).
    Q, variance
        Process noise (n, n) and measurement variances (p,).
    x, P, u_before
        State (n,), covariance (n, n) and input (m,) at the sample before; on return, at the last one.
    u, z, valid
        (N, m) inputs, (N, p) measurements, (N, p) whether to use each.
    mean
        (N, n) receives the filtered mean.
    statistics
        (4, p) accumulates per sensor: count, squared innovations, their expected variances, NIS.
    """
    n, m, p = F.shape[0], u.shape[1], H.shape[0]
    fresh, half, gain = np.empty(n), np.empty((n, n)), np.empty(n)
    for k in range(z.shape[0]):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F[i, j] * x[j]
            for j in range(m):
                total += B0[i, j] * u_before[j] + B1[i, j] * u[k, j]
            fresh[i] = total
        for i in range(n):
            x[i] = fresh[i]
            for j in range(n):
                total = 0.0
                for q in range(n):
                    total += F[i, q] * P[q, j]
                half[i, j] = total
        for i in range(n):
            for j in range(i + 1):
                total = 0.0
                for q in range(n):
                    total += half[i, q] * F[j, q]
                P[i, j] = total + Q[i, j]
                P[j, i] = P[i, j]
        for j in range(m):
            u_before[j] = u[k, j]
        # Each innovation is given the sensors before it, so that their squares add up to the joint NIS.
        for r in range(p):
            if not valid[k, r]:
                continue
            predicted, s = 0.0, variance[r]
            for i in range(n):
                predicted += H[r, i] * x[i]
                total = 0.0
                for j in range(n):
                    total += P[i, j] * H[r, j]
                gain[i] = total
                s += H[r, i] * total
            for j in range(m):
                predicted += D[r, j] * u[k, j]
            innovation = z[k, r] - predicted
            statistics[0, r] += 1.0
            statistics[1, r] += innovation * innovation
            statistics[2, r] += s
            statistics[3, r] += innovation * innovation / s
            for i in range(n):
                x[i] += gain[i] * (innovation / s)
            for i in range(n):
                for j in range(i + 1):
                    P[i, j] -= gain[i] * gain[j] / s
                    P[j, i] = P[i, j]
        for i in range(n):
            mean[k, i] = x[i]


@kernel
def constant_gain_block(
    F: Array,
    B0: Array,
    B1: Array,
    H: Array,
    D: Array,
    gain: Array,
    residual_variance: Array,
    residual_inverse: Array,
    x: Array,
    u_before: Array,
    u: Array,
    z: Array,
    mean: Array,
    statistics: Array,
) -> None:
    """Kalman filter with a constant gain, in place; every sample must be valid.

    With e the innovation and v the inputs before and now, ``e = z - G v - H F x`` and
    ``x <- (F - K H F) x + W (v, z)``: all but the recursion in x has no memory, and is worked out for many
    samples at once, signals in rows and time along them.

    Parameters
    ----------
    gain
        (n, p) steady gain.
    residual_variance, residual_inverse
        (p,) and (p, p): diagonal and inverse of the steady innovation covariance, for the statistics.

    Others as `full_covariance_block`.
    """
    n, m, p, n_samples = F.shape[0], u.shape[1], H.shape[0], z.shape[0]
    innovation_of_x, innovation_of_inputs = np.zeros((p, n)), np.zeros((p, 2 * m))
    for r in range(p):
        for i in range(n):
            for j in range(n):
                innovation_of_x[r, j] -= H[r, i] * F[i, j]
            for j in range(m):
                innovation_of_inputs[r, j] -= H[r, i] * B0[i, j]
                innovation_of_inputs[r, m + j] -= H[r, i] * B1[i, j]
        for j in range(m):
            innovation_of_inputs[r, m + j] -= D[r, j]
    columns, drift_of_signals = F.T.copy(), np.zeros((n, 2 * m + p))
    for i in range(n):
        for j in range(m):
            drift_of_signals[i, j], drift_of_signals[i, m + j] = B0[i, j], B1[i, j]
        for r in range(p):
            for j in range(n):
                columns[j, i] += gain[i, r] * innovation_of_x[r, j]
            for j in range(2 * m):
                drift_of_signals[i, j] += gain[i, r] * innovation_of_inputs[r, j]
            drift_of_signals[i, 2 * m + r] = gain[i, r]

    signals, drift = np.zeros((2 * m + p, STRETCH)), np.zeros((n, STRETCH))
    before, innovation = np.zeros((n, STRETCH)), np.zeros((p, STRETCH))
    products = np.zeros((p, p, STRETCH))
    for first in range(0, n_samples, STRETCH):
        count = min(STRETCH, n_samples - first)
        for k in range(count):
            for j in range(m):
                signals[j, k], signals[m + j, k] = u_before[j], u[first + k, j]
                u_before[j] = u[first + k, j]
            for r in range(p):
                signals[2 * m + r, k] = innovation[r, k] = z[first + k, r]
        drift[:] = 0.0
        add_product(drift_of_signals, signals, drift, count)
        for i in range(n):
            before[i, 0] = x[i]
        recursion(columns, drift, x, mean, first, count)
        for k in range(count - 1):
            for i in range(n):
                before[i, k + 1] = mean[first + k, i]
        add_product(innovation_of_inputs, signals, innovation, count)
        add_product(innovation_of_x, before, innovation, count)
        for r in range(p):
            for q in range(r + 1):
                for k in range(count):
                    products[r, q, k] += innovation[r, k] * innovation[q, k]
    for r in range(p):
        statistics[0, r] += n_samples
        statistics[2, r] += n_samples * residual_variance[r]
        for q in range(r + 1):
            total = 0.0
            for k in range(STRETCH):
                total += products[r, q, k]
            statistics[3, r] += residual_inverse[r, q] * total
            if q == r:
                statistics[1, r] += total
            else:
                statistics[3, q] += residual_inverse[q, r] * total


@kernel
def scalar_update(x: Array, P: Array, h: Array, innovation_variance_noise: float, z: float) -> float:
    """Kalman update by one scalar measurement ``z = h x + noise``, in place.

    Returns
    -------
    float
        Normalised innovation, in standard deviations.
    """
    n = len(x)
    g = np.empty(n)
    s, predicted = innovation_variance_noise, 0.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            total += P[i, j] * h[j]
        g[i] = total
    for i in range(n):
        s += h[i] * g[i]
        predicted += h[i] * x[i]
    innovation = z - predicted
    for i in range(n):
        x[i] += g[i] * innovation / s
        for j in range(n):
            P[i, j] -= g[i] * g[j] / s
    return float(innovation / np.sqrt(s))
