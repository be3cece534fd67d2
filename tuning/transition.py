"""Whether the loop stays stable while the excitation's frequency, and with it the gains, move: proof or "not shown".

Poles at every frequency say nothing about a frequency that moves. What does is a function of the state that falls at
every sample, whatever the frequency does within a rate (`tuning.lyapunov`): one for the whole table, then it may move
as fast as it likes; else one that changes along with the frequency, up to a fastest sweep. No solver is believed:
a function counts if the eigenvalues of the exact matrices say so, at its knots, at every kink of table and damping,
between them, and again on a grid it was not chosen on.

Within the table only: the switch on and off at the ends of the controller's band is a jump between two stable loops.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from tuning.loop import LoopFacts, RigModel
from tuning.lyapunov import (
    MovingProgram,
    Samples,
    admissible_rate_hz_s,
    balancing_scale,
    decay_and_drift,
    frozen_rate_hz_s,
    one_function,
    starting_functions,
)
from twin.control.schedule import GainSchedule
from twin.plant.config import DampingTable, Plant
from twin.plant.linear import Array, read_only

KNOTS = (11, 21)
"""How many frequencies the function is free at; the next if the first do not hold in between."""

BETWEEN = 6
REFINEMENTS = 3
SAFETY = 0.95
"""Share of the largest rate found that is claimed."""

LEAST_DECAY_1_S = 1e-3
"""V must fall at least this fast: what is slower is not told from rounding."""

STILL_1_S = 1e-6
FIRST_HZ_S = 1.0

Method = Literal["one function", "function of frequency", "none"]


@dataclass(frozen=True, slots=True)
class TransitionCertificate:
    """What is proven about a moving frequency, with the function that proves it.

    Attributes
    ----------
    shown
        False: nothing is proven, and ``reason`` says whether for want of a proof or because it is not so.
    method
        ``one function`` for the whole table, ``function of frequency``, or ``none``.
    fastest_sweep_hz_s
        Frequency may move at up to this rate, up and down as it likes [Hz/s]; infinite with one function, where it
        may jump; 0 if nothing is shown.
    worst_margin_1_s
        Least rate at which the function was found to fall at that sweep [1/s]; amplitudes fall half as fast. Where
        the loop is unstable at a frequency that stands still, minus the growth rate of its worst pole.
    reason
        In words.
    knots_hz, functions
        (m,) and (m, n, n): P at the knots, linear between, in the states of `RigModel.closed_loop_matrix`.
    """

    shown: bool
    method: Method
    fastest_sweep_hz_s: float
    worst_margin_1_s: float
    reason: str
    knots_hz: Array
    functions: Array

    def function_at(self, frequency_hz: float) -> Array:
        """P at a frequency, (n, n); held beyond the ends."""
        return _between(self.knots_hz, self.functions, frequency_hz)[0]


class _Loop:
    """Closed loop of a schedule against frequency; computed once per frequency."""

    def __init__(self, plant: Plant, facts: LoopFacts, schedule: GainSchedule) -> None:
        self._plant, self._facts, self._schedule = plant, facts, schedule
        self.dt = 1.0 / facts.sample_rate_hz
        self._known: dict[float, Array] = {}

    def __call__(self, frequency_hz: float) -> Array:
        if frequency_hz not in self._known:
            model = RigModel(self._plant, self._facts, frequency_hz)
            self._known[frequency_hz] = model.closed_loop_matrix(self._schedule.at(frequency_hz))
        return self._known[frequency_hz]

    def samples(self, knots_hz: Array) -> Samples:
        frequency_hz = np.unique(np.concatenate([knots_hz, 0.5 * (knots_hz[:-1] + knots_hz[1:])]))
        return Samples(frequency_hz, np.array([self(float(f)) for f in frequency_hz]), self.dt)

    def growth_1_s(self, frequency_hz: float) -> float:
        largest = float(np.abs(np.linalg.eigvals(self(frequency_hz))).max())
        return math.log(largest) / self.dt if largest > 0.0 else -math.inf


def check_transition(
    plant: Plant,
    facts: LoopFacts,
    schedule: GainSchedule,
    *,
    most_solves: int = 6,
    enough_hz_s: float = math.inf,
) -> TransitionCertificate:
    """Prove that a schedule's loop is stable while the frequency moves inside the controller's band.

    Parameters
    ----------
    plant
        With its damping, a number or against frequency; it moves along.
    schedule
        The one in use; looked at from ``on_from_hz`` to ``on_to_hz``.
    most_solves
        Semidefinite programs that may be spent on a faster sweep; 0 settles for the functions they start from.
    enough_hz_s
        No faster sweep than this is looked for [Hz/s].

    Raises
    ------
    ValueError
        If the plant has no voice coil with a current loop on an absorber, or nothing that excites it.
    """
    loop = _Loop(plant, facts, schedule)
    kinks = _kinks(plant, schedule)
    standing = _unstable_standing_still(loop, kinks)
    if standing is not None:
        return standing
    if len(kinks) == 1:
        return _one_frequency(loop, float(kinks[0]))
    witness = _switching_witness(loop, kinks)
    scale = balancing_scale(loop(float(kinks[len(kinks) // 2])), loop.dt)
    for knots in (np.linspace(kinks[0], kinks[-1], count) for count in KNOTS):
        samples = loop.samples(knots).scaled(scale)
        start = starting_functions(samples)
        if start is None:
            continue
        if not witness and (found := _try_one(loop, kinks, samples, start, scale)) is not None:
            return found
        best = _fastest(loop, kinks, samples, start, scale, most_solves, enough_hz_s)
        if best is None:
            continue
        rate, functions = best
        margin = _worst_margin(loop, kinks, knots, functions, rate, offset=0.381966)
        if margin > 0.0:
            why = witness or "no one function was found for the whole table"
            reason = f"a function of the frequency falls at sweeps up to {rate:.3g} Hz/s; {why}"
            return _certificate(True, "function of frequency", rate, margin, reason, knots, functions)
    reason = (
        "not shown: the loop is stable at every frequency that stands still, and no function that falls while it moves "
        "passed the check by exact eigenvalues; that is no proof of instability"
    )
    return _certificate(False, "none", 0.0, 0.0, reason, np.zeros(0), np.zeros((0, 0, 0)))


def decay_of_function_1_s(
    plant: Plant,
    facts: LoopFacts,
    schedule: GainSchedule,
    certificate: TransitionCertificate,
    frequency_hz: float,
    rate_hz_s: float,
) -> float:
    """Rate at which a certificate's function falls at one frequency and sweep [1/s], from the exact matrices.

    For checking a certificate by itself: negative would refute it. At a knot the steeper side counts.
    """
    return _decay(
        _Loop(plant, facts, schedule), certificate.knots_hz, certificate.functions, frequency_hz, rate_hz_s
    )


def _kinks(plant: Plant, schedule: GainSchedule) -> Array:
    """Ends of the controller's band, and where table or damping bend inside it [Hz]."""
    low, high = schedule.on_from_hz, schedule.on_to_hz
    bends = list(schedule.frequency_hz)
    for body in plant.body:
        if isinstance(body.damping_ns_m, DampingTable):
            bends += body.damping_ns_m.frequency_hz
    return np.unique([low, high, *(f for f in bends if low < f < high)])


