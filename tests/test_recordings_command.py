"""atmd recordings: list, show, verify, repair, export; and what is exported read back in every format."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, make_block
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.foreign import open_foreign
from twin.rig.programme import rig_channels
from twin.rig.recorded import open_recording
from twin.rig.recording import Recorder
from twin.rig.storage import Storage
from twin.rig.writers import WRITERS
from twin.station.cli import app

PLANT = load_plant("rig")
CHANNELS = rig_channels(PLANT)
FS, BLOCK, BLOCKS = 5_000.0, 500, 8
RUN = CliRunner()


def block(k: int) -> Block:
    t = (k * BLOCK + np.arange(BLOCK))[:, None] / FS
    values = np.sin(2.0 * np.pi * 50.0 * t + np.arange(len(CHANNELS))).astype(np.float32).astype(float)
    if k == 2:
        values[10:20, 1] = np.nan
    return make_block(k * BLOCK, FS, values, CHANNELS, config_id=PLANT.fingerprint, control_on=True)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "runs" / "one.rrd"
    with Recorder(
        path, plant=PLANT, sample_rate_hz=FS, channels=CHANNELS, run_config_json='{"a": 1}', seed=7
    ) as out:
        for k in range(BLOCKS):
            if k != 5:  # lost on the way
                out.write_block(block(k))
        out.write_command(Command(command_id=1, apply_at_sample=1000, control_enabled=False))
        answer = Acknowledgement(command_id=1, accepted=True, applied_at_sample=1000)
        out.write_acknowledgement(answer, 1499)
        out.write_note(
            "events", 700, json.dumps({"sample": 700, "level": "warning", "text": "something odd"})
        )
    return path


def run(*arguments: object, code: int = 0) -> str:
    done = RUN.invoke(app, ["recordings", *map(str, arguments)])
    assert done.exit_code == code, done.output
    return done.stdout


def test_list_names_every_recording_and_why_one_cannot_be_read(recording: Path) -> None:
    (recording.parent / "junk.rrd").write_bytes(b"no recording")
    rows = json.loads(run("list", recording.parent, "--json", "-"))["recordings"]
    by_name = {Path(row["file"]).name: row for row in rows}
    assert by_name["one.rrd"]["plant"] == "rig"
    assert by_name["one.rrd"]["seconds"] == pytest.approx(0.8)
    assert by_name["one.rrd"]["commands"] == 1
    assert "is no Rerun recording" in by_name["junk.rrd"]["remark"]


def test_show_tells_what_happened_when(recording: Path) -> None:
    shown = json.loads(run("show", recording, "--json", "-"))
    assert shown["config_id"] == PLANT.fingerprint
    assert shown["seed"] == 7
    assert shown["run_config"] == {"a": 1}
    assert shown["acknowledgements"][0]["applied_at_sample"] == 1000
    assert shown["channels"][0] == {"name": "table_acceleration", "unit": "m/s²"}
    text = run("show", recording)
    assert "something odd" in text
    assert "command 1 accepted" in text


def test_verify_finds_gaps_and_masked_samples_in_a_whole_recording(recording: Path) -> None:
    (row,) = json.loads(run("verify", recording, "--json", "-"))["files"]
    assert row["whole"]
    assert row["good_blocks"] == row["blocks"] == BLOCKS - 1
    assert row["gaps"] == [[5 * BLOCK, BLOCK]]
    assert row["masked_samples"] == 10


def test_recording_that_was_cut_short_is_found_and_repaired_to_its_last_whole_block(
    recording: Path, tmp_path: Path
) -> None:
    content = recording.read_bytes()
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(content[: int(0.8 * len(content))])
    (row,) = json.loads(run("verify", cut, "--json", "-", code=1))["files"]
    assert not row["whole"]
    assert "cut short" in row["damage"][0]
    out = tmp_path / "whole.rrd"
    run("repair", cut, "--out", out)
    assert cut.read_bytes() == content[: int(0.8 * len(content))]
    (row,) = json.loads(run("verify", out, "--json", "-"))["files"]
    assert row["whole"]
    assert 1 <= row["good_blocks"] < BLOCKS
    for saved in open_recording(out).blocks():
        np.testing.assert_array_equal(saved.values, block(saved.first_sample // BLOCK).values)
    done = RUN.invoke(app, ["recordings", "repair", str(cut), "--out", str(out)])
    assert isinstance(done.exception, InputError)


def test_damaged_block_is_left_out_by_repair_and_nothing_half_is_exported(
    recording: Path, tmp_path: Path
) -> None:
    content = bytearray(recording.read_bytes())
    at = content.index(block(3).values.astype("<f4").tobytes()[:64])
    content[at + 5] ^= 0x40
    recording.write_bytes(content)
    (row,) = json.loads(run("verify", recording, "--json", "-", code=1))["files"]
    assert "sample 1500 (0.300 s) is damaged" in row["damage"][0]
    out = tmp_path / "half.npz"
    done = RUN.invoke(app, ["recordings", "export", str(recording), "--out", str(out)])
    assert "atmd recordings repair" in str(done.exception)
    assert not out.exists()
    assert not out.with_suffix(".toml").exists()
    run("repair", recording, "--out", tmp_path / "whole.rrd")
    (row,) = json.loads(run("verify", tmp_path / "whole.rrd", "--json", "-"))["files"]
    assert row["whole"]
    assert row["gaps"] == [[3 * BLOCK, BLOCK], [5 * BLOCK, BLOCK]]
    assert len(json.loads(run("show", tmp_path / "whole.rrd", "--json", "-"))["events"]) == 1


def test_a_run_in_several_files_is_listed_once_and_repaired_as_one(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    with Recorder(
        path, plant=PLANT, sample_rate_hz=FS, channels=CHANNELS, run_config_json="{}", seed=7,
        storage=Storage(rotate_s=0.25, keep_free_bytes=0),
    ) as recorder:  # fmt: skip
        for k in range(BLOCKS):
            recorder.write_block(block(k))
    (row,) = json.loads(run("list", tmp_path, "--json", "-"))["recordings"]
    files = list(tmp_path.glob("*.rrd"))
    assert row["remark"] == f"in {len(files)} files"
    assert row["bytes"] == sum(f.stat().st_size for f in files)
    run("repair", path, "--out", tmp_path / "copy.rrd")
    again = open_recording(tmp_path / "copy.rrd")
    assert len(again.parts) == len(files) > 1
    assert again.n_blocks == BLOCKS


@pytest.mark.parametrize("ending", WRITERS)
def test_what_is_exported_reads_back_the_same_in_every_format(
    recording: Path, tmp_path: Path, ending: str
) -> None:
    out = tmp_path / f"copy{ending}"
    if ending == ".uff":
        done = RUN.invoke(app, ["recordings", "export", str(recording), "--out", str(out)])
        assert "a universal file cannot say so" in str(done.exception)
        run("export", recording, "--out", out, "--to", 0.2)
        np.testing.assert_array_equal(
            open_foreign(out, PLANT).values, np.concatenate([block(0).values, block(1).values])
        )
        return
    run("export", recording, "--out", out)
    again = open_foreign(out, PLANT)
    assert again.sample_rate_hz == pytest.approx(FS, rel=1e-6)
    assert again.n_samples == BLOCKS * BLOCK
    columns = [[c.name for c in again.channels].index(c.name) for c in CHANNELS]
    expected = np.concatenate(
        [np.where(b.valid, b.values, np.nan) for b in (block(k) for k in range(BLOCKS))]
    )
    expected[5 * BLOCK : 6 * BLOCK] = np.nan
    np.testing.assert_allclose(again.values[:, columns], expected, rtol=1e-12)  # float32 to begin with
    assert again.channels[columns[0]].unit == "m/s²"
    again.close()


@pytest.mark.parametrize("ending", WRITERS)
def test_every_bit_of_64_bit_samples_survives_every_format(tmp_path: Path, ending: str) -> None:
    path, out = tmp_path / "one.rrd", tmp_path / f"copy{ending}"
    values = np.random.default_rng(3).standard_normal((2000, len(CHANNELS))) * np.pi
    with Recorder(
        path, plant=PLANT, sample_rate_hz=FS, channels=CHANNELS, run_config_json="{}", seed=None
    ) as recorder:
        for k in range(4):
            recorder.write_block(make_block(500 * k, FS, values[500 * k : 500 * k + 500], CHANNELS))
    run("export", path, "--out", out)
    again = open_foreign(out, PLANT)
    columns = [[c.name for c in again.channels].index(c.name) for c in CHANNELS]
    np.testing.assert_array_equal(again.values[:, columns], values)
    assert again.sample_rate_hz == pytest.approx(FS, rel=1e-9)
    assert again.guesses == ()  # names, units and rate all travel with it
    again.close()


def test_wave_files_beyond_what_their_head_can_say_are_written_in_the_long_form(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    short, long = tmp_path / "short.wav", tmp_path / "long.wav"
    run("export", recording, "--out", short)
    monkeypatch.setattr("twin.rig.writers.LONGEST_WAVE", 1000)
    run("export", recording, "--out", long)
    assert (short.read_bytes()[:4], long.read_bytes()[:4]) == (b"RIFF", b"RF64")
    np.testing.assert_array_equal(open_foreign(short, PLANT).values, open_foreign(long, PLANT).values)


def test_part_of_a_recording_is_exported_and_never_over_another_file(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.csv"
    run("export", recording, "--out", out, "--from", 0.15, "--to", 0.35)
    part = open_foreign(out, PLANT)
    assert part.n_samples == 1000
    expected = np.concatenate([block(k).values for k in range(4)])[750:1750]
    columns = [[c.name for c in part.channels].index(c.name) for c in CHANNELS]
    valid = ~np.isnan(part.values[:, columns])
    np.testing.assert_array_equal(part.values[:, columns][valid], expected[valid])
    for arguments in (
        ["--out", out],
        ["--out", tmp_path / "a.xyz"],
        ["--out", tmp_path / "b.csv", "--from", 99],
    ):
        done = RUN.invoke(app, ["recordings", "export", str(recording), *map(str, arguments)])
        assert isinstance(done.exception, InputError)
