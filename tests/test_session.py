"""The loop as a whole, in this process: what it decides, and that a replay decides it again."""

import dataclasses
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from tuning.loop import LoopFacts, RigModel
from tuning.retune import TuningGoal
from twin.control.schedule import Acknowledgement
from twin.plant.blocks import Block, Channel, make_block
from twin.plant.errors import InputError
from twin.plant.files import load_plant
from twin.rig.programme import Programme
from twin.rig.simulated import SimulatedRig
from twin.station.demo import demo_programme, session_for, true_damping
from twin.station.frame import Frame
from twin.station.session import Session, SessionSettings, settings_from
from twin.station.summary import RunLog, damping_rmse


def blocks_of(rig: SimulatedRig, n: int | None = None) -> Iterator[Block]:
    while not rig.finished and n != 0:
        first = rig.next_sample
        values, on, answers = rig.next_block()
        applied = tuple(a.command_id for a in answers)
        yield make_block(
            first, rig.programme.sample_rate_hz, values, rig.channels, control_on=on, commands_applied=applied
        )
        n = None if n is None else n - 1


def run(programme: Programme, goal: TuningGoal | None = None) -> tuple[Session, list[Frame], RunLog]:
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, goal or TuningGoal())
    frames, log = [], RunLog()
    for block in blocks_of(rig):
        frame = session.advance(block)
        if frame.command is not None:
            rig.accept(frame.command)
        frames.append(frame)
        log.add(frame)
    return session, frames, log


@pytest.fixture(scope="module")
def swept() -> tuple[Session, list[Frame], RunLog]:
    return run(demo_programme(20.0, 7))


def test_learned_damping_is_the_rigs_and_not_the_one_it_started_from(
    swept: tuple[Session, list[Frame], RunLog],
) -> None:
    _, _, log = swept
    assert log.curve is not None
    truth = true_damping(7)
    assert damping_rmse(log.curve, truth) < 0.3
    assert np.mean(np.abs(np.array(truth.ns_m) - 7.0)) > 3.0


def test_table_is_quiet_where_control_acts_and_budget_is_kept(
    swept: tuple[Session, list[Frame], RunLog],
) -> None:
    _, _, log = swept
    attenuation = log.attenuation()
    assert len(attenuation) > 80
    assert attenuation.mean() > 0.95
    assert max(log.joule_mean_w) < 4.0
    assert max(log.current_peak_a) <= 2.0


def test_commands_take_effect_at_the_sample_they_name(swept: tuple[Session, list[Frame], RunLog]) -> None:
    _, frames, _ = swept
    due = {f.command.command_id: f.command.apply_at_sample for f in frames if f.command is not None}
    applied = {number: f.block.first_sample for f in frames for number in f.block.commands_applied}
    assert len(applied) > 10
    assert all(applied[number] == due[number] for number in applied)


def test_every_deployed_point_is_stable_on_the_true_plant(
    swept: tuple[Session, list[Frame], RunLog],
) -> None:
    _, frames, _ = swept
    programme = demo_programme(20.0, 7)
    facts = LoopFacts(programme.sample_rate_hz, programme.loop_delay_samples)
    points = [p for f in frames if f.command is not None and f.proposal for _, p in f.proposal.points]
    assert len(points) > 50
    for point in points[::7]:
        model = RigModel(programme.true_plant, facts, point.frequency_hz)
        assert model.decay_rate_1_s(point.gains) < 0.0


def test_predicted_motion_is_what_the_rig_then_shows(swept: tuple[Session, list[Frame], RunLog]) -> None:
    _, frames, _ = swept
    passive = [
        (asked.performance.displacement_m, answered.performance.passive_m)
        for asked, answered in pairwise(frames[20:95])
        if asked.asked and asked.performance and answered.performance and not asked.block.control_on
    ]
    assert len(passive) > 5
    measured, predicted = np.array(passive).T
    np.testing.assert_allclose(measured, predicted, rtol=0.03)


def test_a_replay_of_blocks_and_commands_repeats_every_number_to_the_bit(
    swept: tuple[Session, list[Frame], RunLog],
) -> None:
    first, frames, _ = swept
    programme = demo_programme(20.0, 7)
    again = Session(
        programme.plant,
        first.channels,
        programme.sample_rate_hz,
        first.settings,
        recorded_commands=first.commands,
    )
    for frame in frames:
        repeated = again.advance(frame.block)
        np.testing.assert_array_equal(repeated.estimate.mean, frame.estimate.mean)
        np.testing.assert_array_equal(repeated.twin, frame.twin)
        assert repeated.command == frame.command
        assert repeated.decision == frame.decision
        if frame.curve is not None:
            assert repeated.curve is not None
            np.testing.assert_array_equal(repeated.curve.damping_ns_m, frame.curve.damping_ns_m)


