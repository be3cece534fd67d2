"""What the estimators hand on: estimates that carry their own uncertainty."""

from dataclasses import dataclass
from typing import Literal

from twin.plant.linear import Array, ComplexArray

DampingStatus = Literal["unestimated", "learning", "estimated", "invalid"]


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

    Attributes
    ----------
    frequency_hz, frequency_std_hz
        Excitation frequency at the block's middle and its standard deviation.
    reference
        Channel whose phase was tracked.
    amplitude
        (n_channels,) complex peak amplitudes at the block's middle, in the channels' SI units, relative to the
        tracked phase.
    slope
        (n_channels,) their rate of change [unit/s].
    variance
        (n_channels,) variance of each complex amplitude, E|error|² [unit²].
    """

    frequency_hz: float
    frequency_std_hz: float
    reference: str
    channels: tuple[str, ...]
    amplitude: ComplexArray
    slope: ComplexArray
    variance: Array


@dataclass(frozen=True, slots=True)
class DampingCurve:
    """Coil damping against frequency as learned, and as used by the model and the tuner.

    Attributes
    ----------
    frequency_hz
        (n,) grid [Hz].
    damping_ns_m, std_ns_m
        (n,) learned value and its standard deviation [Ns/m].
    in_use_ns_m
        (n,) what model and tuner work with: follows the learned value at a limited rate [Ns/m].
    coverage
        (n,) 0..1: how much of the prior variance measurements have removed.
    status
        unestimated | learning | estimated | invalid.
    reason
        Why the learner is not taking this block in; empty when it does.
    stiffness_n_m, stiffness_std_n_m
        Absorber stiffness from the same force balance [N/m]; NaN before the first accepted block.
    """

    frequency_hz: Array
    damping_ns_m: Array
    std_ns_m: Array
    in_use_ns_m: Array
    coverage: Array
    status: DampingStatus
    reason: str
    stiffness_n_m: float
    stiffness_std_n_m: float
