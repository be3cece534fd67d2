"""The wire between rig and station: real sockets, real processes, and what happens when one of them dies."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import psutil
import pytest
import zmq
from numpy.typing import NDArray

from tuning.rule import scheduling_rule
from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.plant.config import DampingTable
from twin.plant.errors import RunError
from twin.plant.files import load_plant
from twin.rig import gateway as gateway_module
from twin.rig.embedded import EmbeddedRig
from twin.rig.gateway import RigGateway
from twin.rig.programme import Programme, Sweep, rig_channels
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import (
    TOPIC_END,
    TOPIC_HELLO,
    TOPIC_SAMPLES,
    KeyPair,
    decode,
    encode,
    guard_client,
    guard_server,
)

BLOCK = 5_000
PLANT = load_plant("rig")
SCHEDULE = scheduling_rule(PLANT, [45.0, 50.0, 55.0])
WEAKER = SCHEDULE.model_copy(update={"beta_ns_m": tuple(0.5 * b for b in SCHEDULE.beta_ns_m)})


def programme(duration_s: float = 2.0) -> Programme:
    return Programme(
        plant=PLANT,
        true_damping=DampingTable(frequency_hz=(45.0, 55.0), ns_m=(14.5, 7.3)),
        sweep=Sweep(from_hz=49.0, to_hz=51.0, duration_s=duration_s, amplitude_v=4.0),
        schedule=SCHEDULE,
        seed=3,
    )


def work_through(rig: EmbeddedRig) -> Iterator[Block]:
    """Blocks of a rig whose station keeps up."""
    for block in rig.blocks():
        yield block
        rig.gateway.heartbeat(block.end_sample)


def gone(pid: int, within_s: float) -> bool:
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        with contextlib.suppress(psutil.NoSuchProcess):
            if psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
                time.sleep(0.05)
                continue
        return True
    return False


# --- a rig in a process of its own -------------------------------------------------------------------------


def test_run_over_the_wire_is_bit_for_bit_the_run_in_one_process() -> None:
    # A command ordered in time acts at its sample, whenever the message arrived: that is what makes runs repeat.
    order = Command(command_id=1, apply_at_sample=10 * BLOCK, schedule=WEAKER)
    off = Command(command_id=2, apply_at_sample=15 * BLOCK, control_enabled=False)
    alone = SimulatedRig(programme())
    alone.accept(order)
    alone.accept(off)
    received, answers = [], []
    with EmbeddedRig(programme(), speed=0.0) as rig:
        rig.connect()
        for block in work_through(rig):
            if block.first_sample == 2 * BLOCK:
                rig.gateway.send(order)
                rig.gateway.send(off)
            received.append(block)
            answers += rig.gateway.acknowledgements()
        answers += rig.gateway.acknowledgements()
        assert rig.gateway.dropped == 0
    assert [b.first_sample for b in received] == [k * BLOCK for k in range(20)]
    assert rig.channels == received[0].channels
    for block in received:
        values, on, expected = alone.next_block()
        np.testing.assert_array_equal(block.values, values.astype(np.float64))
        assert block.valid.all()
        assert block.control_on == on
        assert block.commands_applied == tuple(a.command_id for a in expected)
        assert block.config_id == PLANT.fingerprint
    assert alone.finished
    assert answers == [
        Acknowledgement(command_id=1, accepted=True, applied_at_sample=10 * BLOCK),
        Acknowledgement(command_id=2, accepted=True, applied_at_sample=15 * BLOCK),
    ]
    assert not rig.is_alive()


def replies(rig: EmbeddedRig) -> list[dict[str, object]]:
    """All that the rig has written back so far, unread by the gateway."""
    socket, found = rig.gateway._commands, []
    while socket.poll(200):
        found.append(decode(socket.recv()))
    return found


def test_garbage_and_orders_that_cannot_be_carried_out_are_refused_and_the_run_goes_on() -> None:
    too_fast = SCHEDULE.model_copy(update={"low_pass_hz": (30_000.0,) * 3})
    garbage = [
        b"", b"{", b"\xff\xfe\x00", b"[1, 2]", b"null", b"[" * 5000,
        b'{"type":"heartbeat","next_sample":' + b"9" * 5000 + b"}",
        b'{"type":"reformat"}', b'{"type":["command"]}', b'{"type":"heartbeat","next_sample":"soon"}',
    ]  # fmt: skip
    malformed = [
        None, 7, {}, {"command_id": 4}, {"command_id": -1, "apply_at_sample": 0},
        {"command_id": 5, "apply_at_sample": 0, "schedule": {"frequency_hz": [50.0]}},
        {"command_id": 6, "apply_at_sample": 0, "explode": True},
        {"command_id": 8, "apply_at_sample": 0, "schedule": too_fast.model_dump(mode="json")},
    ]  # fmt: skip
    samples = 0
    with EmbeddedRig(programme(), speed=0.0) as rig:
        rig.connect()
        for block in work_through(rig):
            samples += block.n_samples
            if block.first_sample == 0:
                for frame in garbage:
                    rig.gateway._commands.send(frame)
                for body in malformed:
                    rig.gateway._commands.send(json.dumps({"type": "command", "command": body}).encode())
                time.sleep(0.2)
        answers = replies(rig)
    assert samples == 20 * BLOCK
    refused = [a for a in answers if a["type"] == "refused"]
    assert len(refused) == len(garbage)
    assert all(a["reason"] for a in refused)
    unacknowledged = [a for a in answers if a["type"] == "ack"]
    assert [a["command_id"] for a in unacknowledged] == [0, 0, 0, 4, -1, 5, 6, 8]
    assert not any(a["accepted"] for a in unacknowledged)
    assert "malformed command" in str(unacknowledged[1]["reason"])
    assert "30000 Hz is not below half of the sample rate" in str(unacknowledged[-1]["reason"])


def test_rig_killed_in_mid_run_is_reported_with_the_last_sample_heard() -> None:
    with EmbeddedRig(programme(duration_s=60.0), speed=0.0) as rig:
        rig.connect()
        blocks = work_through(rig)
        for _ in range(3):
            next(blocks)
        os.kill(rig.pid, signal.SIGKILL)
        with pytest.raises(RunError, match=r"process ended in mid-run \(last sample \d+\)"):
            for _ in blocks:
                pass


def test_rig_outlives_nobody_its_process_ends_when_its_starter_is_killed() -> None:
    script = (
        "import sys, time\n"
        "from tests_programme import rig\n"
        "with rig as r:\n"
        "    r.connect()\n"
        "    print(r.pid, flush=True)\n"
        "    for block in r.blocks():\n"
        "        time.sleep(60.0)\n"
    )
    order = programme(duration_s=600.0).model_dump_json()
    header = (
        "import sys, types\n"
        "from twin.rig.embedded import EmbeddedRig\n"
        "from twin.rig.programme import Programme\n"
        "m = types.ModuleType('tests_programme')\n"
        "m.rig = EmbeddedRig(Programme.model_validate_json(sys.stdin.readline()), speed=1.0)\n"
        "sys.modules['tests_programme'] = m\n"
    )
    starter = subprocess.Popen(
        [sys.executable, "-c", header + script],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert starter.stdin is not None
    assert starter.stdout is not None
    try:
        starter.stdin.write(order.encode() + b"\n")
        starter.stdin.flush()
        pid = int(starter.stdout.readline())
        assert not gone(pid, 0.3)
        starter.kill()
        starter.wait()
        assert gone(pid, 10.0)
    finally:
        starter.kill()
        starter.wait()
        starter.stdin.close()
        starter.stdout.close()


def test_rig_in_real_time_without_heartbeats_falls_back_to_no_control() -> None:
    with EmbeddedRig(programme(duration_s=3.0), speed=1.0) as rig:
        rig.connect()
        on, notices = [], []
        for block in rig.blocks():
            on.append(block.control_on)
            notices.append(rig.gateway.notice)
            if len(on) == 12:
                # The operator's station is back and switches control on again. It boasts, but nobody can have
                # worked through what has not been sent: that must not keep the watch from acting later.
                rig.gateway.heartbeat(10**12)
                due = block.end_sample
                rig.gateway.send(Command(command_id=1, apply_at_sample=due, control_enabled=True))
                # Refused: repeated, out of date, for another rig; switching off alone is never too late.
                rig.gateway.send(Command(command_id=1, apply_at_sample=due, control_enabled=True))
                rig.gateway.send(Command(command_id=2, apply_at_sample=0, control_enabled=True))
                rig.gateway.send(Command(command_id=3, apply_at_sample=due, config_id="0123"))
        answers = {a.command_id: a for a in rig.gateway.acknowledgements() if not a.accepted}
    assert "repeated or out of order" in answers[1].reason
    assert "stale: it was due 1." in answers[2].reason
    assert "made for model 0123" in answers[3].reason
    first_off = on.index(
        False
    )  # safe half a second after the rig last heard of its station, by its own clock
    assert first_off == 5
    assert notices[first_off] == "station lost: control off"
    assert notices[0] == ""
    back = on.index(True, first_off)
    assert back >= 12
    assert notices[back] == ""
    # Silent again, it is lost again.
    assert on[-1] is False
    assert notices[-1] == "station lost: control off"


def test_program_that_cannot_be_run_ends_the_start_with_a_clear_error() -> None:
    broken = programme().model_copy(update={"block_samples": 0})
    with EmbeddedRig(broken, speed=0.0) as rig, pytest.raises(RunError, match="did not start"):
        rig.connect()


@contextlib.contextmanager
def bare_rig(station_public: bytes) -> Iterator[tuple[dict[str, int], KeyPair]]:
    """A rig's process without a station: its ports and keys."""
    keys = KeyPair.fresh()
    order = {
        "programme": programme(duration_s=0.3).model_dump(mode="json"),
        "rig_public": keys.public.decode(),
        "rig_secret": keys.secret.decode(),
        "station_public": station_public.decode(),
        "speed": 0.0,
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "twin.rig.process"], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(json.dumps(order).encode() + b"\n")
        process.stdin.flush()
        yield json.loads(process.stdout.readline()), keys
        process.wait(timeout=10.0)
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def station(ports: dict[str, int], keys: KeyPair, rig_public: bytes) -> RigGateway:
    addresses = (f"tcp://127.0.0.1:{ports[f'{kind}_port']}" for kind in ("samples", "commands"))
    return RigGateway(PLANT, *addresses, keys, rig_public)


