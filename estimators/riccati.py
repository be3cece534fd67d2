"""The steady covariance of a Kalman filter: the discrete algebraic Riccati equation by doubling.

``P = F P F' + Q - F P H' (H P H' + R)^-1 H P F'``, P the covariance before a measurement. The structure-preserving
doubling algorithm (Chu, Fan, Lin and Wang 2004; Anderson 1978) takes as many steps of the recursion at its k-th
iteration as all before together: some twenty iterations stand for a million samples.
"""

import numpy as np

from estimators.small_matrices import multiply, multiply_transposed, solve_in_place
from twin.plant.compiled import kernel
from twin.plant.linear import Array

MAX_DOUBLINGS = 60
"""2^60 samples: what has not settled by then never does."""


def steady_prior(F: Array, H: Array, Q: Array, R: Array) -> Array:
    """Covariance before a measurement that the Kalman filter's recursion settles at.

    Parameters
    ----------
    F, H, Q, R
        (n, n), (p, n), (n, n), (p, p); R positive definite.

    Returns
    -------
    ndarray
        (n, n), symmetric.

    Raises
    ------
    numpy.linalg.LinAlgError
        If there is none: some state grows or wanders and no measurement tells of it.
    """
    X = np.empty(F.shape)
    if not settle(F, H, Q, R, X):
        raise np.linalg.LinAlgError(
            "no steady covariance: a state grows or wanders that no measurement tells of"
        )
    return X


@kernel
def settle(F: Array, H: Array, Q: Array, R: Array, X: Array) -> bool:
    """`steady_prior` into X; False if there is none."""
    n, p = len(F), len(R)
    factor, told = R.copy(), H.copy()
    if not solve_in_place(factor, told):
        return False
    informed = np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for r in range(p):
                informed[i, j] += H[r, i] * told[r, j]
    scale = np.ones(n)
    for i in range(n):
        if Q[i, i] > 0.0:
            scale[i] = np.sqrt(Q[i, i])
    A, G = np.empty((n, n)), np.empty((n, n))
    # SI units lie many decades apart. The first pass finds how large each state's uncertainty is, the second works
    # in these units.
    for _ in range(2):
        for i in range(n):
            for j in range(n):
                units = scale[i] * scale[j]
                A[j, i] = F[i, j] / scale[i] * scale[j]
                G[i, j], X[i, j] = informed[i, j] * units, Q[i, j] / units
        if not double(A, G, X):
            return False
        for i in range(n):
            if not X[i, i] >= 0.0:  # which no number is not
                return False
        for i in range(n):
            for j in range(n):
                X[i, j] *= scale[i] * scale[j]
        for i in range(n):
            if X[i, i] > 0.0:
                scale[i] = np.sqrt(X[i, i])
    for i in range(n):
        for j in range(i):
            X[i, j] = X[j, i] = 0.5 * (X[i, j] + X[j, i])
    # Where a measurement tells much more than was known, I + G X loses digits. Newton's method finds them again: the
    # residual, as it would go on through the filter's own samples.
    change, closed = np.empty((n, n)), np.empty((n, n))
    for _ in range(2):
        residual(F, H, Q, R, X, change, closed)
        largest = 0.0
        for i in range(n):
            for j in range(n):
                change[i, j] /= scale[i] * scale[j]
                closed[i, j] *= scale[j] / scale[i]
                largest = max(largest, abs(change[i, j]))
        if largest <= 1e-15 or not sum_of_powers(closed, change):
            break
        for i in range(n):
            for j in range(i + 1):
                step = 0.5 * (change[i, j] + change[j, i]) * (scale[i] * scale[j])
                X[i, j] += step
                if j < i:
                    X[j, i] += step
    return True


