"""The whole chain, block by block at the rig's 50 kS/s: how many times faster than the rig, and what costs it.

Clocked is processor time, of all threads together: what one core that has nothing else to do would take. Retuning
answers come from elsewhere, as they do beside a rig, where a process of its own works them out; what it costs to do
that in the loop is told beside it.
"""

import functools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from benchmarks.observer import by_filterpy
from benchmarks.report import Report, Row
from estimators.observer import Observer
from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from twin.plant.blocks import Block, make_block
from twin.plant.inputs import DriveReader, driven_model
from twin.rig.programme import Programme, Sweep
from twin.rig.simulated import SimulatedRig
from twin.station.answers import NOTHING_KNOWN, KnownAnswers, as_json
from twin.station.demo import demo_programme, session_for
from twin.station.outputs import Outputs
from twin.station.session import Session, SessionSettings
from twin.station.worker import AfterBlocks, TunerHere

WANTED = {"full": 20.0, "steady": 60.0, "recorded": 30.0}
WHAT = {
    "full": "chain, full covariance",
    "steady": "chain, steady state",
    "recorded": "chain, steady state, with recording and Rerun view",
}
INLINE = "chain, steady state, retuning worked out in the loop"
STAGES = {
    "plant in parallel": "_parallel.advance",
    "observer": "observer.advance",
    "lock-in": "_identification.tracker.advance",
    "damping": "_learn",
    "model refresh": "_refresh_model",
    "retuning": "_retune",
    "performance": "_performance",
}


@dataclass(frozen=True, slots=True)
class Setting:
    """Seconds of data before and while the clock runs, and samples for the baseline."""

    learning_s: float = 5.0
    measured_s: float = 10.0
    baseline_samples: int = 5_000
    block_samples: int = 5_000


SMALL = Setting(learning_s=0.6, measured_s=1.0, baseline_samples=200)


def recorded_test(setting: Setting) -> tuple[Programme, list[Block], Session, KnownAnswers]:
    """Blocks of a simulated rig that dwells near 50 Hz and obeys the twin, that twin, and its tuner's answers."""
    seconds = setting.learning_s + setting.measured_s
    programme = demo_programme(seconds, seed=0)
    sweep = Sweep(from_hz=49.9, to_hz=50.1, duration_s=seconds, amplitude_v=programme.sweep.amplitude_v)
    programme = programme.model_copy(update={"sweep": sweep, "block_samples": setting.block_samples})
    rig = SimulatedRig(programme)
    ranges = np.array([*(s.range or np.inf for s in programme.plant.sensor), np.inf])
    session = session_for(programme, rig.channels, TuningGoal())
    session.warm_up()
    blocks, answers = [], {}
    while not rig.finished:
        first = rig.next_sample
        values, on, said = rig.next_block()
        block = make_block(
            first, programme.sample_rate_hz, values, rig.channels, ranges,
            control_on=on, commands_applied=tuple(a.command_id for a in said if a.accepted),
        )  # fmt: skip
        blocks.append(block)
        frame = session.advance(block, tuple(said))
        if frame.arrival is not None and frame.arrival.answer is not None:
            answers[frame.arrival.chain] = as_json(frame.arrival.answer)
        if frame.command is not None:
            rig.accept(frame.command)
    return programme, blocks, session, KnownAnswers(answers)


def replaying(programme: Programme, told: Session, mode: str, known: KnownAnswers = NOTHING_KNOWN) -> Session:
    """Return a fresh twin for the same blocks; in mode ``full`` its observer never freezes its gain.

    Parameters
    ----------
    known
        Answers of the tuner that need not be worked out.
    """
    facts = LoopFacts(
        programme.sample_rate_hz, programme.loop_delay_samples, programme.measurement == "relative"
    )
    settings = SessionSettings(loop=facts, schedule=programme.schedule, goal=told.settings.goal)
    tuner = TunerHere(programme.plant, facts, settings.goal, AfterBlocks(settings.retuning.lag_blocks), known)
    session = Session(
        programme.plant, told.channels, programme.sample_rate_hz, settings, dict(told.commands), tuner
    )
    if mode == "full":
        session.observer = full_observer(programme, session)
    return session


def full_observer(programme: Programme, session: Session) -> Observer:
    """Observer with full covariance for good, started as the session's own."""
    fs, plant = programme.sample_rate_hz, programme.plant
    names = tuple(c.name for c in session.channels)
    observer = Observer(plant, names, fs, settle_samples=10**9)
    observer.set_model(plant, *driven_model(plant, observer.sources, fs, None))
    return observer


