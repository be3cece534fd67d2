"""Reads damaged copies of a recording, in a process of its own: native code may crash, and memory is limited.

``python fuzz_reader.py FOLDER SEED CASES KIND ...``; a line of JSON before each case, with how the file was damaged,
and one after it, with what came of it.
"""

import faulthandler
import json
import resource
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import rerun as rr

from twin.plant.errors import InputError
from twin.rig.foreign import open_foreign
from twin.rig.recorded import open_recording
from twin.station.library import inspect

OWN = "own"
SLOW = ("hdf5", "mat v7.3")  # each looked at in a process of its own
MORE_MEMORY = 1 << 30
SECONDS = 40
TELLING = (
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    0x7FFFFFFFFFFFFFFF,
    0xFFFFFFFFFFFFFFFF,
)


def damaged(
    whole: bytes, rng: np.random.Generator, cases: int, *, few: bool = False
) -> Iterator[tuple[str, bytes]]:
    """Copies cut short, with bytes changed, with absurd numbers in, with parts doubled, lost, swapped."""
    size = len(whole)
    steps = {
        *range(0, 64, 7),
        *(size - k for k in range(1, 40, 6)),
        *(k for k in range(0, size, max(1, size // 12))),
    }
    for at in sorted(k for k in steps if 0 <= k < size)[:: 5 if few else 1]:
        yield f"cut at {at}", whole[:at]
    for _ in range(cases):
        way = rng.integers(0, 6)
        head = min(size, 3000) if rng.random() < 0.7 else size
        at = int(rng.integers(0, head))
        broken = bytearray(whole)
        if way <= 1:
            for place in rng.integers(0, head, int(rng.integers(1, 8))):
                broken[place] = rng.integers(0, 256)
            yield "bytes changed", bytes(broken)
        elif way == 2:
            width = int(rng.choice([2, 4, 8]))
            value = int(rng.choice(TELLING)) & (1 << (8 * width)) - 1 if rng.random() < 0.5 else TELLING[-1]
            at -= at % width
            broken[at : at + width] = (value & (1 << (8 * width)) - 1).to_bytes(width, "little")
            yield f"{value:x} at {at}", bytes(broken[:size])
        elif way == 3:
            to = int(rng.integers(at, size))
            yield f"without {at} to {to}", whole[:at] + whole[to:]
        elif way == 4:
            to = min(size, at + int(rng.integers(1, 400)))
            yield f"{at} to {to} doubled", whole[:to] + whole[at:]
        else:
            to = int(rng.integers(at, size))
            yield f"noise from {at} to {to}", whole[:at] + rng.bytes(to - at) + whole[to:]


def outcome(path: Path, plant: object, rate_hz: float) -> str:
    """What reading a file comes to: ``read``, ``refused: ...``, or what must not happen."""
    try:
        recording = open_foreign(path, plant, sample_rate_hz=rate_hz)  # type: ignore[arg-type]
        for k, block in enumerate(recording.blocks()):
            if not np.all(np.isfinite(block.values)):
                return "not finite"
            if k > 20_000:
                return "read on and on"
        recording.close()
    except InputError as error:
        return (
            f"refused: {error}"
            if str(path) in str(error) or path.stem in str(error)
            else f"nameless: {error}"
        )
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return "read"


def own_recording(folder: Path) -> Path:
    """A recording of this program, with blocks, notes and series to look at."""
    from test_recording import a_block, a_recorder

    path = folder / "own.rrd"
    with a_recorder(path) as recorder:
        for k in range(12):
            recorder.write_block(a_block(500 * k))
            recorder.write_note(
                "events", 500 * k, json.dumps({"sample": 500 * k, "level": "info", "text": "x"})
            )
            recorder.stream.log("x", rr.Scalars(float(k)))
    return path


def outcome_of_own(path: Path) -> str:
    """As `outcome`, of a recording of this program: what is read must be what was written."""
    from test_recording import a_block

    try:
        recording = open_recording(path)
        inspect(path)
        for block in recording.blocks():
            if block.values.tobytes() != a_block(block.first_sample).values.tobytes():
                return "other samples than were written"
        [json.loads(text) for _, text in recording.notes("events")]
    except InputError as error:
        return f"refused: {error}" if str(path) in str(error) else f"nameless: {error}"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return "read"


def main(kinds: list[str], folder: Path, seed: int, cases: int) -> None:
    """Of each kind write the file, then read so many damaged copies of it."""
    from test_archives import FORMATS, FS, PLANT

    warnings.simplefilter("ignore")
    faulthandler.enable()
    attempts: dict[str, tuple[Path, Callable[[], str]]] = {}
    for k, kind in enumerate(kinds):
        home = folder / str(k)
        home.mkdir()
        path = own_recording(home) if kind == OWN else FORMATS[kind](home)
        attempt = partial(outcome_of_own, path) if kind == OWN else partial(outcome, path, PLANT, FS)
        assert attempt() == "read"  # also brings in what is only imported then
        attempts[kind] = path, attempt
    limit = psutil.Process().memory_info().vms + MORE_MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    for kind, (path, attempt) in attempts.items():
        few = kind in SLOW
        for how, content in damaged(
            path.read_bytes(), np.random.default_rng(seed), 10 if few else cases, few=few
        ):
            path.write_bytes(content)
            print(json.dumps([kind, how]), flush=True)
            signal.alarm(SECONDS)  # ends the process, also in the middle of native code
            found = attempt()
            signal.alarm(0)
            print(json.dumps([kind, how, found]), flush=True)


if __name__ == "__main__":
    main(sys.argv[4:], Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
