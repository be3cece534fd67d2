"""Excitation tracker: frequency of the excitation from block to block, and every channel's phasor at it.

The phase is carried on through gaps, sweeps and jumps. A block is fitted once, at the phase that the blocks before
it predict; what the reference's phasor turns by within the block corrects the frequency, and only where that is
more than a hair the fit is repeated.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.lockin import LockIn, Samples, averaged, colour, lock_in, strongest_hz
from estimators.types import Phasors
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.linear import Array

MIN_VALID_SHARE = 0.5
MIN_CYCLES = 1.5
"""Cycles of the excitation a block must hold: with fewer its frequency, offset and drift look alike."""

LOST_SIGNAL_RATIO = 5.0
"""Amplitude over its standard deviation below which a reference tells no frequency."""

SMALL_TURN_RAD = 2e-3
"""Half of what the phasor turns by in a block may be this much before the block is fitted again."""

MAX_FITS = 8
POOR_FIT = 0.02
"""Residual power over the tone's: with more the tracker looks whether it follows the wrong tone."""

NO_NOISE = 1e-6
"""Residual power over the tone's that is too little to tell a jump from."""

RATE_WALK_HZ_S = 0.5
"""Random walk of the sweep rate [Hz/s per sqrt(s)]; faster changes are taken for a break of its course."""

BREAK_SIGMAS = 6.0
NEW_RATE_STD_HZ_S = 3.0
COLOUR_MEMORY_S = 1.5
COLOUR_PRIOR_BINS = 4.0
SUDDEN_NOISE = 10.0
"""A block that is noisier beside the excitation than the blocks before by this factor is judged by itself."""


def choose_reference(plant: Plant, channels: Sequence[str]) -> str | None:
    """Channel that tells the excitation's frequency best.

    An exciting actuator's voltage, its command, force or current: nothing the controller does moves them much. Else a
    motion of the absorber, which moves most where the primary body is quiet; else of the primary body. None if none
    of them is recorded.
    """
    for actuator in plant.actuator:
        if actuator is not plant.voice_coil:
            of_it = {s.kind: s.name for s in plant.sensor if s.of == actuator.name}
            for name in (of_it.get("voltage"), actuator.name, of_it.get("force"), of_it.get("current")):
                if name in channels:
                    return name
    bodies = (plant.primary,) if plant.absorber is None else (plant.absorber, plant.primary)
    for body in bodies:
        of_body = {s.kind: s.name for s in plant.sensor if s.of == body.name}
        for kind in ("acceleration", "velocity", "displacement"):
            if of_body.get(kind) in channels:
                return of_body[kind]
    return None


