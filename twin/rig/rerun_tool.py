"""Rerun's own program from the installed package: where it is, and how to run it without telemetry."""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

from twin.plant.errors import InputError


def rerun_program() -> str:
    """Path of the ``rerun`` executable that belongs to the installed package.

    Raises
    ------
    InputError
        If the package came without it.
    """
    spec = find_spec("rerun_cli")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else Path(sys.prefix)
    for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
        if (folder / name).is_file():
            return str(folder / name)
    raise InputError(f"{folder}: the rerun executable is missing; reinstall rerun-sdk")


def rerun_environment() -> dict[str, str]:
    """Environment in which the executable neither collects nor sends usage data.

    It has no switch of its own for that; with ``CI`` set it does not even make up an identifier. Its log is
    left to errors.
    """
    return os.environ | {"CI": "1", "RERUN_APP_ONLY": "true", "RUST_LOG": os.environ.get("RUST_LOG", "error")}
