"""LQG for a steady vibration: the power-budgeted weights, an observer and the rig's delay in one discrete law.

The gain is the discrete LQ gain for the weights of `power_lq`, on the plant with its coil's circuit and current loop.
A command takes effect a delay later, so the gain acts on the state predicted to that moment, from the estimate and
from the commands on their way. The observer is a stationary Kalman filter of plant and oscillator: as it knows the
frequency, what it feeds back is narrow, and its caution against noise decides the margins.
"""

import math
from dataclasses import dataclass

import numpy as np

from estimators.riccati import double, steady_prior
from tuning.law_loop import LawLoop, StateSpaceLaw, SteadyState
from tuning.loop import LoopFacts, Margins
from tuning.power_lq import LQDesign, PowerBudgetedLQ
from tuning.sampled import SampledPlant, sampled_plant
from twin.plant.config import Plant
from twin.plant.discrete import discretise
from twin.plant.errors import RunError
from twin.plant.linear import Array, LinearModel, read_only

COMMAND_SHARE = 0.05
"""Weight on the command beside that on the current, which lags it by microseconds: bounds what is quicker."""
FORCE_NOISE = 1e-5
"""Density of the white forces the observer supposes, as a share of the absorber's inertial force per sqrt(Hz)."""
CAUTIONS = (1.0, 10.0, 100.0, 300.0, 1000.0)
TRIES = 8
USED = 0.995
"""A limit that binds is used to at least this share, or as far as a few tries bring it."""
BOUND_OF = {
    "power": "joule_mean_w", "current": "current_peak_a", "electrical": "electrical_mean_w", "stroke": "stroke_m",
}  # fmt: skip


@dataclass(frozen=True)
class LQGDesign:
    """A deployable law with what the full sampled model says of it.

    Attributes
    ----------
    law
        Matrices from the measured channels to the commanded current.
    lq
        The weights it follows from.
    caution
        How many times noisier than they are the observer takes the sensors to be, for the sake of the margins.
    margins, decay_rate_1_s
        Of the closed loop with its delay, the least over the dampings that were verified.
    steady
        At the excitation's frequency.
    worst_joule_mean_w
        The most mean Joule power at the frequency and the drift beside it [W].
    """

    law: StateSpaceLaw
    lq: LQDesign
    caution: float
    margins: Margins
    decay_rate_1_s: float
    steady: SteadyState
    worst_joule_mean_w: float


