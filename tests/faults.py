"""What goes wrong with sensors, as functions of a block's values: injected behind the rig, before the twin."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twin.plant.config import Plant, VoiceCoil
from twin.plant.linear import Array

RATE_HZ = 50_000.0

Injection = Callable[[Array, float, int, np.random.Generator], None]
"""Changes one channel's samples (n,) in place, given the time since the onset [s] and the blocks since then."""


def dead(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
    signal[:] = 0.0


def stuck(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
    signal[:] = 0.7 * 1.2345


def unplugged(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
    """Nothing left but the converter's own noise, so that no sample repeats."""
    signal[:] = 1e-3 * rng.standard_normal(len(signal))


def spikes(height: float, share: float = 0.005) -> Injection:
    def inject(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
        hit = rng.random(len(signal)) < share
        signal[hit] += height * rng.choice([-1.0, 1.0], hit.sum())

    return inject


def clipped(limit: float) -> Injection:
    """End of a range that no plant file tells."""

    def inject(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
        np.clip(signal, -limit, limit, out=signal)

    return inject


def drift(rate_1_s: float) -> Injection:
    def inject(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
        signal += rate_1_s * (since_s + np.arange(len(signal)) / RATE_HZ)

    return inject


def gain(factor: float) -> Injection:
    def inject(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
        signal *= factor

    return inject


def lost(every: int) -> Injection:
    """One block of so many never arrives."""

    def inject(signal: Array, since_s: float, k: int, rng: np.random.Generator) -> None:
        if k % every == 0:
            signal[:] = np.nan

    return inject


@dataclass(frozen=True, slots=True)
class WrongModel:
    """A rig that is not, or no longer, what its plant file says: one parameter off by a factor."""

    part: str
    key: str
    factor: float

    def __call__(self, plant: Plant) -> Plant:
        if self.part in {b.name for b in plant.body}:
            bodies = (
                b.model_copy(update={self.key: getattr(b, self.key) * self.factor})
                if b.name == self.part
                else b
                for b in plant.body
            )
            return plant.model_copy(update={"body": tuple(bodies)})
        actuators = (
            a.model_copy(update={self.key: getattr(a, self.key) * self.factor})
            if isinstance(a, VoiceCoil) and a.name == self.part
            else a
            for a in plant.actuator
        )
        return plant.model_copy(update={"actuator": tuple(actuators)})
