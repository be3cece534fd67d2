"""Reading a recorded run back, bit for bit, whole or damaged."""

import json
import shutil
import subprocess
import tempfile
import warnings
import weakref
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError
from rerun.chunk import LazyChunkStream, RrdReader
from rerun.error_utils import RerunWarning

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.rig.recording import ACKNOWLEDGEMENTS, COMMANDS, FORMAT_VERSION, PROPERTY, ROOT
from twin.rig.rerun_tool import rerun_environment, rerun_program

_REPAIR_TIMEOUT_S = 600.0


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Recording:
    """A recorded run.

    Attributes
    ----------
    path
        The file as given.
    plant, config_id, sample_rate_hz, channels, run_config_json, seed
        As the recorder was given them.
    program_version
        Of the program that recorded it.
    n_samples, n_blocks
        Samples and blocks in the file; lost blocks do not count.
    end_sample
        Index of the first sample after the last block.
    repaired
        The file was cut short; what follows its last whole row is lost.
    """

    path: Path
    plant: Plant
    config_id: str
    sample_rate_hz: float
    channels: tuple[Channel, ...]
    run_config_json: str
    seed: int | None
    program_version: str
    n_samples: int
    n_blocks: int
    end_sample: int
    repaired: bool
    _source: Path
    _in_order: bool
    _notes: dict[str, list[tuple[int, str]]] = field(repr=False)

    @property
    def source(self) -> Path:
        """The file that is read: the given one, or the whole part of it where that was cut short."""
        return self._source

    def blocks(self) -> Iterator[Block]:
        """Blocks as they were recorded, by first sample; a few at a time in memory unless they lie out of order.

        Raises
        ------
        InputError
            At a block whose checksum is wrong.
        """
        found = self._blocks_in_file()
        if self._in_order:
            return found
        return iter(sorted(found, key=lambda block: block.first_sample))

    def commands(self) -> tuple[Command, ...]:
        """Commands that were sent, by the sample they asked for."""
        return tuple(Command.model_validate_json(text) for _, text in self.notes(COMMANDS))

    def acknowledgements(self) -> tuple[tuple[int, Acknowledgement], ...]:
        """The rig's answers with the samples at which they came in."""
        return tuple(
            (sample, Acknowledgement.model_validate_json(text))
            for sample, text in self.notes(ACKNOWLEDGEMENTS)
        )

    def notes(self, kind: str) -> tuple[tuple[int, str], ...]:
        """(sample, JSON) of every note of that kind, by sample; empty if there is none."""
        return tuple(self._notes.get(kind, ()))

    def _blocks_in_file(self) -> Iterator[Block]:
        for chunk in _stream(self._source).filter(content=f"/{ROOT}/raw"):
            batch = chunk.to_record_batch()
            rows = zip(batch.column("sample").to_pylist(), batch.column("block").to_pylist(), strict=True)
            for sample, cell in rows:
                yield self._block(sample, cell[0])

    def _block(self, first_sample: int, row: dict[str, Any]) -> Block:
        if zlib.crc32(row["invalid"], zlib.crc32(row["samples"])) != row["crc32"]:
            raise InputError(
                f"{self.path}: the block at sample {first_sample} "
                f"({first_sample / self.sample_rate_hz:.3f} s) is damaged; use another copy of the file"
            )
        shape = (row["n_samples"], len(self.channels))
        values = np.frombuffer(row["samples"], row["dtype"]).astype(np.float64).reshape(shape)
        valid = np.ones(shape, dtype=np.bool_)
        if row["invalid"]:
            bits = np.unpackbits(np.frombuffer(row["invalid"], np.uint8), count=valid.size)
            valid = ~bits.astype(np.bool_).reshape(shape)
        values.flags.writeable = False
        valid.flags.writeable = False
        return Block(
            first_sample=first_sample,
            sample_rate_hz=self.sample_rate_hz,
            values=values,
            valid=valid,
            channels=self.channels,
            config_id=row["config_id"],
            control_on=row["control_on"],
            commands_applied=tuple(row["commands_applied"]),
        )