def run_chain(setting: Setting) -> Report:
    """Real-time factors, the cost of each stage, and a baseline on filterpy and SciPy."""
    programme, blocks, told, known = recorded_test(setting)
    sessions = {mode: replaying(programme, told, mode, known) for mode in WANTED}
    watched = replaying(programme, told, "steady")
    stages = _watch(watched)
    skip = round(setting.learning_s / programme.block_s)
    every = watched.settings.retuning.every_blocks
    taken: dict[str, list[float]] = {mode: [] for mode in (*WANTED, "inline")}
    with tempfile.TemporaryDirectory() as folder:
        output = Outputs(
            sessions["recorded"], recording=Path(folder) / "chain.rrd", setup="", run_config_json="{}", seed=0
        )
        with output as outputs:
            for k, block in enumerate(blocks):
                if k == skip:
                    stages.clear()
                for mode, session in sessions.items():
                    began = time.process_time()
                    frame = session.advance(block)
                    if mode == "recorded":
                        outputs.take(frame)
                    if k >= skip:
                        taken[mode].append(time.process_time() - began)
                began = time.process_time()
                watched.advance(block)
                if k >= skip:
                    taken["inline"].append(time.process_time() - began)
    figures: dict[str, Any] = {"sample_rate_hz": programme.sample_rate_hz}
    rows = []
    for mode, wanted in WANTED.items():
        # Retuning comes every few blocks: only whole rounds are alike.
        rounds = np.array(taken[mode][: len(taken[mode]) // every * every]).reshape(-1, every).sum(axis=1)
        low, median, high = np.percentile(every * programme.block_s / rounds, [25.0, 50.0, 75.0])
        figures[f"realtime_factor_{mode}"] = float(median)
        rows.append(Row(WHAT[mode], float(median), "x", wanted, spread=float(0.5 * (high - low) / median)))
    rounds = np.array(taken["inline"][: len(taken["inline"]) // every * every]).reshape(-1, every).sum(axis=1)
    inline = float(np.median(every * programme.block_s / rounds))
    figures["realtime_factor_retuning_inline"] = inline
    figures["answers_worked_out"] = {mode: session.answers_worked_out for mode, session in sessions.items()}
    rows.append(Row(INLINE, inline, "x"))
    measured_s = (len(blocks) - skip) * programme.block_s
    figures["stage_share_of_real_time"] = {
        name: stages.get(name, 0.0) / measured_s for name in (*STAGES, "recording and view")
    }
    view = (sum(taken["recorded"]) - sum(taken["steady"])) / measured_s
    figures["stage_share_of_real_time"]["recording and view"] = max(view, 0.0)
    for name, share in figures["stage_share_of_real_time"].items():
        rows.append(Row(f"  of a second of data: {name}", 1e3 * share, "ms"))
    own, baseline = baseline_factors(programme, blocks[-1], sessions["full"], setting.baseline_samples)
    figures["realtime_factor_filterpy_scipy"] = baseline
    figures["observer_and_plant_speedup_vs_filterpy_scipy"] = own / baseline
    rows.append(Row("plant and observer by dlsim and filterpy", baseline, "x"))
    rows.append(Row("plant and observer, full covariance, against these", own / baseline, "x"))
    return Report({"chain": figures}, rows)


def _watch(session: Session) -> dict[str, float]:
    """Replace a session's stages by ones that add up how long they take [s]."""
    total: dict[str, float] = {}

    def timed(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(call)
        def wrapper(*args: Any) -> Any:
            began = time.process_time()
            try:
                return call(*args)
            finally:
                total[name] = total.get(name, 0.0) + time.process_time() - began

        return wrapper

    for name, path in STAGES.items():
        *owner, method = path.split(".")
        target: Any = session
        for part in owner:
            target = getattr(target, part)
        setattr(target, method, timed(name, getattr(target, method)))
    return total


def baseline_factors(
    programme: Programme, block: Block, session: Session, samples: int
) -> tuple[float, float]:
    """Real-time factors of plant and observer: the program's own, then `dlsim` and filterpy sample by sample."""
    names = tuple(c.name for c in session.channels)
    observer = full_observer(programme, session)
    _, d = driven_model(programme.plant, observer.sources, programme.sample_rate_hz, None)
    drive = DriveReader(observer.sources, names)
    z = block.values[:, [names.index(s) for s in observer.sensors]]
    few = min(samples, block.n_samples)
    # dlsim knows no first-order hold: two held inputs stand for one that is joined linearly.
    system = (d.F, np.hstack([d.B0, d.B1]), d.C, np.hstack([d.D, 0.0 * d.D]), 1.0)
    began = time.process_time()
    u = drive.gather(block)[:few]
    signal.dlsim(system, np.hstack([u, np.vstack([u[1:], u[-1:]])]))
    by_filterpy(observer, z[:few], u)
    slow = (time.process_time() - began) / few
    began = time.process_time()
    rounds = 5
    for _ in range(rounds):
        session._parallel.advance(block)
        session.observer.advance(block)
    fast = (time.process_time() - began) / (rounds * block.n_samples)
    return 1.0 / (fast * programme.sample_rate_hz), 1.0 / (slow * programme.sample_rate_hz)
