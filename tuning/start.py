"""Where a search for gains starts: on the line of gains that answer the limit's wish exactly.

At one frequency two gains make any reference, the third is free: for each alpha there is one beta and one gamma. Some
of these keep the margin and some do not, and a search that begins beside the wrong ones may end in a bay.
"""

from collections.abc import Sequence

import numpy as np

from tuning.search import Condition
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
        around = np.zeros(len(candidates), dtype=np.bool_)
        for terms in reversed(curves):  # the loop as it is comes last and gives the margin
            one_plus = 1.0 + candidates @ (terms * scale).T
            turns = np.angle(one_plus[:, 1:] / one_plus[:, :-1]).sum(axis=1) / (2.0 * np.pi)
            around |= np.abs(turns) > 0.5
        lacking = np.maximum(0.0, margin - np.abs(one_plus).min(axis=1)) / max(margin, 1e-6)
        outside = np.maximum(limits[:, 0] - candidates, candidates - limits[:, 1]).max(axis=1)
        cost = (1.0 - share) + 2.0 * lacking + 10.0 * np.maximum(0.0, outside) + np.where(around, 10.0, 0.0)
        best = int(np.argmin(cost + 1e-3 * np.abs(ALPHAS)))
        found.append((float(cost[best]), candidates[best]))
    found.sort(key=lambda pair: pair[0])
    return [*(np.clip(y, limits[:, 0], limits[:, 1]) * scale for cost, y in found if cost < 5.0), np.zeros(3)]
