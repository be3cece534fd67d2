"""The reference sender in C, compiled and run against the gateway: what docs/protocol.md promises a C programmer."""

import contextlib
import itertools
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from twin.control.schedule import Command
from twin.plant.errors import RunError
from twin.plant.files import load_plant
from twin.plant.linear import Array
from twin.rig.gateway import RigGateway
from twin.rig.keys import load_pair, load_public, make_keys

SOURCE = Path(__file__).parent.parent / "docs" / "sender" / "sender.c"
PLANT = load_plant("rig")
FS, BLOCK = 50_000.0, 5_000


@pytest.fixture(scope="module")
def sender(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("gcc") is None:
        pytest.skip("no gcc: apt-get install gcc")
    program = tmp_path_factory.mktemp("sender") / "sender"
    flags = ["-std=c11", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    built = subprocess.run(
        ["gcc", *flags, "-o", program, SOURCE, "-lzmq", "-lm", "-lpthread"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if "zmq.h" in built.stderr and "No such file" in built.stderr:
        pytest.skip("no ZeroMQ headers: apt-get install libzmq3-dev")
    assert built.returncode == 0, built.stderr
    return program


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    for name in ("rig", "station", "stranger"):
        make_keys(folder, name)
    return folder


def two_free_ports() -> int:
    for _ in range(100):
        with contextlib.suppress(OSError), socket.socket() as first, socket.socket() as second:
            first.bind(("127.0.0.1", 0))
            port = int(first.getsockname()[1])
            second.bind(("127.0.0.1", port + 1))
            return port
    raise AssertionError("no two neighbouring ports are free")


@contextlib.contextmanager
def running(sender: Path, keys: Path, blocks: int) -> Iterator[tuple[int, "subprocess.Popen[bytes]"]]:
    port = two_free_ports()
    process = subprocess.Popen(
        [sender, keys / "rig.key_secret", keys / "station.key", str(port), str(blocks)]
    )
    try:
        yield port, process
    finally:
        process.kill()
        process.wait()


def gateway(port: int, keys: Path, station: str = "station", rig: str = "rig") -> RigGateway:
    addresses = (f"tcp://127.0.0.1:{p}" for p in (port, port + 1))
    pair, public = load_pair(keys / f"{station}.key_secret"), load_public(keys / f"{rig}.key")
    samples, commands = addresses
    return RigGateway(PLANT, samples, commands, pair, public)


def expected(first: int, n: int) -> Array:
    """What the sender's formula gives, in SI units."""
    peaks = np.array([1.0, 0.5 * 9.80665, 0.0, 0.0, 1.5, 4.0, 0.0])
    t = (first + np.arange(n)) / FS
    return peaks * np.sin(2.0 * np.pi * 50.0 * t[:, None] + np.arange(7))


def test_samples_come_through_in_si_units_and_a_command_is_obeyed_where_it_is_acknowledged(
    sender: Path, keys: Path
) -> None:
    with running(sender, keys, 40) as (port, process):
        station = gateway(port, keys)
        hello = station.connect(timeout_s=20.0)
        assert hello.sample_rate_hz == FS
        answers, blocks = [], []
        for block in station.blocks():
            blocks.append(block)
            station.heartbeat(block.end_sample)
            if len(blocks) == 3:
                station.send(Command(command_id=7, apply_at_sample=block.end_sample, control_enabled=False))
                station.send(Command(command_id=8, apply_at_sample=block.end_sample))
            answers += station.acknowledgements()
        assert process.wait(10.0) == 0
        station.close()
    assert [c.unit for c in blocks[0].channels[:3]] == ["m/s²", "m/s²", "A"]
    assert len(blocks) >= 15
    for before, after in itertools.pairwise(blocks):
        assert after.first_sample == before.end_sample
    for block in blocks:
        np.testing.assert_allclose(block.values, expected(block.first_sample, BLOCK), atol=5e-6)
        assert block.valid.all()
    obeyed = next(b for b in blocks if b.commands_applied)
    assert obeyed.commands_applied == (7,)
    by_id = {a.command_id: a for a in answers}
    assert by_id[7].applied_at_sample == obeyed.first_sample
    assert by_id[7].accepted
    assert by_id[8].reason == "this sender has no gains to change"
    assert [b.control_on for b in blocks] == [b.first_sample < obeyed.first_sample for b in blocks]
    assert station.malformed == 0
    assert station.dropped == 0


@pytest.mark.parametrize(("station", "rig"), [("stranger", "rig"), ("station", "stranger")])
def test_stranger_hears_nothing_and_a_rig_with_another_key_is_not_heard(
    sender: Path, keys: Path, station: str, rig: str
) -> None:
    with running(sender, keys, 60) as (port, process):
        link = gateway(port, keys, station, rig)
        with pytest.raises(RunError, match="check address and keys"):
            link.connect(timeout_s=1.5)
        assert process.poll() is None
        link.close()
