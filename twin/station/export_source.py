"""Where ``atmd export`` takes a schedule from: a recording, a tuning, a schedule handed over before, or a rule."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from tuning.loop import LoopFacts, loop_facts
from tuning.rule import scheduling_rule
from tuning.types import BudgetKind
from twin.control.schedule import GainSchedule
from twin.plant.config import DampingTable, Frozen, Plant, Positive
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.station.analyse import parse_frequencies
from twin.station.handover import Budget, complaints, parse_handover, read_text

if TYPE_CHECKING:
    from twin.rig.recorded import Recording

FixedPoint = Literal["auto", "Q15", "Q31", "none"]

SAMPLE_RATE_HZ, DELAY_US = 50_000.0, 50.0


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """What the person asked for; None leaves it to the source, or to a default where that does not say.

    ``solves`` semidefinite programs at most are spent on a faster sweep, see `tuning.transition`.
    """

    out: Path
    file: Path | None = None
    plant: str | None = None
    rule: str | None = None
    band: str = "45:55:0.5"
    fixed_point: FixedPoint = "auto"
    most_lost_percent: float = 5.0
    budget_w: float | None = None
    budget_kind: BudgetKind | None = None
    excitation: float | None = None
    delay_us: float | None = None
    made: str | None = None
    solves: int = 2


@dataclass(frozen=True, slots=True)
class Source:
    """A schedule and what its source says about it.

    Attributes
    ----------
    configured
        The plant as its file has it, whose fingerprint is handed over.
    plant
        The same with the damping that the figures are computed with.
    """

    schedule: GainSchedule
    configured: Plant
    plant: Plant
    facts: LoopFacts
    budget: Budget | None
    amplitude: float | None
    words: str


def check_options(o: ExportOptions) -> None:
    """Raise InputError for an option that cannot be used; the message names it and the remedy."""
    if (o.file is None) == (o.rule is None):
        raise InputError("give either a FILE (.rrd or .json) or --rule thesis with --plant")
    if o.rule is not None and o.plant is None:
        raise InputError("--rule: says nothing about the plant; add --plant PRESET or --plant FILE.toml")
    if o.rule not in (None, "thesis"):
        raise InputError(f"--rule {o.rule}: no such rule; known: thesis")
    for name, value, unit in (
        ("budget-w", o.budget_w, "W"),
        ("excitation", o.excitation, "its actuator's unit"),
    ):
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"--{name} {value:g}: give a number above 0 in {unit}")
    if o.delay_us is not None and not 0.0 <= o.delay_us <= 1e4:
        raise InputError(f"--delay-us {o.delay_us:g}: give the delay in µs, from 0 to 1e4, such as 50")
    if not 0.0 <= o.most_lost_percent < 100.0:
        raise InputError(
            f"--margin-loss {o.most_lost_percent:g}: give a share in percent, from 0 to below 100"
        )
    if o.budget_kind is not None and o.budget_w is None:
        raise InputError("--budget: says which power is bounded; add --budget-w with how much")
    if o.out.exists() and not o.out.is_dir():
        raise InputError(f"--out {o.out}: is no folder; give one")


def read_source(options: ExportOptions, say: Callable[[str], None]) -> Source:
    """Read the schedule and what its source says about it.

    Raises
    ------
    InputError
        If there is none, or it is for another plant.
    """
    file = options.file
    if file is None:
        found = _from_rule(options)
    elif file.suffix.lower() == ".rrd":
        found = _from_recording(file, options, say)
    elif file.suffix.lower() == ".json":
        found = _from_json(file, options)
    else:
        raise InputError(
            f"{file}: a schedule is read from a recording (.rrd) or from the .json of 'atmd tune'"
        )
    if options.delay_us is None:
        return found
    facts = found.facts
    return replace(found, facts=loop_facts(facts.sample_rate_hz, 1e-6 * options.delay_us, facts.relative))


def _default_facts() -> LoopFacts:
    return loop_facts(SAMPLE_RATE_HZ, 1e-6 * DELAY_US)


def _from_rule(options: ExportOptions) -> Source:
    plant = load_plant(str(options.plant))
    try:
        schedule = scheduling_rule(plant, parse_frequencies(options.band))
    except InputError as error:
        raise InputError(str(error).replace("--at", "--band")) from error
    except ValueError as error:
        raise InputError(f"--band {options.band}, --plant {options.plant}: {error}") from error
    return Source(
        schedule, plant, plant, _default_facts(), None, None, "the scheduling rule of the thesis (eq. 6-5)"
    )


def _from_json(path: Path, options: ExportOptions) -> Source:
    text = read_text(path)
    try:
        data = json.loads(text)
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); give what 'atmd tune --json' wrote") from error
    if isinstance(data, dict) and data.get("format") == "atmd-schedule":
        return _from_handover(path, text, options)
    try:
        tuned = _Tuned.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{path}: {complaints(error)}; give what 'atmd tune --json' wrote") from error
    name = options.plant or tuned.plant
    if name is None:
        raise InputError(f"{path}: says nothing about its plant; add --plant PRESET or --plant FILE.toml")
    plant = load_plant(name)
    _same_plant(path, tuned.fingerprint, plant)
    budget = None
    if tuned.budget_w is not None:
        budget = Budget(power_w=tuned.budget_w, kind=tuned.budget_kind)
    if tuned.plant not in (None, plant.name):
        raise InputError(f"{path}: is for plant '{tuned.plant}', not for '{plant.name}'; change --plant")
    facts = loop_facts(tuned.sample_rate_hz, tuned.loop_delay_s)
    words = f"tuning {path.name}"
    return Source(tuned.schedule(path), plant, plant, facts, budget, tuned.excitation, words)


def _from_handover(path: Path, text: str, options: ExportOptions) -> Source:
    old = parse_handover(text, path)
    configured = load_plant(options.plant or old.plant)
    _same_plant(path, old.fingerprint, configured)
    plant = configured
    if plant.absorber is not None:
        plant = plant.with_damping(plant.absorber.name, old.damping_ns_m)
    return Source(
        old.schedule, configured, plant, old.loop.facts, old.budget, old.excitation.amplitude, old.source
    )


def _from_recording(path: Path, options: ExportOptions, say: Callable[[str], None]) -> Source:
    from twin.rig.recorded import open_recording
    from twin.station.session import settings_from

    recording = open_recording(path)
    if options.plant is not None:
        _same_plant(path, recording.plant.fingerprint, load_plant(options.plant))
    try:
        run = json.loads(recording.run_config_json)
        settings = settings_from(run["session"])
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: holds no run of a rig with a controller; nothing can be handed over"
        ) from error
    if settings.loop is None or settings.schedule is None:
        raise InputError(f"{path}: its rig had no controller to tune; nothing can be handed over")
    accepted = {a.command_id: a.applied_at_sample for _, a in recording.acknowledgements() if a.accepted}
    applied = [
        (accepted[c.command_id] or 0, c.command_id, c.schedule)
        for c in recording.commands()
        if c.schedule is not None and c.command_id in accepted
    ]
    schedule, words = settings.schedule, f"recording {path.name}, the schedule it started with"
    if applied:
        sample, number, schedule = max(applied, key=lambda entry: entry[:2])
        at = sample / recording.sample_rate_hz
        words = f"recording {path.name}, command {number} in force from {at:.1f} s"
    else:
        say(f"{path.name}: the rig took no new schedule; the one it started with is handed over")
    plant = recording.plant
    learned = _learned_damping(recording)
    if learned is not None and plant.absorber is not None:
        plant = plant.with_damping(plant.absorber.name, learned)
        words += ", figures with the damping learned in it"
    goal = settings.goal
    budget = Budget(power_w=goal.budget_w, kind=goal.budget_kind)
    sweep = run.get("programme", {}).get("sweep", {})
    amplitude = next(
        (sweep[key] for key in ("amplitude_v", "amplitude_n", "amplitude_a") if key in sweep), None
    )
    return Source(schedule, recording.plant, plant, settings.loop, budget, amplitude, words)


def _learned_damping(recording: "Recording") -> DampingTable | None:
    """Damping in use at the end of a recording, by going through its blocks as a replay does; None if none was."""
    from twin.station.session import Session, SessionSettings

    session = Session(recording.plant, recording.channels, recording.sample_rate_hz, SessionSettings())
    curve = None
    for block in recording.blocks():
        curve = session.advance(block).curve or curve
    if curve is None or curve.status == "unestimated":
        return None
    values = np.maximum(curve.in_use_ns_m, 0.0)
    return DampingTable(frequency_hz=tuple(curve.frequency_hz.tolist()), ns_m=tuple(values.tolist()))


def _same_plant(path: Path, fingerprint: str | None, plant: Plant) -> None:
    if fingerprint is not None and fingerprint != plant.fingerprint:
        raise InputError(
            f"{path}: is for a plant with fingerprint {fingerprint}, '{plant.name}' has {plant.fingerprint}; "
            "give the plant it was made for with --plant"
        )


class _Gains(Frozen):
    alpha_kg: float
    beta_ns_m: float
    gamma_n_m: float


class _Cutoffs(Frozen):
    low_pass_hz: Positive
    high_pass_hz: Positive


class _Loose(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)


class _TunedPoint(_Loose):
    frequency_hz: Positive
    gains: _Gains | None
    cutoffs: _Cutoffs | None
    reason: str = "no gains"


class _Tuned(_Loose):
    """What ``atmd tune --json`` writes, as far as it matters here."""

    points: tuple[_TunedPoint, ...] = Field(min_length=1)
    plant: str | None = None
    fingerprint: str | None = None
    budget_w: Positive | None = None
    budget_kind: BudgetKind = "joule_mean"
    excitation: Positive | None = None
    loop_delay_s: float = Field(default=1e-6 * DELAY_US, ge=0.0)
    sample_rate_hz: Positive = SAMPLE_RATE_HZ

    @model_validator(mode="after")
    def _rising(self) -> Self:
        hz = [p.frequency_hz for p in self.points]
        if sorted(set(hz)) != hz:
            raise ValueError("frequency_hz must rise from point to point")
        return self

    def schedule(self, path: Path) -> GainSchedule:
        """The points as a table; the controller acts between its ends."""
        hz = tuple(p.frequency_hz for p in self.points)
        rows = [(p.gains, p.cutoffs) for p in self.points if p.gains is not None and p.cutoffs is not None]
        if len(rows) < len(hz):
            bare = next(p for p in self.points if p.gains is None or p.cutoffs is None)
            raise InputError(
                f"{path}: has no gains at {bare.frequency_hz:g} Hz ({bare.reason}); tune with a larger budget or a "
                "narrower band"
            )
        try:
            return GainSchedule(
                frequency_hz=hz,
                alpha_kg=tuple(gains.alpha_kg for gains, _ in rows),
                beta_ns_m=tuple(gains.beta_ns_m for gains, _ in rows),
                gamma_n_m=tuple(gains.gamma_n_m for gains, _ in rows),
                low_pass_hz=tuple(cutoffs.low_pass_hz for _, cutoffs in rows),
                high_pass_hz=tuple(cutoffs.high_pass_hz for _, cutoffs in rows),
                on_from_hz=hz[0],
                on_to_hz=hz[-1],
            )
        except ValidationError as error:
            raise InputError(f"{path}: {complaints(error)}") from error
