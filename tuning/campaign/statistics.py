"""What a campaign says as a whole: yield against budget, worst cases, and what the result depends on."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import rankdata

from tuning.types import BudgetKind
from twin.plant.linear import Array

POWER_OF = {"joule_mean": "joule_mean_w", "joule_peak": "joule_peak_w", "electrical": "electrical_mean_w"}
RESULTS = (
    "attenuation_mean",
    "attenuation_worst",
    "displacement_m",
    "joule_mean_w",
    "growth_1_s",
    "modulus_margin",
)
DRAWN = "drawn "
STEPS = 60
FEWEST = 8
"""Cases per parameter below which a regression says nothing."""

Row = Mapping[str, Any]


def yields(rows: Sequence[Row], kind: BudgetKind, budgeted: bool) -> list[dict[str, Any]]:
    """Share of cases that keep everything, against the budget, plant by plant.

    Parameters
    ----------
    budgeted
        Whether the cases have budgets of their own. If not, a case keeps every budget above the power that it took.

    Returns
    -------
    list of dict
        ``plant``, ``excitation``, ``budget_w``, ``cases``, ``share``, and ``low``, ``high``: Wilson's 95 % interval.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["plant"], row["excitation"]), []).append(row)
    out = []
    for (plant, excitation), some in groups.items():
        if budgeted:
            points = [
                (b, [bool(r["meets"]) for r in some if r["budget_w"] == b])
                for b in sorted({r["budget_w"] for r in some})
            ]
        else:
            power = np.array([r[POWER_OF[kind]] for r in some])
            meets = np.array([bool(r["meets"]) for r in some])
            grid = np.linspace(0.0, 1.05 * float(power.max()), STEPS) if len(power) else np.zeros(0)
            points = [(float(b), list(meets & (power <= b))) for b in grid]
        for budget, met in points:
            low, high = wilson(sum(met), len(met))
            out.append(
                {
                    "plant": plant, "excitation": excitation, "budget_w": budget, "cases": len(met),
                    "share": sum(met) / len(met), "low": low, "high": high,
                }
            )  # fmt: skip
    return out


def wilson(met: int, n: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Interval for a share of n (Wilson 1927)."""
    share, square = met / n, z * z / n
    middle = (share + 0.5 * square) / (1.0 + square)
    half = z * math.sqrt(share * (1.0 - share) / n + square / (4.0 * n)) / (1.0 + square)
    return max(0.0, middle - half), min(1.0, middle + half)


def worst_first(rows: Sequence[Row]) -> list[Row]:
    """Cases in order: unstable ones by their growth, then those that broke a limit, then by the worst attenuation."""

    def badness(row: Row) -> tuple[bool, bool, float]:
        growth, least = row["growth_1_s"], row["attenuation_worst"]
        size = -growth if not row["stable"] and growth is not None else (1.0 if least is None else least)
        return row["stable"], row["meets"], size

    return sorted(rows, key=badness)


def sensitivities(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """How much each result depends on each drawn parameter: rank correlation and standardised rank regression.

    Returns
    -------
    dict
        By result and parameter: ``rank_correlation`` (Spearman), ``regression`` (coefficient of the standardised ranks
        with all other parameters in the regression); under ``""`` the share of variance that the regression explains.
        Results and parameters that do not vary, or too few cases, are left out.
    """
    names = [key for key in (rows[0] if rows else {}) if key.startswith(DRAWN)]
    out: dict[str, dict[str, dict[str, float]]] = {}
    for result in RESULTS:
        some = [r for r in rows if r[result] is not None]
        varied = [name for name in names if len({r[name] for r in some}) > 1]
        if len(some) < FEWEST * max(1, len(varied)) or not varied or len({r[result] for r in some}) < 2:
            continue
        X = np.column_stack([_standardised([r[name] for r in some]) for name in varied])
        y = _standardised([r[result] for r in some])
        factors = np.linalg.lstsq(X, y, rcond=None)[0]
        left = float(np.mean((y - X @ factors) ** 2))
        out[result] = {
            name.removeprefix(DRAWN): {
                "rank_correlation": float(np.mean(X[:, k] * y)),
                "regression": float(factors[k]),
            }
            for k, name in enumerate(varied)
        }
        out[result][""] = {"explained": 1.0 - left}
    return out


def _standardised(values: Sequence[float]) -> Array:
    ranks = rankdata(values)
    return np.asarray((ranks - ranks.mean()) / ranks.std())
