"""Filter cutoffs: the program against brute force, the verified noise against simulated samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from tuning.cutoffs import (
    SECOND_ORDER,
    TWICE_INTEGRATED,
    CutoffBounds,
    CutoffProgram,
    tune_jointly,
)
from tuning.law_loop import LawLoop, rig_law
from tuning.loop import LoopFacts, RigModel, loop_facts
from tuning.rule import scheduling_rule
from tuning.sampled import relative_noise_density, sampled_plant
from twin.control.schedule import Gains
from twin.plant.errors import InputError, RunError
from twin.plant.files import load_plant

RATE_HZ = 50_000.0
FACTS = loop_facts(RATE_HZ, 50e-6)
ENGINE, RIG = load_plant("engine_vcm"), load_plant("rig")


@pytest.fixture(scope="module")
def rig() -> CutoffProgram:
    return CutoffProgram(RIG, FACTS)


@pytest.fixture(scope="module")
def engine() -> CutoffProgram:
    return CutoffProgram(ENGINE, FACTS)


def test_noise_coefficients_are_the_integrals_of_the_filters() -> None:
    once = quad(lambda x: x**2 / (1.0 + x**4), 0.0, math.inf)[0]
    twice = quad(lambda x: x**4 / (1.0 + x**4) ** 2, 0.0, math.inf)[0]
    low = quad(lambda x: 1.0 / (1.0 + x**4), 0.0, math.inf)[0]
    assert (once, low, twice) == pytest.approx((SECOND_ORDER, SECOND_ORDER, TWICE_INTEGRATED), rel=1e-9)
    assert (round(SECOND_ORDER, 4), round(TWICE_INTEGRATED, 4)) == (1.1107, 0.2777)


@pytest.mark.parametrize("delay_s", [0.0, 40e-6, 50e-6])
def test_rig_law_closes_the_loop_that_the_tuner_knows(delay_s: float) -> None:
    facts = loop_facts(RATE_HZ, delay_s)
    gains = replace(scheduling_rule(RIG, [53.0]).at(53.0), alpha_kg=0.02)
    model = RigModel(RIG, facts, 53.0)
    loop = LawLoop(
        sampled_plant(RIG, facts, 53.0, None, ("relative_acceleration",)), rig_law(gains, 8.0, RATE_HZ)
    )
    assert loop.decay_rate_1_s() == pytest.approx(model.decay_rate_1_s(gains), abs=1e-5)
    f = np.geomspace(1.0, 5e3, 50)
    row = np.array([gains.alpha_kg, gains.beta_ns_m, gains.gamma_n_m])
    np.testing.assert_allclose(
        loop.gain(f), model.loop_terms(f, gains.low_pass_hz, gains.high_pass_hz) @ row, rtol=1e-7
    )


def test_noise_power_is_that_of_simulated_samples() -> None:
    gains = replace(scheduling_rule(RIG, [47.0]).at(47.0), high_pass_hz=2.0)
    plant = sampled_plant(RIG, FACTS, 47.0, None, ("relative_acceleration",))
    loop = LawLoop(plant, rig_law(gains, 8.0, RATE_HZ))
    expected = loop.noise_power_w()
    density = relative_noise_density(RIG)
    assert density == pytest.approx(math.sqrt(2.0) * 1e-3)
    # Noise that reaches the measurement as it does: by the response from the channel to the current.
    f = np.concatenate(
        [np.geomspace(1e-3, 1.0, 4000), np.geomspace(1.0, 200.0, 40_000), np.geomspace(200.0, 25e3, 4000)]
    )
    f = np.unique(f)
    law = loop.law.response(f)[:, 0]
    motion, measured = plant.responses(f)
    current = motion[:, 2, 0] * law / (1.0 - law * measured[:, 0, 0])
    power = 2.7 * density**2 * np.trapezoid(np.abs(current) ** 2, f)
    assert expected == pytest.approx(power, rel=1e-3)


def test_law_that_is_unstable_burns_without_bound() -> None:
    gains = scheduling_rule(ENGINE, [47.0]).at(47.0)
    plant = sampled_plant(ENGINE, FACTS, 47.0, None, ("relative_acceleration",))
    loop = LawLoop(plant, rig_law(gains, 22.2, RATE_HZ))
    assert loop.decay_rate_1_s() > 0.0
    assert loop.noise_power_w() == math.inf


@pytest.mark.parametrize("hz", [45.0, 47.0, 53.0, 55.0])
@pytest.mark.parametrize("budget", [3e-5, 1e-3])
def test_no_cutoffs_on_a_fine_grid_have_less_phase_within_the_verified_noise(
    rig: CutoffProgram, hz: float, budget: float
) -> None:
    gains = scheduling_rule(RIG, [hz]).at(hz)
    found = rig.solve(gains, hz, noise_budget_w=budget)
    assert found.verified_noise_power_w <= budget
    assert found.decay_rate_1_s < -0.5
    best = math.inf
    for high in np.geomspace(0.2, 20.0, 60):
        tried = rig.verify(replace(gains, low_pass_hz=2000.0, high_pass_hz=float(high)), hz)
        if tried.verified_noise_power_w <= budget and tried.decay_rate_1_s < -0.5:
            best = min(best, tried.phase_rad)
    # The noise budget is used to nine tenths at least: to a tenth in f_hp at the -1st power, less at the -3rd.
    assert found.phase_rad <= 1.06 * best


@settings(deadline=None, max_examples=25)
@given(st.floats(-0.1, 0.1), st.floats(-15.0, 5.0), st.floats(-8e3, 8e3), st.floats(-6.0, -1.0))
def test_geometric_program_is_no_worse_than_any_pair_on_a_grid(
    alpha: float, beta: float, gamma: float, log_budget: float
) -> None:
    """With all three terms, without the loop: the program itself."""
    gains = Gains(alpha, beta, gamma, 1000.0, 1.0)
    box, budget = CutoffBounds(), 10.0**log_budget
    pair = PROGRAM._program(gains, 50.0, budget, box)
    lead, lag, noise = PROGRAM._terms(gains, 50.0, budget)
    low, high = np.meshgrid(np.geomspace(100.0, 2000.0, 120), np.geomspace(0.2, 20.0, 120))
    fits = noise[0] * high**-3 + noise[1] / high + noise[2] * low <= 1.0
    if pair is None:
        assert not fits.any()
        return
    phase = (lead * high + lag / low)[fits]
    f_lp, f_hp = pair
    assert noise[0] * f_hp**-3 + noise[1] / f_hp + noise[2] * f_lp <= 1.0 + 1e-6
    assert not len(phase) or lead * f_hp + lag / f_lp <= float(phase.min()) * (1.0 + 1e-6)


PROGRAM = CutoffProgram(RIG, FACTS)


def test_engine_that_test_3_filters_destabilise_is_stable_with_better_ones(engine: CutoffProgram) -> None:
    gains = scheduling_rule(ENGINE, [47.0]).at(47.0)
    assert RigModel(ENGINE, FACTS, 47.0).decay_rate_1_s(gains) > 0.0
    found = engine.solve(gains, 47.0, noise_budget_w=1.0)
    better = replace(gains, low_pass_hz=found.low_pass_hz, high_pass_hz=found.high_pass_hz)
    assert RigModel(ENGINE, FACTS, 47.0).decay_rate_1_s(better) < -0.5
    assert found.verified_noise_power_w <= 1.0


def test_high_pass_keeps_off_the_low_mode_below_it(engine: CutoffProgram) -> None:
    """At 53 Hz a high-pass near the engine's own 2 Hz mode drives it: less phase is not always better."""
    gains = scheduling_rule(ENGINE, [53.0]).at(53.0)
    transparent = engine.verify(replace(gains, low_pass_hz=2000.0, high_pass_hz=0.3), 53.0)
    assert transparent.decay_rate_1_s > 0.0
    assert transparent.verified_noise_power_w == math.inf
    found = engine.solve(gains, 53.0, noise_budget_w=1.0)
    assert found.high_pass_hz > 1.0
    assert found.decay_rate_1_s < -0.5


