"""WAV files: integers are shares of full scale, floats stand as they are."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive

PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
KINDS = {
    (PCM, 8): "u1",
    (PCM, 16): "i2",
    (PCM, 24): "i3",
    (PCM, 32): "i4",
    (FLOAT, 32): "f4",
    (FLOAT, 64): "f8",
}
UNKNOWN_LENGTH = 0xFFFFFFFF
MAX_CHUNKS = 10_000


@dataclass(frozen=True, slots=True)
class _Layout:
    """Where the samples lie in the file, and how."""

    rate_hz: int
    n_channels: int
    kind: str
    order: str
    at_byte: int
    n_samples: int

    @property
    def row_bytes(self) -> int:
        return self.n_channels * int(self.kind[1])


class WaveArchive(Archive):
    """The channels of one WAV file (RIFF, RIFX or RF64) as ``channel1``, ``channel2`` and so on.

    A file of integers holds shares of the converter's full scale, -1 to 1: its sidecar says with ``scale`` how much
    of the unit that is. A file larger than 4 GB whose header cannot say so, as recorders write them on, is read to its
    end.

    Raises
    ------
    InputError
        If the file is damaged, cut short or of a coding other than PCM and float.
    """

    format = "WAV"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            self._layout = _layout(path)
        except (OSError, ValueError, struct.error) as error:
            raise InputError(f"{path}: is cut short, damaged or no PCM or float WAV ({error})") from error
        self.names = tuple(f"channel{k + 1}" for k in range(self._layout.n_channels))
        self.rates_hz = dict.fromkeys(self.names, float(self._layout.rate_hz))
        if self._layout.kind[0] != "f":
            self.shares = frozenset(self.names)
        self._last: tuple[int, int, NDArray[np.generic]] | None = None

    def shape(self, name: str) -> tuple[int, ...]:
        """Number of samples."""
        return (self._layout.n_samples,)

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Samples of one channel."""
        n = self._layout.n_samples
        first, stop = min(first, n), n if stop is None else min(stop, n)
        if self._last is None or self._last[:2] != (first, stop):  # the channels lie between each other
            self._last = (first, stop, self._rows(first, stop))
        samples = self._last[2][:, self.names.index(name)]
        bits = {"u1": 8, "i2": 16, "i3": 32, "i4": 32}.get(self._layout.kind)
        if bits is None:
            return np.ascontiguousarray(samples)
        return samples.astype(np.float64) / 2.0 ** (bits - 1) - (1.0 if bits == 8 else 0.0)

    def _rows(self, first: int, stop: int) -> NDArray[np.generic]:
        layout = self._layout
        try:
            with self.path.open("rb") as file:
                file.seek(layout.at_byte + first * layout.row_bytes)
                content = file.read((stop - first) * layout.row_bytes)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read ({error.strerror or error})") from error
        if len(content) < (stop - first) * layout.row_bytes:
            raise InputError(f"{self.path}: ends before its last sample; copy or export it again")
        if layout.kind != "i3":
            return np.frombuffer(content, layout.order + layout.kind).reshape(-1, layout.n_channels)
        three = np.frombuffer(content, np.uint8).reshape(-1, 3)
        four = np.zeros(
            (len(three), 4), np.uint8
        )  # the upper three of the four bytes: sign and scale are right
        four[:, slice(1, 4) if layout.order == "<" else slice(0, 3)] = three
        return four.view(f"{layout.order}i4").reshape(-1, layout.n_channels)


def _layout(path: Path) -> _Layout:
    """Walk along the chunks to the samples; ValueError says what is wrong with them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        order = ">" if head[:4] == b"RIFX" else "<"
        if head[:4] not in (b"RIFF", b"RIFX", b"RF64") or head[8:] != b"WAVE":
            raise ValueError("it does not begin like one")
        format_of: tuple[int, ...] | None = None
        long_data: int | None = None
        for _ in range(MAX_CHUNKS):
            name, length = struct.unpack(f"{order}4sI", _exactly(file.read(8), 8))
            at = file.tell()
            if name == b"fmt ":
                fields = _exactly(file.read(min(length, 40)), 16)
                format_of = struct.unpack(f"{order}HHIIHH", fields[:16])
                if format_of[0] == EXTENSIBLE and len(fields) >= 26:
                    format_of = (struct.unpack(f"{order}H", fields[24:26])[0], *format_of[1:])
            elif name == b"ds64":
                long_data = struct.unpack("<Q", _exactly(file.read(16), 16)[8:])[0]
            elif name == b"data":
                if format_of is None:
                    raise ValueError("its samples come before their format")
                return _checked(format_of, order, at, length, long_data, size)
            file.seek(at + length + length % 2)
    raise ValueError("it has no samples")


def _checked(
    format_of: tuple[int, ...], order: str, at: int, length: int, long_data: int | None, size: int
) -> _Layout:
    coding, n_channels, rate, _, row_bytes, bits = format_of
    kind = KINDS.get((coding, bits))
    if kind is None:
        raise ValueError(f"coding {coding} with {bits} bits a sample")
    if n_channels == 0 or rate == 0 or row_bytes != n_channels * int(kind[1]):
        raise ValueError(f"{n_channels} channels at {rate} Hz in {row_bytes} bytes do not go together")
    to_end = size - at
    if length == UNKNOWN_LENGTH:
        length = long_data if long_data is not None else to_end
    elif length == 0 and to_end > 0:
        length = to_end  # its recorder was killed before it wrote how long it was
    if length > to_end:
        raise ValueError(f"it ends {length - to_end} bytes before its last sample")
    return _Layout(rate, n_channels, kind, order, at, length // row_bytes)


def _exactly(content: bytes, n: int) -> bytes:
    if len(content) < n:
        raise ValueError("it ends inside its head")
    return content
