"""Frequency and damping from free decays, by bands of amplitude.

Damped sinusoids with an offset and a slope of their own are fitted to the samples of every decay at once by maximum
likelihood. An autoregressive model fitted by least squares to the same samples takes the noise of its regressors for
damping; here noise adds nothing. Because damping and stiffness often change with amplitude, the decays are also cut
where their amplitude passes the edges of bands, and each band is fitted for itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import periodogram

from estimators.fits.free_decays import Decay, envelope, find_decays, main_frequency
from estimators.fits.homogeneity import disagree, with_scatter
from estimators.fits.ringing import RingingFit, fit_ringing
from estimators.fits.types import Mode
from twin.plant.errors import InputError
from twin.plant.linear import Array

TAU = 2.0 * np.pi
MOST_MODES = 6
NEAR = 0.1
"""Lines closer to a mode than this share of its frequency are not taken for a mode of their own."""
FEWEST_PERIODS = 2.5
"""A piece of a decay must hold so many periods to be used in a band."""


@dataclass(frozen=True, slots=True)
class AmplitudeBand:
    """Frequency and damping while the amplitude lies in a band.

    Attributes
    ----------
    amplitude_from, amplitude_to
        Lower and upper edge, in the unit of the record.
    mode
        What was found there.
    decays
        How many decays have a piece in it.
    periods
        Periods of vibration in all pieces together.
    """

    amplitude_from: float
    amplitude_to: float
    mode: Mode
    decays: int
    periods: float


@dataclass(frozen=True, slots=True)
class DecayFit:
    """What the free decays of a record say.

    Attributes
    ----------
    modes
        The strongest first; over all amplitudes.
    bands
        Largest amplitudes first; for the strongest mode.
    decays
        The stretches that were used.
    model
        Per decay (n_samples,) fitted values.
    residual_rms
        Root mean square of what the modes leave, over all decays.
    amplitude_dependent
        Whether the bands differ by more than their errors (at 0.1 %).
    """

    modes: tuple[Mode, ...]
    bands: tuple[AmplitudeBand, ...]
    decays: tuple[Decay, ...]
    model: tuple[Array, ...]
    residual_rms: float
    amplitude_dependent: bool


def fit_decay(
    values: ArrayLike,
    sample_rate_hz: float,
    *,
    band_hz: tuple[float, float] | None = None,
    edges: Sequence[float] | None = None,
    n_modes: int | None = None,
) -> DecayFit:
    """Find the free decays in a record and fit them.

    Parameters
    ----------
    values
        (n,) finite samples of a displacement, velocity, acceleration or strain.
    sample_rate_hz
        Samples per second.
    band_hz
        Where to look for the strongest mode [Hz]; everywhere unless given.
    edges
        Edges of the amplitude bands in the unit of the record; 1, 2, 5, 10 ... unless given.
    n_modes
        How many modes the decays hold; as many as stand out unless given.

    Raises
    ------
    InputError
        If the record is too short or constant, or holds no free decay.
    """
    y = np.asarray(values, dtype=np.float64)
    if len(y) < 24:
        raise InputError(f"{len(y)} samples are too few for a free decay; at least 24 are needed")
    if not np.ptp(y) > 0.0:
        raise InputError("the signal is constant; choose the channel that moves")
    frequency = main_frequency(y, sample_rate_hz, band_hz)
    if frequency is None:
        raise InputError("no oscillation can be told from noise; choose another channel or band")
    decays, start = _decays(y, sample_rate_hz, frequency)
    pieces = [y[d.first : d.end] for d in decays]
    whole = _all_modes(pieces, sample_rate_hz, start, n_modes)
    main = whole.modes[0]
    # What the other modes contribute is taken off before the strongest is looked at band by band.
    alone = [y.copy() for _ in decays]
    for k, d in enumerate(decays):
        alone[k][d.first : d.end] -= _other_modes(whole, pieces[k], sample_rate_hz)
    chosen = sorted(edges) if edges is not None else _edges(decays, main.damping_ratio)
    bands = []
    for low, high in pairwise(chosen):
        band = _band(alone, decays, sample_rate_hz, main, low, high)
        if band is not None:
            bands.append(band)
    if not bands:
        reach = (min(d.amplitude[1] for d in decays), max(d.amplitude[0] for d in decays))
        if edges is not None:
            raise InputError(
                f"no decay has {FEWEST_PERIODS:g} periods in any band; "
                f"amplitudes run from {reach[1]:.3g} down to {reach[0]:.3g}"
            )
        periods = sum(d.end - d.first for d in decays) * main.frequency_hz / sample_rate_hz
        bands = [AmplitudeBand(*reach, main, len(decays), periods)]
    bands.sort(key=lambda b: -b.amplitude_to)
    return DecayFit(
        modes=whole.modes,
        bands=tuple(bands),
        decays=tuple(decays),
        model=whole.model,
        residual_rms=whole.residual_rms,
        amplitude_dependent=disagree([band.mode for band in bands], 1e-3),
    )


def _decays(y: Array, rate_hz: float, frequency_hz: float) -> tuple[list[Decay], tuple[float, float]]:
    found = find_decays(y, rate_hz, frequency_hz)
    if not found:
        return _heavy(y, rate_hz, frequency_hz)
    out = []
    for d in found:
        start = _first_guess(y[d.first : d.end], rate_hz, frequency_hz)
        out.append((_back_to_release(y, d, rate_hz, start), start))
    longest = max(out, key=lambda pair: pair[0].amplitude[0] * np.sqrt(pair[0].end - pair[0].first))
    return [d for d, _ in out], longest[1]


def _first_guess(piece: Array, rate_hz: float, frequency_hz: float) -> tuple[float, float]:
    """Frequency and damping ratio from the slope of the phasor's logarithm, louder windows weighing more."""
    seen = envelope(piece, rate_hz, frequency_hz)
    t, a = seen.centre / rate_hz, np.maximum(seen.amplitude, 1e-300)
    if len(t) < 3:
        return frequency_hz, 0.02
    growth = np.polyfit(t, np.log(a), 1, w=a)[0]
    turn = np.polyfit(t, np.unwrap(np.angle(seen.phasor)), 1, w=a)[0]
    w = TAU * frequency_hz + turn
    return float(np.hypot(w, growth) / TAU), float(np.clip(-growth / np.hypot(w, growth), 1e-5, 0.6))