def _grid(kinks: Array, knots: Array, offset: float = 0.0) -> Array:
    """Kinks and knots with some frequencies between each pair; an offset (0 to 1) moves the latter."""
    corners = np.unique(np.concatenate([kinks, knots]))
    steps = (np.arange(BETWEEN) + offset) / BETWEEN
    return np.unique(np.concatenate([corners, *(a + (b - a) * steps for a, b in pairwise(corners))]))


def _unstable_standing_still(loop: _Loop, kinks: Array) -> TransitionCertificate | None:
    grid = _grid(kinks, kinks)
    growth = np.array([loop.growth_1_s(float(f)) for f in grid])
    if growth.max() < -STILL_1_S:
        return None
    bad, worst = grid[growth >= -STILL_1_S], int(np.argmax(growth))
    reason = (
        f"not stable even while the frequency stands still, from {bad.min():.4g} to {bad.max():.4g} Hz: the slowest "
        f"pole is at {growth[worst]:+.3g} 1/s at {grid[worst]:.4g} Hz"
    )
    return _certificate(False, "none", 0.0, -float(growth[worst]), reason, np.zeros(0), np.zeros((0, 0, 0)))


def _one_frequency(loop: _Loop, frequency_hz: float) -> TransitionCertificate:
    knots = np.array([frequency_hz])
    scale = balancing_scale(loop(frequency_hz), loop.dt)
    start = starting_functions(loop.samples(knots).scaled(scale))
    if start is not None:
        functions = _unscaled(start[0], scale)
        margin = _decay(loop, knots, functions, frequency_hz, 0.0)
        if margin > LEAST_DECAY_1_S:
            reason = "the controller acts at one frequency only, where the loop is stable"
            return _certificate(True, "one function", math.inf, margin, reason, knots, functions)
    return _certificate(
        False,
        "none",
        0.0,
        0.0,
        "not shown: too near to instability to tell",
        np.zeros(0),
        np.zeros((0, 0, 0)),
    )


