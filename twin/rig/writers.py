"""A recording's channels written in other people's formats, a part at a time; what is missing becomes NaN."""

import io
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pyuff
from nptdms import ChannelObject, TdmsWriter

from twin.plant.blocks import Block, Channel
from twin.plant.errors import InputError, RunError
from twin.plant.linear import Array
from twin.rig.archives.base import guard_memory

PART_ROWS = 1 << 18
TABLE_TIME = "time"
WAVE_OF_FLOATS, LONG_WAVE, LONGEST_WAVE = 3, 0xFFFFFFFF, 0xFFFFFFFF - 64


class Series:
    """Blocks as one gapless table of rows, which may be gone through several times.

    Parameters
    ----------
    channels, sample_rate_hz
        Of the blocks.
    blocks
        Gives them anew, front to back, at every call.
    """

    def __init__(
        self, channels: Sequence[Channel], sample_rate_hz: float, blocks: Callable[[], Iterator[Block]]
    ) -> None:
        self.channels = tuple(channels)
        self.sample_rate_hz = sample_rate_hz
        self._blocks = blocks

    def parts(self) -> Iterator[tuple[int, Array]]:
        """First sample and (n, n_channels) values of consecutive parts; NaN where no valid sample is."""
        following: int | None = None
        for block in self._blocks():
            while following is not None and block.first_sample > following:
                n = min(block.first_sample - following, PART_ROWS)
                yield following, np.full((n, len(self.channels)), np.nan)
                following += n
            yield block.first_sample, np.where(block.valid, block.values, np.nan)
            following = block.end_sample


Writer = Callable[[Path, Series], None]


def write_csv(path: Path, series: Series) -> None:
    """Comma-separated text with a headline of names and units, 17 digits: every bit survives."""
    schema = _schema(series, "{name} [{unit}]")
    with pacsv.CSVWriter(path, schema) as file:
        for batch in _batches(series, schema):
            file.write_batch(batch)


def write_parquet(path: Path, series: Series) -> None:
    """Parquet, units in the fields' metadata."""
    schema = _schema(series, "{name}")
    with pq.ParquetWriter(path, schema, compression="zstd") as file:
        for batch in _batches(series, schema):
            file.write_batch(batch)


def write_tdms(path: Path, series: Series) -> None:
    """LabVIEW TDMS, one group, a segment a part."""
    step = {"wf_increment": 1.0 / series.sample_rate_hz, "wf_start_offset": 0.0}
    with TdmsWriter(path) as file:
        for _, values in series.parts():
            file.write_segment(
                [
                    ChannelObject(
                        "recording",
                        c.name,
                        np.ascontiguousarray(values[:, k]),
                        step | {"unit_string": c.unit},
                    )
                    for k, c in enumerate(series.channels)
                ]
            )


def write_npz(path: Path, series: Series) -> None:
    """NumPy ``.npz``, one array a channel, with a sidecar for rate and units."""
    length = _length(series)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, allowZip64=True, compresslevel=1) as archive:
        for k, channel in enumerate(series.channels):
            with archive.open(f"{channel.name}.npy", "w", force_zip64=True) as member:
                header = io.BytesIO()
                layout = {"descr": "<f8", "fortran_order": False, "shape": (length,)}
                np.lib.format.write_array_header_1_0(header, layout)
                member.write(header.getvalue())
                for _, values in series.parts():
                    member.write(np.ascontiguousarray(values[:, k], "<f8").tobytes())
    _write_sidecar(path, series, [c.name for c in series.channels])


def write_mat(path: Path, series: Series) -> None:
    """MATLAB v7.3, one column vector a channel, with a sidecar for rate and units."""
    length = _length(series)
    with h5py.File(path, "w", userblock_size=512) as file:
        sets = []
        for channel in series.channels:
            dataset = file.create_dataset(channel.name, (1, length), "<f8", chunks=(1, min(length, 1 << 16)))
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
            sets.append(dataset)
        at = 0
        for _, values in series.parts():
            for k, dataset in enumerate(sets):
                dataset[0, at : at + len(values)] = values[:, k]
            at += len(values)
    # What MATLAB looks for before it looks for HDF5: text, version, byte order.
    head = b"MATLAB 7.3 MAT-file, Platform: any, Created by: atmd, HDF5 schema 1.00 .".ljust(116) + bytes(8)
    with path.open("r+b") as plain:
        plain.write(head + b"\x00\x02IM")
    _write_sidecar(path, series, [c.name for c in series.channels])


def write_wav(path: Path, series: Series) -> None:
    """WAV of floats, with a sidecar for names and units; rates are whole numbers there.

    32 bits a sample where no bit is lost by it, else 64; RF64 from 4 GB on.
    """
    rate = round(series.sample_rate_hz)
    if abs(rate - series.sample_rate_hz) > 1e-9 * rate:
        raise InputError(f"{path}: a WAV file's rate is a whole number of Hz, not {series.sample_rate_hz:g}")
    length, short = 0, True
    for _, values in series.parts():
        length += len(values)
        with np.errstate(over="ignore"):
            short &= bool(np.array_equal(values.astype(np.float32), values, equal_nan=True))
    width, n = (4 if short else 8), len(series.channels)
    size = length * n * width
    layout = struct.pack(
        "<4sIHHIIHH", b"fmt ", 16, WAVE_OF_FLOATS, n, rate, rate * n * width, n * width, 8 * width
    )
    if size < LONGEST_WAVE:
        head = b"RIFF" + struct.pack("<I", size + 36) + b"WAVE" + layout + b"data" + struct.pack("<I", size)
    else:
        lengths = struct.pack("<4sIQQQI", b"ds64", 28, size + 72, size, length, 0)
        head = (
            b"RF64"
            + struct.pack("<I", LONG_WAVE)
            + b"WAVE"
            + lengths
            + layout
            + b"data"
            + struct.pack("<I", LONG_WAVE)
        )
    with path.open("wb") as file:
        file.write(head)
        for _, values in series.parts():
            file.write(np.ascontiguousarray(values, f"<f{width}").tobytes())
    _write_sidecar(path, series, [f"channel{k + 1}" for k in range(n)])