class LQGDesigner:
    """Design and verify LQG laws for one plant and rig.

    Parameters
    ----------
    plant
        With a voice coil that has a current loop, and one further actuator, which excites.
    facts
        Sampling and delay of the rig's loop.
    channels
        What is measured, as `sampled_plant`.
    modulus_margin, delay_margin_s
        What the law must keep.
    observer_bandwidth
        zeta that the observer supposes of the excitation: small is quiet at the frequency itself, large forgives
        drift and costs margin.
    effort_floor
        As `PowerBudgetedLQ`.
    """

    def __init__(
        self,
        plant: Plant,
        facts: LoopFacts,
        *,
        channels: tuple[str, ...] | None = None,
        modulus_margin: float = 0.5,
        delay_margin_s: float = 200e-6,
        observer_bandwidth: float = 1e-4,
        effort_floor: float = 0.01,
    ) -> None:
        self.plant, self.facts, self.channels = plant, facts, channels
        self.modulus_margin, self.delay_margin_s = modulus_margin, delay_margin_s
        self.observer_bandwidth = observer_bandwidth
        self.lq = PowerBudgetedLQ(plant, effort_floor=effort_floor)

    def solve(
        self,
        frequency_hz: float,
        excitation_amplitude: float,
        damping_ns_m: float | None = None,
        *,
        joule_mean_w: float = math.inf,
        current_peak_a: float = math.inf,
        electrical_mean_w: float = math.inf,
        stroke_m: float = math.inf,
        voltage_peak_v: float = math.inf,
        drift_hz: float = 0.0,
        damping_std_ns_m: float = 0.0,
    ) -> LQGDesign:
        """Find a law that keeps margins and limits on the full model.

        Parameters
        ----------
        frequency_hz, excitation_amplitude, damping_ns_m, joule_mean_w, current_peak_a, electrical_mean_w, stroke_m, \
drift_hz
            As `PowerBudgetedLQ.solve`; here the limits hold for the deployed law with the observer's error in it.
        voltage_peak_v
            Limit on the coil's terminal voltage [V]; kept by spending less power where it binds.
        damping_std_ns_m
            Margins and stability hold two of these off the damping, too.

        Raises
        ------
        InputError
            As `PowerBudgetedLQ.solve` and `sampled_plant`.
        RunError
            If no gain keeps the limits, or no observer the margins.
        """
        absorber = self.plant.absorber
        nominal = damping_ns_m
        if nominal is None and absorber is not None:
            nominal = absorber.damping_at(frequency_hz)
        spread = {nominal, max(0.0, (nominal or 0.0) - 2.0 * damping_std_ns_m)}
        spread.add((nominal or 0.0) + 2.0 * damping_std_ns_m)
        plants = [
            sampled_plant(self.plant, self.facts, frequency_hz, c, self.channels)
            for c in sorted(spread, key=lambda c: abs((c or 0.0) - (nominal or 0.0)))
        ]
        asked = {
            "joule_mean_w": joule_mean_w, "current_peak_a": current_peak_a,
            "electrical_mean_w": electrical_mean_w, "stroke_m": stroke_m,
        }  # fmt: skip
        bounds, start = dict(asked), 0
        asked["voltage_peak_v"] = voltage_peak_v
        best: LQGDesign | None = None
        shares: dict[str, float] = {}
        for _ in range(TRIES):
            lq = self.lq.solve(frequency_hz, excitation_amplitude, nominal, drift_hz=drift_hz, **bounds)
            design, start = self._with_margins(plants, lq, excitation_amplitude, drift_hz, start)
            shares = self._shares(plants[0], design, asked, excitation_amplitude, drift_hz)
            if max(shares.values()) <= 1.0 and (
                best is None or design.steady.displacement_m < best.steady.displacement_m
            ):
                best = design
            binding = {BOUND_OF[limit.name] for limit in lq.prices}
            off = {name for name in asked if shares[name] > 1.0 or (name in binding and shares[name] < USED)}
            if not off:
                break
            # What the observer's error spends more or less than the design is made good in the design's bounds.
            if "voltage_peak_v" in off:
                spent = min(bounds["joule_mean_w"], lq.joule_mean_w)
                bounds["joule_mean_w"] = spent * (0.99 / shares["voltage_peak_v"]) ** 2
                continue
            bounds = {
                name: bound * (0.5 + 0.5 * USED) / shares[name] if name in off else bound
                for name, bound in bounds.items()
            }
        if best is None:
            broken = max(shares, key=lambda name: shares[name])
            raise RunError(f"no observer kept the limit {broken} {asked[broken]:.4g} at {frequency_hz:g} Hz")
        return best

    def _with_margins(
        self, plants: list[SampledPlant], lq: LQDesign, amplitude: float, drift_hz: float, start: int
    ) -> tuple[LQGDesign, int]:
        """The least cautious observer with which the margins hold at every damping."""
        frequency, best = lq.excited.frequency_hz, 0.0
        for step in range(start, len(CAUTIONS)):
            law = lqg_law(plants[0], lq, amplitude, self.observer_bandwidth, CAUTIONS[step])
            loops = [LawLoop(plant, law) for plant in plants]
            found = [loop.margins(frequency) for loop in loops]
            modulus = min(m.modulus for m in found)
            delay = min((m.delay_s for m in found if m.delay_s is not None), default=None)
            best = max(best, modulus)
            if modulus < self.modulus_margin or (delay is not None and delay < self.delay_margin_s):
                continue
            decay = max(loop.decay_rate_1_s() for loop in loops)
            if not decay < 0.0:
                continue
            near = {frequency - drift_hz, frequency, frequency + drift_hz}
            worst = max(loops[0].steady(f, amplitude).powers.joule_mean_w for f in near)
            steady = loops[0].steady(frequency, amplitude)
            return LQGDesign(law, lq, CAUTIONS[step], Margins(modulus, delay), decay, steady, worst), step
        raise RunError(
            f"no observer keeps modulus margin {self.modulus_margin:g} and {1e6 * self.delay_margin_s:.0f} µs of "
            f"delay at {frequency:g} Hz (best modulus margin {best:.3f}); allow less, or raise effort_floor"
        )

    @staticmethod
    def _shares(
        plant: SampledPlant, design: LQGDesign, asked: dict[str, float], amplitude: float, drift_hz: float
    ) -> dict[str, float]:
        """How much of each limit the deployed law uses, at most, over the drift."""
        loop, f = LawLoop(plant, design.law), design.lq.excited.frequency_hz
        states = [loop.steady(x, amplitude) for x in {f - drift_hz, f, f + drift_hz}]
        used = {
            "joule_mean_w": max(s.powers.joule_mean_w for s in states),
            "current_peak_a": max(s.current_peak_a for s in states),
            "electrical_mean_w": max(s.powers.electrical_mean_w for s in states),
            "stroke_m": max(s.stroke_m for s in states),
            "voltage_peak_v": max(s.voltage_peak_v for s in states),
        }
        return {name: used[name] / bound for name, bound in asked.items()}