def test_only_the_station_whose_key_the_rig_knows_gets_through(monkeypatch: pytest.MonkeyPatch) -> None:
    known, stranger = KeyPair.fresh(), KeyPair.fresh()
    with bare_rig(known.public) as (ports, rig_keys):
        monkeypatch.setattr(gateway_module, "CONNECT_TIMEOUT_S", 1.0)
        for keys, rig_public in ((stranger, rig_keys.public), (known, stranger.public)):
            refused = station(ports, keys, rig_public)
            with pytest.raises(RunError, match="no rig answered within 1 s: check address and keys"):
                refused.connect()
            refused.close()
        plain = zmq.Context()  # and one that speaks no CURVE at all
        socket = plain.socket(zmq.SUB)
        socket.linger = 0
        socket.connect(f"tcp://127.0.0.1:{ports['samples_port']}")
        socket.subscribe(b"")
        assert not socket.poll(500)
        plain.destroy(linger=0)

        monkeypatch.setattr(gateway_module, "CONNECT_TIMEOUT_S", 20.0)
        welcome = station(ports, known, rig_keys.public)
        welcome.connect()
        first = []
        for block in welcome.blocks():
            first.append(block.first_sample)
            welcome.heartbeat(block.end_sample)
        assert first == [0, BLOCK, 2 * BLOCK]
        welcome.close()