class ExcitationTracker:
    """Track the excitation's phase from block to block and lock every channel in to it.

    Parameters
    ----------
    reference
        Name of the channel to track.
    channels
        Names of a block's columns.
    band_hz
        Frequencies among which a lost excitation is looked for [Hz].
    """

    def __init__(
        self, reference: str, channels: Sequence[str], band_hz: tuple[float, float] = (5.0, 500.0)
    ) -> None:
        self.reference = reference
        self.channels = tuple(channels)
        self._column = self.channels.index(reference)
        self._band = band_hz
        self._course: _Course | None = None
        self._next_sample: int | None = None
        self._residual: float | None = None
        self._power = 0.0
        self._colour = _RunningColour(len(self.channels))

    def advance(self, block: Block) -> Phasors | None:
        """Phasors of one block; None while there is no excitation to track.

        A channel with less than half of its samples has an amplitude of zero with infinite variance.
        """
        dt = 1.0 / block.sample_rate_hz
        n = block.n_samples
        self._cross_gap(block, dt)
        found = self._usable(block) if n >= 8 else None
        if found is None:
            self._coast(n * dt)
            return None
        live, rows = found
        values = block.values if live is None else np.where(live, block.values, 0.0)
        band = (max(self._band[0], MIN_CYCLES / (n * dt)), min(self._band[1], 0.45 / dt))
        samples = averaged(values, dt, self._expected_hz(band), rows)
        searched = self._course is None
        if self._course is None:
            strongest = self._search(samples, band)
            if strongest is None:
                return None
            self._course, self._residual = _Course(strongest), None
            samples = averaged(values, dt, strongest, rows)
        course = self._course
        half = 0.5 * n * dt
        course.go_on(half)
        rate = course.rate
        fit, f_mid = self._converge(samples, course)
        if _poor(fit, self._column) and not searched:
            other = self._search(samples, band)
            if other is not None and abs(other - f_mid) * n * dt > 0.5:
                better, hz = self._converge(samples, course, other)
                if better.residual_variance[self._column] < fit.residual_variance[self._column]:
                    fit, f_mid = better, hz
        size = abs(complex(fit.amplitude[self._column]))
        self._power = 0.5 * size**2
        if not band[0] <= f_mid <= band[1] or size**2 <= LOST_SIGNAL_RATIO**2 * fit.variance[self._column]:
            self._course = None
            return None
        noise = self._colour.take(fit, n * dt)
        variance, slope_variance = fit.variance * noise, fit.slope_variance * noise
        sample_variance = fit.residual_variance * noise
        f_std = math.sqrt(0.5 * slope_variance[self._column]) / (math.tau * size)
        one_tone = self._looks_as_before(float(fit.residual_variance[self._column]))
        steady = course.correct(f_mid, f_std, one_tone) and not searched
        course.go_on(half)
        if live is not None:
            dead = ~live
            fit.amplitude[dead], fit.slope[dead], fit.harmonics[:, dead] = 0.0, 0.0, 0.0
            fit.harmonic_variance[:, dead] = math.inf
            variance[dead] = slope_variance[dead] = sample_variance[dead] = math.inf
        return Phasors(
            frequency_hz=f_mid,
            frequency_std_hz=f_std,
            sweep_rate_hz_s=rate,
            steady=steady,
            reference=self.reference,
            channels=self.channels,
            amplitude=fit.amplitude,
            slope=fit.slope,
            variance=variance,
            slope_variance=slope_variance,
            harmonic_orders=fit.orders,
            harmonics=fit.harmonics,
            harmonic_variance=fit.harmonic_variance,
            samples=fit.filled,
            sample_variance=sample_variance,
            duration_s=n * dt,
        )

    def _usable(self, block: Block) -> tuple[NDArray[np.bool_] | None, NDArray[np.bool_] | None] | None:
        """Channels with enough samples, and rows where all of those are valid; None for all.

        None in place of both if that is not enough.
        """
        if block.valid.all():
            return None, None
        least = max(8, math.ceil(MIN_VALID_SHARE * block.n_samples))
        count = np.count_nonzero(block.valid, axis=0)
        live = count >= least
        if not live[self._column]:
            return None
        rows = np.asarray(block.valid[:, live].all(axis=1))
        if np.count_nonzero(rows) < least:
            return None
        return None if live.all() else live, None if rows.all() else rows

    def _converge(
        self, samples: Samples, course: "_Course", start_hz: float | None = None
    ) -> tuple[LockIn, float]:
        """Fit until the reference's phasor stands still; slopes are then told against that frequency."""
        f_mid = course.frequency if start_hz is None else start_hz
        rate = course.rate if start_hz is None else 0.0
        half = 0.5 * samples.duration_s
        for _ in range(MAX_FITS):
            fit = lock_in(samples, course.phase, f_mid, rate)
            amplitude = complex(fit.amplitude[self._column])
            if amplitude == 0.0:
                break
            correction = (complex(fit.slope[self._column]) / amplitude).imag / math.tau
            correction = min(max(correction, -0.5 / half), 0.5 / half)
            if abs(correction) * math.tau * half < SMALL_TURN_RAD:
                fit.slope[:] -= 1j * math.tau * correction * fit.amplitude
                return fit, f_mid + correction
            f_mid = max(f_mid + correction, 1e-3)
        return fit, f_mid

    def _looks_as_before(self, residual: float) -> bool:
        """Whether the reference's residual is no stronger than it was in the blocks before."""
        before = self._residual
        if before is None:
            self._residual = residual
            return True
        self._residual = 0.9 * before + 0.1 * min(residual, SUDDEN_NOISE * before)
        # Without any noise rounding alone is left, and any share of it may come and go.
        return residual <= SUDDEN_NOISE * before or residual < NO_NOISE * self._power

    def _search(self, samples: Samples, band: tuple[float, float]) -> float | None:
        strongest = strongest_hz(samples, self._column, (self._band[0], band[1]))
        return strongest if strongest >= band[0] else None

    def _expected_hz(self, band: tuple[float, float]) -> float:
        """Highest frequency that need be kept when samples are averaged [Hz]."""
        # Twice the tracked one leaves room for a jump; without one to track, all of the band is kept.
        return band[1] if self._course is None else min(1.3 * self._course.frequency, band[1])

    def _cross_gap(self, block: Block, dt: float) -> None:
        if self._next_sample is not None and block.first_sample != self._next_sample:
            lost_s = (block.first_sample - self._next_sample) * dt
            if lost_s > 0.0:
                self._coast(lost_s)
            else:  # another recording
                self._course = None
        self._next_sample = block.end_sample

    def _coast(self, duration_s: float) -> None:
        if self._course is not None:
            self._course.go_on(duration_s)


