"""What the fits hand on: modes and other estimates with their standard deviations."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Mode:
    """A mode of vibration.

    Attributes
    ----------
    frequency_hz, frequency_std_hz
        Undamped natural frequency |λ|/2π and its standard deviation [Hz].
    damping_ratio, damping_std
        -Re λ/|λ| and its standard deviation.
    """

    frequency_hz: float
    damping_ratio: float
    frequency_std_hz: float
    damping_std: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """A number with its standard deviation.

    Attributes
    ----------
    value, std
        In the same unit.
    """

    value: float
    std: float

    @property
    def interval_95(self) -> tuple[float, float]:
        """Interval that holds the truth in 95 of 100 repetitions, by the normal distribution."""
        return self.value - 1.96 * self.std, self.value + 1.96 * self.std