def open_recording(path: Path) -> Recording:
    """Open a recorded run, also one whose recorder was killed or whose file was cut short.

    Raises
    ------
    InputError
        If the file cannot be read, holds no whole row, or is no recording of this program.
    """
    path = Path(path)
    try:
        if path.stat().st_size == 0:
            raise InputError(f"{path}: is empty; nothing was recorded")
        with path.open("rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    if magic != b"RRF2":
        raise InputError(f"{path}: is no Rerun recording (.rrd); give a file that 'atmd' recorded")
    try:
        return _scan(path, path)
    except (RuntimeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
    folder = tempfile.mkdtemp(prefix="atmd-")
    try:
        recording = _scan(path, _repair(path, Path(folder)))
    except (RuntimeError, ValueError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: is damaged and nothing in it can be recovered ({error}); use another copy"
        ) from error
    # The repaired copy stays for as long as the recording is in use.
    weakref.finalize(recording, shutil.rmtree, folder, ignore_errors=True)
    return recording


def _repair(path: Path, folder: Path) -> Path:
    """Copy all whole chunks of a damaged file to a new one, with Rerun's own tool."""
    whole = folder / "repaired.rrd"
    command = [rerun_program(), "rrd", "filter", "--continue-on-error", str(path), "-o", str(whole)]
    try:
        subprocess.run(
            command, env=rerun_environment(), capture_output=True, timeout=_REPAIR_TIMEOUT_S, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(
            f"{path}: is cut short and could not be repaired ({error}); try: rerun rrd filter --continue-on-error"
        ) from error
    if not whole.is_file():
        raise InputError(f"{path}: is cut short before its first whole row; nothing was recorded")
    return whole


def _stream(path: Path) -> LazyChunkStream:
    with warnings.catch_warnings():
        # A killed recorder leaves no index at the end; streaming does not need one.
        warnings.simplefilter("ignore", RerunWarning)
        return RrdReader(path).stream()


def _scan(path: Path, source: Path) -> Recording:
    """One pass over the file: properties, notes, and where the blocks are."""
    properties: dict[str, str] = {}
    notes: dict[str, list[tuple[int, bytes, str]]] = {}
    firsts: list[int] = []
    lengths: list[int] = []
    for chunk in _stream(source):
        entity = chunk.entity_path
        if entity == f"/__properties/{PROPERTY}":
            batch = chunk.to_record_batch()
            properties |= {
                name: str(_first(batch.column(name)[batch.num_rows - 1].as_py()))
                for name in batch.schema.names
                if not name.startswith("rerun.")
            }
        elif entity == f"/{ROOT}/raw":
            batch = chunk.to_record_batch()
            firsts += batch.column("sample").to_pylist()
            lengths += batch.column("block").flatten().field("n_samples").to_pylist()
        elif entity.startswith(f"/{ROOT}/"):
            batch = chunk.to_record_batch()
            rows = zip(
                batch.column("sample").to_pylist(),
                batch.column("rerun.controls.RowId").to_pylist(),
                (_first(text) for text in batch.column("json").to_pylist()),
                strict=True,
            )
            notes.setdefault(entity.removeprefix(f"/{ROOT}/"), []).extend(rows)
    known = _parse(path, properties)
    return Recording(
        path=path,
        **known,
        n_samples=sum(lengths),
        n_blocks=len(firsts),
        end_sample=max((f + n for f, n in zip(firsts, lengths, strict=True)), default=0),
        repaired=source != path,
        _source=source,
        _in_order=all(a <= b for a, b in pairwise(firsts)),
        # Row ids count up as rows are written: they keep the order of notes at the same sample.
        _notes={kind: [(sample, text) for sample, _, text in sorted(rows)] for kind, rows in notes.items()},
    )


def _parse(path: Path, properties: dict[str, str]) -> dict[str, Any]:
    if "format_version" not in properties:
        raise InputError(f"{path}: is no recording of this program; give a file that 'atmd' recorded")
    if int(properties["format_version"]) > FORMAT_VERSION:
        raise InputError(
            f"{path}: was recorded by the newer version {properties['program_version']}; update this program"
        )
    try:
        return {
            "plant": Plant.model_validate_json(properties["plant"]),
            "config_id": properties["config_id"],
            "sample_rate_hz": float(properties["sample_rate_hz"]),
            "channels": tuple(Channel(name, unit) for name, unit in json.loads(properties["channels"])),
            "run_config_json": properties["run_config"],
            "seed": json.loads(properties["seed"]),
            "program_version": properties["program_version"],
        }
    except (KeyError, ValidationError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: its description of the run cannot be used: {error}") from error


def _first(cell: list[Any] | None) -> Any:
    """The one value of a component's cell; Rerun stores every cell as a list."""
    return cell[0] if cell else None
