"""Every format of recordings: what was written comes back, in parts as at once; what is damaged is refused in words."""

import inspect
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import pyuff
import rerun as rr
import scipy.io
import scipy.io.wavfile
from nptdms import ChannelObject, TdmsWriter

from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.plant.files import parse_toml
from twin.plant.linear import Array
from twin.rig.archives.detect import open_archive
from twin.rig.archives.numpy_zip import NumpyArchive
from twin.rig.foreign import open_foreign

FS = 200.0
N = 1000
PLANT = parse_toml(
    """
name = "mass"
[[body]]
name = "body"
mass_kg = 1.0
attached_to = "ground"
stiffness_n_m = 100.0
damping_ns_m = 0.1
[[actuator]]
name = "push"
kind = "force"
on = "body"
force_constant_n_v = 1.0
[[sensor]]
name = "acceleration"
kind = "acceleration"
of = "body"
noise_density = 1e-3
""",
    Plant,
    "test",
)
T = np.arange(N) / FS
ACCELERATION = np.round(np.sin(7.0 * T) + 0.1 * np.cos(31.0 * T), 6)  # in g
PUSH = np.round(0.5 * np.cos(3.0 * T), 6)  # in V

Write = Callable[[Path], Path]


def _npz(folder: Path) -> Path:
    path = folder / "run.npz"
    np.savez_compressed(path, time=T, acceleration=ACCELERATION, push=PUSH)
    (folder / "run.json").write_text('{"channels": {"acceleration": "g measured"}}')
    return path


def _mat5(folder: Path) -> Path:
    path = folder / "run.mat"
    scipy.io.savemat(
        path, {"time": T, "acceleration": ACCELERATION[:, None], "push": PUSH, "note": "by hand"}
    )
    (folder / "run.json").write_text('{"channels": {"acceleration": "g measured"}}')
    return path


def _mat73(folder: Path) -> Path:
    path = folder / "run73.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in (("time", T), ("acceleration", ACCELERATION), ("push", PUSH)):
            file.create_dataset(name, data=values[None, :]).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("text", data=np.zeros(3, np.uint16)).attrs["MATLAB_class"] = np.bytes_("char")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by a test".ljust(512, b" "))
    (folder / "run73.json").write_text('{"channels": {"acceleration": "g measured"}}')
    return path


def _csv(folder: Path) -> Path:
    path = folder / "run.csv"
    rows = "\n".join(f"{t:.4f},{a:.6f},{p:.6f}" for t, a, p in zip(T, ACCELERATION, PUSH, strict=True))
    path.write_text(f"# a test\ntime [s],acceleration [g],push [V]\n{rows}\n")
    return path


def _german(folder: Path) -> Path:
    path = folder / "lauf.txt"
    rows = "\n".join(f"{t:.4f};{a:.6f};{p:.6f}" for t, a, p in zip(T, ACCELERATION, PUSH, strict=True))
    text = f"Prüfstand\ntime;acceleration;push\ns;g;V\n{rows.replace('.', ',')}\n"
    path.write_bytes(text.encode("latin-1"))
    return path


def _parquet(folder: Path) -> Path:
    path = folder / "run.parquet"
    fields = [
        pa.field("time", pa.float64(), metadata={"unit": "s"}),
        pa.field("acceleration", pa.float64(), metadata={"unit": "g"}),
        pa.field("push", pa.float64(), metadata={"unit": "V"}),
    ]
    pq.write_table(pa.table([T, ACCELERATION, PUSH], schema=pa.schema(fields)), path, row_group_size=300)
    return path


def _tdms(folder: Path) -> Path:
    path = folder / "run.tdms"
    step = {"wf_increment": 1.0 / FS}
    with TdmsWriter(path) as writer:
        for part in (slice(0, 600), slice(600, N)):  # two segments, as a rig that writes as it goes
            writer.write_segment(
                [
                    ChannelObject("run", "acceleration", ACCELERATION[part], step | {"unit_string": "g"}),
                    ChannelObject("run", "push", PUSH[part], step | {"unit_string": "V"}),
                ]
            )
    return path