def _back_to_release(y: Array, d: Decay, rate_hz: float, start: tuple[float, float]) -> Decay:
    """Move the start back for as long as the fitted decay, continued backward, meets the samples."""
    period = rate_hz / start[0]
    reach = int(min(d.end - d.first, max(4.0 * period, 16)))
    fit = fit_ringing([y[d.first : d.first + reach]], rate_hz, [start], drift_order=0)
    mode, back = fit.modes[0], int(2.0 * period)
    tolerance = max(4.0 * fit.residual_rms, 0.02 * d.amplitude[0])
    first = max(0, d.first - back)
    t = np.arange(first - d.first, reach) / rate_hz
    decay = np.exp(-TAU * mode.frequency_hz * mode.damping_ratio * t)
    w = TAU * mode.frequency_hz * np.sqrt(max(1.0 - mode.damping_ratio**2, 1e-6))
    basis = np.column_stack([np.ones_like(t), decay * np.cos(w * t), decay * np.sin(w * t)])
    known = d.first - first
    c = np.linalg.lstsq(basis[known:], y[d.first : d.first + reach], rcond=None)[0]
    off = np.abs(y[first : d.first] - basis[:known] @ c) > tolerance
    bad = np.flatnonzero(off)
    begin = first + (int(bad[-1]) + 2 if len(bad) else 0)
    return Decay(min(begin, d.first), d.end, d.amplitude)


