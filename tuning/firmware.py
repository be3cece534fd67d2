"""A schedule as a rig's firmware holds it: predicted figures per point, fixed-point tables, and what rounding costs.

A fixed-point column is whole numbers with one power of two, ``value = number * 2**exponent``, so that firmware scales
by shifting. Cutoffs are stored as what the filters compute with, ``g = tan(pi f_c/f_s)`` (`twin.control.chain`): a
target without floating point has no tangent. The tables are rounded; the filters' own arithmetic is the firmware's.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import numpy as np

from tuning.loop import LoopFacts, RigModel, margin_grid, margins
from tuning.retune import Retuner, TuningGoal
from tuning.steady import predict
from tuning.types import BudgetKind
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Frozen, Plant
from twin.plant.errors import InputError, RunError
from twin.plant.linear import natural_frequencies_hz

WordFormat = Literal["Q15", "Q31"]

BITS: dict[WordFormat, int] = {"Q15": 16, "Q31": 32}
COLUMNS = ("frequency_hz", "alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_g", "high_pass_g")
SHARE_BITS = 30
"""Position between two rows is a share of 2**30."""

MARGIN_POINTS = 300
UNBOUNDED_W = 1e9


class FixedColumn(Frozen):
    """One column of a fixed-point table: ``value = number * 2**exponent``."""

    exponent: int
    numbers: tuple[int, ...]

    @property
    def resolution(self) -> float:
        """Value of one step."""
        return math.ldexp(1.0, self.exponent)

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers as values."""
        return tuple(math.ldexp(float(q), self.exponent) for q in self.numbers)

    def nearest(self, value: float) -> int:
        """The whole number next to a value."""
        return round(math.ldexp(value, -self.exponent))


class FixedTable(Frozen):
    """A schedule's table in whole numbers.

    Attributes
    ----------
    word
        ``Q15``: 16 bits with the sign, ``Q31``: 32.
    frequency_hz, alpha_kg, beta_ns_m, gamma_n_m
        As in `GainSchedule`.
    low_pass_g, high_pass_g
        ``tan(pi f_c/f_s)`` of the cutoffs.
    on_from, on_to
        Ends of the controller's band in steps of the frequency.
    """

    word: WordFormat
    sample_rate_hz: float
    frequency_hz: FixedColumn
    alpha_kg: FixedColumn
    beta_ns_m: FixedColumn
    gamma_n_m: FixedColumn
    low_pass_g: FixedColumn
    high_pass_g: FixedColumn
    on_from: int
    on_to: int

    def numbers_at(self, frequency: int) -> tuple[int, int, int, int, int]:
        """The five columns at a frequency, all in their steps, by the whole-number arithmetic of the C header."""
        f = self.frequency_hz.numbers
        columns = (self.alpha_kg, self.beta_ns_m, self.gamma_n_m, self.low_pass_g, self.high_pass_g)
        if frequency <= f[0] or len(f) == 1:
            row, share = 0, 0
        elif frequency >= f[-1]:
            row, share = len(f) - 1, 0
        else:
            row = int(np.searchsorted(f, frequency, side="right")) - 1
            share = ((frequency - f[row]) << SHARE_BITS) // (f[row + 1] - f[row])
        out = []
        for column in columns:
            q = column.numbers
            if share == 0:
                out.append(q[row])
                continue
            step = (q[row + 1] - q[row]) * share
            # Rounded to nearest, halves away from zero: the same for both signs, whatever >> does.
            size = (abs(step) + (1 << (SHARE_BITS - 1))) >> SHARE_BITS
            out.append(q[row] + (size if step >= 0 else -size))
        return (out[0], out[1], out[2], out[3], out[4])

    def at(self, frequency_hz: float) -> Gains:
        """Gains and cutoffs at an excitation frequency [Hz], as firmware gets them."""
        numbers = self.numbers_at(self.frequency_hz.nearest(frequency_hz))
        columns = (self.alpha_kg, self.beta_ns_m, self.gamma_n_m, self.low_pass_g, self.high_pass_g)
        alpha, beta, gamma, low, high = (q * c.resolution for q, c in zip(numbers, columns, strict=True))
        return Gains(alpha, beta, gamma, *(math.atan(g) * self.sample_rate_hz / math.pi for g in (low, high)))


class PointFigures(Frozen):
    """What the model predicts of one row of the table; displacements are peaks of the primary body [m].

    ``limit_displacement_m`` is the least any linear controller could reach within the limits, None where it is not
    known: the plant states no limits or the excitation alone breaks them.
    """

    frequency_hz: float
    passive_displacement_m: float
    limit_displacement_m: float | None
    achieved_displacement_m: float
    stroke_m: float
    current_peak_a: float
    joule_mean_w: float
    joule_peak_w: float
    electrical_mean_w: float
    modulus_margin: float
    delay_margin_s: float | None
    slowest_pole_1_s: float


