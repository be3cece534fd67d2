"""Modal parameters from measured frequency responses, all responses together.

Poles come from the stabilisation diagram; a modal model with remainders is then fitted to the responses around them by
weighted nonlinear least squares, the weights being the noise that the residuals show. Fitting the whole shape of the
peaks gives damping far below the frequency resolution, where the half-power width shows the resolution only.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimators.fits.frf_cluster import Cluster, fit_cluster, fit_once, neighbourhoods
from estimators.fits.lscf import Stabilisation, stabilise
from estimators.fits.modal_model import POWER_OF_S, ResponseKind, Window, WindowKind
from estimators.fits.types import Mode
from twin.plant.errors import InputError
from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi
WEAK = 0.05
"""A mode is minor if its peak acceleration stays below this share of the strongest mode's in every response."""
STEADY = 0.6
"""Share of the orders, from its first on, in which a pole must be found again."""
MOST_CANDIDATES = 40


@dataclass(frozen=True, slots=True)
class FrfFit:
    """Modes of a structure from its frequency responses.

    Attributes
    ----------
    modes
        By frequency.
    minor_modes
        Modes that are there but weak (see `WEAK`), by frequency.
    residues
        (n_responses, n_modes) complex residues of the modes, minor ones left out.
    model
        (n, n_responses) fitted responses; NaN outside the stretches that were fitted.
    noise_std
        (n, n_responses) standard deviation of the measured complex values as the residuals show it; NaN likewise.
    misfit
        Largest normalised squared residual per degree of freedom of any stretch: about 1 if the noise model holds.
    stabilisation
        The diagram that the modes were chosen from.
    window
        The window in the model.
    preferred_window
        Kind of window that would explain the data clearly better, or None.
    """

    modes: tuple[Mode, ...]
    minor_modes: tuple[Mode, ...]
    residues: ComplexArray
    model: ComplexArray
    noise_std: Array
    misfit: float
    stabilisation: Stabilisation
    window: Window
    preferred_window: str | None


def fit_frf(
    frequency_hz: ArrayLike,
    response: ArrayLike,
    *,
    kind: ResponseKind = "accelerance",
    n_modes: int | None = None,
    window: Window | None = None,
) -> FrfFit:
    """Fit modes to measured frequency responses.

    Parameters
    ----------
    frequency_hz
        (n,) ascending frequencies.
    response
        (n, n_responses) complex responses that share their modes.
    kind
        What was divided by force; only judges which modes are minor.
    n_modes
        How many modes to return, the strongest; None for all that are not minor.
    window
        How the records were cut.

    Raises
    ------
    InputError
        If there are too few frequencies, or no mode (or fewer than asked for) can be told from noise.
    """
    f = np.asarray(frequency_hz, dtype=np.float64)
    h = np.asarray(response, dtype=np.complex128).reshape(len(f), -1)
    if len(f) < 16:
        raise InputError(f"{len(f)} frequencies are too few for a mode; at least 16 are needed")
    if not (np.all(np.diff(f) > 0.0) and np.all(np.isfinite(h))):
        raise InputError("frequencies must ascend and responses be finite")
    cut = window or Window()
    h = h[:, np.max(np.abs(h), axis=0) > 0.0]
    if h.shape[1] == 0:
        raise InputError("the responses are zero everywhere; there is nothing to fit")
    diagram, candidates = _candidates(f, h)
    clusters = _apart(
        [
            c
            for rows, pairs in neighbourhoods(f, candidates)
            if (c := fit_cluster(f, h, rows, pairs, cut)) is not None
        ],
        float(np.median(np.diff(f))),
    )
    if not clusters:
        raise InputError(
            "no resonance can be told from the noise; choose a band with one, or give better data"
        )
    pairs = np.concatenate([c.pairs for c in clusters])
    std = np.concatenate([c.std for c in clusters])
    residues = np.concatenate([c.residues for c in clusters], axis=1)
    strength = _strength(pairs, residues, POWER_OF_S[kind])
    chosen = strength >= WEAK
    if n_modes is not None:
        if n_modes > len(strength):
            raise InputError(
                f"only {len(strength)} modes can be told from noise, {n_modes} were asked for; ask for fewer"
            )
        chosen = np.zeros(len(strength), dtype=bool)
        chosen[np.argsort(strength)[::-1][:n_modes]] = True
    order = np.argsort(pairs[:, 0])
    modes = [(Mode(*map(float, (*pairs[i], *std[i]))), bool(chosen[i])) for i in order]
    model, noise = np.full(h.shape, np.nan, dtype=np.complex128), np.full(h.shape, np.nan)
    for c in clusters:
        model[c.rows], noise[c.rows] = c.model(f, cut), np.sqrt(c.variance)
    return FrfFit(
        modes=tuple(m for m, strong in modes if strong),
        minor_modes=tuple(m for m, strong in modes if not strong),
        residues=residues[:, order[chosen[order]]],
        model=model,
        noise_std=noise,
        misfit=max(c.misfit for c in clusters),
        stabilisation=diagram,
        window=cut,
        preferred_window=_preferred(f, h, clusters, cut),
    )


