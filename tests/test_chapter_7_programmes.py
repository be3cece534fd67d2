"""Tests 1 to 4 of chapter 7 as programmes: settings of the tables, and what they lead to."""

import math

import numpy as np
import pytest

from twin.plant.files import load_plant
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import TABLE_HZ, TESTS, measured_damping, plant_of, programme
from twin.station.validation.models import steady_test


@pytest.mark.parametrize("test", TESTS)
def test_minute_of_the_thesis_is_the_default(test):
    run = programme(test)
    sweep = run.sweep
    assert (sweep.from_hz, sweep.to_hz, sweep.duration_s, sweep.amplitude_v) == (40.0, 60.0, 60.0, 4.0)
    assert (run.schedule.on_from_hz, run.schedule.on_to_hz) == (45.0, 55.0)
    assert run.sample_rate_hz == 50_000.0


def test_damping_is_the_fit_with_the_sign_that_damps():
    curve = measured_damping()
    assert [curve.at(f) for f in (45.0, 50.0, 55.0)] == pytest.approx([14.525, 13.5, 7.325])


def test_beta_is_constant_in_test_1_and_cancels_the_damping_in_the_others():
    assert set(programme("test1").schedule.beta_ns_m) == {-14.0}
    for test in ("test2", "test3", "test4"):
        beta = programme(test).schedule.beta_ns_m
        assert beta == pytest.approx([-measured_damping().at(f) for f in TABLE_HZ])


def test_cutoffs_are_fixed_in_tests_1_and_2_and_paired_in_tests_3_and_4():
    for test in ("test1", "test2"):
        gains = programme(test).schedule.at(47.0)
        assert (gains.low_pass_hz, gains.high_pass_hz) == (200.0, 1.0)
    for test in ("test3", "test4"):
        gains = programme(test).schedule.at(47.0)
        assert gains.high_pass_hz == 2.5
        assert gains.low_pass_hz * gains.high_pass_hz == pytest.approx(47.0**2)


def test_position_gain_vanishes_where_the_absorber_is_tuned():
    assert programme("test1").schedule.at(50.0).gamma_n_m == pytest.approx(0.0, abs=5.0)
    assert programme("test2").schedule.at(55.0).gamma_n_m == pytest.approx(0.0, abs=5.0)
    assert programme("test2").schedule.at(45.0).gamma_n_m == pytest.approx(-16285.0, rel=1e-3)


def test_absorber_of_test_2_is_stiffer_not_lighter():
    plant, rig = plant_of("test2"), load_plant("rig")
    assert plant_of("test3") == rig
    assert plant.absorber.mass_kg == rig.absorber.mass_kg
    assert math.sqrt(plant.absorber.stiffness_n_m / plant.absorber.mass_kg) / math.tau == pytest.approx(55.0)


def test_only_test_4_measures_the_absorber_alone():
    assert {t: programme(t).measurement for t in TESTS} == {
        "test1": "relative", "test2": "relative", "test3": "relative", "test4": "absolute"
    }  # fmt: skip


def test_passive_rig_never_acts():
    rig = SimulatedRig(programme("test1", seconds=0.4, sweep_hz=(44.0, 56.0), controlled=False))
    while not rig.finished:
        values, acted, _ = rig.next_block()
        assert not acted
        assert not values[:, -1].any()


def test_unknown_test_is_refused():
    with pytest.raises(KeyError):
        programme("test5")


@pytest.mark.parametrize("frequency_hz", [46.0, 50.0, 54.0])
def test_steady_state_is_where_the_simulated_rig_settles(frequency_hz):
    run = programme("test3", seconds=2.0, sweep_hz=(frequency_hz, frequency_hz)).model_copy(
        update={"disturbance_density_n": 0.0}
    )
    rig = SimulatedRig(run)
    blocks = []
    while not rig.finished:
        blocks.append(rig.next_block()[0])
    values = np.concatenate(blocks[-5:])  # whole cycles of 46, 50 and 54 Hz
    t = np.arange(len(values)) / run.sample_rate_hz
    carrier = np.exp(-2j * np.pi * frequency_hz * t)
    table = abs(2.0 * np.mean(values[:, 0] * carrier)) / (2.0 * np.pi * frequency_hz) ** 2
    current = abs(2.0 * np.mean(values[:, rig.programme.plant.sensor.index(_current(rig))] * carrier))
    expected = steady_test("test3", frequency_hz)
    assert current == pytest.approx(expected[2], rel=0.02)
    assert table == pytest.approx(expected[0], rel=0.05)


def _current(rig):
    return next(s for s in rig.programme.plant.sensor if s.kind == "current" and s.of == "vcm")
