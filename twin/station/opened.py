"""A recording of any format, opened so that a session can be run over it."""

import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from estimators.disturbance import likeliest_disturbance, states_disturbances
from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.foreign import ForeignRecording, open_foreign
from twin.rig.recorded import HELD_BYTES, NotOursError, Recording, open_recording
from twin.rig.regroup import in_pieces, restored
from twin.rig.storage import Storage
from twin.station.answers import NOTHING_KNOWN, KnownAnswers, known_answers
from twin.station.confirm import accept_recording
from twin.station.orders import Order
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
    storage
        Of that recording.
    recompute
        Work every answer of the tuner out again, also where the recording holds the very same question's.
    piece_s
        Read in pieces of this size [s]; the session is given the recorded blocks all the same.
    from_s, to_s
        Part to play [s]; what lies before is taken into account, but not shown.
    speed
        1 keeps the time of the data, 0 does not wait.
    bind, port
        Where the page is served, if ``web``; port 0 takes a free one.
    accept
        Is shown a foreign recording before anything is made of it, and raises if what was guessed about it may not be
        used; unless given, nothing guessed is.
    """

    plant: str | None = None
    channels: Mapping[str, str] = field(default_factory=dict)
    sample_rate_hz: float | None = None
    sidecar: Path | None = None
    recording: Path | None = None
    window: bool = False
    web: bool = False
    storage: Storage | None = None
    recompute: bool = False
    piece_s: float | None = None
    from_s: float = 0.0
    to_s: float | None = None
    speed: float = 0.0
    bind: str = "127.0.0.1"
    port: int = 0
    accept: Callable[[ForeignRecording], None] = accept_recording


class BlockSource(Protocol):
    """Where blocks come from, as often as asked."""

    def __call__(self, from_sample: int = 0) -> Iterator[Block]:
        """Blocks that begin at a sample or later, in order."""


@dataclass(frozen=True, slots=True)
class Opened:
    """A recording of any format, ready to be replayed.

    Attributes
    ----------
    blocks
        Iterator over the blocks that begin at a sample (the first unless given) or later.
    commands, decisions
        The run's own: commands by identifier, and (sample, JSON) of decisions; None where the run had no session.
    known
        Answers of the run's tuner that hold here.
    """

    plant: Plant
    settings: SessionSettings
    sample_rate_hz: float
    channels: tuple[Channel, ...]
    n_samples: int
    blocks: BlockSource
    commands: dict[int, Command] | None
    acknowledgements: tuple[tuple[int, Acknowledgement], ...]
    fitted_rows: tuple[tuple[int, int], ...]
    remarks: tuple[str, ...]
    seed: int | None
    config_json: str
    timing: AsRecorded | None = None
    orders: tuple[tuple[int, Order], ...] = ()
    decisions: tuple[tuple[int, str], ...] | None = None
    known: KnownAnswers = NOTHING_KNOWN

    def session(self) -> Session:
        """Return a fresh session for the recording, which repeats what the run's own decided."""
        loop, tuner = self.settings.loop, None
        if loop is not None and self.timing is not None:
            tuner = TunerHere(self.plant, loop, self.settings.goal, self.timing, self.known)
        return Session(self.plant, self.channels, self.sample_rate_hz, self.settings, self.commands, tuner)


def open_any(path: Path, options: ReplayOptions) -> Opened:
    """Open a recording by its format.

    Raises
    ------
    InputError
        If there is no such file, or its format is unknown, or it cannot be read.
    """
    if not path.exists():
        raise InputError(f"{path}: no such recording; check the path")
    if path.is_dir() or path.suffix.lower() == ".rrd":
        try:
            return _open_own(path, options)
        except NotOursError:
            if options.plant is None:
                raise
    return _open_foreign(path, options)


def _open_own(path: Path, options: ReplayOptions) -> Opened:
    recording = open_recording(path, hold_bytes=HELD_BYTES)
    remarks = _condition(recording)
    plant = recording.plant
    settings = SessionSettings()
    commands: dict[int, Command] | None = None
    if options.plant is not None:
        plant = load_plant(options.plant)
        if plant.fingerprint != recording.plant.fingerprint:
            remarks.append(f"plant '{plant.name}' is not the one the recording was made with")
    known = NOTHING_KNOWN
    if not options.recompute:
        known = known_answers(recording.software.get("code_id"), recording.notes("answers"))
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
        blocks=_in_pieces(recording, options.piece_s),
        commands=commands,
        acknowledgements=recording.acknowledgements(),
        fitted_rows=(),
        remarks=tuple(remarks),
        seed=recording.seed,
        config_json=recording.run_config_json,
        timing=as_recorded(recording.notes("questions"), recording.notes("answers")),
        decisions=None if session is None else recording.notes("decisions"),
        known=known,
        orders=tuple((s, Order.model_validate_json(text)) for s, text in recording.notes("orders")),
    )


def _condition(recording: Recording) -> list[str]:
    """What a person should know of the files."""
    remarks = []
    if recording.damaged_rows:
        remarks.append(
            f"{recording.damaged_rows} pieces of the file are damaged and left out: blocks or decisions are missing"
        )
    elif recording.repaired:
        remarks.append("the file was cut short; what follows its last whole block is lost")
    elif not recording.finished:
        remarks.append("its recorder did not finish it: it was killed, or is still recording")
    if recording.missing_parts:
        numbers = ", ".join(map(str, recording.missing_parts))
        remarks.append(
            f"files {numbers} of the run are missing: what was learned and decided then is not known here"
        )
    if len(recording.parts) > 1:
        remarks.append(f"one run in {len(recording.parts)} files, to {recording.parts[-1].name}")
    return remarks


def _in_pieces(recording: Recording, piece_s: float | None) -> BlockSource:
    if piece_s is None:
        return recording.blocks
    n = round(piece_s * recording.sample_rate_hz)
    in_pieces((), max(n, 0))

    def blocks(from_sample: int = 0) -> Iterator[Block]:
        marks = [mark for mark in recording.marks if mark.first_sample >= from_sample]
        return restored(in_pieces(recording.blocks(from_sample), n), marks)

    return blocks


def _open_foreign(path: Path, options: ReplayOptions) -> Opened:
    if options.plant is None:
        raise InputError(f"{path}: says nothing about its plant; add --plant PRESET or --plant FILE.toml")
    plant = load_plant(options.plant)
    recording = open_foreign(
        path, plant, channels=options.channels, sample_rate_hz=options.sample_rate_hz, sidecar=options.sidecar
    )
    options.accept(recording)
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
        blocks=lambda from_sample=0: (b for b in recording.blocks() if b.first_sample >= from_sample),
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
