"""Compiled kernels of the estimators: what runs per sample."""

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array


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

    Parameters
    ----------
    gain
        (n, p) steady gain.
    residual_variance, residual_inverse
        (p,) and (p, p): diagonal and inverse of the steady innovation covariance, for the statistics.

    Others as `full_covariance_block`.
    """
    n, m, p = F.shape[0], u.shape[1], H.shape[0]
    fresh, innovation = np.empty(n), np.empty(p)
    for k in range(z.shape[0]):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F[i, j] * x[j]
            for j in range(m):
                total += B0[i, j] * u_before[j] + B1[i, j] * u[k, j]
            fresh[i] = total
        for j in range(m):
            u_before[j] = u[k, j]
        for r in range(p):
            total = z[k, r]
            for i in range(n):
                total -= H[r, i] * fresh[i]
            for j in range(m):
                total -= D[r, j] * u[k, j]
            innovation[r] = total
        for i in range(n):
            total = fresh[i]
            for r in range(p):
                total += gain[i, r] * innovation[r]
            x[i] = total
            mean[k, i] = total
        for r in range(p):
            total = 0.0
            for q in range(p):
                total += residual_inverse[r, q] * innovation[q]
            statistics[0, r] += 1.0
            statistics[1, r] += innovation[r] * innovation[r]
            statistics[2, r] += residual_variance[r]
            statistics[3, r] += innovation[r] * total


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