@kernel
def residual(F: Array, H: Array, Q: Array, R: Array, prior: Array, change: Array, closed: Array) -> None:
    """What one sample adds to a prior covariance into ``change``, and ``F (I - K H)`` into ``closed``."""
    n, p = len(F), len(R)
    seen, spread = np.empty((p, n)), np.empty((p, p))
    multiply(H, prior, seen)
    multiply_transposed(seen, H, spread)
    for r in range(p):
        for q in range(p):
            spread[r, q] += R[r, q]
    solve_in_place(spread, seen)  # the gain, transposed
    through, left, half = np.empty((n, p)), np.empty((n, n)), np.empty((n, n))
    multiply_transposed(F, seen, through)
    multiply(through, H, half)
    for i in range(n):
        for j in range(n):
            closed[i, j] = F[i, j] - half[i, j]
    multiply(closed, prior, half)
    multiply_transposed(half, closed, change)
    noise = np.empty((n, p))
    multiply(through, R, noise)
    multiply_transposed(noise, through, left)
    for i in range(n):
        for j in range(n):
            change[i, j] += left[i, j] + Q[i, j] - prior[i, j]


def riccati_step(F: Array, H: Array, Q: Array, R: Array, prior: Array) -> Array:
    """One sample of the recursion whose steady state `steady_prior` is."""
    change, closed = np.empty(F.shape), np.empty(F.shape)
    residual(F, H, Q, R, np.array(prior), change, closed)
    return np.asarray(prior + change)


@kernel
def sum_of_powers(A: Array, X: Array) -> bool:
    """``X <- X + A X A' + A² X A'² + ...`` by doubling (Smith 1968), in place; A is used up. Whether it converged."""
    n = len(A)
    half, added = np.empty((n, n)), np.empty((n, n))
    for _ in range(MAX_DOUBLINGS):
        multiply(A, X, half)
        multiply_transposed(half, A, added)
        largest, change = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                X[i, j] += added[i, j]
                change, largest = max(change, abs(added[i, j])), max(largest, abs(X[i, j]))
        if not largest < np.inf:
            return False
        if change <= 1e-16 * largest:
            return True
        multiply(A, A, half)
        for i in range(n):
            for j in range(n):
                A[i, j] = half[i, j]
    return False


@kernel
def double(A: Array, G: Array, X: Array) -> bool:
    """Doubling iteration for ``X = A' X (I + G X)^-1 A + X0``, in place; whether it settled.

    Parameters
    ----------
    A, G
        (n, n) F' and H' R^-1 H; used up.
    X
        (n, n) Q; on return, the solution.
    """
    n = len(A)
    W, both, half = np.empty((n, n)), np.empty((n, 2 * n)), np.empty((n, n))
    right, fresh = np.empty((n, n)), np.empty((n, n))
    for _ in range(MAX_DOUBLINGS):
        # W = I + G X; left = W^-1 A and right = W^-1 G A' in one go.
        multiply(G, X, W)
        multiply_transposed(G, A, half)
        for i in range(n):
            W[i, i] += 1.0
            for j in range(n):
                both[i, j], both[i, n + j] = A[i, j], half[i, j]
        if not solve_in_place(W, both):
            return False
        # X + A' X left, through the columns of A.
        left = both[:, :n]
        multiply(X, left, half)
        largest, change = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                total = 0.0
                for q in range(n):
                    total += A[q, i] * half[q, j]
                fresh[i, j] = total
        for i in range(n):
            for j in range(n):
                step = 0.5 * (fresh[i, j] + fresh[j, i])
                X[i, j] += step
                change, largest = max(change, abs(step)), max(largest, abs(X[i, j]))
        if not largest < np.inf:
            return False
        if change <= 1e-16 * largest:
            return True
        # G + A right and A left.
        for i in range(n):
            for j in range(n):
                right[i, j] = both[i, n + j]
        multiply(A, right, half)
        multiply(A, left, fresh)
        for i in range(n):
            for j in range(n):
                G[i, j] += 0.5 * (half[i, j] + half[j, i])
                A[i, j] = fresh[i, j]
    return False
