"""``python -m recordings [--expected] FOLDER ...``: make recorded tests anew, or only their expected results."""

import argparse
import json
import os
import tempfile
import tomllib
from pathlib import Path

# Before anything imports NumPy: its library reads these once.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

from recordings.results import CONFIG, EXPECTED, FOLDER, RECORDING, replay_results  # noqa: E402
from twin.rig.recorded import open_recording  # noqa: E402
from twin.rig.recording import Recorder  # noqa: E402
from twin.station.demo import DemoOptions, run_demo  # noqa: E402

NOTES = ("events", "decisions")


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
    """Run the demonstration as the folder's configuration says and keep what a replay needs of its recording."""
    config = tomllib.loads((folder / CONFIG).read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as scratch:
        whole = Path(scratch) / "whole.rrd"
        result = run_demo(DemoOptions(**config, recording=whole, speed=0.0), print, lambda _done, _of: None)
        if "error" in result:
            raise SystemExit(result["error"])
        run = open_recording(whole)
        recorder = Recorder(
            folder / RECORDING,
            plant=run.plant,
            sample_rate_hz=run.sample_rate_hz,
            channels=run.channels,
            run_config_json=run.run_config_json,
            seed=run.seed,
            overwrite=True,
        )
        with recorder:
            for block in run.blocks():
                recorder.write_block(block)
            for command in run.commands():
                recorder.write_command(command)
            for sample, answer in run.acknowledgements():
                recorder.write_acknowledgement(answer, sample)
            for kind in NOTES:
                for sample, text in run.notes(kind):
                    recorder.write_note(kind, sample, text)


def write_expected(folder: Path) -> None:
    """Replay the folder's recording and keep its results, but for the bits, which are the machine's own."""
    results = replay_results(folder / RECORDING)
    del results["digest"]
    (folder / EXPECTED).write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
