"""From this very instant on: the full twin run forward under other gains, sample by sample on the loop as deployed.

The start is an estimate, not a truth, unknown forces go on acting, and the damping is known to so much. The covariance
of the first two is carried through the closed loop beside the run, and the run is repeated with the damping one
standard deviation off: together they say how far the prediction can be believed.
"""

import math
from dataclasses import dataclass

import numpy as np

from tuning.loop import LoopFacts, RigModel
from tuning.sweep import current_clamp_a, packed_gains
from twin.control.chain import chain_matrices, chain_step
from twin.control.rig_block import rig_block
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant
from twin.plant.linear import Array, linear_model, read_only

STEP_S = 0.1
"""Gains go linearly over this time and the damping is that of its middle, as at the rig."""

SETTLED_CYCLES = 4
"""Cycles of measured acceleration that tell the phasor from which the filters start."""

OFF = Gains(0.0, 0.0, 0.0, 200.0, 1.0)


@dataclass(frozen=True, slots=True)
class Instant:
    """Where everything stands at one sample. Arrays are read-only.

    Attributes
    ----------
    frequency_hz, rate_hz_s
        Excitation, and how fast its frequency moves; a branch goes on so.
    drive
        Phasor of the excitation: it is ``Re(drive exp(2 pi j (f t + rate t²/2)))`` at t seconds from here.
    state, covariance
        Of the plant (n,) and (n, n), in the order of `linear_model`.
    acceleration
        (N,) measured relative acceleration up to here [m/s²]; the filters are run through it.
    reference_a
        Current reference at the converter.
    """

    frequency_hz: float
    rate_hz_s: float
    drive: complex
    state: Array
    covariance: Array
    acceleration: Array
    reference_a: float


@dataclass(frozen=True, slots=True)
class BranchTrace:
    """One branch. Arrays are (n,), read-only, and start one step after the instant.

    Attributes
    ----------
    displacement_m, displacement_std_m
        Of the primary, and its standard deviation: of the start, of unknown forces since, of the damping.
    current_a
        Of the coil.
    joule_mean_w
        Mean of R i² over the second half.
    stopped
        Why the rig would have switched control off, if it would have: the branch itself goes on.
    """

    name: str
    time_s: Array
    displacement_m: Array
    displacement_std_m: Array
    current_a: Array
    joule_mean_w: float
    stopped: str


