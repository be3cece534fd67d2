"""One run, one recording: raw blocks, commands and notes as they came, in Rerun files that can be replayed.

Everything a replay needs lies under the entity ``/record`` and in the recording's properties; whatever else
the file holds (the series people look at) is written through `Recorder.stream` and never read back.

How safe it is: when a block is taken, all before it are in the file, so that a process that dies, whatever kills it,
loses the block in its hands and no other. The disk confirms a block as soon as it is written, so that power loss costs
the same at the rig's ten blocks a second, and a tenth of a second of faster ones.
Recording ends with an error, and whole, before the disk is full; a disk that fills nevertheless costs the last block.
"""

import json
import threading
import uuid
import zlib
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.rig.filesink import open_sink
from twin.rig.storage import Storage, as_size, free_bytes, part_path, parts_beside

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

_FLUSH_TIMEOUT_S = 10.0


class Recorder:
    """Writes one run, row by row, so that a crash costs a block and not the run.

    Parameters
    ----------
    path
        File to create; where the run is kept in several, the first of them (see `twin.rig.storage.part_path`).
    plant
        The plant the run is about; its fingerprint is the recording's ``config_id``.
    sample_rate_hz, channels
        Of every block that will follow.
    run_config_json
        The run's own configuration; kept as it is, not looked into.
    seed
        Of whatever was random in the run; None for a real rig.
    overwrite
        Replace existing files instead of refusing.
    storage
        When another file is begun, and how much all may take.
    software
        Versions of whatever the results depend on.

    Raises
    ------
    InputError
        If the file cannot be created, or exists already.
    RunError
        If nothing can be written to it, or the disk has too little left.
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
        storage: Storage | None = None,
        software: Mapping[str, str] | None = None,
    ) -> None:
        self.path = Path(path)
        self._storage = storage or Storage()
        self._sample_rate_hz = sample_rate_hz
        self._channels = channels
        self._overwrite = overwrite
        self._closed = False
        self._run_id = uuid.uuid4().hex
        self._properties = {
            "format_version": str(FORMAT_VERSION),
            "program_version": version("atmd-twin"),
            "config_id": plant.fingerprint,
            "sample_rate_hz": repr(float(sample_rate_hz)),
            "channels": json.dumps([[c.name, c.unit] for c in channels]),
            "plant": plant.model_dump_json(),
            "run_config": run_config_json,
            "seed": json.dumps(seed),
            "software": json.dumps(dict(software or {})),
            "run_id": self._run_id,
        }
        for number, old in parts_beside(self.path).items():
            if overwrite and number > 1:
                old.unlink()
            elif not overwrite:
                raise InputError(f"{old}: exists already; give another name or remove it first")
        self.part = 0
        self._parts: dict[Path, int] = {}
        self._refuse_full_disk()
        self._first_sample: int | None = None
        self._begin_part()

    @property
    def stream(self) -> rr.RecordingStream:
        """The present file's stream, for series to be looked at; ``/record`` in it is the recorder's own."""
        return self._stream

    def part_is_full(self, block: Block) -> bool:
        """Whether this block belongs into the next file."""
        limits, first = self._storage, self._first_sample
        if first is None:
            return False
        seconds = (block.first_sample - first) / self._sample_rate_hz
        return (limits.rotate_bytes is not None and self._pipe.written >= limits.rotate_bytes) or (
            limits.rotate_s is not None and seconds >= limits.rotate_s
        )

    def next_part(self) -> None:
        """Finish the present file and begin another; `write_block` does it where nobody did.

        Raises
        ------
        RunError
            If either cannot be written.
        """
        self._end_part()
        self._begin_part()

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
        if self.part_is_full(block):
            self.next_part()
        else:
            self.flush()
        self._make_room()
        if self._first_sample is None:
            self._first_sample = block.first_sample
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
        try:
            self._stream.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except RuntimeError as error:
            raise RunError(
                f"{self._file}: the disk takes no more data ({error}); record elsewhere"
            ) from error
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
        self._end_part()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _refuse_full_disk(self) -> None:
        folder = next(p for p in (self.path.absolute().parent, *self.path.absolute().parents) if p.is_dir())
        wanted, free = self._storage.keep_free_bytes, free_bytes(folder)
        if free < wanted:
            raise RunError(
                f"{self.path}: the disk has {as_size(free)} left, and {as_size(wanted)} are to stay free; make room "
                "or record elsewhere: nothing was recorded"
            )

    def _begin_part(self) -> None:
        if self.part:
            # Rerun keeps threads and memory of a finished stream until it is told; a viewer that has stalled may
            # hold that up, so nobody waits for it.
            threading.Thread(target=flush_and_cleanup_orphaned_recordings, daemon=True).start()
        self.part += 1
        self._first_sample = None
        self._file = part_path(self.path, self.part)
        self._pipe = open_sink(self._file, overwrite=self._overwrite)
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.save(self._pipe.inlet)
        self._pipe.inlet_taken()
        try:
            self._stream.send_recording_name(self._file.stem)
            about: dict[str, Any] = {**self._properties, "part": str(self.part)}
            self._stream.send_property(PROPERTY, rr.AnyValues(**about))
            self.flush()
        except RunError:
            self._stream.disconnect()
            self._pipe.abandon()
            self._closed = True
            raise

    def _end_part(self) -> None:
        self._stream.disconnect()
        self._pipe.close()
        self._parts[self._file] = self._pipe.written

    def _make_room(self) -> None:
        """Keep to the budget and leave the disk what must stay free; RunError if that is not possible."""
        limits = self._storage
        while trouble := self._trouble():
            if not (limits.drop_oldest and self._parts):
                raise RunError(
                    f"{self.path}: recording stopped: {trouble}. What was recorded until then is whole; make room, "
                    "allow more, or let old files go"
                )
            oldest = next(iter(self._parts))
            oldest.unlink(missing_ok=True)
            del self._parts[oldest]

    def _trouble(self) -> str:
        limits = self._storage
        taken = sum(self._parts.values()) + self._pipe.written
        if limits.budget_bytes is not None and taken > limits.budget_bytes:
            return f"it has grown to {as_size(taken)} of the {as_size(limits.budget_bytes)} it may take"
        if limits.keep_free_bytes and (free := free_bytes(self._file.parent)) < limits.keep_free_bytes:
            return (
                f"the disk has {as_size(free)} left, and {as_size(limits.keep_free_bytes)} are to stay free"
            )
        return ""

    def _write(self, kind: str, schema: pa.Schema, sample: int, row: dict[str, object]) -> None:
        self._pipe.check()
        index = {"time": round(sample / self._sample_rate_hz * 1e9), "sample": sample}
        batch = pa.RecordBatch.from_pylist([index | row], schema=schema)
        self._stream.send_record_batch(batch, index=["time", "sample"], entity_path=f"{ROOT}/{kind}")