def _switching_witness(loop: _Loop, kinks: Array) -> str:
    """Proof that no one function exists: two frequencies between which jumping back and forth makes the loop grow."""
    best = (0.0, "")
    ends = np.array([kinks[0], kinks[len(kinks) // 2], kinks[-1]])
    for a, b in ((0, 1), (1, 2), (0, 2)):
        quarter = 1.0 / (loop.dt * 2.0 * float(ends[a] + ends[b]))
        for share in np.linspace(0.7, 1.3, 13):
            count = max(1, round(share * quarter))
            turn = np.linalg.matrix_power(loop(float(ends[a])), count)
            turn = turn @ np.linalg.matrix_power(loop(float(ends[b])), count)
            growth = math.log(float(np.abs(np.linalg.eigvals(turn)).max())) / (2 * count * loop.dt)
            if growth > best[0]:
                text = (
                    f"no one function can hold for the whole table, since jumping between {ends[a]:g} and {ends[b]:g} "
                    f"Hz every {1e3 * count * loop.dt:.3g} ms makes the loop grow by {growth:.3g} 1/s"
                )
                best = (growth, text)
    return best[1]


def _try_one(
    loop: _Loop, kinks: Array, samples: Samples, start: tuple[Array, Array], scale: Array
) -> TransitionCertificate | None:
    """One function for the whole table, if there is one that passes."""
    middle = len(start[0]) // 2
    candidates: list[Callable[[], Array | None]] = [
        lambda: start[0][middle],
        lambda: one_function(samples, start[0][middle], start[1]),
    ]
    for candidate in candidates:
        P = candidate()
        if P is None:
            continue
        knots = samples.knots_hz[[0, -1]]
        functions = _unscaled(np.array([P, P]), scale)
        margin = min(_worst_margin(loop, kinks, knots, functions, 0.0, offset) for offset in (0.0, 0.381966))
        if margin > 0.0:
            reason = "one function falls at every frequency of the table: it may move, or jump, as fast as it likes"
            return _certificate(True, "one function", math.inf, margin, reason, knots, functions)
    return None


def _fastest(
    loop: _Loop,
    kinks: Array,
    samples: Samples,
    start: tuple[Array, Array],
    scale: Array,
    most_solves: int,
    enough_hz_s: float,
) -> tuple[float, Array] | None:
    """Largest sweep rate that passed on the grid, less the safety share, with its functions."""
    best: tuple[float, Array] | None = None

    def judge(P: Array) -> bool:
        nonlocal best
        functions = _unscaled(P, scale)
        rate = SAFETY * _verified_rate(loop, kinks, samples.knots_hz, functions)
        if rate > 0.0 and (best is None or rate > 1.02 * best[0]):
            best = (rate, functions)
            return True
        return False

    judge(start[0])
    if most_solves <= 0 or (best is not None and best[0] >= enough_hz_s):
        return best
    program = MovingProgram(samples, *start)
    asked, failed = max(frozen_rate_hz_s(samples, *start), FIRST_HZ_S), math.inf
    for _ in range(most_solves):
        # Doubled while it works, then halved in between: bisection on the logarithm of the rate.
        asked = 2.0 * asked if failed == math.inf else math.sqrt(asked * failed)
        P = program.solve(asked)
        if P is not None and judge(P):
            asked = max(asked, best[0] if best is not None else 0.0)
            if asked >= enough_hz_s:
                break
            continue
        if best is None and asked > FIRST_HZ_S:
            asked = 0.1 * asked
            continue
        if best is None or asked < 1.05 * best[0]:
            break
        failed, asked = asked, best[0]
    return best


def _verified_rate(loop: _Loop, kinks: Array, knots: Array, functions: Array) -> float:
    """Sweep rate at which the functions fall on the whole grid [Hz/s]; 0 if they do not even at rest."""
    rate = math.inf
    for f in _grid(kinks, knots):
        A = loop(float(f))
        P, slopes = _between(knots, functions, float(f))
        for slope in slopes:
            rate = min(rate, admissible_rate_hz_s(A, P, slope, loop.dt, LEAST_DECAY_1_S))
        if rate == 0.0:
            return 0.0
    return rate


def _worst_margin(
    loop: _Loop, kinks: Array, knots: Array, functions: Array, rate_hz_s: float, offset: float
) -> float:
    """Least decay of the functions [1/s] on a grid that is refined wherever it could hide a change of sign."""
    grid = _grid(kinks, knots, offset)
    found = {float(f): _decay(loop, knots, functions, float(f), rate_hz_s) for f in grid}
    for _ in range(REFINEMENTS):
        known = sorted(found)
        doubtful = [
            0.5 * (a + b) for a, b in pairwise(known) if abs(found[a] - found[b]) > min(found[a], found[b])
        ]
        if not doubtful or min(found.values()) <= 0.0:
            break
        found |= {f: _decay(loop, knots, functions, f, rate_hz_s) for f in doubtful}
    return min(found.values())


def _decay(loop: _Loop, knots: Array, functions: Array, frequency_hz: float, rate_hz_s: float) -> float:
    P, slopes = _between(knots, functions, frequency_hz)
    least = math.inf
    for slope in slopes:
        parts = decay_and_drift(loop(frequency_hz), P, slope, loop.dt)
        if parts is None:
            return -math.inf
        decay, drift, rounding = parts
        for sign in (1.0, -1.0):
            least = min(least, float(np.linalg.eigvalsh(decay + sign * rate_hz_s * drift).min()) - rounding)
    return least


def _between(knots: Array, functions: Array, frequency_hz: float) -> tuple[Array, list[Array]]:
    """P at a frequency, and its slopes there: two at a knot with intervals on both sides."""
    if len(knots) == 1:
        return functions[0], [np.zeros_like(functions[0])]
    f = min(max(frequency_hz, float(knots[0])), float(knots[-1]))
    right = min(max(int(np.searchsorted(knots, f, side="right")), 1), len(knots) - 1)
    intervals = [right - 1]
    if right > 1 and f == knots[right - 1]:
        intervals.append(right - 2)
    slopes = [(functions[k + 1] - functions[k]) / (knots[k + 1] - knots[k]) for k in intervals]
    share = (f - knots[right - 1]) / (knots[right] - knots[right - 1])
    return np.asarray((1.0 - share) * functions[right - 1] + share * functions[right]), slopes


def _unscaled(P: Array, scale: Array) -> Array:
    """Functions in the states as they are, from those in units of ``scale``."""
    return np.asarray(P / (scale[:, None] * scale))


def _certificate(
    shown: bool, method: Method, rate: float, margin: float, reason: str, knots: Array, functions: Array
) -> TransitionCertificate:
    return TransitionCertificate(
        shown=shown,
        method=method,
        fastest_sweep_hz_s=rate,
        worst_margin_1_s=margin,
        reason=reason,
        knots_hz=read_only(knots),
        functions=read_only(functions),
    )
