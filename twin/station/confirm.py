"""What was guessed about a recording is shown to a person and used only if that person says so."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from twin.plant.errors import InputError
from twin.station.terminal import people, say

if TYPE_CHECKING:
    from twin.rig.foreign import ForeignRecording

YesOption = Annotated[
    bool,
    typer.Option("--yes", "-y", help="Take what is guessed about the file's channels and units as right."),
]
WriteSidecarOption = Annotated[
    bool,
    typer.Option(
        "--write-sidecar",
        help="Write what was found and confirmed to a .toml beside the file, so that it is known from then on.",
    ),
]


def somebody_is_there() -> bool:
    """Whether a person can be asked: both ends are a terminal."""
    return sys.stdin.isatty() and people.is_terminal


def accept_recording(
    recording: "ForeignRecording", *, yes: bool = False, write_sidecar: bool = False
) -> None:
    """Have a person confirm what was guessed about a recording, and write it down if wanted.

    Raises
    ------
    InputError
        If the person says no, or nobody is there to be asked: what is guessed is never used by itself. Or the sidecar
        cannot be written.
    """
    sidecar = recording.path.with_suffix(".toml")
    if write_sidecar and sidecar.exists():
        raise InputError(f"--write-sidecar: {sidecar} is there already; move it away first")
    if recording.guesses and not yes:
        _ask(recording, sidecar)
    if write_sidecar:
        try:
            sidecar.write_text(recording.sidecar, encoding="utf-8")
        except OSError as error:
            raise InputError(
                f"--write-sidecar: {sidecar} cannot be written ({error.strerror}); copy the recording "
                "to a folder of yours"
            ) from error
        say(f"{sidecar}: written; channels, units and rate are known from now on")


def confirm_guesses(guesses: Sequence[str], *, yes: bool) -> None:
    """Show what a fit guessed, and have a person confirm it where one is there.

    Raises
    ------
    InputError
        If the person says no.
    """
    for line in guesses:
        say(f"guessed: {line}")
    if guesses and not yes and somebody_is_there() and not typer.confirm("Is this right?", err=True):
        raise InputError(
            "not confirmed; say where each quantity lies with --channel NAME=ARRAY:UNIT, or in a sidecar"
        )


def _ask(recording: "ForeignRecording", sidecar: Path) -> None:
    options = [
        f"--channel {entry.channel}={entry.ref}:{entry.unit}" for entry in recording.mapping if entry.guess
    ]
    if not somebody_is_there():
        lines = [
            f"{recording.path}: guessed, and nobody is here to confirm it:",
            *(f"  {line}" for line in recording.guesses),
            f"If that is right, give --yes (and --write-sidecar to have it in {sidecar.name} for good); "
            f"else say what is, such as {' '.join(options)}, or write {sidecar.name}:",
            *(f"  {line}" for line in recording.sidecar.splitlines()),
        ]
        raise InputError("\n".join(lines))
    for entry in recording.mapping:
        say(f"{'? ' if entry.guess else '  '}{entry}")
    for note in recording.notes:
        say(f"  {note}")
    if not typer.confirm("What is marked with ? was guessed. Is it right?", err=True):
        raise InputError(f"{recording.path}: not confirmed; say what is right, such as {' '.join(options)}")
