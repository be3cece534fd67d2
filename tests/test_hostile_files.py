"""Files that are damaged, made to do harm, or larger than memory: read in parts, or refused in words."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import rerun as rr
import scipy.io
from fuzz_reader import OWN
from nptdms import ChannelObject, TdmsWriter
from test_archives import ACCELERATION, FORMATS, FS, PLANT, PUSH, T, joined

from twin.plant.errors import InputError
from twin.rig.archives.base import free_memory
from twin.rig.foreign import open_foreign
from twin.station.opened import ReplayOptions, open_any

HERE = Path(__file__).parent
CASES = 45
KINDS = [*FORMATS, OWN]


def in_a_process(script: str, *arguments: object) -> tuple[int, list[list[str]], str]:
    command = [sys.executable, str(HERE / script), *map(str, arguments)]
    path = os.pathsep.join([str(HERE), str(HERE.parent)])
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
        env=os.environ | {"PYTHONPATH": path},
    )
    return done.returncode, [json.loads(line) for line in done.stdout.splitlines()], done.stderr


@pytest.mark.parametrize("kinds", [KINDS[0::3], KINDS[1::3], KINDS[2::3]], ids="+".join)
def test_damaged_files_are_read_or_refused_in_words_and_end_no_process(
    kinds: list[str], tmp_path: Path
) -> None:
    code, lines, errors = in_a_process("fuzz_reader.py", tmp_path, 20260, CASES, *kinds)
    assert code == 0, (lines[-1:], errors[-2000:])
    found = [line for line in lines if len(line) == 3]
    wrong = [line for line in found if line[2] != "read" and not line[2].startswith("refused: ")]
    assert wrong == []
    for kind in kinds:
        outcomes = [line[2] for line in found if line[0] == kind]
        assert sum(o != "read" for o in outcomes) >= 5, kind


def test_files_larger_than_the_memory_they_are_read_in(tmp_path: Path) -> None:
    code, lines, errors = in_a_process("read_large_files.py", tmp_path, 9_000_000)
    assert code == 0, errors[-2000:]
    assert [line["format"] for line in lines] == ["tdms", "parquet", "mat", "npz", "wav", "uff", "csv"]  # type: ignore[call-overload]
    start = lines[0]["before_mb"]  # type: ignore[call-overload]
    for line in lines:
        taken = line["peak_mb"] - start  # type: ignore[call-overload]
        assert line["file_mb"] > 110.0  # type: ignore[call-overload]
        assert taken < 110.0, line


@pytest.mark.parametrize("kind", ["mat v5", "uff as text", "rrd", "npz"])
def test_what_can_only_be_read_whole_is_refused_with_its_size_before_it_fills_the_memory(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = FORMATS[kind](tmp_path)
    if kind == "npz":
        np.savez(path, time=T, data=np.asfortranarray(np.column_stack([ACCELERATION, PUSH])))
        monkeypatch.setattr("twin.rig.archives.numpy_zip.WHOLE_BYTES", 100)
    monkeypatch.setattr("twin.rig.archives.base.free_memory", lambda: 10_000)
    options = {"acceleration": "data[:,0]:g", "push": "data[:,1]:V"} if kind == "npz" else {}
    with pytest.raises(
        InputError, match=r"can only be had whole.* takes .* GB, with .* GB of memory free; \w+"
    ):
        open_foreign(path, PLANT, sample_rate_hz=FS, channels=options)


def test_memory_that_is_free_is_that_of_the_limit_too() -> None:
    code = (
        "import resource, psutil\n"
        "from twin.rig.archives.base import free_memory\n"
        "most = psutil.Process().memory_info().vms + 300_000_000\n"
        "resource.setrlimit(resource.RLIMIT_AS, (most, most))\n"
        "assert 200_000_000 < free_memory() <= 300_000_000, free_memory()\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=HERE.parent)
    assert free_memory() > 0


# --- made to do harm --------------------------------------------------------------------------------------------


def refused(path: Path, **options: str) -> str:
    with pytest.raises(InputError) as error:
        list(open_foreign(path, PLANT, sample_rate_hz=FS, channels=options).blocks())
    return str(error.value)


def test_zip_bomb_is_refused_by_what_it_claims(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as file, file.open("acceleration.npy", "w") as member:
        np.lib.format.write_array_header_1_0(  # 72 MB of nothing in a few hundred bytes
            member, {"descr": "<f8", "fortran_order": False, "shape": (9_000_000,)}
        )
        for _ in range(72):
            member.write(bytes(1_000_000))
    assert path.stat().st_size < 2000
    assert "claims 0.072 GB in a file of" in refused(path, push="none", acceleration="acceleration:g")


def test_array_that_claims_more_than_its_member_holds_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "claims.npz"
    with zipfile.ZipFile(path, "w") as file, file.open("acceleration.npy", "w") as member:
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
        )
        member.write(bytes(800))
    assert "claims 8000000000000 bytes" in refused(path, push="none", acceleration="acceleration:g")


def test_objects_are_not_unpickled(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[object, ...]:
            return os.system, (f"touch {tmp_path / 'harm'}",)

    path = tmp_path / "pickle.npz"
    np.savez(path, acceleration=np.array([Harm()] * 5, dtype=object), push=PUSH)
    assert "Python objects, which are never loaded" in refused(
        path, push="none", acceleration="acceleration:g"
    )
    assert not (tmp_path / "harm").exists()


def test_hdf5_leads_to_no_other_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["acceleration"] = ACCELERATION
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["acceleration"] = h5py.ExternalLink(str(secret), "acceleration")
        file["push"] = PUSH
    assert "no array 'acceleration' in the file" in refused(
        path, acceleration="acceleration:g", push="push:V"
    )
    for kind in ("raw", "virtual"):
        path = tmp_path / f"{kind}.h5"
        with h5py.File(path, "w") as file:
            if kind == "raw":
                file.create_dataset("acceleration", (100,), "f8", external=[(str(secret), 0, 800)])
            else:
                layout = h5py.VirtualLayout((N_VIRTUAL,), "f8")
                layout[:] = h5py.VirtualSource(str(secret), "acceleration", (N_VIRTUAL,))
                file.create_virtual_dataset("acceleration", layout)
        assert "lies in other files, which are not followed" in refused(path, acceleration="acceleration:g")


N_VIRTUAL = len(ACCELERATION)


def test_hdf5_that_claims_petabytes_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("acceleration", (10**14,), "f8", chunks=(1000,))
    assert "claims 8e+05 GB in a file of" in refused(path, acceleration="acceleration:g", push="none")


def test_header_of_a_matlab_file_that_claims_a_terabyte_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    scipy.io.savemat(path, {"acceleration": ACCELERATION[:, None], "push": PUSH[:, None]})
    content = bytearray(path.read_bytes())
    at = content.index(len(ACCELERATION).to_bytes(4, "little"))
    content[at : at + 4] = (2**31 - 1).to_bytes(4, "little")
    path.write_bytes(content)
    said = refused(path, acceleration="acceleration:g", push="none")
    assert "claims 17.2 GB" in said


@pytest.mark.parametrize("name", ["run.json", "run.toml"])
def test_sidecar_nested_without_end_is_refused(name: str, tmp_path: Path) -> None:
    path = FORMATS["csv"](tmp_path)
    deep = "[" * 100_000
    (tmp_path / name).write_text(deep if name.endswith("json") else f"channels = {deep}")
    assert f"{name}: not valid" in refused(path)


def test_table_of_a_million_columns_is_refused_and_one_of_thousands_read(tmp_path: Path) -> None:
    path = tmp_path / "wide.csv"
    for n, readable in ((5_000, True), (1_000_000, False)):
        head = ",".join(["acceleration [g]", "push [V]", *(f"c{k}" for k in range(n))])
        path.write_text(f"{head}\n" + f"{','.join(['1.5'] * (n + 2))}\n" * 2)
        if readable:
            np.testing.assert_allclose(open_foreign(path, PLANT, sample_rate_hz=FS).values[:, 1], 1.5)
        else:
            assert "no recording has so many columns" in refused(path)


def test_a_wave_file_that_was_never_finished_is_read_to_its_end(tmp_path: Path) -> None:
    path = FORMATS["wav 24 bit"](tmp_path)
    content = bytearray(path.read_bytes())
    at = content.index(b"data") + 4
    for length in (0, 0xFFFFFFFF):  # as recorders leave it that were killed
        content[at : at + 4] = length.to_bytes(4, "little")
        path.write_bytes(content)
        assert open_foreign(path, PLANT).n_samples == len(ACCELERATION)


def test_integers_of_a_wave_file_need_somebody_to_say_what_full_scale_is(tmp_path: Path) -> None:
    path = FORMATS["wav 24 bit"](tmp_path)
    path.with_suffix(".toml").unlink()
    said = refused(path, acceleration="channel1:g", push="channel2:10 V")
    assert "shares of the converter's full scale" in said
    assert "--channel 'acceleration=channel1:50 g'" in said


# --- channels that do not begin together, Rerun files of others ------------------------------------------------


def test_channels_that_begin_at_different_instants_are_not_put_side_by_side(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    begin = np.datetime64("2024-01-01T00:00:00.000000")
    for late_us, fits in (
        (2_000, True),
        (40_000, False),
    ):  # less than half a sample of 5 ms, and eight samples
        with TdmsWriter(path) as file:
            for name, unit, values, late in (
                ("acceleration", "g", ACCELERATION, 0),
                ("push", "V", PUSH, late_us),
            ):
                stated = {
                    "wf_increment": 1.0 / FS, "unit_string": unit,
                    "wf_start_time": begin + np.timedelta64(late, "us"),
                }  # fmt: skip
                file.write_segment([ChannelObject("run", name, values, stated)])
        if fits:
            assert open_foreign(path, PLANT).n_samples == len(T)
        else:
            with pytest.raises(InputError, match=r"'push' begins 0\.04 s after 'acceleration'"):
                open_foreign(path, PLANT)


def rerun_file(path: Path, **series: tuple[np.ndarray, np.ndarray]) -> Path:
    stream = rr.RecordingStream("somebody_else")
    stream.save(path)
    for name, (stamps, values) in series.items():
        stream.send_columns(
            name, [rr.TimeColumn("time", duration=stamps)], rr.Scalars.columns(scalars=values)
        )
    stream.flush()
    stream.disconnect()
    return path


def test_rerun_file_of_others_is_replayed_as_anybodys_recording(tmp_path: Path) -> None:
    path = rerun_file(tmp_path / "beam.rrd", **{"laser/tip": (T, 1e3 * PUSH), "amplifier": (T, PUSH)})
    with pytest.raises(InputError, match=r"is no recording of this program.*--plant"):
        open_any(path, ReplayOptions())
    options = ReplayOptions(
        plant="beam", channels={"tip_displacement": "laser/tip:um", "piezo": "amplifier:V"}
    )
    opened = open_any(path, options)
    np.testing.assert_allclose(joined(list(opened.blocks()))[:, 0], 1e-3 * PUSH, rtol=1e-12)
    assert opened.sample_rate_hz == pytest.approx(FS)


def test_entities_of_a_rerun_file_have_their_own_rates_or_must_be_even(tmp_path: Path) -> None:
    path = rerun_file(tmp_path / "run.rrd", acceleration=(T, ACCELERATION), push=(T[::4], PUSH[::4]))
    recording = open_foreign(path, PLANT, channels={"acceleration": "acceleration:g", "push": "push:V"})
    assert "push: one sample in 4; masked between" in recording.notes
    uneven = np.sort(np.random.default_rng(1).uniform(0.0, 5.0, len(T)))
    path = rerun_file(tmp_path / "uneven.rrd", acceleration=(T, ACCELERATION), push=(uneven, PUSH))
    assert "entity 'push' is not logged at even instants" in refused(path, acceleration="acceleration:g")