def write_uff(path: Path, series: Series) -> None:
    """Universal file, one binary dataset 58 a channel; it has no way to say that a sample is missing."""
    length = missing = 0
    for _, values in series.parts():
        length += len(values)
        missing += int(values.size - np.isfinite(values).sum())
    if missing:
        raise InputError(
            f"{path}: {missing} samples are missing and a universal file cannot say so; "
            "export a part without gaps (--from, --to), or as .tdms"
        )
    # What writes it wants a whole channel, and a time for every sample, and takes copies of both.
    guard_memory(
        path, f"{length} samples of a channel", 6 * 8 * length, "export as .tdms, which is written in parts"
    )
    path.unlink(missing_ok=True)
    file = pyuff.UFF(str(path))
    with warnings.catch_warnings(
        action="ignore", category=ResourceWarning
    ):  # it leaves its file to the collector
        for k, channel in enumerate(series.channels):
            values = np.concatenate([part[:, k] for _, part in series.parts()])
            file.write_sets(_dataset_58(k, channel, values, series.sample_rate_hz), "add")


def _dataset_58(k: int, channel: Channel, values: Array, rate_hz: float) -> dict[str, object]:
    texts: dict[str, object] = dict.fromkeys(
        (*(f"id{n}" for n in range(2, 6)), *(f"{who}_ent_name" for who in ("rsp", "ref")),
         *(f"{axis}_axis_units_lab" for axis in ("orddenom", "z_axis"))),
        "NONE",
    )  # fmt: skip
    numbers: dict[str, object] = {
        f"{axis}_{what}": 0
        for axis in ("abscissa", "ordinate", "orddenom", "z_axis")
        for what in ("spec_data_type", "len_unit_exp", "force_unit_exp", "temp_unit_exp")
    }
    return texts | numbers | {
        "type": 58, "binary": 1, "func_type": 1, "ver_num": 0, "load_case_id": 0, "ord_data_type": 4,
        "rsp_node": k + 1, "rsp_dir": 1, "ref_node": 0, "ref_dir": 0, "z_axis_value": 0.0,
        "abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": 1.0 / rate_hz, "abscissa_axis_units_lab": "s",
        "ordinate_axis_units_lab": channel.unit.replace("²", "^2"), "id1": channel.name,
        "data": values, "x": np.arange(len(values)) / rate_hz,
    }  # fmt: skip


WRITERS: dict[str, Writer] = {
    ".csv": write_csv, ".parquet": write_parquet, ".tdms": write_tdms, ".npz": write_npz, ".mat": write_mat,
    ".wav": write_wav, ".uff": write_uff,
}  # fmt: skip


def write_series(path: Path, series: Series) -> None:
    """Write a recording in the format that the file's name asks for.

    Raises
    ------
    InputError
        If the format is not known, or the file is there already.
    RunError
        If it cannot be written.
    """
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path}: cannot write '{path.suffix}'; known: {', '.join(WRITERS)}")
    if path.exists():
        raise InputError(f"{path}: is there already; choose another name or remove it first")
    if not path.absolute().parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.absolute().parent}; make it first")
    sidecar = path.with_suffix(".toml")
    had_sidecar = sidecar.exists()
    try:
        writer(path, series)
    except BaseException as error:  # half a file would be taken for a whole one
        path.unlink(missing_ok=True)
        if not had_sidecar:
            sidecar.unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise RunError(
            f"{path}: cannot be written ({error.strerror or error}); make room or write elsewhere"
        ) from error


def _length(series: Series) -> int:
    return sum(len(values) for _, values in series.parts())


def _schema(series: Series, form: str) -> pa.Schema:
    columns = [Channel(TABLE_TIME, "s"), *series.channels]
    return pa.schema(
        [
            pa.field(form.format(name=c.name, unit=c.unit), pa.float64(), metadata={"unit": c.unit})
            for c in columns
        ]
    )


def _batches(series: Series, schema: pa.Schema) -> Iterator[pa.RecordBatch]:
    for first, values in series.parts():
        time_s = (first + np.arange(len(values))) / series.sample_rate_hz
        columns = [time_s, *values.T]
        yield pa.RecordBatch.from_arrays([pa.array(c, from_pandas=True) for c in columns], schema=schema)


def _write_sidecar(path: Path, series: Series, arrays: Sequence[str]) -> None:
    lines = [f"sample_rate_hz = {float(series.sample_rate_hz)!r}", "", "[channels]"]
    lines += [f'{c.name} = "{array}:{c.unit}"' for c, array in zip(series.channels, arrays, strict=True)]
    path.with_suffix(".toml").write_text("\n".join(lines) + "\n", encoding="utf-8")
