"""``python -m recordings [--expected] [FOLDER ...]``: make recorded tests anew, or only their expected results."""

import argparse
import json
import math
import os
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

# Before anything imports NumPy: its library reads these once.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

import numpy as np  # noqa: E402

from recordings.faults import Fault  # noqa: E402
from recordings.results import CONFIG, EXPECTED, FOLDER, RECORDING, replay_results  # noqa: E402
from tuning.retune import TuningGoal  # noqa: E402
from twin.plant.blocks import make_block  # noqa: E402
from twin.plant.config import Plant  # noqa: E402
from twin.rig.programme import Programme, Tone  # noqa: E402
from twin.rig.simulated import SimulatedRig  # noqa: E402
from twin.rig.tests_of_chapter_7 import programme  # noqa: E402
from twin.station.demo import demo_programme, session_for  # noqa: E402
from twin.station.orders import Order  # noqa: E402
from twin.station.outputs import Outputs  # noqa: E402
from twin.station.session import Session, SessionSettings  # noqa: E402


def main() -> None:
    """Make what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m recordings", description=__doc__)
    parser.add_argument(
        "folder", nargs="*", help="names of folders here with a config.toml; all unless given"
    )
    parser.add_argument("--expected", action="store_true", help="keep the recording, write its results anew")
    options = parser.parse_args()
    for name in options.folder or sorted(p.parent.name for p in FOLDER.glob(f"*/{CONFIG}")):
        folder = FOLDER / name
        if not options.expected:
            record(folder)
        write_expected(folder)


def record(folder: Path) -> None:
    """Run the simulated rig as the folder's configuration says, the twin beside it, and record it.

    A folder with a ``test`` is one of the thesis's, with its own gains to the end; one with a ``case`` is a short dwell
    of the demonstration's rig, retuned as it runs, with something wrong or something else asked on the way.
    """
    config = tomllib.loads((folder / CONFIG).read_text(encoding="utf-8"))
    if "test" in config:
        run = programme(
            config["test"], seconds=config["seconds"], sweep_hz=tuple(config["sweep_hz"]), seed=config["seed"]
        )
        truth, order_at, order, fault = run, math.inf, None, None
        rig = SimulatedRig(truth)
        session = Session(run.plant, rig.channels, run.sample_rate_hz, SessionSettings())
    else:
        run = case_programme(config)
        truth = run.model_copy(update={"plant": wrong_plant(run.plant, config.get("wrong", {}))})
        rig = SimulatedRig(truth)
        session = session_for(run, rig.channels, TuningGoal(budget_w=config["budget_w"]))
        names = tuple(c.name for c in rig.channels)
        fault = Fault(config["fault"], names, run.sample_rate_hz) if "fault" in config else None
        asked = config.get("order")
        order_at, order = (math.inf, None) if asked is None else (asked["at_s"], asked)
    ranges = np.array([*(s.range or math.inf for s in run.plant.sensor), math.inf])
    for old in folder.glob("*.rrd"):
        old.unlink()
    recorder = Outputs(
        session,
        recording=folder / RECORDING,
        setup="",
        run_config_json=_run_config(run, session),
        seed=run.seed,
        looked_at=False,
    )
    with recorder:
        while not rig.finished:
            first = rig.next_sample
            raw, control_on, answers = rig.next_block()
            values = np.asarray(raw) if fault is None else fault.apply(raw, first)
            block = make_block(
                first, run.sample_rate_hz, values.astype(np.float32), rig.channels, ranges,
                control_on=control_on, config_id=run.plant.fingerprint,
                commands_applied=tuple(a.command_id for a in answers if a.accepted),
            )  # fmt: skip
            now = None
            if order is not None and block.end_s > order_at and session.schedule is not None:
                goal = replace(session.settings.goal, budget_w=order["budget_w"])
                now = Order(kind="schedule", schedules=(session.schedule,), goal=goal, note="another budget")
                order = None
            frame = session.advance(block, tuple(answers), now)
            for command in frame.commands:
                rig.accept(command)
            recorder.take(frame)


def case_programme(config: dict[str, Any]) -> Programme:
    """The demonstration's rig, dwelling at one frequency, at a sample rate that keeps the folder small."""
    run = demo_programme(60.0, config["seed"])
    tone = Tone(
        frequency_hz=config["frequency_hz"], duration_s=config["seconds"], amplitude_v=run.sweep.amplitude
    )
    rate = config["sample_rate_hz"]
    return run.model_copy(update={"sweep": tone, "sample_rate_hz": rate, "block_samples": round(0.1 * rate)})


def wrong_plant(plant: Plant, wrong: dict[str, float]) -> Plant:
    """The plant as it really is: the absorber's ``stiffness`` or ``mass`` by a factor."""
    absorber = plant.absorber
    if not wrong or absorber is None:
        return plant
    body = absorber.model_copy(
        update={
            "stiffness_n_m": absorber.stiffness_n_m * wrong.get("stiffness", 1.0),
            "mass_kg": absorber.mass_kg * wrong.get("mass", 1.0),
        }
    )
    return plant.model_copy(update={"body": tuple(body if b is absorber else b for b in plant.body)})


def write_expected(folder: Path) -> None:
    """Replay the folder's recording and keep its results, but for the bits, which are the machine's own."""
    results = replay_results(folder / RECORDING)
    del results["digest"]
    (folder / EXPECTED).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def _run_config(run: Programme, session: Session) -> str:
    return json.dumps({"programme": run.model_dump(mode="json"), "session": session.configuration()})


if __name__ == "__main__":
    main()
