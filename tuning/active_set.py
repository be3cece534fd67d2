"""Steps of the gain search: a quadratic program of three variables with thousands of rows, solved exactly.

    minimise ½ s'Hs + g's   subject to   rows s <= upper

Goldfarb and Idnani (1983): from the free minimum, take in the row that is broken most, move along what the rows already
binding leave free, drop those whose multiplier would turn negative. At most three rows bind at a time, and the rows of
neighbouring frequencies, which are nearly parallel, do it no harm.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array

VARIABLES = 3
MOST_CHANGES = 200
BROKEN = 1e-10
PARALLEL = 1e-14


@dataclass(frozen=True, slots=True)
class Step:
    """A step (3,), and which rows bind with which multipliers."""

    step: Array
    rows: NDArray[np.int64]
    multipliers: Array


def solve_step(hessian: Array, gradient: Array, rows: Array, upper: Array) -> Step | None:
    """Solve for a step; None if the rows leave no room.

    Parameters
    ----------
    hessian, gradient
        (3, 3) positive definite, (3,).
    rows, upper
        (n, 3), (n,).
    """
    into = inverse_root(hessian)  # s = into z
    pull = into.T @ gradient
    reach = max(float(np.linalg.norm(pull)), 1e-300)
    leaning, size, bound = np.empty((len(upper), VARIABLES)), np.empty(len(upper)), np.empty(len(upper))
    straighten(rows, upper, into, reach, leaning, size, bound)
    z = -pull / reach
    binding, multipliers = np.zeros(VARIABLES, dtype=np.int64), np.zeros(VARIABLES)
    count = project(leaning, bound, z, binding, multipliers)
    if count < 0:
        return None
    chosen = binding[:count].copy()
    return Step(into @ z * reach, chosen, multipliers[:count] * reach / size[chosen])


@kernel
def _solve(gram: Array, right: Array, count: int) -> None:
    """Solve the first ``count`` equations of a positive definite system in place, by elimination."""
    for k in range(count):
        for i in range(k + 1, count):
            share = gram[i, k] / gram[k, k]
            for j in range(k, count):
                gram[i, j] -= share * gram[k, j]
            right[i] -= share * right[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            right[k] -= gram[k, j] * right[j]
        right[k] /= gram[k, k]


@kernel
def inverse_root(hessian: Array) -> Array:
    """The (3, 3) upper triangular U with ``U' H U = 1``, by Cholesky.

    Parameters
    ----------
    hessian
        (3, 3) positive definite.
    """
    root, into = np.zeros((3, 3)), np.zeros((3, 3))
    for j in range(3):
        for i in range(j, 3):
            left = hessian[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            # Rounding may leave a pivot of nothing where the damping is tiny beside the largest curvature.
            root[i, j] = np.sqrt(max(left, 1e-300)) if i == j else left / root[j, j]
    for j in range(3):
        into[j, j] = 1.0 / root[j, j]
        for i in range(j + 1, 3):
            total = 0.0
            for k in range(j, i):
                total += root[i, k] * into[j, k]
            into[j, i] = -total / root[i, i]
    return into


@kernel
def straighten(
    rows: Array, upper: Array, into: Array, reach: float, leaning: Array, size: Array, bound: Array
) -> None:
    """Rows in coordinates in which the free step is a unit vector, each of unit length.

    Parameters
    ----------
    rows, upper
        (n, 3), (n,) as asked.
    into, reach
        (3, 3) and the length that make a step of the new coordinates.
    leaning, size, bound
        (n, 3), (n,), (n,) receive rows, their length before, and what they must stay below.
    """
    for i in range(len(upper)):
        length = 0.0
        for v in range(3):
            leaning[i, v] = rows[i, 0] * into[0, v] + rows[i, 1] * into[1, v] + rows[i, 2] * into[2, v]
            length += leaning[i, v] * leaning[i, v]
        size[i] = max(np.sqrt(length), 1e-12)
        bound[i] = upper[i] / (size[i] * reach)
        for v in range(3):
            leaning[i, v] /= size[i]


@kernel
def project(rows: Array, upper: Array, z: Array, binding: NDArray[np.int64], multipliers: Array) -> int:
    """Move a point, in place, to the nearest one with ``rows z <= upper``.

    Parameters
    ----------
    rows, upper
        (n, 3) of unit length, (n,).
    z
        (3,) the point.
    binding, multipliers
        (3,) receive which rows bind and how hard.

    Returns
    -------
    int
        How many bind; -1 if there is no such point.
    """
    n, count = len(upper), 0
    r, d, gram = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    for _ in range(MOST_CHANGES):
        worst, new = BROKEN, -1
        for i in range(n):
            excess = rows[i, 0] * z[0] + rows[i, 1] * z[1] + rows[i, 2] * z[2] - upper[i]
            if excess > worst:
                worst, new = excess, i
        if new < 0:
            return count
        weight = 0.0
        while True:
            # What is left of the new row's direction by those that bind, and its parts along them.
            for j in range(count):
                for k in range(count):
                    gram[j, k] = 0.0
                    for v in range(3):
                        gram[j, k] += rows[binding[j], v] * rows[binding[k], v]
                r[j] = 0.0
                for v in range(3):
                    r[j] += rows[binding[j], v] * rows[new, v]
            _solve(gram, r, count)
            free = 0.0
            for v in range(3):
                d[v] = rows[new, v]
                for j in range(count):
                    d[v] -= r[j] * rows[binding[j], v]
                free += d[v] * d[v]
            limit, drop = np.inf, -1
            for j in range(count):
                if r[j] > 0.0 and multipliers[j] < limit * r[j]:
                    limit, drop = multipliers[j] / r[j], j
            excess = rows[new, 0] * z[0] + rows[new, 1] * z[1] + rows[new, 2] * z[2] - upper[new]
            whole = excess / free if free > PARALLEL and count < 3 else np.inf
            if drop < 0 and whole == np.inf:
                return -1
            t = min(limit, whole)
            for j in range(count):
                multipliers[j] -= t * r[j]
            weight += t
            if whole < np.inf:
                for v in range(3):
                    z[v] -= t * d[v]
            if t == whole:
                binding[count], multipliers[count] = new, weight
                count += 1
                break
            for j in range(drop, count - 1):
                binding[j], multipliers[j] = binding[j + 1], multipliers[j + 1]
            count -= 1
    return -1
