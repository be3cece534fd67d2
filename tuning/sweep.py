"""A sweep of the excitation through a schedule, sample by sample on the loop as deployed, beside its steady states.

The plant is stepped exactly, in blocks as the rig exchanges them: within a block the gains go linearly from those of
its first to those of its last frequency, as the rig's firmware does, and damping against frequency is that of its
middle. No sensor noise: what is left over against the quasi-steady prediction is the sweep's own doing, transients of
modes with little damping and of the switch at the ends of the controller's band.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from tuning.loop import LoopFacts, RigModel
from tuning.steady import predict
from twin.control.chain import CHAIN_STATES
from twin.control.rig_block import rig_block
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant, VoiceCoil
from twin.plant.errors import InputError
from twin.plant.linear import Array, linear_model, read_only

BLOCK_S = 0.1
"""How long the rig goes by one pair of gains (thesis 7.8)."""

MOST_SAMPLES = 100_000_000


@dataclass(frozen=True, slots=True)
class SweepResult:
    """What happens during a sweep, a row per block. Arrays are (blocks,) and read-only.

    Attributes
    ----------
    time_s, frequency_hz
        Middle of the block.
    control_on
        Whether the controller acted.
    displacement_m, steady_displacement_m
        Largest |x1| in the block, and the peak in steady state at this frequency.
    stroke_m, steady_stroke_m
        Largest |x_r|, likewise.
    current_peak_a, steady_current_peak_a
        Largest coil current, likewise.
    joule_mean_w, joule_peak_w, electrical_mean_w
        R i² on average and at most, and v i on average, over the block.
    saturated
        Share of the block's samples in which the current reference was at its clamp.
    """

    time_s: Array
    frequency_hz: Array
    control_on: Array
    displacement_m: Array
    steady_displacement_m: Array
    stroke_m: Array
    steady_stroke_m: Array
    current_peak_a: Array
    steady_current_peak_a: Array
    joule_mean_w: Array
    joule_peak_w: Array
    electrical_mean_w: Array
    saturated: Array

    @property
    def sweep_rate_hz_s(self) -> float:
        """Rate at which the frequency moved [Hz/s]; negative downwards."""
        if len(self.time_s) < 2:
            return 0.0
        return float((self.frequency_hz[-1] - self.frequency_hz[0]) / (self.time_s[-1] - self.time_s[0]))

    def worst_excess_m(self, settled_blocks: int = 5) -> float:
        """Most by which |x1| passed its steady state [m], some blocks after the controller was last switched."""
        calm = np.ones(len(self.time_s), dtype=np.bool_)
        for k in np.nonzero(np.diff(self.control_on, prepend=-1.0))[0]:
            calm[k : k + settled_blocks] = False
        excess = (self.displacement_m - self.steady_displacement_m)[calm]
        return float(excess.max()) if len(excess) else 0.0


def simulate_sweep(
    plant: Plant,
    facts: LoopFacts,
    schedule: GainSchedule,
    from_hz: float,
    to_hz: float,
    seconds: float,
    excitation_amplitude: float,
    *,
    clamp_a: float | None = None,
    start: Array | None = None,
) -> SweepResult:
    """Sweep the excitation linearly and record motion, current and power.

    Parameters
    ----------
    plant
        As it really is; damping against frequency moves along.
    schedule
        Acts inside its band only.
    from_hz, to_hz, seconds
        Ends and duration of the sweep; it may go down, or stand still.
    excitation_amplitude
        Peak, in the exciting actuator's unit; 0 shows how a disturbance dies out.
    clamp_a
        Largest current reference [A]; None takes the plant's limit on the coil's current.
    start
        State of the plant at the start (n,), in the model's order; None starts at rest.

    Raises
    ------
    InputError
        If the plant states no limit on the coil's current and none is given, or the sweep cannot be run: a frequency
        not above 0 or not below half of the sample rate, a duration below one block.
    """
    fs = facts.sample_rate_hz
    samples = max(1, round(BLOCK_S * fs))
    _check(from_hz, to_hz, seconds, excitation_amplitude, fs)
    coil = RigModel(plant, facts, from_hz).coil
    clamp = current_clamp_a(plant, coil, clamp_a)
    blocks = int(seconds * fs + 1e-6) // samples
    edges = from_hz + (to_hz - from_hz) * np.arange(blocks + 1) * samples / (seconds * fs)
    names = linear_model(plant, frequency_hz=from_hz).states
    n, inputs = len(names), len(plant.actuator)
    x = np.zeros(n) if start is None else np.array(start, dtype=np.float64)
    if x.shape != (n,):
        raise InputError(f"start has shape {x.shape}; the plant has {n} states: {', '.join(names)}")
    u_before, chain, line = np.zeros(inputs), np.zeros(CHAIN_STATES), np.zeros(facts.delay_samples + 1)
    quiet, noise = np.zeros(samples), np.zeros((samples, 1))
    y, reference, states = np.empty((samples, 1)), np.empty(samples), np.empty((samples, n))
    rows = np.zeros((blocks, len(fields(SweepResult))))
    sweep = 0.5 * (to_hz - from_hz) / seconds
    for b in range(blocks):
        low, high = float(edges[b]), float(edges[b + 1])
        middle = 0.5 * (low + high)
        on = schedule.acts_at(middle)
        model = RigModel(plant, facts, middle)
        d = model.stepping()
        t = (b * samples + np.arange(samples)) / fs
        drive = excitation_amplitude * np.sin(math.tau * (from_hz + sweep * t) * t)
        rig_block(
            d.F, d.B0, d.B1, d.C, d.D, np.zeros(n), x, u_before, chain, line, drive, quiet, noise,
            np.array([math.inf]), np.ones(1), packed_gains(schedule.at(low), coil, fs),
            packed_gains(schedule.at(high), coil, fs), on, clamp, 1.0 / fs, model.coil_input,
            model.excitation_input, y, reference, states,
        )  # fmt: skip
        gains = schedule.at(middle)
        if not on:
            gains = replace(gains, alpha_kg=0.0, beta_ns_m=0.0, gamma_n_m=0.0)
        steady = predict(model, gains, middle, excitation_amplitude)
        reached = _reached(plant, coil, names, states, fs)
        rows[b] = (
            (b + 0.5) * samples / fs, middle, on, reached[0], steady.displacement_m, reached[1],
            steady.stroke_m, reached[2], steady.current_peak_a, *reached[3:],
            float(np.mean(np.abs(reference) >= clamp)),
        )  # fmt: skip
    return SweepResult(*(read_only(column) for column in rows.T))


def _reached(
    plant: Plant, coil: VoiceCoil, names: tuple[str, ...], states: Array, sample_rate_hz: float
) -> tuple[float, float, float, float, float, float]:
    """Largest motion, stroke and current of a block, and its three powers.

    The coil takes v i = R i² + d/dt(L i²/2) + k i (x2' - x1').
    """
    x = {b.name: states[:, names.index(f"x_{b.name}")] for b in plant.body}
    v = {b.name: states[:, names.index(f"v_{b.name}")] for b in plant.body}
    current = states[:, names.index(f"i_{coil.name}")]
    stroke, speed = np.zeros(len(states)), np.zeros(len(states))
    for place, sign in coil.pushes:
        if place in x:
            stroke += sign * x[place]
            speed += sign * v[place]
    joule = coil.resistance_ohm * current**2
    stored = 0.5 * coil.inductance_h * float(current[-1] ** 2 - current[0] ** 2)
    taken = float(np.mean(joule + coil.force_constant_n_a * current * speed))
    return (
        float(np.abs(x[plant.primary.name]).max()),
        float(np.abs(stroke).max()),
        float(np.abs(current).max()),
        float(np.mean(joule)),
        float(np.max(joule)),
        taken + stored * sample_rate_hz / max(len(states) - 1, 1),
    )


def packed_gains(gains: Gains, coil: VoiceCoil, sample_rate_hz: float) -> Array:
    """Gains and cutoffs in the units of `rig_block`, (5,)."""
    k = coil.force_constant_n_a
    low, high = (math.tan(math.pi * f / sample_rate_hz) for f in (gains.low_pass_hz, gains.high_pass_hz))
    return np.array([gains.alpha_kg / k, gains.beta_ns_m / k, gains.gamma_n_m / k, low, high])


def current_clamp_a(plant: Plant, coil: VoiceCoil, clamp_a: float | None = None) -> float:
    """Largest current reference [A]: the given one, else the plant's limit; InputError if there is neither."""
    key = f"{coil.name}_current_a"
    clamp = plant.limits.get(key) if clamp_a is None else clamp_a
    if clamp is None:
        raise InputError(
            f"plant '{plant.name}': limits.{key} [A] is missing; without it the coil is not driven; add it to the "
            "plant file"
        )
    if not clamp > 0.0:
        raise InputError(f"the current's clamp must be above 0 A, got {clamp:g}")
    return clamp


def _check(from_hz: float, to_hz: float, seconds: float, amplitude: float, sample_rate_hz: float) -> None:
    for hz in (from_hz, to_hz):
        if not 0.0 < hz < 0.5 * sample_rate_hz:
            raise InputError(
                f"a sweep to {hz:g} Hz cannot be run; stay between 0 and half of the sample rate"
            )
    if not BLOCK_S * (1.0 - 1e-9) <= seconds <= MOST_SAMPLES / sample_rate_hz:
        raise InputError(
            f"a sweep of {seconds:g} s cannot be run; give at least {BLOCK_S:g} s and at most "
            f"{MOST_SAMPLES / sample_rate_hz:g} s"
        )
    if not 0.0 <= amplitude < math.inf:
        raise InputError(f"the excitation's amplitude must be a number from 0 up, got {amplitude:g}")
