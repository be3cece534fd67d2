"""The frame of a Rerun file: where its messages end, so that one cut short can be read up to its last whole one.

``RRF2``, eight bytes of version and options, then messages: kind and length, both unsigned 64-bit little-endian, and
so many bytes. A finished file ends with a message of kind 0 and a trailer; that of a killed recorder just stops.
"""

import os
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path

_HEADER_BYTES, _MESSAGE = 12, struct.Struct("<QQ")
_END, _KINDS = 0, range(1, 4)


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


def copy_whole_part(path: Path, to: Path) -> bool:
    """Copy a file up to the end of its last whole message; False if it holds none."""
    found = extent(path)
    if not found.has_messages:
        return False
    shutil.copyfile(path, to)
    os.truncate(to, found.whole_bytes)
    return True
