"""Who has the controls of a rig of its own: one station at a time, known by its key, and none that fell silent."""

import contextlib
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest
import zmq
from garbage import text
from test_wire import PLANT, SCHEDULE, programme

from twin.control.schedule import Acknowledgement, Command
from twin.plant.blocks import Block
from twin.plant.errors import RunError
from twin.rig import gateway as gateway_module
from twin.rig.gateway import RigGateway
from twin.rig.server import MOST_WAITING, RigServer
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import KeyPair

SPEED = 0.5
"""A machine that is busy must not count as a station that fell silent."""

BLOCK = 5_000


@dataclass
class Station:
    """A gateway and the blocks it gives, worked through or merely listened to."""

    gateway: RigGateway
    blocks: Iterator[Block]
    answers: list[Acknowledgement] = field(default_factory=list)
    events: list[str] = field(default_factory=list)
    on: list[bool | None] = field(default_factory=list)
    last: Block | None = None

    def follow(self, *, heartbeat: bool = True) -> Block:
        self.last = next(self.blocks)
        self.on.append(self.last.control_on)
        self.answers += self.gateway.acknowledgements()
        self.events += self.gateway.events()
        if heartbeat:
            self.gateway.heartbeat(self.last.end_sample)
        return self.last

    def until(self, true: Callable[[], object], most: int = 40) -> None:
        """Follow until something is so; a busy machine may take a few blocks more."""
        for _ in range(most):
            self.follow()
            if true():
                return
        raise AssertionError(f"not so after {most} blocks: {self.answers} {self.events} {self.on[-10:]}")

    @contextlib.contextmanager
    def going_on(self) -> Iterator[None]:
        """Follow beside what else is done: nobody may hold up the one with the controls."""
        over = threading.Event()

        def run() -> None:
            while not over.is_set():
                self.follow()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    def switch_on(self, command_id: int) -> None:
        due = self.follow().end_sample
        self.gateway.send(Command(command_id=command_id, apply_at_sample=due, control_enabled=True))
        self.until(lambda: self.on[-1] is True)


@dataclass
class Standing:
    """A rig of its own in this process, on real sockets."""

    server: RigServer
    keys: KeyPair
    known: KeyPair
    said: list[str]

    def gateway(self, keys: KeyPair | None = None, rig_public: bytes | None = None) -> RigGateway:
        ports = (self.server.samples_port, self.server.commands_port)
        samples, commands = (f"tcp://127.0.0.1:{port}" for port in ports)
        return RigGateway(PLANT, samples, commands, keys or self.known, rig_public or self.keys.public)


@pytest.fixture
def rig() -> Iterator[Standing]:
    said: list[str] = []
    keys, known = KeyPair.fresh(), KeyPair.fresh()
    server = RigServer(
        SimulatedRig(programme(duration_s=600.0)),
        keys,
        [known.public],
        SPEED,
        stands_alone=True,
        say=said.append,
    )
    over = threading.Event()
    server._starter_gone = over.is_set
    failures: list[BaseException] = []

    def run() -> None:
        try:
            server.run()
        except RunError as error:
            if not over.is_set():
                failures.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield Standing(server, keys, known, said)
    over.set()
    thread.join(10.0)
    assert not thread.is_alive()
    assert failures == []


@pytest.fixture
def joined(rig: Standing) -> Iterator[Callable[[], Station]]:
    with contextlib.ExitStack() as stack:

        def join() -> Station:
            gateway = stack.enter_context(contextlib.closing(rig.gateway()))
            gateway.connect(timeout_s=20.0)
            return Station(gateway, gateway.blocks())

        yield join


def test_second_station_is_told_that_it_watches_and_takes_over_when_the_first_is_gone(
    rig: Standing, joined: Callable[[], Station]
) -> None:
    first = joined()
    first.switch_on(1)
    with first.going_on():
        second = joined()
    for _ in range(2):
        first.follow()
        second.follow()
    second.gateway.send(Command(command_id=1, apply_at_sample=0, control_enabled=False))
    for _ in range(4):
        first.follow()
        second.follow()
    assert first.on[-1] is True  # nobody but the first is heeded
    assert second.answers == [
        Acknowledgement(command_id=1, accepted=False, reason="another station has the controls")
    ]
    assert not second.gateway.in_control
    assert "another station has the controls; this one only watches" in second.gateway.notice
    assert any("only watches" in event for event in second.events)
    assert first.gateway.in_control
    assert any("a command was refused: another station has the controls" in line for line in rig.said)

    # The first stands still without a word: safe half a second later, by the rig's own count.
    assert first.last is not None
    lost_at = first.last.end_sample
    while second.follow().end_sample < lost_at + 50_000:
        pass
    on_until = max(
        (e for e, on in zip(itertools.count(second.last.end_sample, -BLOCK), reversed(second.on), strict=False) if on),
        default=0,
    )  # fmt: skip
    assert on_until <= lost_at + 25_000 + BLOCK  # its heartbeat came before the next block was out
    assert second.on[-1] is False
    assert any("control off" in line for line in rig.said)

    # The one that watched has the controls now, and can be obeyed.
    assert second.gateway.in_control
    assert "this station has the controls" in second.events
    second.switch_on(2)
    # And the first, come back to life, is the one to be refused.
    first.gateway.send(Command(command_id=2, apply_at_sample=0, control_enabled=False))

    def answered() -> bool:
        first.answers += first.gateway.acknowledgements()
        return any(a.command_id == 2 for a in first.answers)

    second.until(answered)
    assert [a.accepted for a in first.answers if a.command_id == 2] == [False]
    assert second.on[-1] is True


