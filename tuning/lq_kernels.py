"""Compiled Riccati and Lyapunov solutions for a stable plant driven by an oscillator that no control reaches.

With ``A = [[Ap, E], [0, Ad]]``, ``b = [bp, 0]`` everything falls apart into the plant's own Riccati equation (by
structure-preserving doubling, Chu, Fan and Lin, 2005) and linear equations for the rest. However narrow the
oscillator's line, nothing here comes near the imaginary axis, where a Riccati solver for the whole would suffer.
"""

import numpy as np

from estimators.riccati import double
from twin.plant.compiled import kernel
from twin.plant.linear import Array


@kernel
def solve_sylvester(A: Array, B: Array, C: Array) -> Array:
    """X of ``A X + X B = C``, as one linear system: for matrices of a dozen rows."""
    n, m = C.shape
    big = np.zeros((n * m, n * m))
    for i in range(n):
        for j in range(m):
            row = i * m + j
            for k in range(n):
                big[row, k * m + j] += A[i, k]
            for k in range(m):
                big[row, i * m + k] += B[k, j]
    return np.linalg.solve(big, C.copy().reshape(n * m)).reshape(n, m)


@kernel
def solve_care(A: Array, b: Array, Q: Array, R: float, N: Array) -> tuple[Array, float]:
    """Stabilising P of ``A'P + P A + Q - (P b + N)(P b + N)'/R = 0``, one input.

    Returns
    -------
    tuple
        P (n, n), and the largest residual over the largest of the terms; infinite if the doubling broke down.
    """
    n = len(A)
    eye = np.eye(n)
    shifted = A - np.outer(b, N) / R
    H = Q - np.outer(N, N) / R
    G = np.outer(b, b) / R
    # Cayley transform about gamma; then A -> A², G and H grow to the two extremal solutions.
    gamma = 1.0
    inverse = np.linalg.inv(shifted - gamma * eye)
    W = np.linalg.inv((shifted - gamma * eye).T + H @ inverse @ G)
    step = eye + 2.0 * gamma * W.T
    low = 2.0 * gamma * inverse @ G @ W
    high = 2.0 * gamma * W @ H @ inverse
    if not double(step, low, high):
        return high, np.inf
    P = 0.5 * (high + high.T)
    # Newton's method (Kleinman) makes good what the doubling lost: each step is a Lyapunov equation.
    for _ in range(2):
        K = (b @ P + N) / R
        closed = A - np.outer(b, K)
        rest = Q + R * np.outer(K, K) - np.outer(N, K) - np.outer(K, N)
        P = solve_sylvester(closed.T.copy(), closed, -rest)
        P = 0.5 * (P + P.T)
    K = (b @ P + N) / R
    left = A.T @ P + P @ A
    residual = left + Q - R * np.outer(K, K)
    size = max(np.max(np.abs(left)), np.max(np.abs(Q)), R * np.max(np.abs(np.outer(K, K))))
    error = np.max(np.abs(residual)) / size
    return P, error if np.isfinite(error) else np.inf


@kernel
def excited_gain(
    A: Array, b: Array, Q: Array, R: float, N: Array, noise: Array
) -> tuple[Array, float, float]:
    """LQ gain for a plant followed by an oscillator of two states.

    Parameters
    ----------
    A, b
        (n + 2, n + 2), (n + 2,); the last two states are the oscillator's.
    Q, R, N
        (n + 2, n + 2), float, (n + 2,): cost ``x'Q x + R u² + 2 u N'x``.
    noise
        (2,) how white noise drives the oscillator.

    Returns
    -------
    tuple
        K (n + 2,) of ``u = -K x``; the least mean cost ``tr(P noise noise')``; relative residual of the Riccati
        equation.
    """
    n = len(A) - 2
    Ap, E, Ad = A[:n, :n].copy(), A[:n, n:].copy(), A[n:, n:].copy()
    bp = b[:n].copy()
    P, error = solve_care(Ap, bp, Q[:n, :n].copy(), R, N[:n].copy())
    K = np.empty(n + 2)
    K[:n] = (bp @ P + N[:n]) / R
    closed = Ap - np.outer(bp, K[:n])
    right = np.outer(K[:n], N[n:]) - P @ E - Q[:n, n:]
    across = solve_sylvester(closed.T.copy(), Ad, right)
    K[n:] = (bp @ across + N[n:]) / R
    own = E.T @ across
    corner = solve_sylvester(Ad.T.copy(), Ad, R * np.outer(K[n:], K[n:]) - Q[n:, n:] - own - own.T)
    return K, float(noise @ corner @ noise), error


@kernel
def excited_covariance(A: Array, b: Array, K: Array) -> Array:
    """Stationary covariance under ``u = -K x`` with an oscillator of unit variance, (n + 2, n + 2)."""
    n = len(A) - 2
    closed = A[:n, :n] - np.outer(b[:n], K[:n])
    drive = A[:n, n:] - np.outer(b[:n], K[n:])
    X = np.eye(n + 2)
    across = solve_sylvester(closed, A[n:, n:].T.copy(), -drive)
    own = drive @ across.T
    X[:n, :n] = solve_sylvester(closed, closed.T.copy(), -own - own.T)
    X[:n, n:], X[n:, :n] = across, across.T
    return X


@kernel
def excited_sine(A: Array, b: Array, K: Array, frequency_ratio: float) -> Array:
    """Second moments of (x, u) under ``u = -K x`` and a pure sine of the oscillator's power, (n + 3, n + 3)."""
    n = len(A) - 2
    z = np.zeros(n + 3, dtype=np.complex128)
    # d1' = w d2 at any frequency: a quarter period behind, with mean squares of 1 each.
    z[n], z[n + 1] = -1j * np.sqrt(2.0), np.sqrt(2.0)
    closed = A[:n, :n] - np.outer(b[:n], K[:n])
    drive = A[:n, n:] - np.outer(b[:n], K[n:])
    resolvent = 1j * frequency_ratio * np.eye(n) - closed
    z[:n] = np.linalg.solve(resolvent, drive.astype(np.complex128) @ z[n : n + 2].copy())
    command = 0.0 + 0.0j
    for i in range(n + 2):
        command -= K[i] * z[i]
    z[n + 2] = command
    return 0.5 * np.outer(z, np.conj(z)).real


@kernel
def joint_moments(X: Array, K: Array) -> Array:
    """Second moments of (x, u) under ``u = -K x``, one more row and column than X."""
    n = len(X)
    S = np.empty((n + 1, n + 1))
    S[:n, :n] = X
    cross = -X @ K
    S[:n, n], S[n, :n] = cross, cross
    S[n, n] = -K @ cross
    return S


@kernel
def lq_point(
    A: Array, b: Array, form: Array, noise: Array, ratios: Array
) -> tuple[Array, Array, float, float]:
    """Optimal gain of one quadratic form and the moments it leads to.

    Parameters
    ----------
    form
        (n + 3, n + 3) cost of (x, u).
    ratios
        (r,) frequencies of pure sines, over the nominal one; the first is 1.

    Returns
    -------
    tuple
        K (n + 2,); moments (1 + r, n + 3, n + 3) under the oscillator's noise, then under each sine; least mean
        cost; relative residual.
    """
    n = len(A)
    K, value, error = excited_gain(A, b, form[:n, :n].copy(), form[n, n], form[:n, n].copy(), noise)
    moments = np.empty((1 + len(ratios), n + 1, n + 1))
    moments[0] = joint_moments(excited_covariance(A, b, K), K)
    for k in range(len(ratios)):
        moments[1 + k] = excited_sine(A, b, K, ratios[k])
    return K, moments, value, error
