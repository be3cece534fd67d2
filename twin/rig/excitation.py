"""What shakes a rig: sines of constant amplitude whose frequency moves, jumps or stays, as data.

Amplitudes are in the exciting actuator's own unit, which their key names: ``amplitude_v`` for a shaker behind a
voltage amplifier, ``amplitude_a`` for a current, ``amplitude_n`` for a force. Every value follows from the number of
its sample alone, so that it does not matter how a run is cut into blocks.
"""

import math
from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import (
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    model_serializer,
    model_validator,
)

from twin.plant.config import Actuator, Frozen, Name, Plant, Positive, Shaker
from twin.plant.linear import Array

DAY_S = 86_400.0
"""What lasts longer than this is meant to go on for ever."""

AMPLITUDES = {"amplitude_v": "V", "amplitude_n": "N", "amplitude_a": "A"}


class Span(NamedTuple):
    """Samples ``[first, stop)`` without a jump inside, and the excitation's frequency at both ends [Hz]."""

    first: int
    stop: int
    from_hz: float
    to_hz: float


class _Sine(Frozen):
    """What all excitations share: one amplitude, in one unit, on one actuator.

    ``actuator`` names who excites; None leaves it to the plant's first shaker, or its first actuator that is not
    the absorber's coil.
    """

    amplitude_v: Positive | None = None
    amplitude_n: Positive | None = None
    amplitude_a: Positive | None = None
    actuator: Name | None = None

    @model_validator(mode="after")
    def _one_amplitude(self) -> Self:
        given = [key for key in AMPLITUDES if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of {', '.join(AMPLITUDES)}, got {', '.join(given) or 'none'}")
        return self

    @model_serializer(mode="wrap")
    def _what_is_given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        whole = handler(self)
        own = {key: value for key, value in whole.items() if key not in _Sine.model_fields}
        return own | {key: value for key, value in whole.items() if key not in own and value is not None}

    @property
    def amplitude(self) -> float:
        """Peak, in ``unit``."""
        values = (self.amplitude_v, self.amplitude_n, self.amplitude_a)
        return next(value for value in values if value is not None)

    @property
    def unit(self) -> Literal["V", "N", "A"]:
        """Unit of the amplitude."""
        return "V" if self.amplitude_v is not None else "N" if self.amplitude_n is not None else "A"


class Sweep(_Sine):
    """Frequency that moves linearly from one end to the other."""

    from_hz: Positive
    to_hz: Positive
    duration_s: Positive

    def frequency_at(self, sample: int, sample_rate_hz: float) -> float:
        """Frequency at a sample [Hz]; held beyond the end."""
        t = sample / sample_rate_hz
        return self.from_hz + (self.to_hz - self.from_hz) * min(t / self.duration_s, 1.0)

    def samples(self, first: int, n: int, sample_rate_hz: float) -> Array:
        """Values at ``n`` samples from ``first`` on, (n,), in ``unit``."""
        t = (first + np.arange(n)) / sample_rate_hz
        rate = (self.to_hz - self.from_hz) / self.duration_s
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * (self.from_hz + 0.5 * rate * t) * t))

    def spans(self, first: int, n: int, sample_rate_hz: float) -> list[Span]:
        """The samples ``[first, first + n)`` as one span: nothing jumps."""
        ends = (self.frequency_at(sample, sample_rate_hz) for sample in (first, first + n))
        return [Span(first, first + n, *ends)]

    @property
    def description(self) -> str:
        """What it does, in words."""
        return f"{self.from_hz:g} to {self.to_hz:g} Hz in {self.duration_s:g} s"


class Tone(_Sine):
    """One frequency throughout."""

    frequency_hz: Positive
    duration_s: Positive

    def frequency_at(self, sample: int, sample_rate_hz: float) -> float:
        """Frequency [Hz], the same at every sample."""
        return self.frequency_hz

    def samples(self, first: int, n: int, sample_rate_hz: float) -> Array:
        """Values at ``n`` samples from ``first`` on, (n,), in ``unit``."""
        t = (first + np.arange(n)) / sample_rate_hz
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * self.frequency_hz * t))

    def spans(self, first: int, n: int, sample_rate_hz: float) -> list[Span]:
        """The samples ``[first, first + n)`` as one span."""
        return [Span(first, first + n, self.frequency_hz, self.frequency_hz)]

    @property
    def description(self) -> str:
        """What it does, in words."""
        return f"{self.frequency_hz:g} Hz" + (
            f" for {self.duration_s:g} s" if self.duration_s <= DAY_S else ""
        )


