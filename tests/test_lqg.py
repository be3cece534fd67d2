"""LQG on the power-budgeted weights: the deployed law on the exact sampled plant, and in time."""

from collections import deque
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tuning.law_loop import LawLoop, StateSpaceLaw
from tuning.loop import LoopFacts, RigModel, loop_facts
from tuning.lqg import LQGDesign, LQGDesigner, _Joint, lqg_law
from tuning.power_lq import PowerBudgetedLQ
from tuning.sampled import SampledPlant, sampled_plant
from twin.plant.config import Plant
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
PLANTS = {name: load_plant(name) for name in ("engine_vcm", "rig")}
AMPLITUDE = {"engine_vcm": 1000.0, "rig": 4.0}


@cache
def designed(name: str, hz: float, watt: float, delay_s: float = 50e-6, drift_hz: float = 0.0) -> LQGDesign:
    designer = LQGDesigner(PLANTS[name], loop_facts(RATE_HZ, delay_s))
    return designer.solve(hz, AMPLITUDE[name], joule_mean_w=watt, drift_hz=drift_hz)


def loop_of(name: str, design: LQGDesign, delay_s: float = 50e-6) -> LawLoop:
    hz = design.lq.excited.frequency_hz
    return LawLoop(sampled_plant(PLANTS[name], loop_facts(RATE_HZ, delay_s), hz), design.law)


def peak(signal: Array, hz: float) -> float:
    """Peak at one frequency, by projection over whole periods at the end."""
    n = round(round(0.5 * hz) * RATE_HZ / hz)
    t = np.arange(len(signal))[-n:] / RATE_HZ
    return float(2.0 * abs(np.mean(signal[-n:] * np.exp(-2j * np.pi * hz * t))))


# --- the sampled plant --------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 40e-6, 55e-6])
@pytest.mark.parametrize("relative", [True, False])
def test_sampled_plant_is_the_one_the_tuner_knows(delay_s: float, relative: bool) -> None:
    facts = loop_facts(RATE_HZ, delay_s, relative)
    f = np.array([7.0, 50.0, 333.0, 4000.0])
    for plant in PLANTS.values():
        mine = sampled_plant(plant, facts, 50.0, None, ("relative_acceleration",))
        motion, measured = mine.responses(f)
        theirs = RigModel(plant, facts, 50.0).response(f)
        theirs[:, :, 0] *= np.exp(-2j * np.pi * f * facts.delay_samples / RATE_HZ)[:, None]
        np.testing.assert_allclose(motion, theirs[:, [0, 1, 3]], rtol=1e-5)
        np.testing.assert_allclose(measured, theirs[:, [2]], rtol=1e-5)


def test_channels_that_are_missing_are_named() -> None:
    facts = LoopFacts(RATE_HZ, 1)
    with pytest.raises(InputError, match="'microphone' is no sensor"):
        sampled_plant(PLANTS["rig"], facts, 50.0, None, ("microphone",))
    with pytest.raises(InputError, match="answers the command at once"):
        sampled_plant(PLANTS["rig"], facts, 50.0, None, ("vcm_voltage",))
    with pytest.raises(InputError, match="no voice coil"):
        sampled_plant(load_plant("engine"), facts, 50.0)


# --- the law ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.0, 60e-6, 50e-6])
def test_poles_are_those_of_gain_and_observer_whatever_the_delay(delay_s: float) -> None:
    """Separation: the predictor hides the delay from the gain, the observer does not see the gain."""
    plant = sampled_plant(PLANTS["rig"], loop_facts(RATE_HZ, delay_s), 53.0)
    lq = PowerBudgetedLQ(PLANTS["rig"]).solve(53.0, 4.0, joule_mean_w=0.2)
    law = lqg_law(plant, lq, 4.0, 1e-4, 30.0)
    poles = np.linalg.eigvals(LawLoop(plant, law).matrices()[0])
    joint = _Joint(plant, lq, 4.0, 1e-4)
    K, before = joint.gain()
    L, n = joint.observer(30.0), joint.own
    own = np.zeros((n + 1, n + 1))
    own[:n, :n] = joint.F[:n, :n] - np.outer(joint.late[:n], K[:n])
    own[:n, n] = joint.early[:n] - before * joint.late[:n]
    own[n, :n], own[n, n] = -K[:n], -before
    expected = [*np.linalg.eigvals(own), *np.linalg.eigvals(joint.F - joint.F @ L @ joint.C)]
    for pole in expected:
        if abs(pole) > 0.3:  # what is quicker is lost among the delay's own zeros
            assert np.abs(poles - pole).min() < 1e-6