def _heavy(y: Array, rate_hz: float, frequency_hz: float) -> tuple[list[Decay], tuple[float, float]]:
    """One decay too short for windows of several periods: from the largest excursion on."""
    rest = float(np.median(y[len(y) // 2 :]))
    noise = float(np.sqrt(np.median((y[len(y) // 2 :] - rest) ** 2))) / 0.6745
    top = int(np.argmax(np.abs(y - rest)))
    size = abs(float(y[top]) - rest)
    if top > 0.7 * len(y) or size < 8.0 * noise:
        raise InputError(_NONE)
    above = np.flatnonzero(np.abs(y[top:] - rest) > max(5.0 * noise, 1e-3 * size))
    end = int(min(len(y), top + 2 * above[-1] + 12))
    best: RingingFit | None = None
    for factor in (0.8, 1.1, 1.5):
        for zeta in (0.05, 0.15, 0.35, 0.6):
            fit = fit_ringing([y[top:end]], rate_hz, [(factor * frequency_hz, zeta)], drift_order=0)
            if best is None or fit.residual_rms < best.residual_rms:
                best = fit
    mode = best.modes[0] if best is not None else None
    if (
        best is None
        or mode is None
        or best.residual_rms > 0.2 * np.std(y[top:end])
        or not 0.02 < mode.damping_ratio < 0.95
    ):
        raise InputError(_NONE)
    decay = Decay(top, end, (float(best.amplitude[0, 0]), max(noise, 1e-3 * size)))
    start = (mode.frequency_hz, mode.damping_ratio)
    return [_back_to_release(y, decay, rate_hz, start)], start


_NONE = (
    "no free decay found: nothing rings down by itself after a release; choose another channel or band, or a part of "
    "the record in which the excitation is off"
)


def _all_modes(
    pieces: list[Array], rate_hz: float, start: tuple[float, float], n_modes: int | None
) -> RingingFit:
    """Fit one mode, then one more at a time where the residual's spectrum has a line, while it pays (BIC)."""
    starts = [start]
    fit = _steady_fit(pieces, rate_hz, starts)
    size = sum(len(p) for p in pieces)
    for _ in range((n_modes or MOST_MODES) - 1):
        found = _next_line(pieces, fit, rate_hz)
        if found is None:
            break
        tried = _steady_fit(pieces, rate_hz, [(m.frequency_hz, m.damping_ratio) for m in fit.modes] + [found])
        gain = 2.0 * size * np.log(fit.residual_rms / max(tried.residual_rms, 1e-300))
        price = (2 + 2 * len(pieces)) * np.log(size)
        new = tried.modes[-1]
        weak = float(np.max(tried.amplitude[:, -1] / tried.amplitude[:, 0])) < 0.01
        bad = not 0.0 < new.damping_ratio < 0.5 or new.damping_std > 0.5 * new.damping_ratio or weak
        hz = np.array([m.frequency_hz for m in tried.modes])
        # Damping that depends on amplitude looks like two modes at one frequency; it is one.
        bad |= bool(np.min(np.abs(hz[:-1] - hz[-1])) < NEAR * hz[-1])
        if n_modes is None and (gain < 2.0 * price or bad):
            break
        fit = tried
    if n_modes is not None and len(fit.modes) < n_modes:
        raise InputError(
            f"only {len(fit.modes)} modes can be told from noise, {n_modes} were asked for; ask for fewer"
        )
    return fit


def _steady_fit(pieces: list[Array], rate_hz: float, starts: list[tuple[float, float]]) -> RingingFit:
    return fit_ringing(pieces, rate_hz, starts, drift_order=1)


def _next_line(pieces: list[Array], fit: RingingFit, rate_hz: float) -> tuple[float, float] | None:
    """Strongest line in the residuals that is not where a mode already is."""
    n = max(len(p) for p in pieces)
    total = np.zeros(2 * n + 1)
    for piece, model in zip(pieces, fit.model, strict=True):
        hz, power = periodogram(piece - model, rate_hz, nfft=4 * n)
        total += power
    allowed = (hz > 3.0 * rate_hz / n) & (hz < 0.48 * rate_hz)
    for m in fit.modes:
        allowed &= np.abs(hz - m.frequency_hz) > max(
            NEAR * m.frequency_hz, 4.0 * m.damping_ratio * m.frequency_hz
        )
    if not allowed.any() or np.max(total[allowed]) < 20.0 * np.median(total[1:]):
        return None
    at = float(hz[allowed][np.argmax(total[allowed])])
    return at, float(np.clip(fit.modes[0].damping_ratio, 1e-3, 0.1))


def _other_modes(whole: RingingFit, piece: Array, rate_hz: float) -> Array:
    if len(whole.modes) == 1:
        return np.zeros(len(piece))
    t = np.arange(len(piece)) / rate_hz
    columns = [np.ones_like(t), t]
    for m in whole.modes:
        decay = np.exp(-TAU * m.frequency_hz * m.damping_ratio * t)
        w = TAU * m.frequency_hz * np.sqrt(max(1.0 - m.damping_ratio**2, 1e-6))
        columns += [decay * np.cos(w * t), decay * np.sin(w * t)]
    basis = np.column_stack(columns)
    c = np.linalg.lstsq(basis, piece, rcond=None)[0]
    return np.asarray(basis[:, 4:] @ c[4:])


def _edges(decays: list[Decay], damping_ratio: float) -> list[float]:
    """Edges that give a band enough periods: 1, 2, 5 for light damping, decades for heavier, none for heavy."""
    top, low = max(d.amplitude[0] for d in decays), min(d.amplitude[1] for d in decays)
    per_factor = 1.0 / (TAU * max(damping_ratio, 1e-9))
    series = (1.0, 2.0, 5.0) if np.log(2.0) * per_factor > FEWEST_PERIODS else (1.0,)
    if np.log(10.0) * per_factor < FEWEST_PERIODS:
        return []
    powers = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(top))) + 2)
    grid = sorted(m * 10.0**p for p in powers for m in series)
    # The last edge above the largest amplitude belongs to a band that reaches up to it.
    return [g for i, g in enumerate(grid) if g >= 0.7 * low and (i == 0 or grid[i - 1] < 1.02 * top)]


def _band(
    records: list[Array], decays: list[Decay], rate_hz: float, main: Mode, low: float, high: float
) -> AmplitudeBand | None:
    pieces = []
    for y, d in zip(records, decays, strict=True):
        piece = y[d.first : d.end]
        seen = envelope(piece, rate_hz, main.frequency_hz)
        a = np.minimum.accumulate(seen.amplitude)
        inside = np.flatnonzero((a < high) & (a >= low))
        if not len(inside):
            continue
        begin = 0 if inside[0] == 0 else int(seen.centre[inside[0]])
        end = len(piece) if inside[-1] == len(a) - 1 else int(seen.centre[inside[-1]]) + 1
        if (end - begin) * main.frequency_hz / rate_hz >= FEWEST_PERIODS and end - begin >= 10:
            pieces.append(piece[begin:end])
    if not pieces:
        return None
    start = [(main.frequency_hz, max(main.damping_ratio, 1e-5))]
    fit = fit_ringing(pieces, rate_hz, start)
    mode = fit.modes[0]
    if len(pieces) > 1:
        start = [(mode.frequency_hz, mode.damping_ratio)]
        mode = with_scatter(mode, [fit_ringing([p], rate_hz, start).modes[0] for p in pieces])
    if not mode.damping_std < 0.5 or mode.damping_std > max(2.0 * abs(mode.damping_ratio), 0.002):
        return None
    return AmplitudeBand(
        low, high, mode, len(pieces), sum(len(p) for p in pieces) * mode.frequency_hz / rate_hz
    )
