"""NumPy ``.npz`` recordings, whoever made them, as blocks of the plant's channels in SI units."""

import io
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.linear import Array, read_only
from twin.rig.arrayref import ArrayRef
from twin.rig.mapping import TIME_NAMES, ChannelMapping, map_channels
from twin.rig.sidecar import Sidecar, find_sidecar
from twin.rig.timebase import sample_rate

_UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, TypeError, SyntaxError, ArithmeticError, MemoryError,
    RuntimeError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class NpzRecording:
    """A recording, checked and ready to be read block by block.

    Attributes
    ----------
    path
        The file.
    sample_rate_hz
        Samples per second.
    n_samples
        Length of the recording.
    channels
        Columns of its blocks: the plant's sensors, then its actuators' commands, as far as recorded.
    mapping
        Where each column comes from and how that was decided, in the same order.
    notes
        What a person should know before trusting it, one sentence each.
    block_s
        Length of a block [s]; the last one may be shorter.
    values
        (n_samples, n_channels) in SI units, read-only, as recorded: not finite where samples are missing.
    ranges
        (n_channels,) largest magnitude each channel can measure, infinity where unknown.
    """

    path: Path
    sample_rate_hz: float
    n_samples: int
    channels: tuple[Channel, ...]
    mapping: tuple[ChannelMapping, ...]
    notes: tuple[str, ...]
    block_s: float
    values: Array = field(repr=False)
    ranges: Array = field(repr=False)

    @property
    def block_samples(self) -> int:
        """Number of samples in a block, at least one."""
        return max(1, round(self.block_s * self.sample_rate_hz))

    def blocks(self) -> Iterator[Block]:
        """Yield the recording's blocks in order; each call begins again at the first sample."""
        for first in range(0, self.n_samples, self.block_samples):
            yield make_block(
                first,
                self.sample_rate_hz,
                self.values[first : first + self.block_samples],
                self.channels,
                self.ranges,
            )


def open_npz(
    path: Path,
    plant: Plant,
    *,
    channels: Mapping[str, str] | None = None,
    sample_rate_hz: float | None = None,
    sidecar: Path | None = None,
    block_s: float = 0.1,
) -> NpzRecording:
    """Open a NumPy recording and find the plant's channels in it.

    A plant's channels are its sensors and its actuators' recorded commands. Each is looked up in the given
    options, then in the sidecar, then under its ``recorded_as`` in the plant, then under its own name; a last
    one left over is guessed only if a single array with a fitting unit is left (see `map_channels`).

    Parameters
    ----------
    path
        The ``.npz`` file. Pickled objects in it are never loaded.
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
    archive = _Archive(path)
    beside = find_sidecar(path, sidecar)
    mapping, notes = map_channels(path, plant, archive.names, channels or {}, beside)
    columns = [_column(archive, entry) for entry in mapping]
    lengths = {str(entry.ref): len(column) for entry, column in zip(mapping, columns, strict=True)}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(
            f"{path}: arrays differ in length ({listed} samples); they must be recorded together"
        )
    n_samples = len(columns[0])
    if n_samples == 0:
        raise InputError(f"{path}: array '{mapping[0].ref}' is empty; there is nothing to replay")
    rate, rate_note = _rate(archive, beside, sample_rate_hz, n_samples)
    limits = {s.name: s.range for s in plant.sensor}
    return NpzRecording(
        path=path,
        sample_rate_hz=rate,
        n_samples=n_samples,
        channels=tuple(Channel(entry.channel, entry.si_unit) for entry in mapping),
        mapping=mapping,
        notes=(rate_note, *notes, *beside.notes),
        block_s=block_s,
        values=read_only(np.column_stack(columns)),
        ranges=read_only([limits.get(entry.channel) or np.inf for entry in mapping]),
    )


def _column(archive: "_Archive", entry: ChannelMapping) -> Array:
    series = entry.ref.take(archive.load(entry.ref.array), str(archive.path))
    if series.dtype.kind not in "fiu":
        raise InputError(
            f"{archive.path}: array '{entry.ref}' holds {series.dtype.name}, not real numbers; "
            f"channel '{entry.channel}' [{entry.si_unit}] needs real samples in time"
        )
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows becomes infinite and is masked
        return series.astype(np.float64) * entry.factor


def _rate(archive: "_Archive", beside: Sidecar, option_hz: float | None, n_samples: int) -> tuple[float, str]:
    given = beside.time
    if given is not None and given.array not in archive.names:
        raise InputError(
            f"{archive.path}: {beside.channels_from} names time array '{given.array}', which is not in the "
            f"file; arrays: {', '.join(archive.names)}"
        )
    ref = given or next((ArrayRef(name) for name in TIME_NAMES if name in archive.names), None)
    stamps = None
    if ref is not None and option_hz is None:
        stamps = ref.take(archive.load(ref.array), str(archive.path))
    return sample_rate(
        archive.path,
        stamps=stamps,
        name=str(ref),
        unit=None if ref is None else ref.unit or beside.units.get(ref.array),
        option_hz=option_hz,
        beside=beside,
        n_samples=n_samples,
    )


class _Archive:
    """The arrays of one ``.npz``, each checked against its checksum when it is loaded."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with zipfile.ZipFile(path) as archive:
                members = archive.namelist()
        except FileNotFoundError as error:
            raise InputError(f"{path}: no such file; check the path") from error
        except IsADirectoryError as error:
            raise InputError(f"{path}: is a directory; give the .npz file in it") from error
        except _UNREADABLE as error:
            raise InputError(f"{path}: {_why(path, error)}") from error
        self._members = {m.removesuffix(".npy"): m for m in members if m.endswith(".npy")}
        self.names = tuple(self._members)
        if not self.names:
            raise InputError(f"{path}: holds no arrays; save it with numpy.savez(path, name=array)")

    def load(self, name: str) -> NDArray[np.generic]:
        """Load one array; InputError if it is damaged or holds Python objects."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                # The whole member is read first, so that its checksum is compared before anything is used.
                content = io.BytesIO(archive.read(self._members[name]))
            with warnings.catch_warnings(
                action="ignore"
            ):  # headers written by Python 2 are read all the same
                array: NDArray[np.generic] = np.lib.format.read_array(content, allow_pickle=False)
        except _UNREADABLE as error:
            if "allow_pickle" in str(error) or "Object arrays" in str(error):
                raise InputError(
                    f"{self.path}: array '{name}' holds Python objects, which are never loaded; "
                    "save it as an array of numbers"
                ) from error
            raise InputError(
                f"{self.path}: array '{name}' is damaged ({error or type(error).__name__}); "
                "copy or export the recording again"
            ) from error
        return array


def _why(path: Path, error: BaseException) -> str:
    """Why a file is no archive, and what to do about it."""
    if isinstance(error, PermissionError):
        return "may not be read (permission denied); check its owner and mode"
    try:
        with path.open("rb") as file:
            start = file.read(6)
    except OSError:
        return f"cannot be read ({error}); check the path"
    if not start:
        return "is empty; copy or export the recording again"
    if start == b"\x93NUMPY":
        return "is a single .npy array, not an .npz; save it with numpy.savez(path, name=array)"
    if start.startswith(b"PK"):
        return f"is cut short or damaged ({error}); copy or export the recording again"
    return "is not a NumPy .npz archive; save the recording with numpy.savez(path, name=array)"
