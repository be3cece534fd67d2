"""How large the unknown disturbances are, by maximum likelihood, where the plant file does not say.

An observer is only as good as its idea of what disturbs the plant. A recording from a foreign rig seldom comes
with one: the likelihood of its own innovations tells which of two kinds of force explains it better, white, or
wandering (white rate of change), and how strong.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from estimators.observer import Observer
from twin.plant.blocks import Block
from twin.plant.config import Plant

SEARCH_DECADES = (-5.0, 5.0)


@dataclass(frozen=True, slots=True)
class LikeliestDisturbance:
    """The disturbance that explains a recording best.

    Attributes
    ----------
    plant
        The plant with it filled in on every body.
    kind
        ``white`` [N/sqrt(Hz)] or ``wandering`` [N/s/sqrt(Hz)].
    density
        One-sided density in the unit of its kind.
    """

    plant: Plant
    kind: str
    density: float


def states_disturbances(plant: Plant) -> bool:
    """Whether the plant file says anything about disturbances."""
    return any(b.disturbance_density_n is not None or b.disturbance_drift_n_s is not None for b in plant.body)


def likeliest_disturbance(plant: Plant, blocks: Sequence[Block]) -> LikeliestDisturbance:
    """Fit one disturbance density to the innovations of some blocks.

    Parameters
    ----------
    blocks
        Consecutive blocks, at least one, all of one rate and with the same channels.
    """
    channels = tuple(c.name for c in blocks[0].channels)
    rate = blocks[0].sample_rate_hz
    sensor = next(s for s in plant.sensor if s.name in channels)
    # A force that moves the primary body by the sensor's noise: where "small" begins.
    small = plant.primary.stiffness_n_m * math.sqrt(sensor.noise_variance(rate))

    def cost(kind: str, decade: float) -> float:
        candidate = _with(plant, kind, small * 10.0**decade)
        try:
            observer = Observer(candidate, channels, rate)
        except (ValueError, np.linalg.LinAlgError):
            return math.inf  # the sensors cannot see such a force at all
        total = 0.0
        for block in blocks:
            estimate = observer.advance(block)
            used = [channels.index(s) for s in observer.sensors]
            count = block.valid[:, used].sum(axis=0)
            seen = count > 0
            spread = np.log(estimate.innovation_std[seen] ** 2)
            total += float(np.sum(count[seen] * spread)) + estimate.nis * float(count.sum())
        return total if math.isfinite(total) else math.inf

    best: tuple[float, str, float] = (math.inf, "white", 0.0)
    for kind in ("white", "wandering"):
        grid = np.arange(SEARCH_DECADES[0], SEARCH_DECADES[1] + 0.5)
        costs = [cost(kind, d) for d in grid]
        k = int(np.argmin(costs))
        if not math.isfinite(costs[k]):
            continue
        low, high = grid[max(k - 1, 0)], grid[min(k + 1, len(grid) - 1)]
        found = minimize_scalar(
            lambda d, kind=kind: cost(kind, d), bounds=(low, high), method="bounded", options={"xatol": 0.02}
        )
        if found.fun < best[0]:
            best = (float(found.fun), kind, float(found.x))
    _, kind, decade = best
    density = small * 10.0**decade
    return LikeliestDisturbance(_with(plant, kind, density), kind, density)


def _with(plant: Plant, kind: str, density: float) -> Plant:
    update = (
        {"disturbance_density_n": density}
        if kind == "white"
        else {"disturbance_density_n": 0.0, "disturbance_drift_n_s": density}
    )
    return plant.model_copy(update={"body": tuple(b.model_copy(update=update) for b in plant.body)})
