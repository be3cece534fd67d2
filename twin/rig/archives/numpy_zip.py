"""NumPy's ``.npz``: a zip of ``.npy`` arrays, stored or deflated; Python objects in it are never loaded."""

import io
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from twin.plant.errors import InputError
from twin.rig.archives.base import WHOLE_BYTES, Archive, damaged, guard_memory, refuse_absurd

UNREADABLE = (
    OSError, EOFError, ValueError, KeyError, TypeError, SyntaxError, ArithmeticError, MemoryError,
    RuntimeError, NotImplementedError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zipfile.LargeZipFile,
    zlib.error,
)  # fmt: skip

KEPT_BYTES = 4 * WHOLE_BYTES
"""Arrays that are small enough to be read at once, so that their checksum is compared before any of it is used, stay in
memory up to so much together."""


@dataclass(slots=True)
class _Stream:
    """An array that is read from front to back."""

    file: IO[bytes]
    dtype: np.dtype[np.generic]
    columns: tuple[int, ...]
    next_row: int = 0


class NumpyArchive(Archive):
    """The arrays of one ``.npz``.

    Raises
    ------
    InputError
        If the file is none, or is cut short.
    """

    format = "NumPy .npz"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        try:
            with zipfile.ZipFile(path) as archive:
                members = {i.filename: i.file_size for i in archive.infolist()}
        except UNREADABLE as error:
            raise InputError(
                f"{path}: is cut short or damaged ({error}); copy or export the recording again"
            ) from error
        self._members = {m.removesuffix(".npy"): m for m in members if m.endswith(".npy")}
        self._sizes = {name: members[member] for name, member in self._members.items()}
        self.names = tuple(self._members)
        if not self.names:
            raise InputError(f"{path}: holds no arrays; save it with numpy.savez(path, name=array)")
        self._whole: dict[str, NDArray[np.generic]] = {}
        self._streams: dict[str, _Stream] = {}
        self._shapes: dict[str, tuple[tuple[int, ...], bool, np.dtype[np.generic]]] = {}

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of an array, from its header."""
        return self._header(name)[0]

    def read(self, name: str, first: int = 0, stop: int | None = None) -> NDArray[np.generic]:
        """Rows of an array; large ones are read from front to back without ever being held whole."""
        shape, fortran, _ = self._header(name)
        if self._sizes[name] <= WHOLE_BYTES or fortran or not shape:
            return self._at_once(name)[first:stop] if shape else self._at_once(name)
        return self._in_turn(name, first, shape[0] if stop is None else min(stop, shape[0]))

    def _header(self, name: str) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
        if name not in self._shapes:
            try:
                with zipfile.ZipFile(self.path) as archive, archive.open(self._members[name]) as file:
                    shape, fortran, dtype = _read_header(file)
                    claimed = math.prod(shape) * dtype.itemsize
                    if claimed > self._sizes[name] and not dtype.hasobject:
                        raise ValueError(f"it claims {claimed} bytes and has {self._sizes[name]}")
            except UNREADABLE as error:
                raise damaged(self.path, name, error) from error
            refuse_absurd(self.path, name, claimed)
            self._shapes[name] = shape, fortran, dtype
        return self._shapes[name]

    def _at_once(self, name: str) -> NDArray[np.generic]:
        if name in self._whole:
            return self._whole[name]
        guard_memory(
            self.path,
            f"array '{name}', with time along its second dimension,",
            3 * self._sizes[name],
            "save it in C order, as one array per channel",
        )
        try:
            with zipfile.ZipFile(self.path) as archive:
                # The whole member is read first, so that its checksum is compared before anything is used.
                content = io.BytesIO(archive.read(self._members[name]))
            with warnings.catch_warnings(action="ignore"):  # headers of Python 2 are read all the same
                array: NDArray[np.generic] = np.lib.format.read_array(content, allow_pickle=False)
        except UNREADABLE as error:
            if "allow_pickle" in str(error) or "Object arrays" in str(error):
                raise InputError(
                    f"{self.path}: array '{name}' holds Python objects, which are never loaded; "
                    "save it as an array of numbers"
                ) from error
            raise damaged(self.path, name, error) from error
        self._whole[name] = array
        while len(self._whole) > 1 and sum(kept.nbytes for kept in self._whole.values()) > KEPT_BYTES:
            del self._whole[next(iter(self._whole))]
        return array

    def _in_turn(self, name: str, first: int, stop: int) -> NDArray[np.generic]:
        try:
            stream = self._streams.get(name)
            if stream is None or stream.next_row > first:
                stream = self._streams[name] = self._open(name)
            row_bytes = stream.dtype.itemsize * int(np.prod(stream.columns, dtype=np.int64))
            while stream.next_row < first:
                skip = min(first - stream.next_row, max(1, WHOLE_BYTES // row_bytes))
                _exactly(stream.file, skip * row_bytes)
                stream.next_row += skip
            content = _exactly(stream.file, (stop - first) * row_bytes)
            stream.next_row = stop
        except UNREADABLE as error:
            raise damaged(self.path, name, error) from error
        return np.frombuffer(content, dtype=stream.dtype).reshape(stop - first, *stream.columns)

    def _open(self, name: str) -> _Stream:
        file = zipfile.ZipFile(self.path).open(self._members[name])  # noqa: SIM115 - until `close`
        shape, _, dtype = _read_header(file)
        if dtype.hasobject:
            raise ValueError("holds Python objects, which are never loaded")
        return _Stream(file, dtype, shape[1:])

    def close(self) -> None:
        """Let go of the file."""
        for stream in self._streams.values():
            stream.file.close()
        self._streams.clear()
        self._whole.clear()


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[np.generic]]:
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings(action="ignore"):
        shape, fortran, dtype = read(file)
    return tuple(shape), bool(fortran) and len(shape) > 1, dtype


def _exactly(file: IO[bytes], n: int) -> bytes:
    content = file.read(n)
    if len(content) != n:
        raise EOFError(f"ends {n - len(content)} bytes early")
    return content
