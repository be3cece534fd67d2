"""A file that Rerun writes through a pipe, so that a full disk is an exception and not a hang.

Rerun's own file sink ends its thread at the first failed write; flushing or closing the stream then waits
forever. Here it writes into a pipe that always accepts, and a thread of ours carries the bytes to the file.

What is in the file outlives this process at once, and power loss once the disk has confirmed it (`fsync`): the thread
asks for that as soon as nothing more waits, up to twenty times a second and at least ten, and at the end; for the
folder's entry at the beginning.
"""

import array
import contextlib
import errno
import fcntl
import os
import select
import termios
import threading
import time
from pathlib import Path

from twin.plant.errors import InputError, RunError

_PIPE_BYTES = 1 << 20
_POLL_S = 0.1
_DRAIN_POLL_S = 1e-4
SYNC_S = 0.05
"""The disk is not asked more often than so."""


class FilePipe:
    """A new file, and a path that writes into it (POSIX).

    Parameters
    ----------
    path
        File to create; its folder is created where it is missing.
    overwrite
        Replace an existing file instead of refusing.

    Attributes
    ----------
    written
        Bytes in the file.

    Raises
    ------
    InputError
        If the file cannot be created, or exists already.
    """

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        self._path = path
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True)
            self._file = open(path, "wb" if overwrite else "xb", buffering=0)  # noqa: SIM115
        except OSError as error:
            if path.exists() and isinstance(error, FileExistsError):
                raise InputError(f"{path}: exists already; give another name or remove it first") from error
            raise InputError(
                f"{path}: cannot be created ({error.strerror}); give a folder that can be written"
            ) from error
        _sync_folder(path.parent)
        self._outlet, self._inlet = os.pipe()
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            fcntl.fcntl(self._inlet, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._error: OSError | None = None
        self.written = 0
        self._closing = False
        self._busy = threading.Lock()
        self._thread = threading.Thread(target=self._carry, name="recorder", daemon=True)
        self._thread.start()

    @property
    def inlet(self) -> str:
        """Path whose writer writes into the file; to be opened once."""
        return f"/dev/fd/{self._inlet}"

    def inlet_taken(self) -> None:
        """Say that the writer has opened the inlet and holds it alone from now on."""
        os.close(self._inlet)

    def check(self) -> None:
        """Raise RunError if a write has failed; what came before it is in the file."""
        if self._error is not None:
            raise RunError(
                f"{self._path}: recording stopped ({self._error.strerror}); make room or record elsewhere. "
                "What was recorded until then can be read"
            ) from self._error

    def drain(self, timeout_s: float) -> None:
        """Wait until what the writer has written is in the file.

        Raises
        ------
        RunError
            If a write has failed or the file takes longer than that.
        """
        deadline = time.monotonic() + timeout_s
        waiting = array.array("i", [0])
        while time.monotonic() < deadline:
            self.check()
            if self._busy.acquire(timeout=_POLL_S):
                try:
                    fcntl.ioctl(self._outlet, termios.FIONREAD, waiting)
                finally:
                    self._busy.release()
                if waiting[0] == 0:
                    self.check()
                    return
                time.sleep(_DRAIN_POLL_S)
        raise RunError(f"{self._path}: the disk takes no more data; record elsewhere")

    def close(self) -> None:
        """Carry what is left and close the file; the writer must have closed its end.

        Raises
        ------
        RunError
            If a write has failed.
        """
        self.abandon()
        self.check()

    def abandon(self) -> None:
        """Close the file without a word about what could not be written."""
        self._closing = True
        self._thread.join()
        os.close(self._outlet)
        self._file.close()

    def _carry(self) -> None:
        # A process forked meanwhile may hold the pipe open, so an end of file need not come: hence `_closing`.
        synced, dirty = time.monotonic(), False
        while True:
            closing = (
                self._closing
            )  # before looking: what the writer wrote until then is then still to be seen
            due = max(0.0, synced + SYNC_S - time.monotonic()) if dirty else _POLL_S
            ready, _, _ = select.select([self._outlet], [], [], due)
            since = time.monotonic() - synced
            if dirty and since >= (2.0 * SYNC_S if ready else SYNC_S):
                self._sync()
                synced, dirty = time.monotonic(), False
            if not ready:
                if closing:
                    break
                continue
            with self._busy:
                data = memoryview(os.read(self._outlet, _PIPE_BYTES))
                if not data:
                    break
                # After an error the pipe is still emptied: the writer must never wait.
                while data and self._error is None:
                    try:
                        done = self._file.write(data)
                    except OSError as error:
                        self._error = error
                    else:
                        data = data[done:]
                        self.written += done
                        dirty = True
        self._sync()

    def _sync(self) -> None:
        if self._error is not None:
            return
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # no disk: a device, a pipe
                self._error = error


def _sync_folder(folder: Path) -> None:
    """Have the disk keep the entry of a new file; where folders cannot be opened, that is its own affair."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
