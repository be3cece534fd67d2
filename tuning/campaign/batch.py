"""Tiles of cases for the kernel, and what it hands back per case and span."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from tuning.campaign.kernel import (
    FIGURES,
    INPUTS,
    MEMORY,
    POWER_WINDOW_BLOCKS,
    TILE,
    in_order,
    rows_of,
    run_spans,
    terms_of,
)
from tuning.loop import LoopFacts
from twin.control.schedule import GainSchedule
from twin.plant.config import DampingTable, Plant, VoiceCoil
from twin.plant.discrete import discretise
from twin.plant.errors import InputError
from twin.plant.linear import Array, linear_model, read_only

NOISE_BLOCKS = 10
"""So many blocks of sensor noise are in memory at a time."""

INTERPOLATED_TO = 1e-13
MOST_NODES = 12


@dataclass(frozen=True, slots=True)
class Excitation:
    """What shakes every case of a tile, for amplitude 1. Arrays are read-only.

    Attributes
    ----------
    samples
        (N,) values.
    spans
        (S, 3) first sample, sample after the last and 1 where a block of the rig ends there.
    edges_hz
        (S, 2) frequency at both ends of each span.
    sample_rate_hz
        Of the loop.
    """

    samples: Array
    spans: Array
    edges_hz: Array
    sample_rate_hz: float

    @property
    def middle_hz(self) -> Array:
        """(S,) frequency in the middle of each span, where damping is read and control switched."""
        return np.asarray(0.5 * (self.edges_hz[:, 0] + self.edges_hz[:, 1]))


@dataclass(frozen=True, slots=True)
class Case:
    """One plant under one schedule.

    Attributes
    ----------
    plant
        As it really is; states the limits the rig enforces.
    facts
        Sampling, delay and measurement of its loop.
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    exciter
        Name of that actuator.
    noise_seed
        Of the sensors' noise, drawn as the simulated rig draws it; None for none.
    """

    plant: Plant
    facts: LoopFacts
    schedule: GainSchedule
    amplitude: float
    exciter: str
    noise_seed: int | None = None

    @property
    def coil(self) -> VoiceCoil:
        """The coil that makes the absorber active; InputError if there is none behind a current loop."""
        coil = self.plant.voice_coil
        if coil is None or coil.between is None or coil.current_loop_kp_v_a is None:
            raise InputError(
                f"plant '{self.plant.name}' has no voice coil between two bodies with current_loop_kp_v_a [V/A]; "
                "a campaign runs the rig's own law"
            )
        return coil

    def limit(self, key: str) -> float:
        """A limit that the rig enforces; InputError if the plant does not state it."""
        if key not in self.plant.limits:
            raise InputError(
                f"plant '{self.plant.name}': limits.{key} [{self.plant.limit_units[key]}] is missing: without it the "
                "coil may not be driven; add it to the plant file"
            )
        return self.plant.limits[key]


@dataclass(frozen=True, slots=True)
class _Lane:
    """One case as the kernel takes it."""

    nodes_ns_m: Array
    coefficients: Array
    constants: Array
    places: tuple[int, ...]
    delay: int
    n: int
    noise_std: Array
    accelerometers: tuple[int, int]


@dataclass(frozen=True, slots=True)
class TileRun:
    """What happened to each case of a tile. Arrays are read-only.

    Attributes
    ----------
    figures
        (S, FIGURES, cases), see `tuning.campaign.kernel`.
    tripped_at_s
        (cases,) when the rig switched control off by itself; -1 if it did not.
    """

    figures: Array
    tripped_at_s: Array


def run_cases(cases: Sequence[Case], excitation: Excitation) -> TileRun:
    """Run cases through an excitation, tile by tile.

    A case's result is the same to the bit in whatever company and order it is run.

    Raises
    ------
    InputError
        If a plant lacks what the rig's law needs: a coil behind a current loop, accelerometers, limits.
    """
    lanes = [_lane(case) for case in cases]
    figures = np.empty((len(excitation.spans), FIGURES, len(cases)))
    tripped = np.empty(len(cases))
    for alike in _tiles(lanes):
        some = [cases[j] for j in alike]
        out, at = _run_tile(some, [lanes[j] for j in alike], excitation)
        figures[:, :, alike], tripped[alike] = out, at
    return TileRun(read_only(figures), read_only(tripped))


def _tiles(lanes: Sequence[_Lane]) -> Iterator[list[int]]:
    """Indices of up to TILE cases with the same states in the same places."""
    kinds: dict[tuple[int, tuple[int, ...], bool], list[int]] = {}
    for j, lane in enumerate(lanes):
        kinds.setdefault((lane.n, lane.places, bool(lane.noise_std.any())), []).append(j)
    for alike in kinds.values():
        for first in range(0, len(alike), TILE):
            yield alike[first : first + TILE]


def _run_tile(cases: Sequence[Case], lanes: Sequence[_Lane], excitation: Excitation) -> tuple[Array, Array]:
    width, spans, fs = len(cases), excitation.spans, excitation.sample_rate_hz
    rows = len(lanes[0].coefficients[0])
    nodes = max(len(lane.coefficients) for lane in lanes)
    coefficients, weights = np.zeros((nodes, rows, TILE)), np.zeros((len(spans), nodes, TILE))
    gains, acts = np.empty((len(spans), 2, 5, TILE)), np.zeros((len(spans), TILE))
    constants, delays = np.zeros((10, TILE)), np.ones(TILE, dtype=np.int64)
    for c, (case, lane) in enumerate(zip(cases, lanes, strict=True)):
        coefficients[: len(lane.coefficients), :, c] = lane.coefficients
        weights[:, : len(lane.coefficients), c] = _weights(case, lane.nodes_ns_m, excitation.middle_hz)
        gains[..., c] = _packed(case.schedule, case.coil.force_constant_n_a, excitation)
        on = (case.schedule.on_from_hz <= excitation.middle_hz) & (
            excitation.middle_hz <= case.schedule.on_to_hz
        )
        acts[:, c], constants[:, c], delays[c] = on, lane.constants, lane.delay
    # Lanes without a case run along on a plant of zeros; what is alike in all others shall stay so.
    gains[..., width:], delays[width:] = gains[..., :1], delays[0]
    n, window = lanes[0].n, POWER_WINDOW_BLOCKS
    guard = np.zeros((window + 3, TILE))
    guard[-1] = -1.0
    terms = terms_of(n)
    state = (
        np.empty(rows * TILE), np.zeros(terms * TILE), np.zeros(MEMORY), np.zeros((int(delays.max()), TILE)), guard,
        np.zeros(3),
    )  # fmt: skip
    figures = np.zeros((len(spans), FIGURES * TILE))
    plants, laws = coefficients.reshape(nodes, -1), gains.reshape(len(spans), 2, -1)
    shape = np.concatenate([[0.0], excitation.samples])
    places = np.array(lanes[0].places, dtype=np.int64)
    for part, noise in _noises(cases, lanes, spans):
        run_spans(
            plants, weights[part], laws[part], acts[part], spans[part], shape, noise, constants,
            places, delays, *state, figures[part], 1.0 / fs, n, terms,
        )  # fmt: skip
    tripped = guard[-1, :width]
    return figures.reshape(-1, FIGURES, TILE)[:, :, :width], np.where(tripped < 0.0, -1.0, tripped / fs)


def _noises(cases: Sequence[Case], lanes: Sequence[_Lane], spans: Array) -> Iterator[tuple[slice, Array]]:
    """Spans to run in one go, and the noise of their accelerometers, drawn block by block as the rig does."""
    if not lanes[0].noise_std.any():
        yield slice(0, len(spans)), np.zeros((0, 2, TILE))
        return
    generators = [np.random.default_rng(case.noise_seed) for case in cases]
    ends = np.nonzero(spans[:, 2])[0] + 1
    first = 0
    for last in [*ends[NOISE_BLOCKS - 1 :: NOISE_BLOCKS].tolist(), len(spans)]:
        if last <= first:
            continue
        count = int(spans[last - 1, 1] - spans[first, 0])
        noise = np.zeros((count, 2, TILE))
        for c, (generator, lane) in enumerate(zip(generators, lanes, strict=True)):
            drawn = generator.standard_normal((count, len(lane.noise_std))) * lane.noise_std
            noise[:, :, c] = drawn[:, lane.accelerometers]
        yield slice(first, last), noise
        first = last


def _lane(case: Case) -> _Lane:
    plant, facts, coil = case.plant, case.facts, case.coil
    fs = facts.sample_rate_hz
    inputs = [a.name for a in plant.actuator]
    drive, exciter = inputs.index(coil.name), inputs.index(case.exciter)
    nodes = _damping_nodes(plant, fs)
    absorber = plant.absorber
    holds = ["foh" if j == exciter else "zoh" for j in range(len(inputs))]
    at = {s.of: k for k, s in reversed(list(enumerate(plant.sensor))) if s.kind == "acceleration"}
    first, second = coil.between or ("", "")
    if second not in at or (facts.relative and first not in at):
        bare = first if second in at else second
        raise InputError(
            f"plant '{plant.name}': the control law needs an accelerometer on body '{bare}'; "
            'add a [[sensor]] with kind = "acceleration"'
        )
    pair = (at.get(first, at[second]), at[second])
    sensors = list(pair)
    rows: list[Array] = []
    states: tuple[str, ...] = ()
    for damping in nodes:
        own = {} if absorber is None else {absorber.name: float(damping)}
        model = linear_model(plant, frequency_hz=None, damping_ns_m=own)
        discrete = discretise(model, fs, holds)  # type: ignore[arg-type]
        n, states = len(model.states), model.states
        sums, feel = np.zeros((rows_of(n), terms_of(n))), slice(n, n + 2)
        last, present = _held(model.A, model.B[:, drive], discrete.B0[:, drive], facts)
        sums[:n, :n] = discrete.F
        sums[:n, n : n + INPUTS] = np.column_stack(
            [last, present, discrete.B0[:, exciter], discrete.B1[:, exciter]]
        )
        # What is felt is what the states are by then: its sums are of the same terms.
        sums[feel] = model.C[sensors] @ sums[:n]
        sums[feel, n + INPUTS - 1] += model.D[sensors, exciter]
        rows.append(in_order(sums))
    ends = [plant.sensor[k].range or math.inf for k in pair]
    constants = np.array([
        case.amplitude, case.limit(f"{coil.name}_current_a"), ends[0], 1.0 if facts.relative else 0.0, ends[1],
        -1.0, coil.force_constant_n_a, coil.inductance_h, case.limit("stroke_m"),
        case.limit(f"{coil.name}_power_w") / coil.resistance_ohm,
    ])  # fmt: skip
    names = (
        [f"x_{plant.primary.name}"] + [f"{q}_{p}" for p in (second, first) for q in "xv"] + [f"i_{coil.name}"]
    )
    places = tuple(states.index(name) if name in states else -1 for name in names)
    std = np.zeros(len(plant.sensor))
    if case.noise_seed is not None:
        std = np.sqrt([s.noise_variance(fs) for s in plant.sensor])
    stepped = facts.delay_fraction > 0.0 or facts.delay_samples == 0
    return _Lane(
        nodes, np.array(rows), constants, places, facts.delay_samples + stepped, len(states), std, pair
    )


def _held(A: Array, b: Array, level: Array, facts: LoopFacts) -> tuple[Array, Array]:
    """What the last and the present command do to the state over a sample, (n,) each.

    With whole samples of delay the rig's converter takes the present command at the sample and holds it until the
    next. Otherwise a command stands for the interval that ends with its sample, and changes inside it.
    """
    share = facts.delay_fraction
    if share == 0.0:
        quiet = np.zeros(len(level))
        return (quiet, level) if facts.delay_samples == 0 else (level, quiet)
    n = len(A)
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = A, b
    late = expm(block * ((1.0 - share) / facts.sample_rate_hz))[:n, n]
    return level - late, late


def _damping_nodes(plant: Plant, sample_rate_hz: float) -> Array:
    """Dampings [Ns/m] at which a plant is discretised.

    A matrix exponential is an entire function of the damping: between Chebyshev's nodes the interpolation error is
    below ``(r dt)^Q / (Q! 2^(Q-1))`` with r half of the range over the reduced mass.
    """
    absorber = plant.absorber
    if absorber is None or not isinstance(absorber.damping_ns_m, DampingTable):
        return np.array([0.0 if absorber is None else absorber.damping_at(None)])
    low, high = min(absorber.damping_ns_m.ns_m), max(absorber.damping_ns_m.ns_m)
    if low == high:
        return np.array([low])
    lightest = min(body.mass_kg for body in plant.body)
    reach, count = (high - low) / lightest / sample_rate_hz, 2
    while (
        count < MOST_NODES and reach**count / (math.factorial(count) * 2.0 ** (count - 1)) > INTERPOLATED_TO
    ):
        count += 1
    points = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * points)


def _weights(case: Case, nodes: Array, frequency_hz: Array) -> Array:
    """Lagrange weights of the nodes at the dampings of the spans, (S, Q)."""
    weights = np.ones((len(frequency_hz), len(nodes)))
    absorber = case.plant.absorber
    if len(nodes) == 1 or absorber is None or not isinstance(absorber.damping_ns_m, DampingTable):
        return weights
    table = absorber.damping_ns_m
    damping = np.interp(frequency_hz, table.frequency_hz, table.ns_m)
    for q in range(len(nodes)):
        for other in range(len(nodes)):
            if other != q:
                weights[:, q] *= (damping - nodes[other]) / (nodes[q] - nodes[other])
    return weights


def _packed(schedule: GainSchedule, force_constant_n_a: float, excitation: Excitation) -> Array:
    """Gains and cutoffs of every span's ends in the kernel's units, (S, 2, 5)."""
    table = _table(schedule, excitation.sample_rate_hz, excitation.edges_hz.tobytes())
    packed = table / np.array([force_constant_n_a] * 3 + [1.0, 1.0])
    packed[:, 1] -= packed[:, 0]
    return np.asarray(packed)


@lru_cache(maxsize=8)
def _table(schedule: GainSchedule, sample_rate_hz: float, edges: bytes) -> Array:
    hz = np.frombuffer(edges).reshape(-1, 2)
    table = np.stack(
        [
            np.interp(hz, schedule.frequency_hz, column)
            for column in (
                schedule.alpha_kg, schedule.beta_ns_m, schedule.gamma_n_m, schedule.low_pass_hz,
                schedule.high_pass_hz,
            )
        ],
        axis=-1,
    )  # fmt: skip
    table[..., 3:] = np.tan(np.pi * table[..., 3:] / sample_rate_hz)
    return read_only(table)
