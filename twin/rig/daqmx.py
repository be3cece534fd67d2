"""A rig measured by an NI-DAQmx device, behind the same wire as any other: samples out, and no command obeyed.

A computer between converter and coil would add milliseconds to a loop that stands some tens of microseconds
(`docs/daqmx.md`): the controller stays where it is, and what its operator orders has to be done there.
Written to the documented interface of NI's Python package `nidaqmx`; no device stood behind its tests.
"""

import contextlib
import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from twin.control.schedule import Acknowledgement, Command, GainSchedule
from twin.plant.blocks import Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.rig.daqmx_setup import Input, read_setup

BUFFER_S = 4.0
"""So much is kept while this program stands still; what is older is overwritten and lost."""

TIMEOUT_S = 2.0
RANGE_SHARE = 0.999
STANDARD_GRAVITY_M_S2 = 9.80665
RATE_TOLERANCE = 1e-6
NOT_OBEYED = (
    "this rig is only measured here: its controller takes orders at the rig itself, nothing was changed"
)


@dataclass(frozen=True, slots=True)
class Acquisition:
    """What a rig that is only measured is set up for, in the words of a simulated rig's programme."""

    plant: Plant
    sample_rate_hz: float
    block_samples: int
    loop_delay_samples: int = 1
    measurement: Literal["relative", "absolute"] = "relative"

    @property
    def block_s(self) -> float:
        """Duration of a block [s]."""
        return self.block_samples / self.sample_rate_hz


