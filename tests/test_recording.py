"""What was recorded comes back to the bit, whatever happened to the recorder."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant
from twin.rig.recorded import HELD_BYTES, Recording, open_recording
from twin.rig.recording import Recorder
from twin.rig.regroup import in_pieces, mark_of, restored
from twin.rig.rrf import Extent, extent
from twin.rig.storage import Storage, part_path, storage

RATE = 50_000.0
CHANNELS = (Channel("table_acceleration", "m/s²"), Channel("vcm_current", "A"), Channel("shaker", "V"))


def a_recorder(
    path: Path, channels: tuple[Channel, ...] = CHANNELS, storage: Storage | None = None
) -> Recorder:
    return Recorder(
        path,
        plant=load_plant("rig"),
        sample_rate_hz=RATE,
        channels=channels,
        run_config_json='{"run": "µ"}',
        seed=7,
        storage=storage or Storage(keep_free_bytes=0),
        software={"program": "test"},
    )


def a_block(first: int, n: int = 500, seed: int = 0) -> Block:
    values = np.random.default_rng([seed, first]).standard_normal((n, 3)).astype(np.float32)
    return make_block(first, RATE, values, CHANNELS, config_id="c")


def a_run(path: Path, n_blocks: int = 20) -> list[Block]:
    blocks = [a_block(k * 500) for k in range(n_blocks)]
    with a_recorder(path) as recorder:
        for block in blocks:
            recorder.write_block(block)
    return blocks


def assert_same_block(a: Block, b: Block) -> None:
    assert a.values.tobytes() == b.values.tobytes()
    assert np.array_equal(a.valid, b.valid)
    assert not b.values.flags.writeable
    assert not b.valid.flags.writeable
    for name in ("first_sample", "sample_rate_hz", "channels", "config_id", "control_on", "commands_applied"):
        assert getattr(a, name) == getattr(b, name), name


@st.composite
def blocks(draw: st.DrawFn) -> list[Block]:
    found, first = [], draw(st.integers(0, 2**40))
    exact = draw(st.booleans())
    for _ in range(draw(st.integers(0, 4))):
        n = draw(st.integers(0, 40))
        rng = np.random.default_rng(draw(st.integers(0, 2**32)))
        values = rng.standard_normal((n, 3)) * 10.0 ** rng.integers(-44, 300 if not exact else 30)
        if exact:
            values = values.astype(np.float32)
        values[rng.random((n, 3)) < draw(st.sampled_from([0.0, 0.3, 1.0]))] = np.nan
        found.append(
            make_block(
                first,
                RATE,
                values,
                CHANNELS,
                config_id=draw(st.text(max_size=8)),
                control_on=draw(st.sampled_from([None, False, True])),
                commands_applied=tuple(draw(st.lists(st.integers(1, 2**40), max_size=3))),
            )
        )
        first += n + draw(st.integers(1, 100))
    return found


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(written=blocks())
def test_blocks_come_back_to_the_bit(tmp_path: Path, written: list[Block]) -> None:
    path = tmp_path / "run.rrd"
    path.unlink(missing_ok=True)
    with a_recorder(path) as recorder:
        for block in written:
            recorder.write_block(block)
    read = list(open_recording(path).blocks())
    assert len(read) == len(written)
    for a, b in zip(written, read, strict=True):
        assert_same_block(a, b)


def test_the_description_of_the_run_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "new" / "run.rrd"
    a_run(path, 3)
    recording = open_recording(path)
    plant = load_plant("rig")
    assert recording.plant == plant
    assert recording.config_id == plant.fingerprint
    assert recording.sample_rate_hz == RATE
    assert recording.channels == CHANNELS
    assert recording.run_config_json == '{"run": "µ"}'
    assert recording.seed == 7
    assert recording.software == {"program": "test"}
    assert recording.finished
    assert (recording.n_samples, recording.n_blocks, recording.end_sample) == (1500, 3, 1500)
    assert not recording.repaired


def test_commands_answers_and_notes_keep_their_order_and_content(tmp_path: Path) -> None:
    schedule = GainSchedule(
        frequency_hz=(47.0, 53.0),
        alpha_kg=(0.0, 0.1),
        beta_ns_m=(1.0, 2.0),
        gamma_n_m=(-3.0, 1 / 3),
        low_pass_hz=(500.0, 500.0),
        high_pass_hz=(1.0, 1.0),
        on_from_hz=47.0,
        on_to_hz=53.0,
    )
    commands = (
        Command(command_id=1, apply_at_sample=500, schedule=schedule),
        Command(command_id=2, apply_at_sample=500, control_enabled=False),
    )
    answer = Acknowledgement(command_id=1, accepted=True, applied_at_sample=1000)
    with a_recorder(tmp_path / "run.rrd") as recorder:
        for command in commands:
            recorder.write_command(command)
        recorder.write_acknowledgement(answer, 1500)
        recorder.write_note("events", 700, '{"n": 2}')
        recorder.write_note("events", 700, '{"n": 1}')
        recorder.write_note("events", 0, '{"n": 0}')
        for name in ("raw", "no name", ""):
            with pytest.raises(ValueError, match="is no name"):
                recorder.write_note(name, 0, "{}")
    recording = open_recording(tmp_path / "run.rrd")
    assert recording.commands() == commands
    assert recording.acknowledgements() == ((1500, answer),)
    assert recording.notes("events") == ((0, '{"n": 0}'), (700, '{"n": 2}'), (700, '{"n": 1}'))
    assert recording.notes("decisions") == ()
    assert list(recording.blocks()) == []


def test_blocks_that_came_out_of_order_are_read_in_order(tmp_path: Path) -> None:
    with a_recorder(tmp_path / "run.rrd") as recorder:
        for first in (1000, 0, 500):
            recorder.write_block(a_block(first))
    assert [b.first_sample for b in open_recording(tmp_path / "run.rrd").blocks()] == [0, 500, 1000]


def test_series_to_look_at_share_the_file_and_do_not_disturb(tmp_path: Path) -> None:
    with a_recorder(tmp_path / "run.rrd") as recorder:
        recorder.stream.log("x", rr.Scalars(1.0))
        recorder.write_block(a_block(0))
        recorder.stream.send_columns(
            "y", [rr.TimeColumn("time", duration=[0.0, 1.0])], rr.Scalars.columns(scalars=[1.0, 2.0])
        )
    assert_same_block(a_block(0), *open_recording(tmp_path / "run.rrd").blocks())


def test_another_rate_or_another_channel_is_refused(tmp_path: Path) -> None:
    with a_recorder(tmp_path / "run.rrd") as recorder:
        with pytest.raises(ValueError, match="sample rate"):
            recorder.write_block(make_block(0, 1000.0, np.zeros((1, 3)), CHANNELS))
        with pytest.raises(ValueError, match="channels"):
            recorder.write_block(make_block(0, RATE, np.zeros((1, 1)), CHANNELS[:1]))


KILLS = 100
WRITER = """
import os, random, signal, struct, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_recording import Storage, a_block, a_recorder
folder, kills = Path(sys.argv[1]), int(sys.argv[3])
moments = random.Random(20260)
for k in range(kills):  # imports are done: each writer is a fork of this process, which itself writes nothing
    told, tell = os.pipe()
    n = moments.choice((1, 40, 500, 3000))
    child = os.fork()
    if child == 0:
        os.close(told)
        limits = Storage(rotate_bytes=60_000, keep_free_bytes=0) if k % 3 == 0 else None  # also between two files
        recorder = a_recorder(folder / f"{k}.rrd", storage=limits)
        i = 0
        while True:
            recorder.write_block(a_block(i * n, n))
            i += 1
            os.write(tell, struct.pack("<I", i))
    os.close(tell)
    words = os.read(told, 4) if moments.random() < 0.8 else b""  # some are killed before their first block
    time.sleep(moments.uniform(0.0, 0.12))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with os.fdopen(told, "rb") as pipe:
        words += pipe.read()
    taken = struct.unpack("<I", words[-4:])[0] if words else 0
    print(k, n, taken, flush=True)
