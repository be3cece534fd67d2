"""Blocks as they arrive from a rig, put in order: what is lost is masked, what comes twice or too late is dropped.

Pure bookkeeping, without a socket or a clock, so that every fault of a wire can be played to it.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from twin.plant.blocks import Block, make_block
from twin.plant.errors import RunError

REMEMBERED = 64
"""Sequence numbers remembered, to tell a repeated block from a late one."""

MAX_GAP_S = 600.0
"""A longer silence is not filled with masked samples: it is another run."""


@dataclass(slots=True)
class ArrivalCounts:
    """What the wire has done to the blocks so far.

    Attributes
    ----------
    received
        Blocks handed on with their samples.
    lost
        Blocks that never came, or came too late; their samples are masked.
    late
        Blocks that came after their place had been masked.
    repeated
        Blocks that came a second time.
    reordered
        Blocks that overtook another by one place and were put back.
    """

    received: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    reordered: int = 0


class Arrivals:
    """Turn what arrives into consecutive blocks.

    One block that is ahead of its turn is held until the next one arrives: if that is the missing one both go on
    in order, else the gap is masked.

    Attributes
    ----------
    counts
        `ArrivalCounts`.
    next_sample
        First sample that has not been handed on; None before the first block.
    """

    def __init__(self) -> None:
        self.counts = ArrivalCounts()
        self.next_sample: int | None = None
        self._seen: deque[int] = deque(maxlen=REMEMBERED)
        self._held: Block | None = None

    def take(self, block: Block, sequence: int) -> Iterator[Block]:
        """Hand on what is due now that this block has arrived.

        Parameters
        ----------
        sequence
            The rig's running number of the block.

        Raises
        ------
        RunError
            If the gap before the block is longer than `MAX_GAP_S`.
        """
        if sequence in self._seen:
            self.counts.repeated += 1
            return
        self._seen.append(sequence)
        if self.next_sample is None:
            self.next_sample = block.first_sample
        if block.first_sample < self.next_sample:
            self.counts.late += 1
            return
        held, self._held = self._held, None
        if held is None:
            if block.first_sample == self.next_sample:
                yield self._pass_on(block)
            else:
                self._held = block
            return
        first, second = (held, block) if held.first_sample <= block.first_sample else (block, held)
        if first is block:
            self.counts.reordered += 1
        yield from self._mask_until(first)
        yield self._pass_on(first)
        if second.first_sample == self.next_sample:
            yield self._pass_on(second)
        elif second.first_sample > self.next_sample:
            self._held = second
        else:
            self.counts.late += 1

    def flush(self) -> Iterator[Block]:
        """Hand on what is still held: nothing more will come."""
        held, self._held = self._held, None
        if held is not None:
            yield from self._mask_until(held)
            yield self._pass_on(held)

    def _pass_on(self, block: Block) -> Block:
        self.counts.received += 1
        self.next_sample = block.end_sample
        return block

    def _mask_until(self, block: Block) -> Iterator[Block]:
        """Blocks of the usual length without a valid sample, up to the given one."""
        first = self.next_sample if self.next_sample is not None else block.first_sample
        missing = block.first_sample - first
        if missing > MAX_GAP_S * block.sample_rate_hz:
            raise RunError(
                f"the rig was away for {missing / block.sample_rate_hz:.0f} s; start again for a new recording"
            )
        while first < block.first_sample:
            n = min(block.n_samples, block.first_sample - first)
            self.counts.lost += 1
            empty = np.full((n, len(block.channels)), np.nan)
            yield make_block(first, block.sample_rate_hz, empty, block.channels, config_id=block.config_id)
            first += n
