"""Parts of block kernels: what has no memory is worked out for a stretch of samples at once.

Signals lie in rows, time along them, so that the innermost loops run over contiguous memory; only the recursion in
the state goes sample by sample. The order of every sum is written out: the same bits wherever it runs.
"""

from twin.plant.compiled import kernel
from twin.plant.linear import Array

STRETCH = 120
"""Samples in a stretch: few enough that its signals stay in the nearest cache."""


@kernel
def add_product(matrix: Array, rows: Array, out: Array, count: int) -> None:
    """``out += matrix @ rows`` for the first ``count`` columns; the innermost loops run along contiguous time."""
    n = matrix.shape[1]
    for r in range(matrix.shape[0]):
        c = 0
        while c + 4 <= n:
            a, b, d, e = matrix[r, c], matrix[r, c + 1], matrix[r, c + 2], matrix[r, c + 3]
            for k in range(count):
                out[r, k] += (a * rows[c, k] + b * rows[c + 1, k]) + (d * rows[c + 2, k] + e * rows[c + 3, k])
            c += 4
        while c < n:
            a = matrix[r, c]
            for k in range(count):
                out[r, k] += a * rows[c, k]
            c += 1


@kernel
def recursion(columns: Array, drift: Array, x: Array, mean: Array, first: int, count: int) -> None:
    """``x <- columns' x + drift`` sample by sample, in place; ``mean`` receives every x from row ``first`` on.

    Four columns at a time: a sum over columns has independent rows, which processors take several at once.
    """
    n = len(x)
    for k in range(count):
        row = first + k
        for i in range(n):
            mean[row, i] = drift[i, k]
        j = 0
        while j + 4 <= n:
            a, b, c, d = x[j], x[j + 1], x[j + 2], x[j + 3]
            for i in range(n):
                mean[row, i] += (columns[j, i] * a + columns[j + 1, i] * b) + (
                    columns[j + 2, i] * c + columns[j + 3, i] * d
                )
            j += 4
        while j < n:
            a = x[j]
            for i in range(n):
                mean[row, i] += columns[j, i] * a
            j += 1
        for i in range(n):
            x[i] = mean[row, i]