def _candidates(f: Array, h: ComplexArray) -> tuple[Stabilisation, Array]:
    """Poles that stay, from two weightings: one sees the strong modes best, one the weak."""
    level = np.sqrt(np.mean(np.abs(h) ** 2, axis=0))
    largest = int(min(40, max(6, len(f) // 4)))
    flat = stabilise(f, h, np.broadcast_to(1.0 / level, h.shape), largest)
    even = stabilise(f, h, 1.0 / (np.abs(h) + 0.03 * level), largest)
    spacing = float(np.median(np.diff(f)))
    out: list[tuple[float, float]] = []
    for p in (*sorted(flat.poles, key=lambda p: abs(p.damping_ratio)), *even.poles):
        # A broad pole may lie over a sharp one, but not a sharp one over itself.
        near = [
            abs(p.frequency_hz - a) <= max(1.5 * min(z * a, p.damping_ratio * p.frequency_hz), spacing)
            for a, z in out
        ]
        if p.found > STEADY and not any(near):
            out.append((p.frequency_hz, p.damping_ratio))
    # A broad pole with a sharp one inside fits what the sharp one leaves; the remainder is there for that.
    out = [
        (a, z) for a, z in out if not any(abs(a - b) < 3.0 * a * z and 5.0 * b * y < a * z for b, y in out)
    ]
    pairs = np.array(sorted((a, max(z, 0.05 * spacing / a)) for a, z in out)).reshape(-1, 2)
    return flat, pairs[:MOST_CANDIDATES]


def _apart(clusters: list[Cluster], spacing_hz: float) -> list[Cluster]:
    """Leave out clusters that ended on a mode of another one, the longer stretch first."""
    kept: list[Cluster] = []
    for c in sorted(clusters, key=lambda c: c.rows.stop - c.rows.start):
        taken = np.concatenate([k.pairs for k in kept]) if kept else np.zeros((0, 2))
        gap = np.abs(c.pairs[:, :1] - taken[:, 0])
        width = np.maximum(c.pairs[:, :1] * np.abs(c.pairs[:, 1:]), spacing_hz)
        if not np.any(gap < np.minimum(width, np.maximum(taken[:, 0] * np.abs(taken[:, 1]), spacing_hz))):
            kept.append(c)
    return sorted(kept, key=lambda c: float(c.pairs[0, 0]))


def _strength(pairs: Array, residues: ComplexArray, power: int) -> Array:
    """Largest share, over the responses, of a mode's peak acceleration in the strongest mode's."""
    w = TAU * pairs[:, 0]
    peaks = np.abs(residues) * w ** (2 - power) / (w * np.maximum(pairs[:, 1], 1e-5))
    return np.asarray(np.max(peaks / peaks.max(axis=1, keepdims=True), axis=0))


def _preferred(f: Array, h: ComplexArray, clusters: list[Cluster], window: Window) -> str | None:
    """Another window that would explain the sharp peaks far better, if there is one."""
    spacing = float(np.median(np.diff(f)))
    sharp = [c for c in clusters if np.all(c.pairs[:, 0] * np.abs(c.pairs[:, 1]) < 2.0 * spacing)]
    if window.kind == "exponential" or not sharp:
        return None
    costs: dict[WindowKind, float] = {window.kind: sum(c.found.cost for c in sharp)}
    for kind in ("none", "rectangular", "hann"):
        if kind not in costs:
            other = Window(kind, 1.0 / spacing)
            costs[kind] = sum(
                fit_once(f[c.rows], h[c.rows], c.found.theta, c.variance, other).cost for c in sharp
            )
    best = min(costs, key=lambda k: costs[k])
    return best if costs[best] < 0.7 * costs[window.kind] else None
