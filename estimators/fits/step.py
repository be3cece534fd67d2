"""Second-order step responses: natural frequency and damping ratio.

The model is simulated, never the data's own past values (output error): a regression on past outputs, as ARX does it,
takes measurement noise and quantisation for damping. Two models are compared. The *forced* one is the response to the
measured input, or to an ideal step with a finite rise, after a delay, on top of what still rings from before. The
*free* one uses only what rings after the input has come to rest, with amplitude and phase left open: it holds also
where a driver distorts the edge or the path has a zero. The forced model is used where it fits as well as the free.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.signal import lfilter

from estimators.fits.homogeneity import with_scatter
from estimators.fits.ringing import TAU, RingingFit, damped_pair, fit_ringing, spectral_covariance
from estimators.fits.separable import SeparableFit, fit_separable
from estimators.fits.types import Mode
from twin.plant.errors import InputError
from twin.plant.linear import Array

FEW = 4
CLEARLY_BETTER = 1.15
"""The free model is used when the forced one leaves so many times its residual."""


@dataclass(frozen=True, slots=True)
class StepPiece:
    """One step response, cut from a record.

    Attributes
    ----------
    output
        (n_samples,) response; begins before the step.
    input
        (n_samples,) what was commanded, or None.
    edge
        Sample at which the step begins.
    record
        Which record it was cut from.
    """

    output: Array
    input: Array | None
    edge: int
    record: int = 0


@dataclass(frozen=True, slots=True)
class StepFit:
    """What the step responses say.

    Attributes
    ----------
    mode
        Over all steps; its standard deviations contain the scatter from step to step.
    each
        The same from every step alone.
    method
        ``forced`` or ``free`` (see the module).
    delay_s, rise_s
        Delay of the response behind the edge and rise time of an ideal step [s]; None where not part of the model.
    overshoot
        Largest first overshoot that such a system shows, as a share of the step.
    model
        Per step (n_samples,) fitted values, NaN where the model says nothing.
    residual_rms
        Root mean square of what is left, in the unit of the output.
    """

    mode: Mode
    each: tuple[Mode, ...]
    method: Literal["forced", "free"]
    delay_s: float | None
    rise_s: float | None
    overshoot: float
    model: tuple[Array, ...]
    residual_rms: float


def fit_steps(pieces: Sequence[StepPiece], sample_rate_hz: float) -> StepFit:
    """Fit one second-order system to all step responses.

    Parameters
    ----------
    pieces
        One or more steps; see `estimators.fits.step_finding.find_steps`.
    sample_rate_hz
        Samples per second.

    Raises
    ------
    InputError
        If there is no step, or no second-order response in it.
    """
    if not pieces:
        raise InputError("no step found; give the record of a step response, from before the step on")
    # A few steps decide between the models; all of them are then fitted with the better one.
    some = [pieces[k] for k in np.unique(np.linspace(0, len(pieces) - 1, FEW).astype(int))]
    forced = _forced(some, sample_rate_hz, _first_guess(some, sample_rate_hz))
    start = (float(forced.theta[0]), float(forced.theta[1]))
    free = _free(some, sample_rate_hz, start)
    method: Literal["forced", "free"] = "forced"
    if free is not None and free.modes[0].damping_ratio < 0.5:
        rms = _rms([r[_settled(p) :] for r, p in zip(forced.residuals, some, strict=True)])
        if rms > CLEARLY_BETTER * free.residual_rms:
            method, free = "free", _free(pieces, sample_rate_hz, _pair(free.modes[0]))
    if method == "forced" and len(some) < len(pieces):
        forced = _forced(pieces, sample_rate_hz, start, forced.theta)
    if method == "free" and free is not None:
        mode, model = free.modes[0], _placed(free.model, pieces)
        singles = [
            fit_ringing([p.output[_settled(p) :]], sample_rate_hz, [_pair(mode)]).modes[0] for p in pieces
        ]
        residual = free.residual_rms
        delay = rise = None
    else:
        covariance = spectral_covariance(forced)
        mode = Mode(
            float(forced.theta[0]), float(forced.theta[1]), *map(float, np.sqrt(np.diag(covariance)[:2]))
        )
        model = tuple(p.output - r for p, r in zip(pieces, forced.residuals, strict=True))
        residual = float(np.sqrt(forced.cost / forced.freedom))
        singles = []
        for p in pieces:
            one = _forced([p], sample_rate_hz, _pair(mode), forced.theta)
            std = np.sqrt(np.diag(spectral_covariance(one))[:2])
            singles.append(Mode(float(one.theta[0]), float(one.theta[1]), float(std[0]), float(std[1])))
        delay = float(forced.theta[2])
        rise = float(forced.theta[3]) if len(forced.theta) > 3 else None
    if not residual < 0.5 * _rms([p.output - np.mean(p.output) for p in pieces]):
        raise InputError(
            "the response after the step is not that of a second-order system; check the channels"
        )
    zeta = mode.damping_ratio
    overshoot = float(np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2))) if abs(zeta) < 1.0 else 0.0
    return StepFit(
        with_scatter(mode, singles), tuple(singles), method, delay, rise, overshoot, model, residual
    )


def second_order(drive: Array, sample_rate_hz: float, frequency_hz: float, damping_ratio: float) -> Array:
    """Response of ``w²/(s² + 2 zeta w s + w²)`` to an input that is linear between samples.

    It rests at the input's first value.

    Exact for such inputs: the ramp-invariant discretisation.

    Returns
    -------
    Array
        (n_samples,) like ``drive``.
    """
    w, dt = TAU * frequency_hz, 1.0 / sample_rate_hz
    c, s = damped_pair(np.array([dt]), frequency_hz, damping_ratio)
    c0, s0, z = float(c[0]), float(s[0]), damping_ratio
    # Transition of the states (y, y'), and the response to 1 and to t over one step.
    a = np.array([[c0 + z * w * s0, s0], [-w * w * s0, c0 - z * w * s0]])
    one = np.array([1.0 - a[0, 0], -a[1, 0]])
    # A unit ramp's particular solution is t - 2 z/w.
    ramp = np.array(
        [dt - 2.0 * z / w + a[0, 0] * 2.0 * z / w - a[0, 1], 1.0 + a[1, 0] * 2.0 * z / w - a[1, 1]]
    )
    b1 = ramp / dt
    b0 = one - b1
    # As a recursion of second order in y alone, from the characteristic polynomial of the transition.
    trace, det = a[0, 0] + a[1, 1], a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    numerator = np.array([
        b1[0],
        b0[0] + a[0, 1] * b1[1] - a[1, 1] * b1[0],
        a[0, 1] * b0[1] - a[1, 1] * b0[0],
    ])  # fmt: skip
    u = drive - drive[0]
    return np.asarray(lfilter(numerator, [1.0, -trace, det], u) + drive[0], dtype=np.float64)


def _forced(
    pieces: Sequence[StepPiece], rate_hz: float, start: tuple[float, float], known: Array | None = None
) -> SeparableFit:
    """Output error: response to the input after a delay, ringing from before, and the level."""
    measured = all(p.input is not None for p in pieces)
    times = [np.arange(len(p.output)) / rate_hz for p in pieces]
    # Half a period before the edge cannot be a delay; many periods after it neither.
    low, high = [0.2 * start[0], -0.05, -0.6 / start[0]], [4.0 * start[0], 3.0, 2.0 / start[0]]
    theta, steps = [start[0], start[1], 0.0], [0.02 * start[0], 0.02, 0.02 / start[0]]
    if not measured:
        # An ideal step has a rise as well, at least what fits between two samples.
        low, high = [*low, 0.0], [*high, 1.5 / start[0]]
        theta, steps = [*theta, 1.0 / rate_hz], [*steps, 0.02 / start[0]]

    def bases(now: Array) -> list[Array]:
        out = []
        for p, t in zip(pieces, times, strict=True):
            if p.input is not None:
                drive = np.interp(t - now[2], t, p.input)
                driven = second_order(_unit(drive), rate_hz, now[0], now[1])
            else:
                begin = p.edge / rate_hz + now[2]
                driven = _ramp_response(t - begin, max(now[3], 1e-3 / rate_hz), now[0], now[1])
            c, s = damped_pair(t, now[0], now[1])
            # Where the record begins in mid-ringing, that goes on under the step.
            out.append(np.column_stack([np.ones_like(t), driven, c, s * TAU * now[0]]))
        return out

    data = [p.output for p in pieces]
    if known is not None:
        return fit_separable(bases, data, known, low, high, steps)
    best = fit_separable(bases, data, theta, low, high, steps)
    for f_factor, zeta in ((1.0, 0.3), (1.5, 0.8), (1.0, 0.03)):
        if _rms(list(best.residuals)) < 0.15 * _rms([y - np.mean(y) for y in data]):
            break
        found = fit_separable(bases, data, [start[0] * f_factor, zeta, *theta[2:]], low, high, steps)
        best = found if found.cost < 0.999 * best.cost else best
    return best


def _ramp_response(t: Array, rise_s: float, frequency_hz: float, damping_ratio: float) -> Array:
    """Response to a ramp from 0 to 1 within ``rise_s``, from rest."""
    w = TAU * frequency_hz

    def ramp(x: Array) -> Array:
        x = np.maximum(x, 0.0)
        c, s = damped_pair(x, frequency_hz, damping_ratio)
        lag = 2.0 * damping_ratio / w
        return np.asarray(x - lag + lag * c + (2.0 * damping_ratio**2 - 1.0) * s)

    return np.asarray((ramp(t) - ramp(t - rise_s)) / rise_s)


def _free(pieces: Sequence[StepPiece], rate_hz: float, start: tuple[float, float]) -> RingingFit | None:
    tails = [p.output[_settled(p) :] for p in pieces]
    if min(len(t) for t in tails) < 12 or start[1] > 0.7:
        return None
    return fit_ringing(tails, rate_hz, [(start[0], float(np.clip(start[1], 1e-4, 0.6)))], drift_order=0)


def _settled(p: StepPiece) -> int:
    """Sample from which the input rests: a fiftieth of the piece after the edge, later if the input says so."""
    after = p.edge + max(2, len(p.output) // 50)
    if p.input is None:
        return after
    last = float(np.median(p.input[-max(4, len(p.input) // 4) :]))
    noise = float(np.median(np.abs(p.input[-max(4, len(p.input) // 4) :] - last)))
    off = np.flatnonzero(np.abs(p.input[p.edge :] - last) > max(6.0 * noise, 0.03 * float(np.ptp(p.input))))
    moving = off[off < len(p.output) // 4]
    return max(after, p.edge + int(moving[-1]) + 2 if len(moving) else 0)


def _first_guess(pieces: Sequence[StepPiece], rate_hz: float) -> tuple[float, float]:
    """From crossings of the final value and the size of successive extremes."""
    frequencies, dampings = [], []
    for p in pieces:
        y = p.output[p.edge :]
        final = float(np.mean(y[-max(4, len(y) // 5) :]))
        error = y - final
        size = float(np.max(np.abs(error)))
        loud = np.flatnonzero(np.abs(error) > 0.05 * size)
        error = error[: int(loud[-1]) + 2] if len(loud) else error
        sign = np.sign(error)
        crossings = np.flatnonzero(sign[1:] * sign[:-1] < 0)
        if len(crossings) >= 3:
            frequencies.append(0.5 * rate_hz * (len(crossings) - 1) / (crossings[-1] - crossings[0]))
            swings = [np.max(np.abs(error[a : b + 1])) for a, b in pairwise(crossings) if b > a]
            drop = (
                -np.polyfit(np.arange(len(swings)), np.log(np.maximum(swings, 1e-12)), 1)[0]
                if len(swings) > 1
                else 0.5
            )
            dampings.append(float(np.clip(drop / np.hypot(np.pi, drop), 1e-3, 0.7)))
        else:
            # Hardly any overshoot: the time to reach two thirds of the step.
            reached = np.flatnonzero(np.abs(error) < 0.4 * size)
            frequencies.append(0.25 * rate_hz / max(1, int(reached[0]) if len(reached) else len(y) // 4))
            dampings.append(0.7)
    return float(np.median(frequencies)), float(np.median(dampings))


def _placed(tails: Sequence[Array], pieces: Sequence[StepPiece]) -> tuple[Array, ...]:
    return tuple(
        np.concatenate([np.full(len(p.output) - len(t), np.nan), t])
        for t, p in zip(tails, pieces, strict=True)
    )


def _unit(drive: Array) -> Array:
    return np.asarray((drive - drive[0]) / max(float(np.ptp(drive)), 1e-300))


def _pair(mode: Mode) -> tuple[float, float]:
    return mode.frequency_hz, max(mode.damping_ratio, 1e-5)


def _rms(parts: list[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
