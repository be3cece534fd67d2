"""The things a what-if may change, by name, with their units and what they do to plant, goal and schedule."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, get_args

from tuning.retune import TuningGoal
from tuning.types import BudgetKind
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import Plant, VoiceCoil
from twin.plant.errors import InputError

KINDS = get_args(BudgetKind)

KEYS: dict[str, tuple[str, str]] = {
    "budget_w": ("W", "coil power that may be spent"),
    "budget_kind": ("", f"which power that is: {', '.join(KINDS)}"),
    "power_price_um_w": ("µm/W", "spend a watt only where it buys at least so much less motion"),
    "displacement_m": ("m", "motion that is enough: reached with the least power"),
    "modulus_margin": ("", "least distance of the loop gain from -1"),
    "low_pass_hz": ("Hz", "cutoff of the low-pass behind the accelerometers"),
    "high_pass_hz": ("Hz", "cutoff of both high-passes"),
    "excitation": ("V, N or A", "peak of the excitation"),
    "damping_ns_m": ("Ns/m", "damping of the absorber at every frequency, in place of what is known"),
    "damping_scale": ("", "factor on the absorber's damping"),
    "absorber_mass_kg": ("kg", "moving mass of the absorber"),
    "absorber_stiffness_n_m": ("N/m", "of the absorber's spring"),
    "resistance_ohm": ("ohm", "of the coil"),
    "inductance_h": ("H", "of the coil"),
    "force_constant_n_a": ("N/A", "of the coil"),
    "on_from_hz": ("Hz", "control acts from here"),
    "on_to_hz": ("Hz", "control acts up to here"),
}
"""Every key with its unit and meaning; a coil's preset, read from a file, is added by the command."""


@dataclass(frozen=True, slots=True)
class Changes:
    """What is different; None leaves a thing as it is. Units as in `KEYS`."""

    budget_w: float | None = None
    budget_kind: BudgetKind | None = None
    power_price_um_w: float | None = None
    displacement_m: float | None = None
    modulus_margin: float | None = None
    low_pass_hz: float | None = None
    high_pass_hz: float | None = None
    excitation: float | None = None
    damping_ns_m: float | None = None
    damping_scale: float | None = None
    absorber_mass_kg: float | None = None
    absorber_stiffness_n_m: float | None = None
    resistance_ohm: float | None = None
    inductance_h: float | None = None
    force_constant_n_a: float | None = None
    on_from_hz: float | None = None
    on_to_hz: float | None = None
    coil: VoiceCoil | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None or field.name == "coil":
                continue
            unit = KEYS[field.name][0]
            if field.name == "budget_kind":
                if value not in KINDS:
                    raise InputError(f"budget_kind must be one of {', '.join(KINDS)}; got '{value}'")
                continue
            lowest = 0.0 if field.name in ("damping_ns_m", "damping_scale") else math.ulp(0.0)
            if not (math.isfinite(value) and value >= lowest):
                what = "at least 0" if lowest == 0.0 else "greater than 0"
                raise InputError(f"{field.name} must be {what}{f' {unit}' if unit else ''}; got {value:g}")
        if self.modulus_margin is not None and not self.modulus_margin < 1.0:
            raise InputError(
                f"modulus_margin must be below 1, which only an open loop reaches; got {self.modulus_margin:g}"
            )
        if self.damping_ns_m is not None and self.damping_scale is not None:
            raise InputError("give either damping_ns_m or damping_scale")

    @property
    def amplitude(self) -> float | None:
        """Peak of the excitation, if it is another."""
        return self.excitation

    def goal(self, goal: TuningGoal) -> TuningGoal:
        """The goal with these changes."""
        found: dict[str, Any] = {
            name: getattr(self, name)
            for name in ("budget_w", "budget_kind", "displacement_m", "modulus_margin")
            if getattr(self, name) is not None
        }
        return replace(goal, **found)

    def plant(self, plant: Plant) -> Plant:
        """The plant with these changes.

        Raises
        ------
        InputError
            If it has no such part.
        """
        absorber, coil = plant.absorber, plant.voice_coil
        if absorber is None or coil is None:
            raise InputError(f"plant '{plant.name}' has no voice coil on an absorber")
        if self.damping_ns_m is not None:
            plant = plant.with_damping(absorber.name, self.damping_ns_m)
        elif self.damping_scale is not None:
            plant = plant.with_damping(absorber.name, _scaled(absorber.damping_ns_m, self.damping_scale))
        parts = {"mass_kg": self.absorber_mass_kg, "stiffness_n_m": self.absorber_stiffness_n_m}
        parts = {name: value for name, value in parts.items() if value is not None}
        if parts:
            bodies = tuple(b.model_copy(update=parts) if b.name == absorber.name else b for b in plant.body)
            plant = plant.model_copy(update={"body": bodies})
        names = ("resistance_ohm", "inductance_h", "force_constant_n_a")
        new = coil
        if self.coil is not None:
            kp = self.coil.current_loop_kp_v_a or coil.current_loop_kp_v_a
            new = coil.model_copy(
                update={n: getattr(self.coil, n) for n in names} | {"current_loop_kp_v_a": kp}
            )
        found = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
        new = new.model_copy(update=found)
        if new == coil:
            return plant
        actuators = tuple(new if a is coil else a for a in plant.actuator)
        return plant.model_copy(update={"actuator": actuators})

    def filters(self, gains: Gains) -> Gains:
        """Return the gains behind the changed filters."""
        return replace(
            gains,
            low_pass_hz=self.low_pass_hz or gains.low_pass_hz,
            high_pass_hz=self.high_pass_hz or gains.high_pass_hz,
        )

    def acts(self, schedule: GainSchedule, frequency_hz: float) -> bool:
        """Whether control would act at a frequency."""
        low = schedule.on_from_hz if self.on_from_hz is None else self.on_from_hz
        high = schedule.on_to_hz if self.on_to_hz is None else self.on_to_hz
        return low <= frequency_hz <= high

    def table(self, schedule: GainSchedule, frequencies_hz: Sequence[float]) -> GainSchedule:
        """Schedule with points at the given frequencies [Hz], behind the changed filters, acting over all of them."""
        points = [self.filters(schedule.at(f)) for f in frequencies_hz]
        return GainSchedule(
            frequency_hz=tuple(frequencies_hz),
            alpha_kg=tuple(g.alpha_kg for g in points),
            beta_ns_m=tuple(g.beta_ns_m for g in points),
            gamma_n_m=tuple(g.gamma_n_m for g in points),
            low_pass_hz=tuple(g.low_pass_hz for g in points),
            high_pass_hz=tuple(g.high_pass_hz for g in points),
            on_from_hz=frequencies_hz[0],
            on_to_hz=frequencies_hz[-1],
        )