class RoundingEffect(Frozen):
    """What fixed-point tables do to the loop: the least over the controller's band, at rows and between them.

    Attributes
    ----------
    modulus_margin, modulus_margin_rounded
        Least distance of the loop gain from -1, with the tables in double precision and rounded.
    delay_margin_s, delay_margin_rounded_s
        Least further delay that destabilises [s]; None if none below 8 ms does.
    margin_lost
        Largest share by which a margin fell at any one frequency; 0 if none did.
    displacement_gained
        Largest share by which the primary's motion grew at any one frequency, of the passive motion there.
    worst_hz
        Where ``margin_lost`` was found [Hz].
    """

    modulus_margin: float
    modulus_margin_rounded: float
    delay_margin_s: float | None
    delay_margin_rounded_s: float | None
    margin_lost: float
    displacement_gained: float
    worst_hz: float


def acting_hz(schedule: GainSchedule) -> list[float]:
    """Rows inside the controller's band and its ends, ascending [Hz]."""
    inside = (f for f in schedule.frequency_hz if schedule.acts_at(f))
    return sorted({schedule.on_from_hz, schedule.on_to_hz, *inside})


def point_figures(
    plant: Plant,
    facts: LoopFacts,
    schedule: GainSchedule,
    excitation_amplitude: float,
    budget_w: float | None = None,
    budget_kind: BudgetKind = "joule_mean",
) -> tuple[PointFigures, ...]:
    """Figures for every row inside the controller's band and its ends, from the deployed numbers alone.

    Parameters
    ----------
    excitation_amplitude
        Peak, in the exciting actuator's unit.
    budget_w, budget_kind
        Power that the physical limit may spend; None leaves the plant's own limits.

    Raises
    ------
    RunError
        If the loop is not stable at one of them; the message says where.
    """
    limits: Retuner | None = None
    try:
        goal = TuningGoal(budget_w=UNBOUNDED_W if budget_w is None else budget_w, budget_kind=budget_kind)
        limits = Retuner(plant, facts, goal)
    except InputError:
        if budget_w is not None:
            raise
    grid = margin_grid(facts.sample_rate_hz, natural_frequencies_hz(plant), MARGIN_POINTS)
    out = []
    for f in acting_hz(schedule):
        model, gains = RigModel(plant, facts, f), schedule.at(f)
        decay = _stable(model, gains, f, "the schedule")
        found = margins(model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid, gains)
        steady = predict(model, gains, f, excitation_amplitude)
        least: float | None = None
        if limits is not None:
            try:
                least = limits.limit_at(plant, f, excitation_amplitude).displacement_m
            except RunError:
                least = None
        passive = predict(
            model, Gains(0.0, 0.0, 0.0, gains.low_pass_hz, gains.high_pass_hz), f, excitation_amplitude
        )
        out.append(
            PointFigures(
                frequency_hz=f,
                passive_displacement_m=passive.displacement_m,
                limit_displacement_m=least,
                achieved_displacement_m=steady.displacement_m,
                stroke_m=steady.stroke_m,
                current_peak_a=steady.current_peak_a,
                joule_mean_w=steady.powers.joule_mean_w,
                joule_peak_w=steady.powers.joule_peak_w,
                electrical_mean_w=steady.powers.electrical_mean_w,
                modulus_margin=found.modulus,
                delay_margin_s=found.delay_s,
                slowest_pole_1_s=decay,
            )
        )
    return tuple(out)


def fixed_table(schedule: GainSchedule, sample_rate_hz: float, word: WordFormat) -> FixedTable:
    """Round a schedule to whole numbers; each column gets the finest power of two that holds its largest value.

    Raises
    ------
    RunError
        If the words are too short: two rows fall on one frequency, or a cutoff on 0.
    InputError
        If a cutoff is not below half of the sample rate.
    """
    fastest = max(schedule.low_pass_hz + schedule.high_pass_hz)
    if not fastest < 0.5 * sample_rate_hz:
        raise InputError(
            f"cutoff {fastest:g} Hz is not below half of the sample rate ({sample_rate_hz:g} Hz)"
        )
    largest = (1 << (BITS[word] - 1)) - 1
    low, high = (
        [math.tan(math.pi * f / sample_rate_hz) for f in column]
        for column in (schedule.low_pass_hz, schedule.high_pass_hz)
    )
    plain = (schedule.frequency_hz, schedule.alpha_kg, schedule.beta_ns_m, schedule.gamma_n_m, low, high)
    columns = {name: _column(values, largest) for name, values in zip(COLUMNS, plain, strict=True)}
    frequency = columns["frequency_hz"]
    if len(set(frequency.numbers)) < len(frequency.numbers):
        raise RunError(
            f"{word} is too coarse: two rows of the table fall on the same step of {frequency.resolution:g} Hz; "
            "use Q31 or fewer rows"
        )
    for name in ("low_pass_g", "high_pass_g"):
        if min(columns[name].numbers) < 1:
            raise RunError(f"{word} is too coarse: a cutoff falls on 0; use Q31 or cutoffs that differ less")
    return FixedTable(
        word=word,
        sample_rate_hz=sample_rate_hz,
        **columns,
        on_from=frequency.nearest(schedule.on_from_hz),
        on_to=frequency.nearest(schedule.on_to_hz),
    )


