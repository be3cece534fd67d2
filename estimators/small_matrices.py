"""Products and solutions of small matrices in compiled code.

Written out they compile in a fraction of a library call's time and, at a dozen rows, run as fast.
"""

import numpy as np

from twin.plant.compiled import kernel
from twin.plant.linear import Array


@kernel
def multiply(A: Array, B: Array, out: Array) -> None:
    """``out = A @ B``; out must be neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = 0.0
        for q in range(A.shape[1]):
            a = A[i, q]
            for j in range(B.shape[1]):
                out[i, j] += a * B[q, j]


@kernel
def multiply_transposed(A: Array, B: Array, out: Array) -> None:
    """``out = A @ B'``; out must be neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[0]):
            total = 0.0
            for q in range(A.shape[1]):
                total += A[i, q] * B[j, q]
            out[i, j] = total


@kernel
def solve_in_place(A: Array, B: Array) -> bool:
    """Replace B by ``A^-1 B``, and A by what elimination with row pivots leaves; False if A is singular."""
    n, m = B.shape
    for c in range(n):
        best = c
        for i in range(c + 1, n):
            if abs(A[i, c]) > abs(A[best, c]):
                best = i
        if not abs(A[best, c]) > 0.0:
            return False
        if best != c:
            for j in range(n):
                A[c, j], A[best, j] = A[best, j], A[c, j]
            for j in range(m):
                B[c, j], B[best, j] = B[best, j], B[c, j]
        for i in range(c + 1, n):
            factor = A[i, c] / A[c, c]
            for j in range(c + 1, n):
                A[i, j] -= factor * A[c, j]
            for j in range(m):
                B[i, j] -= factor * B[c, j]
    for i in range(n - 1, -1, -1):
        for j in range(m):
            total = B[i, j]
            for q in range(i + 1, n):
                total -= A[i, q] * B[q, j]
            B[i, j] = total / A[i, i]
    return True


@kernel
def invert_positive(A: Array) -> bool:
    """Replace a symmetric positive definite A by its inverse, by Cholesky; False, and A is used up, if it is not."""
    n = len(A)
    for j in range(n):
        pivot = A[j, j]
        for q in range(j):
            pivot -= A[j, q] * A[j, q]
        if not pivot > 0.0:
            return False
        A[j, j] = np.sqrt(pivot)
        for i in range(j + 1, n):
            total = A[i, j]
            for q in range(j):
                total -= A[i, q] * A[j, q]
            A[i, j] = total / A[j, j]
    # The factor's inverse in its place, then its product with its own transpose.
    for j in range(n):
        A[j, j] = 1.0 / A[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for q in range(j, i):
                total -= A[i, q] * A[q, j]
            A[i, j] = total / A[i, i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for q in range(i, n):
                total += A[q, i] * A[q, j]
            A[j, i] = total
    for i in range(n):
        for j in range(i):
            A[i, j] = A[j, i]
    return True
