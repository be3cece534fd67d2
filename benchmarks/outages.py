"""Rig, station, viewer and browser struck in every order: all 24 permutations, which takes a quarter of an hour.

Run: python benchmarks/outages.py [--orders N] [--json FILE|-]. Of every permutation one part is struck after the other
while those before are still down, with killing, ending and stopping in turn; then they start in the same order. What
must hold is checked after every blow, see `tests/outages.py`.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from outages import BLOWS, PARTS, Everything, everything
from station_processes import ATMD

from twin.station.doctor import find_browser


def campaign(four: Everything, orders: int) -> dict[str, Any]:
    """Go through the permutations; returns what was measured."""
    blows = itertools.cycle(BLOWS)
    done = 0
    for order in list(itertools.permutations(PARTS))[:orders]:
        for part in order:
            four.strike(part, next(blows))
        for part in order:
            four.start(part)
        four.settle()
        next(blows)  # four blows and three kinds: the next permutation begins with another kind
        done += 1
        sys.stderr.write(f"{done}: {' '.join(order)}; safe after {four.safe_after_ms} ms\n")
    said = four.both.end_live()
    four.processes["station"] = None
    unread = []
    for recording in four.recordings:
        if recording.exists():
            verified = subprocess.run(
                [ATMD, "recordings", "verify", recording], capture_output=True, check=False
            )
            if verified.returncode:
                unread.append(recording.name)
    return {
        "orders": done,
        "safe_after_ms": four.safe_after_ms,
        "safe_after_ms_max": max(four.safe_after_ms, default=None),
        "exit_codes": {what: sorted(codes) for what, codes in four.exit_codes.items()},
        "exit_code_at_the_end": four.both.live.returncode,
        "traceback": "Traceback" in said,
        "recordings": len(four.recordings),
        "recordings_that_were_cut_off": unread,
    }


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--orders", type=int, default=24)
    parser.add_argument("--json", metavar="FILE")
    given = parser.parse_args()
    with (
        tempfile.TemporaryDirectory(prefix="outages-") as folder,
        everything(Path(folder), find_browser()) as four,
    ):
        text = json.dumps(campaign(four, given.orders), indent=2) + "\n"
    if given.json in (None, "-"):
        sys.stdout.write(text)
    else:
        Path(given.json).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
