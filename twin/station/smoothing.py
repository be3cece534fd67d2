"""States of a recording smoothed: estimated from all of it, what came later included."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from estimators.observer import Observer
from estimators.smoother import RecordingSmoother
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.errors import InputError
from twin.plant.inputs import driven_model
from twin.station.replay import ReplayOptions, open_any

UNITS = {"x": "m", "v": "m/s", "i": "A", "d": "N", "f": "N", "h": "", "l": "", "n": ""}
"""Of a state, by the letter its name begins with; input stages and noise have their sensor's."""

MEMORY_SHARE = 0.4


def smooth_recording(
    path: Path, every: int, say: Callable[[str], None], progress: Callable[[int, int], None]
) -> tuple[tuple[Channel, ...], float, list[Block]]:
    """Smooth a recording with the model that its replay identifies, block by block.

    Parameters
    ----------
    every
        One sample in so many is kept.
    progress
        Takes blocks done and blocks in all, there and back.

    Returns
    -------
    channels
        States and their standard deviations (``x_table``, ``x_table_std``).
    sample_rate_hz
        Of what is kept.
    blocks
        Front to back.

    Raises
    ------
    InputError
        If the recording cannot be used or does not fit into memory.
    """
    opened = open_any(path, ReplayOptions())
    size = opened.n_samples * len(opened.channels) * 9
    free = int(psutil.virtual_memory().available)
    if size > MEMORY_SHARE * free:
        raise InputError(
            f"{path}: smoothing goes through it backwards and needs {size / 1e9:.1f} GB of memory, {free / 1e9:.1f} GB "
            "are free; export a part of it with 'atmd recordings export --from --to' and smooth that"
        )
    for remark in opened.remarks:
        say(remark)
    session = opened.session()
    session.warm_up()
    names = tuple(c.name for c in opened.channels)
    sources = session.observer.sources
    unknown = session.observer.unknown_force
    observer = Observer(opened.plant, names, opened.sample_rate_hz, sources=sources, unknown_force=unknown)
    smoother = RecordingSmoother(observer)
    answers, kept = list(opened.acknowledgements), []
    n_blocks = max(1, sum(1 for _ in opened.blocks()))
    modelled = None
    for block in opened.blocks():
        due = tuple(a for sample, a in answers if sample < block.end_sample)
        answers = answers[len(due) :]
        frame = session.advance(block, due)
        hz = frame.phasors.frequency_hz if frame.phasors is not None else None
        plant = session.identified_plant()
        if hz is not None and plant.absorber is not None:
            damping = plant.absorber.damping_at(hz)
            if modelled is None or abs(damping - modelled) > session.settings.model_step_ns_m:
                modelled = damping
                observer.set_model(plant, *driven_model(plant, sources, opened.sample_rate_hz, hz))
        checked = frame.block if frame.checked is None else frame.checked.block
        smoother.filter(checked)
        kept.append(checked)
        progress(len(kept), 2 * n_blocks)
    channels = tuple(
        Channel(f"{state}{ending}", UNITS.get(state.split("_", 1)[0], ""))
        for state in observer.states
        for ending in ("", "_std")
    )
    out = []
    for done, block in enumerate(reversed(kept), start=1):
        estimate = smoother.smooth(block)
        first = -block.first_sample % every
        values = np.stack([estimate.mean[first::every], estimate.std[first::every]], axis=2)
        rows = values.reshape(len(values), -1)
        if len(rows):
            at = (block.first_sample + first) // every
            out.append(make_block(at, opened.sample_rate_hz / every, rows, channels))
        progress(n_blocks + done, 2 * n_blocks)
    return channels, opened.sample_rate_hz / every, out[::-1]
