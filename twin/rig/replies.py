"""What a rig answers to its station: acknowledgements of what was sent, refusals, and who has the controls."""

from typing import Any

from pydantic import ValidationError

from twin.control.schedule import Acknowledgement
from twin.plant.errors import RunError
from twin.rig.complaints import Complaints, first_problem, plain
from twin.rig.wire import ANOTHER_STATION, MAX_SAMPLE, decode

MAX_ANSWER_BYTES = 64 * 1024


class Replies:
    """Reads the rig's answers, and believes none that was not asked for.

    Parameters
    ----------
    complaints
        Where to with what cannot be read.

    Attributes
    ----------
    in_control
        False if the rig has said that another station has the controls.
    events
        What has happened, in words; whoever reads them takes them out.
    acknowledgements
        Answers to commands, in the station's count of samples; whoever reads them takes them out.
    """

    def __init__(self, complaints: Complaints) -> None:
        self._complaints = complaints
        self._unanswered: set[int] = set()
        self.in_control = True
        self.events: list[str] = []
        self.acknowledgements: list[Acknowledgement] = []

    def await_for(self, command_id: int) -> None:
        """Expect an acknowledgement."""
        self._unanswered.add(command_id)

    def take(self, frames: list[bytes], offset: int) -> None:
        """Read one message; ``offset`` is the station's number of the rig's sample 0."""
        try:
            if len(frames) != 1 or len(frames[0]) > MAX_ANSWER_BYTES:
                raise RunError(f"{len(frames)} frames of {sum(map(len, frames))} bytes")
            message = decode(frames[0])
            kind = message.pop("type", "")
            if kind == "ack":
                self._acknowledge(Acknowledgement.model_validate(message, strict=True), offset)
            elif kind == "refused":
                self._refused(plain(message.get("reason", "")))
            elif kind == "controls":
                self.in_control = True
                self.events.append("this station has the controls")
            else:
                raise RunError(f"of type {plain(kind, 20)!r}")
        except ValidationError as error:
            self._complaints.add("an answer of the rig cannot be read", first_problem(error))
        except RunError as error:
            self._complaints.add("an answer of the rig cannot be read", str(error))

    def _acknowledge(self, answer: Acknowledgement, offset: int) -> None:
        at = answer.applied_at_sample
        if answer.command_id not in self._unanswered or not (at is None or 0 <= at <= MAX_SAMPLE):
            self._complaints.add(
                "an acknowledgement of what was not sent", f"command {plain(answer.command_id, 20)}"
            )
            return
        self._unanswered.discard(answer.command_id)
        self.in_control = self.in_control or answer.accepted
        changes: dict[str, Any] = {"reason": plain(answer.reason)}
        if at is not None:
            changes["applied_at_sample"] = at + offset
        self.acknowledgements.append(answer.model_copy(update=changes))

    def _refused(self, reason: str) -> None:
        if ANOTHER_STATION not in reason:
            self._complaints.add("the rig refused a message", reason)
            return
        if self.in_control:
            self.events.append(f"the rig refuses orders of this station: {reason}; it only watches")
        self.in_control = False