# --- a rig that misbehaves, played by the test -------------------------------------------------------------


HELLO: dict[str, object] = {
    "version": 2,
    "run_id": "a",
    "sample_rate_hz": 50_000.0,
    "block_samples": 100,
    "channels": [{"name": c.name, "unit": c.unit} for c in rig_channels(PLANT)],
}


@dataclass
class FalseRig:
    """A publisher that sends what the test wants, behind the same wire."""

    gateway: RigGateway
    samples: "zmq.Socket[bytes]"
    commands: "zmq.Socket[bytes]"

    def send(self, first: int, values: NDArray[np.float64], **changes: object) -> None:
        header: dict[str, object] = {
            "run_id": "a",
            "sequence": first // 100,
            "first_sample": first,
            "n_samples": len(values),
            "config_id": "abc",
            "control_on": True,
            "commands_applied": [],
            "notice": "",
        }
        payload = values.astype("<f4").tobytes()
        self.samples.send_multipart([TOPIC_SAMPLES, encode(header | changes), payload])


@pytest.fixture
def false_rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[FalseRig]:
    monkeypatch.setattr(gateway_module, "SILENCE_TIMEOUT_S", 0.4)
    context = zmq.Context()
    rig_keys, station_keys = KeyPair.fresh(), KeyPair.fresh()
    samples, commands = context.socket(zmq.PUB), context.socket(zmq.ROUTER)
    for socket in (samples, commands):
        guard_server(socket, rig_keys)
    ports = {
        "samples_port": samples.bind_to_random_port("tcp://127.0.0.1"),
        "commands_port": commands.bind_to_random_port("tcp://127.0.0.1"),
    }
    link = station(ports, station_keys, rig_keys.public)

    def hello() -> bool:
        samples.send_multipart([TOPIC_HELLO, encode(HELLO)])
        return True

    link.connect(hello)
    assert decode(commands.recv_multipart()[1]) == {"type": "start"}
    yield FalseRig(link, samples, commands)
    link.close()
    context.destroy(linger=0)


