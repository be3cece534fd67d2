"""From a specification to cases, and from a handful of cases to their rows: what a thread or a worker does."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from tuning.campaign.batch import Case, run_cases
from tuning.campaign.batch import Excitation as Shape
from tuning.campaign.figures import Goal, Judge
from tuning.campaign.kernel import TILE
from tuning.campaign.sampling import drawn_values
from tuning.campaign.scatter import (
    AMPLITUDE,
    LOOP_DELAY,
    check_parameter,
    noise_seed,
    nominal,
    scattered_plant,
)
from tuning.loop import LoopFacts, loop_facts
from tuning.retune import NoGainsError, Retuner, TuningGoal
from tuning.rule import scheduling_rule
from twin.control.filters import paired_low_pass_hz
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.excitation import Excitation, exciter
from twin.station.analyse import parse_frequencies
from twin.station.campaign.spec import CampaignSpec, FromFile, Retuned, ThesisRule

RETUNED_TOGETHER = 8
"""Cases of a job where every case is retuned: a job shall not take minutes."""

FEWEST_PIECES, MOST_TILES = 64, 16
"""A large campaign is cut into larger pieces, so that its folder does not fill with small files."""


@dataclass(frozen=True, slots=True)
class Job:
    """Draws ``[first, last)`` of one combination of plant, budget and excitation."""

    number: int
    combination: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Campaign:
    """A specification with all it names read in: what is sent to a worker.

    Attributes
    ----------
    plants
        Nominal, in the specification's order.
    schedules
        Of each combination; None where every case has its own.
    """

    spec: CampaignSpec
    plants: tuple[Plant, ...]
    schedules: tuple[GainSchedule | None, ...]

    @property
    def fingerprint(self) -> str:
        """Of everything that decides the results."""
        text = json.dumps(
            [
                self.spec.model_dump(mode="json"),
                [p.model_dump(mode="json") for p in self.plants],
                [None if s is None else s.model_dump(mode="json") for s in self.schedules],
            ],
            sort_keys=True,
        )
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def jobs(self) -> list[Job]:
        """All the work, in pieces of whole tiles; the cut follows from the specification alone."""
        retuned = isinstance(self.spec.schedule, Retuned) and self.spec.schedule.per_case
        tiles = min(MOST_TILES, max(1, self.spec.cases // (FEWEST_PIECES * TILE)))
        size = RETUNED_TOGETHER if retuned else tiles * TILE
        pieces = [
            (c, first)
            for c in range(len(self.spec.combinations))
            for first in range(0, self.spec.draws, size)
        ]
        return [Job(k, c, first, min(first + size, self.spec.draws)) for k, (c, first) in enumerate(pieces)]


@dataclass(frozen=True, slots=True)
class Drawn:
    """One case: what was drawn, and what becomes of it in the plant."""

    number: int
    draw: int
    parameters: dict[str, float]
    case: Case
    refused_hz: tuple[float, ...]


def prepare(spec: CampaignSpec, folder: Path, say: Callable[[str], None]) -> Campaign:
    """Read the plants and schedules that a specification names.

    Parameters
    ----------
    folder
        Of the specification: paths in it start there.

    Raises
    ------
    InputError
        If something cannot be used; the message names the key and the remedy.
    """
    plants = tuple(load_plant(place(folder, name)) for name in spec.plants)
    for plant in plants:
        for s in spec.scatter:
            check_parameter(s.parameter, plant)
    for key, text in (
        ("report_hz", spec.report_hz),
        ("schedule.at_hz", getattr(spec.schedule, "at_hz", "45")),
    ):
        try:
            parse_frequencies(text)
        except InputError as error:
            raise InputError(str(error).replace("--at", key)) from error
    schedules: list[GainSchedule | None] = []
    for plant_index, budget, e in spec.combinations:
        plant, excitation = plants[plant_index], spec.excitation[e]
        try:
            exciter(plant, excitation)
        except ValueError as error:
            raise InputError(f"excitation[{e}]: {error}") from error
        facts = _facts(spec, spec.delay_us)
        if isinstance(spec.schedule, FromFile):
            schedules.append(_from_file(spec.schedule, folder, plant, say))
        elif getattr(spec.schedule, "per_case", False):
            schedules.append(None)
        else:
            found, refused = _schedule(spec, plant, facts, excitation.amplitude, budget)
            if refused:
                at = ", ".join(f"{f:g}" for f in refused)
                say(
                    f"{plant.name}, {spec.budgets_w[budget]:g} W: the tuner has no gains at {at} Hz; none act there"
                )
            schedules.append(found)
    campaign = Campaign(spec, plants, tuple(schedules))
    _check(campaign)
    return campaign


def drawn_case(campaign: Campaign, number: int) -> Drawn:
    """One case by its number, whatever the others are.

    Raises
    ------
    InputError
        If there is no such case.
    """
    spec = campaign.spec
    if not 0 <= number < spec.cases:
        raise InputError(f"case {number}: there is none; give a number from 0 to {spec.cases - 1}")
    combination, draw = divmod(number, spec.draws)
    p, budget, e = spec.combinations[combination]
    plant, excitation = campaign.plants[p], spec.excitation[e]
    drawn = drawn_values(spec.scatter, spec.correlation, spec.sampling, spec.seed, spec.draws, draw)
    absolute = {s.parameter: s.scale == "absolute" for s in spec.scatter}
    base = {LOOP_DELAY: spec.delay_us, AMPLITUDE: excitation.amplitude}
    values = {}
    for name, value in drawn.items():
        own = base[name] if name in base else nominal(plant, name)
        # What is given against frequency is told by its factor.
        values[name] = value if absolute[name] or own is None else value * own
    own_plant = scattered_plant(plant, spec.scatter, drawn)
    facts = _facts(spec, values.get(LOOP_DELAY, spec.delay_us))
    amplitude = values.get(AMPLITUDE, excitation.amplitude)
    schedule = campaign.schedules[combination]
    refused: tuple[float, ...] = ()
    if schedule is None:
        schedule, refused = _schedule(spec, own_plant, facts, amplitude, budget)
    seed = noise_seed(spec.seed, draw) if spec.sensor_noise else None
    case = Case(own_plant, facts, schedule, amplitude, exciter(plant, excitation).name, seed)
    return Drawn(number, draw, values, case, refused)


def run_job(
    campaign: Campaign, job: Job, stopped: Callable[[], bool] = lambda: False
) -> list[dict[str, Any]]:
    """Rows of a job's cases; none if it was told to stop."""
    spec = campaign.spec
    p, budget, e = spec.combinations[job.combination]
    shape = shape_of(spec, e)
    drawn = []
    for draw in range(job.first, job.last):
        if stopped():
            return []
        drawn.append(drawn_case(campaign, job.combination * spec.draws + draw))
    run = run_cases([d.case for d in drawn], shape)
    judge = judge_of(campaign, budget, e)
    rows = []
    for k, d in enumerate(drawn):
        if stopped():
            return []
        figures = asdict(judge.figures(d.case, run.figures[:, :, k], float(run.tripped_at_s[k])))
        rows.append(
            {
                "case": d.number,
                "draw": d.draw,
                "plant": campaign.plants[p].name,
                "excitation": spec.excitation[e].description,
                "budget_w": spec.budgets_w[budget] if budget >= 0 else None,
                **figures,
                "refused_points": len(d.refused_hz),
                **{f"drawn {name}": value for name, value in d.parameters.items()},
            }
        )
    return rows


