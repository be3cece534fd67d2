"""The simulated rig: true plant, sensors, filter chain, controller and its limits, one block at a time.

It stands where the real rig will: it knows the truth, obeys commands at block boundaries, and enforces its own
limits whatever it is told.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.control.chain import CHAIN_STATES
from twin.control.rig_block import rig_block
from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.config import VoiceCoil
from twin.plant.discrete import DiscreteModel, Hold, discretise
from twin.plant.linear import Array, LinearModel, linear_model, read_only
from twin.rig.excitation import Span
from twin.rig.programme import Programme, rig_channels

POWER_WINDOW_BLOCKS = 10


@dataclass(frozen=True, slots=True)
class Truth:
    """What really happened over N samples without a change of plant or controller. Arrays are read-only.

    Attributes
    ----------
    first_sample
        Of the N; row 0 of the arrays is the sample before it.
    frequency_hz
        Where damping given against frequency was read [Hz].
    model, holds
        The plant as it was, and how each input went on between samples.
    states, inputs
        (N + 1, n) and (N + 1, m), in the model's order and units.
    """

    first_sample: int
    frequency_hz: float
    model: LinearModel
    holds: tuple[Hold, ...]
    states: Array
    inputs: Array


class SimulatedRig:
    """A rig in software, advanced block by block.

    Damping that is given against frequency and the controller's gains follow a sweep: within a block the damping is
    that of its middle and the gains go linearly. Where nothing follows the frequency, and without ground noise, it
    does not matter for a single bit how the run is cut into blocks.

    Parameters
    ----------
    programme
        What to do and what is true.
    keep_truth
        Whether ``truth`` is filled, block by block.

    Attributes
    ----------
    truth
        True motion of the latest block: one `Truth`, or one for each step where the excitation's frequency jumps.
    """

    def __init__(self, programme: Programme, *, keep_truth: bool = False) -> None:
        self.programme = programme
        self.truth: list[Truth] = []
        self._keep_truth = keep_truth
        plant = programme.true_plant
        coil = plant.voice_coil
        if coil is None or coil.between is None:
            raise ValueError("the simulated rig needs a voice coil between two bodies")
        self._plant, self._coil = plant, coil
        self._inputs = tuple(a.name for a in plant.actuator)
        self._coil_input = self._inputs.index(coil.name)
        self._exciter_input = self._inputs.index(programme.exciter.name)
        # The converter holds the coil's reference; what amplifies the excitation smooths it.
        self._holds: tuple[Hold, ...] = tuple(
            "foh" if j == self._exciter_input else "zoh" for j in range(len(self._inputs))
        )
        self.channels = rig_channels(plant)
        self._pick = _relative_acceleration(programme, coil)
        self._ranges = np.array([s.range or math.inf for s in plant.sensor])
        fs = programme.sample_rate_hz
        self._noise_std = np.sqrt([s.noise_variance(fs) for s in plant.sensor])
        self._force_std = programme.disturbance_density_n * math.sqrt(fs / 2.0)
        self._rng = np.random.default_rng(programme.seed)

        self.schedule: GainSchedule = programme.schedule
        self.control_enabled = True
        self.tripped = ""
        self.next_sample = 0
        self._pending: list[Command] = []
        self._heating: deque[float] = deque(maxlen=POWER_WINDOW_BLOCKS)
        model = self._model(self.frequency_at(0))
        n = len(model.states)
        self._x, self._u_before = np.zeros(n), np.zeros(len(self._inputs))
        self._chain, self._delay_line = np.zeros(CHAIN_STATES), np.zeros(programme.loop_delay_samples)

    @property
    def finished(self) -> bool:
        """Whether the programme is over."""
        return self.next_sample >= self.programme.n_blocks * self.programme.block_samples

    @property
    def waiting(self) -> int:
        """Commands that have been taken in and wait for their sample."""
        return len(self._pending)

    def frequency_at(self, sample: int) -> float:
        """Excitation frequency at a sample [Hz]."""
        return self.programme.sweep.frequency_at(sample, self.programme.sample_rate_hz)

    def accept(self, command: Command) -> None:
        """Take a command in; it acts from the first block that begins at or after its sample."""
        self._pending.append(command)

    def next_block(self) -> tuple[NDArray[np.float32], bool, list[Acknowledgement]]:
        """Advance by one block.

        Returns
        -------
        values
            (block_samples, n_channels) float32, as a 24-bit converter would give them, in the order of
            ``channels``.
        control_on
            Whether the controller acted during the block; at its end, where the excitation jumps inside.
        acknowledgements
            Of the commands that took effect at the block's first sample.
        """
        programme = self.programme
        n, fs = programme.block_samples, programme.sample_rate_hz
        first = self.next_sample
        acknowledgements = self._apply_due(first)
        disturbance = self._rng.normal(0.0, self._force_std, n) if self._force_std > 0.0 else np.zeros(n)
        noise = self._rng.standard_normal((n, len(self._noise_std))) * self._noise_std
        drive = programme.sweep.samples(first, n, fs)
        y, reference = np.empty((n, len(self._noise_std))), np.empty(n)
        stroke, on = 0.0, False
        self.truth = []
        for span in programme.sweep.spans(first, n, fs):
            rows = slice(span.first - first, span.stop - first)
            on, reached = self._run(
                span, drive[rows], disturbance[rows], noise[rows], y[rows], reference[rows]
            )
            stroke = max(stroke, reached)
        self._guard(stroke, reference)
        self.next_sample = first + n
        return np.column_stack([y, reference]).astype(np.float32), on, acknowledgements

    def _run(
        self, span: Span, drive: Array, disturbance: Array, noise: Array, y: Array, reference: Array
    ) -> tuple[bool, float]:
        """Go through a span of the excitation; returns whether control acted, and the largest stroke [m]."""
        middle = 0.5 * (span.from_hz + span.to_hz)
        on = self.control_enabled and not self.tripped and self.schedule.acts_at(middle)
        model = self._model(middle)
        fs = self.programme.sample_rate_hz
        discrete = self._stepping(model, middle)
        x_before, u_before = self._x.copy(), self._u_before.copy()
        states = np.empty((len(drive) if self._keep_truth else 0, len(self._x)))
        stroke = rig_block(
            discrete.F, discrete.B0, discrete.B1, discrete.C, discrete.D, self._kick(model),
            self._x, self._u_before, self._chain, self._delay_line, drive, disturbance, noise, self._ranges,
            self._pick, self._packed(span.from_hz), self._packed(span.to_hz), on,
            self._plant.limits[f"{self._coil.name}_current_a"], 1.0 / fs, self._coil_input, self._exciter_input,
            y, reference, states,
        )  # fmt: skip
        if self._keep_truth:
            inputs = np.zeros((len(drive) + 1, len(self._inputs)))
            inputs[0] = u_before
            inputs[1:, self._coil_input], inputs[1:, self._exciter_input] = reference, drive
            self.truth.append(
                Truth(
                    first_sample=span.first,
                    frequency_hz=middle,
                    model=model,
                    holds=self._holds,
                    states=read_only(np.vstack([x_before, states])),
                    inputs=read_only(inputs),
                )
            )
        return on, stroke

    def _apply_due(self, first: int) -> list[Acknowledgement]:
        due = [c for c in self._pending if c.apply_at_sample <= first]
        self._pending = [c for c in self._pending if c.apply_at_sample > first]
        answers = []
        for command in due:
            fastest = (
                max(command.schedule.low_pass_hz + command.schedule.high_pass_hz) if command.schedule else 0.0
            )
            if fastest >= 0.5 * self.programme.sample_rate_hz:
                reason = f"cutoff {fastest:g} Hz is not below half of the sample rate"
                answers.append(Acknowledgement(command_id=command.command_id, accepted=False, reason=reason))
                continue
            # An order for sample 0 is one for the next block, whichever that is.
            late = first - command.apply_at_sample if command.apply_at_sample else 0
            if command.schedule is not None:
                self.schedule = command.schedule
            if command.control_enabled is not None:
                self.control_enabled = command.control_enabled
                self.tripped = "" if command.control_enabled else self.tripped
            reason = f"{late} samples late" if late > 0 else ""
            answers.append(
                Acknowledgement(
                    command_id=command.command_id, accepted=True, applied_at_sample=first, reason=reason
                )
            )
        return answers

    def _guard(self, stroke: float, reference: Array) -> None:
        """Switch control off when stroke or mean coil power pass the plant's limits; the clamp bounds current."""
        limits, name = self._plant.limits, self._coil.name
        self._heating.append(self._coil.resistance_ohm * float(np.mean(reference**2)))
        power = sum(self._heating) / len(self._heating)
        if not stroke <= limits["stroke_m"]:
            self.tripped = f"stroke {stroke * 1e3:.2f} mm passed the limit {limits['stroke_m'] * 1e3:.2f} mm"
        elif not power <= limits[f"{name}_power_w"]:
            self.tripped = f"{name} power {power:.1f} W passed the limit {limits[f'{name}_power_w']:.1f} W"

    def _packed(self, frequency_hz: float) -> Array:
        """Gains at a frequency in the kernel's units."""
        g = self.schedule.at(frequency_hz)
        dt, k = 1.0 / self.programme.sample_rate_hz, self._coil.force_constant_n_a
        return np.array([
            g.alpha_kg / k, g.beta_ns_m / k, g.gamma_n_m / k,
            math.tan(math.pi * g.low_pass_hz * dt), math.tan(math.pi * g.high_pass_hz * dt),
        ])  # fmt: skip

    def _model(self, frequency_hz: float) -> LinearModel:
        return linear_model(self._plant, frequency_hz=frequency_hz)

    def _stepping(self, model: LinearModel, frequency_hz: float) -> DiscreteModel:
        """The plant for stepping sample by sample; the frequency is where the model's damping was read [Hz]."""
        return discretise(model, self.programme.sample_rate_hz, self._holds)

    def _kick(self, model: LinearModel) -> Array:
        """State change per newton held over one sample on the primary body."""
        row = model.states.index(f"v_{self._plant.primary.name}")
        kick = np.zeros(len(model.states))
        dt = 1.0 / self.programme.sample_rate_hz
        kick[row] = dt / self._plant.primary.mass_kg
        # Second order in dt is enough: the force is white, its exact path within 20 µs is immaterial.
        kick[model.states.index(f"x_{self._plant.primary.name}")] = 0.5 * dt * kick[row]
        return kick


def _relative_acceleration(programme: Programme, coil: VoiceCoil) -> Array:
    """Weights that form primary minus absorber acceleration from the sensors."""
    plant = programme.plant
    first, second = coil.between or ("", "")
    pick = np.zeros(len(plant.sensor))
    wanted = {second: -1.0} if programme.measurement == "absolute" else {first: 1.0, second: -1.0}
    for body, weight in wanted.items():
        found = [i for i, s in enumerate(plant.sensor) if s.kind == "acceleration" and s.of == body]
        if not found:
            raise ValueError(
                f"the control law needs an accelerometer on body '{body}': give plant '{plant.name}' a [[sensor]] "
                f'with kind = "acceleration" and of = "{body}"'
            )
        pick[found[0]] = weight
    return pick
