"""What every run of the loop does with a block, whether it comes from a rig or from a file."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.station.frame import Event, Frame
from twin.station.orders import Order, Ordered
from twin.station.outputs import Outputs
from twin.station.session import Session
from twin.station.summary import RunLog


class Link(Protocol):
    """The way to a rig; `twin.rig.gateway.RigGateway` is one."""

    def acknowledgements(self) -> tuple[Acknowledgement, ...]:
        """What the rig has answered since the last call."""

    def send(self, command: Command) -> None:
        """Send a command."""

    def heartbeat(self, next_sample: int) -> None:
        """Say how far the data have been worked through."""


class Desk(Protocol):
    """Where a person sits: orders come from there, frames are shown there. Nothing here ever waits for it."""

    def order(self) -> Order | None:
        """Return the next order, if there is one."""

    def remarks(self) -> tuple[str, ...]:
        """What the log should say of the desk since the last call."""

    def show(self, frame: Frame, in_loop_s: float) -> None:
        """Show a frame, which took so long to work out."""


@dataclass(slots=True)
class Loop:
    """Takes block after block through a session, to rig, recording and views.

    Attributes
    ----------
    link
        To the rig; None for a recording.
    desk
        The operator's, if there is one.
    remarks
        What the connection has to say since the last block, for the log.
    in_loop_s
        Time spent in the loop.
    """

    session: Session
    outputs: Outputs
    link: Link | None = None
    desk: Desk | None = None
    remarks: Callable[[], tuple[str, ...]] = tuple
    log: RunLog = field(default_factory=RunLog)
    in_loop_s: float = 0.0

    def turn(
        self,
        block: Block,
        recorded: tuple[Acknowledgement, ...] = (),
        order: Order | None = None,
    ) -> Frame:
        """Take one block through everything.

        Parameters
        ----------
        recorded
            Acknowledgements of a recording.
        order
            Of a recording, or of the program's own; else the desk is asked.

        Raises
        ------
        RunError
            If the recording can no longer be written.
        """
        began = time.perf_counter()
        link, desk = self.link, self.desk
        if order is None and desk is not None:
            order = desk.order()
        answers = recorded if link is None else link.acknowledgements()
        frame = self.session.advance(block, answers, order)
        if link is not None:
            for command in frame.commands:
                if not _has_gone_out(frame.ordered, command):
                    link.send(command)
            link.heartbeat(block.end_sample)
        said = (*self.remarks(), *(() if desk is None else desk.remarks()))
        if said:
            events = tuple(Event(block.end_sample - 1, "warning", text) for text in said)
            frame = replace(frame, events=(*frame.events, *events))
        self.outputs.take(frame)
        self.log.add(frame)
        spent = time.perf_counter() - began
        if desk is not None:
            desk.show(frame, spent)
        self.in_loop_s += time.perf_counter() - began
        return frame

    @property
    def realtime_factor(self) -> float | None:
        """Time of the data over time in the loop."""
        rate = self.session.observer.sample_rate_hz
        return self.log.samples / rate / self.in_loop_s if self.in_loop_s else None


def _has_gone_out(ordered: Ordered | None, command: Command) -> bool:
    """Whether a command was sent beside the loop: an emergency stop."""
    return (
        ordered is not None and ordered.order is not None and ordered.order.command_id == command.command_id
    )
