"""What a what-if starts from: what was known of the rig at an instant of a recording, or a plant as its file has it."""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tuning.loop import LoopFacts, loop_facts
from tuning.retune import TuningGoal
from tuning.rule import scheduling_rule
from twin.control.schedule import GainSchedule
from twin.plant.config import Plant, Shaker
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.programme import Programme
from twin.station.frame import Frame
from twin.station.replay import Opened, ReplayOptions, open_any
from twin.station.session import Session
from twin.station.worker import AsRecorded, TunerHere

SAMPLE_RATE_HZ, DELAY_US = 50_000.0, 50.0
HISTORY_FRAMES = 10
VOLTS, NEWTONS = 4.0, 1000.0


@dataclass(frozen=True, slots=True)
class Known:
    """State of knowledge at an instant.

    Attributes
    ----------
    at_s
        Of the recording; None for a plant alone.
    frames
        The last ones up to there.
    later
        Those of the recording that follow, for as long as a branch runs.
    """

    source: str
    plant: Plant
    facts: LoopFacts
    schedule: GainSchedule
    goal: TuningGoal
    amplitude: float
    damping_std_ns_m: float
    at_s: float | None = None
    frames: Sequence[Frame] = ()
    later: Sequence[Frame] = ()


def from_plant(name: str, band_hz: Sequence[float], delay_us: float = DELAY_US) -> Known:
    """A plant as its file has it, with the gains of the thesis's own rule over the band.

    Raises
    ------
    InputError
        If the plant cannot be read, or has no absorber.
    """
    plant = load_plant(name)
    if plant.absorber is None or plant.voice_coil is None:
        raise InputError(f"plant '{plant.name}' has no voice coil on an absorber: there is nothing to tune")
    exciter = next((a for a in plant.actuator if a is not plant.voice_coil), None)
    if exciter is None:
        raise InputError(f"plant '{plant.name}' has no actuator that excites it")
    volts = isinstance(exciter, Shaker) or exciter.input_unit == "V"
    return Known(
        source=plant.name,
        plant=plant,
        facts=loop_facts(SAMPLE_RATE_HZ, 1e-6 * delay_us),
        schedule=scheduling_rule(plant, band_hz, high_pass_hz=2.5),
        goal=TuningGoal(),
        amplitude=VOLTS if volts else NEWTONS,
        damping_std_ns_m=0.0,
    )


def from_recording(path: Path, at_s: float | None, later_s: float = 0.0) -> Known:
    """What the twin knew at an instant of a recording of this program, by replaying it up to there.

    Parameters
    ----------
    at_s
        Time in the recording [s]; None for its end.
    later_s
        How much of what follows is wanted besides [s].

    Raises
    ------
    InputError
        If the file is no such recording, does not say what its controller was, or ends before.
    """
    if path.suffix.lower() != ".rrd":
        raise InputError(f"{path}: a what-if needs a recording of this program (.rrd); or give --plant")
    opened = open_any(path, ReplayOptions())
    facts, schedule = _controller(path, opened)
    length_s = opened.n_samples / opened.sample_rate_hz
    if at_s is not None and not 0.0 < at_s <= length_s + 1e-9:
        raise InputError(f"--at {at_s:g}: the recording lasts from 0 to {length_s:g} s")
    # What the tuner proposed then is not asked again: the gains in use are those the rig took.
    silent = TunerHere(opened.plant, facts, opened.settings.goal, AsRecorded({}, {}))
    session = Session(
        opened.plant, opened.channels, opened.sample_rate_hz, opened.settings, opened.commands, silent
    )
    frames: list[Frame] = []
    blocks = iter(opened.blocks())
    for block in blocks:
        if at_s is not None and block.end_s > at_s + 1e-9 and frames:
            blocks = itertools.chain([block], blocks)
            break
        frames.append(session.advance(block))
        del frames[:-HISTORY_FRAMES]
    if not frames:
        raise InputError(f"{path}: holds no block")
    excited = next((f for f in reversed(frames) if f.phasors is not None), None)
    if excited is None or excited.phasors is None:
        raise InputError(
            f"{path}: no excitation is tracked at {frames[-1].block.end_s:.1f} s; give another --at"
        )
    phasors = excited.phasors
    amplitude = abs(phasors.amplitude[phasors.channels.index(phasors.reference)])
    plant, std = session.identified_plant(), session.damping_std_at(phasors.frequency_hz)
    known_schedule = session.schedule or schedule
    end_s = frames[-1].block.end_s
    later = [
        session.advance(b)
        for b in itertools.takewhile(lambda b: b.end_s <= end_s + later_s + 1e-9, blocks)
        if later_s > 0.0
    ]
    return Known(
        source=str(path),
        plant=plant,
        facts=facts,
        schedule=known_schedule,
        goal=opened.settings.goal,
        amplitude=float(amplitude),
        damping_std_ns_m=std,
        at_s=end_s,
        frames=tuple(frames),
        later=tuple(later),
    )


def measured_displacement(known: Known, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Time from the instant [s] and the primary's displacement [m] as the observer followed it."""
    if not known.later:
        return np.zeros(0), np.zeros(0)
    states = known.later[0].estimate.states
    column = states.index(f"x_{known.plant.primary.name}")
    x = np.concatenate([f.estimate.mean[:, column] for f in known.later])[every - 1 :: every]
    return (np.arange(len(x)) + 1.0) * every / known.facts.sample_rate_hz, x


def _controller(path: Path, opened: Opened) -> tuple[LoopFacts, GainSchedule]:
    """Loop and schedule of the run: as the session was told, or as its rig's programme says."""
    settings = opened.settings
    if settings.loop is not None and settings.schedule is not None:
        return settings.loop, settings.schedule
    try:
        config: dict[str, Any] = json.loads(opened.config_json)
        programme = Programme.model_validate_json(json.dumps(config["programme"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: does not say what its controller was; give --plant and the settings instead"
        ) from error
    delay = programme.loop_delay_samples
    facts = LoopFacts(programme.sample_rate_hz, delay, programme.measurement == "relative")
    return facts, programme.schedule


def proposed_schedule(
    schedule: GainSchedule, points: Sequence[tuple[float, Any]], window_hz: tuple[float, float]
) -> GainSchedule | None:
    """Schedule of proposed gains.

    Parameters
    ----------
    points
        (frequency [Hz], `Gains`), ascending.
    window_hz
        Where control acts; narrowed to the points.
    """
    if not points:
        return None
    hz = tuple(f for f, _ in points)
    low, high = max(window_hz[0], hz[0]), min(window_hz[1], hz[-1])
    if not (math.isfinite(low) and low <= high):
        return None
    return schedule.model_copy(
        update={
            "frequency_hz": hz,
            "alpha_kg": tuple(g.alpha_kg for _, g in points),
            "beta_ns_m": tuple(g.beta_ns_m for _, g in points),
            "gamma_n_m": tuple(g.gamma_n_m for _, g in points),
            "low_pass_hz": tuple(g.low_pass_hz for _, g in points),
            "high_pass_hz": tuple(g.high_pass_hz for _, g in points),
            "on_from_hz": low,
            "on_to_hz": high,
        }
    )