def test_steady_state_is_what_a_simulation_step_by_step_comes_to() -> None:
    """Plant, delay line and law stepped apart from each other, as a rig would run them."""
    design = designed("rig", 52.0, 0.2)
    plant: SampledPlant = sampled_plant(PLANTS["rig"], loop_facts(RATE_HZ, 60e-6), 52.0)
    law: StateSpaceLaw = lqg_law(plant, design.lq, 4.0, 1e-4, design.caution)
    steady = LawLoop(plant, law).steady(52.0, 4.0)
    count = 60_000
    drive = 4.0 * np.sin(2.0 * np.pi * 52.0 * np.arange(count + 1) / RATE_HZ)
    x, s, waiting = np.zeros(len(plant.F)), np.zeros(len(law.A)), deque([0.0] * 3)
    out = np.empty((count, 3))
    for k in range(count):
        y = plant.measured @ x + plant.measured_feed * drive[k]
        out[k] = plant.motion @ x
        waiting.append(float(law.C @ s + law.D @ y))
        s = law.A @ s + law.B @ y
        x = plant.F @ x + plant.late * waiting.popleft() + plant.before * drive[k] + plant.now * drive[k + 1]
    assert peak(out[:, 0], 52.0) == pytest.approx(steady.displacement_m, rel=0.02)
    assert 0.5 * 2.7 * peak(out[:, 2], 52.0) ** 2 == pytest.approx(steady.powers.joule_mean_w, rel=0.01)
    assert peak(out[:, 1], 52.0) == pytest.approx(steady.stroke_m, rel=0.01)
    together = LawLoop(plant, law).simulate(drive[:count])
    np.testing.assert_allclose(together, out, rtol=1e-6, atol=1e-9 * np.abs(out).max())


@pytest.mark.parametrize(
    ("name", "hz", "watt"), [("engine_vcm", 53.0, 25.0), ("engine_vcm", 47.0, 50.0), ("rig", 46.0, 0.4)]
)
def test_prediction_holds_in_time(name: str, hz: float, watt: float) -> None:
    design = designed(name, hz, watt)
    t = np.arange(int(6.0 * RATE_HZ)) / RATE_HZ
    out = loop_of(name, design).simulate(AMPLITUDE[name] * np.sin(2.0 * np.pi * hz * t))
    ohm = design.lq.excited.coil.resistance_ohm
    assert peak(out[:, 0], hz) == pytest.approx(design.steady.displacement_m, rel=0.02)
    assert 0.5 * ohm * peak(out[:, 2], hz) ** 2 == pytest.approx(design.steady.powers.joule_mean_w, rel=0.01)


@pytest.mark.parametrize(
    ("hz", "watt", "um"), [(53.0, 25.0, 50.776), (47.0, 25.0, 28.19), (47.0, 50.0, 2.4425)]
)
def test_deployed_law_comes_within_a_few_percent_of_the_physical_limit(
    hz: float, watt: float, um: float
) -> None:
    design = designed("engine_vcm", hz, watt)
    assert um * 0.9999 <= design.steady.displacement_m * 1e6 <= 1.06 * um
    assert design.steady.powers.joule_mean_w <= watt
    assert design.margins.modulus >= 0.5
    assert design.decay_rate_1_s < 0.0


@pytest.mark.parametrize("watt", [50.0, 100.0])
@pytest.mark.parametrize("hz", [47.0, 50.0, 53.0])
def test_case_stays_below_20_um_with_margins_that_a_rig_can_live_with(hz: float, watt: float) -> None:
    design = designed("engine_vcm", hz, watt)
    assert design.steady.displacement_m < 20e-6
    assert design.margins.modulus >= 0.3
    assert design.margins.delay_s is None or design.margins.delay_s >= 200e-6


