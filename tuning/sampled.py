"""A plant between current reference, excitation and any measured channels, exact at the controller's samples."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tuning.loop import LoopFacts
from twin.plant.config import GROUND, Plant, Shaker, VoiceCoil
from twin.plant.discrete import discretise
from twin.plant.errors import InputError
from twin.plant.linear import Array, ComplexArray, LinearModel, linear_model, read_only

RELATIVE_ACCELERATION = "relative_acceleration"
"""Channel that the rig forms of its two accelerometers: the coil's first body against its second.

In a loop with absolute measurement the absorber's accelerometer alone stands for it.
"""
ACCELEROMETER_DENSITY = 1e-3
"""Noise of an accelerometer that the plant does not list [m/s² per sqrt(Hz)]; the rig's have it."""


@dataclass(frozen=True)
class SampledPlant:
    """``x+ = F x + late r(k - d) + early r(k - d - 1) + before w(k) + now w(k + 1)`` with the commanded current r.

    Attributes
    ----------
    model
        In continuous time, the coil's circuit and current loop included.
    F, late, early, before, now
        (n, n) and (n,) each; ``early`` is zero unless the delay has a fraction of a sample.
    motion
        (3, n) primary motion [m], stroke [m], coil current [A].
    channels, measured, measured_feed
        Names, (p, n) and (p,) of what is measured, from states and from the excitation.
    noise_density
        (p,) of each channel, in its unit per sqrt(Hz).
    coil_input, excitation_input
        Columns of the model.
    """

    plant: Plant
    facts: LoopFacts
    coil: VoiceCoil
    model: LinearModel
    F: Array
    late: Array
    early: Array
    before: Array
    now: Array
    motion: Array
    channels: tuple[str, ...]
    measured: Array
    measured_feed: Array
    noise_density: Array
    coil_input: int
    excitation_input: int

    @property
    def waiting(self) -> int:
        """How many commands are on their way to the converter: the delay, its fraction counted as a whole sample."""
        return self.facts.delay_samples + (1 if self.facts.delay_fraction else 0)

    def responses(self, frequency_hz: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Steady responses of motion and measurement to [commanded current, excitation], delay included.

        Returns
        -------
        tuple of ndarray
            (n_frequencies, 3, 2) of ``motion``, (n_frequencies, p, 2) of ``measured``.
        """
        f = np.atleast_1d(np.asarray(frequency_hz, dtype=np.float64))
        z = np.exp(2j * np.pi * f / self.facts.sample_rate_hz)[:, None]
        command = (self.late + self.early / z) * z ** (-self.facts.delay_samples)
        drive = np.stack([command, self.before + self.now * z], axis=-1)
        states = np.linalg.solve(z[:, :, None] * np.eye(len(self.F)) - self.F, drive)
        measured = self.measured @ states
        measured[:, :, 1] += self.measured_feed
        return np.asarray(self.motion @ states), np.asarray(measured)


def sampled_plant(
    plant: Plant,
    facts: LoopFacts,
    frequency_hz: float,
    damping_ns_m: float | None = None,
    channels: tuple[str, ...] | None = None,
) -> SampledPlant:
    """Sample a plant whose coil obeys a current reference.

    Parameters
    ----------
    frequency_hz
        Where damping against frequency is read [Hz].
    damping_ns_m
        Absorber damping in place of the plant's own [Ns/m].
    channels
        Sensors of the plant, or ``relative_acceleration``; None takes the plant's accelerometers, and without any
        the relative acceleration.

    Raises
    ------
    InputError
        If coil, current loop, excitation or a channel is missing, or a channel answers the command at once.
    """
    coil, absorber = plant.voice_coil, plant.absorber
    if coil is None or absorber is None or coil.between is None or coil.current_loop_kp_v_a is None:
        raise InputError(
            f"plant '{plant.name}' has no voice coil with current_loop_kp_v_a [V/A] between two bodies; "
            "a law that commands a current needs one"
        )
    exciters = [j for j, a in enumerate(plant.actuator) if a is not coil]
    if not exciters:
        raise InputError(f"plant '{plant.name}' has no actuator that excites it")
    damping = {} if damping_ns_m is None else {absorber.name: damping_ns_m}
    model = linear_model(plant, frequency_hz=frequency_hz, damping_ns_m=damping)
    drive, j = exciters[0], plant.actuator.index(coil)
    # Shakers are driven smoothly; a force follows its samples, as the simulated rig has it.
    smooth = isinstance(plant.actuator[drive], Shaker)
    holds = ["foh" if smooth and k == drive else "zoh" for k in range(len(plant.actuator))]
    rate = facts.sample_rate_hz
    whole = discretise(model, rate, holds)  # type: ignore[arg-type]
    late = whole.B0[:, j]
    if facts.delay_fraction:
        late = discretise(model, rate / (1.0 - facts.delay_fraction), holds).B0[:, j]  # type: ignore[arg-type]
    n = len(plant.body)
    order = {body.name: row for row, body in enumerate(plant.body)}
    size = len(model.A)
    motion = np.zeros((3, size))
    motion[0, 0] = 1.0
    relative, relative_feed = np.zeros(size), 0.0
    for name, sign in zip(coil.between, (1.0, -1.0), strict=True):
        if name == GROUND:
            continue
        row = order[name]
        motion[1, row] = sign
        if facts.relative or name == absorber.name:
            relative += sign * model.A[n + row]
            relative_feed += sign * float(model.B[n + row, drive])
    motion[2, model.states.index(f"i_{coil.name}")] = 1.0
    sensors = {s.name: s for s in plant.sensor}
    accelerometers = tuple(s.name for s in plant.sensor if s.kind == "acceleration")
    names = channels or accelerometers or (RELATIVE_ACCELERATION,)
    rows, feed, density = [], [], []
    for name in names:
        if name == RELATIVE_ACCELERATION:
            rows.append(relative)
            feed.append(relative_feed)
            density.append(relative_noise_density(plant, facts.relative))
        elif name in model.outputs:
            place = model.outputs.index(name)
            if model.D[place, j] != 0.0:
                raise InputError(f"sensor '{name}' answers the command at once; a law cannot use it")
            rows.append(model.C[place])
            feed.append(float(model.D[place, drive]))
            density.append(sensors[name].noise_density)
        else:
            raise InputError(
                f"'{name}' is no sensor of plant '{plant.name}'; known: "
                f"{', '.join((RELATIVE_ACCELERATION, *model.outputs))}"
            )
    return SampledPlant(
        plant=plant,
        facts=facts,
        coil=coil,
        model=model,
        F=whole.F,
        late=read_only(late),
        early=read_only(whole.B0[:, j] - late),
        before=read_only(whole.B0[:, drive]),
        now=read_only(whole.B1[:, drive]),
        motion=read_only(motion),
        channels=tuple(names),
        measured=read_only(rows),
        measured_feed=read_only(feed),
        noise_density=read_only(density),
        coil_input=j,
        excitation_input=drive,
    )


def relative_noise_density(plant: Plant, relative: bool = True) -> float:
    """One-sided noise density of the relative acceleration formed of two accelerometers [m/s² per sqrt(Hz)].

    Of the sensors on the coil's bodies; where the plant lists none there, that of the rig's accelerometers.

    Parameters
    ----------
    relative
        False if the absorber's accelerometer alone stands for it.
    """
    coil, absorber = plant.voice_coil, plant.absorber
    total = 0.0
    for name in () if coil is None or coil.between is None else coil.between:
        if name != GROUND and (relative or (absorber is not None and name == absorber.name)):
            listed = [s.noise_density for s in plant.sensor if s.kind == "acceleration" and s.of == name]
            total += (listed[0] if listed else ACCELEROMETER_DENSITY) ** 2
    return math.sqrt(total)
