"""What the views are given is what the frames hold, in the units their names say."""

import json
import subprocess
import sys
import threading
import time
import warnings
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from frames import BUDGET_W, RATE, channels, frames, schedule
from rerun.chunk import RrdReader

from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.rig.recorded import open_recording
from twin.station.curve_plot import HEIGHT, WIDTH, Axes, axes_for
from twin.station.frame import Frame
from twin.station.live import LiveView
from twin.station.rerun_view import RerunView, describe
from twin.station.view.pace import WATCHED, Pace

Rows = dict[str, list[tuple[float, object]]]


def a_view(stream: rr.RecordingStream, plant: Plant, pace: Pace = WATCHED) -> RerunView:
    return RerunView(
        stream,
        plant=plant,
        sample_rate_hz=RATE,
        channels=channels(plant),
        schedule=schedule(),
        pace=pace,
    )


def read_back(path: Path) -> dict[tuple[str, str], tuple[np.ndarray, list[object]]]:
    """(entity, component) -> times [s] and cells, by time; nan for static ones."""
    rows = defaultdict(list)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        chunks = RrdReader(path).stream().to_chunks()
    for chunk in chunks:
        batch = chunk.to_record_batch()
        names = batch.schema.names
        times = (
            np.array(batch.column("time").cast("int64")) * 1e-9
            if "time" in names
            else np.full(batch.num_rows, np.nan)
        )
        for name in names:
            if ":" in name:
                cells = batch.column(name).to_pylist()
                rows[chunk.entity_path, name] += list(zip(times.tolist(), cells, strict=True))
    found = {}
    for key, pairs in rows.items():
        ordered = sorted(pairs, key=lambda pair: pair[0])
        found[key] = (np.array([t for t, _ in ordered]), [c for _, c in ordered if c is not None])
    return found


@pytest.fixture(scope="module")
def plant() -> Plant:
    return load_plant("rig")


@pytest.fixture(scope="module")
def shown(plant: Plant, tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("view") / "view.rrd"
    stream = rr.RecordingStream("test")
    stream.save(path)
    view = a_view(stream, plant, replace(WATCHED, hold_blocks=3, hold_slow_blocks=4))
    made: list[Frame] = []
    for frame in frames(plant, 4.0):
        view.show(frame)
        made.append(frame)
    view.send()
    stream.disconnect()
    return made, read_back(path)


def test_waveforms_are_every_kth_sample_to_the_bit(plant: Plant, shown) -> None:
    made, rows = shown
    times, cells = rows["/waveform/table", "Scalars:scalars"]
    measured = np.concatenate([f.block.values[:, 0] for f in made])[::50]
    twin = np.concatenate([f.twin[:, 0] for f in made])[::50]
    assert np.array_equal(np.array(cells), np.column_stack([measured, twin]))
    assert np.allclose(times, np.arange(len(measured)) * 1e-3, atol=1e-9)


def test_decimation_keeps_its_step_across_blocks_of_any_length(plant: Plant, tmp_path: Path) -> None:
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "odd.rrd")
    view = a_view(stream, plant)
    for frame in frames(plant, 0.5, block=1237):
        view.show(frame)
    stream.disconnect()
    times, _ = read_back(tmp_path / "odd.rrd")["/waveform/table", "Scalars:scalars"]
    assert np.allclose(np.diff(times), 1e-3, atol=1e-9)


def test_missing_samples_are_gaps(shown) -> None:
    _, rows = shown
    _, cells = rows["/waveform/acceleration", "Scalars:scalars"]
    values = np.array(cells)
    assert np.isnan(values[:, 0]).sum() == 16  # samples 1666 to 2499 of the block, every 50th
    assert not np.isnan(values[:, 1]).any()


def test_slow_quantities_are_in_the_units_of_their_names(plant: Plant, shown) -> None:
    made, rows = shown
    times, cells = rows["/vibration", "Scalars:scalars"]
    p = made[-1].performance
    assert p is not None
    assert np.allclose(cells[-1], np.array([p.displacement_m, p.passive_m, p.limit_m]) * 1e6)
    assert times[-1] == pytest.approx(4.0)
    _, watts = rows["/power", "Scalars:scalars"]
    assert watts[-1][3] == BUDGET_W
    assert watts[-1][0] == p.powers.electrical_mean_w
    names = rows["/vibration", "SeriesLines:names"][1][0]
    assert all("[µm]" in name for name in names)


