"""Where a search for gains starts: on the line of gains that answer the limit's wish exactly.

At one frequency two gains make any reference, the third is free: for each alpha there is one beta and one gamma. Some
of these keep the margin and some do not, and a search that begins beside the wrong ones may end in a bay.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tuning.search import Condition
from twin.plant.compiled import kernel
from twin.plant.linear import Array, ComplexArray

ALPHAS = np.linspace(-0.6, 1.8, 33)
SHARES = (1.0, 0.8, 0.5)


def starts(
    condition: Condition,
    wish_a: complex,
    curves: Sequence[ComplexArray],
    margin: float,
    scale: Array,
    bounds: Array,
) -> list[Array]:
    """Gains to start from, the most promising first.

    Parameters
    ----------
    condition
        The operating point's own: law and acceleration.
    wish_a
        Reference at the limit [A].
    curves
        (n, 3) each: loop gain per unit of each gain over rising frequency, as it is and with every further delay that
        must be tolerated. None of them may go around -1.
    margin
        Wanted |1 + L|.
    scale, bounds
        (3,) and (3, 2) of the gains, in SI units.

    Returns
    -------
    list of ndarray
        (3,) each; ends with no gains at all, with which every loop is as stable as its plant.
    """
    per_ampere, alone = condition.acceleration
    law, limits = condition.law * scale, bounds / scale[:, None]
    matrix = np.array([law[1:].real, law[1:].imag])
    found: list[tuple[float, Array]] = []
    for share in SHARES:
        wish = share * wish_a
        answer = wish / (per_ampere * wish + alone)
        rest = answer - law[0] * ALPHAS
        candidates = np.column_stack([ALPHAS, np.linalg.solve(matrix, np.stack([rest.real, rest.imag])).T])
        around, nearest = np.zeros(len(candidates), dtype=np.bool_), np.empty(len(candidates))
        for terms in reversed(curves):  # the loop as it is comes last and gives the margin
            go_around(np.ascontiguousarray(terms * scale), candidates, around, nearest)
        lacking = np.maximum(0.0, margin - nearest) / max(margin, 1e-6)
        outside = np.maximum(limits[:, 0] - candidates, candidates - limits[:, 1]).max(axis=1)
        cost = (1.0 - share) + 2.0 * lacking + 10.0 * np.maximum(0.0, outside) + np.where(around, 10.0, 0.0)
        best = int(np.argmin(cost + 1e-3 * np.abs(ALPHAS)))
        found.append((float(cost[best]), candidates[best]))
    found.sort(key=lambda pair: pair[0])
    return [*(np.clip(y, limits[:, 0], limits[:, 1]) * scale for cost, y in found if cost < 5.0), np.zeros(3)]


@kernel
def go_around(terms: ComplexArray, candidates: Array, around: NDArray[np.bool_], nearest: Array) -> None:
    """Which loops go around -1, and how near they come to it.

    Parameters
    ----------
    terms
        (n, 3) loop gain per unit of each gain over rising frequency.
    candidates
        (c, 3) gains.
    around
        (c,) set True where 1 + L turns by more than half around zero.
    nearest
        (c,) receives the least |1 + L|.
    """
    for c in range(len(candidates)):
        turns, least, first, before = 0.0, np.inf, 0.0 + 0.0j, 0.0 + 0.0j
        for k in range(len(terms)):
            q = 1.0 + 0.0j
            for v in range(3):
                q += terms[k, v] * candidates[c, v]
            least = min(least, q.real * q.real + q.imag * q.imag)
            if k == 0:
                first = q
            elif (before.imag < 0.0) != (q.imag < 0.0):
                # The branch cut of the angle is the negative real axis: where a chord crosses it counts.
                share = before.imag / (before.imag - q.imag)
                if before.real + share * (q.real - before.real) < 0.0:
                    turns += 1.0 if q.imag < 0.0 else -1.0
            before = q
        turns += (np.arctan2(before.imag, before.real) - np.arctan2(first.imag, first.real)) / (2.0 * np.pi)
        around[c] = around[c] or abs(turns) > 0.5
        nearest[c] = np.sqrt(least)