def test_a_noise_budget_that_no_stable_cutoffs_keep_names_the_least_that_would_do(
    engine: CutoffProgram,
) -> None:
    gains = scheduling_rule(ENGINE, [47.0]).at(47.0)
    with pytest.raises(RunError, match=r"burns at least ([0-9.]+) W") as error:
        engine.solve(gains, 47.0, noise_budget_w=1e-3)
    least = float(str(error.value).split("at least ")[1].split(" W")[0])
    assert engine.solve(gains, 47.0, noise_budget_w=1.05 * least).verified_noise_power_w <= 1.05 * least


def test_gains_that_are_unstable_with_any_filters_are_refused(rig: CutoffProgram) -> None:
    with pytest.raises(RunError, match="do not settle"):
        rig.solve(Gains(0.0, -60.0, 4e3, 500.0, 1.0), 53.0, noise_budget_w=1.0)


def test_bad_input_is_refused(rig: CutoffProgram) -> None:
    gains = scheduling_rule(RIG, [50.0]).at(50.0)
    with pytest.raises(InputError, match="noise_budget_w"):
        rig.solve(gains, 50.0, noise_budget_w=0.0)
    with pytest.raises(InputError, match="low_pass_min_hz"):
        CutoffBounds(low_pass_min_hz=3000.0)
    with pytest.raises(InputError, match="noise_density"):
        CutoffProgram(RIG, FACTS, noise_density=-1.0)
    with pytest.raises(InputError, match="no voice coil"):
        CutoffProgram(load_plant("engine"), FACTS)


