"""A hundred thousand senseless messages at each socket of the wire: the loop goes on and loses nothing of sense."""

import math
import random
import time
from typing import Any

import numpy as np
import psutil
import zmq
from garbage import deep, spoiled, text
from test_wire import HELLO, PLANT, SCHEDULE, FalseRig, false_rig, programme, rows  # noqa: F401

from twin.control.schedule import Acknowledgement, Command
from twin.rig.embedded import EmbeddedRig
from twin.rig.gateway import RigGateway
from twin.rig.wire import TOPIC_END, TOPIC_HELLO, TOPIC_SAMPLES, decode, encode, guard_client

MESSAGES = 100_000
MOST_GROWTH_MB = 60.0


class HostileRig:
    """Everything that a rig with the right key could say by mistake or malice, but not what would be right."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.payload = rows(100).astype("<f4").tobytes()

    def header(self, at: int) -> dict[str, Any]:
        """Of a block that is well formed and not in its place: its number and its sample contradict each other."""
        rng = self.rng
        sequence = rng.choice(
            [rng.getrandbits(61), at // 100 + rng.randrange(200), rng.randrange(max(1, at // 100))]
        )
        return {
            "run_id": "a", "sequence": sequence, "first_sample": 100 * sequence + rng.randrange(1, 10**12),
            "n_samples": 100, "config_id": "abc", "control_on": True, "commands_applied": [], "notice": "boo",
        }  # fmt: skip

    def samples_message(self, at: int) -> list[bytes]:
        """One message for the samples socket."""
        rng, kind = self.rng, self.rng.randrange(10)
        header = self.header(at)
        match kind:
            case 0:
                topic = rng.choice([TOPIC_HELLO, TOPIC_SAMPLES, TOPIC_END])
                return [topic, *(rng.randbytes(rng.randrange(300)) for _ in range(rng.randrange(5)))]
            case 1:
                return [TOPIC_SAMPLES + rng.randbytes(3), text(header), self.payload]
            case 2:
                hello = dict(HELLO) | {"run_id": rng.choice(["a", "z", str(rng.random())])}
                return [TOPIC_HELLO, spoiled(rng, hello)]
            case 3:
                other = {
                    "run_id": "b",
                    "sample_rate_hz": rng.choice([1.0, 49_999.0, 1e8]),
                    "config_id": "other",
                }
                return [TOPIC_HELLO, encode(dict(HELLO) | other)]
            case 4:
                wrong = rng.choice(
                    [-1, 37, at + 100 * rng.randrange(1, 50) + 7, 2**70, math.nan, "now", None]
                )
                return [TOPIC_END, rng.choice([text({"next_sample": wrong}), deep(), b"", rng.randbytes(9)])]
            case 5:
                return [TOPIC_SAMPLES, text(header), self.payload[: rng.randrange(len(self.payload))]]
            case 6:
                return [TOPIC_SAMPLES, text(header | {"run_id": "elsewhere"}), self.payload]
            case 7:
                return [TOPIC_SAMPLES, text(header), self.payload]
            case _:
                return [TOPIC_SAMPLES, spoiled(rng, header), self.payload]

    def answer(self) -> list[bytes]:
        """One message for the commands socket."""
        rng = self.rng
        ack = {
            "type": "ack",
            "command_id": rng.randrange(2000, 9000),
            "accepted": True,
            "applied_at_sample": 5,
        }
        match rng.randrange(4):
            case 0:
                return [rng.randbytes(rng.randrange(200)) for _ in range(rng.randrange(1, 4))]
            case 1:
                return [text(ack)]
            case 2:
                return [spoiled(rng, {"type": "refused", "reason": "because"})]
            case _:
                return [spoiled(rng, ack | {"command_id": 10_000, "reason": "x"})]


def resident_mb(pid: int | None = None) -> float:
    return float(psutil.Process(pid).memory_info().rss) / 1e6


def test_hostile_rig_costs_the_station_no_block_and_no_memory(false_rig: FalseRig) -> None:  # noqa: F811
    station, rig = false_rig.gateway, HostileRig(seed=11)
    rig_side = false_rig.samples
    rig_side.sndhwm = 0
    blocks, sent, answers, events = station.blocks(patience_s=30.0), 0, 0, []
    per_block = 400
    begin_mb = 0.0
    for k in range(MESSAGES // per_block):
        for _ in range(per_block):
            rig_side.send_multipart(rig.samples_message(100 * k))
        false_rig.send(100 * k, rows(100, float(k)))
        if k == 50:
            # A large one, and one that never ends within reason.
            rig_side.send_multipart([TOPIC_SAMPLES, text(rig.header(100 * k)), bytes(30_000_000)])
            rig_side.send_multipart([TOPIC_SAMPLES, *[b""] * 20_000])
        block = next(blocks)
        assert block.first_sample == 100 * k
        assert block.valid.all()
        np.testing.assert_array_equal(block.values, rows(100, float(k)))
        assert station.notice == ""
        events += station.events()
        sent += per_block
        if k == MESSAGES // per_block // 4:
            begin_mb = resident_mb()
    assert sent == MESSAGES
    counts = station.counts
    assert (counts.received, counts.lost, station.restarts) == (MESSAGES // per_block, 0, 0)
    # All but hellos of runs that never came were counted, each with its reason; few enough were told.
    assert station.malformed + counts.late + counts.repeated > 0.8 * MESSAGES
    assert 20 < len(events) < 150
    for reason in (
        "header of a block cannot be read",
        "contradict",
        "an end",
        "hello cannot be read",
        "bytes, not",
    ):
        assert any(reason in event for event in events), reason
    assert max(map(len, events)) < 400
    assert resident_mb() - begin_mb < MOST_GROWTH_MB
    assert answers == 0


def test_hostile_answers_neither_hold_the_loop_up_nor_pass_for_acknowledgements(
    false_rig: FalseRig,  # noqa: F811
) -> None:
    station, rig = false_rig.gateway, HostileRig(seed=12)
    socket = false_rig.commands
    socket.sndhwm = 0
    station.heartbeat(0)
    who = socket.recv_multipart()[0]
    accepted: list[Acknowledgement] = []
    events: list[str] = []
    per_turn, begin_mb = 500, 0.0
    for k in range(1, MESSAGES // per_turn + 1):
        for _ in range(per_turn):
            socket.send_multipart([who, *rig.answer()])
        if k <= 20:
            station.send(Command(command_id=k, apply_at_sample=100 * k))
            while decode(socket.recv_multipart()[1])["command"]["command_id"] != k:
                pass
            right = {
                "type": "ack",
                "command_id": k,
                "accepted": True,
                "applied_at_sample": 100 * k,
                "reason": "",
            }
            socket.send_multipart([who, encode(right)])
            socket.send_multipart([who, encode(right)])  # a second one is one too many
        for _ in range(3):
            accepted += station.acknowledgements()
        events += station.events()
        if k == 50:
            begin_mb = resident_mb()
    end = time.monotonic() + 20.0
    while station._commands.poll(100) and time.monotonic() < end:
        accepted += station.acknowledgements()
    assert [a.command_id for a in accepted] == list(range(1, 21))
    assert [a.applied_at_sample for a in accepted] == [100 * k for k in range(1, 21)]
    assert station.malformed > 0.7 * MESSAGES
    assert any("was not sent" in event for event in events)
    assert len(events) < 100
    assert resident_mb() - begin_mb < MOST_GROWTH_MB
    for event in events:
        event.encode()  # what a log can take


COMMAND: dict[str, Any] = {
    "command_id": 7, "apply_at_sample": 10**9, "control_enabled": True, "schedule": SCHEDULE.model_dump(mode="json"),
}  # fmt: skip


def hostile_order(rng: random.Random) -> list[bytes]:
    """One message that no station should send."""
    match rng.randrange(8):
        case 0:
            return [rng.randbytes(rng.randrange(200)) for _ in range(rng.randrange(1, 6))]
        case 1:
            return [text({"type": "command", "command": COMMAND | {"command_id": rng.randrange(10**6)}})]
        case 2:
            return [b'{"type":"command","command":' + spoiled(rng, COMMAND) + b"}"]
        case 3:
            return [spoiled(rng, {"type": "command", "command": COMMAND})]
        case 4:
            return [
                text(
                    {
                        "type": "heartbeat",
                        "next_sample": rng.choice([-5, "soon", None, 0.5, math.nan, [], True]),
                    }
                )
            ]
        case 5:
            return [text({"type": rng.choice(["reformat", None, 7, ["start"], {"a": 1}, "\ud800"])})]
        case 6:
            return [deep()]
        case _:
            return [b'{"type":"command","command":{"command_id":1,"apply_at_sample":' + b"9" * 400 + b"}}"]


def test_hostile_stations_cost_the_rig_no_block_and_no_memory() -> None:
    rng = random.Random(13)
    blocks_wanted, rounds = 100, 50
    answers: list[Acknowledgement] = []
    with EmbeddedRig(programme(duration_s=10.0), speed=0.0) as rig:
        rig.connect()
        gateway: RigGateway = rig.gateway
        stranger = Stranger(rig)
        received: list[int] = []
        begin_mb, sent, refused = 0.0, 0, 0
        for k, block in enumerate(rig.blocks()):
            received.append(block.first_sample)
            assert block.valid.all()
            if k < rounds:
                for j in range(MESSAGES // rounds):
                    (stranger.socket if j % 2 else gateway._commands).send_multipart(hostile_order(rng))
                    sent += 1
                stranger.read()
            if k == 20:
                begin_mb = resident_mb(rig.pid)
            if k == 60:
                gateway.send(
                    Command(command_id=10**7, apply_at_sample=block.end_sample, control_enabled=False)
                )
            gateway.heartbeat(block.end_sample)
            for _ in range(20):
                answers += gateway.acknowledgements()
        end_mb = resident_mb(rig.pid) if rig.is_alive() else begin_mb
        refused = gateway.malformed + stranger.answers
        stranger.close()
    assert sent == MESSAGES
    assert received == [5_000 * k for k in range(blocks_wanted)]
    assert end_mb - begin_mb < MOST_GROWTH_MB
    assert [(a.command_id, a.accepted) for a in answers] == [(10**7, True)]
    assert refused > 0.5 * MESSAGES
    assert stranger.reasons["another station has the controls"] > 1000
    assert len(stranger.reasons) > 5


class Stranger:
    """Another client with a key that the rig knows, and without the controls."""

    def __init__(self, rig: EmbeddedRig) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        guard_client(self.socket, rig._keys, rig._rig_public)
        self.socket.connect(rig.gateway._commands.last_endpoint.decode())
        self.answers = 0
        self.reasons: dict[str, int] = {}

    def read(self) -> None:
        """Take what the rig has answered."""
        while self.socket.poll(0):
            reason = str(decode(self.socket.recv())["reason"])
            kind = reason if len(reason) < 40 else reason[:20]
            self.reasons[kind] = self.reasons.get(kind, 0) + 1
            self.answers += 1

    def close(self) -> None:
        """Go."""
        self.context.destroy(linger=0)
