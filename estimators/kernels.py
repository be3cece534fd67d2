"""Compiled kernels of the estimators: what runs per sample.

Innovations are sequential in both kernels of the observer: each sensor's is what the sensors before it in the same
sample leave unexplained, so that normalised they are independent standard normals and their squares add up to the
joint NIS. The joint one-step prediction error, before any sensor of the sample, is kept beside them.
"""

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array

STATISTICS = 9
COUNT, SUM, SQUARES, VARIANCES, NIS, NORMALISED, LAGGED, PAIRS, PREDICTION = range(STATISTICS)
"""Rows of the statistics that the observer's kernels add up per sensor: valid samples; innovations, their squares and
the variances expected of them; normalised innovations squared, normalised innovations, products of one with the next
and how many such pairs there were; squares of the joint one-step prediction errors."""

ABSURD = 1e150
"""Values from here on, whose squares overflow, and those that are no number are never taken in."""


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
    last: Array,
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
        (N, m) inputs, (N, p) measurements, (N, p) whether to use each. What is no finite number is not used
        either way; such an input keeps its value of the sample before.
    last
        (p,) normalised innovations of the sample before, NaN where there was none; on return, of the last one.
    mean
        (N, n) receives the filtered mean.
    statistics
        (STATISTICS, p) sums per sensor, added to.
    """
    n, m, p = F.shape[0], u.shape[1], H.shape[0]
    fresh, half, gain, now = np.empty(n), np.empty((n, n)), np.empty(n), np.empty(m)
    prediction = np.empty(p)
    for k in range(z.shape[0]):
        for j in range(m):
            now[j] = u[k, j] if abs(u[k, j]) < ABSURD else u_before[j]
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F[i, j] * x[j]
            for j in range(m):
                total += B0[i, j] * u_before[j] + B1[i, j] * now[j]
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
            u_before[j] = now[j]
        for r in range(p):
            total = 0.0
            for i in range(n):
                total += H[r, i] * x[i]
            for j in range(m):
                total += D[r, j] * now[j]
            prediction[r] = total
        for r in range(p):
            if not valid[k, r] or not abs(z[k, r]) < ABSURD:
                last[r] = np.nan
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
                predicted += D[r, j] * now[j]
            innovation = z[k, r] - predicted
            normalised = innovation / np.sqrt(s)
            statistics[COUNT, r] += 1.0
            statistics[SUM, r] += innovation
            statistics[SQUARES, r] += innovation * innovation
            statistics[VARIANCES, r] += s
            statistics[NIS, r] += normalised * normalised
            statistics[NORMALISED, r] += normalised
            statistics[PREDICTION, r] += (z[k, r] - prediction[r]) ** 2
            if not np.isnan(last[r]):
                statistics[LAGGED, r] += normalised * last[r]
                statistics[PAIRS, r] += 1.0
            last[r] = normalised
            for i in range(n):
                x[i] += gain[i] * (innovation / s)
            for i in range(n):
                for j in range(i + 1):
                    P[i, j] -= gain[i] * gain[j] / s
                    P[j, i] = P[i, j]
        for i in range(n):
            mean[k, i] = x[i]


@kernel
def summarise(sums: Array, out: Array) -> None:
    """Means of the statistics per sensor.

    Parameters
    ----------
    sums
        (STATISTICS, p) what the observer's kernels added up.
    out
        (7, p) receives count, mean, root mean square and expected standard deviation of the innovations, their
        autocorrelation from one sample to the next, mean NIS, and root mean square of the prediction error; NaN
        where nothing was measured.
    """
    for r in range(sums.shape[1]):
        count, pairs = sums[COUNT, r], sums[PAIRS, r]
        out[0, r] = count
        if count == 0.0:
            out[1:, r] = np.nan
            continue
        out[1, r] = sums[SUM, r] / count
        out[2, r] = np.sqrt(sums[SQUARES, r] / count)
        out[3, r] = np.sqrt(sums[VARIANCES, r] / count)
        # About the mean, so that a bias does not pass for colour.
        mean, nis = sums[NORMALISED, r] / count, sums[NIS, r] / count
        spread = nis - mean * mean
        lag1 = (sums[LAGGED, r] / pairs - mean * mean) / spread if pairs > 0.0 and spread > 0.0 else np.nan
        out[4, r] = min(max(lag1, -1.0), 1.0) if count > 2.0 else np.nan
        out[5, r] = nis
        out[6, r] = np.sqrt(max(sums[PREDICTION, r], 0.0) / count)


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


@kernel
def rls3_block(theta: Array, P: Array, phi: Array, z: Array, variance: Array, forgetting: float) -> None:
    """Recursive least squares for three parameters over a block of scalar measurements, in place.

    ``z = phi theta + noise``. With a forgetting factor the covariance is divided by it before each measurement
    (Ljung 1999, section 11.2); a Kalman filter with that fading memory does the same. Written out for the six
    different elements of P: time goes where one sample's P waits for that of the sample before.

    Parameters
    ----------
    theta, P
        (3,) parameters and (3, 3) covariance; on return, after the last measurement. The upper triangle is read.
    phi, z, variance
        (N, 3) regressors, (N,) measurements, (N,) their noise variances. A measurement with anything that is not
        finite, or with a variance that is not positive, is left out, and nothing is forgotten for it.
    forgetting
        0 to 1; with 1 everything is remembered.
    """
    t0, t1, t2 = theta[0], theta[1], theta[2]
    p00, p01, p02, p11, p12, p22 = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    inflation = 1.0 / forgetting
    for k in range(len(z)):
        a, b, c = phi[k, 0], phi[k, 1], phi[k, 2]
        g0 = p00 * a + p01 * b + p02 * c
        g1 = p01 * a + p11 * b + p12 * c
        g2 = p02 * a + p12 * b + p22 * c
        s = (forgetting * variance[k] + a * g0) + (b * g1 + c * g2)
        innovation = z[k] - (t0 * a + t1 * b + t2 * c)
        if not (abs(innovation) < ABSURD and s < ABSURD and variance[k] > 0.0):
            continue
        step = inflation / s
        h0, h1, h2 = g0 * step, g1 * step, g2 * step
        innovation *= forgetting
        t0 += h0 * innovation
        t1 += h1 * innovation
        t2 += h2 * innovation
        p00 = p00 * inflation - h0 * g0
        p01 = p01 * inflation - h0 * g1
        p02 = p02 * inflation - h0 * g2
        p11 = p11 * inflation - h1 * g1
        p12 = p12 * inflation - h1 * g2
        p22 = p22 * inflation - h2 * g2
    theta[0], theta[1], theta[2] = t0, t1, t2
    P[0, 0], P[0, 1], P[0, 2] = p00, p01, p02
    P[1, 0], P[1, 1], P[1, 2] = p01, p11, p12
    P[2, 0], P[2, 1], P[2, 2] = p02, p12, p22
