"""Reading a recorded run back, bit for bit, whole or damaged."""

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import ValidationError

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block, Channel
from twin.plant.config import Plant
from twin.plant.errors import InputError
from twin.rig.recording import ACKNOWLEDGEMENTS, COMMANDS, FORMAT_VERSION, PROPERTY, ROOT
from twin.rig.regroup import Mark
from twin.rig.rrf import Rows, extent, rows
from twin.rig.storage import part_of, parts_beside

HELD_BYTES = 256_000_000
"""Raw blocks up to so much stay in memory once read, if asked: a minute at 50 kS/s is read once and not twice."""


_UNREADABLE = (pa.ArrowException, OSError, ValueError, KeyError, TypeError, AttributeError, IndexError)


class NotOursError(InputError):
    """A Rerun file of another program."""


@dataclass(frozen=True, slots=True, weakref_slot=True)
class Recording:
    """A recorded run.

    Attributes
    ----------
    path
        The file as given.
    parts
        The files of the run that are read, in order.
    missing_parts
        Numbers of files that are no longer there, or not yet found, before or between those.
    plant, config_id, sample_rate_hz, channels, run_config_json, seed, software
        As the recorder was given them.
    program_version
        Of the program that recorded it.
    n_samples, n_blocks
        Samples and blocks in the file; lost blocks do not count.
    end_sample
        Index of the first sample after the last block.
    repaired
        A file was cut short, what follows its last whole row is lost; or `damaged_rows` are.
    damaged_rows
        So many pieces of the file, blocks or others, are damaged and left out.
    finished
        The recorder closed its last file; else it was killed, or is still at it.
    """

    path: Path
    parts: tuple[Path, ...]
    missing_parts: tuple[int, ...]
    plant: Plant
    config_id: str
    sample_rate_hz: float
    channels: tuple[Channel, ...]
    run_config_json: str
    seed: int | None
    software: dict[str, str]
    program_version: str
    n_samples: int
    n_blocks: int
    end_sample: int
    repaired: bool
    damaged_rows: int
    finished: bool
    _run_id: str
    _in_order: bool
    _notes: dict[str, list[tuple[int, str]]] = field(repr=False)
    _marks: tuple[Mark, ...] = field(repr=False)
    _held: tuple[pa.RecordBatch, ...] | None = field(repr=False)

    @property
    def source(self) -> Path:
        """The first file that is read."""
        return self.parts[0]

    @property
    def marks(self) -> tuple[Mark, ...]:
        """Every block without its samples, by first sample."""
        return self._marks

    def blocks(self, from_sample: int = 0) -> Iterator[Block]:
        """Blocks as they were recorded, by first sample; a few at a time in memory unless they lie out of order.

        Parameters
        ----------
        from_sample
            Leave out blocks that begin before.

        Raises
        ------
        InputError
            At a block whose checksum is wrong.
        """
        found = self._in_words(self._blocks_in_file(from_sample))
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

    def _in_words(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Say it where a block's description, which no checksum covers, has become another."""
        try:
            yield from blocks
        except _UNREADABLE as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{self.path}: a block's description is damaged ({error}); use another copy of the file, or leave the "
                "block out with 'atmd recordings repair'"
            ) from error

    def _blocks_in_file(self, from_sample: int) -> Iterator[Block]:
        for batch in self._batches():
            cells, times = batch.column("block"), batch.column("time").cast(pa.int64()).to_pylist()
            for row, sample in enumerate(batch.column("sample").to_pylist()):
                if sample >= from_sample:
                    yield self._block(sample, times[row], cells[row].as_py()[0])

    def _batches(self) -> Iterator[pa.RecordBatch]:
        if self._held is not None:
            yield from self._held
            return
        for part in self.parts:
            for found in rows(part):
                if found.batch is not None and found.entity == f"/{ROOT}/raw":
                    yield found.batch

    def _block(self, first_sample: int, time_ns: int, row: dict[str, Any]) -> Block:
        if not _is_whole(first_sample, time_ns, row, self.sample_rate_hz, len(self.channels)):
            raise InputError(
                f"{self.path}: the block at sample {first_sample} "
                f"({first_sample / self.sample_rate_hz:.3f} s) is damaged; use another copy of the file, or leave the "
                "block out with 'atmd recordings repair'"
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


def open_recording(path: Path, *, hold_bytes: int = 0, alone: bool = False) -> Recording:
    """Open a recorded run, also one whose recorder was killed or whose file was cut short.

    Parameters
    ----------
    path
        A file, or a folder that holds one run. The first file there is of a run stands for all of them; any other for
        itself alone.
    hold_bytes
        Keep raw blocks in memory up to so much, for whoever reads them at once (see `HELD_BYTES`).
    alone
        Take the first file for itself alone, too.

    Raises
    ------
    InputError
        If a file cannot be read, holds no whole row, is no recording of this program, or a folder holds no run, or
        more than one.
    """
    path = Path(path)
    if path.is_dir():
        path = _only_run(path)
    first = _open_file(path, hold_bytes)
    _, number = part_of(path)
    beside = {} if alone else parts_beside(path)
    if min(beside, default=number) != number:
        return first
    found, numbers, begun_only = [first], [number], False
    for k, other in sorted(beside.items()):
        if k <= number:
            continue
        try:
            part = _open_file(other, hold_bytes - sum(_held_bytes(p) for p in found))
        except InputError:
            begun_only = k == max(beside)  # killed before its first row, or nothing of it is left
            continue
        if part._run_id != first._run_id:
            continue  # another run's, left beside this one
        found.append(part)
        numbers.append(k)
    missing = (
        tuple(k for k in range(1, numbers[-1]) if k not in numbers) if len(found) > 1 or number > 1 else ()
    )
    whole = _joined(found, missing)
    return replace(whole, finished=False) if begun_only else whole


def _joined(parts: list[Recording], missing: tuple[int, ...]) -> Recording:
    """One run of several files."""
    first = parts[0]
    if len(parts) == 1:
        return replace(first, missing_parts=missing) if missing else first
    notes: dict[str, list[tuple[int, str]]] = {}
    for part in parts:
        for kind, lines in part._notes.items():
            notes.setdefault(kind, []).extend(lines)
    marks = sorted((mark for part in parts for mark in part.marks), key=_first_sample)
    held = [part._held for part in parts]
    return replace(
        first,
        parts=tuple(p for part in parts for p in part.parts),
        missing_parts=missing,
        n_samples=sum(part.n_samples for part in parts),
        n_blocks=sum(part.n_blocks for part in parts),
        end_sample=max(part.end_sample for part in parts),
        repaired=any(part.repaired for part in parts),
        damaged_rows=sum(part.damaged_rows for part in parts),
        finished=parts[-1].finished,
        _in_order=all(part._in_order for part in parts)
        and all(a.end_sample <= b.marks[0].first_sample for a, b in pairwise(parts) if b.marks),
        _notes={kind: sorted(rows, key=lambda row: row[0]) for kind, rows in notes.items()},
        _marks=tuple(marks),
        _held=None if None in held else tuple(batch for some in held if some is not None for batch in some),
    )


def blocks_are_whole(recording: Recording, found: Rows) -> bool:
    """Whether rows of a recording's file hold no block that is not what was recorded."""
    batch = found.batch
    if batch is None or found.entity != f"/{ROOT}/raw":
        return batch is not None
    try:
        firsts, times = (batch.column(name).cast(pa.int64()).to_pylist() for name in ("sample", "time"))
        return all(
            _is_whole(first, time_ns, cell.as_py()[0], recording.sample_rate_hz, len(recording.channels))
            for first, time_ns, cell in zip(firsts, times, batch.column("block"), strict=True)
        )
    except _UNREADABLE:
        return False


def _is_whole(first: int, time_ns: int, row: dict[str, Any], rate_hz: float, n_channels: int) -> bool:
    """Whether a block's checksum is right, it is as long as it says, and stands where it belongs."""
    n_bytes = {"<f4": 4, "<f8": 8}.get(row["dtype"], 0) * row["n_samples"] * n_channels
    return (
        zlib.crc32(row["invalid"], zlib.crc32(row["samples"])) == row["crc32"]
        and len(row["samples"]) == n_bytes
        and time_ns == round(first / rate_hz * 1e9)  # two records of the same
    )


def _only_run(folder: Path) -> Path:
    runs: dict[Path, int] = {}
    for file in folder.glob("*.rrd"):
        first, number = part_of(file)
        runs[first] = min(number, runs.get(first, number))
    if len(runs) != 1:
        names = ", ".join(sorted(p.name for p in runs)) or "none"
        raise InputError(f"{folder}: holds not one run but {names}; give the file")
    ((first, number),) = runs.items()
    return parts_beside(first)[number]


def _held_bytes(recording: Recording) -> int:
    return sum(batch.nbytes for batch in recording._held or ())


def _open_file(path: Path, hold_bytes: int) -> Recording:
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
        return _scan(path, hold_bytes)
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: is damaged and nothing in it can be recovered ({error}); use another copy"
        ) from error