def test_bands_are_the_variances_of_the_estimates(shown) -> None:
    made, rows = shown
    _, variances = rows["/estimate/primary", "Measurements:variances"]
    _, values = rows["/estimate/primary", "Measurements:values"]
    assert np.sqrt(variances[0][0]) == pytest.approx(0.2)  # µm
    assert values[-1][0] == pytest.approx(made[-1].estimate.mean[-50, 0] * 1e6)
    _, stroke = rows["/estimate/stroke", "Measurements:variances"]
    assert np.sqrt(stroke[0][0]) == pytest.approx(np.hypot(2e-7, 4e-6) * 1e3)  # mm
    _, hz = rows["/excitation", "Measurements:variances"]
    assert np.sqrt(hz[0][0]) == pytest.approx(4e-3)


def test_damping_at_the_excitation_is_read_off_the_curve(shown) -> None:
    made, rows = shown
    frame = made[-1]
    assert frame.curve is not None
    assert frame.phasors is not None
    expected = np.interp(frame.phasors.frequency_hz, frame.curve.frequency_hz, frame.curve.damping_ns_m)
    _, values = rows["/damping/learned", "Measurements:values"]
    assert values[-1][0] == pytest.approx(expected)


def test_gains_change_when_the_rig_says_so_and_not_when_the_command_is_sent(shown) -> None:
    made, rows = shown
    times, cells = rows["/gains/beta_ns_m", "Scalars:scalars"]
    beta = np.array([c[0] for c in cells])
    answered = next(f for f in made if f.acknowledgements)
    before = times < answered.block.end_s - 1e-6
    for mask, scale in ((before, 1.0), (~before, 1.3)):
        hz = np.array([f.phasors.frequency_hz for f in made])[mask]
        assert np.allclose(beta[mask], [schedule(scale).at(f).beta_ns_m for f in hz])


def test_lanes_change_only_when_the_state_does(shown) -> None:
    _, rows = shown
    _, control = rows["/state/control", "StateChange:state"]
    assert [c[0] for c in control] == ["off", "on"]
    _, damping = rows["/state/damping", "StateChange:state"]
    assert [c[0] for c in damping] == ["unestimated", "learning", "estimated"]
    _, model = rows["/state/model", "StateChange:state"]
    assert [m[0] for m in model] == ["consistent", "diverged", "consistent"]


def test_the_log_tells_events_decisions_and_answers(shown) -> None:
    _, rows = shown
    _, texts = rows["/log", "TextLog:text"]
    said = " | ".join(c[0] for c in texts)
    for part in ("control on", "order accepted (operator)", "command 1 applied", "samples missing"):
        assert part in said
    _, levels = rows["/log", "TextLog:level"]
    assert "WARN" in {c[0] for c in levels}


def test_the_set_up_names_bodies_and_limits(plant: Plant) -> None:
    text = describe(plant)
    for part in ("absorber", "40714", "primary_displacement_m", "2e-05 m", plant.fingerprint):
        assert part in text


@pytest.mark.parametrize("name", ["analogue_2dof", "engine", "rig_no_vcm", "shaker_v721"])
def test_plants_without_coil_or_absorber_are_shown_too(name: str, tmp_path: Path) -> None:
    plant = load_plant(name)
    stream = rr.RecordingStream("test")
    stream.memory_recording()
    a_view(stream, plant)


def test_curve_axes_hold_the_curve_and_stay_put(plant: Plant) -> None:
    first, *_, last = [f.curve for f in frames(plant, 2.0)]
    assert first is not None
    assert last is not None
    axes = axes_for(first, None)
    assert axes.top_ns_m >= np.max(first.damping_ns_m + first.std_ns_m)
    assert axes_for(first, axes) is axes
    assert axes_for(last, Axes(47.0, 53.0, 1.0)).top_ns_m > 1.0
    corners = axes.place(np.array([axes.low_hz, axes.high_hz]), np.array([0.0, axes.top_ns_m]))
    assert np.allclose(corners, [[0.0, 0.0], [WIDTH, -HEIGHT]])


