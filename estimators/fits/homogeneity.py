"""Whether single estimates of the same mode agree within what they state: Cochran's test of homogeneity."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from estimators.fits.types import Mode

_FIGURES = (("frequency_hz", "frequency_std_hz"), ("damping_ratio", "damping_std"))


def disagree(modes: Sequence[Mode], probability: float) -> bool:
    """Whether frequencies or dampings scatter more than their standard deviations allow.

    Parameters
    ----------
    modes
        Independent estimates.
    probability
        How often estimates that agree may be taken for ones that do not.
    """
    if len(modes) < 2:
        return False
    return any(chi2.sf(_square(modes, name, std), len(modes) - 1) < probability for name, std in _FIGURES)


def with_scatter(mode: Mode, singles: Sequence[Mode]) -> Mode:
    """Widen a common estimate's standard deviations where single ones differ by clearly more than their own errors.

    Parameters
    ----------
    mode
        Estimated from all together.
    singles
        Estimated from each alone.
    """
    if len(singles) < 2:
        return mode
    degrees = len(singles) - 1
    wider = {}
    for name, std in _FIGURES:
        square = _square(singles, name, std)
        if chi2.sf(square, degrees) < 0.01:
            wider[std] = getattr(mode, std) * float(np.sqrt(square / degrees))
    return replace(mode, **wider)


def _square(modes: Sequence[Mode], name: str, std: str) -> float:
    """Weighted sum of squares about the weighted mean, chi-square distributed where all agree."""
    x = np.array([getattr(m, name) for m in modes])
    weight = 1.0 / np.maximum(np.array([getattr(m, std) for m in modes]), 1e-300) ** 2
    return float(np.sum(weight * (x - np.sum(weight * x) / np.sum(weight)) ** 2))