def _uff(folder: Path) -> Path:
    path = folder / "run.uff"
    for name, values, unit in (("acceleration", ACCELERATION, "g"), ("push", PUSH, "V")):
        names = inspect.signature(pyuff.prepare_58).parameters
        dataset = {key: 0 for key in names if key.endswith(("_exp", "data_type", "_node", "_dir"))} | {
            key: "NONE" for key in names if key.endswith(("_lab", "_name")) or key.startswith("id")
        }
        dataset |= {
            "type": 58, "binary": 1, "func_type": 1, "ver_num": 0, "load_case_id": 0, "ord_data_type": 4,
            "z_axis_value": 0.0, "abscissa_spacing": 1, "abscissa_min": 0.0, "abscissa_inc": 1.0 / FS, "id1": name,
            "ordinate_axis_units_lab": unit, "data": values, "x": T,
        }  # fmt: skip
        with warnings.catch_warnings(action="ignore"):
            pyuff.UFF(str(path)).write_sets(dataset, "add")
    return path


def _uff_text(folder: Path) -> Path:
    path = _uff(folder)
    sets = pyuff.UFF(str(path)).read_sets()
    path.unlink()
    for dataset in sets:
        with warnings.catch_warnings(action="ignore"):
            pyuff.UFF(str(path)).write_sets(dataset | {"binary": 0}, "add")
    return path


def _mat7(folder: Path) -> Path:
    path = _mat5(folder)
    scipy.io.savemat(path, {"time": T, "acceleration": ACCELERATION, "push": PUSH}, do_compression=True)
    return path


def _hdf5(folder: Path) -> Path:
    path = folder / "run.h5"
    with h5py.File(path, "w") as file:
        for name, values, unit in (
            ("time", T, "s"),
            ("acceleration", ACCELERATION, "g"),
            ("push", PUSH, "V"),
        ):
            file.create_dataset(name, data=values, chunks=(300,), compression="gzip", shuffle=True)
            file[name].attrs["unit"] = unit
    return path


def _rrd(folder: Path) -> Path:
    path = folder / "run.rrd"
    stream = rr.RecordingStream("somebody_else")
    stream.save(path)
    for part in (slice(600, N), slice(0, 600)):  # not in order
        stamps = [rr.TimeColumn("time", duration=T[part])]
        for name, values in (("acceleration", ACCELERATION), ("push", PUSH)):
            stream.send_columns(name, stamps, rr.Scalars.columns(scalars=values[part]))
    stream.log("remark", rr.TextLog("not a series"))
    stream.flush()
    stream.disconnect()
    (folder / "run.json").write_text('{"channels": {"acceleration": "g measured"}}')
    return path


def _wav_of_integers(folder: Path) -> Path:
    path = folder / "run.wav"
    full = np.column_stack([ACCELERATION / 2.0, PUSH / 10.0]) * 2.0**31
    three = full.astype(">i4").view(np.uint8).reshape(-1, 4)[:, :3]  # 24 bits, of which there is no such type
    data = three[:, ::-1].tobytes()
    layout = struct.pack("<4sIHHIIHH", b"fmt ", 16, 1, 2, int(FS), int(FS) * 6, 6, 24)
    chunks = (
        b"WAVE"
        + layout
        + b"LIST"
        + struct.pack("<I", 3)
        + b"odd\0"
        + b"data"
        + struct.pack("<I", len(data))
        + data
    )
    path.write_bytes(b"RIFF" + struct.pack("<I", len(chunks)) + chunks)
    (folder / "run.toml").write_text(
        '[channels]\nacceleration = { array = "channel1", unit = "g", scale = 2.0 }\n'
        'push = { array = "channel2", unit = "V", scale = 10.0 }\n'
    )
    return path


def _wav(folder: Path) -> Path:
    path = folder / "run.wav"
    scipy.io.wavfile.write(path, int(FS), np.column_stack([ACCELERATION, PUSH]).astype(np.float32))
    (folder / "run.toml").write_text('[channels]\nacceleration = "channel1:g"\npush = "channel2:V"\n')
    return path


FORMATS: dict[str, Write] = {
    "npz": _npz, "mat v5": _mat5, "mat v7.3": _mat73, "csv": _csv, "text": _german, "parquet": _parquet,
    "tdms": _tdms, "uff": _uff, "uff as text": _uff_text, "wav": _wav, "wav 24 bit": _wav_of_integers, "mat v7": _mat7,
    "hdf5": _hdf5, "rrd": _rrd,
}  # fmt: skip


