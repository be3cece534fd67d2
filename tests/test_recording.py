"""What was recorded comes back to the bit, whatever happened to the recorder."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
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
from twin.rig.recorded import Recording, open_recording
from twin.rig.recording import Recorder

RATE = 50_000.0
CHANNELS = (Channel("table_acceleration", "m/s²"), Channel("vcm_current", "A"), Channel("shaker", "V"))


def a_recorder(path: Path, channels: tuple[Channel, ...] = CHANNELS) -> Recorder:
    return Recorder(
        path,
        plant=load_plant("rig"),
        sample_rate_hz=RATE,
        channels=channels,
        run_config_json='{"run": "µ"}',
        seed=7,
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


def test_a_killed_recorder_loses_one_block_at_most(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    script = textwrap.dedent(
        """
        import sys, time
        sys.path.insert(0, sys.argv[2])
        from pathlib import Path
        from test_recording import a_block, a_recorder
        recorder = a_recorder(Path(sys.argv[1]))
        for k in range(10_000):
            recorder.write_block(a_block(k * 500))
            print(k, flush=True)
            time.sleep(0.01)
        """
    )
    here = Path(__file__).parent
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(path), str(here)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    last = -1
    for line in process.stdout:
        last = int(line)
        if last >= 60:
            os.kill(process.pid, signal.SIGKILL)
            break
    rest = process.stdout.read().split()
    process.stdout.close()
    process.wait()
    last = int(rest[-1]) if rest else last
    read = list(open_recording(path).blocks())
    assert len(read) >= last  # of last + 1 that were written
    for k, block in enumerate(read):
        assert_same_block(a_block(k * 500), block)


@pytest.mark.parametrize("part", [0.35, 0.8, 0.999])
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
    for path in (tmp_path / "nothing.rrd", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            open_recording(path)


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


def test_closing_does_not_wait_for_a_forked_child(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path / "run.rrd")
    recorder.write_block(a_block(0))
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(30)"], close_fds=False)
    start = time.monotonic()
    recorder.close()
    assert time.monotonic() - start < 5.0
    child.kill()
    child.wait()
