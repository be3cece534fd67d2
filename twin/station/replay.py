"""The same loop on a recording, as fast as it goes."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.station.frame import Frame
from twin.station.opened import Opened, ReplayOptions, open_any
from twin.station.orders import Order
from twin.station.outputs import Outputs
from twin.station.player import Player
from twin.station.prediction import PredictionScore
from twin.station.run import Loop
from twin.station.session import Session

__all__ = ["Opened", "Repeated", "ReplayOptions", "open_any", "run_replay"]


def run_replay(
    path: Path,
    options: ReplayOptions,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
    linger: Callable[[], None] | None = None,
    watch: Callable[[Session, Frame], None] | None = None,
    opened: Opened | None = None,
) -> dict[str, Any]:
    """Replay a recording through the loop.

    Parameters
    ----------
    path
        ``.rrd`` of this program, or any other format; a folder with one run.
    say
        Takes lines for the person.
    progress
        Takes samples done and samples in all.
    linger
        Called when the run is over and its recording finished, while the views are still served.
    watch
        Takes the session and each frame that counts, after everything else has.
    opened
        The recording, where it is open already.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        If the recording or the plant cannot be used; the message says why and what to do.
    """
    opened = open_any(path, options) if opened is None else opened
    for remark in opened.remarks:
        say(remark)
    session = opened.session()
    score = PredictionScore(
        opened.plant, opened.channels, opened.sample_rate_hz, session.observer.sources, opened.fitted_rows
    )
    session.warm_up()
    repeated = Repeated(opened)
    with Outputs(
        session,
        recording=options.recording,
        setup=f"# Replay of {path.name}",
        run_config_json=opened.config_json,
        seed=opened.seed,
        window=options.window,
        web=options.web,
        storage=options.storage,
    ) as outputs:
        if outputs.url:
            say(f"open {outputs.url}")
        loop = Loop(session, outputs)

        def turn(
            _: Session, block: Block, answers: tuple[Acknowledgement, ...], order: Order | None
        ) -> Frame:
            return loop.turn(block, answers, order)

        player = Player(opened, session, turn, checkpoint_s=None)
        player.seek(options.from_s)
        for frame in player.play(options.to_s, options.speed):
            repeated.add(frame)
            score.add(frame.block, frame.estimate)
            if watch is not None:
                watch(session, frame)
            progress(frame.block.end_sample, opened.n_samples)
        outputs.finish()
        if linger is not None:
            linger()
    scores = score.scores()
    return {
        **loop.log.figures(),
        "estimation": loop.log.estimation(),
        "file": str(path),
        "plant": opened.plant.name,
        "sample_rate_hz": opened.sample_rate_hz,
        "nrmse": _together([s.nrmse for s in scores]),
        "nrmse_without_input": _together([s.nrmse_without_input for s in scores]),
        "sensors": [asdict(s) for s in scores],
        "fitted_rows_left_out": [list(rows) for rows in opened.fitted_rows],
        "decisions_repeated": repeated.verdict,
        "answers_recomputed": session.answers_worked_out,
        "realtime_factor": loop.realtime_factor,
        "remarks": list(opened.remarks),
        "recording": str(options.recording) if options.recording is not None else None,
    }


class Repeated:
    """Whether a replay comes to the commands and decisions of the run itself.

    Parameters
    ----------
    opened
        The recording.
    """

    def __init__(self, opened: Opened) -> None:
        self._recorded_commands, self._recorded_decisions = opened.commands, opened.decisions
        self._n_samples = opened.n_samples
        self._commands: dict[int, Command] = {}
        self._decisions: list[tuple[int, str]] = []
        self._range: tuple[int, int] | None = None

    def add(self, frame: Frame) -> None:
        """Take one frame in."""
        self._commands.update({c.command_id: c for c in frame.commands})
        self._decisions += [(d.sample, json.dumps(asdict(d))) for d in frame.decisions]
        first = frame.block.first_sample if self._range is None else self._range[0]
        self._range = (first, frame.block.end_sample)

    @property
    def verdict(self) -> bool | None:
        """Whether both are the same over what was played; None where the run had no session, or nothing was."""
        if self._recorded_commands is None or self._recorded_decisions is None or self._range is None:
            return None
        first, end = self._range
        decided = [(s, text) for s, text in self._recorded_decisions if first <= s < end]
        told = self._recorded_commands
        if (first, end) != (0, self._n_samples):  # a part: those made in it must be the run's
            told = {k: c for k, c in told.items() if k in self._commands}
        return told == self._commands and decided == self._decisions


def _together(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known and len(known) == len(values) else None