@pytest.fixture(params=FORMATS, ids=str)
def written(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return FORMATS[request.param](tmp_path)


def joined(blocks: list[Block]) -> Array:
    return np.concatenate([b.values for b in blocks])


def test_what_was_written_comes_back_in_si_units(written: Path) -> None:
    recording = open_foreign(written, PLANT)
    assert recording.sample_rate_hz == pytest.approx(FS, rel=1e-6)
    assert recording.n_samples == N
    blocks = list(recording.blocks())
    assert [b.first_sample for b in blocks] == list(range(0, N, 20))
    assert all(b.valid.all() for b in blocks)
    expected = np.column_stack([ACCELERATION * 9.80665, PUSH])
    np.testing.assert_allclose(joined(blocks), expected, atol=3e-6)
    np.testing.assert_array_equal(recording.values, joined(blocks))
    np.testing.assert_array_equal(joined(list(recording.blocks())), joined(blocks))  # a second time
    assert all("g -> m/s²" in str(m) or "V -> V" in str(m) for m in recording.mapping)
    recording.close()


def test_arrays_are_read_in_parts_as_at_once(written: Path) -> None:
    archive = open_archive(written)
    name = archive.names[-1]
    whole = archive.read(name)
    assert archive.shape(name) == (N,)
    for first, stop in ((0, 10), (990, 1000), (250, 750), (0, N), (5, 5)):
        np.testing.assert_array_equal(archive.read(name, first, stop), whole[first:stop])
    chunks = list(archive.chunks(archive.names, 333))
    for each in archive.names:
        together = np.concatenate([chunk[each] for chunk in chunks])
        np.testing.assert_array_equal(together, archive.read(each))
    archive.close()


def test_file_is_known_by_its_content_whatever_it_is_called(written: Path, tmp_path: Path) -> None:
    folder = tmp_path / "renamed"
    folder.mkdir()
    renamed = folder / "recording.dat"
    renamed.write_bytes(written.read_bytes())
    assert open_archive(renamed).format == open_archive(written).format


# --- time that is not even, channels that are not alike ------------------------------------------------------


def test_rows_that_are_missing_by_their_stamps_are_masked_where_they_belong(tmp_path: Path) -> None:
    keep = np.ones(N, bool)
    keep[100:137] = keep[500] = keep[998] = False
    path = tmp_path / "run.csv"
    rows = "\n".join(
        f"{t:.4f},{a},{p}" for t, a, p in zip(T[keep], ACCELERATION[keep], PUSH[keep], strict=True)
    )
    path.write_text(f"time,acceleration,push\n{rows}\n")
    recording = open_foreign(path, PLANT)
    assert recording.sample_rate_hz == pytest.approx(FS)
    assert recording.n_samples == N
    assert any("39 samples are missing in 3 gaps and masked" in note for note in recording.notes)
    blocks = list(recording.blocks())
    assert [b.first_sample for b in blocks] == list(range(0, N, 20))
    valid = np.concatenate([b.valid for b in blocks])
    np.testing.assert_array_equal(valid.all(axis=1), keep)
    np.testing.assert_allclose(joined(blocks)[keep, 0], ACCELERATION[keep])


@pytest.mark.parametrize(
    "stamps",
    [
        np.sort(np.random.default_rng(1).uniform(0.0, 5.0, N)),
        np.round(T, 2),
        T[::-1],
        np.where(T > 2.0, T + 0.0021, T),
    ],
    ids=["irregular", "repeating", "backwards", "slipped"],
)
def test_stamps_that_are_no_clock_are_refused_unless_a_rate_is_given(tmp_path: Path, stamps: Array) -> None:
    path = tmp_path / "run.npz"
    np.savez(path, time=stamps, acceleration=ACCELERATION, push=PUSH)
    with pytest.raises(InputError, match=r"is not evenly spaced.*--sample-rate HZ"):
        open_foreign(path, PLANT)
    assert open_foreign(path, PLANT, sample_rate_hz=FS).n_samples == N


def test_slower_channel_has_its_samples_where_they_were_taken_and_is_masked_between(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject("a", "acceleration", ACCELERATION, {"wf_increment": 1.0 / FS}),
                ChannelObject("b", "push", PUSH[::4], {"wf_increment": 4.0 / FS}),
            ]
        )
    recording = open_foreign(path, PLANT)
    assert "push: one sample in 4; masked between" in recording.notes
    blocks = list(recording.blocks())
    valid = np.concatenate([b.valid for b in blocks])
    assert valid[:, 0].all()
    np.testing.assert_array_equal(valid[:, 1], np.arange(N) % 4 == 0)
    np.testing.assert_allclose(joined(blocks)[::4, 1], PUSH[::4])


