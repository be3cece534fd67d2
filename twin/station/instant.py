"""The instant a branch starts from: what the loop knows at the end of a block, put together for the simulation."""

import math
from collections.abc import Sequence

import numpy as np

from estimators.types import StateEstimate
from tuning.branch import Instant
from tuning.loop import LoopFacts
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.linear import Array, linear_model, read_only
from twin.station.frame import Frame

FIT_S = 0.1
"""The excitation's phase and amplitude are those of the last such stretch."""


def instant_at(plant: Plant, facts: LoopFacts, frames: Sequence[Frame]) -> Instant:
    """Where everything stands at the last sample of the last frame.

    Parameters
    ----------
    frames
        The last frames in order, without a gap: their accelerations settle the filters, the last two tell how fast the
        excitation's frequency moves.

    Raises
    ------
    InputError
        If nothing excites the rig there, or samples are missing that a branch needs.
    """
    last = frames[-1]
    if last.phasors is None:
        raise InputError(f"at {last.block.end_s:.1f} s no excitation is tracked; branch at another time")
    if not all(f.block.valid.all() for f in frames):
        raise InputError(f"samples are missing before {last.block.end_s:.1f} s; branch at another time")
    names = tuple(c.name for c in last.block.channels)
    middle_hz, rate = last.phasors.frequency_hz, 0.0
    if len(frames) > 1 and (before := frames[-2].phasors) is not None:
        apart = 0.5 * (last.block.n_samples + frames[-2].block.n_samples) / last.block.sample_rate_hz
        rate = (middle_hz - before.frequency_hz) / apart
    length_s = last.block.n_samples / last.block.sample_rate_hz
    frequency = middle_hz + 0.5 * rate * length_s
    values = np.vstack([f.block.values for f in frames])
    reference = values[:, names.index(last.phasors.reference)]
    fit = max(8, round(min(FIT_S, length_s) * facts.sample_rate_hz))
    coil = plant.voice_coil
    if coil is None or coil.name not in names:
        raise InputError("the coil's current reference is not recorded; a branch cannot start without it")
    state, covariance = _plant_state(plant, last.estimate, last.block, frequency)
    return Instant(
        frequency_hz=frequency,
        rate_hz_s=rate,
        drive=_phasor_at_end(reference[-fit:], frequency, rate, facts.sample_rate_hz),
        state=state,
        covariance=covariance,
        acceleration=read_only(_relative_acceleration(plant, facts, values, names)),
        reference_a=float(values[-1, names.index(coil.name)]),
    )


def _phasor_at_end(signal: Array, frequency_hz: float, rate_hz_s: float, sample_rate_hz: float) -> complex:
    """Complex amplitude A of ``Re(A exp(j phase))`` with the phase zero at the last sample."""
    t = (np.arange(len(signal)) - (len(signal) - 1)) / sample_rate_hz
    phase = math.tau * (frequency_hz + 0.5 * rate_hz_s * t) * t
    basis = np.column_stack([np.cos(phase), -np.sin(phase), np.ones(len(t))])
    real, imaginary, _ = np.linalg.lstsq(basis, signal, rcond=None)[0]
    return complex(real, imaginary)


def _plant_state(
    plant: Plant, estimate: StateEstimate, block: Block, frequency_hz: float
) -> tuple[Array, Array]:
    """Mean and covariance of the plant's states; a current the observer was given instead of estimated is measured."""
    names = linear_model(plant, frequency_hz=frequency_hz).states
    channels = tuple(c.name for c in block.channels)
    mean, covariance = np.zeros(len(names)), np.zeros((len(names), len(names)))
    known = [i for i, name in enumerate(names) if name in estimate.states]
    columns = [estimate.states.index(names[i]) for i in known]
    mean[known] = estimate.mean[-1, columns]
    covariance[np.ix_(known, known)] = estimate.covariance[np.ix_(columns, columns)]
    for i, name in enumerate(names):
        if i in known:
            continue
        sensor = next(
            (s for s in plant.sensor if s.kind == "current" and f"i_{s.of}" == name and s.name in channels),
            None,
        )
        if sensor is None:
            raise InputError(f"nothing tells the state '{name}' at this instant")
        mean[i] = block.values[-1, channels.index(sensor.name)]
        covariance[i, i] = sensor.noise_variance(block.sample_rate_hz)
    return read_only(mean), read_only(covariance)


def _relative_acceleration(plant: Plant, facts: LoopFacts, values: Array, names: Sequence[str]) -> Array:
    """What the control law measures [m/s²]."""
    coil = plant.voice_coil
    first, second = coil.between if coil is not None and coil.between is not None else ("", "")
    total = np.zeros(len(values))
    for body, sign in ((first, 1.0), (second, -1.0)):
        if body == first and not facts.relative:
            continue
        sensor = next(
            (s for s in plant.sensor if s.kind == "acceleration" and s.of == body and s.name in names), None
        )
        if sensor is None:
            raise InputError(f"no recorded sensor measures the acceleration of '{body}'")
        total += sign * values[:, names.index(sensor.name)]
    return total
