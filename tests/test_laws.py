"""Gains, Routh's table and the analogue chain against roots, SciPy and the thesis's own polynomials."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter

from tuning import rule
from twin.control import filters, laws, routh
from twin.control.continuous import build_loop
from twin.control.filters import Cutoffs
from twin.control.laws import Law, scheduled_law
from twin.plant.config import GROUND, Body, Plant, VoiceCoil
from twin.plant.files import load_plant

ENGINE = load_plant("engine")
share = st.floats(0.0, 1.0)


def two_bodies(m1=40.0, m2=9.0, c1=100.0, c2=3.0, k1=8000.0, k2=8e5) -> Plant:
    return Plant(
        name="two",
        body=(
            Body(name="one", mass_kg=m1, attached_to=GROUND, stiffness_n_m=k1, damping_ns_m=c1),
            Body(name="two", mass_kg=m2, attached_to="one", stiffness_n_m=k2, damping_ns_m=c2),
        ),
    )


@pytest.mark.parametrize("measurement", ["relative", "absolute"])
@pytest.mark.parametrize("feedback", ["position", "acceleration"])
@pytest.mark.parametrize("hz", [41.0, 47.0, 50.0, 55.0])
def test_primary_is_quiet_at_the_excitation_whichever_way_the_motion_is_measured(hz, feedback, measurement):
    law = scheduled_law(ENGINE.absorber, hz, feedback, measurement)
    loop = build_loop(ENGINE, law)
    assert abs(loop.steady(hz)[0]) < 1e-12 * abs(loop.steady(hz + 1.0)[0])


def test_the_scheduling_rule_stands_once():
    assert rule.scheduled_stiffness is laws.scheduled_stiffness
    assert rule.paired_low_pass_hz is filters.paired_low_pass_hz


def test_gains_have_the_sign_of_the_retuning():
    assert laws.scheduled_stiffness(2.0, 50.0, 45.0) == pytest.approx(2.0 * math.tau**2 * (45**2 - 50**2))
    assert laws.scheduled_mass(2.0, 50.0, 45.0) == pytest.approx(2.0 * (2500.0 / 2025.0 - 1.0))


def test_coil_on_the_ground_pushes_the_absorber_alone():
    coil = VoiceCoil(
        name="c", kind="voice_coil", on="two", resistance_ohm=1.0, inductance_h=1e-3, force_constant_n_a=5.0
    )
    plant = two_bodies().model_copy(update={"actuator": (coil,)})
    assert laws.actuated_pair(plant) == (GROUND, "two")
    np.testing.assert_array_equal(laws.measured_motion(plant, "relative"), [0.0, -1.0])


# --- Routh ------------------------------------------------------------------------------------------------


def test_table_of_a_textbook_polynomial():
    # s^4 + 2 s^3 + 3 s^2 + 4 s + 5 (Ogata): first column 1, 2, 1, -6, 5
    table = routh.routh_table([1.0, 2.0, 3.0, 4.0, 5.0])
    np.testing.assert_allclose(table[:, 0], [1.0, 2.0, 1.0, -6.0, 5.0])
    assert routh.unstable_roots([1.0, 2.0, 3.0, 4.0, 5.0]) == 2


def test_row_of_zeros_is_told_from_stability():
    pair_on_axis = np.poly([-1.0, 2j, -2j]).real
    assert routh.unstable_roots(pair_on_axis) == 0
    assert not routh.is_hurwitz(pair_on_axis)
    assert routh.unstable_roots(np.poly([2.0, -2.0, -1.0])) == 1


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(0.1, 3)), min_size=1, max_size=3), st.floats(-3, 3))
def test_sign_changes_are_the_roots_right_of_the_axis(pairs, real):
    roots = [complex(a, s * b) for a, b in pairs for s in (1, -1)] + [real]
    if min(abs(complex(r).real) for r in roots) < 0.05:
        return
    coefficients = np.poly(roots).real
    assert routh.unstable_roots(coefficients) == sum(complex(r).real > 0 for r in roots)
    assert routh.is_hurwitz(coefficients) == all(complex(r).real < 0 for r in roots)


@pytest.mark.parametrize("bad", [[0.0, 1.0], [1.0], [1.0, np.nan]])
def test_what_is_no_polynomial_is_refused(bad):
    with pytest.raises(ValueError, match="characteristic polynomial"):
        routh.routh_table(bad)


@settings(deadline=None)
@given(share, share, share, st.sampled_from(["relative", "absolute"]))
def test_characteristic_polynomial_has_the_closed_loop_poles(a, b, g, measurement):
    law = Law(-3.0 + 6.0 * a, -60.0 + 100.0 * b, -6e5 + 1.2e6 * g, measurement)
    coefficients = routh.characteristic_polynomial(ENGINE, law)
    poles = build_loop(ENGINE, law).closed_poles
    np.testing.assert_allclose(np.poly(poles).real * coefficients[0], coefficients, rtol=1e-6)
    assert routh.is_hurwitz(coefficients) == (poles.real.max() < 0.0)


@settings(deadline=None)
@given(share, share, share)
def test_relative_feedback_inside_the_bounds_is_stable(a, b, g):
    bounds = routh.gain_bounds(ENGINE)
    law = Law(
        bounds.alpha_relative_kg * 0.999 + 20.0 * a,
        bounds.beta_ns_m + 1e-3 + 500.0 * b,
        bounds.gamma_n_m * 0.999 + 2e6 * g,
    )
    assert routh.is_hurwitz(routh.characteristic_polynomial(ENGINE, law))


def test_acceleration_gain_between_the_two_bounds_is_unstable_although_the_thesis_allows_it():
    bounds = routh.gain_bounds(ENGINE)
    assert bounds.alpha_kg == -8.862 < bounds.alpha_relative_kg == pytest.approx(-7.299, abs=1e-3)
    law = Law(alpha_kg=-8.0)
    assert not routh.is_hurwitz(routh.characteristic_polynomial(ENGINE, law))
    assert build_loop(ENGINE, law).closed_poles.real.max() > 0.0


def test_absolute_measurement_needs_more_than_the_bounds():
    # without damping on the primary, gamma > m2 k1/(m1 + m2) drives the slow mode
    plant = two_bodies(c1=0.0)
    limit = 9.0 * 8000.0 / 49.0
    for factor, stable in ((0.9, True), (1.1, False)):
        law = Law(gamma_n_m=factor * limit, measurement="absolute")
        assert routh.is_hurwitz(routh.characteristic_polynomial(plant, law)) is stable
    relative = Law(gamma_n_m=1.1 * limit)
    assert routh.is_hurwitz(routh.characteristic_polynomial(plant, relative))


# --- filters ----------------------------------------------------------------------------------------------


def test_phases_are_those_of_the_thesis():
    degrees = [math.degrees(filters.low_pass_phase(f, 200.0)) for f in (45.0, 55.0)]
    assert degrees == pytest.approx([-18.53, -22.82], abs=0.006)
    delays = [1e3 * filters.phase_delay_s(filters.low_pass_phase(f, 200.0), f) for f in (45.0, 55.0)]
    assert delays == pytest.approx([1.144, 1.153], abs=6e-4)
    high = [math.degrees(filters.high_pass_phase(f, 1.0)) for f in (45.0, 55.0)]
    assert high == pytest.approx([1.801, 1.473], abs=6e-4)
    # the thesis prints 0.10006 ms
    assert -1e3 * filters.phase_delay_s(filters.high_pass_phase(45.0, 1.0), 45.0) == pytest.approx(
        0.1112, abs=1e-4
    )


def test_pairing_nulls_the_velocity_and_leaves_a_lead_on_the_position():
    for hz in (45.0, 50.0, 55.0):
        cutoffs = Cutoffs(filters.paired_low_pass_hz(hz, 2.5), 2.5)
        assert filters.velocity_path_phase(hz, cutoffs) == pytest.approx(0.0, abs=1e-12)
        assert filters.position_path_phase(hz, cutoffs) == pytest.approx(
            filters.high_pass_phase(hz, 2.5), abs=1e-12
        )
    assert math.degrees(filters.position_path_phase(45.0, Cutoffs(810.0, 2.5))) > 4.0


def test_phase_of_the_position_path_looks_like_damping():
    # absorber at 55 Hz, low-pass 200 Hz, high-pass 1 Hz
    found = []
    for hz in (45.0, 50.0, 55.0):
        phase = filters.position_path_phase(hz, Cutoffs(200.0, 1.0))
        found.append(filters.phase_as_damping(laws.scheduled_stiffness(0.4125, 55.0, hz), phase, hz))
    assert found == pytest.approx([14.8, 8.1, 0.0], abs=0.1)


@settings(deadline=None)
@given(st.floats(30.0, 3000.0), st.floats(0.1, 20.0), st.floats(1.0, 500.0))
def test_chain_is_a_butterworth_chain(low, high, hz):
    A, B, C = filters.chain_state_space(Cutoffs(low, high))
    s = 2j * np.pi * hz
    ours = C @ np.linalg.solve(s * np.eye(6) - A, B)
    lp, hp = (
        (np.polyval(b, s) / np.polyval(a, s))
        for b, a in (
            butter(2, math.tau * low, "low", analog=True),
            butter(2, math.tau * high, "high", analog=True),
        )
    )
    np.testing.assert_allclose(ours, [lp, lp * hp / s, lp * (hp / s) ** 2], rtol=1e-8)
    assert np.angle(lp) == pytest.approx(filters.low_pass_phase(hz, low), abs=1e-9)
    assert np.angle(hp) == pytest.approx(filters.high_pass_phase(hz, high), abs=1e-9)


@pytest.mark.parametrize("cutoffs", [(1.0, 200.0), (0.0, 0.0), (200.0, -1.0), (math.inf, 1.0)])
def test_cutoffs_in_the_wrong_order_are_refused(cutoffs):
    with pytest.raises(ValueError, match="low-pass"):
        Cutoffs(*cutoffs)