class Stuck:
    """A view whose first frame takes until it is let go."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.seen: list[int] = []

    def show(self, frame: Frame) -> None:
        self.go.wait(20.0)
        self.seen.append(frame.block.first_sample)

    def send(self) -> None:
        pass


def test_a_stalled_viewer_costs_the_oldest_frames_and_no_time(plant: Plant) -> None:
    made = list(frames(plant, 3.0))
    stuck = Stuck()
    live = LiveView(stuck, depth=5)
    live.show(made[0])
    time.sleep(0.2)
    start = time.perf_counter()
    for frame in made[1:]:
        live.show(frame)
    assert time.perf_counter() - start < 0.05
    assert live.dropped == len(made) - 1 - 5
    stuck.go.set()
    live.close(5.0)
    assert stuck.seen == [made[0].block.first_sample] + [f.block.first_sample for f in made[-5:]]


def test_a_view_that_fails_does_not_fail_the_run(plant: Plant) -> None:
    class Broken(Stuck):
        def show(self, frame: Frame) -> None:
            raise RuntimeError("gone")

    live = LiveView(Broken())
    made = list(frames(plant, 0.5))
    for frame in made:
        live.show(frame)
        time.sleep(0.02)
    live.close()
    assert isinstance(live.error, RuntimeError)
    assert live.dropped == len(made)


WATCHED_RUN = """
import json, os, signal, sys, time
sys.path.insert(0, sys.argv[1])
import rerun as rr
from frames import RATE, channels, frames
from test_rerun_view import a_view
from twin.plant.files import load_plant
from twin.rig.recording import Recorder
from twin.station.live import LiveView
from twin.station.native import Broadcast, NativeViewer, ViewerKeeper

plant, viewer, stream = load_plant("rig"), NativeViewer(headless=True), rr.RecordingStream("test")
source = Broadcast(stream)
keeper = ViewerKeeper(viewer, source.url)
live = LiveView(a_view(stream, plant), depth=20, keeper=keeper)
spent, pids = [], [viewer.pid]
deeds = {30: signal.SIGKILL, 80: signal.SIGSTOP, 150: signal.SIGCONT}

def wait(what, seconds=60.0):
    end = time.monotonic() + seconds
    while not what() and time.monotonic() < end:
        time.sleep(0.1)
    return what()

caught_up = lambda: keeper.seen_s is not None and keeper.seen_s > keeper.shown_s - 0.2
report = {}
run = Recorder(sys.argv[2], plant=plant, sample_rate_hz=RATE, channels=channels(plant), run_config_json="{}", seed=1)
with run as recorder:
    for k, frame in enumerate(frames(plant, 20.0)):
        if k == 30:
            report["saw_the_start"] = wait(caught_up)
        if k == 80:
            report["came_back"] = wait(lambda: keeper.starts == 2 and caught_up())
            pids.append(viewer.pid)
        if k in deeds:
            os.kill(viewer.pid, deeds[k])
        start = time.perf_counter()
        recorder.write_block(frame.block)
        live.show(frame)
        spent.append(time.perf_counter() - start)
        time.sleep(max(0.0, 0.03 - spent[-1]))
    report["went_on"] = wait(caught_up)
start = time.perf_counter()
live.close(5.0)
stream.disconnect()
report["closing_s"] = time.perf_counter() - start
report |= {"dropped": live.dropped, "pids": pids, "phases": [
    [sorted(part)[len(part) // 2], max(part)] for part in (spent[:30], spent[30:80], spent[80:150], spent[150:])
]}
from rerun.experimental import ViewerClient
client = ViewerClient.connect(keeper._control)
report["views"] = sorted({view.view_class for view in client.get_state().views})
report["seen_s"] = keeper.seen_s
viewer.stop()
print(json.dumps(report))
"""


def test_a_viewer_killed_stopped_and_started_costs_no_time_and_no_sample_and_sees_all_again(
    requires_debian: Callable[[str], Path], tmp_path: Path
) -> None:
    requires_debian("mesa-vulkan-drivers")
    command = [sys.executable, "-c", WATCHED_RUN, str(Path(__file__).parent), str(tmp_path / "run.rrd")]
    run = subprocess.run(command, capture_output=True, text=True, timeout=280.0, check=False)
    assert run.returncode == 0, run.stderr
    told = json.loads(run.stdout)
    assert told["saw_the_start"]
    assert told["came_back"]
    assert told["went_on"]
    assert told["pids"][0] != told["pids"][1]
    assert told["seen_s"] == pytest.approx(20.0, abs=0.2)
    assert {"2D", "StateTimeline", "TextLog", "TimeSeries"} <= set(told["views"])
    assert told["dropped"] == 0  # the server kept for the viewer what it could not take
    assert told["closing_s"] < 10.0
    # Generous, for a machine that has much else to do; a block that waited for the viewer would wait for seconds.
    (median, worst), *others = told["phases"]
    assert max(m for m, _ in others) < 10.0 * median + 0.02
    assert max(w for _, w in others) < 20.0 * worst + 0.5
    recording = open_recording(tmp_path / "run.rrd")
    assert not recording.repaired
    assert recording.end_sample == 20 * RATE
    expected = np.concatenate([f.block.values for f in frames(load_plant("rig"), 20.0)])
    got = np.concatenate([b.values for b in recording.blocks()])
    assert np.array_equal(got, expected, equal_nan=True)
