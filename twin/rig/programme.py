"""What a simulated rig is told to do: excitation, controller at start, and the truth the twin does not know."""

from typing import Literal, Self

from pydantic import Field, model_validator

from twin.control.schedule import GainSchedule
from twin.plant.blocks import Channel
from twin.plant.config import GROUND, Actuator, DampingTable, Frozen, NonNegative, Plant, Positive, Sensor
from twin.rig.excitation import Excitation, Steps, Sweep, Tone, exciter

__all__ = ["Programme", "Steps", "Sweep", "Tone", "rig_channels", "with_accelerometers"]


class Programme(Frozen):
    """One run of the simulated rig.

    Attributes
    ----------
    plant
        The true plant but for its absorber's damping, which is ``true_damping``.
    sweep
        What excites: a `Sweep`, `Steps` or a `Tone`.
    seed
        Seeds sensor noise and ground motion, and nothing else.
    measurement
        ``relative``: both accelerometers; ``absolute``: the absorber's alone stands for the difference.
    loop_delay_samples
        Samples between measuring and the converter's update; the hold adds half a sample on average.
    disturbance_density_n
        White force on the primary body, N per sqrt(Hz), one-sided.
    """

    plant: Plant
    true_damping: DampingTable
    sweep: Excitation
    schedule: GainSchedule
    measurement: Literal["relative", "absolute"] = "relative"
    sample_rate_hz: Positive = 50_000.0
    block_samples: int = Field(default=5_000, ge=10)
    loop_delay_samples: int = Field(default=1, ge=1, le=100)
    disturbance_density_n: NonNegative = 0.01
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _limits_fail_closed(self) -> Self:
        coil = self.plant.voice_coil
        if coil is None or coil.current_loop_kp_v_a is None or coil.between is None:
            raise ValueError("a rig needs a voice coil between two bodies, with a current loop")
        for key in (f"{coil.name}_current_a", f"{coil.name}_power_w", "stroke_m"):
            if key not in self.plant.limits:
                unit = self.plant.limit_units[key]
                raise ValueError(
                    f"limits.{key} [{unit}] is missing: without it the coil may not be driven; add it"
                )
        exciter(self.plant, self.sweep)
        fastest = max(self.schedule.low_pass_hz + self.schedule.high_pass_hz)
        if fastest >= 0.5 * self.sample_rate_hz:
            raise ValueError(
                f"schedule: cutoff {fastest:g} Hz is not below half of the sample rate ({self.sample_rate_hz:g} Hz)"
            )
        return self

    @property
    def true_plant(self) -> Plant:
        """The plant as it really is."""
        absorber = self.plant.absorber
        if absorber is None:
            raise ValueError("the plant has no absorber")
        return self.plant.with_damping(absorber.name, self.true_damping)

    @property
    def exciter(self) -> Actuator:
        """Actuator that the excitation drives."""
        return exciter(self.plant, self.sweep)

    @property
    def n_blocks(self) -> int:
        """Whole blocks in the run."""
        # 0.29 s times 50 kS/s is a rounding short of 14,500: a millionth of a sample is not missed.
        return int(self.sweep.duration_s * self.sample_rate_hz + 1e-6) // self.block_samples

    @property
    def block_s(self) -> float:
        """Duration of a block [s]."""
        return self.block_samples / self.sample_rate_hz


def rig_channels(plant: Plant) -> tuple[Channel, ...]:
    """What a rig sends: its sensors, then the coil's current reference as the converter holds it."""
    coil = plant.voice_coil
    command = () if coil is None else (Channel(coil.name, coil.input_unit),)
    return (*(Channel(s.name, s.unit) for s in plant.sensor), *command)


def with_accelerometers(plant: Plant, noise_density: float) -> Plant:
    """Return the plant with an accelerometer on either end of its coil, where there is none yet.

    What the control law measures is always a sensor of the plant: it has a stated noise, it is recorded, and the
    twin sees what the controller saw.

    Parameters
    ----------
    noise_density
        One-sided, of the sensors that are added [m/s² per sqrt(Hz)].

    Raises
    ------
    ValueError
        If the plant has no voice coil.
    """
    coil = plant.voice_coil
    if coil is None:
        raise ValueError(f"plant '{plant.name}' has no voice coil")
    have = {s.of for s in plant.sensor if s.kind == "acceleration"}
    added = tuple(
        Sensor(name=f"{place}_acceleration", kind="acceleration", of=place, noise_density=noise_density)
        for place, _ in coil.pushes
        if place != GROUND and place not in have
    )
    return plant.model_copy(update={"sensor": (*plant.sensor, *added)})