def parse_changes(settings: Sequence[str], coil: Callable[[str], VoiceCoil] | None = None) -> Changes:
    """Read ``key=value`` pairs.

    Parameters
    ----------
    settings
        Such as ``budget_w=50``.
    coil
        Reads the coil of a plant by its preset's or file's name, for ``coil=NAME``; without it there is no such key.

    Raises
    ------
    InputError
        If a key is not known, given twice, or its value cannot be used; the message lists the keys with their units.
    """
    found: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = (part.strip() for part in setting.partition("="))
        if not equals:
            raise InputError(
                f"--set {setting}: write KEY=VALUE, such as budget_w=2; {known_keys(coil is not None)}"
            )
        if key in found:
            raise InputError(f"--set {setting}: '{key}' is given twice")
        if key == "coil" and coil is not None:
            found[key] = coil(text)
        elif key == "budget_kind":
            found[key] = text
        elif key in KEYS:
            try:
                found[key] = float(text)
            except ValueError:
                unit = KEYS[key][0]
                raise InputError(
                    f"--set {setting}: '{text}' is no number{f' in {unit}' if unit else ''}"
                ) from None
        else:
            raise InputError(f"--set {setting}: there is no '{key}'; {known_keys(coil is not None)}")
    return Changes(**found)


def known_keys(with_coil: bool = True) -> str:
    """All keys with their units, in a sentence."""
    keys = [f"{key} [{unit}]" if unit else key for key, (unit, _) in KEYS.items()]
    return "known: " + ", ".join([*keys, *(["coil (a preset or a plant file)"] if with_coil else [])])


def _scaled(damping: Any, factor: float) -> Any:
    if isinstance(damping, float):
        return factor * damping
    return damping.model_copy(update={"ns_m": tuple(factor * c for c in damping.ns_m)})
