"""Writes a file of each format that is read in parts, reads it block by block, and says what memory that took.

``python read_large_files.py FOLDER ROWS``, two channels of 8 bytes a row; a line of JSON for each format.
"""

import io
import json
import resource
import struct
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyuff
from nptdms import ChannelObject, TdmsWriter

from twin.plant.blocks import Channel
from twin.rig.foreign import open_foreign
from twin.rig.writers import _dataset_58

FS, PART = 50_000.0, 250_000
CHANNELS = ("acceleration", "g"), ("push", "V")
VALUES = np.random.default_rng(0).standard_normal((PART, 2))


def columns() -> list[np.ndarray]:
    return [np.ascontiguousarray(VALUES[:, k]) for k in range(2)]


def tdms(path: Path, parts: int) -> None:
    with TdmsWriter(path) as file:
        for _ in range(parts):
            named = zip(CHANNELS, columns(), strict=True)
            file.write_segment([ChannelObject("g", n, c, {"unit_string": u}) for (n, u), c in named])


def parquet(path: Path, parts: int) -> None:
    fields = [pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in CHANNELS]
    table = pa.table(columns(), schema=pa.schema(fields))
    with pq.ParquetWriter(path, table.schema, compression="none", use_dictionary=False) as file:
        for _ in range(parts):
            file.write_table(table, row_group_size=PART)


def mat(path: Path, parts: int) -> None:
    with h5py.File(path, "w") as file:
        for (name, unit), column in zip(CHANNELS, columns(), strict=True):
            dataset = file.create_dataset(name, (1, parts * PART), "<f8", chunks=(1, 1 << 16))
            dataset.attrs["MATLAB_class"], dataset.attrs["unit"] = np.bytes_("double"), np.bytes_(unit)
            for k in range(parts):
                dataset[0, k * PART : (k + 1) * PART] = column


def npz(path: Path, parts: int) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (parts * PART,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as file:
        for (name, _), column in zip(CHANNELS, columns(), strict=True):
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                member.write(header.getvalue())
                for _ in range(parts):
                    member.write(column.tobytes())


def wav(path: Path, parts: int) -> None:
    size = 16 * parts * PART
    layout = struct.pack("<4sIHHIIHH", b"fmt ", 16, 3, 2, int(FS), int(FS) * 16, 16, 64)
    lengths = struct.pack("<4sIQQQI", b"ds64", 28, size + 72, size, parts * PART, 0)
    with path.open("wb") as file:
        file.write(b"RF64\xff\xff\xff\xffWAVE" + lengths + layout + b"data\xff\xff\xff\xff")
        for _ in range(parts):
            file.write(VALUES.tobytes())


def uff(path: Path, parts: int) -> None:
    """What pyuff writes of a hundred samples, with the two places changed that say how many there are."""
    with path.open("wb") as file, warnings.catch_warnings(action="ignore"):
        for k, (named, column) in enumerate(zip(CHANNELS, columns(), strict=True)):
            small = path.with_suffix(f".small{k}")
            pyuff.UFF(str(small)).write_sets(_dataset_58(k, Channel(*named), column[:100], FS), "add")
            lines = small.read_bytes().splitlines(True)[:13]
            lines[1] = lines[1].replace(b"%12d" % 800, b"%12d" % (8 * parts * PART))
            lines[8] = lines[8].replace(b"%10d" % 100, b"%10d" % (parts * PART), 1)
            file.write(b"".join(lines))
            for _ in range(parts):
                file.write(column.tobytes())
            file.write(b"\n    -1\n")


def csv(path: Path, parts: int) -> None:
    text = "\n".join(f"{a!r},{b!r}" for a, b in VALUES[:10_000].tolist()) + "\n"
    with path.open("w") as file:
        file.write("acceleration [g],push [V]\n")
        for _ in range(parts * PART // 10_000 // 3):  # text is slow, and three times as long
            file.write(text)


WRITE: dict[str, Callable[[Path, int], None]] = {
    "tdms": tdms, "parquet": parquet, "mat": mat, "npz": npz, "wav": wav, "uff": uff, "csv": csv,
}  # fmt: skip


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main(folder: Path, rows: int) -> None:
    from test_archives import PLANT

    warnings.simplefilter("ignore")
    for ending, write in WRITE.items():
        path = folder / f"large.{ending}"
        write(path, rows // PART)
        before, n = peak_mb(), 0
        named = {"acceleration": "channel1:g", "push": "channel2:V"} if ending == "wav" else {}
        recording = open_foreign(path, PLANT, sample_rate_hz=FS, channels=named)
        for block in recording.blocks():
            n += block.n_samples
        recording.close()
        size = path.stat().st_size / 1e6
        path.unlink()
        print(
            json.dumps(
                {"format": ending, "file_mb": size, "rows": n, "before_mb": before, "peak_mb": peak_mb()}
            )
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
