"""The V721 shaker against its model, python-control and the regimes of the thesis."""

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twin.plant.files import load_plant
from twin.plant.linear import linear_model
from twin.plant.shaker import Regime, SweepLimits, sweep, table_motion

V721 = load_plant("shaker_v721")


def test_table_motion_is_the_plants_model():
    hz = np.geomspace(1.0, 4000.0, 101)
    model = linear_model(V721)
    table = model.response(hz)[:, model.outputs.index("table_acceleration"), 0]
    motion = table_motion(V721, hz)
    np.testing.assert_allclose(motion.acceleration, table, rtol=1e-9)
    s = control.tf("s")
    position = 159 / (4.41 * s**2 + 170 * s + 31500)
    np.testing.assert_allclose(motion.position, position(2j * np.pi * hz), rtol=1e-12)
    np.testing.assert_allclose(motion.velocity, (s * position)(2j * np.pi * hz), rtol=1e-12)


def test_limits_meet_where_the_thesis_changes_its_regime():
    low, high = SweepLimits().crossovers_hz
    assert low == pytest.approx(8.8, abs=0.05)  # thesis table in 5.3
    assert high == pytest.approx(150.0, rel=0.02)
    # with 25.4 mm read as an amplitude, as the text has it, the first would be half of that
    assert SweepLimits(displacement_m=0.0254).crossovers_hz[0] == pytest.approx(4.4, abs=0.05)


@pytest.mark.parametrize(
    ("hz", "regime", "power_of_s", "level"),
    [
        (5.0, Regime.POSITION, 0, 0.0127),
        (13.5, Regime.VELOCITY, 1, 0.7),
        (100.0, Regime.VELOCITY, 1, 0.7),
        (1000.0, Regime.ACCELERATION, 2, 647.2389),
    ],
)
def test_current_in_each_regime_follows_the_transfer_function_of_the_table(hz, regime, power_of_s, level):
    got = sweep(V721, hz)
    s = 2j * np.pi * hz
    held = (got.displacement_m, got.velocity_m_s, got.acceleration_m_s2)[power_of_s]
    assert got.regime == regime
    assert held == pytest.approx(level, rel=1e-12)
    expected = abs((4.41 * s**2 + 170 * s + 31500) / (159 * s**power_of_s)) * level
    assert got.current_a == pytest.approx(expected, rel=1e-12)


def test_current_dips_at_the_table_resonance():
    hz = np.linspace(5.0, 400.0, 79_001)
    current = sweep(V721, hz).current_a
    assert hz[current.argmin()] == pytest.approx(13.45, abs=0.01)  # thesis reads 13.5 Hz off its plot
    assert current.min() == pytest.approx(170 * 0.7 / 159, rel=1e-6)  # only the damper is left
    # far above, the mass is all there is
    assert sweep(V721, 4000.0).current_a == pytest.approx(4.41 * 647.2389 / 159, rel=1e-3)


@given(hz=st.floats(0.1, 5000.0))
def test_no_limit_is_ever_passed_and_one_is_always_reached(hz):
    limits = SweepLimits()
    got = sweep(V721, hz)
    use = np.array(
        [
            got.displacement_m / limits.displacement_m,
            got.velocity_m_s / limits.velocity_m_s,
            got.acceleration_m_s2 / limits.acceleration_m_s2,
        ]
    )
    assert use.max() == pytest.approx(1.0, rel=1e-12)


def test_regimes_follow_one_another_once():
    regime = sweep(V721, np.geomspace(5.0, 4000.0, 500)).regime
    assert list(dict.fromkeys(regime)) == ["position", "velocity", "acceleration"]
    assert np.count_nonzero(regime[1:] != regime[:-1]) == 2


def test_a_velocity_that_is_never_reached_has_no_regime():
    with pytest.raises(ValueError, match="never reached"):
        _ = SweepLimits(velocity_m_s=5.0).crossovers_hz


def test_a_plant_that_is_no_bare_shaker_is_refused():
    for name in ("rig", "beam"):
        with pytest.raises(ValueError, match="no bare shaker"):
            table_motion(load_plant(name), 10.0)