class Shuttle(_Sine):
    """Frequency that moves linearly from one end to the other and back again, over and over.

    Attributes
    ----------
    leg_s
        Time from one end to the other [s].
    """

    from_hz: Positive
    to_hz: Positive
    leg_s: Positive
    duration_s: Positive

    def frequency_at(self, sample: int, sample_rate_hz: float) -> float:
        """Frequency at a sample [Hz]."""
        leg, t = divmod(sample / sample_rate_hz, self.leg_s)
        begin, end = (self.from_hz, self.to_hz) if int(leg) % 2 == 0 else (self.to_hz, self.from_hz)
        return begin + (end - begin) * t / self.leg_s

    def samples(self, first: int, n: int, sample_rate_hz: float) -> Array:
        """Values at ``n`` samples from ``first`` on, (n,), in ``unit``."""
        leg, t = np.divmod((first + np.arange(n)) / sample_rate_hz, self.leg_s)
        there = np.mod(leg, 2.0) == 0.0
        begin = np.where(there, self.from_hz, self.to_hz)
        rate = np.where(there, 1.0, -1.0) * (self.to_hz - self.from_hz) / self.leg_s
        # Every leg adds the same number of turns; its whole ones are dropped before they cost digits.
        turns = np.mod(leg * np.mod(0.5 * (self.from_hz + self.to_hz) * self.leg_s, 1.0), 1.0)
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * (turns + (begin + 0.5 * rate * t) * t)))

    def spans(self, first: int, n: int, sample_rate_hz: float) -> list[Span]:
        """The samples ``[first, first + n)``, cut where the frequency turns round."""
        legs = range(
            *(math.ceil(sample / sample_rate_hz / self.leg_s) + 1 for sample in (first - 1, first + n))
        )
        turns = (math.ceil(k * self.leg_s * sample_rate_hz - 1e-6) for k in legs)
        cuts = [first, *dict.fromkeys(turn for turn in turns if first < turn < first + n), first + n]
        return [
            Span(a, b, *(self.frequency_at(sample, sample_rate_hz) for sample in (a, b)))
            for a, b in pairwise(cuts)
        ]

    @property
    def description(self) -> str:
        """What it does, in words."""
        there_and_back = f"{self.from_hz:g} to {self.to_hz:g} Hz and back, {self.leg_s:g} s each way"
        return there_and_back if self.duration_s > DAY_S else f"{there_and_back}, for {self.duration_s:g} s"


class Step(Frozen):
    """One frequency [Hz] for a while [s]."""

    frequency_hz: Positive
    duration_s: Positive


class Steps(_Sine):
    """Frequencies one after the other, as a grid whose frequency jumps; the phase goes on without a break."""

    steps: tuple[Step, ...] = Field(min_length=1)

    @property
    def duration_s(self) -> float:
        """Of all steps together [s]."""
        return math.fsum(step.duration_s for step in self.steps)

    def starts(self, sample_rate_hz: float) -> tuple[int, ...]:
        """First sample of each step; a step that begins between two samples has the later one."""
        begins = accumulate((step.duration_s for step in self.steps[:-1]), initial=0.0)
        # A sum of decimal fractions misses its sample by rounding: a millionth of a sample is no later.
        return tuple(math.ceil(begin * sample_rate_hz - 1e-6) for begin in begins)

    def frequency_at(self, sample: int, sample_rate_hz: float) -> float:
        """Frequency from a sample on [Hz]; the last one is held beyond the end."""
        at = int(np.searchsorted(self.starts(sample_rate_hz), sample, side="right")) - 1
        return self.steps[at].frequency_hz

    def samples(self, first: int, n: int, sample_rate_hz: float) -> Array:
        """Values at ``n`` samples from ``first`` on, (n,), in ``unit``."""
        numbers = first + np.arange(n)
        at = np.searchsorted(self.starts(sample_rate_hz), numbers, side="right") - 1
        begin_s = np.array([0.0, *accumulate(step.duration_s for step in self.steps)])[at]
        turns = [0.0, *accumulate(step.frequency_hz * step.duration_s for step in self.steps)]
        hz = np.array([step.frequency_hz for step in self.steps])[at]
        phase = np.mod(turns, 1.0)[at] + hz * (numbers / sample_rate_hz - begin_s)
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi * phase))

    def spans(self, first: int, n: int, sample_rate_hz: float) -> list[Span]:
        """The samples ``[first, first + n)``, cut where the frequency jumps."""
        inside = [start for start in self.starts(sample_rate_hz) if first < start < first + n]
        cuts = [first, *dict.fromkeys(inside), first + n]
        return [
            Span(a, b, hz, hz) for a, b in pairwise(cuts) for hz in [self.frequency_at(a, sample_rate_hz)]
        ]

    @property
    def description(self) -> str:
        """What it does, in words."""
        return ", ".join(f"{step.frequency_hz:g} Hz for {step.duration_s:g} s" for step in self.steps)


_FORMS = {"steps": "steps", "frequency_hz": "tone", "leg_s": "shuttle"}


def _form(value: Any) -> str:
    keys = set(value) if isinstance(value, dict) else set(type(value).model_fields)
    return next((form for key, form in _FORMS.items() if key in keys), "sweep")


# Told apart by form, so that a mistake is explained for the form that was meant.
Excitation = Annotated[
    Annotated[Sweep, Tag("sweep")]
    | Annotated[Steps, Tag("steps")]
    | Annotated[Tone, Tag("tone")]
    | Annotated[Shuttle, Tag("shuttle")],
    Discriminator(_form),
]


def exciter(plant: Plant, excitation: Sweep | Steps | Tone | Shuttle) -> Actuator:
    """Actuator that an excitation drives.

    Raises
    ------
    ValueError
        If there is none, it is the absorber's own coil, or its unit is not the amplitude's.
    """
    coil = plant.voice_coil
    others = [a for a in plant.actuator if a is not coil]
    if excitation.actuator is not None:
        found = [a for a in others if a.name == excitation.actuator]
        if not found:
            raise ValueError(
                f"actuator '{excitation.actuator}' cannot excite plant '{plant.name}'; "
                f"those that can: {', '.join(a.name for a in others) or 'none'}"
            )
    else:
        found = [a for a in others if isinstance(a, Shaker)] or others
        if not found:
            raise ValueError(f"plant '{plant.name}' has no actuator besides its coil that could excite it")
    if found[0].input_unit != excitation.unit:
        raise ValueError(
            f"actuator '{found[0].name}' is driven in {found[0].input_unit}, the excitation's amplitude is in "
            f"{excitation.unit}: give amplitude_{found[0].input_unit.lower()}"
        )
    return found[0]