def _scan(path: Path, hold_bytes: int) -> Recording:
    """One pass over the file: properties, notes, and where the blocks are."""
    frame, damaged, any_rows = extent(path), 0, False
    properties: dict[str, str] = {}
    notes: dict[str, list[tuple[int, bytes, str]]] = {}
    marks: list[Mark] = []
    held: list[pa.RecordBatch] | None = [] if hold_bytes > 0 else None
    for found in rows(path):
        entity, batch = found.entity, found.batch
        if batch is None:
            damaged += 1
            continue
        any_rows = True
        if entity == f"/__properties/{PROPERTY}":
            properties |= {
                name: str(_first(batch.column(name)[batch.num_rows - 1].as_py()))
                for name in batch.schema.names
                if not name.startswith("rerun.")
            }
        elif entity == f"/{ROOT}/raw":
            marks += _marks_in(batch)
            hold_bytes -= batch.nbytes
            if held is not None and hold_bytes >= 0:
                held.append(batch)
            else:
                held = None
        elif entity.startswith(f"/{ROOT}/"):
            lines = zip(
                batch.column("sample").to_pylist(),
                batch.column("rerun.controls.RowId").to_pylist(),
                (_first(text) for text in batch.column("json").to_pylist()),
                strict=True,
            )
            notes.setdefault(entity.removeprefix(f"/{ROOT}/"), []).extend(lines)
    if not any_rows:
        raise InputError(f"{path}: is cut short before its first whole row; nothing was recorded")
    known = _parse(path, properties)
    return Recording(
        path=path,
        parts=(path,),
        missing_parts=(),
        **known,
        n_samples=sum(mark.n_samples for mark in marks),
        n_blocks=len(marks),
        end_sample=max((mark.end_sample for mark in marks), default=0),
        repaired=frame.cut or damaged > 0,
        damaged_rows=damaged,
        finished=frame.finished,
        _run_id=properties.get("run_id", ""),
        _in_order=all(a.first_sample <= b.first_sample for a, b in pairwise(marks)),
        # Row ids count up as rows are written: they keep the order of notes at the same sample.
        _notes={kind: [(sample, text) for sample, _, text in sorted(lines)] for kind, lines in notes.items()},
        _marks=tuple(sorted(marks, key=_first_sample)),
        _held=None if held is None else tuple(held),
    )


def _marks_in(batch: pa.RecordBatch) -> list[Mark]:
    firsts, blocks = batch.column("sample").to_pylist(), batch.column("block").flatten()
    names = ("n_samples", "config_id", "control_on", "commands_applied")
    columns = [blocks.field(name).to_pylist() for name in names]
    return [
        Mark(first, n, config_id, on, tuple(applied))
        for first, n, config_id, on, applied in zip(firsts, *columns, strict=True)
    ]


def _first_sample(mark: Mark) -> int:
    return mark.first_sample


def _parse(path: Path, properties: dict[str, str]) -> dict[str, Any]:
    if "format_version" not in properties:
        raise NotOursError(
            f"{path}: is no recording of this program; give a file that 'atmd' recorded, or say with --plant whose "
            "channels its scalars are"
        )
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
            "software": json.loads(properties.get("software", "{}")),
            "program_version": properties["program_version"],
        }
    except (KeyError, ValidationError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: its description of the run cannot be used: {error}") from error


def _first(cell: list[Any] | None) -> Any:
    """The one value of a component's cell; Rerun stores every cell as a list."""
    return cell[0] if cell else None