class Brancher:
    """Runs branches from one instant.

    Parameters
    ----------
    plant
        As identified, the damping in use included.
    facts
        Sampling and delay of the rig's loop.
    instant
        Where to start.
    damping_std_ns_m
        Standard deviation of the absorber's damping [Ns/m].
    force_density_n
        One-sided density [N/sqrt(Hz)] of the unknown white force on every body that has none of its own.
    """

    def __init__(
        self,
        plant: Plant,
        facts: LoopFacts,
        instant: Instant,
        damping_std_ns_m: float = 0.0,
        force_density_n: float = 0.01,
    ) -> None:
        self._plant, self._facts, self._instant = plant, facts, instant
        self._damping_std, self._density = damping_std_ns_m, force_density_n
        self._settled: dict[Gains, tuple[Array, float]] = {}
        self._states = linear_model(plant, frequency_hz=instant.frequency_hz).states

    def run(self, name: str, schedule: GainSchedule | None, seconds: float, every: int = 50) -> BranchTrace:
        """Run one branch.

        Parameters
        ----------
        schedule
            Gains; None switches control off.
        seconds
            How far.
        every
            Samples per row of the trace.

        Raises
        ------
        InputError
            If the plant states no limit on the coil's current.
        """
        fs, instant = self._facts.sample_rate_hz, self._instant
        x, current, reference, stopped = self._go(schedule, seconds, instant.state, 0.0)
        variance = self._variance(schedule, len(x) // every, every)
        rows = slice(every - 1, len(variance) * every, every)
        if self._damping_std > 0.0:
            beside = self._go(schedule, seconds, instant.state, self._damping_std)[0]
            variance += (beside[rows] - x[rows]) ** 2
        coil = self._plant.voice_coil
        resistance = coil.resistance_ohm if coil is not None else math.nan
        heat = resistance * float(np.mean(current[len(current) // 2 :] ** 2))
        limit = math.inf if coil is None else self._plant.limits.get(f"{coil.name}_power_w", math.inf)
        drawn = resistance * float(np.mean(reference**2))
        return BranchTrace(
            name=name,
            time_s=read_only((np.arange(len(x)) + 1.0)[rows] / fs),
            displacement_m=read_only(x[rows]),
            displacement_std_m=read_only(np.sqrt(variance)),
            current_a=read_only(current[rows]),
            joule_mean_w=heat,
            stopped=stopped or (f"coil power {drawn:.1f} W is over the limit" if drawn > limit else ""),
        )

    def _go(
        self, schedule: GainSchedule | None, seconds: float, start: Array, more_damping: float
    ) -> tuple[Array, Array, Array, str]:
        """Displacement of the primary [m], coil current and reference [A], sample by sample; why it would stop."""
        plant, facts, instant = self._plant, self._facts, self._instant
        fs, n_all = facts.sample_rate_hz, max(1, round(seconds * facts.sample_rate_hz))
        step = max(1, round(STEP_S * fs))
        absorber = plant.absorber
        x = np.array(start)
        n = len(x)
        gains = OFF if schedule is None else schedule.at(instant.frequency_hz)
        model = RigModel(plant, facts, instant.frequency_hz)
        clamp = current_clamp_a(plant, model.coil)
        on = schedule is not None and schedule.acts_at(instant.frequency_hz)
        chain, command = self._filters(model, gains)
        line = np.full(facts.delay_samples + 1, float(np.clip(command, -clamp, clamp)) if on else 0.0)
        line[0] = instant.reference_a  # what the converter holds, the old gains computed
        u_before = np.zeros(len(plant.actuator))
        u_before[model.coil_input] = instant.reference_a
        u_before[model.excitation_input] = instant.drive.real
        states, reference = np.empty((n_all, n)), np.empty(n_all)
        y, t = np.empty((n_all, 1)), (np.arange(n_all) + 1.0) / fs
        phase = math.tau * (instant.frequency_hz + 0.5 * instant.rate_hz_s * t) * t
        drive = (instant.drive * np.exp(1j * phase)).real
        hz = np.maximum(instant.frequency_hz + instant.rate_hz_s * t, 1.0)
        quiet, noise, unlimited = np.zeros(step), np.zeros((step, 1)), np.array([math.inf])
        stopped = ""
        for first in range(0, n_all, step):
            rows = slice(first, min(first + step, n_all))
            length = rows.stop - first
            low, high = float(hz[first]), float(hz[rows.stop - 1])
            middle = 0.5 * (low + high)
            damping = absorber.damping_at(middle) + more_damping if absorber is not None else None
            model = RigModel(plant, facts, middle, damping)
            d = model.stepping()
            on = schedule is not None and schedule.acts_at(middle)
            ends = (gains, gains) if schedule is None else (schedule.at(low), schedule.at(high))
            stroke = rig_block(
                d.F, d.B0, d.B1, d.C, d.D, np.zeros(n), x, u_before, chain, line, drive[rows], quiet[:length],
                noise[:length], unlimited, np.ones(1), packed_gains(ends[0], model.coil, fs),
                packed_gains(ends[1], model.coil, fs), on, clamp, 1.0 / fs, model.coil_input,
                model.excitation_input, y[rows], reference[rows], states[rows],
            )  # fmt: skip
            most = plant.limits.get("stroke_m", math.inf)
            if on and not stroke <= most and not stopped:
                stopped = f"stroke {stroke * 1e3:.2f} mm passes the limit {most * 1e3:.2f} mm"
        primary = self._states.index(f"x_{plant.primary.name}")
        current = states[:, self._states.index(f"i_{model.coil.name}")]
        return states[:, primary], current, reference, stopped

    def _filters(self, model: RigModel, gains: Gains) -> tuple[Array, float]:
        if gains not in self._settled:
            self._settled[gains] = self._chain(model, gains)
        chain, command = self._settled[gains]
        return chain.copy(), command

    def _chain(self, model: RigModel, gains: Gains) -> tuple[Array, float]:
        """State of the filters after the measured acceleration, and the command that follows from it [A]."""
        a, fs = self._instant.acceleration, self._facts.sample_rate_hz
        A, B, _, _ = chain_matrices(gains.low_pass_hz, gains.high_pass_hz, fs)
        # They ran long before this stretch: start as settled at the excitation, as it is where the stretch begins.
        some = min(len(a), round(SETTLED_CYCLES * fs / self._instant.frequency_hz))
        began_hz = self._instant.frequency_hz - self._instant.rate_hz_s * (len(a) - 0.5 * some) / fs
        w = math.tau * began_hz / fs
        k = np.arange(some)
        basis = np.column_stack([np.cos(w * k), -np.sin(w * k), np.ones(some)])
        real, imaginary, _ = np.linalg.lstsq(basis, a[:some], rcond=None)[0]
        before = complex(real, imaginary) * np.exp(-1j * w)
        s = np.ascontiguousarray(
            (np.linalg.solve(np.exp(1j * w) * np.eye(len(A)) - A, B[:, 0]) * before).real
        )
        s = A @ s + B[:, 0] * before.real
        low, high = (math.tan(math.pi * f / fs) for f in (gains.low_pass_hz, gains.high_pass_hz))
        out = (0.0, 0.0, 0.0)
        for value in a:
            out = chain_step(s, value, low, high, 1.0 / fs)
        law = np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m]) / model.coil.force_constant_n_a
        return s, float(law @ np.array(out))

    def _variance(self, schedule: GainSchedule | None, steps: int, every: int) -> Array:
        """Variance of the primary's displacement [m²] by the start's covariance and unknown forces, a row per step.

        The loop is taken for linear, which it is while the current stays below its clamp.
        """
        plant, instant, fs = self._plant, self._instant, self._facts.sample_rate_hz
        n, row = len(self._states), self._states.index(f"x_{plant.primary.name}")
        per_block = max(1, round(STEP_S * fs / every))
        out, P = np.empty(steps), np.zeros((0, 0))
        for first in range(0, steps, per_block):
            f = max(instant.frequency_hz + instant.rate_hz_s * (first + 0.5 * per_block) * every / fs, 1.0)
            on = schedule is not None and schedule.acts_at(f)
            A = RigModel(plant, self._facts, f).closed_loop_matrix(schedule.at(f) if schedule and on else OFF)
            if not P.size:
                P = np.zeros(A.shape)
                P[:n, :n] = instant.covariance
            Q = np.zeros(A.shape)
            for body in plant.body:
                density = body.disturbance_density_n
                density = self._density if density is None else density
                v = self._states.index(f"v_{body.name}")
                Q[v, v] = 0.5 * density**2 / (fs * body.mass_kg**2)
            A, Q = _over(A, Q, every)
            for k in range(first, min(first + per_block, steps)):
                P = A @ P @ A.T + Q
                out[k] = P[row, row]
        return np.maximum(out, 0.0)


def _over(A: Array, Q: Array, samples: int) -> tuple[Array, Array]:
    """Transition and process noise over several samples: A^N and the sum of A^i Q A^i', by doubling."""
    whole, noise = np.eye(len(A)), np.zeros_like(Q)
    while samples:
        if samples % 2:
            whole, noise = A @ whole, A @ noise @ A.T + Q
        A, Q = A @ A, A @ Q @ A.T + Q
        samples //= 2
    return whole, noise