def lqg_law(
    plant: SampledPlant, lq: LQDesign, amplitude: float, observer_bandwidth: float, caution: float
) -> StateSpaceLaw:
    """Discrete LQG law with the plant's delay in its model.

    Parameters
    ----------
    plant
        With the channels that the observer uses.
    lq
        Weights, at the same frequency.
    amplitude
        Peak of the excitation, in the exciting actuator's unit.
    observer_bandwidth
        zeta of the excitation that the observer supposes.
    caution
        Factor on the sensors' noise.
    """
    joint = _Joint(plant, lq, amplitude, observer_bandwidth)
    K, previous = joint.gain()
    L = joint.observer(caution)
    n, d, line = len(joint.F), plant.facts.delay_samples, plant.waiting
    # The command sees the state a delay ahead: F^d of the estimate, and what the commands on their way will do.
    ahead = K @ np.linalg.matrix_power(joint.F, d)
    correct = np.eye(n) - L @ joint.C
    command, feed = np.zeros(n + line), -ahead @ L
    command[:n] = -ahead @ correct
    effect = K.copy()
    for age in range(d):
        command[n + age] -= effect @ joint.late
        if age + 1 < line:
            command[n + age + 1] -= effect @ joint.early
        effect = effect @ joint.F
    if line:
        command[n] -= previous
    p = len(joint.C)
    A, B = np.zeros((n + line, n + line)), np.zeros((n + line, p))
    A[:n, :n], B[:n] = joint.F @ correct, joint.F @ L
    for by, age in ((joint.late, d), (joint.early, d + 1)):
        if not by.any():
            continue
        if age == 0:
            A[:n] += np.outer(by, command)
            B[:n] += np.outer(by, feed)
        else:
            A[:n, n + age - 1] += by
    if line:
        A[n], B[n] = command, feed
        A[n + 1 :, n : n + line - 1] = np.eye(line - 1)
    return StateSpaceLaw(
        A=read_only(A),
        B=read_only(B),
        C=read_only(command * joint.current_a),
        D=read_only(feed * joint.current_a),
        channels=plant.channels,
        sample_rate_hz=plant.facts.sample_rate_hz,
    )


