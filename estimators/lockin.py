"""Lock-in: phasors of every channel at a known phase, with their noise, by one least-squares fit per block.

Each channel is ``Re{(A + S t) exp(j phi) + sum A_h exp(j h phi)} + offset`` plus noise, t from the block's middle.
The slope S makes the phasors right while amplitudes move; the harmonics belong to the model, since what is left
over is taken for noise. How strong that noise is *at the excitation*, where alone it matters, is read off the
residual's own phasors a few hertz beside it: a white residual is no assumption.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimators.small_matrices import invert_positive
from twin.plant.compiled import kernel
from twin.plant.linear import Array, ComplexArray, read_only

HARMONICS = (2, 3, 4, 5)

SAMPLES_PER_CYCLE = 80
"""Finer sampling than this is averaged away: it holds nothing more about the excitation and its harmonics."""

SIDEBANDS = (2, 3, 4)
"""Distance of the noise's phasors from the excitation, in steps of one over the block's duration."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of one block, averaged in groups, with their time from the block's middle [s]."""

    time_s: Array
    values: Array
    """(M, p), equidistant."""
    used: NDArray[np.bool_] | None
    """(M,) which to fit; None for all."""
    group: int
    """Raw samples in each."""
    raw_step_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class LockIn:
    """What one fit found, with p channels.

    Variances are of complex numbers, E|error|², and suppose white noise as strong as the residual.
    """

    amplitude: ComplexArray
    slope: ComplexArray
    variance: Array
    slope_variance: Array
    orders: tuple[int, ...]
    harmonics: ComplexArray
    harmonic_variance: Array
    residual_variance: Array
    """Of one of the samples fitted."""
    filled: Array
    """(M, p) the samples; those not used are the fit's own."""
    steps: tuple[int, ...]
    """Distances of the sidebands from the excitation, in steps of one over the block's duration."""
    sidebands: ComplexArray
    """(K, p) phasors of the residual there, scaled as the amplitude is."""


@kernel
def group_means(values: Array, out: Array) -> None:
    """Means of consecutive rows: (N, p) values into (M, p), N a multiple of M."""
    rows, p = out.shape
    group = values.shape[0] // rows
    share = 1.0 / group
    for k in range(rows):
        for c in range(p):
            out[k, c] = 0.0
        for i in range(k * group, (k + 1) * group):
            for c in range(p):
                out[k, c] += values[i, c]
        for c in range(p):
            out[k, c] *= share


