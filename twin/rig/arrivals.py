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
"""Blocks remembered, to tell a repeated one from a late one."""

MOST_AHEAD = 16
"""Blocks ahead of their turn that are held; of more, the one that claims to be farthest ahead goes."""

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
        Times that a block came after one that follows it, and was put back.
    stray
        Blocks whose number and place contradict each other or those of all others; left out.
    """

    received: int = 0
    lost: int = 0
    late: int = 0
    repeated: int = 0
    reordered: int = 0
    stray: int = 0


@dataclass(frozen=True, slots=True)
class _Ahead:
    sequence: int
    block: Block

    def agrees_with(self, other: "_Ahead") -> bool:
        """Whether both can be of one run: as far apart in samples as in numbers."""
        first, second = (self, other) if self.sequence < other.sequence else (other, self)
        apart = second.sequence - first.sequence
        return (
            0 < apart <= REMEMBERED
            and second.block.first_sample == first.block.first_sample + apart * first.block.n_samples
        )


class Arrivals:
    """Turn what arrives into consecutive blocks.

    A block that is not the next one is held until another one agrees with it on where the run is: a header that was
    garbled must not carry the run to another place. If what was missing arrives in the meantime all go on in order,
    else the gap is masked. The first of a run needs such a witness, too, unless it is number 0.

    Parameters
    ----------
    origin
        Sample that the run's sample 0 is.
    next_sample
        First sample wanted, if there was a run before; else the run begins where its first block lies.

    Attributes
    ----------
    counts
        `ArrivalCounts`.
    next_sample
        First sample that has not been handed on; None before the first block.
    """

    def __init__(self, origin: int = 0, next_sample: int | None = None) -> None:
        self.counts = ArrivalCounts()
        self.next_sample = next_sample
        self._origin = origin
        self._next_sequence: int | None = None
        self._seen: deque[tuple[int, int]] = deque(maxlen=REMEMBERED)
        self._ahead: list[_Ahead] = []

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
        place = (sequence, block.first_sample)
        if place in self._seen or any(place == (a.sequence, a.block.first_sample) for a in self._ahead):
            self.counts.repeated += 1
            return
        arrived = _Ahead(sequence, block)
        if self._next_sequence is None and sequence == 0 and block.first_sample == self._origin:
            yield from self._go_on_at(arrived)
        elif self._is_next(arrived):
            yield self._pass_on(arrived)
            handed_on = self.counts.received
            yield from self._drain()
            self.counts.reordered += self.counts.received > handed_on
        elif self._next_sequence is None or self._lies_ahead(arrived):
            yield from self._hold(arrived)
        elif sequence < self._next_sequence and block.first_sample < (self.next_sample or 0):
            self.counts.late += 1
        else:
            self.counts.stray += 1

    def flush(self) -> Iterator[Block]:
        """Hand on what is still held and fits: nothing more will come."""
        while self._ahead:
            first = min(self._ahead, key=lambda a: a.block.first_sample)
            self._ahead.remove(first)
            n, following, number = first.block.n_samples, self.next_sample, self._next_sequence
            fits = (
                number is None
                or following is None
                or first.block.first_sample - following == (first.sequence - number) * n
            )
            if fits:
                yield from self._go_on_at(first)
            else:
                self.counts.stray += 1

    @property
    def due_sample(self) -> int | None:
        """Where the run would end if nothing more came: after what is held in line."""
        due, number = self.next_sample, self._next_sequence
        for a in sorted(self._ahead, key=lambda a: a.sequence):
            n = a.block.n_samples
            if due is None or number is None or a.block.first_sample - due == (a.sequence - number) * n:
                due, number = a.block.end_sample, a.sequence + 1
        return due

    def _is_next(self, arrived: _Ahead) -> bool:
        return (arrived.sequence, arrived.block.first_sample) == (self._next_sequence, self.next_sample)

    def _lies_ahead(self, arrived: _Ahead) -> bool:
        following, number = self.next_sample, self._next_sequence
        return (
            following is not None
            and number is not None
            and arrived.block.first_sample > following
            and arrived.sequence >= number
        )

    def _hold(self, arrived: _Ahead) -> Iterator[Block]:
        witness = next((a for a in self._ahead if a.agrees_with(arrived)), None)
        self._ahead.append(arrived)
        if witness is None:
            if len(self._ahead) > MOST_AHEAD:
                self._ahead.remove(max(self._ahead, key=lambda a: a.block.first_sample))
                self.counts.stray += 1
            return
        first = min(witness, arrived, key=lambda a: a.sequence)
        if first is arrived:
            self.counts.reordered += 1
        self._ahead.remove(first)
        yield from self._go_on_at(first)

    def _go_on_at(self, first: _Ahead) -> Iterator[Block]:
        """Mask what is missing before a block, and hand on it and all that follows it."""
        yield from self._mask_until(first.block)
        yield self._pass_on(first)
        yield from self._drain()

    def _drain(self) -> Iterator[Block]:
        """Hand on what is held and has its turn now, and forget what can no longer have one."""
        while due := next((a for a in self._ahead if self._is_next(a)), None):
            self._ahead.remove(due)
            yield self._pass_on(due)
        kept = [a for a in self._ahead if self._lies_ahead(a)]
        self.counts.stray += len(self._ahead) - len(kept)
        self._ahead = kept

    def _pass_on(self, arrived: _Ahead) -> Block:
        self.counts.received += 1
        self._seen.append((arrived.sequence, arrived.block.first_sample))
        self._next_sequence, self.next_sample = arrived.sequence + 1, arrived.block.end_sample
        return arrived.block

    def _mask_until(self, block: Block) -> Iterator[Block]:
        """Blocks of the usual length without a valid sample, up to the given one."""
        first = self.next_sample if self.next_sample is not None else block.first_sample
        missing = block.first_sample - first
        if missing > MAX_GAP_S * block.sample_rate_hz:
            raise RunError(
                f"the rig was away for {missing / block.sample_rate_hz:.0f} s; start again for a new recording"
            )
        self.counts.lost += -(
            -missing // block.n_samples
        )  # all at once: they are one loss, and one word about it
        while first < block.first_sample:
            n = min(block.n_samples, block.first_sample - first)
            empty = np.full((n, len(block.channels)), np.nan)
            yield make_block(first, block.sample_rate_hz, empty, block.channels, config_id=block.config_id)
            first += n
