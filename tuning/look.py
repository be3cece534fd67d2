"""What the gain search sees at one point, compiled: distances from -1, the valleys between them, motion and limits.

A grid has thousands of rows and the search looks at all of them in every iteration, so these are loops over scalars.
"""

import numpy as np
from numpy.typing import NDArray

from twin.plant.compiled import kernel
from twin.plant.linear import Array, ComplexArray

GRID, VALLEY, LIMIT, DECAY, RANGE = range(5)

POCKET = 0.02
"""Share of the margin by which points of the grid may miss it; what lies between them is looked at by itself."""

NEAR, SAME_VALLEY = 0.5, 3
REFINEMENTS = 3
SMALLEST = 1e-12


@kernel
def look_at_grid(
    terms: ComplexArray, margin: Array, y: Array, distance: Array, values: Array, slopes: Array
) -> None:
    """Distances of the loop gain from -1 on the grid.

    Parameters
    ----------
    terms, margin, y
        (n, 3) loop gain per gain, (n,) what |1 + L| must be, (3,) gains.
    distance
        (n,) receives |1 + L|.
    values, slopes
        (n or more,), (n or more, 3) receive what the margin lacks, with a pocket's play, and its slopes.
    """
    for i in range(len(margin)):
        q = 1.0 + terms[i, 0] * y[0] + terms[i, 1] * y[1] + terms[i, 2] * y[2]
        size = np.sqrt(q.real * q.real + q.imag * q.imag)
        distance[i] = size
        values[i] = margin[i] * (1.0 - POCKET) - size
        per = 1.0 / max(size, SMALLEST)
        for v in range(3):
            slopes[i, v] = -(q.real * terms[i, v].real + q.imag * terms[i, v].imag) * per


@kernel
def look_into_valleys(
    terms: ComplexArray, margin: Array, inner: NDArray[np.bool_], y: Array, distance: Array,
    weighed: NDArray[np.int64], weights: Array, values: Array, slopes: Array, places: NDArray[np.int64],
    hessian: Array,
) -> int:  # fmt: skip
    """Where |1 + L| is least between the points of the grid, on a parabola through three of them.

    Parameters
    ----------
    terms, margin, inner, y, distance
        As `look_at_grid`; ``inner`` is True where a row has neighbours on its own curve.
    weighed, weights
        (m,) rows and multipliers of the valleys whose curvature belongs into the hessian.
    values, slopes, places
        Receive what the margin lacks at the bottoms, its slopes, and the rows they are at.
    hessian
        (3, 3), changed in place.

    Returns
    -------
    int
        Number of valleys.
    """
    found = 0
    tilt, curve = np.zeros(3, np.complex128), np.zeros(3, np.complex128)
    here, moving = np.zeros(3, np.complex128), np.zeros(3, np.complex128)
    shift, toward = np.zeros(3), np.zeros(3)
    nearest = np.full(len(weighed), -1, np.int64)  # each weight goes to one valley, the nearest
    for i in range(len(margin)):
        if not _is_bottom(i, inner, distance, margin):
            continue
        for j in range(len(weighed)):
            if nearest[j] < 0 or abs(i - weighed[j]) < abs(nearest[j] - weighed[j]):
                nearest[j] = i
    for i in range(len(margin)):
        if not _is_bottom(i, inner, distance, margin):
            continue
        start, along, bend = 1.0 + 0.0j, 0.0j, 0.0j
        for v in range(3):
            tilt[v] = 0.5 * (terms[i + 1, v] - terms[i - 1, v])
            curve[v] = 0.5 * (terms[i + 1, v] + terms[i - 1, v]) - terms[i, v]
            start += terms[i, v] * y[v]
            along += tilt[v] * y[v]
            bend += curve[v] * y[v]
        t = 0.0
        for _ in range(REFINEMENTS):
            q, turn = start + t * (along + t * bend), along + 2.0 * t * bend
            slope = q.real * turn.real + q.imag * turn.imag
            steep = turn.real**2 + turn.imag**2 + 2.0 * (q.real * bend.real + q.imag * bend.imag)
            if steep > 0.0:
                t = min(max(t - slope / steep, -1.0), 1.0)
        q, turn = start + t * (along + t * bend), along + 2.0 * t * bend
        size = max(np.sqrt(q.real * q.real + q.imag * q.imag), SMALLEST)
        steep = (turn.real**2 + turn.imag**2 + 2.0 * (q.real * bend.real + q.imag * bend.imag)) / size
        for v in range(3):
            here[v] = terms[i, v] + t * (tilt[v] + t * curve[v])
            moving[v] = tilt[v] + 2.0 * t * curve[v]
            toward[v] = (q.real * here[v].real + q.imag * here[v].imag) / size
            slopes[found, v] = -toward[v]
            shift[v] = (
                turn.real * here[v].real + turn.imag * here[v].imag
                + q.real * moving[v].real + q.imag * moving[v].imag
            ) / size  # fmt: skip
        values[found] = margin[i] - size
        places[found] = i
        found += 1
        for j in range(len(weighed)):
            if nearest[j] != i or abs(i - weighed[j]) > SAME_VALLEY:
                continue
            for a in range(3):
                for b in range(3):
                    across = here[a].real * here[b].real + here[a].imag * here[b].imag
                    hessian[a, b] -= weights[j] / size * (across - toward[a] * toward[b])
                    if abs(t) < 1.0 and steep > 0.0:
                        # The valley's bottom moves along with the gains.
                        hessian[a, b] += weights[j] / steep * shift[a] * shift[b]
    return found


