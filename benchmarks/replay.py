"""A recorded test replayed from the file: opened, decoded, through the whole session, scored, and recorded again.

The factors are the test's length over the processor time of all threads together, from opening the file to the figures:
what one core that has nothing else to do takes. The time that went by is told beside it.

The test is the demonstration's, swept and retuned. The baseline is plant and observer alone on `scipy.signal.dlsim` and
filterpy, sample by sample: less work than the replay does, on the same recording.
"""

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.chain import baseline_factors
from benchmarks.report import Report, Row
from tuning.retune import TuningGoal
from twin.plant.blocks import Block, make_block
from twin.rig.programme import Programme
from twin.rig.simulated import SimulatedRig
from twin.station.demo import demo_programme, session_for
from twin.station.opened import ReplayOptions, open_any
from twin.station.outputs import Outputs
from twin.station.replay import run_replay

WANTED, WANTED_WITH_RERUN = 30.0, 15.0
"""60 s in 2 s, and in 4 s."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Seconds of the recording, replays of each kind, and samples for the baseline."""

    seconds: float = 60.0
    rounds: int = 5
    baseline_samples: int = 5_000


SMALL = Setting(seconds=3.0, rounds=1, baseline_samples=200)


def record(programme: Programme, path: Path) -> Block:
    """Run the simulated rig with its twin, recorded as every run is; returns a block of it."""
    rig = SimulatedRig(programme)
    ranges = np.array([*(s.range or np.inf for s in programme.plant.sensor), np.inf])
    session = session_for(programme, rig.channels, TuningGoal())
    session.warm_up()
    config = json.dumps({"programme": programme.model_dump(mode="json"), "session": session.configuration()})
    with Outputs(session, recording=path, setup="", run_config_json=config, seed=programme.seed) as outputs:
        while not rig.finished:
            first = rig.next_sample
            values, on, answers = rig.next_block()
            applied = tuple(a.command_id for a in answers if a.accepted)
            block = make_block(
                first, programme.sample_rate_hz, values, rig.channels, ranges, control_on=on,
                commands_applied=applied, config_id=programme.plant.fingerprint,
            )  # fmt: skip
            frame = session.advance(block, tuple(answers))
            if frame.command is not None:
                rig.accept(frame.command)
            outputs.take(frame)
    return block


def run_replays(setting: Setting) -> Report:
    """Time of the data over processor time from opening the file to the figures, in turns with and without Rerun."""
    programme = demo_programme(setting.seconds, seed=0)
    taken: dict[str, list[float]] = {"": [], "_rerun": []}
    passed: dict[str, list[float]] = {"": [], "_rerun": []}
    with tempfile.TemporaryDirectory() as folder:
        path, again = Path(folder) / "test.rrd", Path(folder) / "again.rrd"
        block = record(programme, path)
        for k in range(setting.rounds + 1):  # the first warms up
            for kind, options in (("", ReplayOptions()), ("_rerun", ReplayOptions(recording=again))):
                began, at = time.process_time(), time.perf_counter()
                result = run_replay(path, options, lambda _: None, lambda _a, _b: None)
                if k:
                    taken[kind].append(time.process_time() - began)
                    passed[kind].append(time.perf_counter() - at)
                for file in Path(folder).glob("again*.rrd"):
                    file.unlink()
        session = open_any(path, ReplayOptions()).session()
    _, slow = baseline_factors(programme, block, session, setting.baseline_samples)
    figures: dict[str, Any] = {"seconds": setting.seconds, "decisions_repeated": result["decisions_repeated"]}
    rows = []
    wanted = {"": WANTED, "_rerun": WANTED_WITH_RERUN}
    what = {"": "replay, from file to figures", "_rerun": "replay, recorded again with Rerun's series"}
    for kind, seconds in taken.items():
        low, median, high = np.percentile(setting.seconds / np.array(seconds), [25.0, 50.0, 75.0])
        figures[f"realtime_factor{kind}"] = float(median)
        figures[f"processor_s{kind}"] = float(np.median(seconds))
        figures[f"passed_s{kind}"] = float(np.median(passed[kind]))
        rows.append(
            Row(what[kind], float(median), "x", wanted[kind], spread=float(0.5 * (high - low) / median))
        )
    figures["baseline_filterpy_scipy_factor"] = slow
    figures["speedup_vs_filterpy_scipy"] = figures["realtime_factor"] / slow
    rows.append(Row("plant and observer alone by dlsim and filterpy", slow, "x"))
    rows.append(Row("replay against these", figures["speedup_vs_filterpy_scipy"], "x"))
    return Report({"replay": figures}, rows)