class _Course:
    """Phase, frequency and sweep rate as they go on: a Kalman filter on the blocks' frequencies."""

    def __init__(self, frequency_hz: float) -> None:
        self.frequency, self.rate, self.phase = frequency_hz, 0.0, 0.0
        self._new = True
        self._variance = np.diag([1.0, NEW_RATE_STD_HZ_S**2])

    def go_on(self, duration_s: float) -> None:
        """Let time pass."""
        d = duration_s
        self.phase += math.tau * (self.frequency + 0.5 * self.rate * d) * d
        self.phase = math.remainder(self.phase, math.tau)
        self.frequency += self.rate * d
        # [1 d; 0 1] V [1 0; d 1] and the walk's covariance, written out.
        V, walk = self._variance, RATE_WALK_HZ_S**2
        both = V[0, 1] + d * V[1, 1]
        self._variance = np.array(
            [
                [V[0, 0] + d * V[0, 1] + d * both + walk * d**3 / 3.0, both + walk * 0.5 * d**2],
                [both + walk * 0.5 * d**2, V[1, 1] + walk * d],
            ]
        )

    def correct(self, frequency_hz: float, std_hz: float, one_tone: bool) -> bool:
        """Take a block's frequency in; returns whether it lies on the course so far.

        A block that does not hold one tone throughout has left it, wherever its frequency lies.
        """
        P = self._variance
        s = P[0, 0] + std_hz**2 + 1e-14
        innovation = frequency_hz - self.frequency
        if not one_tone or abs(innovation) > BREAK_SIGMAS * math.sqrt(s):
            self.frequency, self.rate = frequency_hz, 0.0
            self._variance = np.diag([max(std_hz, 0.1) ** 2, NEW_RATE_STD_HZ_S**2])
            self._new = False
            return False
        gain = P[:, 0] / s
        self.frequency += float(gain[0]) * innovation
        if not self._new:  # the first block's frequency, found by search, has no rate in it
            self.rate += float(gain[1]) * innovation
        self._new = False
        self._variance = P - np.outer(gain, P[0])
        return True


class _RunningColour:
    """Noise at the excitation over that of a white residual, per channel, over the last blocks."""

    def __init__(self, n_channels: int) -> None:
        self._bins = COLOUR_PRIOR_BINS
        self._sum = np.full(n_channels, COLOUR_PRIOR_BINS)

    def take(self, fit: LockIn, duration_s: float) -> Array:
        """Factor on the variances of this block, (p,)."""
        bins = len(fit.steps)
        if bins == 0:
            return self._sum / self._bins
        now = colour(fit)
        before = self._sum / self._bins
        sudden = now > SUDDEN_NOISE * before
        keep = math.exp(-duration_s / COLOUR_MEMORY_S)
        self._bins = keep * self._bins + bins
        # One block of another kind must not be remembered for seconds.
        self._sum = keep * self._sum + bins * np.where(sudden, SUDDEN_NOISE * before, now)
        return np.asarray(np.where(sudden, now, self._sum / self._bins))


def _poor(fit: LockIn, column: int) -> bool:
    power = 0.5 * abs(complex(fit.amplitude[column])) ** 2
    return bool(fit.residual_variance[column] > POOR_FIT * power)