@kernel
def _is_bottom(i: int, inner: NDArray[np.bool_], distance: Array, margin: Array) -> bool:
    return bool(
        inner[i]
        and distance[i] < margin[i] + NEAR
        and distance[i] <= distance[i - 1]
        and distance[i] < distance[i + 1]
    )


@kernel
def look_at_motion(
    y: Array, law: ComplexArray, acceleration: ComplexArray, target: ComplexArray, weight: Array, ridge: float,
    gradient: Array, hessian: Array, reference: ComplexArray, first: ComplexArray, second: ComplexArray,
) -> float:  # fmt: skip
    """Weighted square of the targets, with exact slope and curvature.

    Parameters
    ----------
    y
        (3,) gains.
    law, acceleration, target, weight
        (c, 3), (c, 2), (c, 2), (c,) of every condition.
    ridge
        Weight of the gains' own size.
    gradient, hessian
        (3,), (3, 3) receive the objective's.
    reference, first, second
        (c,) receive the reference and its slope and curvature over the law's response.

    Returns
    -------
    float
        The objective.
    """
    objective = 0.0
    for a in range(3):
        objective += ridge * y[a] * y[a]
        gradient[a] = 2.0 * ridge * y[a]
        for b in range(3):
            hessian[a, b] = 2.0 * ridge if a == b else 0.0
    for c in range(len(weight)):
        response = law[c, 0] * y[0] + law[c, 1] * y[1] + law[c, 2] * y[2]
        per_ampere, alone = acceleration[c, 0], acceleration[c, 1]
        rest = 1.0 - response * per_ampere
        reference[c] = response * alone / rest
        first[c] = alone / (rest * rest)
        second[c] = 2.0 * per_ampere * alone / (rest * rest * rest)
        if weight[c] == 0.0:
            continue
        motion = target[c, 0] * reference[c] + target[c, 1]
        along = target[c, 0] * first[c]
        bend = motion.conjugate() * target[c, 0] * second[c]
        objective += weight[c] * (motion.real * motion.real + motion.imag * motion.imag)
        for a in range(3):
            move = along * law[c, a]
            gradient[a] += 2.0 * weight[c] * (motion.conjugate() * move).real
            for b in range(3):
                curved = (move.conjugate() * along * law[c, b]).real + (bend * law[c, a] * law[c, b]).real
                hessian[a, b] += 2.0 * weight[c] * curved
    return objective


@kernel
def look_at_limits(
    law: ComplexArray, of: NDArray[np.int64], slope: ComplexArray, offset: ComplexArray, reference: ComplexArray,
    first: ComplexArray, second: ComplexArray, weighed: NDArray[np.int64], weights: Array, values: Array,
    slopes: Array, hessian: Array,
) -> None:  # fmt: skip
    """Limits ``|slope r + offset| <= 1`` and, of those weighed, the curvature.

    Parameters
    ----------
    law, reference, first, second
        As `look_at_motion`.
    of, slope, offset
        (l,) condition of each limit, and the bounded quantity over the reference.
    weighed, weights
        (m,) which limits' curvature belongs into the hessian, and how much.
    values, slopes
        (l or more,), (l or more, 3) receive by how much they are broken.
    hessian
        (3, 3), changed in place.
    """
    for k in range(len(of)):
        c = of[k]
        quantity = slope[k] * reference[c] + offset[k]
        size = max(np.sqrt(quantity.real * quantity.real + quantity.imag * quantity.imag), SMALLEST)
        per = slope[k] * first[c]
        values[k] = size - 1.0
        for v in range(3):
            slopes[k, v] = (quantity.conjugate() * per * law[c, v]).real / size
        for j in range(len(weighed)):
            if weighed[j] != k:
                continue
            bend = quantity.conjugate() * slope[k] * second[c]
            for a in range(3):
                for b in range(3):
                    across = ((per * law[c, a]).conjugate() * per * law[c, b]).real - slopes[k, a] * slopes[
                        k, b
                    ]
                    hessian[a, b] += weights[j] / size * (across + (bend * law[c, a] * law[c, b]).real)