def rows(n: int, level: float = 1.0) -> NDArray[np.float64]:
    return np.full((n, len(rig_channels(PLANT))), level)


def test_lost_blocks_come_out_as_blocks_without_a_valid_sample_and_are_counted(false_rig: FalseRig) -> None:
    for k in (0, 1, 4, 5):
        false_rig.send(100 * k, rows(100, float(k)))
    false_rig.samples.send_multipart([TOPIC_END, encode({"next_sample": 600})])
    blocks = list(false_rig.gateway.blocks())
    assert false_rig.gateway.dropped == 2
    ends = [b.end_sample for b in blocks]
    assert [b.first_sample for b in blocks] == [0, *ends[:-1]]
    assert ends[-1] == 600
    valid = np.concatenate([b.valid for b in blocks])
    assert not valid[200:400].any()
    assert valid[:200].all()
    assert valid[400:].all()
    assert all(np.all(np.isfinite(b.values)) for b in blocks)


def test_samples_that_are_no_numbers_or_at_the_end_of_range_are_masked(false_rig: FalseRig) -> None:
    values = rows(10)
    values[2, 0], values[3, 0], values[4, 0] = np.nan, np.inf, 696.5
    false_rig.send(0, values)
    block = next(false_rig.gateway.blocks())
    assert np.argwhere(~block.valid).tolist() == [[2, 0], [3, 0], [4, 0]]


def test_rig_that_falls_silent_is_given_up_with_the_last_sample_heard(false_rig: FalseRig) -> None:
    false_rig.send(0, rows(100))
    blocks = false_rig.gateway.blocks()
    next(blocks)
    with pytest.raises(RunError, match=r"silent for .* s \(last sample 99\)"):
        next(blocks)


