"""What a recording comes to when it is replayed: everything that must come out the same again."""

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

from twin.station.opened import ReplayOptions, open_any
from twin.station.player import Player
from twin.station.summary import RunLog

FOLDER = Path(__file__).resolve().parent
RECORDING, CONFIG, EXPECTED = "recording.rrd", "config.toml", "expected.json"


RECOMPUTED = ReplayOptions(recompute=True)


def replay_results(path: Path, options: ReplayOptions = RECOMPUTED) -> dict[str, Any]:
    """Replay one recording through a session, every answer of the tuner worked out again unless told otherwise.

    Returns
    -------
    dict
        ``figures`` of the run; ``damping``, the learned curve; ``estimate``, the observer's last state;
        ``events``, ``decisions`` and ``commands`` in order; ``commands_repeated``, whether they are the run's own;
        ``digest`` of every estimate's and every twin's bits, the same on the same machine only.
    """
    opened = open_any(path, options)
    player = Player(opened, checkpoint_s=None)
    player.session.warm_up()
    log, digest = RunLog(), hashlib.sha256()
    decisions, commands = [], []
    events: list[str] = []
    for frame in player.play():
        log.add(frame)
        events += [event.text for event in frame.events]
        digest.update(frame.twin.tobytes())
        digest.update(frame.estimate.mean.tobytes())
        digest.update(frame.estimate.covariance.tobytes())
        if frame.curve is not None:
            digest.update(frame.curve.damping_ns_m.tobytes())
        decisions += [asdict(decision) for decision in frame.decisions]
        commands += frame.commands
    made = {command.command_id: command for command in commands}
    curve = log.curve
    return {
        "figures": {k: v for k, v in log.figures().items() if v is not None},
        "damping": None
        if curve is None
        else {
            "frequency_hz": curve.frequency_hz.tolist(),
            "damping_ns_m": curve.damping_ns_m.tolist(),
            "std_ns_m": curve.std_ns_m.tolist(),
            "in_use_ns_m": curve.in_use_ns_m.tolist(),
            "status": curve.status,
        },
        "estimate": dict(zip(frame.estimate.states, frame.estimate.mean[-1].tolist(), strict=True)),
        "events": events,
        "decisions": decisions,
        "commands": [command.model_dump(mode="json") for command in commands],
        "commands_repeated": None if opened.commands is None else made == opened.commands,
        "digest": digest.hexdigest(),
    }


def recorded_tests() -> list[Path]:
    """Folders of all recorded tests."""
    return sorted(path.parent for path in FOLDER.glob(f"*/{EXPECTED}"))
