"""``atmd tune``: the physical limit, LQ weights and verified gains of a plant over a band, frequency by frequency."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from tuning.cutoffs import CutoffBounds, CutoffProgram, tune_jointly
from tuning.loop import loop_facts
from tuning.power_lq import LQDesign, PowerBudgetedLQ
from tuning.retune import NoGainsError, Retuner, TuningGoal
from tuning.types import BudgetKind, OperatingPoint
from twin.control.filters import Cutoffs, paired_low_pass_hz
from twin.control.schedule import Gains
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.station.analyse import parse_cutoffs, parse_frequencies

THESIS_EXCITATION = {"N": 1000.0, "V": 4.0}
"""Peaks that the thesis excites with: the engine (Table 8-2) and the rig (Tests 1 to 4)."""

TEST_3_HIGH_PASS_HZ = 2.5
LONGEST_DELAY_S = 8e-3
NOISE_SHARE = 0.02
"""Share of the budget that sensor noise may burn where cutoffs are chosen."""

FIRST_STEP, WORTH = 1.6, 0.01
"""Factor by which cutoffs are moved at first, and the share of the motion that a move must save."""

AT_THE_LIMIT = 1e-3
"""What is left above the physical limit, as a share of the passive motion, for which no other cutoffs are sought."""


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """What the person asked for; text as it was typed."""

    plant: str
    band: str = "47:53:0.5"
    budget_w: float = 25.0
    budget: BudgetKind = "joule_mean"
    excitation_n: float | None = None
    excitation_v: float | None = None
    delay_us: float = 50.0
    modulus_margin: float = 0.3
    delay_margin_us: float = 200.0
    sample_rate: float = 50_000.0
    displacement_um: float | None = None
    damping_std: float = 0.1
    drift: float = 0.25
    cutoffs: str | None = None
    plot: Path | None = None


def run_tune(
    options: TuneOptions, say: Callable[[str], None], progress: Callable[[int, int], None]
) -> dict[str, Any]:
    """Tune every frequency of the band.

    Returns
    -------
    dict
        Figures by name (see the command's help).

    Raises
    ------
    InputError
        For an option or a plant that cannot be used; the message names it and the remedy.
    """
    frequencies = _frequencies(options.band)
    fixed = parse_cutoffs(options.cutoffs) if options.cutoffs is not None else None
    _check(options, fixed, frequencies)
    try:
        plant = load_plant(options.plant)
    except InputError as error:
        raise InputError(f"--plant {error}") from error
    goal = TuningGoal(
        budget_w=options.budget_w,
        budget_kind=options.budget,
        modulus_margin=options.modulus_margin,
        drift_hz=options.drift,
        delay_margin_s=1e-6 * options.delay_margin_us,
        displacement_m=None if options.displacement_um is None else 1e-6 * options.displacement_um,
    )
    facts = loop_facts(options.sample_rate, 1e-6 * options.delay_us)
    tuner = _Tuner(plant, Retuner(plant, facts, goal), goal, options, fixed)
    amplitude, unit = excitation(plant, options)
    tuner.warm_up(frequencies[len(frequencies) // 2], amplitude)
    points = []
    for done, frequency in enumerate(frequencies):
        points.append(tuner.point(frequency, amplitude))
        progress(done + 1, len(frequencies))
    result = {
        "points": points,
        "plant": plant.name,
        "excitation": amplitude,
        "excitation_unit": unit,
        "budget_w": options.budget_w,
        "budget_kind": options.budget,
        "wanted_modulus_margin": options.modulus_margin,
        "wanted_delay_margin_s": goal.delay_margin_s,
        "loop_delay_s": facts.delay_s,
        "plot": None,
    }
    if options.plot is not None:
        from twin.station.tune_plot import draw_tune

        draw_tune(result, options.plot)
        result["plot"] = str(options.plot)
        say(f"plot: {options.plot}")
    return result


def excitation(plant: Plant, options: TuneOptions) -> tuple[float, str]:
    """Peak and unit of the excitation: the option in the exciting actuator's unit, or the thesis's value.

    Raises
    ------
    InputError
        If the option is in another unit than the actuator's, or the unit has no value of its own.
    """
    exciter = next(a for a in plant.actuator if a is not plant.voice_coil)
    given = {"N": options.excitation_n, "V": options.excitation_v}
    flags = {"N": "--excitation-n", "V": "--excitation-v"}
    unit = exciter.input_unit
    for other, value in given.items():
        if value is not None and other != unit:
            remedy = f"use {flags[unit]}" if unit in flags else "it cannot be tuned by this command"
            raise InputError(
                f"{flags[other]}: actuator '{exciter.name}' of plant '{plant.name}' takes {unit}, not {other}; {remedy}"
            )
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"{flags[other]} {value:g}: give the peak in {other}, above 0")
    if unit not in THESIS_EXCITATION:
        raise InputError(
            f"plant '{plant.name}': actuator '{exciter.name}' is driven in {unit}; give one in N or V"
        )
    value = given[unit]
    return (THESIS_EXCITATION[unit] if value is None else value), unit


class _Tuner:
    """One plant's solvers, and a point of the result after the other."""

    def __init__(
        self, plant: Plant, retuner: Retuner, goal: TuningGoal, options: TuneOptions, fixed: Cutoffs | None
    ) -> None:
        self._plant, self._retuner, self._goal, self._options, self._fixed = (
            plant,
            retuner,
            goal,
            options,
            fixed,
        )
        self._lq = PowerBudgetedLQ(plant)
        self._cutoffs: CutoffProgram | None = None
        if fixed is None:
            try:
                self._cutoffs = CutoffProgram(plant, retuner.facts)
            except InputError:
                self._cutoffs = None

    def warm_up(self, frequency: float, amplitude: float) -> None:
        """Compile what a point needs, so that its time is that of solving."""
        self.point(frequency, amplitude)

    def point(self, frequency: float, amplitude: float) -> dict[str, Any]:
        """Everything about one frequency, as JSON."""
        began = time.perf_counter()
        lq, lq_reason = self._weights(frequency, amplitude)
        try:
            found = self._gains(frequency, amplitude)
        except NoGainsError as error:
            taken = time.perf_counter() - began
            return (
                self._refused(frequency, amplitude, error)
                | _weights_json(lq, lq_reason)
                | {"solve_ms": 1e3 * taken}
            )
        taken = time.perf_counter() - began
        return _point_json(found) | _weights_json(lq, lq_reason) | {"solve_ms": 1e3 * taken}

    def _weights(self, frequency: float, amplitude: float) -> tuple[LQDesign | None, str]:
        limits = self._retuner.limits
        try:
            design = self._lq.solve(
                frequency,
                amplitude,
                joule_mean_w=limits.joule_mean_w,
                current_peak_a=limits.current_peak_a,
                electrical_mean_w=limits.electrical_mean_w,
                stroke_m=limits.stroke_m,
            )
        except RunError as error:
            return None, str(error)
        return design, ""

    def _gains(self, frequency: float, amplitude: float) -> OperatingPoint:
        """Gains behind Test 3's cutoffs and, where these keep them from the limit, behind better ones."""
        fixed = self._fixed
        pair = (
            (fixed.low_pass_hz, fixed.high_pass_hz)
            if fixed is not None
            else (self._paired(frequency), TEST_3_HIGH_PASS_HZ)
        )
        trouble: NoGainsError | None = None
        best: OperatingPoint | None = None
        try:
            best = self._solve(frequency, amplitude, pair)
        except NoGainsError as error:
            trouble = error
        if self._cutoffs is not None and (best is None or self._is_short(best)):
            better = self._jointly(self._cutoffs, frequency, amplitude, pair)
            if better is not None and (best is None or self._cost(better) < self._cost(best)):
                return better
        if best is None:
            raise trouble if trouble is not None else NoGainsError("no gains", ())
        return best

    def _paired(self, frequency: float) -> float:
        return min(paired_low_pass_hz(frequency, TEST_3_HIGH_PASS_HZ), 0.2 * self._options.sample_rate)

    def _solve(self, frequency: float, amplitude: float, pair: tuple[float, float]) -> OperatingPoint:
        start = Gains(0.0, 0.0, 0.0, *pair)
        return self._retuner.point(self._plant, self._options.damping_std, frequency, amplitude, start)

    def _is_short(self, p: OperatingPoint) -> bool:
        if self._goal.displacement_m is not None:
            return False
        return p.predicted_displacement_m - p.limit_displacement_m > AT_THE_LIMIT * p.passive_displacement_m

    def _cost(self, p: OperatingPoint) -> float:
        if self._goal.displacement_m is not None:
            return p.powers.of_kind(self._goal.budget_kind)
        return p.predicted_displacement_m

    def _jointly(
        self, program: CutoffProgram, frequency: float, amplitude: float, pair: tuple[float, float]
    ) -> OperatingPoint | None:
        """Cutoffs of the geometric program, or Test 3's, moved on while the gains behind them leave less motion."""

        def gains(low: float, high: float) -> Gains:
            return self._solve(frequency, amplitude, (low, high)).gains

        noise_w = NOISE_SHARE * self._goal.budget_w
        tried: dict[tuple[float, float], OperatingPoint | None] = {}

        def point(at: tuple[float, float]) -> OperatingPoint | None:
            if at not in tried:
                tried[at] = self._quiet(program, frequency, amplitude, at, noise_w)
            return tried[at]

        best = point(pair)
        if best is None:
            try:
                joint = tune_jointly(
                    gains,
                    program,
                    frequency,
                    pair,
                    noise_budget_w=noise_w,
                    slowest_decay_1_s=self._goal.slowest_decay_1_s,
                    rounds=3,
                )
                best = point((joint.gains.low_pass_hz, joint.gains.high_pass_hz))
            except (RunError, InputError):
                return None
        step = FIRST_STEP
        while best is not None and step > 1.1 and self._is_short(best):
            low, high = best.gains.low_pass_hz, best.gains.high_pass_hz
            around = [(low * step, high), (low / step, high), (low, high * step), (low, high / step)]
            found = [q for at in around if self._allowed(at) and (q := point(at)) is not None]
            next_best = min(found, key=self._cost, default=best)
            if self._cost(next_best) < (1.0 - WORTH) * self._cost(best):
                best = next_best
            else:
                step = math.sqrt(step)
        return best

    def _allowed(self, at: tuple[float, float]) -> bool:
        box = CutoffBounds()
        low = box.low_pass_min_hz <= at[0] <= min(box.low_pass_max_hz, 0.2 * self._options.sample_rate)
        return low and box.high_pass_min_hz <= at[1] <= box.high_pass_max_hz

    def _quiet(
        self,
        program: CutoffProgram,
        frequency: float,
        amplitude: float,
        at: tuple[float, float],
        noise_w: float,
    ) -> OperatingPoint | None:
        """Gains behind given cutoffs, if sensor noise burns little enough with them."""
        try:
            found = self._solve(frequency, amplitude, at)
            noise = program.verify(found.gains, frequency).verified_noise_power_w
        except (RunError, InputError):
            return None
        return found if noise <= noise_w else None

    def _refused(self, frequency: float, amplitude: float, error: NoGainsError) -> dict[str, Any]:
        passive = self._retuner.passive_m(self._plant, frequency, amplitude)
        try:
            limit = self._retuner.limit_at(self._plant, frequency, amplitude).displacement_m
        except RunError:
            limit = None
        empty = dict.fromkeys(
            (
                "achieved_displacement_m", "joule_mean_w", "joule_peak_w", "electrical_mean_w", "gains", "cutoffs",
                "modulus_margin", "delay_margin_s",
            )
        )  # fmt: skip
        return {
            "frequency_hz": frequency,
            "limit_displacement_m": limit,
            "passive_displacement_m": passive,
            **empty,
            "active_limits": [],
            "reason": str(error),
            "binding": list(error.binding),
            "least_budget_w": error.least_budget_w,
        }


def _point_json(p: OperatingPoint) -> dict[str, Any]:
    gains = p.gains
    units = {"power": "m/W", "electrical": "m/W", "current": "m/A", "stroke": "m/m", "voltage": "m/V"}
    units |= {"modulus margin": "m", "decay": "m s"}
    return {
        "frequency_hz": p.frequency_hz,
        "limit_displacement_m": p.limit_displacement_m,
        "achieved_displacement_m": p.predicted_displacement_m,
        "passive_displacement_m": p.passive_displacement_m,
        "displacement_range_m": list(p.displacement_range_m),
        **asdict(p.powers),
        "power_range_w": list(p.power_range_w),
        "stroke_m": p.stroke_m,
        "current_peak_a": p.current_peak_a,
        "voltage_peak_v": p.voltage_peak_v,
        "gains": {"alpha_kg": gains.alpha_kg, "beta_ns_m": gains.beta_ns_m, "gamma_n_m": gains.gamma_n_m},
        "cutoffs": {"low_pass_hz": gains.low_pass_hz, "high_pass_hz": gains.high_pass_hz},
        "modulus_margin": p.modulus_margin,
        "delay_margin_s": LONGEST_DELAY_S if p.delay_margin_s is None else p.delay_margin_s,
        "decay_rate_1_s": p.decay_rate_1_s,
        "active_limits": [{"name": a.name, "price": a.price, "unit": units[a.name]} for a in p.active_limits],
        "least_power_w": p.least_power_w,
    }


def _weights_json(lq: LQDesign | None, reason: str) -> dict[str, Any]:
    if lq is None:
        return {"lq": None, "duality_gap": None, "lq_reason": reason}
    return {
        "lq": lq.as_json(),
        "duality_gap": lq.duality_gap,
        "lq_displacement_m": lq.achieved_displacement_m,
    }


def _frequencies(band: str) -> list[float]:
    try:
        return parse_frequencies(band)
    except InputError as error:
        raise InputError(str(error).replace("--at", "--band")) from error


def _check(options: TuneOptions, fixed: Cutoffs | None, frequencies: list[float]) -> None:
    ranges = (
        ("--budget-w", options.budget_w, 0.0, 1e9, "W"),
        ("--sample-rate", options.sample_rate, 100.0, 1e7, "Hz"),
        (
            "--displacement-um",
            1.0 if options.displacement_um is None else options.displacement_um,
            0.0,
            1e9,
            "µm",
        ),
    )
    for name, value, low, high, unit in ranges:
        if not low < value < high:
            raise InputError(f"{name} {value:g}: give a number above {low:g} and below {high:g} {unit}")
    shares = (
        ("--delay-us", options.delay_us, 1e5, "µs"),
        ("--delay-margin-us", options.delay_margin_us, 8e3, "µs"),
        ("--damping-std", options.damping_std, 1e6, "Ns/m"),
        ("--drift", options.drift, min(frequencies), "Hz"),
    )
    for name, value, high, unit in shares:
        if not 0.0 <= value < high:
            raise InputError(f"{name} {value:g}: give a number from 0 to below {high:g} {unit}")
    if not 0.0 <= options.modulus_margin < 1.0:
        raise InputError(f"--modulus-margin {options.modulus_margin:g}: give a distance from 0 to below 1")
    fastest = max(frequencies) + options.drift if fixed is None else max(fixed.low_pass_hz, *frequencies)
    if fastest >= 0.4 * options.sample_rate:
        raise InputError(
            f"--sample-rate {options.sample_rate:g}: {fastest:g} Hz is too near to half of it; sample faster"
        )
    if options.delay_us * options.sample_rate > 200e6:
        raise InputError(
            f"--delay-us {options.delay_us:g}: more than 200 samples at {options.sample_rate:g} Hz"
        )


def tune_table(result: dict[str, Any]) -> Table:
    """Table for people."""
    kind = result["budget_kind"].replace("_", " ")
    title = f"{result['plant']}, {result['excitation']:g} {result['excitation_unit']} peak, budget "
    title += f"{result['budget_w']:g} W {kind}, loop delay {1e6 * result['loop_delay_s']:g} µs"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 0))
    heads = ["f|Hz", "passive|µm", "limit|µm", "gains|µm", "R i²|W avg", "R i²|W pk", "v i|W avg"]
    heads += ["alpha|kg", "beta|Ns/m", "gamma|kN/m", "1+L|min", "late|ms"]
    for head in heads:
        table.add_column(head.replace("|", "\n"), justify="right", no_wrap=True)
    table.add_column("binds", overflow="fold")
    for p in result["points"]:
        f = f"{p['frequency_hz']:g}"
        if p.get("reason"):
            dashes = ["-"] * 9
            table.add_row(
                f, _um(p["passive_displacement_m"]), _um(p["limit_displacement_m"]), *dashes,
                f"[red]none: {', '.join(p['binding'])}[/red]",
            )  # fmt: skip
            continue
        gains, delay = p["gains"], p["delay_margin_s"]
        watts = (_short(p[key]) for key in ("joule_mean_w", "joule_peak_w", "electrical_mean_w"))
        table.add_row(
            f,
            *(
                _um(p[key])
                for key in ("passive_displacement_m", "limit_displacement_m", "achieved_displacement_m")
            ),
            *watts,
            *(_short(x) for x in (gains["alpha_kg"], gains["beta_ns_m"], 1e-3 * gains["gamma_n_m"])),
            _short(p["modulus_margin"]),
            ">8" if delay >= LONGEST_DELAY_S else f"{1e3 * delay:.2f}",
            "\n".join(_price(a) for a in p["active_limits"]) or "-",
        )
    return table


def troubles(result: dict[str, Any]) -> list[str]:
    """Why there are no gains, frequency by frequency."""
    return [f"{p['frequency_hz']:g} Hz: {p['reason']}" for p in result["points"] if p.get("reason")]


def _price(limit: dict[str, Any]) -> str:
    if limit["unit"] == "m/W":
        return f"{limit['name']}\n{1e6 * limit['price']:.2g} µm/W"
    return str(limit["name"]).replace("modulus ", "")


def _um(metres: float | None) -> str:
    return "-" if metres is None else _short(1e6 * metres)


def _short(value: float) -> str:
    """Two or three figures without an exponent, for a narrow column."""
    if value != 0.0 and abs(value) < 5e-3:
        return "~0"
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}" if abs(value) >= 1.0 else f"{value:.2g}"
