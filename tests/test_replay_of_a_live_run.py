"""A run over real sockets, with lost blocks, a worker that retunes and an operator, is replayed to the bit."""

import json
import threading
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.test_replay import Trace, replayed, trace
from tuning.retune import TuningGoal
from twin.rig.gateway import RigGateway
from twin.rig.programme import Programme, Tone
from twin.rig.server import RigServer
from twin.rig.simulated import SimulatedRig
from twin.rig.wire import TOPIC_SAMPLES, KeyPair
from twin.station.answers import as_json
from twin.station.demo import demo_programme, facts_of, session_for
from twin.station.opened import ReplayOptions, open_any
from twin.station.orders import Order
from twin.station.outputs import Outputs
from twin.station.player import Player
from twin.station.replay import run_replay
from twin.station.run import Loop
from twin.station.worker import TunerProcess

LOST = (9, 17, 18, 31)
"""Blocks that never arrive."""

ORDERS = {13: "off", 15: "on", 24: "schedule", 35: "revert"}
GOAL = TuningGoal()


class LossySocket:
    """A rig's socket of samples of which some messages are lost on the way."""

    def __init__(self, socket: Any) -> None:
        self._socket = socket

    def __getattr__(self, name: str) -> Any:
        return getattr(self._socket, name)

    def send_multipart(self, frames: list[bytes]) -> None:
        if frames[0] == TOPIC_SAMPLES and json.loads(frames[1])["sequence"] in LOST:
            return
        self._socket.send_multipart(frames)


@dataclass(frozen=True)
class LiveRun:
    """Where it was recorded, what its session came to, and what was lost."""

    path: Path
    made: list[Trace]
    lost: int


def programme() -> Programme:
    tone = Tone(frequency_hz=52.0, duration_s=4.5, amplitude_v=4.0)
    return demo_programme(20.0, 11).model_copy(update={"sweep": tone})


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> LiveRun:
    path = tmp_path_factory.mktemp("live") / "live.rrd"
    run, rig_keys, station_keys = programme(), KeyPair.fresh(), KeyPair.fresh()
    server = RigServer(SimulatedRig(run), rig_keys, {station_keys.public}, speed=1.0)
    server._samples = LossySocket(server._samples)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    gateway = RigGateway(
        run.plant,
        f"tcp://127.0.0.1:{server.samples_port}",
        f"tcp://127.0.0.1:{server.commands_port}",
        station_keys,
        rig_keys.public,
    )
    made = []
    with closing(gateway), closing(TunerProcess(run.plant, facts_of(run), GOAL, None)) as tuner:
        gateway.connect(start=False)
        session = session_for(run, gateway.channels, GOAL, None, tuner)
        session.warm_up()
        config = json.dumps({"session": session.configuration()})
        with Outputs(session, recording=path, setup="", run_config_json=config, seed=11) as outputs:
            loop = Loop(session, outputs, gateway)
            gateway.start()
            for k, block in enumerate(gateway.blocks()):
                order = None
                if ORDERS.get(k) == "schedule":
                    schedule = session.schedule
                    assert schedule is not None
                    weaker = schedule.model_copy(
                        update={"beta_ns_m": tuple(0.9 * b for b in schedule.beta_ns_m)}
                    )
                    order = Order(kind="schedule", schedules=(weaker,))
                elif k in ORDERS:
                    order = Order.model_validate({"kind": ORDERS[k]})
                made.append(trace(loop.turn(block, order=order)))
        lost = gateway.counts.lost
    thread.join(30.0)
    return LiveRun(path, made, lost)


def test_the_run_had_all_that_can_go_otherwise(live: LiveRun) -> None:
    assert live.lost == len(LOST)
    assert len(live.made) == 45
    assert any("no valid sample" in t.health for t in live.made)
    assert sum(bool(t.proposal) for t in live.made) >= 2
    assert sum(d.by == "operator" for t in live.made for d in t.decisions) >= len(ORDERS)
    assert sum(len(t.commands) for t in live.made) >= 3


@pytest.mark.parametrize("options", [{}, {"recompute": True}, {"piece_s": 0.037}, {"piece_s": 0.5}])
def test_estimates_proposals_and_decisions_come_out_again(live: LiveRun, options: dict[str, Any]) -> None:
    """Answers worked out in the worker's process, and again here, are the same to the bit."""
    assert replayed(live.path, **options) == live.made


def test_a_replay_recorded_and_replayed_again_is_still_the_run(live: LiveRun, tmp_path: Path) -> None:
    again = tmp_path / "again.rrd"
    result = run_replay(live.path, ReplayOptions(recording=again), lambda _: None, lambda _a, _b: None)
    assert result["decisions_repeated"] is True
    assert result["answers_recomputed"] == 0
    assert replayed(again) == live.made


def test_from_anywhere_it_goes_on_as_it_did(live: LiveRun) -> None:
    player = Player(open_any(live.path, ReplayOptions()), checkpoint_s=1.0)
    for time_s, at in ((3.3, 33), (1.0, 10), (1.85, 18), (0.0, 0), (2.45, 24)):
        player.seek(time_s)
        frame = player.step()
        assert frame is not None
        assert trace(frame) == live.made[at]
        if frame.arrival is not None and frame.arrival.answer is not None:
            assert as_json(frame.arrival.answer) == live.made[at].proposal