def test_station_that_comes_after_one_that_died_finds_control_off_and_may_switch_it_on(
    rig: Standing, joined: Callable[[], Station]
) -> None:
    first = joined()
    first.follow()
    first.switch_on(9)
    first.gateway._context.destroy(linger=0)  # it takes no leave
    time.sleep(0.8 / SPEED)
    second = joined()
    assert second.follow().control_on is False
    assert "control off" in second.gateway.notice
    second.switch_on(1)  # counts from 1 again
    second.until(lambda: second.answers)
    assert second.answers[0].accepted


def test_orders_too_early_too_many_and_too_large_are_refused_with_a_reason_that_the_rig_logs(
    rig: Standing, joined: Callable[[], Station]
) -> None:
    station = joined()
    at = station.follow().end_sample
    station.gateway.send(Command(command_id=1, apply_at_sample=at + 61 * 50_000))
    for k in range(MOST_WAITING + 5):
        station.gateway.send(Command(command_id=10 + k, apply_at_sample=at + 50 * 50_000))
    large = {"type": "command", "command": {"command_id": 999, "apply_at_sample": 0, "note": "x" * 1_100_000}}
    station.gateway._commands.send(text(large))
    station.until(lambda: any("too large" in event for event in station.events))
    reasons = {a.command_id: a.reason for a in station.answers}
    assert "more than 60 s ahead" in reasons[1]
    assert sum("others waiting" in reason for reason in reasons.values()) == 5
    assert any("is too large" in event for event in station.events)
    logged = " ".join(rig.said)
    for words in ("60 s ahead", "others waiting", "is too large"):
        assert words in logged
    assert rig.server.complaints.in_all == 7


def test_wrong_keys_are_told_apart_from_a_wrong_address(
    rig: Standing, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gateway_module, "FOR_GOOD_S", 0.3)
    stranger = KeyPair.fresh()
    for keys, rig_public, reason in (
        (stranger, rig.keys.public, "does not know this station's key"),
        (rig.known, stranger.public, "has another key than the one given"),
    ):
        with (
            contextlib.closing(rig.gateway(keys, rig_public)) as gateway,
            pytest.raises(RunError, match="check address and keys") as refused,
        ):
            gateway.connect(timeout_s=20.0)  # and not after twenty
        assert reason in str(refused.value)
    assert any("unknown key was refused" in line and stranger.public.decode() in line for line in rig.said)
    plain = zmq.Context()
    listening = plain.socket(zmq.PUB)
    port = listening.bind_to_random_port("tcp://127.0.0.1")
    with (
        contextlib.closing(
            RigGateway(PLANT, f"tcp://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}", stranger, stranger.public)
        ) as gateway,
        pytest.raises(RunError, match="is no rig"),
    ):
        gateway.connect(timeout_s=20.0)
    plain.destroy(linger=0)
    with (
        contextlib.closing(
            RigGateway(PLANT, f"tcp://127.0.0.1:{port}", f"tcp://127.0.0.1:{port}", stranger, stranger.public)
        ) as gateway,
        pytest.raises(RunError, match="nobody listens"),
    ):
        gateway.connect(timeout_s=0.6)


def test_schedule_of_another_model_is_refused(rig: Standing, joined: Callable[[], Station]) -> None:
    station = joined()
    station.follow()
    station.gateway.send(Command(command_id=1, apply_at_sample=0, schedule=SCHEDULE, config_id="0123"))
    station.until(lambda: station.answers)
    assert [a.accepted for a in station.answers] == [False]
    assert "made for model 0123" in station.answers[0].reason


def test_what_is_ordered_while_the_rig_is_away_is_lost_with_a_word_but_off_reaches_it_when_it_is_back() -> (
    None
):
    keys, known = KeyPair.fresh(), KeyPair.fresh()

    def serve(ports: tuple[int, int]) -> tuple[RigServer, threading.Thread, threading.Event]:
        server = RigServer(
            SimulatedRig(programme(duration_s=600.0)), keys, [known.public], SPEED,
            samples_port=ports[0], commands_port=ports[1], stands_alone=True,
        )  # fmt: skip
        over = threading.Event()
        server._starter_gone = over.is_set
        thread = threading.Thread(target=_run, args=(server,), daemon=True)
        thread.start()
        return server, thread, over

    def _run(server: RigServer) -> None:
        with contextlib.suppress(RunError):
            server.run()

    server, thread, over = serve((0, 0))
    ports = (server.samples_port, server.commands_port)
    samples, commands = (f"tcp://127.0.0.1:{port}" for port in ports)
    with contextlib.closing(RigGateway(PLANT, samples, commands, known, keys.public)) as gateway:
        gateway.connect(timeout_s=20.0)
        station = Station(gateway, gateway.blocks(patience_s=60.0))
        for _ in range(3):
            station.follow()
        over.set()
        thread.join(10.0)
        while gateway._commands.poll(0, zmq.POLLOUT):
            time.sleep(0.05)
        gateway.send(Command(command_id=3, apply_at_sample=10**6, schedule=SCHEDULE))
        gateway.send(Command(command_id=4, apply_at_sample=0, control_enabled=False))
        said = gateway.events()
        assert any("command 3 finds no rig: it is lost" in event for event in said)
        assert any("command 4 finds no rig: it is sent when the rig is back" in event for event in said)
        server, thread, over = serve(ports)
        for _ in range(30):
            block = station.follow()
            if gateway.restarts and block.valid.any() and block.control_on is False:
                break
        assert gateway.restarts == 1
        assert station.on[-1] is False
        station.until(lambda: station.answers)
        assert [(a.command_id, a.accepted) for a in station.answers] == [(4, True)]
        over.set()
        thread.join(10.0)
