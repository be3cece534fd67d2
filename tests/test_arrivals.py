"""Blocks out of order, twice, late or never; the drift of a clock from arrivals with queues in between."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.plant.blocks import Block, Channel, make_block
from twin.plant.errors import RunError
from twin.rig.arrivals import MAX_GAP_S, Arrivals
from twin.rig.drift import WINDOW_BLOCKS, ClockDrift

CHANNELS = (Channel("a", "V"),)
N = 10


def block(k: int, n: int = N) -> Block:
    return make_block(k * N, 100.0, np.full((n, 1), float(k)), CHANNELS)


def play(arrivals: Arrivals, order: list[int]) -> list[Block]:
    out = [b for k in order for b in arrivals.take(block(k), k)]
    return [*out, *arrivals.flush()]


def content(blocks: list[Block]) -> list[int | None]:
    """What each block holds: its number, or None where it is masked."""
    return [int(b.values[0, 0]) if b.valid.all() else None for b in blocks]


@pytest.mark.parametrize(
    ("order", "expected", "counts"),
    [
        ([0, 1, 2], [0, 1, 2], (3, 0, 0, 0, 0)),
        ([0, 2, 1, 3], [0, 1, 2, 3], (4, 0, 0, 0, 1)),
        ([0, 2, 3], [0, None, 2, 3], (3, 1, 0, 0, 0)),
        ([0, 4, 5], [0, None, None, None, 4, 5], (3, 3, 0, 0, 0)),
        ([0, 0, 1, 1, 1], [0, 1], (2, 0, 0, 3, 0)),
        ([0, 2, 3, 1, 4], [0, None, 2, 3, 4], (4, 1, 1, 0, 0)),
        ([5, 6], [5, 6], (2, 0, 0, 0, 0)),
        ([0, 2], [0, None, 2], (2, 1, 0, 0, 0)),
        ([0, 2, 2, 1], [0, 1, 2], (3, 0, 0, 1, 1)),
    ],
)
def test_what_arrives_is_put_in_order_masked_or_dropped_and_counted(
    order: list[int], expected: list[int | None], counts: tuple[int, ...]
) -> None:
    arrivals = Arrivals()
    assert content(play(arrivals, order)) == expected
    c = arrivals.counts
    assert (c.received, c.lost, c.late, c.repeated, c.reordered) == counts


@given(st.lists(st.integers(0, 30), max_size=60))
def test_whatever_arrives_comes_out_without_a_gap_and_no_sample_twice(order: list[int]) -> None:
    arrivals = Arrivals()
    blocks = play(arrivals, order)
    if not order:
        assert blocks == []
        return
    starts = [b.first_sample for b in blocks]
    assert starts == [blocks[0].first_sample, *(b.end_sample for b in blocks[:-1])]
    assert starts[0] // N in order
    for b in blocks:
        assert not b.valid.any() or b.values[0, 0] * N == b.first_sample
    c = arrivals.counts
    assert c.received + c.late + c.repeated + c.stray == len(order)
    assert c.received + c.lost == len(blocks)


def test_pause_longer_than_any_gap_ends_the_run() -> None:
    arrivals = Arrivals()
    far = int(MAX_GAP_S * 100.0 / N) + 2
    list(arrivals.take(block(0), 0))
    list(arrivals.take(block(far), far))
    with pytest.raises(RunError, match="away for 600 s"):
        list(arrivals.take(block(far + 1), far + 1))


@pytest.mark.parametrize("ppm", [-80.0, 0.0, 35.0])
def test_drift_is_found_behind_queues_and_its_deviation_is_true(ppm: float) -> None:
    inside = 0
    runs = 60
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        drift = ClockDrift()
        rig_s = 0.1 * np.arange(1, 40 * WINDOW_BLOCKS)
        wall_s = rig_s / (1.0 + ppm * 1e-6)
        for rig, arrived in zip(rig_s, 1000.0 + wall_s + rng.exponential(2e-3, len(rig_s)), strict=True):
            drift.take(float(rig), float(arrived))
        assert abs(drift.ppm - ppm) < 3.0
        inside += abs(drift.ppm - ppm) <= 1.96 * drift.ppm_std
    assert inside >= 0.85 * runs


def test_drift_says_nothing_before_it_can_and_after_a_restart() -> None:
    drift = ClockDrift()
    for k in range(2 * WINDOW_BLOCKS):
        drift.take(0.1 * k, 0.1 * k)
    assert np.isnan(drift.ppm)
    for k in range(2 * WINDOW_BLOCKS, 5 * WINDOW_BLOCKS):
        drift.take(0.1 * k, 0.1 * k)
    assert abs(drift.ppm) < 1e-6
    drift.restart()
    assert np.isnan(drift.ppm)
