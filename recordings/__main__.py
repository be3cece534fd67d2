"""``python -m recordings [--expected] FOLDER ...``: make recorded tests anew, or only their expected results."""

import argparse
import json
import os
import tomllib
from dataclasses import asdict
from pathlib import Path

# Before anything imports NumPy: its library reads these once.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

from recordings.results import CONFIG, EXPECTED, FOLDER, RECORDING, replay_results  # noqa: E402
from twin.plant.blocks import make_block  # noqa: E402
from twin.rig.programme import Programme  # noqa: E402
from twin.rig.recording import Recorder  # noqa: E402
from twin.rig.simulated import SimulatedRig  # noqa: E402
from twin.rig.tests_of_chapter_7 import programme  # noqa: E402
from twin.station.session import Session, SessionSettings  # noqa: E402


def main() -> None:
    """Make what was asked for."""
    parser = argparse.ArgumentParser(prog="python -m recordings", description=__doc__)
    parser.add_argument("folder", nargs="+", help="names of folders here that hold a config.toml")
    parser.add_argument("--expected", action="store_true", help="keep the recording, write its results anew")
    options = parser.parse_args()
    for name in options.folder:
        folder = FOLDER / name
        if not options.expected:
            record(folder)
        write_expected(folder)


def record(folder: Path) -> None:
    """Run the simulated rig as the folder's configuration says, the twin beside it, and record it."""
    config = tomllib.loads((folder / CONFIG).read_text(encoding="utf-8"))
    run = programme(
        config["test"], seconds=config["seconds"], sweep_hz=tuple(config["sweep_hz"]), seed=config["seed"]
    )
    rig = SimulatedRig(run)
    session = Session(run.plant, rig.channels, run.sample_rate_hz, SessionSettings())
    recorder = Recorder(
        folder / RECORDING,
        plant=run.plant,
        sample_rate_hz=run.sample_rate_hz,
        channels=rig.channels,
        run_config_json=_run_config(run, session),
        seed=run.seed,
        overwrite=True,
    )
    with recorder:
        while not rig.finished:
            first = rig.next_sample
            values, control_on, _ = rig.next_block()
            block = make_block(
                first,
                run.sample_rate_hz,
                values,
                rig.channels,
                control_on=control_on,
                config_id=run.plant.fingerprint,
            )
            frame = session.advance(block)
            recorder.write_block(block)
            for event in frame.events:
                recorder.write_note("events", event.sample, json.dumps(asdict(event)))


def write_expected(folder: Path) -> None:
    """Replay the folder's recording and keep its results, but for the bits, which are the machine's own."""
    results = replay_results(folder / RECORDING)
    del results["digest"]
    (folder / EXPECTED).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def _run_config(run: Programme, session: Session) -> str:
    return json.dumps({"programme": run.model_dump(mode="json"), "session": session.configuration()})


if __name__ == "__main__":
    main()