class DaqmxRig:
    """Continuous acquisition from one NI-DAQmx task, block by block; close it.

    The device's own sample clock counts. Samples that were overwritten before they were read are left out by whole
    blocks, so that what comes after stands where it belongs and the station sees the gap.

    Parameters
    ----------
    plant
        Names the channels.
    setup
        File that says where they are, see `twin.rig.daqmx_setup`.

    Attributes
    ----------
    next_sample
        First sample of the next block since the start.
    lost_blocks
        Blocks overwritten before they were read.
    tripped
        Words for the operator; empty if there are none.

    Raises
    ------
    InputError
        If package, driver or device is missing, or the device cannot do what the file asks for.
    """

    schedule: GainSchedule | None = None
    finished = False

    def __init__(self, plant: Plant, setup: Path) -> None:
        asked, self._inputs = read_setup(setup, plant)
        self._where = setup
        self.programme = Acquisition(plant, asked.sample_rate_hz, asked.block_samples)
        self.channels: tuple[Channel, ...] = tuple(i.channel for i in self._inputs)
        self.control_enabled = False
        self.next_sample = self.lost_blocks = 0
        self.tripped = ""
        self._refused: list[int] = []
        self._factor = np.array([i.factor for i in self._inputs])
        self._offset = np.array([i.place.offset_v for i in self._inputs])
        self._limit = np.array([RANGE_SHARE * i.place.range_v for i in self._inputs])
        # An accelerometer's channel comes in g, as its sensitivity is given to the driver; all others in volts.
        self._volts = np.array([
            abs(STANDARD_GRAVITY_M_S2 / i.factor) if i.place.iepe_ma is not None else 1.0 for i in self._inputs
        ])  # fmt: skip
        self._raw = np.empty((len(self._inputs), asked.block_samples))
        self._ni = _package()
        self._task: Any = None
        try:
            self._task = self._ni.Task()
            self._configure()
            self._reader = _submodule("stream_readers").AnalogMultiChannelReader(self._task.in_stream)
            self._task.start()
        except self._errors.Error as error:
            self.close()
            self._unusable(error)
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """Release the device."""
        task, self._task = self._task, None
        if task is not None:
            with contextlib.suppress(self._errors.Error):
                task.close()

    @property
    def waiting(self) -> int:
        """Commands that have not been answered."""
        return len(self._refused)

    def accept(self, command: Command) -> None:
        """Take a command in, to be refused with the next block."""
        self._refused.append(command.command_id)

    def next_block(self) -> tuple[NDArray[np.float32], bool | None, list[Acknowledgement]]:
        """Wait for the next block.

        Returns
        -------
        values
            (block_samples, n_channels) in SI units; NaN where a converter was at the end of its range.
        control_on
            None: nobody tells.
        acknowledgements
            Refusals of the commands that came.

        Raises
        ------
        RunError
            If the device stops delivering; the message says what it said.
        """
        n = self.programme.block_samples
        if not self._read(n):
            self._skip(n)
        self.next_sample += n
        volts = self._raw.T * self._volts
        values = (volts - self._offset) * self._factor
        values[~(np.abs(volts) < self._limit)] = np.nan
        answers = [Acknowledgement(command_id=k, accepted=False, reason=NOT_OBEYED) for k in self._refused]
        self._refused = []
        return values.astype(np.float32), None, answers

    @property
    def _errors(self) -> Any:
        return self._ni.errors

    def _configure(self) -> None:
        constants = _submodule("constants")
        for i in self._inputs:
            self._add(i, constants)
        rate, n = self.programme.sample_rate_hz, self.programme.block_samples
        size = max(round(BUFFER_S * rate), 4 * n)
        timing, stream = self._task.timing, self._task.in_stream
        timing.cfg_samp_clk_timing(
            rate, sample_mode=constants.AcquisitionType.CONTINUOUS, samps_per_chan=size
        )
        got = float(timing.samp_clk_rate)
        if abs(got / rate - 1.0) > RATE_TOLERANCE:
            raise InputError(
                f"{self._where}: sample_rate_hz: the device samples at {got:.9g} Hz where {rate:g} Hz was asked for; "
                f"write sample_rate_hz = {got!r}"
            )
        stream.input_buf_size = size
        stream.overwrite = constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        stream.relative_to = constants.ReadRelativeTo.CURRENT_READ_POSITION
        stream.offset = 0

    def _add(self, i: Input, constants: Any) -> None:
        place = i.place
        terminal = {
            "default": "DEFAULT", "differential": "DIFF", "pseudo_differential": "PSEUDO_DIFF", "rse": "RSE",
            "nrse": "NRSE",
        }[place.terminal]  # fmt: skip
        common = {
            "name_to_assign_to_channel": i.channel.name,
            "terminal_config": constants.TerminalConfiguration[terminal],
        }
        if place.iepe_ma is None:
            self._task.ai_channels.add_ai_voltage_chan(
                place.physical,
                min_val=-place.range_v,
                max_val=place.range_v,
                units=constants.VoltageUnits.VOLTS,
                **common,
            )
            return
        volts_per_g = abs(STANDARD_GRAVITY_M_S2 / i.factor)
        self._task.ai_channels.add_ai_accel_chan(
            place.physical,
            min_val=-place.range_v / volts_per_g,
            max_val=place.range_v / volts_per_g,
            units=constants.AccelUnits.G,
            sensitivity=1e3 * volts_per_g,
            sensitivity_units=constants.AccelSensitivityUnits.MILLIVOLTS_PER_G,
            current_excit_source=constants.ExcitationSource.INTERNAL,
            current_excit_val=1e-3 * place.iepe_ma,
            **common,
        )

    def _read(self, n: int) -> bool:
        """Fill the raw values; False if some of them were overwritten before."""
        codes = _submodule("error_codes").DAQmxErrors
        try:
            got = self._reader.read_many_sample(self._raw, number_of_samples_per_channel=n, timeout=TIMEOUT_S)
        except self._errors.DaqError as error:
            code = int(error.error_code)
            if code == codes.SAMPLES_NO_LONGER_AVAILABLE.value:
                return False
            if code == codes.SAMPLES_NOT_YET_AVAILABLE.value:
                raise RunError(
                    f"no samples came within {TIMEOUT_S:g} s: the device's sample clock stands still; check the device "
                    f"and what else uses it ({_first_line(error)})"
                ) from error
            raise RunError(
                f"the device stopped delivering after sample {self.next_sample}: {_first_line(error)}"
            ) from error
        if got != n:
            raise RunError(f"the device gave {got} samples where {n} were asked for")
        return True

    def _skip(self, n: int) -> None:
        """Read the latest block that has begun instead; what lies between is lost."""
        stream = self._task.in_stream
        try:
            acquired, position = int(stream.total_samp_per_chan_acquired), int(stream.curr_read_pos)
            target = max(acquired // n, self.next_sample // n + 1) * n
            stream.offset = target - position
            kept_up = self._read(n)
            stream.offset = 0
            after = int(stream.curr_read_pos)
        except self._errors.DaqError as error:
            raise RunError(
                f"samples were overwritten, and reading cannot go on: {_first_line(error)}"
            ) from error
        if not kept_up:
            raise RunError(
                "samples were overwritten twice in a row before they could be read: this computer is too slow for "
                f"{self.programme.sample_rate_hz:g} samples/s of {len(self._inputs)} channels; lower the rate"
            )
        if after != target + n:
            raise RunError(
                f"after an overrun the device reads sample {after - n} where {target} was asked for: "
                "the count of samples is lost; start again"
            )
        self.lost_blocks += (target - self.next_sample) // n
        self.next_sample = target
        self.tripped = f"{self.lost_blocks} blocks lost in all: the computer did not keep up with the device"

    def _unusable(self, error: Exception) -> NoReturn:
        missing = (self._errors.DaqNotFoundError, self._errors.DaqNotSupportedError)
        if isinstance(error, missing):
            raise InputError(
                "NI's driver NI-DAQmx is not on this machine (Windows and some Linux distributions have it); "
                "install it from ni.com/downloads, or send samples over the wire from where it is (docs/protocol.md)"
            ) from error
        raise InputError(
            f"{self._where}: the device cannot do this: {_first_line(error)}; "
            f"check the names against NI's own tools{self._devices()}"
        ) from error

    def _devices(self) -> str:
        with contextlib.suppress(self._errors.Error, AttributeError):
            names = [str(d.name) for d in _submodule("system").System.local().devices]
            return f" (devices here: {', '.join(names) or 'none'})"
        return ""


def _package() -> Any:
    """NI's package, which is an optional extra."""
    try:
        return importlib.import_module("nidaqmx")
    except ImportError as error:
        raise InputError(
            "NI-DAQmx devices need the package nidaqmx: pip install 'atmd-twin[daqmx]', and NI's driver"
        ) from error


def _submodule(name: str) -> Any:
    return importlib.import_module(f"nidaqmx.{name}")


def _first_line(error: Exception) -> str:
    """What the driver said, without its pages of advice."""
    text = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    code = getattr(error, "error_code", None)
    return text if code is None else f"{text} (code {int(code)})"
