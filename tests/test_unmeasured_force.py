"""An engine whose own force nothing measures: the session estimates it, learns and retunes with it."""

import numpy as np
import pytest

from tuning.loop import LoopFacts
from tuning.retune import TuningGoal
from tuning.rule import scheduling_rule
from twin.plant.blocks import make_block
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.rig.excitation import Sweep
from twin.rig.programme import Programme, rig_channels, with_accelerometers
from twin.rig.simulated import SimulatedRig
from twin.station.frame import Frame
from twin.station.session import Session, SessionSettings

FORCE_N, TRUE_NS_M = 1000.0, 3.5


@pytest.fixture(scope="module")
def engine() -> Plant:
    plant = load_plant("engine_vcm")
    plant = plant.model_copy(update={"limits": {**plant.limits, "vcm_power_w": 500.0}})
    return with_accelerometers(plant, 1e-3)


@pytest.fixture(scope="module")
def frames(engine: Plant) -> list[Frame]:
    schedule = scheduling_rule(
        engine, [47.0 + 0.5 * k for k in range(13)], high_pass_hz=0.5, low_pass_hz=2000.0
    )
    programme = Programme(
        plant=engine,
        true_damping=DampingTable(frequency_hz=(40.0, 60.0), ns_m=(TRUE_NS_M, TRUE_NS_M)),
        sweep=Sweep(from_hz=48.0, to_hz=48.8, duration_s=8.0, amplitude_n=FORCE_N),
        schedule=schedule,
        seed=1,
    )
    rig = SimulatedRig(programme)
    assert "excitation" not in {c.name for c in rig.channels}
    settings = SessionSettings(
        loop=LoopFacts(programme.sample_rate_hz, programme.loop_delay_samples),
        schedule=schedule,
        goal=TuningGoal(budget_w=60.0, modulus_margin=0.3),
    )
    session = Session(engine, rig.channels, programme.sample_rate_hz, settings)
    out = []
    while not rig.finished:
        first = rig.next_sample
        values, on, answers = rig.next_block()
        applied = tuple(a.command_id for a in answers if a.accepted)
        block = make_block(
            first, programme.sample_rate_hz, values, rig.channels, control_on=on, commands_applied=applied
        )
        out.append(session.advance(block, tuple(answers)))
        for command in out[-1].commands:
            rig.accept(command)
    return out


def test_force_is_estimated_within_its_stated_deviation(frames: list[Frame]) -> None:
    settled = [f.force_n for f in frames[50:]]
    assert all(force is not None for force in settled)
    mean, std = np.array(settled).T
    assert np.all(std < 10.0)
    assert np.mean(np.abs(mean - FORCE_N) < 1.96 * std) > 0.85
    assert np.all(np.abs(mean - FORCE_N) < 5.0 * std)


def test_damping_is_learned_and_the_verdict_is_consistent_once_the_transient_is_over(
    frames: list[Frame],
) -> None:
    last = frames[-1]
    assert last.curve is not None
    assert last.curve.status == "estimated"
    learned = np.interp(48.7, last.curve.frequency_hz, last.curve.damping_ns_m)
    assert learned == pytest.approx(TRUE_NS_M, abs=0.3)
    assert all(f.health is not None and f.health.verdict == "consistent" for f in frames[60:])


def test_gains_are_retuned_for_the_estimated_force_and_quiet_the_case(frames: list[Frame]) -> None:
    last = frames[-1].performance
    assert last is not None
    assert any(command.schedule is not None for f in frames for command in f.commands)
    assert last.displacement_m < 0.5 * last.passive_m
    assert last.powers.joule_mean_w < 60.0


def test_nothing_is_estimated_where_the_force_is_measured() -> None:
    rig = load_plant("rig")
    session = Session(rig, rig_channels(rig), 50_000.0, SessionSettings())
    assert session.observer.unknown_force is None