def judge_of(campaign: Campaign, budget: int, excitation: int) -> Judge:
    """Judge of a combination's cases."""
    spec = campaign.spec
    goal = Goal(
        displacement_m=spec.goal.displacement_m,
        attenuation=spec.goal.attenuation,
        budget_w=spec.budgets_w[budget] if budget >= 0 else None,
        budget_kind=spec.budget_kind,
        settle_s=spec.goal.settle_s,
    )
    return Judge(shape_of(spec, excitation), goal, parse_frequencies(spec.report_hz))


def shape_of(spec: CampaignSpec, excitation: int) -> Shape:
    """Excitation of amplitude 1 as the kernel takes it."""
    return _shape(spec.excitation[excitation].model_dump_json(), spec, excitation)


@lru_cache(maxsize=4)
def _shape(_key: str, spec: CampaignSpec, index: int) -> Shape:
    excitation: Excitation = spec.excitation[index]
    unit = excitation.model_copy(update={f"amplitude_{excitation.unit.lower()}": 1.0})
    fs, n = spec.sample_rate_hz, block_samples(spec)
    blocks = int(excitation.duration_s * fs + 1e-6) // n
    rows, edges = [], []
    for b in range(blocks):
        spans = unit.spans(b * n, n, fs)
        for k, span in enumerate(spans):
            rows.append((span.first, span.stop, float(k == len(spans) - 1)))
            edges.append((span.from_hz, span.to_hz))
    arrays = unit.samples(0, blocks * n, fs), np.array(rows, dtype=np.float64), np.array(edges)
    for array in arrays:
        array.flags.writeable = False
    return Shape(*arrays, fs)


def block_samples(spec: CampaignSpec) -> int:
    """Samples of a block of the rig."""
    return max(1, round(spec.block_s * spec.sample_rate_hz))


def _facts(spec: CampaignSpec, delay_us: float) -> LoopFacts:
    return loop_facts(spec.sample_rate_hz, 1e-6 * delay_us, spec.measurement == "relative")