def test_rates_that_do_not_divide_are_refused_with_both_numbers(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    with TdmsWriter(path) as writer:
        writer.write_segment(
            [
                ChannelObject("a", "acceleration", ACCELERATION, {"wf_increment": 1.0 / FS}),
                ChannelObject("b", "push", PUSH, {"wf_increment": 1.0 / 90.0}),
            ]
        )
    with pytest.raises(InputError, match="'push' was sampled at 90 Hz, which does not divide 200 Hz"):
        open_foreign(path, PLANT)


def test_cells_that_are_empty_or_no_number_are_missing_samples(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text("acceleration,push\n1.0,2.0\n,3.0\nNaN,inf\n4.0,\n")
    block = next(open_foreign(path, PLANT, sample_rate_hz=1.0, block_s=10.0).blocks())
    assert block.valid.tolist() == [[True, True], [False, True], [False, False], [True, False]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("acceleration,push\n1.0,2.0\n1.0,2.0,3.0\n", "a row of 3 cells, where there should be 2"),
        ("acceleration,push\n1.0,2.0\nbroken,2.0\n", "column 'acceleration'.*broken"),
        ("acceleration push\n1 2\n", "columns are separated by neither"),
    ],
)
def test_table_that_is_no_table_says_where(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "run.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        list(open_foreign(path, PLANT, sample_rate_hz=1.0).blocks())


def test_numbers_in_the_other_byte_order_are_recognised(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    swapped = ACCELERATION.astype(np.float32).view(np.uint32).byteswap().view(np.float32)
    np.savez(path, acceleration=swapped, push=PUSH)
    with pytest.raises(InputError, match="in the other byte order"):
        open_foreign(path, PLANT, sample_rate_hz=FS)
    np.savez(path, acceleration=ACCELERATION.astype(">f4"), push=PUSH)  # said so: read as it is
    np.testing.assert_allclose(
        open_foreign(path, PLANT, sample_rate_hz=FS).values[:, 0], ACCELERATION, atol=1e-6
    )


def test_integers_of_a_wave_file_are_shares_of_full_scale(tmp_path: Path) -> None:
    path = tmp_path / "run.wav"
    for dtype, full in ((np.int16, 2**15), (np.int32, 2**31)):
        scipy.io.wavfile.write(path, int(FS), np.array([0, full // 2, -full, full - 1], dtype))
        read = open_archive(path).read("channel1")
        np.testing.assert_allclose(read, [0.0, 0.5, -1.0, 1.0], atol=1e-4)


def test_large_arrays_of_a_numpy_archive_are_never_held_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.rig.archives.numpy_zip.WHOLE_BYTES", 1000)
    path = _npz(tmp_path)
    archive = NumpyArchive(path)

    def never(*_: object) -> None:
        raise AssertionError("was read whole")

    monkeypatch.setattr(NumpyArchive, "_at_once", never)
    np.testing.assert_array_equal(archive.read("push", 100, 900), PUSH[100:900])
    np.testing.assert_array_equal(archive.read("push", 50, 60), PUSH[50:60])  # back again
    np.testing.assert_allclose(open_foreign(path, PLANT).values[:, 1], PUSH)
    archive.close()


def test_matrix_of_matlab_73_lies_as_matlab_shows_it(tmp_path: Path) -> None:
    path = tmp_path / "m.mat"
    matrix = np.column_stack([ACCELERATION, PUSH])
    with h5py.File(path, "w") as file:
        file.create_dataset("data", data=matrix.T).attrs["MATLAB_class"] = np.bytes_("double")
    recording = open_foreign(
        path, PLANT, sample_rate_hz=FS, channels={"acceleration": "data[:,0]", "push": "data[:,1]"}
    )
    np.testing.assert_array_equal(recording.values, matrix)


def test_mat_file_without_numbers_says_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"run": {"acceleration": ACCELERATION}})
    with pytest.raises(InputError, match=r"only run \(struct\)"):
        open_foreign(path, PLANT)


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.bin"
    path.write_bytes(struct.pack("<100d", *range(100)))
    with pytest.raises(InputError, match=r"of no known format; recordings are read from \.npz"):
        open_foreign(path, PLANT)
