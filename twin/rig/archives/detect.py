"""Which format a file has: by what it begins with, not by what it is called."""

from collections.abc import Callable
from pathlib import Path

from twin.plant.errors import InputError
from twin.rig.archives.base import Archive

KNOWN = ".npz, .tdms, .mat, .h5, .csv (and other text tables), .parquet, .uff, .wav, .rrd"


def open_archive(path: Path) -> Archive:
    """Open a file of measured data, whatever its format.

    Raises
    ------
    InputError
        If it cannot be read, or is of none of the known formats.
    """
    try:
        with path.open("rb") as file:
            start = file.read(1024)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; check the path") from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: is a directory; give a file in it") from error
    except PermissionError as error:
        raise InputError(f"{path}: may not be read (permission denied); check its owner and mode") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error}); check the path") from error
    if not start:
        raise InputError(f"{path}: is empty; copy or export the recording again")
    return _opener(path, start)(path)


def _opener(path: Path, start: bytes) -> Callable[[Path], Archive]:
    """The reader for what a file begins with; each is loaded only when it is wanted."""
    if start.startswith(b"PK"):
        from twin.rig.archives.numpy_zip import NumpyArchive

        return NumpyArchive
    if start.startswith(b"\x93NUMPY"):
        raise InputError(
            f"{path}: is a single .npy array, not an .npz; save it with numpy.savez(path, name=array)"
        )
    if start.startswith(b"TDSm"):
        from twin.rig.archives.tdms import TdmsArchive

        return TdmsArchive
    if start.startswith(b"PAR1"):
        from twin.rig.archives.parquet import ParquetArchive

        return ParquetArchive
    if start[:4] in (b"RIFF", b"RIFX", b"RF64"):
        from twin.rig.archives.wave import WaveArchive

        return WaveArchive
    if start.startswith(b"RRF"):
        from twin.rig.archives.rerun_file import RerunArchive

        return RerunArchive
    hdf = b"\x89HDF\r\n\x1a\n"
    if start.startswith(hdf) or start[512:520] == hdf or start.startswith(b"MATLAB 7.3"):
        from twin.rig.archives.matlab import HdfArchive

        return HdfArchive
    if start.startswith(b"MATLAB 5.0") or (
        path.suffix.lower() == ".mat" and start[124:128][2:] in (b"IM", b"MI")
    ):
        from twin.rig.archives.matlab import Mat5Archive

        return Mat5Archive
    if start.lstrip(b" ")[:2] == b"-1" and b"\n" in start and start.split(b"\n")[1].strip()[:2].isdigit():
        from twin.rig.archives.universal import UniversalArchive

        return UniversalArchive
    binary = b"\0" in start and not start.startswith((b"\xff\xfe", b"\xfe\xff"))
    if binary:
        raise InputError(f"{path}: is of no known format; recordings are read from {KNOWN}")
    from twin.rig.archives.text import TextArchive

    return TextArchive
