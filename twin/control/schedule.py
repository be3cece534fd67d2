"""What the rig's controller runs by: gains and cutoffs against excitation frequency, and when to act."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from twin.plant.config import Frozen, Positive


@dataclass(frozen=True, slots=True)
class Gains:
    """One operating point of the law ``f = alpha x_r'' + beta x_r' + gamma x_r`` and of its filters.

    Attributes
    ----------
    alpha_kg, beta_ns_m, gamma_n_m
        Gains on relative acceleration, velocity and position [kg, Ns/m, N/m].
    low_pass_hz, high_pass_hz
        Cutoffs of the 2nd-order Butterworth filters [Hz].
    """

    alpha_kg: float
    beta_ns_m: float
    gamma_n_m: float
    low_pass_hz: float
    high_pass_hz: float

    def as_tuple(self) -> tuple[float, float, float, float, float]:
        """All five numbers in the order of the attributes."""
        return (self.alpha_kg, self.beta_ns_m, self.gamma_n_m, self.low_pass_hz, self.high_pass_hz)


class GainSchedule(Frozen):
    """Gains and cutoffs over excitation frequency; linear between points, held beyond the ends.

    The controller acts only while the excitation is inside ``[on_from_hz, on_to_hz]``; a schedule that
    reaches outside its table is refused when it is built.
    """

    frequency_hz: tuple[Positive, ...] = Field(min_length=1)
    alpha_kg: tuple[float, ...]
    beta_ns_m: tuple[float, ...]
    gamma_n_m: tuple[float, ...]
    low_pass_hz: tuple[Positive, ...]
    high_pass_hz: tuple[Positive, ...]
    on_from_hz: Positive
    on_to_hz: Positive

    @model_validator(mode="after")
    def _rows_pair_up(self) -> Self:
        n = len(self.frequency_hz)
        for name in ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz"):
            if len(getattr(self, name)) != n:
                raise ValueError(
                    f"{name} has {len(getattr(self, name))} points, frequency_hz has {n}; give one each"
                )
        if any(b <= a for a, b in pairwise(self.frequency_hz)):
            raise ValueError("frequency_hz must rise from point to point [Hz]")
        if self.on_from_hz > self.on_to_hz:
            raise ValueError("on_from_hz must not be above on_to_hz [Hz]")
        if self.on_from_hz < self.frequency_hz[0] or self.on_to_hz > self.frequency_hz[-1]:
            raise ValueError(
                f"the controller would act from {self.on_from_hz:g} to {self.on_to_hz:g} Hz but the table has gains "
                f"from {self.frequency_hz[0]:g} to {self.frequency_hz[-1]:g} Hz; add points or narrow the band"
            )
        return self

    def at(self, frequency_hz: float) -> Gains:
        """Gains and cutoffs at one excitation frequency [Hz]."""
        columns = (self.alpha_kg, self.beta_ns_m, self.gamma_n_m, self.low_pass_hz, self.high_pass_hz)
        return Gains(*(float(np.interp(frequency_hz, self.frequency_hz, column)) for column in columns))

    def acts_at(self, frequency_hz: float) -> bool:
        """Whether the controller is on at this excitation frequency [Hz]."""
        return self.on_from_hz <= frequency_hz <= self.on_to_hz

    def with_points(self, points: dict[int, Gains]) -> Self:
        """Return a copy in which some rows of the table are replaced."""
        columns = {
            name: tuple(
                getattr(points[k], name) if k in points else old for k, old in enumerate(getattr(self, name))
            )
            for name in ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
        }
        return self.model_copy(update=columns)


class Command(Frozen):
    """An order to the rig. It takes effect at the first sample of a block, never inside one.

    Attributes
    ----------
    command_id
        Counts up from 1 within a run.
    apply_at_sample
        First sample it may act on; a rig that gets it later applies it at its next block and says so.
    schedule
        The controller's new schedule; None leaves it as it is.
    control_enabled
        False switches the controller off whatever the schedule says; None leaves it as it is.
    config_id
        Fingerprint of the plant the command was made for; a rig set up for another refuses it. Empty: any.
    """

    command_id: int = Field(ge=1)
    apply_at_sample: int = Field(ge=0)
    schedule: GainSchedule | None = None
    control_enabled: bool | None = None
    config_id: str = Field(default="", max_length=200)


class Acknowledgement(Frozen):
    """The rig's answer to a command."""

    command_id: int
    accepted: bool
    applied_at_sample: int | None = None
    reason: str = ""
