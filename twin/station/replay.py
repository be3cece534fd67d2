"""The same loop on a recording, as fast as it goes."""

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from estimators.disturbance import likeliest_disturbance, states_disturbances
from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.foreign import open_foreign
from twin.rig.recorded import open_recording
from twin.station.orders import Order
from twin.station.outputs import Outputs
from twin.station.prediction import PredictionScore
from twin.station.run import Loop
from twin.station.session import Session, SessionSettings, settings_from
from twin.station.worker import AsRecorded, TunerHere, as_recorded

DISTURBANCE_SAMPLES = 50_000
"""No more samples than these go into estimating an unknown disturbance."""


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """What the person asked for.

    Attributes
    ----------
    plant
        Preset or file; None takes the plant a recording carries.
    channels
        Plant channel to ``array:unit`` of a foreign recording.
    recording
        Where to record the replay; None for nowhere.
    """

    plant: str | None = None
    channels: Mapping[str, str] = field(default_factory=dict)
    sample_rate_hz: float | None = None
    sidecar: Path | None = None
    recording: Path | None = None
    window: bool = False
    web: bool = False


@dataclass(frozen=True, slots=True)
class Opened:
    """A recording of any format, ready to be replayed."""

    plant: Plant
    settings: SessionSettings
    sample_rate_hz: float
    channels: tuple[Channel, ...]
    n_samples: int
    blocks: Callable[[], Iterator[Block]]
    commands: dict[int, Command] | None
    acknowledgements: tuple[tuple[int, Acknowledgement], ...]
    fitted_rows: tuple[tuple[int, int], ...]
    remarks: tuple[str, ...]
    seed: int | None
    config_json: str
    timing: AsRecorded | None = None
    orders: tuple[tuple[int, Order], ...] = ()

    def session(self) -> Session:
        """Return a fresh session for the recording, which repeats what the run's own decided."""
        loop, tuner = self.settings.loop, None
        if loop is not None and self.timing is not None:
            tuner = TunerHere(self.plant, loop, self.settings.goal, self.timing)
        return Session(
            self.plant, self.channels, self.sample_rate_hz, self.settings, self.commands, tuner
        )


