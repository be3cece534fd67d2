"""Retuning beside the loop: the loop never waits, nothing outdated is deployed, and a replay repeats all of it."""

import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import psutil
import pytest

from tuning.retune import TuningGoal
from tuning.step import Stepper, between, step_n_m
from twin.plant.blocks import make_block
from twin.plant.errors import InputError
from twin.rig.programme import Programme, Tone
from twin.rig.simulated import SimulatedRig
from twin.station.advice import Question
from twin.station.demo import demo_programme, facts_of, session_for
from twin.station.frame import Frame
from twin.station.retuning import RetuningSettings
from twin.station.session import Session
from twin.station.worker import AfterBlocks, Arrival, AsRecorded, Tuner, TunerHere, TunerProcess

GOAL = TuningGoal()


def tone(seconds: float, hz: float = 52.0) -> Programme:
    excitation = Tone(frequency_hz=hz, duration_s=seconds, amplitude_v=4.0)
    return demo_programme(20.0, 7).model_copy(update={"sweep": excitation})


PROGRAMME = tone(4.0)


def here(when: AfterBlocks | AsRecorded | None = None) -> TunerHere:
    return TunerHere(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, when or AfterBlocks(1))


def session(tuner: Tuner, settings: RetuningSettings | None = None) -> Session:
    return session_for(PROGRAMME, SimulatedRig(PROGRAMME).channels, GOAL, settings, tuner)


def run(twin: Session, programme: Programme = PROGRAMME, pause_s: float = 0.0) -> Iterator[Frame]:
    rig = SimulatedRig(programme)
    while not rig.finished:
        first = rig.next_sample
        values, on, answers = rig.next_block()
        applied = tuple(a.command_id for a in answers)
        block = make_block(
            first, programme.sample_rate_hz, values, rig.channels, control_on=on, commands_applied=applied
        )
        frame = twin.advance(block)
        if frame.command is not None:
            rig.accept(frame.command)
        time.sleep(pause_s)
        yield frame


def timing(frames: list[Frame]) -> AsRecorded:
    asked = {f.asked: f.block.end_sample - 1 for f in frames if f.asked is not None}
    taken = {
        f.arrival.number: (f.block.end_sample - 1, f.arrival.trouble) for f in frames if f.arrival is not None
    }
    return AsRecorded(asked, taken)


def assert_replay_repeats(frames: list[Frame], told: Session) -> None:
    again = session_for(PROGRAMME, told.channels, GOAL, told.settings.retuning, here(timing(frames)))
    repeated = Session(
        PROGRAMME.plant,
        told.channels,
        PROGRAMME.sample_rate_hz,
        again.settings,
        told.commands,
        here(timing(frames)),
    )
    for frame in frames:
        other = repeated.advance(frame.block)
        assert other.asked == frame.asked
        assert other.proposal == frame.proposal
        assert other.decision == frame.decision
        assert other.command == frame.command
        assert other.audited == frame.audited


@pytest.fixture(scope="module")
def lockstep() -> list[Frame]:
    return list(run(session(here())))


@pytest.fixture
def live() -> Iterator[TunerProcess]:
    tuner = TunerProcess(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, None)
    yield tuner
    tuner.close()


def test_process_gives_the_answers_of_this_process_to_the_bit(lockstep: list[Frame]) -> None:
    tuner = TunerProcess(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, 1)
    try:
        twin = session(tuner)
        twin.warm_up()
        frames = list(run(twin))
    finally:
        tuner.close()
    assert sum(f.command is not None for f in frames) > 1
    for ours, theirs in zip(lockstep, frames, strict=True):
        assert ours.proposal == theirs.proposal
        assert ours.command == theirs.command
        assert ours.decision == theirs.decision


def test_answer_is_taken_one_block_after_the_question(lockstep: list[Frame]) -> None:
    asked = {f.asked: k for k, f in enumerate(lockstep) if f.asked is not None}
    taken = {f.arrival.number: k for k, f in enumerate(lockstep) if f.arrival is not None}
    assert len(taken) > 5
    assert all(taken[number] == asked[number] + 1 for number in taken)


