"""The same loop on a recording, as fast as it goes."""

import contextlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.station.frame import Frame
from twin.station.opened import Opened, ReplayOptions, open_any
from twin.station.orders import Order
from twin.station.outputs import Outputs
from twin.station.playback import Playback
from twin.station.player import CHECKPOINT_S, Player
from twin.station.prediction import PredictionScore
from twin.station.run import Loop
from twin.station.session import Session

if TYPE_CHECKING:
    from twin.station.page_server import OperatorPage

__all__ = ["Opened", "Repeated", "ReplayEnd", "ReplayOptions", "open_any", "run_replay"]


def run_replay(
    path: Path,
    options: ReplayOptions,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
    stay: Callable[[], bool] | None = None,
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
    stay
        With a page: whether it is to be served on though nobody looks at it. It is while somebody does.
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
        loop = Loop(session, outputs)
        page, playback = None, None

        def turn(
            current: Session, block: Block, answers: tuple[Acknowledgement, ...], order: Order | None
        ) -> Frame:
            loop.session = current  # another one after a jump
            return loop.turn(block, answers, order)

        def take(frame: Frame) -> None:
            repeated.add(frame)
            score.add(frame.block, frame.estimate)
            if watch is not None:
                watch(loop.session, frame)
            progress(frame.block.end_sample, opened.n_samples)

        player = Player(opened, session, turn, checkpoint_s=CHECKPOINT_S if options.web else None)
        if options.web:
            page, playback = _page(player, loop, opened, options)
        if page is None or playback is None:
            player.seek(options.from_s)
            for frame in player.play(options.to_s, options.speed):
                take(frame)
            outputs.finish()
        else:
            with page:
                say(f"operator page: {page.url}   Ctrl-C ends")
                if page.warning:
                    say(f"warning: {page.warning}")
                watched = page.desk.is_watched
                with contextlib.suppress(ReplayEnd):
                    playback.run(take, outputs.finish, lambda: watched() or (stay is not None and stay()))
            outputs.finish()
    jumped = playback is not None and playback.jumps > 0
    if jumped:
        say("there were jumps: the figures are of all that was shown, some of it perhaps twice")
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
        "decisions_repeated": None if jumped else repeated.verdict,
        "answers_recomputed": session.answers_worked_out,
        "realtime_factor": loop.realtime_factor,
        "remarks": list(opened.remarks),
        "recording": str(options.recording) if options.recording is not None else None,
    }


class ReplayEnd(BaseException):
    """The person at the terminal has had enough of a page."""


def _page(
    player: Player, loop: Loop, opened: Opened, options: ReplayOptions
) -> "tuple[OperatorPage, Playback]":
    """The page of a live run, but nothing can be sent, and the recording is played from there."""
    from twin.station.desk import Desk
    from twin.station.page_server import OperatorPage

    outputs = loop.outputs
    desk = Desk(player.session, unseen=lambda: outputs.frames_unseen, viewer_url=outputs.url)
    loop.desk = desk
    playback = Playback(
        player, opened.sample_rate_hz, opened.n_samples,
        speed=options.speed, from_s=options.from_s, to_s=options.to_s,
        seekable=options.recording is None, jumped=lambda: desk.jumped(player.session, player.time_s),
    )  # fmt: skip
    desk.playback = playback
    return OperatorPage(desk, options.bind, options.port), playback


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
