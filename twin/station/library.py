"""``atmd recordings``: what is recorded, whether it is whole, and how to get it out."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from twin.plant.blocks import Block
from twin.plant.errors import InputError
from twin.station.terminal import JsonOption, must_be_writable, progress_bar, report, say

if TYPE_CHECKING:
    from twin.rig.recorded import Recording

recordings_app = typer.Typer(
    name="recordings",
    no_args_is_help=True,
    help="List, show, verify, repair and export recordings.",
    context_settings={"help_option_names": ["-h", "--help"]},
)

FileArgument = Annotated[Path, typer.Argument(metavar="FILE.rrd", help="A recording.", show_default=False)]
EXIT_DAMAGED = 1


@dataclass(frozen=True, slots=True)
class Inspection:
    """What a look at every block of a recording found.

    Attributes
    ----------
    blocks
        Blocks in the recording.
    good_blocks
        Blocks whose checksum is right, from the beginning to the first damage.
    gaps
        (first sample, samples) of stretches that no block covers.
    masked
        Samples that are there but not valid.
    damage
        What is wrong, one sentence each; empty for a whole recording.
    """

    blocks: int
    good_blocks: int
    gaps: tuple[tuple[int, int], ...]
    masked: int
    damage: tuple[str, ...]


@recordings_app.command("list", epilog="Example: atmd recordings list runs")
def list_recordings(
    folder: Annotated[Path, typer.Argument(help="Where to look, folders inside it included.")] = Path("runs"),
    json_to: JsonOption = None,
) -> None:
    """List the recordings in a folder, newest first, those that cannot be read with the reason."""
    from twin.rig.storage import parts_beside

    must_be_writable(json_to)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; give the one with the recordings")
    files = [path for path in folder.rglob("*.rrd") if path == min(parts_beside(path).items())[1]]
    files.sort(key=lambda p: p.stat().st_mtime, reverse=True)
    rows = []
    with progress_bar("list") as progress:
        for done, path in enumerate(files, start=1):
            rows.append(_line(path))
            progress(done, len(files))

    def table(_: dict[str, Any]) -> Table:
        out = Table("recording", "plant", "length", "size", "commands", "remark", title=str(folder))
        for row in rows:
            length = "-" if row["seconds"] is None else f"{row['seconds']:.1f} s"
            commands = "-" if row["commands"] is None else str(row["commands"])
            name = str(Path(row["file"]).relative_to(folder))
            out.add_row(
                name, row["plant"] or "-", length, f"{row['bytes'] / 1e6:.1f} MB", commands, row["remark"]
            )
        return out

    report({"recordings": rows}, table, json_to)


@recordings_app.command("show", epilog="Example: atmd recordings show runs/demo.rrd --json -")
def show(file: FileArgument, json_to: JsonOption = None) -> None:
    """Show what a recording is about: plant, channels, commands with the rig's answers, events, decisions.

    JSON keys: file, plant, config_id, sample_rate_hz, channels, seconds, blocks, seed, program_version, repaired,
    commands, acknowledgements, decisions, events, run_config.
    """
    from twin.rig.recorded import open_recording

    must_be_writable(json_to)
    recording = open_recording(file)
    notes = {
        kind: [{"sample": sample, **_object(text)} for sample, text in recording.notes(kind)]
        for kind in ("commands", "acknowledgements", "decisions", "events")
    }
    result = {
        "file": str(file),
        "plant": recording.plant.name,
        "config_id": recording.config_id,
        "sample_rate_hz": recording.sample_rate_hz,
        "channels": [{"name": c.name, "unit": c.unit} for c in recording.channels],
        "seconds": recording.end_sample / recording.sample_rate_hz,
        "blocks": recording.n_blocks,
        "seed": recording.seed,
        "program_version": recording.program_version,
        "repaired": recording.repaired,
        **notes,
        "run_config": _object(recording.run_config_json),
    }

    def table(r: dict[str, Any]) -> Table:
        out = Table("time", "what", title=f"{file}: {r['plant']} ({r['config_id']})", title_justify="left")
        rate = recording.sample_rate_hz
        out.add_row(
            "",
            f"{r['seconds']:.1f} s, {r['blocks']} blocks at {rate:g} samples/s; made by {r['program_version']}",
        )
        out.add_row("", escape(", ".join(f"{c.name} [{c.unit}]" for c in recording.channels)))
        lines = [(n["sample"], f"{n['level']}: {n['text']}") for n in notes["events"] if "text" in n]
        lines += [(n["sample"], f"command {n['command_id']} due") for n in notes["commands"]]
        lines += [
            (
                n["sample"],
                f"command {n['command_id']} " + ("accepted" if n["accepted"] else f"refused: {n['reason']}"),
            )
            for n in notes["acknowledgements"]
        ]
        for sample, line in sorted(lines):
            out.add_row(f"{sample / rate:.2f} s", escape(line))
        return out

    report(result, table, json_to)


@recordings_app.command("verify", epilog="Example: atmd recordings verify runs/*.rrd")
def verify(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE.rrd ...", help="Recordings.", show_default=False)
    ],
    json_to: JsonOption = None,
) -> None:
    """Read every sample of recordings and compare the checksums. Ends with 1 if any is damaged or cut short.

    JSON keys: files, each with file, whole, good_blocks, blocks, gaps ([first sample, samples]), masked_samples and
    damage.
    """
    must_be_writable(json_to)
    rows = []
    with progress_bar("verify") as progress:
        for done, file in enumerate(files):
            rows.append(_verified(file, partial(_share, progress, done, len(files))))

    def table(_: dict[str, Any]) -> Table:
        out = Table("recording", "whole", "blocks", "masked", "remark")
        for row in rows:
            remark = "; ".join(
                [*row["damage"], *(f"{n} samples missing from {first}" for first, n in row["gaps"])]
            )
            out.add_row(
                row["file"], "yes" if row["whole"] else "no", f"{row['good_blocks']} of {row['blocks']}",
                str(row["masked_samples"]), remark or "-",
            )  # fmt: skip
        return out

    report({"files": rows}, table, json_to)
    if not all(row["whole"] for row in rows):
        raise typer.Exit(EXIT_DAMAGED)


@recordings_app.command("repair", epilog="Example: atmd recordings repair runs/cut.rrd --out runs/whole.rrd")
def repair(
    file: FileArgument,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.rrd", help="Where to write what is whole.")],
) -> None:
    """Copy all that is whole of a recording to a new file, or to as many as it has; the old ones stay as they are.

    What is left out: what follows the last whole row of a file that was cut short, and pieces that are damaged.
    """
    from twin.rig.recorded import blocks_are_whole, open_recording
    from twin.rig.rrf import copy_sound_part
    from twin.rig.storage import part_of, part_path

    if not out.absolute().parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.absolute().parent}; make it first")
    recording = open_recording(file)
    copies = [part_path(out, part_of(part)[1]) for part in recording.parts]
    for copy in (out, *copies):
        if copy.exists():
            raise InputError(f"{copy}: is there already; choose another name or remove it first")
    left_out = 0
    with progress_bar("repair") as progress:
        for done, (part, copy) in enumerate(zip(recording.parts, copies, strict=True)):
            left_out += copy_sound_part(part, copy, partial(blocks_are_whole, recording))
            progress(done + 1, len(copies))
    found = inspect(copies[0])
    say(f"{out}: {found.good_blocks} blocks, {recording.end_sample / recording.sample_rate_hz:.1f} s")
    if left_out:
        say(f"{left_out} damaged pieces of {file} are left out")
    elif not recording.repaired:
        say(f"{file} was neither cut short nor damaged")
    for sentence in found.damage:
        say(sentence)
    if found.damage:
        raise typer.Exit(EXIT_DAMAGED)


@recordings_app.command("export", epilog="Example: atmd recordings export runs/demo.rrd --out demo.tdms")
def export_recording(
    file: FileArgument,
    out: Annotated[
        Path,
        typer.Option(
            "--out", metavar="FILE", help="Its ending chooses: .csv, .parquet, .tdms, .npz, .mat, .wav, .uff."
        ),
    ],
    from_s: Annotated[float, typer.Option("--from", min=0.0, help="First moment, in s.")] = 0.0,
    to_s: Annotated[
        float | None, typer.Option("--to", min=0.0, help="Last moment, in s; the end unless given.")
    ] = None,
) -> None:
    """Write the measured channels of a recording in another format, in SI units, NaN where no valid sample is."""
    from twin.rig.recorded import open_recording
    from twin.rig.writers import Series, write_series

    recording = open_recording(file)
    rate = recording.sample_rate_hz
    first, stop = round(from_s * rate), recording.end_sample if to_s is None else round(to_s * rate)
    if not first < min(stop, recording.end_sample):
        raise InputError(
            f"--from {from_s:g} --to {stop / rate:g}: the recording ends at {recording.end_sample / rate:g} s"
        )
    with progress_bar("export") as progress:
        series = Series(recording.channels, rate, lambda: _between(recording.blocks, first, stop, progress))
        write_series(out, series)
    say(
        f"{out}: {', '.join(c.name for c in recording.channels)}, "
        f"{first / rate:g} to {min(stop, recording.end_sample) / rate:g} s"
    )


@recordings_app.command(
    "smooth", epilog="Example: atmd recordings smooth runs/demo.rrd --out states.parquet --every 50"
)
def smooth(
    file: FileArgument,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE", help="Its ending chooses: .csv, .parquet, .tdms, .npz, .mat."),
    ],
    every: Annotated[int, typer.Option(min=1, help="Keep one sample in so many.")] = 50,
) -> None:
    """Estimate every state from the whole recording, later samples included, each with its standard deviation.

    Rauch-Tung-Striebel smoothing with the model that a replay identifies. Columns are the observer's states, such as
    x_table, and x_table_std.
    """
    from twin.rig.writers import Series, write_series
    from twin.station.smoothing import smooth_recording

    with progress_bar("smooth") as progress:
        channels, rate, blocks = smooth_recording(file, every, say, progress)
    write_series(out, Series(channels, rate, lambda: iter(blocks)))
    say(f"{out}: {', '.join(c.name for c in channels[::2])} with standard deviations, {rate:g} samples/s")


def inspect(file: Path, progress: Callable[[int, int], None] = lambda _done, _total: None) -> Inspection:
    """Look at every block of a recording; ``progress`` takes blocks done and blocks in all.

    Raises
    ------
    InputError
        If it is no recording at all.
    """
    from twin.rig.recorded import open_recording

    recording = open_recording(file)
    damage = ["cut short: what follows its last whole row is lost"] if recording.repaired else []
    if recording.damaged_rows:
        damage = [f"{recording.damaged_rows} pieces of it are damaged and left out"]
    good = masked = 0
    following: int | None = None
    gaps = []
    try:
        for block in recording.blocks():
            good += 1
            progress(good, recording.n_blocks)
            masked += block.valid.size - int(block.valid.sum())
            if following is not None and block.first_sample > following:
                gaps.append((following, block.first_sample - following))
            following = block.end_sample
    except InputError as error:
        damage.append(str(error).removeprefix(f"{file}: "))
    return Inspection(recording.n_blocks, good, tuple(gaps), masked, tuple(damage))


def _share(progress: Callable[[int, int], None], files_done: int, files: int, done: int, total: int) -> None:
    """Progress within one of several files, in thousandths."""
    progress(round(1000.0 * (files_done + done / max(total, 1))), 1000 * files)


def _verified(file: Path, progress: Callable[[int, int], None]) -> dict[str, Any]:
    try:
        found = inspect(file, progress)
    except InputError as error:
        found = Inspection(0, 0, (), 0, (str(error).removeprefix(f"{file}: "),))
    return {
        "file": str(file),
        "whole": not found.damage,
        "good_blocks": found.good_blocks,
        "blocks": found.blocks,
        "gaps": [list(gap) for gap in found.gaps],
        "masked_samples": found.masked,
        "damage": list(found.damage),
    }


def _line(path: Path) -> dict[str, Any]:
    from twin.rig.recorded import open_recording

    row: dict[str, Any] = {"file": str(path), "bytes": path.stat().st_size}
    try:
        recording = open_recording(path)
    except InputError as error:
        return row | {
            "plant": None,
            "seconds": None,
            "commands": None,
            "remark": str(error).removeprefix(f"{path}: "),
        }
    return row | {
        "bytes": sum(part.stat().st_size for part in recording.parts),
        "plant": recording.plant.name,
        "seconds": recording.end_sample / recording.sample_rate_hz,
        "commands": len(recording.commands()),
        "remark": _remark(recording),
    }


def _remark(recording: "Recording") -> str:
    if recording.damaged_rows:
        return f"damaged; {recording.damaged_rows} pieces are left out"
    if recording.repaired:
        return "cut short; readable to its last whole block"
    if not recording.finished:
        return "not finished: its recorder was killed, or is still at it"
    return f"in {len(recording.parts)} files" if len(recording.parts) > 1 else ""


def _between(
    blocks: Callable[[], Iterator[Block]], first: int, stop: int, progress: Callable[[int, int], None]
) -> Iterator[Block]:
    for block in blocks():
        if block.end_sample <= first:
            continue
        if block.first_sample >= stop:
            return
        a, b = max(0, first - block.first_sample), min(block.n_samples, stop - block.first_sample)
        yield Block(
            block.first_sample + a, block.sample_rate_hz, block.values[a:b], block.valid[a:b], block.channels,
            block.config_id, block.control_on, block.commands_applied if a == 0 else (),
        )  # fmt: skip
        progress(min(block.end_sample, stop) - first, stop - first)


def _object(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except json.JSONDecodeError:
        return {"text": text}
    return found if isinstance(found, dict) else {"value": found}