class _Joint:
    """Plant with coil circuit and oscillator, sampled, in units that make its numbers of order one."""

    def __init__(self, plant: SampledPlant, lq: LQDesign, amplitude: float, bandwidth: float) -> None:
        model, f = plant.model, lq.excited.frequency_hz
        n, w = len(model.A), math.tau * f
        self.plant, self.lq, self.own = plant, lq, n
        self.w, self.bandwidth = w, bandwidth
        A, b = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        A[:n, :n], b[:n] = model.A, model.B[:, plant.coil_input]
        drive = model.B[:, plant.excitation_input] * amplitude / math.sqrt(2.0)
        A[:n, n + 1] = drive
        A[n, n + 1], A[n + 1, n], A[n + 1, n + 1] = w, -w, -2.0 * bandwidth * w
        alone = np.linalg.solve(1j * w * np.eye(n) - model.A, math.sqrt(2.0) * drive)
        absorber = plant.plant.absorber
        place = model.states.index(f"x_{absorber.name}") if absorber is not None else 0
        mass = absorber.mass_kg if absorber is not None else 1.0
        # What shakes the absorber, as force: near the excitation itself.
        self.force_n = max(mass * w**2 * float(abs(alone[place])), 1e-6)
        k = plant.coil.force_constant_n_a
        self.current_a = max(lq.current_peak_a, 1e-2 * self.force_n / k)
        by_coil = np.linalg.solve(1j * w * np.eye(n) - model.A, b[:n] * self.current_a)
        size = np.abs(alone) + np.abs(by_coil)
        self.scale = np.concatenate([np.maximum(size, 1e-9 * size.max()), [1.0, 1.0]])
        rate = plant.facts.sample_rate_hz
        scaled = LinearModel(
            A=read_only(A * self.scale / self.scale[:, None]),
            B=read_only((b * self.current_a / self.scale)[:, None]),
            C=read_only(np.zeros((0, n + 2))),
            D=read_only(np.zeros((0, 1))),
            states=(),
            inputs=(),
            outputs=(),
        )
        whole = discretise(scaled, rate, ["zoh"])
        self.F, self.late = whole.F.copy(), whole.B0[:, 0].copy()
        if plant.facts.delay_fraction:
            self.late = discretise(scaled, rate / (1.0 - plant.facts.delay_fraction), ["zoh"]).B0[:, 0].copy()
        self.early = whole.B0[:, 0] - self.late
        C = np.zeros((len(plant.channels), n + 2))
        C[:, :n], C[:, n + 1] = plant.measured, plant.measured_feed * amplitude / math.sqrt(2.0)
        self.C = C * self.scale

    def gain(self) -> tuple[Array, float]:
        """Gain on the state at the moment the command takes effect, and on the command before it.

        The second is zero unless the delay has a fraction of a sample.
        """
        lq, model, n = self.lq, self.plant.model, self.own
        names = (*model.states, *lq.states[-2:])
        into = np.zeros((len(lq.states) + 1, n + 2))
        for row, name in enumerate(lq.states):
            into[row, names.index(name)] = 1.0
        current = model.states.index(f"i_{self.plant.coil.name}")
        into[-1, current] = self.plant.coil.force_constant_n_a
        into = into * self.scale
        weight = np.block([[lq.Q, lq.N[:, None]], [lq.N[None, :], np.array([[lq.R]])]])
        Q = into.T @ weight @ into
        R = COMMAND_SHARE * lq.R * (self.plant.coil.force_constant_n_a * self.current_a) ** 2
        fraction = bool(self.early.any())
        m = n + 1 if fraction else n
        # Own states first, then the command before if it still acts; the oscillator apart: no command reaches it.
        Fp, Fe, Fd = np.zeros((m, m)), np.zeros((m, 2)), self.F[n:, n:]
        Fp[:n, :n], Fe[:n] = self.F[:n, :n], self.F[:n, n:]
        g, Qp, Qe = np.zeros(m), np.zeros((m, m)), np.zeros((m, 2))
        g[:n], Qp[:n, :n], Qe[:n] = self.late[:n], Q[:n, :n], Q[:n, n:]
        if fraction:
            Fp[:n, n], g[n] = self.early[:n], 1.0
        P, step = Qp.copy(), Fp.copy()
        if not double(step, np.outer(g, g) / R, P):
            raise RunError("the discrete LQ problem has no solution for these weights")
        stiff = R + g @ P @ g
        own = g @ P @ Fp / stiff
        closed = Fp - np.outer(g, own)
        right = Qe + closed.T @ P @ Fe
        across = np.linalg.solve(np.eye(2 * m) - np.kron(closed.T, Fd.T), right.ravel()).reshape(m, 2)
        on_oscillator = g @ (P @ Fe + across @ Fd) / stiff
        return np.concatenate([own[:n], on_oscillator]), float(own[n]) if fraction else 0.0

    def observer(self, caution: float) -> Array:
        """Stationary Kalman gain (n + 2, p) from the innovation to the estimate at the same sample."""
        plant, n = self.plant, self.own
        rate = plant.facts.sample_rate_hz
        noise = np.zeros((n + 2, n + 2))
        noise[n + 1, n + 1] = 4.0 * self.bandwidth * self.w / rate
        model = self.lq.excited
        on_primary, on_pair = np.zeros(n + 2), np.zeros(n + 2)
        on_primary[plant.model.states.index(f"v_{plant.plant.primary.name}")] = (
            1.0 / plant.plant.primary.mass_kg
        )
        for name, by in zip(model.states, model.b, strict=True):
            if name in plant.model.states:
                on_pair[plant.model.states.index(name)] = by
        density = FORCE_NOISE * self.force_n
        for way in (on_primary, on_pair):
            moved = way / self.scale
            noise += np.outer(moved, moved) * 0.5 * density**2 / rate
        sensors = np.diag((caution * plant.noise_density) ** 2 * 0.5 * rate)
        try:
            ahead = steady_prior(self.F, self.C, noise, sensors)
        except np.linalg.LinAlgError as error:
            raise RunError(f"the observer has no steady state: {error}") from error
        return np.asarray(np.linalg.solve(self.C @ ahead @ self.C.T + sensors, self.C @ ahead).T)
