"""Rig, station, viewer and browser killed, ended and stopped, each after every other one, and started again."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

from outages import BLOWS, PARTS, Part, every_pair, everything
from station_processes import atmd


def test_each_is_struck_after_every_other_and_the_rig_is_safe_and_the_recording_readable(
    tmp_path: Path, requires_debian: Callable[[str], Path]
) -> None:
    walk = every_pair()
    assert {(a, b) for a, b in pairwise(walk)} == {(a, b) for a in PARTS for b in PARTS if a != b}
    chromium = requires_debian("chromium")
    struck: dict[Part, int] = dict.fromkeys(PARTS, 0)
    with everything(tmp_path, chromium) as four:
        down: Part | None = None
        for part in walk[:-1]:
            # The next one is struck while the one before is still down, which then comes back.
            four.strike(part, BLOWS[struck[part] % len(BLOWS)])
            struck[part] += 1
            if down is not None:
                four.start(down)
            down = part
            if four.up("rig") and four.up("station"):
                four.settle()
        if down is not None:
            four.start(down)
        four.settle()
        said = four.both.end_live()
        four.processes["station"] = None
        assert four.both.live.returncode == 0, said
        assert "Traceback" not in said
        assert four.exit_codes["station kill"] == {-9}
        assert four.exit_codes["station end"] == {0}
        assert four.exit_codes["rig end"] == {0}
        assert len(four.safe_after_ms) >= 2
        assert max(four.safe_after_ms) <= 500.0
        for recording in four.recordings:
            if recording.exists():
                verified = atmd("recordings", "verify", recording)
                assert verified.returncode == 0 or "repair" in verified.stdout + verified.stderr