def _schedule(
    spec: CampaignSpec, plant: Plant, facts: LoopFacts, amplitude: float, budget: int
) -> tuple[GainSchedule, tuple[float, ...]]:
    """Schedule for a plant by the rule or the tuner, and frequencies at which the tuner has no gains."""
    rule = spec.schedule
    if not isinstance(rule, ThesisRule | Retuned):
        raise InputError("schedule: a handed over schedule is not made for a plant")
    hz = parse_frequencies(rule.at_hz)
    try:
        start = scheduling_rule(plant, hz, high_pass_hz=rule.high_pass_hz, low_pass_hz=rule.low_pass_hz)
    except ValueError as error:
        raise InputError(f"schedule: {error}") from error
    if isinstance(rule, ThesisRule):
        return start, ()
    goal = TuningGoal(
        budget_w=spec.budgets_w[budget],
        budget_kind=spec.budget_kind,
        modulus_margin=rule.modulus_margin,
        delay_margin_s=1e-6 * rule.delay_margin_us,
        drift_hz=rule.drift_hz,
    )
    retuner, points, refused = Retuner(plant, facts, goal), {}, []
    for row, f in enumerate(hz):
        low_pass = rule.low_pass_hz or paired_low_pass_hz(f, rule.high_pass_hz)
        idle = Gains(0.0, 0.0, 0.0, low_pass, rule.high_pass_hz)
        try:
            points[row] = retuner.point(plant, 0.0, f, amplitude, idle).gains
        except NoGainsError:
            points[row] = idle
            refused.append(f)
    return start.with_points(points), tuple(refused)


def _from_file(rule: FromFile, folder: Path, plant: Plant, say: Callable[[str], None]) -> GainSchedule:
    from twin.station.export_source import ExportOptions, read_source

    path = folder / rule.file
    if not path.is_file():
        raise InputError(f"schedule file: {path}: no such file; give what 'atmd tune --json' wrote")
    try:
        return read_source(ExportOptions(out=folder, file=path, plant=None), say).schedule
    except InputError as error:
        if "--plant" not in str(error):
            raise
    # It names another plant, or none: the campaign may well ask what its gains do on this one.
    text = json.loads(path.read_text(encoding="utf-8")) if path.suffix == ".json" else {}
    if "points" not in text:
        raise InputError(
            f"schedule file: {path}: cannot be used for plant '{plant.name}'; export it for that plant"
        )
    rows = [p for p in text["points"] if p.get("gains") and p.get("cutoffs")]
    try:
        columns = {
            key: tuple(p[part][key] for p in rows)
            for part, keys in (
                ("gains", ("alpha_kg", "beta_ns_m", "gamma_n_m")),
                ("cutoffs", ("low_pass_hz", "high_pass_hz")),
            )
            for key in keys
        }
        hz = tuple(p["frequency_hz"] for p in rows)
        return GainSchedule(frequency_hz=hz, on_from_hz=hz[0], on_to_hz=hz[-1], **columns)
    except (ValidationError, KeyError, IndexError) as error:
        raise InputError(f"schedule file: {path}: is not what 'atmd tune --json' writes ({error})") from error


def _check(campaign: Campaign) -> None:
    """Say now what would stop every case."""
    spec = campaign.spec
    if spec.block_s * spec.sample_rate_hz < 10.0:
        raise InputError(
            f"block_s [s]: a block of {spec.block_s:g} s has fewer than 10 samples; make it longer"
        )
    for combination, (p, _, e) in enumerate(spec.combinations):
        plant, excitation = campaign.plants[p], spec.excitation[e]
        if excitation.duration_s < spec.block_s:
            raise InputError(
                f"excitation[{e}] duration_s [s]: must be at least a block of {spec.block_s:g} s"
            )
        if excitation.duration_s * spec.sample_rate_hz > 1e8:
            raise InputError(
                f"excitation[{e}] duration_s [s]: {excitation.duration_s:g} s is longer than a run may be"
            )
        schedule = campaign.schedules[combination]
        fastest = max(schedule.low_pass_hz + schedule.high_pass_hz) if schedule is not None else 0.0
        if fastest >= 0.5 * spec.sample_rate_hz:
            raise InputError(
                f"schedule: cutoff {fastest:g} Hz is not below half of sample_rate_hz ({spec.sample_rate_hz:g} Hz); "
                "give low_pass_hz or a faster rate"
            )
        known = replace(campaign, schedules=tuple(s or _nothing() for s in campaign.schedules))
        case = drawn_case(known, combination * spec.draws).case
        coil = case.coil
        for key in ("stroke_m", f"{coil.name}_current_a", f"{coil.name}_power_w"):
            case.limit(key)
        others = [a for a in plant.actuator if a is not plant.voice_coil]
        if others[0].name != case.exciter:
            raise InputError(
                f"excitation[{e}]: actuator '{case.exciter}' is not the first of plant '{plant.name}' beside its coil; "
                "put it first in the plant file"
            )


def _nothing() -> GainSchedule:
    zero = (0.0,)
    return GainSchedule(
        frequency_hz=(50.0,), alpha_kg=zero, beta_ns_m=zero, gamma_n_m=zero, low_pass_hz=(200.0,),
        high_pass_hz=(1.0,), on_from_hz=50.0, on_to_hz=50.0,
    )  # fmt: skip


def place(folder: Path, name: str) -> str:
    """A plant file beside the specification, or a preset's name."""
    beside = folder / name
    return str(beside) if beside.is_file() else name
