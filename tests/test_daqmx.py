"""The NI-DAQmx source against the real package's classes: no device stands behind it, but every name is checked."""

import itertools
import sys
import threading
import time
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import create_autospec

import numpy as np
import pytest

nidaqmx = pytest.importorskip("nidaqmx", reason="the optional extra daqmx is not installed")

from nidaqmx import constants, errors, stream_readers  # noqa: E402
from nidaqmx.task import InStream, Timing  # noqa: E402
from nidaqmx.task.collections import AIChannelCollection  # noqa: E402

from twin.control.schedule import Command  # noqa: E402
from twin.plant.errors import InputError, RunError  # noqa: E402
from twin.plant.files import load_plant  # noqa: E402
from twin.rig.daqmx import BUFFER_S, NOT_OBEYED, DaqmxRig  # noqa: E402
from twin.rig.gateway import RigGateway  # noqa: E402
from twin.rig.server import RigServer  # noqa: E402
from twin.rig.wire import KeyPair  # noqa: E402
from twin.station.rig import RigOptions, serve_device  # noqa: E402

PLANT = load_plant("rig")
N = 500
SETUP = f"""
sample_rate_hz = 50000.0
block_samples = {N}

[channels]
vcm_current = {{ physical = "Dev1/ai2", sensitivity = "-0.1 V/A", range_v = 10.0, offset_v = 0.5,\
  terminal = "differential" }}
table_acceleration = {{ physical = "Dev1/ai0", sensitivity = "100 mV/g", iepe_ma = 2.0 }}
vcm = {{ physical = "Dev1/ai3", sensitivity = "2.5 V/A", range_v = 5.0 }}
"""


class Stream:
    """Takes only what the package's stream has, and counts as the device does."""

    def __init__(self, device: "Device") -> None:
        object.__setattr__(self, "_device", device)
        object.__setattr__(self, "told", {})

    def __setattr__(self, name: str, value: object) -> None:
        assert isinstance(getattr(InStream, name), property), name
        assert getattr(InStream, name).fset is not None, name
        self.told[name] = value

    def __getattr__(self, name: str) -> Any:
        assert isinstance(getattr(InStream, name), property), name
        return {
            "curr_read_pos": self._device.position,
            "total_samp_per_chan_acquired": self._device.acquired,
        }[name]


@dataclass
class Device:
    """Three channels, and what goes wrong with them: ``faults`` by the number of the read."""

    channels: int = 3
    rate: float = 50_000.0
    position: int = 0
    acquired: int = 0
    reads: int = 0
    pace_s: float = 0.0
    faults: dict[int, Exception | int] = field(default_factory=dict)
    lies_by: int = 0
    task: Any = None
    stream: Any = None
    driver: Any = None

    def volts(self, first: int, n: int) -> np.ndarray:
        """What lies at the terminals [V]: (channels, n), a function of the sample's number alone."""
        k = np.arange(first, first + n)
        return np.stack([0.1 * np.sin(2e-3 * k), 0.5 - 0.02 * np.cos(1e-3 * k), 2.5e-3 * (k % 1000)])[
            : self.channels
        ]

    def read(self, data: np.ndarray, number_of_samples_per_channel: int = -1, timeout: float = 10.0) -> int:
        assert data.shape == (self.channels, number_of_samples_per_channel)
        assert 0.0 < timeout < 10.0
        time.sleep(self.pace_s)
        fault = self.faults.get(self.reads)
        self.reads += 1
        if isinstance(fault, Exception):
            raise fault
        self.acquired += number_of_samples_per_channel
        if fault is not None:  # the reader stood still for so many samples
            self.acquired += fault
        start = self.position + self.stream.told["offset"]
        if self.acquired - start > self.stream.told["input_buf_size"]:
            raise errors.DaqReadError("Attempted to read samples that are no longer available.", -200279, 0)
        self.position = (
            start + number_of_samples_per_channel + self.lies_by * (self.stream.told["offset"] != 0)
        )
        volts = self.volts(start, number_of_samples_per_channel)
        volts[0] /= 0.1  # an accelerometer's channel is in g
        data[:] = volts
        return number_of_samples_per_channel


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Device:
    made = Device()
    made.stream = Stream(made)
    made.task = create_autospec(nidaqmx.Task, instance=True)
    made.task.in_stream = made.stream
    made.task.ai_channels = create_autospec(AIChannelCollection, instance=True)
    made.task.timing = create_autospec(Timing, instance=True)
    made.task.timing.samp_clk_rate = made.rate
    made.driver = create_autospec(nidaqmx.Task, return_value=made.task)
    monkeypatch.setattr(nidaqmx, "Task", made.driver)
    reader = create_autospec(stream_readers.AnalogMultiChannelReader)
    reader.return_value.read_many_sample.side_effect = made.read
    monkeypatch.setattr(stream_readers, "AnalogMultiChannelReader", reader)
    return made


@pytest.fixture
def setup(tmp_path: Path) -> Path:
    path = tmp_path / "dev1.toml"
    path.write_text(SETUP)
    return path