def test_a_tight_budget_is_kept_at_the_price_of_motion() -> None:
    # A plant whose absorber is worked hard: at 45 Hz silence would take more than this.
    goal = TuningGoal(budget_w=0.8)
    _, frames, log = run(demo_programme(20.0, 7), goal)
    controlled = [f for f in frames if f.block.control_on and f.performance and f.phasors]
    settled = [f for f in controlled if 46.0 < f.phasors.frequency_hz < 55.0]
    assert max(f.performance.powers.joule_mean_w for f in settled) < 1.05 * goal.budget_w
    bound = [p for f in frames if f.proposal for _, p in f.proposal.points if p.active_limits]
    assert any(limit.name == "power" and limit.price > 0.0 for p in bound for limit in p.active_limits)
    assert all(p.powers.joule_mean_w <= 1.001 * goal.budget_w for p in bound)
    assert log.attenuation().mean() > 0.5


def test_dead_sensor_freezes_the_learner_and_nothing_is_nan() -> None:
    programme = demo_programme(20.0, 7)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    before = after = None
    for k, block in enumerate(blocks_of(rig, 60)):
        taken = block
        if 30 <= k < 40:
            values = block.values.copy()
            values[:, 1] = np.nan
            taken = make_block(block.first_sample, block.sample_rate_hz, values, block.channels)
        frame = session.advance(taken)
        assert np.isfinite(frame.estimate.mean).all()
        assert np.isfinite(frame.estimate.covariance).all()
        assert frame.curve is not None
        assert np.isfinite(frame.curve.damping_ns_m).all()
        if 30 <= k < 40:
            assert frame.curve.reason
            if k == 30:
                before = frame.curve.damping_ns_m
                assert any("masked" in e.text for e in frame.events)
            after = frame.curve.damping_ns_m
        if k == 59:
            assert not frame.curve.reason
            assert frame.estimate.nis == pytest.approx(1.0, abs=0.1)
    np.testing.assert_array_equal(before, after)


def test_a_rig_that_is_not_the_model_is_called_so_with_the_channel_that_says_it() -> None:
    programme = demo_programme(20.0, 7)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    texts = []
    for k, block in enumerate(blocks_of(rig, 16)):
        values = block.values.copy()
        if k >= 10:
            values[:, 0] *= 1.3  # the table's accelerometer loses its calibration
        frame = session.advance(make_block(block.first_sample, block.sample_rate_hz, values, block.channels))
        texts += [(k, e.level, e.text) for e in frame.events if e.text.startswith("model")]
    assert [k for k, _, _ in texts][:1] == [10]
    assert texts[0][1] == "warning"
    assert "table_acceleration" in texts[0][2]


def test_lost_blocks_are_bridged() -> None:
    programme = demo_programme(20.0, 7)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    frames = []
    for k, block in enumerate(blocks_of(rig, 50)):
        if k in (20, 21):
            lost = np.full(block.values.shape, np.nan)
            block = make_block(block.first_sample, block.sample_rate_hz, lost, block.channels)  # noqa: PLW2901
        frames.append(session.advance(block))
    assert frames[20].phasors is None
    assert frames[22].phasors is not None
    assert frames[22].phasors.frequency_hz == pytest.approx(rig.frequency_at(22 * 5000 + 2500), abs=0.01)
    assert frames[-1].estimate.nis == pytest.approx(1.0, abs=0.1)


def test_refused_command_is_an_error_in_the_log() -> None:
    programme = demo_programme(20.0, 7)
    rig = SimulatedRig(programme)
    session = session_for(programme, rig.channels, TuningGoal())
    block = next(blocks_of(rig))
    answer = Acknowledgement(command_id=3, accepted=False, reason="malformed")
    frame = session.advance(block, (answer,))
    assert any(e.level == "error" and "malformed" in e.text for e in frame.events)


def test_settings_survive_the_recording(swept: tuple[Session, list[Frame], RunLog]) -> None:
    session, _, _ = swept
    assert settings_from(session.configuration()) == session.settings
    with pytest.raises(InputError, match="another version"):
        settings_from({"loop": None})


def test_plant_without_current_limit_is_not_retuned() -> None:
    plant = load_plant("rig")
    without = plant.model_copy(update={"limits": {"stroke_m": 0.0095}})
    channels = tuple(Channel(s.name, s.unit) for s in plant.sensor)
    settings = SessionSettings(loop=LoopFacts(50_000.0, 1))
    with pytest.raises(InputError, match=r"limits\.vcm_current_a \[A\] is missing"):
        Session(without, channels, 50_000.0, settings)


def test_channels_that_no_sensor_of_the_plant_measures_are_refused_by_name() -> None:
    with pytest.raises(InputError, match="temperature"):
        Session(load_plant("rig"), (Channel("temperature", "K"),), 100.0, SessionSettings())


def test_warm_up_leaves_the_session_as_it_was() -> None:
    programme = demo_programme(20.0, 7)
    rig = SimulatedRig(programme)
    blocks = list(blocks_of(rig, 12))
    cold = session_for(programme, rig.channels, TuningGoal())
    warm = session_for(programme, rig.channels, TuningGoal())
    warm.warm_up()
    for block in blocks:
        a, b = cold.advance(block), warm.advance(block)
        np.testing.assert_array_equal(a.estimate.mean, b.estimate.mean)
        assert a.command == b.command


def test_budget_as_peak_joule_power_is_half_of_it_as_mean() -> None:
    assert TuningGoal(budget_w=4.0, budget_kind="joule_peak").joule_mean_w == 2.0
    assert dataclasses.replace(TuningGoal(), budget_kind="joule_mean").joule_mean_w == 4.0
