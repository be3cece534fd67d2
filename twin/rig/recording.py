"""One run, one file: raw blocks, commands and notes as they came, in a Rerun recording that can be replayed.

Everything a replay needs lies under the entity ``/record`` and in the recording's properties; whatever else
the file holds (the series people look at) is written through `Recorder.stream` and never read back.
"""

import json
import zlib
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pyarrow as pa
import rerun as rr

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.rig.filepipe import FilePipe

APPLICATION = "atmd_twin"
FORMAT_VERSION = 1
ROOT = "record"
PROPERTY = "atmd_twin"
COMMANDS, ACKNOWLEDGEMENTS = "commands", "acknowledgements"

_INDEX = [("time", pa.duration("ns")), ("sample", pa.int64())]
# One struct, not one column each: tools that rearrange recordings split columns of a row, never a struct.
_RAW_SCHEMA = pa.schema(
    [
        *_INDEX,
        (
            "block",
            pa.struct(
                [
                    ("samples", pa.binary()),
                    ("dtype", pa.string()),
                    ("n_samples", pa.int64()),
                    ("invalid", pa.binary()),
                    ("crc32", pa.uint32()),
                    ("control_on", pa.bool_()),
                    ("commands_applied", pa.list_(pa.int64())),
                    ("config_id", pa.string()),
                ]
            ),
        ),
    ]
)
_NOTE_SCHEMA = pa.schema([*_INDEX, ("json", pa.string())])

_FLUSH_BYTES = 4 << 20
_FLUSH_TIMEOUT_S = 10.0


class Recorder:
    """Writes one run to one ``.rrd`` file, row by row, so that a crash costs a block and not the run.

    Parameters
    ----------
    path
        File to create.
    plant
        The plant the run is about; its fingerprint is the recording's ``config_id``.
    sample_rate_hz, channels
        Of every block that will follow.
    run_config_json
        The run's own configuration; kept as it is, not looked into.
    seed
        Of whatever was random in the run; None for a real rig.
    overwrite
        Replace an existing file instead of refusing.

    Raises
    ------
    InputError
        If the file cannot be created, or exists already.
    RunError
        If nothing can be written to it.
    """

    def __init__(
        self,
        path: Path,
        *,
        plant: Plant,
        sample_rate_hz: float,
        channels: tuple[Channel, ...],
        run_config_json: str,
        seed: int | None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self._sample_rate_hz = sample_rate_hz
        self._channels = channels
        self._unflushed = 0
        self._closed = False
        self._pipe = FilePipe(self.path, overwrite=overwrite)
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.save(self._pipe.inlet)
        self._pipe.inlet_taken()
        try:
            self._describe(plant, run_config_json, seed)
        except RunError:
            self._stream.disconnect()
            self._pipe.abandon()
            raise

    @property
    def stream(self) -> rr.RecordingStream:
        """The file's stream, for series that are to be looked at; ``/record`` in it is the recorder's own."""
        return self._stream

    def write_block(self, block: Block) -> None:
        """Append a block. Values that are float32 to the bit, as those from the wire are, take four bytes.

        Raises
        ------
        ValueError
            If the block's channels or sample rate are not those of the recording.
        RunError
            If the file can no longer be written.
        """
        if block.channels != self._channels or block.sample_rate_hz != self._sample_rate_hz:
            raise ValueError(
                "a recording keeps its channels and sample rate from the first block to the last"
            )
        with np.errstate(over="ignore"):
            samples = block.values.astype("<f4")
        if not np.array_equal(samples, block.values):
            samples = block.values.astype("<f8")
        data = samples.tobytes()
        invalid = b"" if block.valid.all() else np.packbits(~block.valid).tobytes()
        row = {
            "samples": data,
            "dtype": samples.dtype.str,
            "n_samples": block.n_samples,
            "invalid": invalid,
            "crc32": zlib.crc32(invalid, zlib.crc32(data)),
            "control_on": block.control_on,
            "commands_applied": block.commands_applied,
            "config_id": block.config_id,
        }
        self._write("raw", _RAW_SCHEMA, block.first_sample, {"block": row})
        self._unflushed += len(data)
        if self._unflushed > _FLUSH_BYTES:
            self.flush()

    def write_command(self, command: Command) -> None:
        """Append a command at the sample it asks for; raises RunError as `write_block`."""
        self.write_note(COMMANDS, command.apply_at_sample, command.model_dump_json())

    def write_acknowledgement(self, acknowledgement: Acknowledgement, sample: int) -> None:
        """Append the rig's answer at the sample it came in; raises RunError as `write_block`."""
        self.write_note(ACKNOWLEDGEMENTS, sample, acknowledgement.model_dump_json())

    def write_note(self, kind: str, sample: int, json_text: str) -> None:
        """Append a line of JSON under a name such as ``events``; raises RunError as `write_block`.

        Raises
        ------
        ValueError
            If ``kind`` is no identifier, or the one that blocks go by.
        """
        if not kind.isidentifier() or kind == "raw":
            raise ValueError(f"'{kind}' is no name for notes")
        self._write(kind, _NOTE_SCHEMA, sample, {"json": json_text})

    def flush(self) -> None:
        """Wait until everything written so far is in the file.

        Raises
        ------
        RunError
            If it cannot be written, or the disk does not answer.
        """
        self._unflushed = 0
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:
            raise RunError(f"{self.path}: the disk takes no more data ({error}); record elsewhere") from error
        self._pipe.drain(_FLUSH_TIMEOUT_S)

    def close(self) -> None:
        """Finish the file; calling it twice does nothing.

        Raises
        ------
        RunError
            If the end of the run could not be written.
        """
        if self._closed:
            return
        self._closed = True
        self._stream.disconnect()
        self._pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _describe(self, plant: Plant, run_config_json: str, seed: int | None) -> None:
        self._stream.send_recording_name(self.path.stem)
        properties = rr.AnyValues(
            format_version=str(FORMAT_VERSION),
            program_version=version("atmd-twin"),
            config_id=plant.fingerprint,
            sample_rate_hz=repr(float(self._sample_rate_hz)),
            channels=json.dumps([[c.name, c.unit] for c in self._channels]),
            plant=plant.model_dump_json(),
            run_config=run_config_json,
            seed=json.dumps(seed),
        )
        self._stream.send_property(PROPERTY, properties)
        self.flush()

    def _write(self, kind: str, schema: pa.Schema, sample: int, row: dict[str, object]) -> None:
        self._pipe.check()
        index = {"time": round(sample / self._sample_rate_hz * 1e9), "sample": sample}
        batch = pa.RecordBatch.from_pylist([index | row], schema=schema)
        self._stream.send_record_batch(batch, index=["time", "sample"], entity_path=f"{ROOT}/{kind}")
