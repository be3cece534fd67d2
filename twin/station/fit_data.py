"""What a fit reads: arrays of a test, whoever made the file, and which of them is force, time or frequency."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.plant.linear import Array
from twin.rig.archives.detect import open_archive
from twin.rig.arrayref import ArrayRef, parse_array_ref
from twin.rig.sidecar import Sidecar, find_sidecar
from twin.rig.timebase import Stamps, time_base
from twin.rig.units import is_common, to_si

TIMES = ("t", "time", "zeit", "timestamp", "seconds", "temps")
WORDS = {
    "force": ("force", "load", "kraft", "f"),
    "displacement": ("displacement", "deflection", "position", "stroke", "disp", "weg", "x", "d", "pos"),
    "velocity": ("velocity", "speed", "vel", "v"),
    "acceleration": ("acceleration", "accel", "acc", "a"),
    "input": ("input", "command", "reference", "drive", "excitation", "u", "in", "step"),
    "output": ("output", "response", "y", "out"),
    "frequency": ("frequency", "freq", "resonance", "f", "hz", "fn"),
    "angular frequency": ("omega", "w"),
    "added mass": ("added", "mass", "madd", "m"),
    "standard deviation": ("std", "sigma", "uncertainty"),
    "response": ("frf", "h", "transmissibility", "accelerance", "receptance", "mobility", "tr", "response"),
}
DIMENSIONS = {
    "force": ("N",), "displacement": ("m",), "velocity": ("m/s",), "acceleration": ("m/s²",),
    "frequency": ("Hz",), "added mass": ("kg",), "angular frequency": ("rad/s",),
}  # fmt: skip
_SETPOINTS = ("reference", "setpoint", "command", "target", "desired", "ref")
_IN_NAMES = ("hz", "khz", "db", "deg")
"""Spellings of units in names, beside the common ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """One series of samples.

    Attributes
    ----------
    name
        As a person would write it: ``y``, ``e1_1[:,2]``, ``data[0,1,:]``.
    channel
        What it has in common with the same quantity of another record: the array, or the column in it.
    record
        What it has in common with other quantities of the same record.
    values
        (n_samples,) as recorded, real or complex.
    unit, text
        As stated; empty where nothing is said.
    """

    name: str
    channel: str
    record: str
    values: NDArray[Any]
    unit: str = ""
    text: str = ""

    @property
    def words(self) -> tuple[str, ...]:
        """Words of the name and of what is said about it, in lower case."""
        return tuple(w for w in re.split(r"[^a-zA-Z]+", f"{self.channel} {self.text}".lower()) if w)

    @property
    def si(self) -> tuple[str, float] | None:
        """SI unit and the factor to it, or None where the unit is not known."""
        return to_si(self.unit)

    def real(self) -> Array:
        """(n_samples,) real values; InputError naming the series and row where one is missing."""
        if np.iscomplexobj(self.values):
            raise InputError(f"{self.name}: holds complex values where a signal in time is needed")
        values = np.asarray(self.values, dtype=np.float64)
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            raise InputError(
                f"{self.name}: {len(bad)} values are missing or not finite, the first in row {bad[0]}; cut the record "
                "there or fill the gap"
            )
        return values


@dataclass(slots=True, eq=False)
class TestFile:
    """A file of measured data with what lies beside it.

    Attributes
    ----------
    path
        The file.
    series
        Everything in it that is a series.
    beside, facts
        The sidecar, and all that a JSON beside the file says.
    chosen
        Role to series as the person said.
    notes
        What was found, for people.
    guesses
        What nothing in the file or beside it says, for people to confirm.
    """

    __test__ = False
    path: Path
    series: list[Series]
    times: dict[str, NDArray[Any]]
    own_hz: float | None
    beside: Sidecar
    facts: Mapping[str, Any]
    chosen: dict[str, ArrayRef]
    rate_option_hz: float | None
    notes: list[str] = field(default_factory=list)
    guesses: list[str] = field(default_factory=list)

    def error(self, message: str) -> InputError:
        """Error that names the file and what is in it."""
        names = list(dict.fromkeys(s.name for s in self.series))
        listed = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
        return InputError(f"{self.path}: {message}; it holds {listed}")

    def pick(self, role: str, among: Sequence[Series] | None = None, *, needed: bool = True) -> list[Series]:
        """Series of a role, one per record, by option, else by what names, texts and units say."""
        given = self.chosen.get(role.replace(" ", "_"))
        if given is not None:
            found = [s for s in self.series if _is(s, given)]
            if not found:
                raise self.error(f"--channel {role.replace(' ', '_')}={given}: no such array or column")
            return [_with_unit(s, given.unit) for s in found]
        scored = [
            (score, s) for s in (self.series if among is None else among) if (score := _score(s, role)) > 0
        ]
        if not scored:
            if needed:
                raise self.error(
                    f"nothing in it is named or described as {role}; say where it is with "
                    f"--channel {role.replace(' ', '_')}=ARRAY:UNIT"
                )
            return []
        best = max(score for score, _ in scored)
        channel = next(s.channel for score, s in scored if score == best)
        found = [s for _, s in scored if s.channel == channel]
        line = f"{role} <- {_names(found)}{_stated(found[0])}"
        if why := self._said(found[0], role):
            self.notes.append(f"{line}: {why}")
        else:
            self.guesses.append(f"{line}: by its letter alone")
        return found

    def _said(self, s: Series, role: str) -> str:
        """What names a series of a role; empty if only a letter does."""
        if _named(s, role):
            return "named or described so"
        dimension = DIMENSIONS.get(role)
        if dimension is not None and s.si is not None and s.si[0] in dimension:
            channels = {o.channel for o in self.series if o.si is not None and o.si[0] == s.si[0]}
            if len(channels) == 1:
                return f"the only one in {s.unit}"
        return ""

    def rate(self, n: int) -> float:
        """Sample rate [Hz] of series with n samples.

        Raises
        ------
        InputError
            If nothing states or shows it.
        """
        name, stamps = next(((k, v) for k, v in self.times.items() if len(v) == n), ("", None))
        unit = self.beside.units.get(name) or (
            name.rsplit("_", 1)[-1] if is_common(name.rsplit("_", 1)[-1]) else None
        )
        try:
            base = time_base(
                self.path,
                stamps=None if stamps is None else Stamps(name, unit, [stamps]),
                option_hz=self.rate_option_hz,
                own_hz=self.own_hz,
                beside=self.beside,
                n_rows=n,
            )
        except InputError:
            mean = None if stamps is None or self.beside.sample_rate_hz else _mean_rate(stamps, unit)
            if mean is None:
                raise
            self.notes.append(f"time stamps '{name}' are rounded; their mean rate {mean:g} Hz is used")
            return mean
        self.notes.append(base.note)
        return base.rate_hz