def in_si(device: Device, first: int, n: int = N) -> np.ndarray:
    """The same in the plant's units and order."""
    volts = device.volts(first, n)
    return np.stack([volts[0] / 0.1 * 9.80665, (volts[1] - 0.5) / -0.1, volts[2] / 2.5], axis=1)


def test_samples_come_in_the_plants_units_and_order(device: Device, setup: Path) -> None:
    with closing(DaqmxRig(PLANT, setup)) as rig:
        assert [(c.name, c.unit) for c in rig.channels] == [
            ("table_acceleration", "m/s²"), ("vcm_current", "A"), ("vcm", "A")]  # fmt: skip
        for k in range(4):
            values, control_on, answers = rig.next_block()
            assert values.dtype == np.float32
            np.testing.assert_allclose(values, in_si(device, k * N), rtol=1e-6, atol=1e-7)
            assert control_on is None
            assert answers == []
        assert rig.next_sample == 4 * N
        assert rig.programme.plant.fingerprint == PLANT.fingerprint
    device.task.close.assert_called_once_with()


def test_the_task_is_set_up_as_the_file_says(device: Device, setup: Path) -> None:
    DaqmxRig(PLANT, setup)
    channels, timing = device.task.ai_channels, device.task.timing
    accelerometer = channels.add_ai_accel_chan.call_args
    assert accelerometer.args == ("Dev1/ai0",)
    assert accelerometer.kwargs["sensitivity"] == pytest.approx(100.0)
    assert accelerometer.kwargs["sensitivity_units"] is constants.AccelSensitivityUnits.MILLIVOLTS_PER_G
    assert accelerometer.kwargs["max_val"] == pytest.approx(50.0)  # 5 V at 100 mV/g
    assert accelerometer.kwargs["current_excit_val"] == pytest.approx(2e-3)
    current, command = channels.add_ai_voltage_chan.call_args_list
    assert current.args == ("Dev1/ai2",)
    assert (current.kwargs["min_val"], current.kwargs["max_val"]) == (-10.0, 10.0)
    assert current.kwargs["terminal_config"] is constants.TerminalConfiguration.DIFF
    assert command.args == ("Dev1/ai3",)
    clock = timing.cfg_samp_clk_timing.call_args
    assert clock.args == (50_000.0,)
    assert clock.kwargs["sample_mode"] is constants.AcquisitionType.CONTINUOUS
    assert device.stream.told["input_buf_size"] == BUFFER_S * 50_000
    assert device.stream.told["overwrite"] is constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
    assert device.stream.told["relative_to"] is constants.ReadRelativeTo.CURRENT_READ_POSITION
    device.task.start.assert_called_once_with()


def test_a_converter_at_the_end_of_its_range_tells_nothing(
    device: Device, setup: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    honest = device.volts

    def clipped(first: int, n: int) -> np.ndarray:
        volts = honest(first, n)
        volts[0, 7], volts[1, 8], volts[2, 9], volts[2, 10] = -5.0, 10.0, 4.9999, np.nan
        return volts

    monkeypatch.setattr(device, "volts", clipped)
    values, _, _ = DaqmxRig(PLANT, setup).next_block()
    assert set(zip(*np.nonzero(np.isnan(values)), strict=True)) == {(7, 0), (8, 1), (9, 2), (10, 2)}


def test_overrun_is_lost_masked_and_counted_all_the_way_to_the_station(device: Device, setup: Path) -> None:
    buffered = round(BUFFER_S * 50_000)
    rig_keys, station_keys = KeyPair.fresh(), KeyPair.fresh()
    rig = DaqmxRig(PLANT, setup)
    server = RigServer(rig, rig_keys, [station_keys.public], float("inf"), stands_alone=True)
    ended: list[BaseException] = []

    def run() -> None:
        try:
            server.run()
        except RuntimeError as error:
            ended.append(error)

    thread = threading.Thread(target=run)
    gateway = RigGateway(
        PLANT, f"tcp://127.0.0.1:{server.samples_port}", f"tcp://127.0.0.1:{server.commands_port}",
        station_keys, rig_keys.public,
    )  # fmt: skip
    device.pace_s = 0.05
    thread.start()
    hello = gateway.connect(timeout_s=20.0)
    assert hello.schedule is None
    gateway.send(Command(command_id=1, apply_at_sample=0, control_enabled=False))
    answers, blocks = [], []
    for block in gateway.blocks(thread.is_alive):
        blocks.append(block)
        gateway.heartbeat(block.end_sample)
        answers += gateway.acknowledgements()
        if len(blocks) == 5:
            device.faults, device.pace_s = {device.reads + 5: buffered + 3 * N}, 0.01
        if block.valid.any() and block.first_sample > buffered:
            break
    ours = gateway.counts.lost
    gateway.close()
    device.faults[device.reads + 1] = RuntimeError("enough")
    thread.join(20.0)
    assert [str(e) for e in ended] == ["enough"]
    # Where the device counts, blocks follow one another, and what was lost is there as masked samples.
    assert all(b.first_sample == a.end_sample for a, b in itertools.pairwise(blocks))
    masked = [b for b in blocks if not b.valid.any()]
    assert sum(b.n_samples for b in masked) == rig.lost_blocks * N > buffered
    assert ours == rig.lost_blocks
    for b in blocks:
        if b.valid.any():
            np.testing.assert_allclose(b.values, in_si(device, b.first_sample), rtol=1e-5, atol=1e-6)
    assert "did not keep up" in rig.tripped
    assert [(a.command_id, a.accepted, a.reason) for a in answers] == [(1, False, NOT_OBEYED)]


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            errors.DaqReadError("Some or all of the samples are not yet available.", -200284, 0),
            "clock stands still",
        ),
        (
            errors.DaqReadError("Task was aborted.\nlong advice", -88709, 0),
            "stopped delivering after sample 500",
        ),
        (errors.DaqError("Device cannot be accessed.", -201003), r"code -201003"),
    ],
)
def test_what_the_device_says_ends_the_run_in_words(
    device: Device, setup: Path, fault: Exception, words: str
) -> None:
    rig = DaqmxRig(PLANT, setup)
    rig.next_block()
    device.faults = {1: fault}
    with pytest.raises(RunError, match=words) as told:
        rig.next_block()
    assert "advice" not in str(told.value)