def run_replay(
    path: Path,
    options: ReplayOptions,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
    linger: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Replay a recording through the loop.

    Parameters
    ----------
    path
        ``.rrd`` of this program, or ``.npz``.
    say
        Takes lines for the person.
    progress
        Takes samples done and samples in all.
    linger
        Called when the run is over and its recording finished, while the views are still served.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        If the recording or the plant cannot be used; the message says why and what to do.
    """
    opened = open_any(path, options)
    for remark in opened.remarks:
        say(remark)
    session = opened.session()
    score = PredictionScore(
        opened.plant, opened.channels, opened.sample_rate_hz, session.observer.sources, opened.fitted_rows
    )
    session.warm_up()
    made: dict[int, Command] = {}
    answers = list(opened.acknowledgements)
    with Outputs(
        session,
        recording=options.recording,
        setup=f"# Replay of {path.name}",
        run_config_json=opened.config_json,
        seed=opened.seed,
        window=options.window,
        web=options.web,
    ) as outputs:
        if outputs.url:
            say(f"open {outputs.url}")
        loop = Loop(session, outputs)
        orders = list(opened.orders)
        for block in opened.blocks():
            due = tuple(a for sample, a in answers if sample < block.end_sample)
            answers = answers[len(due) :]
            order = orders.pop(0)[1] if orders and orders[0][0] < block.end_sample else None
            frame = loop.turn(block, due, order)
            made.update({c.command_id: c for c in frame.commands})
            score.add(block, frame.estimate)
            progress(block.end_sample, opened.n_samples)
        outputs.finish()
        if linger is not None:
            linger()
    scores = score.scores()
    return {
        **loop.log.figures(),
        "file": str(path),
        "plant": opened.plant.name,
        "sample_rate_hz": opened.sample_rate_hz,
        "nrmse": _together([s.nrmse for s in scores]),
        "nrmse_without_input": _together([s.nrmse_without_input for s in scores]),
        "sensors": [asdict(s) for s in scores],
        "fitted_rows_left_out": [list(rows) for rows in opened.fitted_rows],
        "decisions_repeated": None if opened.commands is None else made == opened.commands,
        "realtime_factor": loop.realtime_factor,
        "remarks": list(opened.remarks),
        "recording": str(options.recording) if options.recording is not None else None,
    }


def open_any(path: Path, options: ReplayOptions) -> Opened:
    """Open a recording by its format.

    Raises
    ------
    InputError
        If there is no such file, or its format is unknown, or it cannot be read.
    """
    if not path.exists():
        raise InputError(f"{path}: no such recording; check the path")
    if path.suffix.lower() == ".rrd":
        return _open_own(path, options)
    return _open_foreign(path, options)


def _open_own(path: Path, options: ReplayOptions) -> Opened:
    recording = open_recording(path)
    remarks = (
        ["the file was cut short; what follows its last whole block is lost"] if recording.repaired else []
    )
    plant = recording.plant
    settings = SessionSettings()
    commands: dict[int, Command] | None = None
    if options.plant is not None:
        plant = load_plant(options.plant)
        if plant.fingerprint != recording.plant.fingerprint:
            remarks.append(f"plant '{plant.name}' is not the one the recording was made with")
    try:
        session = json.loads(recording.run_config_json).get("session")
    except (json.JSONDecodeError, AttributeError):
        session = None
    if session is not None:
        settings = settings_from(session)
        commands = {c.command_id: c for c in recording.commands()}
    return Opened(
        plant=plant,
        settings=settings,
        sample_rate_hz=recording.sample_rate_hz,
        channels=recording.channels,
        n_samples=recording.end_sample,
        blocks=recording.blocks,
        commands=commands,
        acknowledgements=recording.acknowledgements(),
        fitted_rows=(),
        remarks=tuple(remarks),
        seed=recording.seed,
        config_json=recording.run_config_json,
        timing=as_recorded(recording.notes("questions"), recording.notes("answers")),
        orders=tuple((s, Order.model_validate_json(text)) for s, text in recording.notes("orders")),
    )


def _open_foreign(path: Path, options: ReplayOptions) -> Opened:
    if options.plant is None:
        raise InputError(f"{path}: says nothing about its plant; add --plant PRESET or --plant FILE.toml")
    plant = load_plant(options.plant)
    recording = open_foreign(
        path, plant, channels=options.channels, sample_rate_hz=options.sample_rate_hz, sidecar=options.sidecar
    )
    remarks = [*(str(entry) for entry in recording.mapping), *recording.notes]
    fitted = tuple((f.first_row, f.last_row) for f in plant.fitted_on if f.recording == path.name)
    if not states_disturbances(plant):
        plant, rows, remark = _estimate_disturbance(plant, recording.blocks(), recording.n_samples, fitted)
        remarks.append(remark)
        fitted = fitted or (rows,)
    return Opened(
        plant=plant,
        settings=SessionSettings(),
        sample_rate_hz=recording.sample_rate_hz,
        channels=recording.channels,
        n_samples=recording.n_samples,
        blocks=recording.blocks,
        commands=None,
        acknowledgements=(),
        fitted_rows=fitted,
        remarks=tuple(remarks),
        seed=None,
        config_json=json.dumps({"source": path.name}),
    )


def _estimate_disturbance(
    plant: Plant, blocks: Iterator[Block], n_samples: int, fitted: tuple[tuple[int, int], ...]
) -> tuple[Plant, tuple[int, int], str]:
    """Fill in the disturbance from rows that are then not scored: the fitted ones, else the first half."""
    first, end = fitted[0] if fitted else (0, n_samples // 2)
    end = min(end, first + DISTURBANCE_SAMPLES)
    some = [b for b in itertools.takewhile(lambda b: b.end_sample <= end, blocks) if b.first_sample >= first]
    if not some:
        return plant, (0, 0), "the plant states no disturbance and the recording is too short to tell one"
    found = likeliest_disturbance(plant, some)
    unit = "N/sqrt(Hz)" if found.kind == "white" else "N/s/sqrt(Hz)"
    rows = (some[0].first_sample, some[-1].end_sample)
    remark = (
        f"the plant states no disturbance; a {found.kind} force of {found.density:.3g} {unit} explains rows "
        f"{rows[0]} to {rows[1]} best, and those rows are not scored"
    )
    return found.plant, rows, remark


def _together(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known and len(known) == len(values) else None
