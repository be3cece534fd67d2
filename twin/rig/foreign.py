"""Recordings of other people's rigs, in any known format, as blocks of the plant's channels in SI units."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.linear import Array, read_only
from twin.rig.archives.base import Archive
from twin.rig.archives.detect import open_archive
from twin.rig.arrayref import ArrayRef
from twin.rig.mapping import TIME_NAMES, ChannelMapping, map_channels, plant_channels
from twin.rig.sidecar import Sidecar, find_sidecar, sidecar_text
from twin.rig.timebase import Gap, Stamps, TimeBase, time_base

PART_ROWS = 1 << 18
"""Rows read from the file at a time."""

APART = 0.5
"""Channels that begin further apart than this, in samples, do not belong into the same row."""

ABSURD = 1e12
ABSURD_SHARE = 0.2
"""So many values beyond this, or below its inverse: numbers read in the wrong byte order."""


@dataclass(frozen=True, slots=True, eq=False)
class _Column:
    """A channel's series in the file.

    ``stride``: every how many of the recording's samples it has one. ``whole``: the series itself, where time does
    not run along the array's first dimension, so that it cannot be read in parts.
    """

    entry: ChannelMapping
    n_rows: int
    stride: int = 1
    whole: NDArray[np.generic] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ForeignRecording:
    """A recording, checked and ready to be read block by block.

    Attributes
    ----------
    path
        The file.
    sample_rate_hz
        Samples per second.
    n_samples
        Length of the recording, missing rows included.
    channels
        Columns of its blocks: the plant's sensors, then its actuators' commands, as far as recorded.
    mapping
        Where each column comes from and how that was decided, in the same order.
    notes
        What a person should know before trusting it, one sentence each.
    block_s
        Length of a block [s]; the last one may be shorter.
    ranges
        (n_channels,) largest magnitude each channel can measure, infinity where unknown.
    sidecar
        All of this as the text of a sidecar (TOML), so that nothing need be guessed again.
    """

    path: Path
    sample_rate_hz: float
    n_samples: int
    channels: tuple[Channel, ...]
    mapping: tuple[ChannelMapping, ...]
    notes: tuple[str, ...]
    block_s: float
    ranges: Array = field(repr=False)
    sidecar: str = field(repr=False)
    _archive: Archive = field(repr=False)
    _columns: tuple[_Column, ...] = field(repr=False)
    _gaps: tuple[Gap, ...] = field(repr=False)

    @property
    def guesses(self) -> tuple[str, ...]:
        """What nobody has said, a line each: for a person to confirm before anything is made of it."""
        return tuple(str(entry) for entry in self.mapping if entry.guess)

    @property
    def block_samples(self) -> int:
        """Number of samples in a block, at least one."""
        return max(1, round(self.block_s * self.sample_rate_hz))

    @property
    def values(self) -> Array:
        """(n_samples, n_channels) in SI units, as recorded: not finite where samples are missing."""
        parts = [np.empty((0, len(self.channels))), *self._parts()]
        return read_only(np.concatenate(parts))

    def blocks(self) -> Iterator[Block]:
        """Yield the recording's blocks in order; each call begins again at the first sample."""
        size, first = self.block_samples, 0
        waiting = np.empty((0, len(self.channels)))
        for part in self._parts():
            waiting = np.concatenate([waiting, part])
            whole = len(waiting) - len(waiting) % size
            for at in range(0, whole, size):
                yield self._block(first, waiting[at : at + size])
                first += size
            waiting = waiting[whole:]
        if len(waiting):
            yield self._block(first, waiting)

    def close(self) -> None:
        """Let go of the file."""
        self._archive.close()

    @property
    def _n_rows(self) -> int:
        return self.n_samples - sum(gap.missing for gap in self._gaps)

    def _chunks(self, names: list[str]) -> Iterator[dict[str, NDArray[np.generic]]]:
        if names:
            return self._archive.chunks(names, PART_ROWS)
        return iter([{}] * -(-self._n_rows // PART_ROWS))

    def _rows(self, column: _Column, begin: int, stop: int) -> NDArray[np.generic]:
        if column.whole is not None:
            return column.whole[begin:stop]
        return self._series(column, self._archive.read(column.entry.ref.array, begin, stop))

    def _series(self, column: _Column, rows: NDArray[np.generic]) -> NDArray[np.generic]:
        return _series(self._archive, column.entry, rows)

    def _block(self, first: int, values: Array) -> Block:
        return make_block(first, self.sample_rate_hz, values, self.channels, self.ranges)

    def _parts(self) -> Iterator[Array]:
        """Rows in SI units, the missing ones as NaN, as many at a time as are read."""
        streamed = [c.entry.ref.array for c in self._columns if c.stride == 1 and c.whole is None]
        gaps, row = list(self._gaps), 0
        for chunk in self._chunks(streamed):
            n = min((len(series) for series in chunk.values()), default=min(PART_ROWS, self._n_rows - row))
            out = np.full((n, len(self._columns)), np.nan)
            for k, column in enumerate(self._columns):
                if column.stride == 1 and column.whole is None:
                    at, series = 0, self._series(column, chunk[column.entry.ref.array][:n])
                else:
                    at = -row % column.stride
                    begin, stop = (row + at) // column.stride, -(-(row + n) // column.stride)
                    series = self._rows(column, begin, min(stop, column.n_rows))
                out[at :: column.stride, k][: len(series)] = _si(self._archive, column.entry, series)
            due = [g for g in gaps if g.before_row < row + n]
            gaps = gaps[len(due) :]
            at = 0
            for gap in due:
                yield out[at : gap.before_row - row]
                at = gap.before_row - row
                for begin in range(0, gap.missing, PART_ROWS):
                    yield np.full((min(PART_ROWS, gap.missing - begin), len(self._columns)), np.nan)
            yield out[at:]
            row += n


def open_foreign(
    path: Path,
    plant: Plant,
    *,
    channels: Mapping[str, str] | None = None,
    sample_rate_hz: float | None = None,
    sidecar: Path | None = None,
    block_s: float = 0.1,
) -> ForeignRecording:
    """Open a recording of any known format and find the plant's channels in it.

    A plant's channels are its sensors and its actuators' recorded commands. Each is looked up in the given
    options, then in the sidecar, then under its ``recorded_as`` in the plant, then under its own name; what is left
    over is guessed where there is no choice (see `map_channels`), and said in `ForeignRecording.guesses`.

    Channels of different rates are not resampled: a slower one, whose rate divides the fastest, has a valid sample
    where it was sampled and is masked between.

    Parameters
    ----------
    path
        The file; its format is told by its content.
    plant
        Says which channels there are, their SI units and their ranges.
    channels
        Plant channel to ``array``, ``array:unit``, ``array[:,2]:unit``, or ``none`` if it was not recorded.
    sample_rate_hz
        Sample rate [Hz], over what the recording and its sidecar say.
    sidecar
        A file with rate, units and channels; without it, files of the recording's name beside it are used.
    block_s
        Length of a block [s].

    Raises
    ------
    InputError
        If the file or its sidecar cannot be read, a channel cannot be found, its unit does not fit, lengths
        differ, or the sample rate is unknown; the message names the file, the channel and the remedy.
    """
    path = Path(path)
    if not (math.isfinite(block_s) and block_s > 0.0):
        raise InputError(f"block length [s]: must be a positive number of s, got {block_s!r}")
    archive = open_archive(path)
    beside = _with_own_units(find_sidecar(path, sidecar), archive)
    mapping, notes = map_channels(path, plant, archive.names, channels or {}, beside, archive.shares)
    columns, own_hz = _columns(archive, mapping, sample_rate_hz)
    n_rows = next(c.n_rows for c in columns if c.stride == 1)
    if n_rows == 0:
        raise InputError(f"{path}: array '{mapping[0].ref}' is empty; there is nothing to replay")
    for column in columns:
        _look(archive, column)
    _begin_together(archive, mapping, max(rate for rate in (own_hz, sample_rate_hz, 0.0) if rate is not None))
    stamped_by = _stamped_by(archive, beside)
    base = _time_base(archive, beside, stamped_by, sample_rate_hz, own_hz, n_rows)
    if base.gaps and any(c.stride > 1 for c in columns):
        raise InputError(
            f"{path}: has both gaps in time and channels of different rates; export the channels apart"
        )
    slow = tuple(
        f"{c.entry.channel}: one sample in {c.stride}; masked between" for c in columns if c.stride > 1
    )
    limits = {s.name: s.range for s in plant.sensor}
    return ForeignRecording(
        path=path,
        sample_rate_hz=base.rate_hz,
        n_samples=n_rows + base.missing,
        channels=tuple(Channel(entry.channel, entry.si_unit) for entry in mapping),
        mapping=mapping,
        notes=(base.note, *slow, *notes, *beside.notes),
        block_s=block_s,
        ranges=read_only([limits.get(entry.channel) or np.inf for entry in mapping]),
        sidecar=_as_sidecar(plant, mapping, stamped_by if base.by_stamps else None, base.rate_hz),
        _archive=archive,
        _columns=columns,
        _gaps=base.gaps,
    )


def _with_own_units(beside: Sidecar, archive: Archive) -> Sidecar:
    if not archive.units:
        return beside
    said_by = f"{beside.units_from} and the file itself" if beside.units else "the file itself"
    return replace(beside, units={**archive.units, **beside.units}, units_from=said_by)


def _columns(
    archive: Archive, mapping: tuple[ChannelMapping, ...], option_hz: float | None
) -> tuple[tuple[_Column, ...], float | None]:
    """Each channel's length and stride, and the rate [Hz] that the file states for the fastest."""
    rates = [archive.rates_hz.get(entry.ref.array) for entry in mapping]
    fastest = max((r for r in rates if r is not None), default=None)
    strides = []
    for entry, rate in zip(mapping, rates, strict=True):
        ratio = 1.0 if rate is None or fastest is None or option_hz is not None else fastest / rate
        if abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise InputError(
                f"{archive.path}: channel '{entry.channel}' was sampled at {rate:g} Hz, which does not divide "
                f"{fastest:g} Hz; resample it before, or leave it out with --channel {entry.channel}=none"
            )
        strides.append(round(ratio))
    columns = tuple(_column(archive, e, s) for e, s in zip(mapping, strides, strict=True))
    lengths = {str(c.entry.ref): c.n_rows for c in columns if c.stride == 1}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(
            f"{archive.path}: arrays differ in length ({listed} samples); they must be recorded together"
        )
    return columns, fastest


def _column(archive: Archive, entry: ChannelMapping, stride: int) -> _Column:
    ref, shape = entry.ref, archive.shape(entry.ref.array)
    vector = ref.index is None and (len(shape) == 1 or (len(shape) == 2 and shape[1] == 1 < shape[0]))
    rows_first = ref.index is not None and len(shape) == len(ref.index) and ref.index[0] is None
    if vector or rows_first:
        if rows_first:
            # Without touching a sample: complains of a position outside.
            ref.take(np.broadcast_to(np.int8(0), shape), str(archive.path))
        return _Column(entry, shape[0], stride)
    series = ref.take(archive.read(ref.array), str(archive.path))
    return _Column(entry, len(series), stride, series)


def _series(archive: Archive, entry: ChannelMapping, rows: NDArray[np.generic]) -> NDArray[np.generic]:
    return rows.reshape(-1) if entry.ref.index is None else entry.ref.take(rows, str(archive.path))


def _si(archive: Archive, entry: ChannelMapping, series: NDArray[np.generic]) -> Array:
    if series.dtype.kind not in "fiu":
        raise InputError(
            f"{archive.path}: array '{entry.ref}' holds {series.dtype.name}, not real numbers; "
            f"channel '{entry.channel}' [{entry.si_unit}] needs real samples in time"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows becomes infinite and is masked
        return series.astype(np.float64) * entry.factor


def _look(archive: Archive, column: _Column) -> None:
    """Read the beginning of a channel: it must hold numbers, and not such as come of a wrong byte order."""
    entry = column.entry
    rows = column.whole[:10_000] if column.whole is not None else archive.read(entry.ref.array, 0, 10_000)
    start = _si(archive, entry, rows if column.whole is not None else _series(archive, entry, rows))
    sizes = np.abs(start[np.isfinite(start) & (start != 0.0)])
    absurd = (sizes > ABSURD) | (sizes < 1.0 / ABSURD)
    if len(sizes) > 10 and np.mean(absurd) > ABSURD_SHARE:
        raise InputError(
            f"{archive.path}: array '{entry.ref}' has values from {sizes.min():.0e} to {sizes.max():.0e} "
            f"{entry.si_unit}: written in the other byte order, or damaged; export it again"
        )


def _begin_together(archive: Archive, mapping: tuple[ChannelMapping, ...], rate_hz: float) -> None:
    """Complain of channels whose first samples were not taken at the same instant."""
    starts = {m.channel: archive.starts_s[m.ref.array] for m in mapping if m.ref.array in archive.starts_s}
    if not starts:
        return
    first, last = min(starts, key=lambda k: starts[k]), max(starts, key=lambda k: starts[k])
    apart = starts[last] - starts[first]
    if apart * rate_hz > APART:
        raise InputError(
            f"{archive.path}: channel '{last}' begins {apart:.6g} s after '{first}', by what the file says; export "
            f"both from one instant on, or leave one out with --channel {last}=none"
        )


def _as_sidecar(
    plant: Plant, mapping: tuple[ChannelMapping, ...], time: ArrayRef | None, rate_hz: float
) -> str:
    found = {m.channel: ArrayRef(m.ref.array, m.ref.index, m.unit) for m in mapping}
    return sidecar_text(
        None if time is not None else rate_hz, time, {name: found.get(name) for name in plant_channels(plant)}
    )


def _stamped_by(archive: Archive, beside: Sidecar) -> ArrayRef | None:
    """The array of time stamps, with its unit where one is stated."""
    given = beside.time
    if given is not None and given.array not in archive.names:
        raise InputError(
            f"{archive.path}: {beside.channels_from} names time array '{given.array}', which is not in the "
            f"file; arrays: {', '.join(archive.names)}"
        )
    by_name = {name.lower(): name for name in reversed(archive.names)}
    ref = given or next((ArrayRef(by_name[name]) for name in TIME_NAMES if name in by_name), None)
    return None if ref is None else replace(ref, unit=ref.unit or beside.units.get(ref.array))


def _time_base(
    archive: Archive,
    beside: Sidecar,
    ref: ArrayRef | None,
    option_hz: float | None,
    own_hz: float | None,
    n_rows: int,
) -> TimeBase:
    stamps = None if ref is None or option_hz is not None else _stamps(archive, ref, ref.unit)
    return time_base(
        archive.path, stamps=stamps, option_hz=option_hz, own_hz=own_hz, beside=beside, n_rows=n_rows
    )


def _stamps(archive: Archive, ref: ArrayRef, unit: str | None) -> Stamps:
    shape = archive.shape(ref.array)
    if ref.index is None and len(shape) == 1:
        parts = (chunk[ref.array] for chunk in archive.chunks([ref.array], PART_ROWS))
        return Stamps(str(ref), unit, parts)
    series = ref.take(archive.read(ref.array), str(archive.path))
    return Stamps(str(ref), unit, [series])