def rounding_effect(
    plant: Plant,
    facts: LoopFacts,
    schedule: GainSchedule,
    table: FixedTable,
    excitation_amplitude: float,
    most_lost: float = 0.05,
) -> RoundingEffect:
    """Compare rounded tables with double precision at every row and half-way between rows, on the full model.

    Parameters
    ----------
    most_lost
        Share of a margin that may be lost.

    Raises
    ------
    RunError
        If the rounded loop is unstable somewhere, or a margin falls by more than ``most_lost``; the message says where.
    """
    rows = acting_hz(schedule)
    places = sorted({*rows, *(0.5 * (a + b) for a, b in pairwise(rows))})
    grid = margin_grid(facts.sample_rate_hz, natural_frequencies_hz(plant), MARGIN_POINTS)
    exact, rounded = [], []
    lost, worst_hz, grown = 0.0, places[0], 0.0
    for f in places:
        model = RigModel(plant, facts, f)
        pair = (schedule.at(f), table.at(f))
        found = []
        for gains, whose in zip(pair, ("the schedule", f"the schedule rounded to {table.word}"), strict=True):
            _stable(model, gains, f, whose)
            found.append(margins(model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid, gains))
        exact.append(found[0])
        rounded.append(found[1])
        here = max(
            1.0 - found[1].modulus / found[0].modulus,
            _share_lost(found[0].delay_s, found[1].delay_s),
        )
        if here > lost:
            lost, worst_hz = here, f
        motion = [predict(model, gains, f, excitation_amplitude).displacement_m for gains in pair]
        still = Gains(0.0, 0.0, 0.0, pair[0].low_pass_hz, pair[0].high_pass_hz)
        passive = predict(model, still, f, excitation_amplitude).displacement_m
        if passive > 0.0:
            grown = max(grown, (motion[1] - motion[0]) / passive)
    if lost > most_lost:
        raise RunError(
            f"rounded to {table.word}, a margin at {worst_hz:g} Hz falls by {100.0 * lost:.3g} %, more than the "
            f"{100.0 * most_lost:g} % that may be lost; use Q31 or allow more"
        )
    return RoundingEffect(
        modulus_margin=min(m.modulus for m in exact),
        modulus_margin_rounded=min(m.modulus for m in rounded),
        delay_margin_s=min((m.delay_s for m in exact if m.delay_s is not None), default=None),
        delay_margin_rounded_s=min((m.delay_s for m in rounded if m.delay_s is not None), default=None),
        margin_lost=lost,
        displacement_gained=grown,
        worst_hz=worst_hz,
    )


def _share_lost(before_s: float | None, after_s: float | None) -> float:
    if after_s is None:
        return 0.0
    # Where no delay below the longest looked for destabilised, that longest one is what is known to be left.
    return 1.0 - after_s / (8e-3 if before_s is None else before_s)


def _stable(model: RigModel, gains: Gains, frequency_hz: float, whose: str) -> float:
    decay = model.decay_rate_1_s(gains)
    if not decay < 0.0:
        raise RunError(
            f"{whose} is not stable at {frequency_hz:g} Hz (slowest pole {decay:+.3g} 1/s); nothing is handed over: "
            "retune it, or narrow the band in which the controller acts"
        )
    return decay


def _column(values: Sequence[float], largest: int) -> FixedColumn:
    biggest = max(abs(v) for v in values)
    if biggest == 0.0:
        return FixedColumn(exponent=0, numbers=(0,) * len(values))
    exponent = math.frexp(biggest / largest)[1] - 1
    while round(math.ldexp(biggest, -exponent)) > largest:
        exponent += 1
    return FixedColumn(exponent=exponent, numbers=tuple(round(math.ldexp(v, -exponent)) for v in values))
