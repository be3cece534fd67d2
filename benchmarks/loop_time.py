"""What retuning costs the loop: its own time per block with the tuner at work beside it, and with the tuner idle."""

import time
from contextlib import closing
from dataclasses import replace

import numpy as np

from tuning.retune import TuningGoal
from twin.plant.blocks import Block, make_block
from twin.rig.simulated import SimulatedRig
from twin.station.demo import demo_programme, facts_of, session_for
from twin.station.retuning import RetuningSettings
from twin.station.session import Session
from twin.station.worker import Tuner, TunerProcess

SEGMENT = 10
PAUSE_S = 0.02
NEVER = 10**9


def loop_block_times(blocks: int = 200, tuner: Tuner | None = None) -> dict[str, float]:
    """Median milliseconds that a block takes in the loop, idle and retuning, side by side on the same blocks.

    Two sessions take the same blocks in turns of ten. One never asks; the other asks at every block that finds the
    tuner free, in its own process as at a live rig. Both pause between blocks, as a loop does that waits for its rig.

    Parameters
    ----------
    blocks
        How many blocks of 100 ms each session takes.
    tuner
        Tuner to measure with; a `TunerProcess` unless given.

    Returns
    -------
    dict
        ``loop_block_ms_idle``, ``loop_block_ms_retuning`` and their 95th percentiles with ``_p95`` at the end.
    """
    programme = demo_programme(0.1 * (blocks + SEGMENT) / 0.5, seed=0)
    rig = SimulatedRig(programme)
    goal = TuningGoal()
    facts = facts_of(programme)
    with closing(tuner or TunerProcess(programme.plant, facts, goal, None)) as beside:
        often = RetuningSettings(every_blocks=1, min_change=1e9)
        # Commands are not worth it here: both sessions go through the very same blocks.
        with closing(TunerProcess(programme.plant, facts, goal, None)) as unused:
            idle = session_for(programme, rig.channels, goal, replace(often, every_blocks=NEVER), unused)
            busy = session_for(programme, rig.channels, goal, often, beside)
            for session in (idle, busy):
                session.warm_up()
                if session.retuning is not None:
                    session.retuning._since_question = 0
        taken: dict[str, list[float]] = {"idle": [], "retuning": []}
        for k in range(blocks // SEGMENT):
            some = [_next_block(rig) for _ in range(SEGMENT)]
            for name, session in (("idle", idle), ("retuning", busy)):
                times = [_advance(session, block) for block in some]
                if k:  # the first turn warms up
                    taken[name] += times
            time.sleep(
                0.3
            )  # the open question is answered: the next turn's first session finds a quiet machine
    figures = {}
    for name, times in taken.items():
        figures[f"loop_block_ms_{name}"] = float(np.median(times))
        figures[f"loop_block_ms_{name}_p95"] = float(np.percentile(times, 95.0))
    return figures


def _advance(session: Session, block: Block) -> float:
    time.sleep(PAUSE_S)
    began = time.perf_counter()
    session.advance(block)
    return 1e3 * (time.perf_counter() - began)


def _next_block(rig: SimulatedRig) -> Block:
    first = rig.next_sample
    values, on, _ = rig.next_block()
    return make_block(first, rig.programme.sample_rate_hz, values, rig.channels, control_on=on)


if __name__ == "__main__":
    print(loop_block_times())
