"""When gains are asked for, and which of them are worth a command."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tuning.step import stiffness_terms
from twin.control.schedule import Gains, GainSchedule

COMMAND_LEAD_BLOCKS = 2
"""A command is due this many blocks after the one that led to it: time for it to reach the rig."""

GROWTH_BLOCKS = 10
"""Growth is measured over so many blocks."""

MAX_AHEAD_HZ = 3.0
"""A jump of the excitation is no sweep: no more of the table than this is retuned ahead of it."""


@dataclass(frozen=True, slots=True)
class RetuningSettings:
    """When gains are asked for, and which of them become commands.

    Attributes
    ----------
    every_blocks
        How often proposals are asked for, if the last answer is there and no command on its way.
    lag_blocks
        Blocks from question to answer where the data can wait for the twin; a live rig takes answers as they come.
    outdated_ns_m
        A proposal is dropped if the damping in use at one of its points has moved this far since the question.
    min_change
        A point's gains are worth a command if one of the law's terms moves by this share of the table's largest.
    reversal
        And by so many times more where they would turn back on their last step: estimates scatter, plants drift.
    longest_step
        How far one command may move any of the law's terms, as a share of the absorber's stiffness.
    only_if_unstable
        Keep the gains in use for as long as they are stable.
    only_if_growing_1_s
        And, with that, until the coil's current reference is seen to grow this fast; 0 does not wait for it.
    approve
        Proposals stand until the operator accepts them: nothing becomes a command by itself.
    """

    every_blocks: int = 5
    lag_blocks: int = 1
    outdated_ns_m: float = 0.6
    min_change: float = 1e-3
    reversal: float = 4.0
    longest_step: float = 0.2
    only_if_unstable: bool = False
    only_if_growing_1_s: float = 0.0
    approve: bool = False

    def look_ahead_hz(self, moved_hz: float) -> float:
        """How far the excitation moves until the proposal after this one takes effect [Hz].

        Parameters
        ----------
        moved_hz
            How far it moved over a block [Hz].
        """
        blocks = self.every_blocks + self.lag_blocks + COMMAND_LEAD_BLOCKS + 1
        return min(max(moved_hz * blocks, -MAX_AHEAD_HZ), MAX_AHEAD_HZ)


class ReferenceGrowth:
    """How fast the coil's current reference grows: what an unstable loop shows before anything else."""

    def __init__(self) -> None:
        self._rms: deque[float] = deque(maxlen=GROWTH_BLOCKS)
        self._block_s = 0.1

    def add(self, rms: float, block_s: float) -> None:
        """Take in a block's root mean square [A] and its length [s]."""
        self._rms.append(rms)
        self._block_s = block_s

    @property
    def rate_1_s(self) -> float:
        """Rate of growth over the last blocks [1/s]; 0 while there are too few, or nothing flows."""
        rms = self._rms
        if len(rms) < GROWTH_BLOCKS or min(rms) <= 0.0:
            return 0.0
        return float(np.polyfit(np.arange(len(rms)) * self._block_s, np.log(rms), 1)[0])


class StepJudge:
    """Tells steps of the gains that are worth a command from those that estimates' scatter brings.

    Parameters
    ----------
    settings
        Least change, and how much more where a step would undo the last one.
    """

    def __init__(self, settings: RetuningSettings) -> None:
        self._settings = settings
        self._last: dict[int, tuple[float, ...]] = {}

    def is_worth_it(self, schedule: GainSchedule, row: int, gains: Gains) -> bool:
        """Whether a point's step stands out from the table in use, more so where it would undo the last one."""
        step = step_shares(schedule, row, gains)
        before = self._last.get(row, step)
        turns_back = sum(a * b for a, b in zip(step, before, strict=True)) < 0.0
        least = self._settings.min_change * (self._settings.reversal if turns_back else 1.0)
        return max(map(abs, step)) > least

    def taken(self, schedule: GainSchedule, steps: Mapping[int, Gains]) -> None:
        """Remember steps that became a command."""
        for row, gains in steps.items():
            self._last[row] = step_shares(schedule, row, gains)


def step_shares(schedule: GainSchedule, row: int, gains: Gains) -> tuple[float, ...]:
    """Change of the law's terms and cutoffs at a point of the table, as shares of the largest there."""
    s = schedule
    w = math.tau * np.array(s.frequency_hz)
    table = np.stack([np.array(s.alpha_kg) * w**2, np.array(s.beta_ns_m) * w, np.array(s.gamma_n_m)])
    largest = float(np.abs(table).max()) or 1.0
    new = stiffness_terms(gains, s.frequency_hz[row])
    terms = [(after - float(before)) / largest for before, after in zip(table[:, row], new, strict=True)]
    cutoffs = [
        gains.low_pass_hz / s.low_pass_hz[row] - 1.0,
        gains.high_pass_hz / s.high_pass_hz[row] - 1.0,
    ]
    return (*terms, *cutoffs)
