"""Blocks of other sizes than those recorded, and back: what a session is given are always the recorded ones.

One frequency is tracked, one step is learned and commands take effect per block: a block is part of the measurement,
not of the reading. So a recording may be read, sent or kept in pieces of any size; before they reach a session they are
put together again as the rig had them, and estimates and decisions are the same to the bit.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from twin.plant.blocks import Block
from twin.plant.errors import InputError
from twin.plant.linear import read_only


@dataclass(frozen=True, slots=True)
class Mark:
    """One block as recorded, without its samples."""

    first_sample: int
    n_samples: int
    config_id: str = ""
    control_on: bool | None = None
    commands_applied: tuple[int, ...] = ()

    @property
    def end_sample(self) -> int:
        """Index of the first sample after it."""
        return self.first_sample + self.n_samples


def mark_of(block: Block) -> Mark:
    """What a block says besides its samples."""
    return Mark(
        block.first_sample, block.n_samples, block.config_id, block.control_on, block.commands_applied
    )


def in_pieces(blocks: Iterable[Block], n_samples: int) -> Iterator[Block]:
    """Samples of blocks in pieces of one size; the last before a gap or the end may be shorter.

    Raises
    ------
    InputError
        If a piece would have no sample.
    """
    if n_samples < 1:
        raise InputError("pieces need one sample at least; give a longer --block-ms")
    held: list[Block] = []
    for block in blocks:
        if held and held[-1].end_sample != block.first_sample:
            yield _joined(held)
            held = []
        held.append(block)
        while sum(b.n_samples for b in held) >= n_samples:
            whole = _joined(held)
            yield _rows(whole, 0, n_samples)
            held = [_rows(whole, n_samples, whole.n_samples)] if whole.n_samples > n_samples else []
    if held:
        yield _joined(held)


def restored(pieces: Iterable[Block], marks: Iterable[Mark]) -> Iterator[Block]:
    """The recorded blocks again, from pieces of whatever size, in order.

    Raises
    ------
    InputError
        If samples of a block are missing.
    """
    waiting, held = iter(pieces), None
    for mark in marks:
        parts: list[Block] = []
        at = mark.first_sample
        while at < mark.end_sample or (mark.n_samples == 0 and not parts):
            while held is None or (held.end_sample <= at and mark.n_samples):
                held = next(waiting, None)
                if held is None:
                    break
            if held is None or held.first_sample > at:
                raise InputError(f"the samples from {at} on are missing; use the whole recording")
            start, stop = at - held.first_sample, min(mark.end_sample, held.end_sample) - held.first_sample
            parts.append(_rows(held, start, stop))
            at = held.first_sample + stop
        whole = _joined(parts)
        yield replace(
            whole,
            config_id=mark.config_id,
            control_on=mark.control_on,
            commands_applied=mark.commands_applied,
        )


def _joined(blocks: list[Block]) -> Block:
    if len(blocks) == 1:
        return blocks[0]
    values = read_only(np.vstack([b.values for b in blocks]))
    valid = np.vstack([b.valid for b in blocks])
    valid.flags.writeable = False
    applied = tuple(number for b in blocks for number in b.commands_applied)
    return replace(blocks[0], values=values, valid=valid, commands_applied=applied)


def _rows(block: Block, start: int, stop: int) -> Block:
    if (start, stop) == (0, block.n_samples):
        return block
    return replace(
        block,
        first_sample=block.first_sample + start,
        values=block.values[start:stop],
        valid=block.valid[start:stop],
        commands_applied=block.commands_applied if start == 0 else (),
    )