"""


def test_whenever_a_recorder_is_killed_all_but_the_block_in_its_hands_comes_back(tmp_path: Path) -> None:
    here = Path(__file__).parent
    command = [sys.executable, "-c", WRITER, str(tmp_path), str(here), str(KILLS)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    lines = [tuple(map(int, line.split())) for line in done.stdout.splitlines()]
    assert len(lines) == KILLS
    began = 0
    for k, n, taken in lines:
        path = tmp_path / f"{k}.rrd"
        if taken == 0:  # killed before its first block was taken: there may be no description yet
            if path.exists() and path.stat().st_size:
                with contextlib.suppress(InputError):
                    assert open_recording(path).n_blocks <= 1
            continue
        began += 1
        recording = open_recording(path, hold_bytes=HELD_BYTES)
        read = list(recording.blocks())
        assert not recording.finished or k % 3 == 0  # killed between two files
        assert taken - 1 <= len(read) <= taken + 1, (
            k,
            n,
            taken,
        )  # + 1: written, and killed before it could say so
        for i, block in enumerate(read):
            assert_same_block(a_block(i * n, n), block)
    assert began > KILLS // 2


def test_a_recorder_that_was_killed_is_told_from_one_that_finished(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    a_run(path, 3)
    assert open_recording(path).finished
    found = extent(path)
    os.truncate(path, found.whole_bytes)
    assert extent(path) == Extent(found.whole_bytes, False, False)
    recording = open_recording(path)
    assert (recording.finished, recording.repaired, recording.n_blocks) == (False, False, 3)


@pytest.mark.parametrize("tail", [b"\0", b"\0" * 4096, b"\1\0\0\0\0\0\0\0", b"\xff" * 100])
def test_what_power_loss_leaves_behind_the_last_block_does_no_harm(tmp_path: Path, tail: bytes) -> None:
    path = tmp_path / "run.rrd"
    written = a_run(path, 5)
    os.truncate(path, extent(path).whole_bytes)
    with path.open("ab") as file:
        file.write(tail)
    recording = open_recording(path)
    assert recording.repaired
    for a, b in zip(written, recording.blocks(), strict=True):
        assert_same_block(a, b)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(written=blocks(), size=st.integers(1, 70))
def test_blocks_read_in_pieces_of_any_size_are_the_recorded_ones_again(
    tmp_path: Path, written: list[Block], size: int
) -> None:
    kept = [block for block in written if block.n_samples]
    pieces = list(in_pieces(kept, size))
    assert all(piece.n_samples <= size for piece in pieces)
    for a, b in zip(kept, restored(pieces, map(mark_of, kept)), strict=True):
        assert a.values.tobytes() == b.values.tobytes()
        assert np.array_equal(a.valid, b.valid)
        assert mark_of(a) == mark_of(b)


def test_pieces_with_a_hole_are_not_put_together(tmp_path: Path) -> None:
    written = [a_block(k * 500) for k in range(4)]
    pieces = list(in_pieces(written, 300))
    with pytest.raises(InputError, match="from 600 on are missing"):
        list(restored([*pieces[:2], *pieces[3:]], map(mark_of, written)))


def a_run_in_parts(path: Path, storage: Storage, n_blocks: int = 20) -> list[Block]:
    blocks = [a_block(k * 500) for k in range(n_blocks)]
    with a_recorder(path, storage=storage) as recorder:
        for k, block in enumerate(blocks):
            recorder.write_block(block)
            recorder.write_note("events", k * 500, json.dumps({"k": k}))
    return blocks


@pytest.mark.parametrize("limits", [Storage(rotate_s=0.045, keep_free_bytes=0), Storage(rotate_bytes=30_000)])
def test_a_run_in_several_files_is_read_as_one(tmp_path: Path, limits: Storage) -> None:
    path = tmp_path / "run.rrd"
    written = a_run_in_parts(path, limits)
    files = sorted(tmp_path.glob("*.rrd"))
    assert 3 <= len(files) < 20
    for named in (path, tmp_path):
        recording = open_recording(named)
        assert recording.parts == tuple(part_path(path, k + 1) for k in range(len(files)))
        assert [(m.first_sample, m.n_samples) for m in recording.marks] == [(k * 500, 500) for k in range(20)]
        assert recording.missing_parts == ()
        assert [s for s, _ in recording.notes("events")] == [k * 500 for k in range(20)]
        for a, b in zip(written, recording.blocks(), strict=True):
            assert_same_block(a, b)
    second = open_recording(part_path(path, 2))
    assert second.parts == (part_path(path, 2),)
    assert second.plant == recording.plant  # each file says what it is about


def test_a_missing_file_of_a_run_is_named_and_anothers_is_not_taken_for_it(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    a_run_in_parts(path, Storage(rotate_s=0.045))
    part_path(path, 3).unlink()
    (tmp_path / "else").mkdir()
    a_run(tmp_path / "else" / "other.rrd", 2)
    shutil.copy(tmp_path / "else" / "other.rrd", part_path(path, 3))
    recording = open_recording(path)
    assert recording.missing_parts == (3,)
    assert part_path(path, 3) not in recording.parts


def test_a_budget_ends_the_recording_whole_or_lets_the_oldest_files_go(tmp_path: Path) -> None:
    strict, ring = tmp_path / "strict.rrd", tmp_path / "ring.rrd"
    with pytest.raises(RunError, match=r"recording stopped: it has grown to .* of the 60 kB it may take"):
        a_run_in_parts(strict, Storage(budget_bytes=60_000))
    kept = open_recording(strict)
    assert kept.finished
    assert 3 < kept.n_blocks < 20
    assert_same_block(a_block(0), next(kept.blocks()))
    a_run_in_parts(ring, Storage(rotate_bytes=25_000, budget_bytes=80_000, drop_oldest=True), 60)
    files = sorted(tmp_path.glob("ring*.rrd"))
    assert sum(f.stat().st_size for f in files) < 100_000
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(ring)
    recording = open_recording(min(files, key=lambda f: int(f.stem.rpartition("part")[2])))
    assert recording.missing_parts[0] == 1
    assert recording.end_sample == 60 * 500
    for mark, block in zip(recording.marks, recording.blocks(), strict=True):
        assert_same_block(a_block(mark.first_sample), block)


def test_recording_ends_whole_before_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.rrd"
    left = iter([*[10**9] * 6, *[10**6] * 100])
    monkeypatch.setattr("twin.rig.recording.free_bytes", lambda _: next(left))
    with pytest.raises(RunError, match=r"the disk has 1 MB left, and 100 MB are to stay free"):
        a_run_in_parts(path, Storage())
    recording = open_recording(path)
    assert recording.finished
    assert recording.n_blocks == 5


def test_a_disk_without_room_is_refused_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.rig.recording.free_bytes", lambda _: 5_000_000)
    with pytest.raises(RunError, match="nothing was recorded"):
        a_recorder(tmp_path / "run.rrd", storage=Storage())
    assert not (tmp_path / "run.rrd").exists()


def test_sizes_and_times_are_read_as_people_write_them() -> None:
    assert storage("500MB", "20GB", drop_oldest=True) == Storage(500_000_000, None, 20 * 10**9, True)
    assert storage("10min", None) == Storage(None, 600.0)
    assert storage("1.5 GB, 2h", None) == Storage(1_500_000_000, 7200.0)
    assert storage(None, None) == Storage()
    for rotate, budget in (("ten", None), ("10", None), ("5 parsec", None), ("0s", None), (None, "10min")):
        with pytest.raises(InputError):
            storage(rotate, budget)
    with pytest.raises(InputError, match="if there are several"):
        storage(None, "1GB", drop_oldest=True)
    with pytest.raises(InputError, match="does not hold two files"):
        storage("1GB", "1GB")


@pytest.mark.parametrize("part", [0.37, 0.8, 0.999])
def test_a_file_cut_short_is_read_up_to_its_last_whole_block(tmp_path: Path, part: float) -> None:
    path = tmp_path / "run.rrd"
    written = a_run(path)
    size = path.stat().st_size
    os.truncate(path, int(size * part))
    recording = open_recording(path)
    read = list(recording.blocks())
    assert recording.repaired
    assert recording.n_blocks == len(read) >= int(part * 20) - 2
    for a, b in zip(written, read, strict=False):
        assert_same_block(a, b)


@pytest.mark.parametrize("size", [0, 3, 20, 300, 900])
def test_a_file_cut_before_its_first_block_says_so(tmp_path: Path, size: int) -> None:
    path = tmp_path / "run.rrd"
    a_run(path, 2)
    os.truncate(path, size)
    with pytest.raises(InputError, match=r"run\.rrd: "):
        open_recording(path)


def test_a_bit_that_fell_over_is_found(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    written = a_run(path)
    data = bytearray(path.read_bytes())
    place = data.index(written[10].values.astype("<f4").tobytes()[:64])
    data[place + 5] ^= 0x40
    path.write_bytes(data)
    blocks = open_recording(path).blocks()
    for block in written[:10]:
        assert_same_block(block, next(blocks))
    with pytest.raises(InputError, match=r"sample 5000 \(0\.100 s\) is damaged"):
        next(blocks)


def test_a_block_that_says_another_sample_than_its_time_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.rrd"
    with a_recorder(path) as recorder:
        recorder.write_block(a_block(0))
        # Both are written, and a number that fell over no longer belongs to its time.
        monkeypatch.setattr("twin.rig.recording.round", lambda ns: round(ns) + 20_000, raising=False)
        recorder.write_block(a_block(500))
    blocks = open_recording(path).blocks()
    assert_same_block(a_block(0), next(blocks))
    with pytest.raises(InputError, match=r"sample 500 .* is damaged"):
        next(blocks)


def test_damage_inside_a_file_costs_the_rows_it_hit_and_is_said(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    written = a_run(path)
    data = bytearray(path.read_bytes())
    at = data.index(written[7].values.astype("<f4").tobytes()[:64])
    data[at - 900 : at - 40] = bytes(860)  # what says where the rows of block 7 lie, and not the rows
    path.write_bytes(data)
    recording = open_recording(path)
    assert recording.repaired
    assert recording.damaged_rows == 1
    kept = list(recording.blocks())
    assert [b.first_sample // 500 for b in kept] == [k for k in range(20) if k != 7]
    for block in kept:
        assert_same_block(a_block(block.first_sample), block)


def test_a_recording_that_another_tool_rearranged_reads_the_same(tmp_path: Path) -> None:
    path, other = tmp_path / "run.rrd", tmp_path / "other.rrd"
    written = a_run(path)
    command = [sys.executable, "-m", "rerun", "rrd", "optimize", str(path), "-o", str(other)]
    subprocess.run(command, check=True, capture_output=True)
    for a, b in zip(written, open_recording(other).blocks(), strict=True):
        assert_same_block(a, b)


def test_files_that_are_no_recordings_are_refused_in_words(tmp_path: Path) -> None:
    foreign, text = tmp_path / "foreign.rrd", tmp_path / "text.rrd"
    stream = rr.RecordingStream("else")
    stream.save(foreign)
    stream.log("x", rr.Scalars(1.0))
    stream.disconnect()
    text.write_text("not a recording at all")
    for path in (foreign, text):
        with pytest.raises(InputError, match="give a file that 'atmd' recorded"):
            open_recording(path)
    with pytest.raises(InputError, match="cannot be read"):
        open_recording(tmp_path / "nothing.rrd")
    with pytest.raises(InputError, match=r"holds not one run but foreign\.rrd, text\.rrd"):
        open_recording(tmp_path)


def test_a_recording_is_not_overwritten_unless_told(tmp_path: Path) -> None:
    a_run(tmp_path / "run.rrd", 2)
    with pytest.raises(InputError, match="exists already"):
        a_recorder(tmp_path / "run.rrd")
    assert open_recording(tmp_path / "run.rrd").n_blocks == 2


@pytest.mark.parametrize("path", ["/proc/nothing/run.rrd", "/dev/null/run.rrd"])
def test_a_path_that_cannot_be_written_is_refused(path: str) -> None:
    with pytest.raises(InputError, match="cannot be created"):
        a_recorder(Path(path))


def full_disk(recorder: Recorder) -> None:
    for k in range(200):
        recorder.write_block(a_block(k * 500))
        recorder.flush()


def test_a_disk_that_is_full_from_the_start_is_reported() -> None:
    with pytest.raises(RunError, match="No space left on device"):
        Recorder(
            Path("/dev/full"),
            plant=load_plant("rig"),
            sample_rate_hz=RATE,
            channels=CHANNELS,
            run_config_json="{}",
            seed=None,
            overwrite=True,
            storage=Storage(keep_free_bytes=0),
        )


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("mount") is None, reason="needs root to mount a tmpfs")
def test_what_fitted_on_a_full_disk_can_be_read(tmp_path: Path) -> None:
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(tmp_path)], check=False)
    if mounted.returncode != 0:
        pytest.skip("tmpfs cannot be mounted here")
    try:
        recorder = a_recorder(tmp_path / "run.rrd")
        with pytest.raises(RunError, match="No space left on device"):
            full_disk(recorder)
        with pytest.raises(RunError):
            recorder.close()
        recording: Recording = open_recording(tmp_path / "run.rrd")
        assert recording.repaired
        assert recording.n_blocks > 20
        assert_same_block(a_block(0), next(recording.blocks()))
    finally:
        subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_disk_that_is_slow_to_confirm_costs_no_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The end of a run falls into the disk's confirmation of what came before it.
    confirm = os.fsync

    def slowly(handle: int) -> None:
        confirm(handle)
        time.sleep(0.3)

    path, recorder = tmp_path / "run.rrd", a_recorder(tmp_path / "run.rrd")
    recorder.write_block(a_block(0))
    monkeypatch.setattr(os, "fsync", slowly)
    recorder.flush()
    time.sleep(0.15)  # the confirmation has begun and is not over
    recorder.write_block(a_block(1))
    recorder.close()
    read = open_recording(path)
    assert read.finished
    assert read.n_blocks == 2


OUT_OF_ROOM = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_recording import RunError, a_block, a_recorder
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))  # as a quota, or a disk that is full
recorder = a_recorder(Path(sys.argv[1]))
try:
    for k in range(200):
        recorder.write_block(a_block(k * 500))
        print(k + 1, flush=True)
    raise SystemExit("it should have been told")
except RunError as error:
    print(error)
try:
    recorder.close()
except RunError:
    print("told again")
"""


