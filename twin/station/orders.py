"""What a person asks of the loop: orders that take effect at a block, are recorded there, and repeat in a replay."""

from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from tuning.retune import TuningGoal
from twin.control.schedule import Command, GainSchedule
from twin.plant.config import Frozen
from twin.station.frame import Decision

OFF_ID_STEP = 1000
"""An emergency stop goes out at once, beside the loop, under a number so far ahead that no command overtakes it."""

OrderKind = Literal["accept", "schedule", "revert", "off", "on", "found"]


class Order(Frozen):
    """One order of the operator.

    Attributes
    ----------
    kind
        ``accept`` a standing proposal, take a ``schedule``, ``revert`` to the gains before, control ``off`` or ``on``;
        ``found``: the rig came back with a schedule of its own.
    number
        Of the proposal that is accepted.
    schedules
        Verified steps on the way to the last of them, which is the one meant.
    goal
        Budget and margins behind the schedule, kept from then on.
    command_id
        Of a command that has gone out already; 0 if it is to be made.
    note
        Words for the log.
    """

    kind: OrderKind
    number: int = Field(default=0, ge=0)
    schedules: tuple[GainSchedule, ...] = Field(default=(), max_length=50)
    goal: TuningGoal | None = None
    command_id: int = Field(default=0, ge=0)
    note: str = Field(default="", max_length=200)


@dataclass(frozen=True, slots=True)
class Ordered:
    """What came of an order, or of the next step of one.

    Attributes
    ----------
    order
        None for a further step.
    decision
        Whether it was taken, and if not, why not.
    command
        To be sent; None if nothing is.
    """

    order: Order | None
    decision: Decision
    command: Command | None
