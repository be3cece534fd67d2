"""A walk through an HDF5 file, for a process of its own: a damaged one may crash or trap the library that reads it.

``python -m twin.rig.archives.hdf_walk FILE`` visits everything that `twin.rig.archives.matlab.HdfArchive` will ask for,
and ends with 0 if that went well.
"""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py

SECONDS = 20.0
DEPTH = 8
ROWS = 4096


def datasets(group: h5py.Group, prefix: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Datasets of numbers with their paths; MATLAB's own bookkeeping and what links lead to elsewhere is left out."""
    for name in group:
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue  # no link leads out of the file or round in circles
        item = group[name]
        if isinstance(item, h5py.Group):
            if prefix.count("/") < DEPTH:
                yield from datasets(item, f"{prefix}{name}/")
        elif isinstance(item, h5py.Dataset) and item.dtype.kind in "fiu" and item.shape:
            yield f"{prefix}{name}", item


def elsewhere(dataset: h5py.Dataset) -> bool:
    """Whether the samples of a dataset lie in other files."""
    return bool(dataset.external) or bool(dataset.is_virtual)


def survives(path: Path) -> str:
    """What befell a process that walked through the file: nothing, or why it should not be opened here."""
    command = [sys.executable, "-m", "twin.rig.archives.hdf_walk", str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    except subprocess.TimeoutExpired:
        return "it leads round in circles"
    except OSError:
        return ""  # no process to be had: as well as we can, then
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return lines[-1] if lines and done.returncode > 0 else "the library that reads it crashes over it"


def main(path: str) -> None:
    """Visit names, attributes, shapes, and the first and last rows of every dataset."""
    with h5py.File(path, "r") as file:
        for _, dataset in datasets(file):
            for key in ("MATLAB_class", "unit", "units"):
                dataset.attrs.get(key)
            if not elsewhere(dataset) and dataset.ndim == 1:
                dataset[:ROWS]
                dataset[-ROWS:]


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except Exception as error:
        sys.exit(f"{error}")