def averaged(
    values: Array, step_s: float, highest_hz: float, used: NDArray[np.bool_] | None = None
) -> Samples:
    """Samples of a block, as few as hold all there is to know about tones up to a frequency and their harmonics.

    Parameters
    ----------
    values
        (N, p), one row every ``step_s`` seconds.
    used
        (N,) rows to fit; None for all. Where some are missing nothing is averaged.
    """
    n = len(values)
    if used is not None:
        return Samples(_times(n, 1, step_s), values, used, 1, step_s, n * step_s)
    group = max(int(1.0 / (SAMPLES_PER_CYCLE * highest_hz * step_s)), 1)
    while n % group:
        group -= 1
    if group == 1:
        return Samples(_times(n, 1, step_s), values, None, 1, step_s, n * step_s)
    means = np.empty((n // group, values.shape[1]))
    group_means(values, means)
    return Samples(_times(n, group, step_s), means, None, group, step_s, n * step_s)


@lru_cache(maxsize=8)
def _times(n: int, group: int, step_s: float) -> Array:
    """(n / group,) middles of groups of samples [s], from the middle of the block."""
    return read_only((np.arange(0, n, group) - 0.5 * (n - 1)) * step_s + 0.5 * (group - 1) * step_s)


def lock_in(samples: Samples, phase_mid: float, f_mid: float, rate: float) -> LockIn:
    """Fit all channels at a phase of ``phase_mid + 2 pi (f_mid + rate t/2) t``.

    Parameters
    ----------
    phase_mid, f_mid, rate
        Phase [rad], frequency [Hz] and sweep rate [Hz/s] at the block's middle.
    """
    t, used = samples.time_s, samples.used
    phase = phase_mid + math.tau * (f_mid + 0.5 * rate * t) * t
    half = 0.5 * samples.duration_s
    nyquist = 0.45 / (samples.raw_step_s * samples.group)
    n = len(t) if used is None else int(np.count_nonzero(used))
    orders = tuple(h for h in HARMONICS if h * f_mid < nyquist) if n >= 52 else ()
    whole = _basis(phase, t / half, orders)
    basis, values = (whole, samples.values) if used is None else (whole[:, used], samples.values[used])
    inverse = _inverse(basis @ basis.T)
    solution = inverse @ (basis @ values)
    residual = values - basis.T @ solution
    filled = samples.values if used is None else np.where(used[:, None], samples.values, whole.T @ solution)
    noise = np.einsum("ij,ij->j", residual, residual) / max(n - len(basis), 1)
    droop = [_droop(h * f_mid, samples) for h in (1, *orders)]
    own = np.diag(inverse)
    at = 5 + 2 * np.arange(len(orders))
    gain = 1.0 / np.array(droop[1:]).reshape(-1, 1)
    steps = _steps(f_mid * samples.duration_s)
    turns = t if used is None else t[used]
    sidebands = _sidebands(steps, turns / samples.duration_s, residual, basis[0] + 1j * basis[1])
    return LockIn(
        amplitude=(solution[0] + 1j * solution[1]) / droop[0],
        slope=(solution[2] + 1j * solution[3]) / (half * droop[0]),
        variance=noise * ((own[0] + own[1]) / droop[0] ** 2),
        slope_variance=noise * ((own[2] + own[3]) / (half * droop[0]) ** 2),
        orders=orders,
        harmonics=np.asarray((solution[at] + 1j * solution[at + 1]) * gain),
        harmonic_variance=(own[at] + own[at + 1])[:, None] * noise * gain**2,
        residual_variance=noise,
        filled=filled,
        steps=steps,
        sidebands=sidebands,
    )


def colour(fit: LockIn) -> Array:
    """Noise beside the excitation over what a white residual would have there, (p,); 1 where nothing tells."""
    white = np.where(fit.variance > 0.0, fit.variance, 1.0)
    if not fit.steps:
        return np.ones(len(white))
    seen = np.mean(np.abs(fit.sidebands) ** 2, axis=0)
    return np.asarray(np.where(fit.variance > 0.0, seen / white, 1.0))


def strongest_hz(samples: Samples, column: int, band_hz: tuple[float, float]) -> float:
    """Strongest frequency of a channel in a band [Hz], from a Hann-windowed, zero-padded spectrum."""
    step = samples.raw_step_s * samples.group
    n = len(samples.values)
    signal = samples.values[:, column]
    if samples.used is None:
        signal = signal - signal.mean()
    else:
        signal = np.where(samples.used, signal - signal[samples.used].mean(), 0.0)
    size = 1 << max(14, (8 * n - 1).bit_length())
    spectrum = np.abs(np.fft.rfft(signal * np.hanning(n), size))
    frequency = np.fft.rfftfreq(size, step)
    inside = (frequency >= band_hz[0]) & (frequency <= band_hz[1])
    if not inside.any():
        inside = frequency > 0.0
    return float(frequency[inside][np.argmax(spectrum[inside])])


def _basis(phase: Array, u: Array, orders: tuple[int, ...]) -> Array:
    """(5 + 2 n_orders, N): fundamental, its slope, one, harmonics by Chebyshev's recursion."""
    basis = np.empty((5 + 2 * len(orders), len(phase)))
    np.cos(phase, out=basis[0])
    np.sin(phase, out=basis[1])
    basis[1] *= -1.0
    np.multiply(basis[:2], u, out=basis[2:4])
    basis[4] = 1.0
    twice = 2.0 * basis[0]
    before: tuple[Array | float, Array | float] = (1.0, 0.0)
    now: tuple[Array, Array] = (basis[0], basis[1])
    for i in range(len(orders)):
        row = 5 + 2 * i
        for part in (0, 1):
            np.multiply(twice, now[part], out=basis[row + part])
            basis[row + part] -= before[part]
        before, now = now, (basis[row], basis[row + 1])
    return basis


@lru_cache(maxsize=4)
def _turning_by(steps: tuple[int, ...], turns: bytes) -> ComplexArray:
    """(n_steps, N) ``exp(-2j pi step turns)``: the same from block to block."""
    powers = [np.exp(-2j * math.pi * np.frombuffer(turns))]
    for _ in range(max(steps) - 1):
        powers.append(powers[-1] * powers[0])
    found = np.stack([powers[s - 1] if s > 0 else np.conj(powers[-s - 1]) for s in steps])
    found.flags.writeable = False
    return found


def _inverse(gram: Array) -> Array:
    """Inverse of a Gram matrix; the pseudoinverse where its columns cannot be told apart."""
    inverse = gram.copy()
    if invert_positive(inverse):
        return inverse
    return np.asarray(np.linalg.pinv(gram))


def _droop(frequency_hz: float, samples: Samples) -> float:
    """What averaging in groups leaves of a tone's amplitude."""
    x = math.pi * frequency_hz * samples.raw_step_s
    return math.sin(samples.group * x) / (samples.group * math.sin(x)) if samples.group > 1 else 1.0


def _steps(cycles: float) -> tuple[int, ...]:
    """Sidebands two steps clear of the offset below, and of the second harmonic above: the fit takes what is there."""
    return tuple(s for k in SIDEBANDS if k <= cycles - 2.0 for s in (-k, k))


def _sidebands(steps: tuple[int, ...], turns: Array, residual: Array, turning: ComplexArray) -> ComplexArray:
    """Phasors of the residual beside the excitation; ``turns`` is time over the block's duration."""
    if not steps:
        return np.zeros((0, residual.shape[1]), dtype=np.complex128)
    basis = _turning_by(steps, turns.tobytes()) * turning
    # The slope in the fit has taken its share of each.
    left = np.sqrt(1.0 - 3.0 / (math.pi * np.array(steps)) ** 2)
    return np.asarray((basis @ residual) * (2.0 / (len(residual) * left))[:, None])