def test_louder_sensors_ask_for_a_higher_high_pass() -> None:
    gains = scheduling_rule(RIG, [47.0]).at(47.0)
    quiet, loud = (
        CutoffProgram(RIG, FACTS, noise_density=n).solve(gains, 47.0, noise_budget_w=1e-3)
        for n in (1e-3, 4e-3)
    )
    # Twice the noise density is four times the power: with the position's share alone the cutoff goes by 16^(1/3).
    assert loud.high_pass_hz / quiet.high_pass_hz == pytest.approx(16.0 ** (1.0 / 3.0), rel=0.15)


def nulling_gains(plant_hz: float, facts: LoopFacts) -> "object":
    """(beta, gamma) that null the primary's motion through given filters: a two by two real solve."""
    model = RigModel(RIG, facts, plant_hz)
    response = model.response(plant_hz)[0]
    wanted = -response[0, 1] / response[0, 0]
    acceleration = response[2, 0] * wanted + response[2, 1]

    def solve(low_pass_hz: float, high_pass_hz: float) -> Gains:
        path = model.paths(plant_hz, low_pass_hz, high_pass_hz)[0] * acceleration
        pair = np.array([[path[1].real, path[2].real], [path[1].imag, path[2].imag]])
        beta, gamma = np.linalg.solve(pair, [wanted.real, wanted.imag])
        return Gains(0.0, float(beta), float(gamma), low_pass_hz, high_pass_hz)

    return solve


@pytest.mark.parametrize("hz", [46.0, 48.0])
def test_gains_and_cutoffs_settle_together(rig: CutoffProgram, hz: float) -> None:
    solve = nulling_gains(hz, FACTS)
    found = tune_jointly(solve, rig, hz, (200.0, 2.5), noise_budget_w=2e-4)
    assert found.settled
    assert found.rounds <= 6
    assert found.cutoffs.verified_noise_power_w <= 2e-4
    assert RigModel(RIG, FACTS, hz).decay_rate_1_s(found.gains) < -0.5
    again = solve(found.gains.low_pass_hz, found.gains.high_pass_hz)
    assert again.as_tuple() == pytest.approx(found.gains.as_tuple())


def test_joint_iteration_says_why_it_found_nothing(rig: CutoffProgram) -> None:
    def none(low_pass_hz: float, high_pass_hz: float) -> Gains:
        return Gains(0.0, -60.0, 4e3, low_pass_hz, high_pass_hz)

    with pytest.raises(RunError, match="do not come together at 53 Hz: these gains do not settle"):
        tune_jointly(none, rig, 53.0, (500.0, 1.0), noise_budget_w=1.0)


def test_joint_iteration_begins_elsewhere_where_the_filters_in_use_allow_no_gains(rig: CutoffProgram) -> None:
    solve, asked = nulling_gains(47.0, FACTS), []

    def picky(low_pass_hz: float, high_pass_hz: float) -> Gains:
        asked.append((low_pass_hz, high_pass_hz))
        if low_pass_hz < 500.0:
            raise RunError("no gains keep the margin")
        return solve(low_pass_hz, high_pass_hz)

    found = tune_jointly(picky, rig, 47.0, (200.0, 2.5), noise_budget_w=2e-4)
    assert asked[:2] == [(200.0, 2.5), (2000.0, 0.2)]
    assert found.settled