def test_a_file_that_may_grow_no_further_costs_the_last_block_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    command = [sys.executable, "-c", OUT_OF_ROOM, str(path), str(Path(__file__).parent)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    *counts, said, again = done.stdout.splitlines()
    assert "recording stopped" in said
    assert "What was recorded until then can be read" in said
    assert again == "told again"
    recording = open_recording(path)
    read = list(recording.blocks())
    # The block in hand, and one that was taken while the disk said no.
    assert len(counts) - 1 <= len(read) <= len(counts)
    for k, block in enumerate(read):
        assert_same_block(a_block(k * 500), block)


WITHOUT_PIPES = """
import os, signal, sys
from pathlib import Path
sys.modules["fcntl"] = sys.modules["termios"] = None  # as on Windows: importing them fails
sys.path.insert(0, sys.argv[2])
from test_recording import Storage, a_block, a_recorder
from twin.rig import filesink
assert filesink.FilePipe is None
recorder = a_recorder(Path(sys.argv[1]), storage=Storage(rotate_bytes=60_000, keep_free_bytes=0))
for k in range(30):
    recorder.write_block(a_block(k * 500))
    recorder.write_note("events", k * 500, "{}")
if sys.argv[3] == "kill":
    os.kill(os.getpid(), signal.SIGKILL)
recorder.close()
"""


@pytest.mark.parametrize("end", ["close", "kill"])
def test_where_there_are_no_pipes_rerun_writes_the_file_itself(tmp_path: Path, end: str) -> None:
    path = tmp_path / "run.rrd"
    command = [sys.executable, "-c", WITHOUT_PIPES, str(path), str(Path(__file__).parent), end]
    subprocess.run(command, check=end == "close", capture_output=True)
    recording = open_recording(path)
    read = list(recording.blocks())
    assert len(recording.parts) > 2
    assert len(read) == 30 if end == "close" else len(read) >= 29
    for k, block in enumerate(read):
        assert_same_block(a_block(k * 500), block)
    assert recording.finished is (end == "close")


def test_a_run_whose_next_file_has_no_row_yet_is_read_up_to_there(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    written = a_run_in_parts(path, Storage(rotate_s=0.045))
    number = len(list(tmp_path.glob("*.rrd")))
    for content in (b"", b"RRF2" + bytes(8)):  # killed just after it was begun
        part_path(path, number + 1).write_bytes(content)
        recording = open_recording(path)
        assert not recording.finished
        assert len(recording.parts) == number
        for a, b in zip(written, recording.blocks(), strict=True):
            assert_same_block(a, b)


def test_closing_does_not_wait_for_a_forked_child(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path / "run.rrd")
    recorder.write_block(a_block(0))
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(30)"], close_fds=False)
    start = time.monotonic()
    recorder.close()
    assert time.monotonic() - start < 5.0
    child.kill()
    child.wait()