def open_test(
    path: Path,
    channels: Sequence[str],
    sample_rate_hz: float | None,
    sidecar: Path | None,
    lone_role: str = "",
) -> TestFile:
    """Read a file of measured data.

    Parameters
    ----------
    path
        ``.npz``, a text table, or another format that recordings are read from.
    channels
        Options ``NAME=ARRAY[:UNIT]``; ``ARRAY[:UNIT]`` alone stands for ``lone_role``.
    sample_rate_hz
        Over what the file says.
    sidecar
        A JSON or TOML file; the one of the same name beside the file unless given.

    Raises
    ------
    InputError
        If it cannot be read, or an option cannot.
    """
    archive = open_archive(path)
    beside = find_sidecar(path, sidecar)
    facts = _facts(path, sidecar)
    texts = {k: v for k, v in facts.get("channels", {}).items() if isinstance(v, str)}
    arrays = {name: np.asarray(archive.read(name)) for name in archive.names}
    stated = {**archive.units, **beside.units}
    own = next(iter(archive.rates_hz.values()), None)
    archive.close()
    chosen = {name: ref for name, ref in beside.channels.items() if ref is not None}
    for option in channels:
        name, equals, ref = option.partition("=")
        if not equals:
            name, ref = lone_role, option
        if not (name and ref):
            raise InputError(f"--channel {option}: write NAME=ARRAY:UNIT, such as force=F:N")
        chosen[name.strip().replace("-", "_")] = parse_array_ref(ref, f"--channel {option}")
    times = {k: v for k, v in arrays.items() if _is_time(k) and v.ndim == 1 and v.dtype.kind in "fiu"}
    lengths = {len(v) for v in times.values()}
    series: list[Series] = []
    for name, array in arrays.items():
        if name in times and len(arrays) > 1:
            continue
        series += _series(name, np.asarray(array), lengths, texts, stated)
    if not series:
        raise InputError(f"{path}: holds no series of numbers; expected named columns or arrays")
    return TestFile(path, series, times, own, beside, facts, chosen, sample_rate_hz)


def _is_unit(word: str) -> bool:
    return is_common(word) or word.strip().lower() in _IN_NAMES


def _series(
    name: str, array: NDArray[Any], lengths: set[int], texts: Mapping[str, str], stated: Mapping[str, str]
) -> list[Series]:
    if array.dtype.kind not in "fiuc" or array.ndim == 0 or array.size < 2:
        return []
    squeezed = np.squeeze(array)
    unit, text = stated.get(name, ""), _text_of(name, texts)
    if squeezed.ndim <= 1:
        return [Series(name, name, "", squeezed.reshape(-1), unit or _unit_in(name, text), text)]
    axis = next((k for k, n in enumerate(squeezed.shape) if n in lengths), int(np.argmax(squeezed.shape)))
    moved = np.moveaxis(squeezed, axis, -1)
    axes = [k for k in range(squeezed.ndim) if k != axis]
    records = _record_axes(name, moved, axes, texts)
    out = []
    for index in np.ndindex(moved.shape[:-1]):
        where = [":" if k == axis else str(index[axes.index(k)]) for k in range(squeezed.ndim)]
        columns = [i for k, i in zip(axes, index, strict=True) if k not in records]
        key = f"col{columns[0]}" if len(columns) == 1 else "col" + "_".join(map(str, columns))
        said = _column_text(name, columns[0] if columns else 0, texts)
        record = name + "".join(f"[{i}]" for k, i in zip(axes, index, strict=True) if k in records)
        out.append(
            Series(f"{name}[{','.join(where)}]", key, record, moved[index], unit or _unit_in("", said), said)
        )
    return out


