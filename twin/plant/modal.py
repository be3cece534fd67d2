"""A linear recursion in the coordinates of its own modes: pairs of states that know nothing of the others.

``x <- A x + s`` costs n products per state; in modal coordinates it costs two, and the pairs need not wait for one
another.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.plant.compiled import kernel
from twin.plant.discrete import DiscreteModel
from twin.plant.linear import Array, read_only
from twin.plant.stretches import STRETCH, add_product

WORST_CONDITION = 1e4
"""Modes nearer to each other than this, by the condition number of their shapes, are not taken apart: rounding is
multiplied by it."""


@dataclass(frozen=True, slots=True)
class ModalModel:
    """A `DiscreteModel` in modal coordinates y: ``y_k = A y_{k-1} + W s_k``, outputs ``T y_k + D u_k``.

    Arrays are read-only; n_y is n padded to a multiple of four; s are the inputs before and now.

    Attributes
    ----------
    pairs
        (n_y / 2, 4) rows a, b, c, d of the blocks [[a, b], [c, d]] of A.
    of_inputs
        (n_y, 2m) W.
    outputs, feedthrough
        (p, n_y) T and (p, m) D.
    shapes, inverse
        (n, n_y) and (n_y, n): from modal coordinates to states, and back.
    """

    pairs: Array
    of_inputs: Array
    outputs: Array
    feedthrough: Array
    shapes: Array
    inverse: Array


def modal_model(d: DiscreteModel, C: Array, D: Array) -> ModalModel | None:
    """Take a model apart into its modes; None if they are too close together.

    Parameters
    ----------
    C, D
        (p, n) and (p, m), of the outputs that are wanted.
    """
    n = len(d.F)
    # States of one size each: positions in metres and currents in amperes lie decades apart.
    seen = np.abs(C).max(axis=0, initial=0.0)
    scale = 1.0 / np.where(seen > 0.0, seen, 1.0)
    scaled, blocks = modes(d.F / scale[:, None] * scale)
    back = inverse_of_shapes(scaled, WORST_CONDITION)
    if back is None:
        return None
    size = -(-n // 4) * 4
    shapes, inverse, pairs = np.zeros((n, size)), np.zeros((size, n)), np.zeros((size // 2, 4))
    shapes[:, :n], inverse[:n], pairs[: len(blocks)] = scale[:, None] * scaled, back / scale, blocks
    return ModalModel(
        pairs=read_only(pairs),
        of_inputs=read_only(inverse @ np.hstack([d.B0, d.B1])),
        outputs=read_only(C @ shapes),
        feedthrough=read_only(D),
        shapes=read_only(shapes),
        inverse=read_only(inverse),
    )


def inverse_of_shapes(shapes: Array, worst_condition: float) -> Array | None:
    """Inverse of shapes that can be told apart: None if their condition number, by Frobenius, is above the worst."""
    try:
        inverse = np.linalg.inv(shapes)
    except np.linalg.LinAlgError:
        return None
    condition = math.sqrt(float(np.vdot(shapes, shapes)) * float(np.vdot(inverse, inverse)))
    return np.asarray(inverse) if condition <= worst_condition else None


def modes(A: Array) -> tuple[Array, Array]:
    """Real shapes (n, n) and blocks (ceil(n / 2), 4): complex modes first, then real ones two and two."""
    values, vectors = np.linalg.eig(A)
    upper, real = np.flatnonzero(values.imag > 0.0), np.flatnonzero(values.imag == 0.0)
    shapes = [part for j in upper for part in (vectors[:, j].real, vectors[:, j].imag)]
    blocks = [(values[j].real, values[j].imag, -values[j].imag, values[j].real) for j in upper]
    shapes += [vectors[:, j].real for j in real]
    own = [float(values[j].real) for j in real] + [0.0] * (len(real) % 2)
    blocks += [(a, 0.0, 0.0, d) for a, d in zip(own[::2], own[1::2], strict=True)]
    return np.column_stack(shapes), np.array(blocks)


@kernel
def modal_recursion(pairs: Array, y: Array, count: int) -> None:
    """``y[:, k] <- A y[:, k-1] + y[:, k]`` for k = 1 .. count, in place, A block-diagonal.

    Every step waits for the one before, but not for those of other pairs: four pairs, or two, take turns.

    Parameters
    ----------
    pairs
        (n_y / 2, 4) blocks, an even number of them.
    y
        (n_y, count + 1 or more), the start in column 0.
    """
    n, b = len(pairs), 0
    while b + 4 <= n:
        a0, b0, c0, d0 = pairs[b, 0], pairs[b, 1], pairs[b, 2], pairs[b, 3]
        a1, b1, c1, d1 = pairs[b + 1, 0], pairs[b + 1, 1], pairs[b + 1, 2], pairs[b + 1, 3]
        a2, b2, c2, d2 = pairs[b + 2, 0], pairs[b + 2, 1], pairs[b + 2, 2], pairs[b + 2, 3]
        a3, b3, c3, d3 = pairs[b + 3, 0], pairs[b + 3, 1], pairs[b + 3, 2], pairs[b + 3, 3]
        r = 2 * b
        p0, q0, p1, q1 = y[r, 0], y[r + 1, 0], y[r + 2, 0], y[r + 3, 0]
        p2, q2, p3, q3 = y[r + 4, 0], y[r + 5, 0], y[r + 6, 0], y[r + 7, 0]
        for k in range(1, count + 1):
            p0, q0 = (y[r, k] + a0 * p0) + b0 * q0, (y[r + 1, k] + c0 * p0) + d0 * q0
            p1, q1 = (y[r + 2, k] + a1 * p1) + b1 * q1, (y[r + 3, k] + c1 * p1) + d1 * q1
            p2, q2 = (y[r + 4, k] + a2 * p2) + b2 * q2, (y[r + 5, k] + c2 * p2) + d2 * q2
            p3, q3 = (y[r + 6, k] + a3 * p3) + b3 * q3, (y[r + 7, k] + c3 * p3) + d3 * q3
            y[r, k], y[r + 1, k], y[r + 2, k], y[r + 3, k] = p0, q0, p1, q1
            y[r + 4, k], y[r + 5, k], y[r + 6, k], y[r + 7, k] = p2, q2, p3, q3
        b += 4
    while b < n:
        a0, b0, c0, d0 = pairs[b, 0], pairs[b, 1], pairs[b, 2], pairs[b, 3]
        a1, b1, c1, d1 = pairs[b + 1, 0], pairs[b + 1, 1], pairs[b + 1, 2], pairs[b + 1, 3]
        r = 2 * b
        p0, q0, p1, q1 = y[r, 0], y[r + 1, 0], y[r + 2, 0], y[r + 3, 0]
        for k in range(1, count + 1):
            p0, q0 = (y[r, k] + a0 * p0) + b0 * q0, (y[r + 1, k] + c0 * p0) + d0 * q0
            p1, q1 = (y[r + 2, k] + a1 * p1) + b1 * q1, (y[r + 3, k] + c1 * p1) + d1 * q1
            y[r, k], y[r + 1, k], y[r + 2, k], y[r + 3, k] = p0, q0, p1, q1
        b += 2


@kernel
def simulate_modes(
    pairs: Array,
    of_inputs: Array,
    outputs: Array,
    feedthrough: Array,
    modes: Array,
    u_before: Array,
    u: Array,
    out: Array,
) -> None:
    """Step a `ModalModel` through a block, in place.

    Parameters
    ----------
    pairs, of_inputs, outputs, feedthrough
        The `ModalModel`.
    modes, u_before
        (n_y,) modal coordinates and (m,) inputs at the sample before; on return, at the last one.
    u
        (N, m) inputs.
    out
        (N, p) receives the outputs.
    """
    m, p, n_samples, n_y = u.shape[1], outputs.shape[0], len(u), len(modes)
    signals, now = np.zeros((2 * m, STRETCH)), np.zeros((m, STRETCH))
    y, rows = np.zeros((n_y, STRETCH + 1)), np.zeros((p, STRETCH))
    for i in range(n_y):
        y[i, 0] = modes[i]
    for first in range(0, n_samples, STRETCH):
        count = min(STRETCH, n_samples - first)
        for j in range(m):
            signals[j, 0] = u_before[j]
            for k in range(count):
                signals[m + j, k] = now[j, k] = u[first + k, j]
            for k in range(1, count):
                signals[j, k] = now[j, k - 1]
            u_before[j] = now[j, count - 1]
        add_product(of_inputs, signals, y, count, 0, 1, False)
        modal_recursion(pairs, y, count)
        add_product(outputs, y, rows, count, 1, 0, False)
        add_product(feedthrough, now, rows, count)
        for k in range(count):
            for i in range(p):
                out[first + k, i] = rows[i, k]
        for i in range(n_y):
            y[i, 0] = y[i, count]
    for i in range(n_y):
        modes[i] = y[i, 0]
