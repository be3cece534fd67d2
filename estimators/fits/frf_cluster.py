"""Modes that lie close together, fitted to the stretch of the responses around them."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimators.fits.modal_model import REMAINDERS, Window, modal_basis, mode_columns
from estimators.fits.response_noise import noise_variance
from estimators.fits.separable import SMALL, SeparableFit, fit_separable
from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
REACH_LINES, REACH_WIDTHS, WIDE_LINES = 16.0, 12.0, 60.0
"""How far the stretch goes beyond a mode: lines of the spectrum at least, half-widths of its peak at least, and more
lines where they are less than 15 % of its frequency."""
LAGS = 10
ROUNDS = 4


@dataclass(frozen=True, slots=True)
class Cluster:
    """Modes fitted together.

    Attributes
    ----------
    rows
        The stretch of the spectrum that was fitted.
    found
        Natural frequencies [Hz] and damping ratios, mode by mode, as theta.
    variance
        (n_rows, n_responses) noise variance of the complex responses.
    """

    rows: slice
    found: SeparableFit
    variance: Array

    @property
    def pairs(self) -> Array:
        """(n_modes, 2) natural frequency [Hz] and damping ratio."""
        return self.found.theta.reshape(-1, 2)

    @property
    def residues(self) -> ComplexArray:
        """(n_responses, n_modes) residues."""
        return np.array([_residues(c) for c in self.found.coefficients])

    @property
    def misfit(self) -> float:
        """Squared residual per degree of freedom, in variances."""
        return self.found.cost / self.found.freedom

    @property
    def std(self) -> Array:
        """(n_modes, 2) standard deviations of `pairs`."""
        white = np.diag(self.found.covariance(max(1.0, self.misfit)))
        seen = _serial_covariance(self.found)
        return np.sqrt(white if seen is None else np.maximum(white, np.diag(seen))).reshape(-1, 2)

    def model(self, frequency_hz: Array, window: Window) -> ComplexArray:
        """(n_rows, n_responses) fitted responses."""
        basis = modal_basis(frequency_hz[self.rows], self.found.theta, window)
        return np.column_stack([_complex(basis @ c) for c in self.found.coefficients])


def neighbourhoods(frequency_hz: Array, candidates: Array) -> list[tuple[slice, Array]]:
    """Stretches of the spectrum around candidates; overlapping ones are joined.

    Parameters
    ----------
    frequency_hz
        (n,) ascending.
    candidates
        (n_candidates, 2) natural frequency [Hz] and damping ratio, by frequency.
    """
    spacing = float(np.median(np.diff(frequency_hz)))
    out: list[tuple[float, float, list[Array]]] = []
    for pair in candidates:
        wide = min(WIDE_LINES * spacing, 0.15 * pair[0])
        reach = max(REACH_LINES * spacing, REACH_WIDTHS * pair[0] * abs(pair[1]), wide)
        low, high = pair[0] - reach, pair[0] + reach
        # Half a reach apart they are fitted one by one: what one leaves in the other's stretch is smooth.
        if out and pair[0] - 0.5 * reach < out[-1][2][-1][0] + 0.5 * (out[-1][1] - out[-1][2][-1][0]):
            before = out.pop()
            out.append((min(low, before[0]), max(high, before[1]), [*before[2], pair]))
        else:
            out.append((low, high, [pair]))
    spans = []
    for low, high, pairs in out:
        first, last = np.searchsorted(frequency_hz, [low, high])
        first, last = max(0, min(first, len(frequency_hz) - 12)), max(12, last)
        spans.append((slice(int(first), int(last)), np.array(pairs)))
    return spans


def fit_cluster(
    frequency_hz: Array, response: ComplexArray, rows: slice, candidates: Array, window: Window
) -> Cluster | None:
    """Fit candidates to their stretch and drop, one by one, those that are no modes; None if none is left.

    Parameters
    ----------
    frequency_hz, response
        (n,) and (n, n_responses), the whole spectrum.
    candidates
        (n_candidates, 2) natural frequency [Hz] and damping ratio.
    """
    f, h = frequency_hz[rows], response[rows]
    pairs = candidates
    while len(pairs):
        found, variance = _refine(f, h, pairs.ravel(), window)
        poor = _poorest(f, h, found, window)
        if poor is None:
            return Cluster(rows, found, variance)
        pairs = np.delete(found.theta.reshape(-1, 2), poor, axis=0)
    return None


def fit_once(f: Array, h: ComplexArray, theta: Array, variance: Array, window: Window) -> SeparableFit:
    """Weighted least squares of the modal model with known noise variances."""
    # Real and imaginary part each carry half of a complex value's variance.
    weights = [np.sqrt(2.0 / np.concatenate([v, v])) for v in variance.T]
    data = [np.concatenate([c.real, c.imag]) * w for c, w in zip(h.T, weights, strict=True)]

    def bases(now: Array) -> list[Array]:
        basis = modal_basis(f, now, window)
        return [basis * w[:, None] for w in weights]

    def slopes(now: Array, coefficients: list[Array]) -> list[Array]:
        own = np.array([_residues(c) for c in coefficients])
        out = [np.empty((len(w), len(now))) for w in weights]
        for p in range(len(now)):
            shift = np.zeros(len(now))
            shift[p] = SMALL * steps[p]
            mode = slice(2 * (p // 2), 2 * (p // 2) + 2)
            above, below = (now + shift)[mode], (now - shift)[mode]
            ahead = mode_columns(s, float(above[0]), float(above[1]), window)
            behind = mode_columns(s, float(below[0]), float(below[1]), window)
            for k, w in enumerate(weights):
                one, j = own[k, p // 2].real, own[k, p // 2].imag
                change = (one * (ahead[0] - behind[0]) + j * (ahead[1] - behind[1])) / (2.0 * shift[p])
                out[k][:, p] = np.concatenate([change.real, change.imag]) * w
        return out

    s: ComplexArray = np.asarray(1j * TAU * f, dtype=np.complex128)
    pairs = theta.reshape(-1, 2)
    spacing = float(np.median(np.diff(f)))
    width = np.maximum(pairs[:, 0] * np.abs(pairs[:, 1]), 0.05 * spacing)
    reach = np.maximum(3.0 * width, 2.0 * spacing)
    low = np.column_stack([np.maximum(pairs[:, 0] - reach, 1e-6), np.full(len(pairs), -0.01)])
    high = np.column_stack([pairs[:, 0] + reach, np.full(len(pairs), 0.95)])
    steps = np.column_stack([width, width / pairs[:, 0]]).ravel()
    return fit_separable(bases, data, theta, low.ravel(), high.ravel(), steps, slopes)


def _refine(f: Array, h: ComplexArray, theta: Array, window: Window) -> tuple[SeparableFit, Array]:
    """Fit, with the noise learned from the residuals round by round."""
    level = np.abs(h)
    # The first round trusts every value to the same share of itself, far below the peaks to a floor.
    variance = (0.05 * level) ** 2 + (0.02 * np.sqrt(np.mean(level**2, axis=0))) ** 2
    found = fit_once(f, h, theta, variance, window)
    for _ in range(ROUNDS):
        variance = _learn_noise(f, found, variance, window)
        found = fit_once(f, h, found.theta, variance, window)
    return found, variance


def _learn_noise(f: Array, found: SeparableFit, variance: Array, window: Window) -> Array:
    basis, n = modal_basis(f, found.theta, window), len(f)
    shared = found.covariance(1.0)
    out = np.empty_like(variance)
    for k, (r, j, c) in enumerate(zip(found.residuals, found.jacobians, found.coefficients, strict=True)):
        scale = np.sqrt(variance[:, k] / 2.0)
        q = np.linalg.qr(found.bases[k])[0]
        leverage = np.sum(q**2, axis=1) + np.einsum("ij,jk,ik->i", j, shared, j)
        kept = 1.0 - 0.5 * (leverage[:n] + leverage[n:])
        out[:, k] = noise_variance(
            np.abs(_complex(r)) ** 2 * scale**2, kept, np.abs(_complex(basis @ c)) ** 2
        )
    return out


def _poorest(f: Array, h: ComplexArray, found: SeparableFit, window: Window) -> int | None:
    """Return the mode that is least of a mode, or None if all are: worth it (BIC), damped, apart, seen as a peak."""
    pairs = found.theta.reshape(-1, 2)
    gain = _gains(found, len(pairs))
    price = (2 * h.shape[1] + 2) * np.log(2.0 * h.size)
    std = np.sqrt(np.diag(found.covariance(max(1.0, found.cost / found.freedom)))).reshape(-1, 2)[:, 1]
    inside = (pairs[:, 0] >= f[0]) & (pairs[:, 0] <= f[-1])
    good: NDArray[np.bool_] = (gain > price) & (pairs[:, 1] > -3.0 * std) & (std < 0.3) & inside
    good &= _prominence(f, h, found, window) > 0.15
    width = np.maximum(pairs[:, 0] * np.abs(pairs[:, 1]), 0.5 * float(np.median(np.diff(f))))
    for a, b in combinations(range(len(pairs)), 2):
        # Of two modes closer than their own width only the stronger can be believed.
        if good[a] and good[b] and abs(pairs[a, 0] - pairs[b, 0]) < min(width[a], width[b]):
            good[a if gain[a] < gain[b] else b] = False
    return None if good.all() else int(np.argmin(np.where(good, np.inf, gain)))


def _gains(found: SeparableFit, n_modes: int) -> Array:
    """Growth of the normalised cost if a mode were left out."""
    gain = np.zeros(n_modes)
    for matrix, c in zip(found.bases, found.coefficients, strict=True):
        for m in range(n_modes):
            own = matrix[:, 2 * m : 2 * m + 2]
            q = np.linalg.qr(np.delete(matrix, [2 * m, 2 * m + 1], axis=1))[0]
            alone = own @ c[2 * m : 2 * m + 2]
            alone = alone - q @ (q.T @ alone)
            gain[m] += float(alone @ alone)
    return gain


def _prominence(f: Array, h: ComplexArray, found: SeparableFit, window: Window) -> Array:
    """Largest ratio, over the responses, of a mode's own peak to all the rest of the response there."""
    out = np.zeros(len(found.theta) // 2)
    for m, (hz, zeta) in enumerate(found.theta.reshape(-1, 2)):
        at = int(np.clip(np.searchsorted(f, hz), 1, len(f) - 1))
        near = slice(at - 1, at + 1)
        one, j = mode_columns(np.asarray(1j * TAU * f[near], dtype=np.complex128), hz, zeta, window)
        for k, c in enumerate(found.coefficients):
            own = c[2 * m] * one + c[2 * m + 1] * j
            out[m] = max(out[m], float(np.max(np.abs(own) / (np.abs(h[near, k] - own) + 1e-300))))
    return out


def _serial_covariance(found: SeparableFit) -> Array | None:
    """Covariance when residuals of neighbouring lines are alike, as where the model does not quite fit; else None.

    Scores summed over lags with Bartlett weights (Newey and West, Econometrica 55, 1987).
    """
    alike, lines, meat = 0.0, 0, np.zeros((len(found.theta), len(found.theta)))
    for r, j in zip(found.residuals, found.jacobians, strict=True):
        n = len(r) // 2
        complex_r = _complex(r)
        power = float(np.sum(np.abs(complex_r) ** 2))
        if power == 0.0:
            continue
        alike += float(np.sum(complex_r[1:] * np.conj(complex_r[:-1])).real) / power * n
        lines += n
        score = j[:n] * r[:n, None] + j[n:] * r[n:, None]
        for lag in range(-LAGS, LAGS + 1):
            part = score[max(0, lag) : n + min(0, lag)].T @ score[max(0, -lag) : n - max(0, lag)]
            meat += (1.0 - abs(lag) / (LAGS + 1.0)) * part
    if lines == 0 or alike / lines < max(0.15, 4.0 / np.sqrt(2.0 * lines)):
        return None
    bread = found.covariance(1.0)
    return np.asarray(bread @ (0.5 * (meat + meat.T)) @ bread)


def _residues(coefficients: Array) -> ComplexArray:
    own = coefficients[: len(coefficients) - REMAINDERS]
    return np.asarray(own[0::2] + 1j * own[1::2])


def _complex(stacked: Array) -> ComplexArray:
    n = len(stacked) // 2
    return np.asarray(stacked[:n] + 1j * stacked[n:])