@pytest.mark.parametrize(
    "changes",
    [
        {"n_samples": 7},
        {"n_samples": 10**9},
        {"first_sample": "now"},
        {"first_sample": -5},
        {"commands_applied": None},
    ],
)
def test_block_that_cannot_be_read_is_left_out_counted_and_told(
    false_rig: FalseRig, changes: dict[str, object]
) -> None:
    false_rig.send(0, rows(100))
    false_rig.send(100, rows(100), **changes)
    false_rig.samples.send_multipart([TOPIC_SAMPLES, b"\xff", b""])
    false_rig.samples.send_multipart([TOPIC_SAMPLES])
    false_rig.samples.send_multipart([TOPIC_HELLO, b"{"])
    false_rig.send(200, rows(100))
    false_rig.samples.send_multipart([TOPIC_END, encode({"next_sample": 300})])
    blocks = list(false_rig.gateway.blocks())
    assert [b.first_sample for b in blocks] == [0, 100, 200]
    assert [bool(b.valid.any()) for b in blocks] == [True, False, True]
    assert false_rig.gateway.malformed == 4
    assert false_rig.gateway.dropped == 1
    assert len(false_rig.gateway.events()) == 4


def test_rig_that_starts_again_goes_on_in_the_same_count_of_samples(false_rig: FalseRig) -> None:
    gateway = false_rig.gateway
    false_rig.send(0, rows(100))
    false_rig.samples.send_multipart([TOPIC_HELLO, encode(HELLO | {"run_id": "b", "waits_for_start": True})])
    false_rig.send(0, rows(100), run_id="b", sequence=0)
    false_rig.send(100, rows(100), run_id="a")  # a straggler of the run that is over
    false_rig.samples.send_multipart([TOPIC_END, encode({"next_sample": 100})])
    blocks = list(gateway.blocks())
    starts = [b.first_sample for b in blocks]
    assert starts == [0, *(b.end_sample for b in blocks[:-1])]
    assert blocks[0].valid.all()
    assert blocks[-1].valid.all()
    assert not any(b.valid.any() for b in blocks[1:-1])
    assert gateway.restarts == 1
    assert any("started again" in event for event in gateway.events())
    # What the rig calls sample 50 is another number here, and the other way round.
    offset = blocks[-1].first_sample
    gateway.send(Command(command_id=1, apply_at_sample=offset + 50))
    messages = [decode(false_rig.commands.recv_multipart()[1]) for _ in range(2)]
    assert messages[0] == {"type": "start"}
    assert messages[1]["command"]["apply_at_sample"] == 50


@pytest.mark.parametrize(
    "changes",
    [{"sample_rate_hz": 10_000.0}, {"channels": [{"name": "a", "unit": "V"}]}, {"config_id": "xyz"}],
)
def test_rig_that_comes_back_as_another_ends_the_run_with_words(
    false_rig: FalseRig, changes: dict[str, object]
) -> None:
    false_rig.send(0, rows(100))
    false_rig.samples.send_multipart([TOPIC_HELLO, encode(HELLO | {"run_id": "b"} | changes)])
    false_rig.send(0, rows(100), run_id="b", sequence=0)
    blocks = false_rig.gateway.blocks()
    assert next(blocks).first_sample == 0
    with pytest.raises(RunError, match=f"came back with another {next(iter(changes))}"):
        next(blocks)


def test_secret_key_is_not_shown() -> None:
    keys = KeyPair.fresh()
    assert keys.secret.decode() not in repr(keys)
    assert keys.public.decode() in repr(keys)


def test_message_without_an_end_is_not_taken_from_the_wire() -> None:
    # 64 MiB is far above any block; what is larger is dropped with its connection before it fills the memory.
    context = zmq.Context()
    keys = KeyPair.fresh()
    server, client = context.socket(zmq.ROUTER), context.socket(zmq.DEALER)
    guard_server(server, keys)
    guard_client(client, KeyPair.fresh(), keys.public)
    port = server.bind_to_random_port("tcp://127.0.0.1")
    client.connect(f"tcp://127.0.0.1:{port}")
    client.send(b"small")
    assert server.poll(5000)
    assert server.recv_multipart()[1] == b"small"
    client.send(b"\0" * (64 * 1024 * 1024 + 1))
    assert not server.poll(1500)
    context.destroy(linger=0)
