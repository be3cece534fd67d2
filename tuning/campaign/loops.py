"""How stable a case's loop is over a grid of frequencies: poles and both margins, all rows of a schedule at once."""

import math
from collections.abc import Sequence

import numpy as np

from tuning.campaign.batch import Case
from tuning.loop import RigModel, mode_grid, nearest_and_soonest
from twin.control.chain import SQRT2
from twin.control.schedule import Gains
from twin.plant.compiled import kernel
from twin.plant.config import DampingTable
from twin.plant.linear import Array, ComplexArray

MARGIN_POINTS = 36
"""On either side of each mode, see `tuning.loop.mode_grid`."""

LONGEST_DELAY_S = 8e-3
"""A delay margin beyond this is none, as in `tuning.loop.loop_margins`."""


def loop_models(case: Case, grid_hz: Sequence[float]) -> list[tuple[float, RigModel]]:
    """The loop's model at each frequency; one for all of them where nothing in the plant depends on it."""
    if not grid_hz:
        return []
    if any(isinstance(body.damping_ns_m, DampingTable) for body in case.plant.body):
        return [(f, RigModel(case.plant, case.facts, f)) for f in grid_hz]
    model = RigModel(case.plant, case.facts, grid_hz[0])
    return [(f, model) for f in grid_hz]


def _gains(case: Case, models: Sequence[tuple[float, RigModel]]) -> list[list[float]]:
    """Rows of the schedule at each frequency, as `GainSchedule.at` has them."""
    s, at = case.schedule, [f for f, _ in models]
    columns = (s.alpha_kg, s.beta_ns_m, s.gamma_n_m, s.low_pass_hz, s.high_pass_hz)
    return np.array([np.interp(at, s.frequency_hz, column) for column in columns]).T.tolist()  # type: ignore[no-any-return]


def slowest_pole(case: Case, models: Sequence[tuple[float, RigModel]]) -> tuple[float, float | None]:
    """Largest real part of the closed loop's poles over the grid [1/s], and where [Hz].

    Without a frequency at which the schedule acts there is no loop; a plant by itself is stable.
    """
    if not models:
        return -math.inf, None
    loops = np.stack(
        [
            model.closed_loop_matrix(Gains(*row))
            for (_, model), row in zip(models, _gains(case, models), strict=True)
        ]
    )
    largest = np.abs(np.linalg.eigvals(loops)).max(axis=1)
    k = int(np.argmax(largest))
    return float(np.log(largest[k]) * case.facts.sample_rate_hz), models[k][0]


def least_margins(case: Case, models: Sequence[tuple[float, RigModel]]) -> tuple[float, float | None]:
    """Least modulus and delay margin [s] over the grid, as `tuning.loop.margins` of each frequency.

    Returns
    -------
    tuple of float
        The delay is None where none below `LONGEST_DELAY_S` destabilises.
    """
    if not models:
        return 1.0, None
    modulus, delay = math.inf, math.inf
    facts = case.facts
    table = np.array(_gains(case, models))
    first = 0
    while first < len(models):
        model, last = models[first][1], first + 1
        while last < len(models) and models[last][1] is model:
            last += 1
        grid = mode_grid(model, MARGIN_POINTS)
        gain = -model.acceleration(grid) / model.coil.force_constant_n_a
        found = _margins(gain, grid, table[first:last], facts.sample_rate_hz, facts.delay_samples)
        modulus, delay = min(modulus, found[0]), min(delay, found[1])
        first = last
    return modulus, delay if delay < LONGEST_DELAY_S else None


@kernel
def _margins(
    gain: ComplexArray, frequency_hz: Array, table: Array, sample_rate_hz: float, delay_samples: int
) -> tuple[float, float]:
    """Least modulus and delay margin over rows of gains and cutoffs.

    Parameters
    ----------
    gain
        (n,) measured relative acceleration over command, in newtons and the sign of negative feedback.
    frequency_hz
        (n,) ascending.
    table
        (rows, 5) alpha, beta, gamma, low-pass, high-pass.
    """
    dt = 1.0 / sample_rate_hz
    n, nearest, soonest = len(frequency_hz), np.inf, np.inf
    # The chain in trapezoidal form (`twin.control.chain.chain_response`): s dt / 2 is j tan(pi f dt).
    t = np.tan(np.pi * frequency_hz * dt)
    turned = gain * np.exp(-2j * np.pi * dt * delay_samples * frequency_hz)
    L = np.empty(n, dtype=np.complex128)
    for k in range(len(table)):
        g_low, g_high = np.tan(np.pi * table[k, 3] * dt), np.tan(np.pi * table[k, 4] * dt)
        for j in range(n):
            square = -t[j] * t[j]
            low = g_low * g_low / complex(square + g_low * g_low, SQRT2 * g_low * t[j])
            integrate = (
                0.5 * dt * complex(0.0, t[j]) / complex(square + g_high * g_high, SQRT2 * g_high * t[j])
            )
            law = table[k, 0] + integrate * (table[k, 1] + integrate * table[k, 2])
            L[j] = turned[j] * low * law
        near, soon = nearest_and_soonest(L, frequency_hz)
        nearest, soonest = min(nearest, near), min(soonest, soon)
    return nearest, soonest
