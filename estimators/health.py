"""Whether model and measurements agree, judged by the observer's own innovations."""

import math
from typing import Literal

Health = Literal["agrees", "drifts", "disagrees", "no data"]

# Mean NIS over a block is 1 for a consistent filter; these bounds leave room for its scatter over a block.
AGREES, DRIFTS = (0.5, 2.0), (0.25, 4.0)


def model_health(nis: float) -> Health:
    """Return a word for how well model and rig agree.

    Parameters
    ----------
    nis
        Mean normalised innovation squared per measurement over a block; NaN if nothing was measured.
    """
    if not math.isfinite(nis):
        return "no data"
    if AGREES[0] <= nis <= AGREES[1]:
        return "agrees"
    return "drifts" if DRIFTS[0] <= nis <= DRIFTS[1] else "disagrees"
