"""What the estimators hand on: estimates that carry their own uncertainty."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from twin.plant.linear import Array, ComplexArray

DampingStatus = Literal["unestimated", "learning", "estimated", "invalid"]

UNKNOWN_ANGLE_STD_RAD = np.pi / np.sqrt(3.0)
"""Standard deviation of an angle of which nothing is known: uniform over the circle."""


@dataclass(frozen=True, slots=True)
class StateEstimate:
    """The observer's result over one block.

    Innovations are sequential: each sensor's is what it says beyond the prediction and the sensors before it in the
    same sample. Of a consistent filter they are white and independent from sensor to sensor, with the variances that
    the filter expects. Statistics over the block are NaN for a sensor without a valid sample in it.

    Attributes
    ----------
    states
        Names of the states, with units m, m/s and A by their prefix x, v and i.
    mean
        (n_samples, n_states) filtered mean after each sample.
    covariance
        (n_states, n_states) at the block's last sample.
    innovation_rms, innovation_std
        (n_sensors,) root mean square of the innovations over the block and what the filter expected of it,
        in the sensors' units.
    nis
        Mean normalised innovation squared per valid scalar measurement: 1 for a consistent filter.
    sensors
        Names of the sensors that were used.
    innovation_count
        (n_sensors,) valid samples.
    innovation_mean
        (n_sensors,) mean innovation in the sensors' units: 0 for a filter without bias.
    innovation_lag1
        (n_sensors,) autocorrelation coefficient of the normalised innovations, about their mean, from one valid
        sample to the next: 0 for a consistent filter, with standard deviation 1/sqrt(count). NaN where no two
        consecutive samples were valid.
    nis_per_sensor
        (n_sensors,) mean normalised innovation squared of each sensor: count times it is chi-squared with
        count degrees of freedom.
    prediction_rms
        (n_sensors,) root mean square of the one-step prediction error before any sensor of the sample is used, in
        the sensors' units; equal to ``innovation_rms`` for the first sensor.
    """

    states: tuple[str, ...]
    mean: Array
    covariance: Array
    innovation_rms: Array
    innovation_std: Array
    nis: float
    sensors: tuple[str, ...]
    innovation_count: Array
    innovation_mean: Array
    innovation_lag1: Array
    nis_per_sensor: Array
    prediction_rms: Array


@dataclass(frozen=True, slots=True)
class Phasors:
    """Complex amplitudes of every channel at the excitation frequency over one block.

    Amplitudes are peak values at the block's middle in the channels' SI units, relative to the tracked phase; each
    variance is that of a complex number, E|error|² [unit²]. A channel with too few valid samples has an amplitude of
    0 and infinite variance.

    Attributes
    ----------
    frequency_hz, frequency_std_hz
        Excitation frequency at the block's middle and its standard deviation.
    sweep_rate_hz_s
        How fast the frequency moves.
    steady
        Whether the frequency lies on the course of the blocks before: False in a block with a jump or a new tone.
    reference
        Channel whose phase was tracked.
    amplitude, variance
        (n_channels,).
    slope, slope_variance
        (n_channels,) rate of change of the amplitude [unit/s].
    harmonic_orders
        Multiples of the excitation frequency that were fitted; those beyond the sample rate's reach are not.
    harmonics, harmonic_variance
        (n_orders, n_channels) amplitudes at these multiples, relative to as many times the tracked phase.
    samples, sample_variance
        (n_samples, n_channels) of the block, averaged in groups, and the noise variance of
        one of them (n_channels,): for equations of motion that must hold in transients too.
    duration_s
        Of the block.
    """

    frequency_hz: float
    frequency_std_hz: float
    sweep_rate_hz_s: float
    steady: bool
    reference: str
    channels: tuple[str, ...]
    amplitude: ComplexArray
    slope: ComplexArray
    variance: Array
    slope_variance: Array
    harmonic_orders: tuple[int, ...]
    harmonics: ComplexArray
    harmonic_variance: Array
    samples: Array
    sample_variance: Array
    duration_s: float

    @property
    def amplitude_std(self) -> Array:
        """(n_channels,) standard deviation of the amplitudes' magnitudes."""
        return np.sqrt(0.5 * self.variance)

    @property
    def phase_std_rad(self) -> Array:
        """(n_channels,) standard deviation of the amplitudes' angles, at most that of an unknown one."""
        size = np.abs(self.amplitude)
        known = size > self.amplitude_std
        ratio = self.amplitude_std[known] / size[known]
        std = np.full(len(size), UNKNOWN_ANGLE_STD_RAD)
        std[known] = np.minimum(ratio, UNKNOWN_ANGLE_STD_RAD)
        return std

    def distortion_of(self, channel: str) -> float:
        """Total harmonic distortion of one channel, as `distortion` has it for all."""
        column = self.channels.index(channel)
        size, noise = abs(complex(self.amplitude[column])), sum(self.harmonic_variance[:, column].tolist())
        if not (math.isfinite(noise) and size > 0.0):
            return 0.0
        power = sum(abs(h) ** 2 for h in self.harmonics[:, column].tolist())
        return math.sqrt(max(power - noise, 0.0)) / size

    def distortion(self) -> tuple[Array, Array]:
        """Total harmonic distortion: r.m.s. of the fitted harmonics over the fundamental, noise taken off.

        Returns
        -------
        thd, std
            (n_channels,) each, 1 for a harmonic as large as the fundamental; 0 with an infinite standard
            deviation where there is no fundamental.
        """
        power = np.sum(np.abs(self.harmonics) ** 2, axis=0)
        noise = np.sum(self.harmonic_variance, axis=0)
        size = np.abs(self.amplitude)
        seen = np.isfinite(noise) & (size > 0.0)
        spread = np.sqrt(
            np.sum(
                (2.0 * np.abs(self.harmonics) ** 2 + self.harmonic_variance) * self.harmonic_variance, axis=0
            )
        )
        rms = np.sqrt(np.maximum(power - noise, 0.0)) if seen.all() else np.zeros(len(size))
        rms[seen] = np.sqrt(np.maximum(power[seen] - noise[seen], 0.0))
        thd, std = np.zeros(len(size)), np.full(len(size), np.inf)
        thd[seen] = rms[seen] / size[seen]
        # d sqrt(P) = dP / (2 sqrt(P)), and near nothing no more than sqrt(dP).
        std[seen] = spread[seen] / np.maximum(2.0 * rms[seen], np.sqrt(spread[seen]) + 1e-300) / size[seen]
        return thd, std


