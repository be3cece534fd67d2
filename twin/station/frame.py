"""What one turn of the loop produced, for whoever shows or keeps it."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from estimators.health import Health
from estimators.signal_check import CheckedBlock
from estimators.types import DampingCurve, Phasors, StateEstimate
from tuning.types import Powers, Proposal
from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.plant.linear import Array

if TYPE_CHECKING:
    from twin.station.audit import AuditPoint
    from twin.station.orders import Ordered
    from twin.station.worker import Arrival


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth a line in the log."""

    sample: int
    level: Literal["info", "warning", "error"]
    text: str


UNCHANGED = "too small a change"
STANDS = "waits for the operator"
ROUTINE = (UNCHANGED, STANDS)
"""Reasons of decisions that are kept but not worth a person's attention."""


@dataclass(frozen=True, slots=True)
class Decision:
    """What became of a proposal, and who said so."""

    sample: int
    accepted: bool
    by: Literal["automatic", "operator"]
    reason: str


@dataclass(frozen=True, slots=True)
class Performance:
    """How the block went, at the excitation frequency.

    Displacements are peak amplitudes [m] of the primary body: measured, predicted by the model without
    control, and the least any linear controller can reach; NaN where the plant or the data cannot tell.
    """

    displacement_m: float
    passive_m: float
    limit_m: float
    current_peak_a: float
    powers: Powers
    budget_w: float


@dataclass(frozen=True, slots=True)
class Frame:
    """One block and everything the twin made of it.

    Attributes
    ----------
    block, checked
        As it came, and as the estimators took it: with what cannot be trusted masked.
    twin
        (n_samples, n_sensors) outputs of the plant in parallel, stepped from the measured inputs alone, in
        the order of ``estimate.sensors``.
    estimate
        The observer's.
    health
        Whether model and rig agree, and who says that they do not.
    asked, arrival
        Number of the question asked of the tuner after this block, and what was taken of it at this block.
    audited
        What the gains in use were promised to do at an earlier block, beside what they did.
    ordered
        What came of the operator's order.
    force_n
        Amplitude of the exciting force where nothing measures it, and its standard deviation [N].
    phasors, curve, performance
        None where the plant has no such part or the block no excitation.
    """

    block: Block
    checked: CheckedBlock
    twin: Array
    estimate: StateEstimate
    health: Health
    phasors: Phasors | None
    curve: DampingCurve | None
    performance: Performance | None
    proposal: Proposal | None
    decision: Decision | None
    command: Command | None
    acknowledgements: tuple[Acknowledgement, ...]
    events: tuple[Event, ...]
    asked: int | None = None
    arrival: "Arrival | None" = None
    audited: "AuditPoint | None" = None
    ordered: "Ordered | None" = None
    force_n: tuple[float, float] | None = None

    @property
    def commands(self) -> tuple[Command, ...]:
        """Commands that this block led to."""
        ordered = None if self.ordered is None else self.ordered.command
        return tuple(c for c in (ordered, self.command) if c is not None)

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Decisions made after this block."""
        ordered = None if self.ordered is None else self.ordered.decision
        return tuple(d for d in (ordered, self.decision) if d is not None)
