"""Sensors behind an input stage: what it does to a signal, to the loop, and how the force balance sees through it."""

import control
import numpy as np
import pytest

from estimators.excitation import ExcitationTracker
from estimators.force_balance import AbsorberBalance, ForceBalance
from tuning.loop import LoopFacts, RigModel
from tuning.rule import scheduling_rule
from twin.plant.blocks import make_block
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.plant.linear import linear_model
from twin.rig.excitation import Sweep
from twin.rig.programme import Programme
from twin.rig.simulated import SimulatedRig

TRUE_NS_M = 11.0


def staged(
    bandwidth_hz: float | None, ac_coupled_hz: float | None, name: str = "absorber_acceleration"
) -> Plant:
    rig = load_plant("rig")
    sensors = tuple(
        s.model_copy(update={"bandwidth_hz": bandwidth_hz, "ac_coupled_hz": ac_coupled_hz})
        if s.name == name
        else s
        for s in rig.sensor
    )
    return rig.model_copy(update={"sensor": sensors})


@pytest.mark.parametrize(("bandwidth_hz", "ac_coupled_hz"), [(800.0, None), (None, 0.7), (800.0, 0.7)])
def test_output_is_the_ideal_one_through_the_stage(
    bandwidth_hz: float | None, ac_coupled_hz: float | None
) -> None:
    plant = staged(bandwidth_hz, ac_coupled_hz)
    output = [s.name for s in plant.sensor].index("absorber_acceleration")
    w = 2.0 * np.pi * np.array([0.3, 5.0, 49.0, 700.0, 4000.0])

    def response(p: Plant) -> np.ndarray:
        m = linear_model(p, frequency_hz=50.0)
        return np.asarray(control.ss(m.A, m.B, m.C, m.D)(1j * w))[output]

    stage = np.array([plant.sensor[output].input_stage(1j * each) for each in w])
    np.testing.assert_allclose(response(plant), response(load_plant("rig")) * stage, rtol=1e-8)


def test_plants_without_a_stage_keep_their_fingerprint() -> None:
    assert staged(None, None).fingerprint == load_plant("rig").fingerprint
    assert staged(800.0, None).fingerprint != load_plant("rig").fingerprint


def test_the_loop_is_closed_through_the_stage() -> None:
    facts = LoopFacts(50_000.0, 1, relative=False)
    f = np.array([10.0, 50.0, 300.0])
    plant = staged(800.0, 0.7)
    plain, through = (RigModel(p, facts, 50.0).response(f)[:, 2, 0] for p in (load_plant("rig"), plant))
    stage = [plant.sensor[1].input_stage(2j * np.pi * each) for each in f]
    np.testing.assert_allclose(through, plain * stage, rtol=1e-2)  # sampled


def balances(plant: Plant, model: Plant) -> list[ForceBalance]:
    """Force balance by a model's knowledge of blocks that a plant's rig records through a sweep with control on."""
    programme = Programme(
        plant=plant,
        true_damping=DampingTable(frequency_hz=(40.0, 60.0), ns_m=(TRUE_NS_M, TRUE_NS_M)),
        sweep=Sweep(from_hz=45.2, to_hz=46.2, duration_s=4.0, amplitude_v=4.0),
        schedule=scheduling_rule(plant, [45.0, 50.0, 55.0]),
        seed=2,
    )
    rig = SimulatedRig(programme)
    names = tuple(c.name for c in rig.channels)
    tracker, balance = ExcitationTracker("shaker_voltage", names), AbsorberBalance(model, names)
    out = []
    for k in range(40):
        values, _, _ = rig.next_block()
        phasors = tracker.advance(make_block(k * 5_000, 50_000.0, values, rig.channels))
        if phasors is not None and k >= 10:
            out.append(balance.solve(phasors))
    return out


@pytest.fixture(scope="module")
def unstaged() -> float:
    plain = load_plant("rig")
    return float(np.mean([b.damping_ns_m for b in balances(plain, plain)]))


@pytest.mark.parametrize("stage", [(1_000.0, None), (None, 2.0), (500.0, 1.0)])
def test_balance_sees_through_the_stage_that_would_fake_damping(
    stage: tuple[float | None, float | None], unstaged: float
) -> None:
    plant = staged(*stage)
    seen = balances(plant, plant)
    damping = float(np.mean([b.damping_ns_m for b in seen]))
    assert damping == pytest.approx(unstaged, abs=0.01)  # the same noise, seen through the stage or not
    assert damping == pytest.approx(TRUE_NS_M, abs=0.06)
    assert abs(np.mean([b.stiffness_n_m for b in seen]) - 40714.0) < 15.0
    fooled = np.mean([b.damping_ns_m for b in balances(plant, load_plant("rig"))])
    assert abs(fooled - TRUE_NS_M) > 0.5