@dataclass(frozen=True, slots=True)
class DampingCurve:
    """Coil damping against frequency as learned, and as used by the model and the tuner.

    Attributes
    ----------
    frequency_hz
        (n,) grid [Hz].
    damping_ns_m, std_ns_m
        (n,) learned value and its standard deviation [Ns/m], doubt about the channels' delays included.
    noise_std_ns_m
        (n,) the part of it that is noise and averages away [Ns/m].
    in_use_ns_m
        (n,) what model and tuner work with: follows the learned value at a limited rate [Ns/m].
    coverage
        (n,) 0..1: how much of the prior variance measurements have removed.
    status
        unestimated | learning | estimated | invalid.
    progress
        0..1: 1 when the damping is known as well as wanted in the wanted band.
    reason
        Why the learner is not taking this block in; empty when it does.
    stiffness_n_m, stiffness_std_n_m
        Absorber stiffness from the same force balance, where the excitation last was [N/m]; NaN before the first
        accepted block.
    stiffness_curve_n_m, stiffness_curve_std_n_m
        (n,) the same against frequency.
    """

    frequency_hz: Array
    damping_ns_m: Array
    std_ns_m: Array
    noise_std_ns_m: Array
    in_use_ns_m: Array
    coverage: Array
    status: DampingStatus
    progress: float
    reason: str
    stiffness_n_m: float
    stiffness_std_n_m: float
    stiffness_curve_n_m: Array
    stiffness_curve_std_n_m: Array
