"""What a run tells about gains that were unstable: from where, how it was explained, and which command ended it."""

from dataclasses import dataclass
from typing import Any

from tuning.stability import Instability
from twin.station.frame import Frame


@dataclass(slots=True)
class InstabilityLog:
    """Collected frame by frame.

    Attributes
    ----------
    found
        The instability as first explained.
    """

    found: Instability | None = None
    _latest: Instability | None = None
    _found_hz: float | None = None
    _ordered: int | None = None
    _applied_sample: int | None = None
    _asked_sample: int | None = None
    _removed_by: int | None = None
    _removed_hz: float | None = None
    _largest_m: float | None = None
    _after_m: float | None = None

    def add(self, frame: Frame) -> None:
        """Take one frame in."""
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        answer = None if frame.arrival is None else frame.arrival.answer
        if answer is not None and self._asked_sample is not None:
            self._judge(answer.unstable, self._asked_sample, hz)
        if frame.asked is not None:
            self._asked_sample = frame.block.end_sample - 1
        if self.found is None:
            return
        if frame.command is not None and self._ordered is None:
            self._ordered = frame.command.command_id
        if self._ordered in frame.block.commands_applied:
            self._applied_sample = frame.block.first_sample
        motion = None if frame.performance is None else frame.performance.displacement_m
        if motion is not None and frame.block.control_on:
            if self._applied_sample is None:
                self._largest_m = max(self._largest_m or 0.0, motion)
            else:
                self._after_m = motion

    def _judge(self, unstable: Instability | None, asked_sample: int, hz: float | None) -> None:
        self._latest = unstable or self._latest
        if unstable is not None and self.found is None:
            self.found, self._found_hz = unstable, hz
        applied = self._applied_sample
        if unstable is None and applied is not None and asked_sample >= applied and self._removed_by is None:
            self._removed_by, self._removed_hz = self._ordered, hz

    def figures(self) -> dict[str, Any] | None:
        """Figures by name; None if nothing was unstable.

        The latest word before it was removed counts: the damping is learned as the excitation comes nearer.
        """
        last = self._latest
        if self.found is None or last is None:
            return None
        return {
            "from_hz": last.from_hz,
            "to_hz": last.to_hz,
            "growth_1_s": last.growth_1_s,
            "growth_at_hz": last.worst_hz,
            "explained": last.explanation,
            "found_at_hz": self._found_hz,
            "displacement_before_m": self._largest_m,
            "removed_by_command": self._removed_by,
            "removed_at_hz": self._removed_hz,
            "displacement_after_m": self._after_m,
        }