def _record_axes(name: str, moved: NDArray[Any], axes: list[int], texts: Mapping[str, str]) -> set[int]:
    """Which axes count repetitions, not channels: as stated like ``data[rec,ch,k]``, else by how alike they are."""
    for key in texts:
        match = re.match(rf"^{re.escape(name)}\[([^\]]*)\]$", key)
        if match:
            named = [p.strip().lower() for p in match[1].split(",")]
            if len(named) == moved.ndim:
                return {
                    k for k in axes if named[k].startswith(("rec", "run", "rep", "test", "trial", "shot"))
                }
    if len(axes) < 2:
        return set()
    spread = []
    for k in range(len(axes)):
        level = np.mean(np.abs(moved), axis=-1)
        spread.append(float(np.mean(np.std(level, axis=k) / (np.mean(level, axis=k) + 1e-300))))
    return {axes[int(np.argmin(spread))]} if not np.iscomplexobj(moved) else set()


def _text_of(name: str, texts: Mapping[str, str]) -> str:
    return texts.get(name, "")


def _column_text(name: str, column: int, texts: Mapping[str, str]) -> str:
    for key in (f"{name}[:,{column}]", f"col{column}", f"ch{column}", f"column {column}"):
        if key in texts:
            return texts[key]
    for key, text in texts.items():
        if key == name or key.startswith(f"{name}["):
            match = re.search(rf"(?:ch|col)(?:annel|umn)?\s*{column}\s*[=:]\s*([^,;]+)", text)
            return match[1] if match else text
    return ""


def _unit_in(name: str, text: str) -> str:
    """Find a unit as the end of a name, ``added_mass_g``, or any word of a text."""
    parts = name.lower().split("_")
    for size in (2, 1):
        tail = "/".join(parts[-size:])
        if len(parts) > size and _is_unit(tail):
            return tail
    # A single letter in a sentence is no unit unless it stands first or last.
    words = [w.strip(",;:()") for w in text.split()]
    for k, word in enumerate(words):
        if word and _is_unit(word) and (len(word) > 1 or k in (0, len(words) - 1)):
            return word
    return ""


def _score(s: Series, role: str) -> int:
    """How well a series fits a role: words of its description most, then unit, then the name's own letters."""
    words, points = s.words, 0
    for rank, word in enumerate(WORDS.get(role, (role,))):
        if len(word) > 2 and any(w.startswith(word) for w in words):
            points = max(points, 100 - rank)
        elif s.channel.lower() == word or s.channel.lower().split("_")[0] == word:
            points = max(points, 60 - rank)
    dimension = DIMENSIONS.get(role)
    if dimension is not None and s.si is not None:
        points = points + 40 if s.si[0] in dimension else 0 if points < 100 else points - 50
    if role != "input" and points and any(w in _SETPOINTS for w in words):
        points -= 70
    return points


def _named(s: Series, role: str) -> bool:
    """Whether a word of the role stands in what a series is called or described as."""
    return any(
        len(word) > 2 and any(w.startswith(word) for w in s.words) for word in WORDS.get(role, (role,))
    )


def _is(s: Series, ref: ArrayRef) -> bool:
    bare = str(ref).replace(" ", "")
    return (
        bare in (s.name, s.channel)
        or s.record == bare
        or (ref.index is None and s.name.split("[")[0] == ref.array)
    )


def _with_unit(s: Series, unit: str | None) -> Series:
    return s if not unit else Series(s.name, s.channel, s.record, s.values, unit, s.text)


def _stated(s: Series) -> str:
    return f" [{s.unit}]" if s.unit else ""


def _names(found: Sequence[Series]) -> str:
    names = [s.name for s in found]
    return ", ".join(names[:3]) + (f", ... ({len(names)})" if len(names) > 3 else "")


def _is_time(name: str) -> bool:
    return name.lower() in TIMES or re.split(r"[_ \[(]", name.lower())[0] in TIMES


def _facts(path: Path, sidecar: Path | None) -> Mapping[str, Any]:
    file = sidecar if sidecar is not None and sidecar.suffix.lower() == ".json" else path.with_suffix(".json")
    if not file.is_file():
        return {}
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}  # the sidecar's own reader has said so
    return found if isinstance(found, dict) else {}


def _mean_rate(stamps: NDArray[Any], unit: str | None) -> float | None:
    """Mean rate of stamps that only rounding keeps from being even; None for any others."""
    time = stamps.astype(np.float64) * (to_si(unit or "s") or ("s", 1.0))[1]
    if len(time) < 16 or not np.all(np.isfinite(time)) or np.any(np.diff(time) < 0.0) or time[-1] <= time[0]:
        return None
    rows = np.arange(len(time))
    slope, level = np.polyfit(rows, time, 1)
    grain = float(np.max(np.diff(time)))
    return (
        1.0 / float(slope) if np.max(np.abs(time - level - slope * rows)) < 3.0 * max(grain, slope) else None
    )
