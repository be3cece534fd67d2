"""What a session learns of the absorber: excitation, force balance, damping curve, and the plant that has it."""

import math
from collections.abc import Sequence

from estimators.damping import AbsorberBalance, DampingLearner, ForceBalance
from estimators.excitation import ExcitationTracker, choose_reference
from estimators.health import Health
from estimators.signal_check import Finding
from estimators.types import DampingCurve, Phasors
from twin.plant.blocks import Block
from twin.plant.config import DampingTable, Plant
from twin.plant.errors import InputError
from twin.station.settings import SessionSettings

SETTLE_BLOCKS = 3
"""Blocks not learned from after the controller went on or off."""

UNKNOWN_NS_M = 1.0
"""Where the damping is less well known than this, an inconsistent model is no reason not to learn it."""

REPRIEVE_S = 3.0
"""A model that disagrees this long while the absorber's own force balance closes may be cured by learning."""

STIFFNESS_SHARE = 0.005
"""The force balance closes if the stiffness it gives has moved by no more than this share of it."""


class Identification:
    """Learns a plant's damping block by block, where the plant and its channels let it.

    Parameters
    ----------
    plant
        To start from.
    names
        Of a block's columns.
    settings
        Of the learner, and what was learned before.

    Attributes
    ----------
    tracker, learner
        None where there is no absorber with a coil, or its motion, its current or what excites it is not recorded.

    Raises
    ------
    InputError
        If what was learned before is not of such a plant.
    """

    def __init__(self, plant: Plant, names: tuple[str, ...], settings: SessionSettings) -> None:
        self._start = self._plant = plant
        self._table: DampingTable | None = None
        self._balance: AbsorberBalance | None = None
        self.tracker: ExcitationTracker | None = None
        self.learner: DampingLearner | None = None
        try:
            balance = AbsorberBalance(plant, names)
        except ValueError:
            return
        reference = choose_reference(plant, names)
        if reference is None:
            return
        self._balance, self.tracker = balance, ExcitationTracker(reference, names)
        self.learner = _learner(plant, settings)

    @property
    def plant(self) -> Plant:
        """The plant with the damping in use; the same object for as long as that is the same."""
        absorber, learner = self._start.absorber, self.learner
        if learner is None or absorber is None:
            return self._start
        table = learner.table()
        if table is not self._table:
            self._table, self._plant = table, self._start.with_damping(absorber.name, table)
        return self._plant

    def damping_at(self, frequency_hz: float) -> float:
        """Damping in use at a frequency [Ns/m]; 0 where none is learned."""
        return 0.0 if self.learner is None else self.learner.in_use_at(frequency_hz)

    def std_at(self, frequency_hz: float) -> float:
        """Standard deviation of the learned damping at a frequency [Ns/m]; 0 where none is learned."""
        return 0.0 if self.learner is None else self.learner.std_at(frequency_hz)

    def learn(
        self,
        block: Block,
        phasors: Phasors | None,
        findings: Sequence[Finding],
        health: Health,
        frequency_hz: float,
        since_switch: int,
    ) -> DampingCurve | None:
        """Take one block in, unless something speaks against it; the curve afterwards.

        Parameters
        ----------
        findings, health
            What was masked in the block, and whether the model agrees with it.
        frequency_hz
            Of the excitation, as far as known.
        since_switch
            Blocks since the controller was last switched on or off.
        """
        if self.learner is None or self._balance is None:
            return None
        balance = self._balance.solve(phasors) if phasors is not None else None
        objection = ""
        if since_switch < SETTLE_BLOCKS:
            objection = "control has just been switched"
        elif findings:
            names = dict.fromkeys(f"{f.channel} ({f.kind})" for f in findings)
            objection = f"samples masked in {', '.join(names)}"
        elif health.verdict != "consistent":
            objection = self._distrust(self.learner, block, health, balance, frequency_hz)
        return self.learner.advance(balance, block.n_samples / block.sample_rate_hz, objection)

    def _distrust(
        self,
        learner: DampingLearner,
        block: Block,
        health: Health,
        balance: ForceBalance | None,
        frequency_hz: float,
    ) -> str:
        """Why an inconsistent model speaks against learning; empty where learning may be the cure."""
        absorber = self._start.absorber
        if absorber is None or health.test in ("signal", "noise", "bias"):
            return health.reason
        if learner.std_at(frequency_hz) > UNKNOWN_NS_M:
            return ""
        known = learner.curve().stiffness_n_m
        known = known if math.isfinite(known) else absorber.stiffness_n_m
        closes = balance is not None and abs(balance.stiffness_n_m - known) <= (
            STIFFNESS_SHARE * known + 5.0 * balance.stiffness_std_n_m
        )
        lasts_s = (block.end_sample - health.since_sample) / block.sample_rate_hz
        return "" if closes and lasts_s > REPRIEVE_S else health.reason


def _learner(plant: Plant, settings: SessionSettings) -> DampingLearner:
    if settings.learned is None:
        return DampingLearner(plant, settings.learner)
    try:
        return DampingLearner.restored(settings.learned, plant)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"what was learned before cannot be used ({error}); begin without it") from error
