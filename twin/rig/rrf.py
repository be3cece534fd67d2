"""Rerun files: where their messages end, and the rows that are in them.

``RRF2``, eight bytes of version and options, then messages: kind and length, both unsigned 64-bit little-endian, and
so many bytes. A finished file ends with a message of kind 0 and a trailer; that of a killed recorder just stops.

The rows in a message are an Arrow stream, packed by LZ4, in a field of Protocol Buffers. They are read here and not by
Rerun's own reader, which ends the process, whatever it was doing, at some damages inside a message.
"""

import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

_HEADER_BYTES, _MESSAGE = 12, struct.Struct("<QQ")
_END, _KINDS = 0, range(1, 4)
_ROWS = 2  # the kind of message that holds rows
_STORE, _PACKED_AS, _UNPACKED_BYTES, _PAYLOAD = 1, 2, 3, 5  # its fields
_PLAIN, _LZ4 = 1, 2
_MOST_PACKED = 255  # what LZ4 can reach
_CODEC = pa.Codec("lz4_raw")


@dataclass(frozen=True, slots=True)
class Extent:
    """How far a file is whole.

    Attributes
    ----------
    whole_bytes
        Length up to the end of the last whole message; a finished file's trailer is not counted.
    finished
        Its recorder closed it.
    cut
        Something follows the last whole message that is none.
    """

    whole_bytes: int
    finished: bool
    cut: bool

    @property
    def has_messages(self) -> bool:
        """Whether there is any whole message."""
        return self.whole_bytes > _HEADER_BYTES


def extent(path: Path) -> Extent:
    """Walk along a file's messages without reading them.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        size, at = os.fstat(handle).st_size, _HEADER_BYTES
        while at + _MESSAGE.size <= size:
            kind, length = _MESSAGE.unpack(os.pread(handle, _MESSAGE.size, at))
            if kind == _END and length > 0:
                return Extent(at, True, at + _MESSAGE.size + length > size)
            if kind not in _KINDS or length == 0 or at + _MESSAGE.size + length > size:
                break
            at += _MESSAGE.size + length
    finally:
        os.close(handle)
    return Extent(min(at, size), False, at != size)


@dataclass(frozen=True, slots=True)
class Rows:
    """The rows of one message.

    Attributes
    ----------
    entity
        Path they were logged under, ``/record/raw``; empty if the message is damaged.
    batch
        The rows; None if the message is damaged.
    store
        What tells the recordings in one file apart.
    """

    entity: str
    batch: pa.RecordBatch | None
    store: bytes


def rows(path: Path) -> Iterator[Rows]:
    """All rows of a file in the order in which they were written, up to the end of its last whole message.

    Raises
    ------
    OSError
        If the file cannot be read.
    """
    for _, _, found in _messages(path):
        yield from found


def copy_sound_part(path: Path, to: Path, sound: Callable[[Rows], bool] = lambda _: True) -> int:
    """Copy a file without its damaged messages and without what follows its last whole one; how many are left out.

    Parameters
    ----------
    sound
        Whether the rows of a message, which can be read, are also what they should be.
    """
    left_out = 0
    with path.open("rb") as file, to.open("wb") as copy:
        copy.write(file.read(_HEADER_BYTES))
        for at, length, found in _messages(path):
            if all(one.batch is not None and sound(one) for one in found):
                file.seek(at)
                copy.write(file.read(length))
            else:
                left_out += 1
    return left_out


def _messages(path: Path) -> Iterator[tuple[int, int, list[Rows]]]:
    """Where each whole message begins, its length with its head, and the rows in it."""
    end, at = extent(path).whole_bytes, _HEADER_BYTES
    with path.open("rb") as file:
        while at < end:
            file.seek(at)
            kind, length = _MESSAGE.unpack(file.read(_MESSAGE.size))
            yield at, _MESSAGE.size + length, _rows_of(file.read(length)) if kind == _ROWS else []
            at += _MESSAGE.size + length


def _rows_of(content: bytes) -> list[Rows]:
    """Rows of one message; one without a batch where it is damaged."""
    try:
        packed_as, unpacked, start, n, store = _fields(content)
        payload = pa.py_buffer(memoryview(content)[start : start + n])
        if packed_as == _LZ4:
            if unpacked > _MOST_PACKED * n + 64:
                raise ValueError("more than can be packed into so little")
            payload = _CODEC.decompress(payload, unpacked)
        found = []
        for batch in pa.RecordBatchStreamReader(payload):
            batch.validate(full=True)
            found.append(Rows(batch.schema.metadata[b"rerun:entity_path"].decode(), batch, store))
    except (pa.ArrowException, ValueError, KeyError, IndexError, OSError, MemoryError, TypeError):
        return [Rows("", None, b"")]
    return found


def _fields(content: bytes) -> tuple[int, int, int, int, bytes]:
    """How a message's rows are packed, their bytes unpacked, where they begin, how long they are, whose they are."""
    at, packed_as, unpacked, store = 0, _PLAIN, 0, b""
    while at < len(content):
        key, at = _varint(content, at)
        number, form = key >> 3, key & 7
        if form == 0:
            value, at = _varint(content, at)
            packed_as = value if number == _PACKED_AS else packed_as
            unpacked = value if number == _UNPACKED_BYTES else unpacked
        elif form == 2:
            size, at = _varint(content, at)
            if at + size > len(content):
                break
            if number == _STORE:
                store = content[at : at + size]
            if number == _PAYLOAD:
                return packed_as, unpacked, at, size, store
            at += size
        else:
            break
    raise ValueError("no rows in it")


def _varint(content: bytes, at: int) -> tuple[int, int]:
    if content[at] < 0x80:
        return content[at], at + 1
    value = 0
    for shift in range(0, 70, 7):
        byte = content[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("a number without an end")
