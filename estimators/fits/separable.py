"""Least squares in which most parameters enter linearly: variable projection.

Every fit of this package explains its data by ``basis(theta) @ coefficients``: few nonlinear parameters theta
(frequencies, damping ratios, delays), and coefficients (amplitudes, offsets, residues) that follow from theta by
linear least squares. The coefficients are projected out (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973), with
Kaufman's Jacobian (BIT 15, 1975); its normal matrix is the Fisher information of theta with the coefficients
unknown, so its inverse is the Cramer-Rao bound.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from twin.plant.linear import Array

Bases = Callable[[Array], list[Array]]
Slopes = Callable[[Array, list[Array]], list[Array]]
SMALL = 1e-3
"""Share of a parameter's step over which derivatives are taken."""


@dataclass(frozen=True, slots=True)
class SeparableFit:
    """Result of `fit_separable`.

    Attributes
    ----------
    theta
        (n_theta,) nonlinear parameters.
    coefficients
        Per data set (n_basis,) linear parameters.
    residuals
        Per data set (n_samples,) data minus model.
    jacobians
        Per data set (n_samples, n_theta) derivative of the model by theta, coefficients projected out.
    bases
        Per data set (n_samples, n_basis) matrix at theta, weighted like the data.
    """

    theta: Array
    coefficients: tuple[Array, ...]
    residuals: tuple[Array, ...]
    jacobians: tuple[Array, ...]
    bases: tuple[Array, ...]

    @property
    def cost(self) -> float:
        """Sum of squared residuals."""
        return float(sum(r @ r for r in self.residuals))

    @property
    def freedom(self) -> int:
        """Samples less parameters, at least one."""
        spent = len(self.theta) + sum(len(c) for c in self.coefficients)
        return max(1, sum(len(r) for r in self.residuals) - spent)

    def covariance(self, variance: float | None = None) -> Array:
        """(n_theta, n_theta) for white noise; its variance from the residuals unless given."""
        information = sum(j.T @ j for j in self.jacobians)
        return (self.cost / self.freedom if variance is None else variance) * invert(np.asarray(information))


def fit_separable(
    bases: Bases,
    data: Sequence[Array],
    start: ArrayLike,
    lower: ArrayLike,
    upper: ArrayLike,
    steps: ArrayLike,
    slopes: Slopes | None = None,
) -> SeparableFit:
    """Fit data sets that share their nonlinear parameters and have coefficients of their own.

    Parameters
    ----------
    bases
        From theta to one (n_samples, n_basis) matrix per data set, weighted like the data.
    data
        One (n_samples,) vector per data set.
    start, lower, upper
        (n_theta,) first guess and bounds.
    steps
        (n_theta,) size of a small change of each parameter: for derivatives and scaling.
    slopes
        From theta and the coefficients to the model's (n_samples, n_theta) derivatives per data set; by differences
        of ``bases`` unless given.

    Returns
    -------
    SeparableFit
        At the minimum nearest to the first guess.
    """
    problem = _Problem(bases, data, np.asarray(steps, dtype=np.float64), slopes)
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    first = np.clip(
        np.asarray(start, dtype=np.float64), low + 1e-9 * (high - low), high - 1e-9 * (high - low)
    )
    found = least_squares(
        problem.residual,
        first,
        jac=problem.descent,
        bounds=(low, high),
        x_scale=problem.steps,
        ftol=1e-10,
        xtol=1e-12,
        gtol=None,
        max_nfev=60,
    )
    theta = np.asarray(found.x, dtype=np.float64)
    here = problem.at(theta)
    return SeparableFit(
        theta=theta,
        coefficients=tuple(here.coefficients),
        residuals=tuple(here.residuals),
        jacobians=tuple(problem.jacobians(theta)),
        bases=tuple(here.bases),
    )


def invert(information: Array) -> Array:
    """Inverse of a symmetric non-negative matrix, scaled first; the pseudo-inverse where it is singular."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(np.float64).tiny))
    return np.asarray(
        np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
    )


def _project(matrix: Array, y: Array) -> tuple[Array, Array]:
    """Orthonormal basis of the columns, and the coefficients of y in them."""
    size = np.maximum(np.linalg.norm(matrix, axis=0), np.finfo(np.float64).tiny)
    scaled = matrix / size
    gram = scaled.T @ scaled
    if np.linalg.eigvalsh(gram)[0] > 1e-9:
        # Well conditioned: two rounds of Cholesky are as good as a QR and several times faster.
        first = np.linalg.inv(np.linalg.cholesky(gram)).T
        span = scaled @ first
        second = np.linalg.inv(np.linalg.cholesky(span.T @ span)).T
        span = span @ second
        return span, first @ (second @ (span.T @ y)) / size
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    rank = int(np.sum(s > 1e-11 * s[0]))
    return u[:, :rank], vt[:rank].T @ (u[:, :rank].T @ y / s[:rank]) / size


@dataclass(slots=True)
class _Point:
    """Everything known at one theta."""

    theta: Array
    bases: list[Array]
    spans: list[Array]
    coefficients: list[Array]
    residuals: list[Array]


class _Problem:
    """Residuals and derivatives; what was worked out at the last theta is kept."""

    def __init__(self, bases: Bases, data: Sequence[Array], steps: Array, slopes: Slopes | None) -> None:
        self._bases, self._data, self.steps, self._slopes = bases, data, steps, slopes
        self._last: _Point | None = None

    def at(self, theta: Array) -> _Point:
        """Projection of the data at theta."""
        if self._last is not None and np.array_equal(self._last.theta, theta):
            return self._last
        matrices = self._bases(theta)
        point = _Point(theta.copy(), matrices, [], [], [])
        for matrix, y in zip(matrices, self._data, strict=True):
            span, coefficients = _project(matrix, y)
            point.spans.append(span)
            point.coefficients.append(coefficients)
            point.residuals.append(y - span @ (span.T @ y))
        self._last = point
        return point

    def residual(self, theta: Array) -> Array:
        """All residuals in a row."""
        return np.concatenate(self.at(theta).residuals)

    def descent(self, theta: Array) -> Array:
        """Derivatives of `residual`."""
        return -np.concatenate(self.jacobians(theta))

    def jacobians(self, theta: Array) -> list[Array]:
        """Derivatives of the model by theta, less what the coefficients can take up."""
        here = self.at(theta)
        changes = (self._slopes or self._by_differences)(theta, here.coefficients)
        return [d - u @ (u.T @ d) for d, u in zip(changes, here.spans, strict=True)]

    def _by_differences(self, theta: Array, coefficients: list[Array]) -> list[Array]:
        out = [np.empty((len(y), len(theta))) for y in self._data]
        for p in range(len(theta)):
            shift = np.zeros(len(theta))
            shift[p] = SMALL * self.steps[p]
            sides = zip(self._bases(theta + shift), self._bases(theta - shift), strict=True)
            for k, (plus, minus) in enumerate(sides):
                out[k][:, p] = (plus - minus) @ coefficients[k] / (2.0 * shift[p])
        return out
