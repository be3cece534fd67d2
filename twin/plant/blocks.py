"""The unit in which measured data moves through the program: a block of samples with its validity."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Channel:
    """One column of a block: a plant's sensor, or an actuator's recorded command."""

    name: str
    unit: str


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive samples of all channels, in SI units.

    Attributes
    ----------
    first_sample
        Index of the first row since the start of the recording; gaps in it are lost data.
    sample_rate_hz
        Samples per second, the same for every channel.
    values
        (n_samples, n_channels) float64, read-only. An invalid sample holds 0, never NaN.
    valid
        (n_samples, n_channels) bool, read-only; False where the sample is missing, not finite or saturated.
    channels
        What the columns are.
    config_id
        Fingerprint of the configuration the block was recorded under.
    control_on
        Whether the rig's controller was acting at the block's end; None where the source cannot know.
    commands_applied
        Identifiers of the commands that took effect at this block's first sample.
    """

    first_sample: int
    sample_rate_hz: float
    values: NDArray[np.float64]
    valid: NDArray[np.bool_]
    channels: tuple[Channel, ...]
    config_id: str = ""
    control_on: bool | None = None
    commands_applied: tuple[int, ...] = field(default=())

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return len(self.values)

    @property
    def end_sample(self) -> int:
        """Index of the first sample after the block."""
        return self.first_sample + len(self.values)

    @property
    def start_s(self) -> float:
        """Time of the first sample since the start of the recording [s]."""
        return self.first_sample / self.sample_rate_hz

    @property
    def end_s(self) -> float:
        """Time just after the last sample [s]."""
        return self.end_sample / self.sample_rate_hz


def make_block(
    first_sample: int,
    sample_rate_hz: float,
    values: NDArray[np.floating],
    channels: tuple[Channel, ...],
    ranges: NDArray[np.float64] | None = None,
    **extra: object,
) -> Block:
    """Build a block from raw samples: what is not finite or at the end of its range becomes invalid.

    Parameters
    ----------
    values
        (n_samples, n_channels) in SI units; NaN and infinities are masked, not passed on.
    ranges
        (n_channels,) largest magnitude each channel can measure, in its SI unit; infinity where unknown.
    extra
        Further fields of `Block`.
    """
    data = np.array(values, dtype=np.float64, order="C")
    valid = np.isfinite(data)
    if ranges is not None:
        # A converter at the end of its range reports the end: such a sample says "at least this much".
        valid &= np.abs(data) < ranges * (1.0 - 1e-6)
    data[~np.isfinite(data)] = 0.0
    data.flags.writeable = False
    valid.flags.writeable = False
    return Block(first_sample, sample_rate_hz, data, valid, channels, **extra)  # type: ignore[arg-type]
