"""Gains that a person gives for a what-if: for the whole table, or by operating point."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from pydantic import ValidationError

from tuning.changes import Changes
from twin.control.schedule import Gains, GainSchedule
from twin.plant.errors import InputError

UNITS = {"alpha_kg": "kg", "beta_ns_m": "Ns/m", "gamma_n_m": "N/m"}
"""Keys of ``--set`` and their units."""

HELP = "alpha_kg, beta_ns_m, gamma_n_m (gains of your own; KEY=VALUE@HZ for one operating point)"


@dataclass(frozen=True, slots=True)
class GivenGains:
    """Gains of a person's own.

    Attributes
    ----------
    points
        (key, frequency [Hz] or None for all of the table, value in the key's unit), in the order given.
    """

    points: tuple[tuple[str, float | None, float], ...]

    def schedule(self, in_use: GainSchedule, changes: Changes) -> GainSchedule:
        """The schedule in use with these gains, behind the changed filters, acting where the changes say.

        An operating point that is not in the table becomes one of its points; gains are straight lines between.

        Raises
        ------
        InputError
            If control would act beyond the table.
        """
        own = {hz for _, hz, _ in self.points if hz is not None}
        frequencies = sorted({*in_use.frequency_hz, *own})
        rows = {hz: changes.filters(in_use.at(hz)) for hz in frequencies}
        for everywhere in (True, False):  # what is said of a point stands above what is said of all
            for key, hz, value in self.points:
                if everywhere == (hz is None):
                    rows |= {f: _with(rows[f], key, value) for f in (frequencies if hz is None else [hz])}
        columns = ("alpha_kg", "beta_ns_m", "gamma_n_m", "low_pass_hz", "high_pass_hz")
        low = in_use.on_from_hz if changes.on_from_hz is None else changes.on_from_hz
        high = in_use.on_to_hz if changes.on_to_hz is None else changes.on_to_hz
        try:
            return GainSchedule(
                frequency_hz=tuple(frequencies),
                **{name: tuple(getattr(rows[f], name) for f in frequencies) for name in columns},
                on_from_hz=low,
                on_to_hz=high,
            )
        except ValidationError as error:
            raise InputError(f"--set: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from None


def split_given(settings: Sequence[str]) -> tuple[GivenGains | None, tuple[str, ...]]:
    """Gains among ``KEY=VALUE`` or ``KEY=VALUE@HZ``, and the settings that are none.

    Raises
    ------
    InputError
        If a value or a frequency is no finite number, or something is given twice.
    """
    points: list[tuple[str, float | None, float]] = []
    others = []
    for setting in settings:
        key, _, text = (part.strip() for part in setting.partition("="))
        if key not in UNITS:
            others.append(setting)
            continue
        value, at, place = text.partition("@")
        hz = _number(setting, place, "Hz") if at else None
        if hz is not None and not hz > 0.0:
            raise InputError(f"--set {setting}: an operating point lies above 0 Hz")
        if any((k, f) == (key, hz) for k, f, _ in points):
            raise InputError(f"--set {setting}: '{key}' is given twice")
        points.append((key, hz, _number(setting, value, UNITS[key])))
    return GivenGains(tuple(points)) if points else None, tuple(others)


def _number(setting: str, text: str, unit: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(
            f"--set {setting}: '{text}' is no number in {unit}; write such as gamma_n_m=-3000, or gamma_n_m=-3000@48"
        )
    return value


def _with(gains: Gains, key: str, value: float) -> Gains:
    match key:
        case "alpha_kg":
            return replace(gains, alpha_kg=value)
        case "beta_ns_m":
            return replace(gains, beta_ns_m=value)
        case _:
            return replace(gains, gamma_n_m=value)
