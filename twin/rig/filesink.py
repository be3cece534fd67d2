"""Where a recording's bytes go: through a pipe of ours where there are such, else by Rerun's own file sink.

Windows has no path that leads into a pipe. There Rerun writes the file itself. What differs: when the disk is full,
Rerun's thread ends and its stream waits for good, so all depends on what must stay free (`Storage.keep_free_bytes`);
and the disk is asked to confirm while the caller waits, at most every 50 ms.
"""

import os
import time
from pathlib import Path
from typing import Protocol

from twin.plant.errors import InputError, RunError

try:
    from twin.rig.filepipe import FilePipe
except ImportError:  # no fcntl, no termios
    FilePipe = None  # type: ignore[assignment, misc]

SYNC_S = 0.05
PIPES = "/dev/fd"


class Sink(Protocol):
    """A new file, and a path for Rerun to write to."""

    @property
    def written(self) -> int:
        """Bytes in the file."""

    @property
    def inlet(self) -> str:
        """Path to be opened by the writer, once."""

    def inlet_taken(self) -> None:
        """Say that the writer has opened it."""

    def check(self) -> None:
        """Raise RunError if a write has failed."""

    def drain(self, timeout_s: float) -> None:
        """Wait until what the writer has written is in the file; raises RunError as `check`, or if it takes longer."""

    def close(self) -> None:
        """Close the file; the writer must have closed its end. Raises RunError if a write has failed."""

    def abandon(self) -> None:
        """Close the file without a word about what could not be written."""


class PlainFile:
    """A new file that Rerun itself writes.

    Parameters
    ----------
    path
        File to create; its folder is created where it is missing.
    overwrite
        Replace an existing file instead of refusing.

    Raises
    ------
    InputError
        If the file cannot be created, or exists already.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = path.open("wb" if overwrite else "xb")
        except FileExistsError as error:
            raise InputError(f"{path}: exists already; give another name or remove it first") from error
        except OSError as error:
            raise InputError(
                f"{path}: cannot be created ({error.strerror}); give a folder that can be written"
            ) from error
        self._synced = time.monotonic()
        self._closed = False

    @property
    def written(self) -> int:
        """Bytes in the file."""
        return self._path.stat().st_size if self._closed else os.fstat(self._file.fileno()).st_size

    @property
    def inlet(self) -> str:
        """The file itself."""
        return str(self._path)

    def inlet_taken(self) -> None:
        """Nothing is to be done."""

    def check(self) -> None:
        """Nothing is known of Rerun's writing before it is flushed."""

    def drain(self, timeout_s: float) -> None:
        """Have the disk confirm what Rerun has flushed, unless it just has."""
        if time.monotonic() - self._synced >= SYNC_S:
            self._sync()

    def close(self) -> None:
        """Have the disk confirm all of it and close the file."""
        try:
            self._sync()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file."""
        self._closed = True
        self._file.close()

    def _sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            raise RunError(
                f"{self._path}: recording stopped ({error.strerror}); make room or record elsewhere. "
                "What was recorded until then can be read"
            ) from error
        self._synced = time.monotonic()


def open_sink(path: Path, *, overwrite: bool) -> Sink:
    """Create a recording's file; raises InputError if it cannot be created, or exists already."""
    if FilePipe is not None and os.path.isdir(PIPES):
        return FilePipe(path, overwrite=overwrite)
    return PlainFile(path, overwrite=overwrite)