def test_stopped_worker_stops_no_block_and_its_late_answer_is_replayed_at_its_block(
    live: TunerProcess,
) -> None:
    twin = session(live)
    twin.warm_up()
    frames: list[Frame] = []
    longest = 0.0
    assert live.pid is not None
    for k, frame in enumerate(run(twin, pause_s=0.02)):
        frames.append(frame)
        if k == 4:
            os.kill(live.pid, signal.SIGSTOP)
        if k == 5:
            began = time.perf_counter()
        if k == 25:
            longest = time.perf_counter() - began
            os.kill(live.pid, signal.SIGCONT)
    asked = [k for k, f in enumerate(frames) if f.asked is not None]
    taken = [k for k, f in enumerate(frames) if f.arrival is not None]
    assert not [k for k in taken if 6 <= k <= 25]
    assert len([k for k in asked if 5 <= k <= 25]) <= 1
    assert [k for k in taken if k > 25]
    assert longest < 20.0  # twenty blocks while it stood still: none of them waited for it
    assert_replay_repeats(frames, twin)


def test_killed_worker_is_said_started_anew_and_replayed(live: TunerProcess) -> None:
    settings = RetuningSettings(every_blocks=2)
    twin = session(live, settings)
    twin.warm_up()
    frames: list[Frame] = []
    killed, asked_before = False, 0
    for frame in run(twin, tone(30.0), pause_s=0.02):
        if killed and sum(f.asked is not None for f in frames) > asked_before + 1:
            break
        frames.append(frame)
        if len(frames) > 8 and frame.asked is not None and not killed and live.pid is not None:
            os.kill(live.pid, signal.SIGKILL)
            killed, asked_before = True, sum(f.asked is not None for f in frames)
        if killed and live._open is None and live.restarts:
            time.sleep(0.1)  # the new one loads its solvers: seconds, in which the loop goes on
    texts = [e.text for f in frames for e in f.events if e.level == "error"]
    assert len(texts) == 1
    assert "started anew" in texts[0]
    assert live.restarts == 1
    lost = next(k for k, f in enumerate(frames) if f.arrival is not None and f.arrival.answer is None)
    assert any(f.arrival is not None and f.arrival.answer is not None for f in frames[lost + 1 :])
    assert_replay_repeats(frames, twin)


def test_worker_that_cannot_be_kept_alive_is_given_up_with_a_reason(live: TunerProcess) -> None:
    live.restarts = 3
    os.kill(live.pid or 0, signal.SIGKILL)
    live._is_ready = True
    live.ask(session(here()).retuning._question(1, PROGRAMME.plant, 0.1, 50.0, 4.0, 0.0, propose=True))  # type: ignore[union-attr]
    arrival = None
    while arrival is None:
        arrival = live.take(0)
        time.sleep(0.01)
    assert "not started again" in arrival.trouble
    assert not live.ready(1)


def test_closing_leaves_no_process(live: TunerProcess) -> None:
    pid = live.pid
    assert pid is not None
    assert psutil.pid_exists(pid)
    live.close()
    live.close()
    assert not psutil.pid_exists(pid)
    assert not [c for c in psutil.Process().children() if c.status() == psutil.STATUS_ZOMBIE]