def test_margins_are_those_of_more_delay_and_more_gain() -> None:
    design = designed("engine_vcm", 53.0, 25.0)
    margin = design.margins.delay_s
    assert margin is not None
    for share, stable in ((0.97, True), (1.03, False)):
        loop = loop_of("engine_vcm", design, 50e-6 + share * margin)
        assert bool(loop.decay_rate_1_s() < 0.0) is stable
    # A modulus margin of M allows any gain from 1/(1 + M) to 1/(1 - M) times its own.
    loop, M, law = loop_of("engine_vcm", design), design.margins.modulus, design.law
    for factor in (0.99 / (1.0 - M), 1.01 / (1.0 + M)):
        scaled = StateSpaceLaw(law.A, law.B, law.C * factor, law.D * factor, law.channels, law.sample_rate_hz)
        # The law's own predictor must not change with it: the factor stands behind the law.
        assert LawLoop(loop.plant, scaled).decay_rate_1_s() < 0.0
    f = np.linspace(1.0, 2000.0, 20_001)
    assert np.abs(1.0 + loop.gain(f)).min() >= M * 0.999


def test_budget_holds_beside_the_frequency_and_the_loop_at_other_dampings() -> None:
    designer = LQGDesigner(PLANTS["engine_vcm"], loop_facts(RATE_HZ, 50e-6))
    design = designer.solve(53.0, 1000.0, joule_mean_w=25.0, drift_hz=0.25, damping_std_ns_m=0.5)
    loop = loop_of("engine_vcm", design)
    assert max(loop.steady(f, 1000.0).powers.joule_mean_w for f in (52.75, 53.0, 53.25)) <= 25.0
    for damping in (1.7, 3.7):
        plant = sampled_plant(PLANTS["engine_vcm"], designer.facts, 53.0, damping)
        other = LawLoop(plant, design.law)
        assert other.decay_rate_1_s() < 0.0
        assert other.margins(53.0).modulus >= 0.49


def test_voltage_limit_is_kept_by_spending_less_where_less_current_is_less_voltage() -> None:
    free = designed("engine_vcm", 47.0, 25.0)
    most = 0.95 * free.steady.voltage_peak_v
    designer = LQGDesigner(PLANTS["engine_vcm"], loop_facts(RATE_HZ, 50e-6))
    held = designer.solve(47.0, 1000.0, joule_mean_w=25.0, voltage_peak_v=most)
    assert held.steady.voltage_peak_v <= most
    assert held.steady.powers.joule_mean_w < free.steady.powers.joule_mean_w
    # At 53 Hz the current holds the stroke down, and with it the back-EMF: less current is more voltage.
    with pytest.raises(RunError, match="kept the limit voltage_peak_v"):
        designer.solve(53.0, 1000.0, joule_mean_w=25.0, voltage_peak_v=1.0)


def test_noise_of_the_sensors_burns_little_and_goes_with_the_square_of_their_density() -> None:
    design = designed("rig", 46.0, 0.4)
    loop = loop_of("rig", design)
    power = loop.noise_power_w()
    assert 0.0 < power < 1e-3
    assert loop.noise_power_w(2.0 * np.asarray(loop.plant.noise_density)) == pytest.approx(4.0 * power)


@settings(deadline=None, max_examples=12)
@given(st.floats(45.0, 55.0), st.floats(0.02, 5.0), st.integers(0, 10), st.sampled_from([0.0, 0.2]))
def test_whatever_is_designed_is_stable_within_budget_and_better_than_nothing(
    hz: float, watt: float, samples: int, drift: float
) -> None:
    plant: Plant = PLANTS["rig"]
    design = LQGDesigner(plant, LoopFacts(RATE_HZ, samples)).solve(hz, 4.0, joule_mean_w=watt, drift_hz=drift)
    loop = LawLoop(sampled_plant(plant, LoopFacts(RATE_HZ, samples), hz), design.law)
    assert loop.decay_rate_1_s() < 0.0
    for f in (hz - drift, hz, hz + drift):
        assert loop.steady(f, 4.0).powers.joule_mean_w <= watt * (1.0 + 1e-9)
    motion, _ = loop.plant.responses(hz)
    assert loop.steady(hz, 4.0).displacement_m <= 4.0 * abs(motion[0, 0, 1])
    assert loop.margins(hz).modulus >= 0.5


def test_margins_that_no_observer_keeps_are_refused_with_the_best_there_is() -> None:
    designer = LQGDesigner(PLANTS["rig"], loop_facts(RATE_HZ, 50e-6), modulus_margin=0.99)
    with pytest.raises(RunError, match="best modulus margin"):
        designer.solve(46.0, 4.0, joule_mean_w=1.0)
