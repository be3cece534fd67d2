"""Parts of block kernels: what has no memory is worked out for a stretch of samples at once.

Signals lie in rows, time along them, so that the innermost loops run over contiguous memory; only the recursion in
the state goes sample by sample. The order of every sum is written out: the same bits wherever it runs.
"""

from twin.plant.compiled import kernel
from twin.plant.linear import Array

STRETCH = 120
"""Samples in a stretch: few enough that its signals stay in the nearest cache."""


@kernel
def add_product(
    matrix: Array,
    rows: Array,
    out: Array,
    count: int,
    rows_from: int = 0,
    out_from: int = 0,
    keep: bool = True,
) -> None:
    """``out += matrix @ rows`` for ``count`` columns; the innermost loops run along contiguous time.

    Both arrays must own their memory row after row: processors do not take several samples of a slice at once,
    which is why the columns to begin with, ``rows_from`` and ``out_from``, are arguments. Without ``keep`` what was
    in ``out`` does not count: ``out = matrix @ rows``.
    """
    m, n = matrix.shape
    r = 0
    # Two rows share what they read.
    while r + 2 <= m:
        c, kept = 0, keep
        while c + 4 <= n:
            a, b, d, e = matrix[r, c], matrix[r, c + 1], matrix[r, c + 2], matrix[r, c + 3]
            f, g, h, i = matrix[r + 1, c], matrix[r + 1, c + 1], matrix[r + 1, c + 2], matrix[r + 1, c + 3]
            for k in range(count):
                v, w = rows[c, k + rows_from], rows[c + 1, k + rows_from]
                x, y = rows[c + 2, k + rows_from], rows[c + 3, k + rows_from]
                before, below = (out[r, k + out_from], out[r + 1, k + out_from]) if kept else (0.0, 0.0)
                out[r, k + out_from] = before + ((a * v + b * w) + (d * x + e * y))
                out[r + 1, k + out_from] = below + ((f * v + g * w) + (h * x + i * y))
            c, kept = c + 4, True
        while c < n:
            a, b = matrix[r, c], matrix[r + 1, c]
            for k in range(count):
                before, below = (out[r, k + out_from], out[r + 1, k + out_from]) if kept else (0.0, 0.0)
                out[r, k + out_from] = before + a * rows[c, k + rows_from]
                out[r + 1, k + out_from] = below + b * rows[c, k + rows_from]
            c, kept = c + 1, True
        r += 2
    if r < m:
        c, kept = 0, keep
        while c + 4 <= n:
            a, b, d, e = matrix[r, c], matrix[r, c + 1], matrix[r, c + 2], matrix[r, c + 3]
            for k in range(count):
                v, w = rows[c, k + rows_from], rows[c + 1, k + rows_from]
                x, y = rows[c + 2, k + rows_from], rows[c + 3, k + rows_from]
                before = out[r, k + out_from] if kept else 0.0
                out[r, k + out_from] = before + ((a * v + b * w) + (d * x + e * y))
            c, kept = c + 4, True
        while c < n:
            a = matrix[r, c]
            for k in range(count):
                before = out[r, k + out_from] if kept else 0.0
                out[r, k + out_from] = before + a * rows[c, k + rows_from]
            c, kept = c + 1, True


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
