"""A replay is the run again: to the bit, whatever was read in which pieces, from wherever one has jumped."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tuning.retune import TuningGoal
from twin.plant.blocks import make_block
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.recorded import open_recording
from twin.rig.simulated import SimulatedRig
from twin.rig.storage import Storage, parts_beside
from twin.station import answers
from twin.station.demo import demo_programme, session_for
from twin.station.frame import Frame
from twin.station.opened import ReplayOptions, open_any
from twin.station.outputs import Outputs, keep_existing
from twin.station.player import Player
from twin.station.replay import Repeated, run_replay
from twin.station.session import settings_from

SECONDS = 4.0


@dataclass(frozen=True, slots=True)
class Trace:
    """All that a block comes to, as bytes and text."""

    end_sample: int
    mean: bytes
    covariance: bytes
    twin: bytes
    damping: bytes
    health: str
    events: tuple[str, ...]
    decisions: tuple[Any, ...]
    commands: tuple[Any, ...]
    proposal: str


def trace(frame: Frame) -> Trace:
    proposal = (
        "" if frame.arrival is None or frame.arrival.answer is None else answers.as_json(frame.arrival.answer)
    )
    return Trace(
        frame.block.end_sample,
        frame.estimate.mean.tobytes(),
        frame.estimate.covariance.tobytes(),
        frame.twin.tobytes(),
        b"" if frame.curve is None else frame.curve.damping_ns_m.tobytes() + frame.curve.std_ns_m.tobytes(),
        repr((frame.health.verdict, frame.health.reason)),
        tuple(f"{e.sample} {e.text}" for e in frame.events),
        frame.decisions,
        frame.commands,
        proposal,
    )


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Trace]]:
    """A run that was recorded, in files of a second, and what its own session came to."""
    path = tmp_path_factory.mktemp("run") / "run.rrd"
    programme = demo_programme(SECONDS, 3)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    session.warm_up()
    config = json.dumps({"programme": programme.model_dump(mode="json"), "session": session.configuration()})
    made = []
    with Outputs(
        session,
        recording=path,
        setup="",
        run_config_json=config,
        seed=3,
        storage=Storage(rotate_s=1.0),
    ) as outputs:
        while not rig.finished:
            first = rig.next_sample
            values, on, said = rig.next_block()
            block = make_block(
                first, programme.sample_rate_hz, values, rig.channels, control_on=on,
                commands_applied=tuple(a.command_id for a in said if a.accepted),
            )  # fmt: skip
            frame = session.advance(block, tuple(said))
            for command in frame.commands:
                rig.accept(command)
            outputs.take(frame)
            made.append(trace(frame))
    return path, made


def replayed(path: Path, **options: Any) -> list[Trace]:
    return [trace(frame) for frame in Player(open_any(path, ReplayOptions(**options))).play()]


def test_a_run_decides_something(run: tuple[Path, list[Trace]]) -> None:
    path, made = run
    assert sum(len(t.commands) for t in made) >= 2
    assert sum(bool(t.proposal) for t in made) >= 5
    assert len(parts_beside(path)) == 4


@pytest.mark.parametrize("options", [{}, {"recompute": True}, {"piece_s": 0.0123}, {"piece_s": 0.37}])
def test_a_replay_is_the_live_run_to_the_bit(run: tuple[Path, list[Trace]], options: dict[str, Any]) -> None:
    path, made = run
    assert replayed(path, **options) == made


def test_recorded_answers_are_taken_only_from_the_same_program(
    run: tuple[Path, list[Trace]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, made = run
    same = Player(open_any(path, ReplayOptions()))
    list(same.play())
    assert same.session.answers_worked_out == 0
    monkeypatch.setattr(answers, "code_id", lambda: "another program")
    other = Player(open_any(path, ReplayOptions()))
    assert [trace(frame) for frame in other.play()] == made
    assert other.session.answers_worked_out == sum(bool(t.proposal) for t in made)


def test_answers_to_other_questions_are_worked_out(run: tuple[Path, list[Trace]]) -> None:
    path, made = run
    opened = open_any(path, ReplayOptions())
    told = dict(opened.known.by_chain)
    del told[list(told)[2]]  # the third is not known: the adviser makes up for the first two
    object.__setattr__(opened, "known", answers.KnownAnswers(told))
    player = Player(opened)
    assert [trace(frame) for frame in player.play()] == made
    assert player.session.answers_worked_out == 1


def test_answers_come_back_to_the_bit(run: tuple[Path, list[Trace]]) -> None:
    for t in run[1]:
        if t.proposal:
            assert answers.as_json(answers.from_json(t.proposal)) == t.proposal
    assert answers.NOTHING_KNOWN.get("x") is None
    assert answers.KnownAnswers({"x": "{}"}).get("x") is None


@pytest.mark.parametrize("recompute", [False, True])
def test_seeking_back_and_forth_changes_no_bit(run: tuple[Path, list[Trace]], recompute: bool) -> None:
    path, made = run
    player = Player(open_any(path, ReplayOptions(recompute=recompute)), checkpoint_s=0.5)
    for time_s, blocks in ((2.0, 20), (0.3, 3), (3.1, 31), (1.75, 17), (0.0, 0), (99.0, 40)):
        player.seek(time_s)
        assert player.time_s == pytest.approx(0.1 * blocks)
        frame = player.step()
        assert (None if frame is None else trace(frame)) == (made[blocks] if blocks < 40 else None)
    player.seek(1.0)
    assert [trace(frame) for frame in player.play()] == made[10:]


def test_playing_stops_pauses_and_keeps_time(run: tuple[Path, list[Trace]]) -> None:
    path, made = run
    player = Player(open_any(path, ReplayOptions()))
    now, waited = 100.0, []

    def sleep(seconds: float) -> None:
        nonlocal now
        waited.append(seconds)
        now += seconds

    assert len(list(player.play(until_s=1.0, speed=2.0, clock=lambda: now, sleep=sleep))) == 10
    assert sum(waited) == pytest.approx(0.5)
    seen = []
    for frame in player.play():
        seen.append(trace(frame))
        player.paused = len(seen) == 3
    assert seen == made[10:13]
    assert trace(player.step()) == made[13]  # type: ignore[arg-type]
    forth = Player(open_any(path, ReplayOptions()), checkpoint_s=None)
    forth.seek(1.0)
    with pytest.raises(ValueError, match="only goes forth"):
        forth.seek(0.5)


def test_the_command_repeats_decisions_of_the_whole_and_of_a_part(run: tuple[Path, list[Trace]]) -> None:
    path, _ = run
    for options in (ReplayOptions(), ReplayOptions(from_s=1.5), ReplayOptions(from_s=1.0, to_s=3.0)):
        result = run_replay(path, options, lambda _: None, lambda _a, _b: None)
        assert result["decisions_repeated"] is True
        assert result["answers_recomputed"] == 0
    assert result["blocks"] == 20


def test_decisions_that_differ_are_told(run: tuple[Path, list[Trace]]) -> None:
    opened = open_any(run[0], ReplayOptions())
    repeated = Repeated(opened)
    assert repeated.verdict is None
    for frame in Player(opened).play():
        if not frame.commands:
            repeated.add(frame)
    assert repeated.verdict is False


def test_model_and_software_are_recorded(run: tuple[Path, list[Trace]]) -> None:
    recording = open_recording(run[0])
    models = [json.loads(text)["damping_ns_m"] for _, text in recording.notes("models")]
    assert models[0] == 7.0
    assert len(set(models)) > 3
    assert recording.software["code_id"] == answers.code_id()
    assert {"numpy", "scipy", "numba", "python"} <= recording.software.keys()
    assert recording.seed == 3


def test_a_run_in_the_way_is_kept_with_all_its_files(run: tuple[Path, list[Trace]], tmp_path: Path) -> None:
    for number, file in parts_beside(run[0]).items():
        (tmp_path / file.name).write_bytes(file.read_bytes())
        assert number in (1, 2, 3, 4)
    path = tmp_path / run[0].name
    assert keep_existing(path) == tmp_path / "run.1.rrd"
    assert not parts_beside(path)
    assert len(open_recording(tmp_path / "run.1.rrd").parts) == 4
    assert keep_existing(path) is None


def test_an_estimate_does_not_depend_on_the_blocks_it_was_worked_out_in() -> None:
    """Where nothing is decided per block the cut does not matter: the observer alone, to 1e-9 at common samples."""
    from estimators.observer import Observer

    programme = demo_programme(1.0, 5)
    rig = SimulatedRig(programme)
    values = np.vstack([rig.next_block()[0] for _ in range(10)])
    names = tuple(c.name for c in rig.channels)
    found = []
    for n in (5000, 1000, 777, 50_000):
        observer = Observer(load_plant("rig"), names, programme.sample_rate_hz)
        parts = [
            observer.advance(make_block(k, programme.sample_rate_hz, values[k : k + n], rig.channels)).mean
            for k in range(0, len(values), n)
        ]
        found.append(np.vstack(parts))
    for other in found[1:]:
        scale = np.abs(found[0]).max(axis=0)
        assert np.max(np.abs(other - found[0]) / scale) < 1e-9


def test_settings_of_another_version_say_which_key_it_is(run: tuple[Path, list[Trace]]) -> None:
    recorded = json.loads(open_recording(run[0]).run_config_json)["session"]
    recorded["learner"]["transient_std_ns"] = 1.0
    with pytest.raises(InputError, match=r"learner\.transient_std_ns"):
        settings_from(recorded)