def test_worker_ends_with_a_loop_that_is_killed() -> None:
    script = (
        "import sys, time\n"
        "from tests.test_worker import PROGRAMME, GOAL, facts_of\n"
        "from twin.station.worker import TunerProcess\n"
        "if __name__ == '__main__':\n"
        "    tuner = TunerProcess(PROGRAMME.plant, facts_of(PROGRAMME), GOAL, None)\n"
        "    print(tuner.pid, flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        worker = psutil.Process(pid)
        parent.kill()
    worker.wait(30.0)
    assert not psutil.pid_exists(pid)


def test_missing_limits_reach_the_person_from_the_process_too() -> None:
    plant = PROGRAMME.plant.model_copy(update={"limits": {"stroke_m": 0.0095}})
    tuner = TunerProcess(plant, facts_of(PROGRAMME), GOAL, None)
    with pytest.raises(InputError, match=r"limits\.vcm_current_a \[A\] is missing"):
        tuner.warm_up(_any_question())
    assert tuner.pid is None


def test_proposal_for_a_damping_that_has_moved_on_is_dropped_and_counted() -> None:
    # Answers come half a second late while the damping in use still runs to what was learned.
    twin = session(here(AfterBlocks(5)), RetuningSettings(every_blocks=6, outdated_ns_m=0.3))
    frames = list(run(twin))
    reasons = [f.decision.reason for f in frames if f.decision is not None]
    dropped = [r for r in reasons if r.startswith("outdated: the damping has moved")]
    assert dropped
    assert twin.retuning is not None
    assert twin.retuning.outdated == len(dropped)
    assert any(f.command is not None for f in frames)  # once it rests, they hold


def test_proposal_for_another_goal_or_schedule_is_dropped() -> None:
    twin = session(here(AfterBlocks(3)))
    retuning = twin.retuning
    assert retuning is not None
    reasons = []
    for k, frame in enumerate(run(twin)):
        if k > 20 and frame.asked is not None:
            retuning.goal = dataclasses.replace(GOAL, budget_w=1.0)
        if frame.decision is not None:
            reasons.append(frame.decision.reason)
    assert any("the goal has changed" in r for r in reasons)


class Scattering:
    """A tuner whose gains scatter as those of a bad estimate would: each answer's gains are off by a few per mille."""

    def __init__(self, share: float) -> None:
        self._inner, self._share, self._rng = here(), share, np.random.default_rng(5)

    def warm_up(self, question: Question) -> None:
        self._inner.warm_up(question)

    def ready(self, sample: int) -> bool:
        return self._inner.ready(sample)

    def ask(self, question: Question) -> None:
        self._inner.ask(question)

    def take(self, sample: int) -> Arrival | None:
        arrival = self._inner.take(sample)
        if arrival is None or arrival.answer is None:
            return arrival
        steps = tuple(
            (row, dataclasses.replace(g, gamma_n_m=g.gamma_n_m + self._share * 16_000.0 * self._rng.normal()))
            for row, g in arrival.answer.steps
        )
        return dataclasses.replace(arrival, answer=dataclasses.replace(arrival.answer, steps=steps))

    def close(self) -> None:
        self._inner.close()


def gains_of(settings: RetuningSettings) -> tuple[int, float]:
    """Commands after five seconds of settling, and the total variation of gamma at 52 Hz that they bring [N/m]."""
    frames = list(run(session(Scattering(5e-4), settings), tone(12.0)))
    late = [f.command for f in frames[50:] if f.command is not None and f.command.schedule is not None]
    gamma = [c.schedule.at(52.0).gamma_n_m for c in late if c.schedule is not None]
    return len(late), float(np.sum(np.abs(np.diff(gamma))))


def test_noise_does_not_make_gains_chatter() -> None:
    calm, calm_variation = gains_of(RetuningSettings())
    nervous, nervous_variation = gains_of(RetuningSettings(min_change=0.0, reversal=1.0))
    assert nervous >= 12  # every proposal is another command
    assert calm <= 4
    assert calm_variation < nervous_variation  # both make the first, large move; the rest is chatter


def test_no_command_moves_a_gain_further_than_a_step_at_once() -> None:
    settings = RetuningSettings(longest_step=0.01)
    frames = list(run(session(here(), settings), tone(6.0)))
    schedules = [
        PROGRAMME.schedule,
        *(f.command.schedule for f in frames if f.command is not None and f.command.schedule is not None),
    ]
    absorber = PROGRAMME.plant.absorber
    assert absorber is not None
    longest = [
        max(step_n_m(a.at(hz), b.at(hz), hz) for hz in PROGRAMME.schedule.frequency_hz)
        for a, b in pairwise(schedules)
    ]
    assert len(longest) > 2
    assert longest[0] <= 0.01 * absorber.stiffness_n_m * (1.0 + 1e-9)
    at_once = list(run(session(here(), RetuningSettings(longest_step=10.0)), tone(6.0)))
    first = next(f.command for f in at_once if f.command is not None)
    assert first.schedule is not None
    before, after = PROGRAMME.schedule, first.schedule
    there = max(step_n_m(before.at(hz), after.at(hz), hz) for hz in before.frequency_hz)
    assert there > 0.01 * absorber.stiffness_n_m


def test_step_from_unstable_gains_goes_all_the_way() -> None:
    frames = list(run(session(here())))
    point = next(p for f in frames if f.proposal is not None for _, p in f.proposal.points)
    bad = dataclasses.replace(point.gains, beta_ns_m=-60.0)
    stepper = Stepper(PROGRAMME.true_plant, facts_of(PROGRAMME), 0.05, 4.0)
    assert stepper.limited(bad, point, 10.0) == point.gains


def test_halfway_gains_are_half_way() -> None:
    point = PROGRAMME.schedule.at(47.0)
    other = dataclasses.replace(point, gamma_n_m=point.gamma_n_m + 100.0, low_pass_hz=4.0 * point.low_pass_hz)
    middle = between(point, other, 0.5)
    assert middle.gamma_n_m == pytest.approx(point.gamma_n_m + 50.0)
    assert middle.low_pass_hz == pytest.approx(2.0 * point.low_pass_hz)
    assert between(point, other, 0.0) == point


def _any_question() -> Question:
    retuning = session(here()).retuning
    assert retuning is not None
    return retuning._question(0, PROGRAMME.plant, 0.1, 50.0, 4.0, 0.0, propose=True)