def test_two_overruns_in_a_row_and_a_lost_count_are_not_passed_over(device: Device, setup: Path) -> None:
    much = round(BUFFER_S * 50_000) + N
    device.faults = {1: much, 2: much}
    rig = DaqmxRig(PLANT, setup)
    rig.next_block()
    with pytest.raises(RunError, match="lower the rate"):
        rig.next_block()


def test_a_device_that_reads_elsewhere_after_an_overrun_is_caught(device: Device, setup: Path) -> None:
    device.faults = {1: round(BUFFER_S * 50_000) + N}
    device.lies_by = 17
    rig = DaqmxRig(PLANT, setup)
    rig.next_block()
    with pytest.raises(RunError, match="count of samples is lost"):
        rig.next_block()


def test_a_rate_the_device_does_not_have_is_named(device: Device, setup: Path) -> None:
    device.task.timing.samp_clk_rate = 51_200.0
    with pytest.raises(InputError, match=r"sample_rate_hz = 51200\.0"):
        DaqmxRig(PLANT, setup)
    device.task.close.assert_called_once_with()


def test_missing_package_driver_and_device_each_say_what_to_do(
    device: Device, setup: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.task.ai_channels.add_ai_voltage_chan.side_effect = errors.DaqError(
        "Device identifier is invalid.", -200220
    )
    with pytest.raises(InputError, match=r"Device identifier is invalid.*code -200220.*own tools"):
        DaqmxRig(PLANT, setup)
    device.task.close.assert_called_once_with()
    device.driver.side_effect = errors.DaqNotFoundError("no driver")
    with pytest.raises(InputError, match=r"driver NI-DAQmx is not on this machine.*ni\.com"):
        DaqmxRig(PLANT, setup)
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    with pytest.raises(InputError, match=r"atmd-twin\[daqmx\]"):
        DaqmxRig(PLANT, setup)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("vcm_current", "coil_current", "no such channel; it has"),
        ("Dev1/ai2", "Dev1/ai0", "is that of 'vcm_current' already|is that of 'table_acceleration' already"),
        ("-0.1 V/A", "0.1 V/g", "does not give A"),
        ("-0.1 V/A", "0.1 A", "does not give A"),
        ("Dev1/ai2", "Dev1/ao2", "physical"),
        ("range_v = 10.0", "range_v = -10.0", "range_v"),
        ("offset_v = 0.5", "iepe_ma = 2.0", "feeds accelerometers"),
        ("offset_v = 0.5", "ofset_v = 0.5", "ofset_v"),
        ("block_samples = 500", "block_samples = 1", "block_samples"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_before_a_device_is_touched(
    device: Device, setup: Path, old: str, new: str, words: str
) -> None:
    setup.write_text(SETUP.replace(old, new))
    with pytest.raises(InputError, match=words):
        DaqmxRig(PLANT, setup)
    device.task.start.assert_not_called()


def test_a_file_without_a_sensor_is_refused(device: Device, setup: Path) -> None:
    setup.write_text('[channels]\nvcm = { physical = "Dev1/ai0", sensitivity = "1 V/A" }\n')
    with pytest.raises(InputError, match="nothing to watch"):
        DaqmxRig(PLANT, setup)


def test_a_port_that_is_taken_releases_the_device(device: Device, setup: Path, tmp_path: Path) -> None:
    from twin.rig.keys import make_keys

    public = make_keys(tmp_path, "rig")
    options = RigOptions("rig", public.with_suffix(".key_secret"), (public,), host="127.0.0.1", port=0)
    server, rig = serve_device(options, setup)
    with closing(rig), pytest.raises(InputError, match="cannot listen"):
        serve_device(RigOptions("rig", options.keys, options.stations, port=server.samples_port), setup)
    assert device.task.close.call_count == 2
    server._close()
