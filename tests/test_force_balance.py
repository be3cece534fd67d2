"""Damping and stiffness of one block: exact whatever the motion does, and as uncertain as it says."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.excitation import ExcitationTracker
from estimators.force_balance import AbsorberBalance, ForceBalance
from estimators.moments import MOST_DERIVATIVES, moments
from tests.absorber_motion import (
    FORCE_CONSTANT_N_A,
    MASS_KG,
    NAMES,
    STIFFNESS_N_M,
    WITH_DRIVE,
    amplitudes,
    blocks,
    last_phasors,
    measured,
)
from twin.plant.blocks import Channel, make_block
from twin.plant.config import Plant, Sensor
from twin.plant.files import load_plant

RATE_HZ, SIZE = 5_000.0, 500
TABLE, ABSORBER = 1e-5, 3e-4 * np.exp(0.7j)
NOISE = np.array([0.158, 0.158, 1.58e-3])
"""Standard deviations of the rig's own sensors at 50 kS/s [m/s², m/s², A]."""


@pytest.fixture(scope="module")
def rig() -> Plant:
    return load_plant("rig")


def time_of(n_blocks: int) -> np.ndarray:
    return np.arange(n_blocks * SIZE) / RATE_HZ


def solved(values: np.ndarray, plant: Plant) -> ForceBalance:
    return AbsorberBalance(plant, WITH_DRIVE).solve(last_phasors(values, RATE_HZ, SIZE))


# --- exactness ----------------------------------------------------------------------------------------------


def test_moments_of_a_derivative_are_those_of_the_function_by_parts() -> None:
    # <x'', psi> = <x, psi''> for a sum of tones, growth and offset that have nothing to do with the block.
    n, duration = 2_000, 0.1
    t = (np.arange(n) + 0.5) / n * duration - 0.5 * duration
    s = np.array([3.0 + 2j * np.pi * 47.1, -1.0 + 2j * np.pi * 11.3])
    x = np.exp(s[:, None] * t).real
    second = (s[:, None] ** 2 * np.exp(s[:, None] * t)).real
    found = moments(np.vstack([x, second]).T, duration, 50.0, MOST_DERIVATIVES)
    full = found.against_derivatives
    np.testing.assert_allclose(
        full[:, 2, :2], full[:, 0, 2:], rtol=1e-6, atol=1e-6 * np.abs(full[:, 2]).max()
    )


@settings(deadline=None, max_examples=60)
@given(
    hz=st.floats(30.0, 70.0),
    damping=st.floats(0.0, 40.0),
    stiffness=st.floats(2e4, 8e4),
    sizes=st.tuples(st.floats(1e-6, 1e-3), st.floats(1e-6, 1e-3)),
    angles=st.tuples(st.floats(0.0, 6.28), st.floats(0.0, 6.28)),
    growth=st.floats(-3.0, 3.0),
)
def test_motion_that_obeys_newton_gives_back_damping_and_stiffness(
    hz: float,
    damping: float,
    stiffness: float,
    sizes: tuple[float, float],
    angles: tuple[float, float],
    growth: float,
) -> None:
    table, absorber = (a * np.exp(1j * p) for a, p in zip(sizes, angles, strict=True))
    if abs(table - absorber) < 1e-2 * max(sizes):
        return
    s = complex(growth, 2 * math.pi * hz)
    values = measured(s, amplitudes(s, table, absorber, damping, stiffness), time_of(3))
    balance = solved(values, load_plant("rig"))
    amplification = max(sizes) / abs(table - absorber)
    scale = stiffness / (2 * math.pi * hz)  # what a damping of the spring's own size would be
    assert balance.damping_ns_m == pytest.approx(damping, abs=1e-5 * scale * amplification)
    assert balance.stiffness_n_m == pytest.approx(stiffness, rel=1e-5 * amplification)
    assert balance.transient_1_s == pytest.approx(abs(growth), rel=0.05, abs=1e-3)


def test_swept_excitation_leaves_no_bias(rig: Plant) -> None:
    # x, x' and x'' of a chirp in closed form; taking it for a tone at each instant would cost 0.1 Ns/m at 2 Hz/s.
    t = time_of(12)
    rate = 2.0
    phase = 2 * np.pi * (44.0 * t + 0.5 * rate * t**2)
    w, turning = 2 * np.pi * (44.0 + rate * t), np.exp(1j * phase)
    velocity, acceleration = 1j * w, 2j * np.pi * rate - w**2
    relative = ABSORBER - TABLE
    force = MASS_KG * acceleration * ABSORBER + (STIFFNESS_N_M + 13.5 * velocity) * relative
    signals = np.column_stack([acceleration * TABLE, acceleration * ABSORBER, force / FORCE_CONSTANT_N_A])
    values = np.column_stack([(signals * turning[:, None]).real, np.cos(phase)])
    assert solved(values, rig).damping_ns_m == pytest.approx(13.5, abs=1e-3)


def test_motion_from_elsewhere_neither_biases_nor_counts_as_noise(rig: Plant) -> None:
    # A floor that shakes both bodies at the rig's own resonances, several times stronger than the excitation.
    t, s = time_of(30), 2j * math.pi * 50.0
    clean = measured(s, amplitudes(s, TABLE, ABSORBER, 13.5), t)
    for pole, size in ((-1.0 + 2j * math.pi * 11.1, 2e-3), (-2.0 + 2j * math.pi * 57.3, 3e-4)):
        clean[:, :3] += (np.exp(pole * t)[:, None] * amplitudes(pole, size, 1.3 * size, 13.5)).real
    clean[:, :3] += (9.81, -3.0, 0.05)  # offsets, as of accelerometers that feel gravity
    rng = np.random.default_rng(4)
    values = clean.copy()
    values[:, :3] += 0.1 * NOISE * rng.standard_normal((len(t), 3))
    tracker, balance = ExcitationTracker("drive", WITH_DRIVE), AbsorberBalance(rig, WITH_DRIVE)
    found = []
    for block in blocks(values, RATE_HZ, SIZE):
        phasors = tracker.advance(block)
        assert phasors is not None
        found.append(balance.solve(phasors))
    errors = np.array([b.damping_ns_m - 13.5 for b in found[5:]])
    stds = np.array([b.damping_std_ns_m for b in found[5:]])
    assert np.all(np.abs(errors) < 5.0 * stds)
    assert 0.7 < np.std(errors / stds) < 1.4


def test_any_kind_of_motion_sensor_will_do(rig: Plant) -> None:
    t, s = time_of(3), 2j * math.pi * 50.0
    current = amplitudes(s, TABLE, ABSORBER, 13.5)[2]
    sensors = {
        "table_velocity": ("velocity", "table", s * TABLE),
        "absorber_displacement": ("displacement", "absorber", ABSORBER),
        "stroke": ("displacement", ("absorber", "table"), ABSORBER - TABLE),
        "absorber_acceleration": ("acceleration", "absorber", s**2 * ABSORBER),
    }
    for names in (
        ("table_velocity", "absorber_displacement"),
        ("stroke", "absorber_acceleration"),
        ("table_velocity", "absorber_displacement", "stroke", "absorber_acceleration"),
    ):
        own = tuple(Sensor(name=n, kind=sensors[n][0], of=sensors[n][1], noise_density=1e-6) for n in names)  # type: ignore[arg-type]
        coil = next(q for q in rig.sensor if q.name == "vcm_current")
        plant = rig.model_copy(update={"sensor": (*own, coil)})
        columns = (*names, "vcm_current", "drive")
        amplitude = np.array([*(sensors[n][2] for n in names), current, 1.0])
        values = (np.exp(s * t)[:, None] * amplitude).real
        tracker = ExcitationTracker("drive", columns)
        channels = tuple(Channel(c, "") for c in columns)
        for k in range(0, len(values), SIZE):
            phasors = tracker.advance(make_block(k, RATE_HZ, values[k : k + SIZE], channels))
        assert phasors is not None
        balance = AbsorberBalance(plant, columns).solve(phasors)
        assert balance.damping_ns_m == pytest.approx(13.5, abs=5e-3)
        assert balance.stiffness_n_m == pytest.approx(STIFFNESS_N_M, rel=1e-4)


# --- uncertainty --------------------------------------------------------------------------------------------


def cramer_rao_damping(hz: float, damping: float, noise: np.ndarray, n: int, rate_hz: float) -> float:
    """Least standard deviation of the damping from one block: Fisher information of the sampled signals.

    Unknown are both motions' complex amplitudes, stiffness and damping; the frequency is known.
    """
    s = 2j * math.pi * hz
    t = (np.arange(n) - 0.5 * (n - 1)) / rate_hz
    start = np.array([TABLE, 0.0, ABSORBER.real, ABSORBER.imag, damping, STIFFNESS_N_M])

    def signals(p: np.ndarray) -> np.ndarray:
        amplitude = amplitudes(s, complex(p[0], p[1]), complex(p[2], p[3]), p[4], p[5])
        return ((np.exp(s * t)[:, None] * amplitude).real / noise).ravel()

    steps = np.array([1e-8, 1e-8, 1e-8, 1e-8, 1e-2, 1.0])
    scaled = np.column_stack(
        [0.5 * (signals(start + d) - signals(start - d)) for d in np.diag(steps)]
    )  # per step, which keeps the information well conditioned
    return float(np.sqrt(np.linalg.inv(scaled.T @ scaled)[4, 4]) * steps[4])


@pytest.mark.parametrize("hz", [45.0, 50.0, 55.0])
def test_damping_reaches_the_cramer_rao_bound_and_its_std_covers_the_truth(rig: Plant, hz: float) -> None:
    n_blocks = 620
    t, s = time_of(n_blocks), 2j * math.pi * hz
    amplitude = amplitudes(s, TABLE, ABSORBER, 13.5)
    rng = np.random.default_rng(round(hz))
    values = measured(s, amplitude, t)
    values[:, :3] += NOISE * rng.standard_normal((len(t), 3))
    tracker, balance = ExcitationTracker("drive", WITH_DRIVE), AbsorberBalance(rig, WITH_DRIVE)
    found = []
    for block in blocks(values, RATE_HZ, SIZE):
        phasors = tracker.advance(block)
        assert phasors is not None
        found.append(balance.solve(phasors))
    found = found[20:]
    error = np.array([b.damping_ns_m - 13.5 for b in found])
    std = np.array([b.damping_std_ns_m for b in found])
    bound = cramer_rao_damping(hz, 13.5, NOISE, SIZE, RATE_HZ)
    assert 0.9 < np.std(error) / bound < 1.25
    assert 0.92 <= np.mean(np.abs(error) < 1.96 * std) <= 0.98
    assert abs(np.mean(error)) < 4.0 * np.std(error) / math.sqrt(len(error))
    stiffness = np.array([(b.stiffness_n_m - STIFFNESS_N_M) / b.stiffness_std_n_m for b in found])
    assert 0.92 <= np.mean(np.abs(stiffness) < 1.96) <= 0.98


def test_delay_of_a_channel_adds_what_the_balance_says_and_a_common_one_nothing(rig: Plant) -> None:
    s, late = 2j * math.pi * 46.0, 20e-6
    amplitude = amplitudes(s, 4 * TABLE, ABSORBER, 13.5)
    plain = solved(measured(s, amplitude, time_of(3)), rig)
    assert abs(plain.damping_per_delay_ns_m_s.sum()) < 1e-6 * np.abs(plain.damping_per_delay_ns_m_s).max()
    for which in range(3):
        delayed = amplitude.copy()
        delayed[which] *= np.exp(-s * late)
        found = solved(measured(s, delayed, time_of(3)), rig)
        said = plain.damping_per_delay_ns_m_s[which] * late
        assert found.damping_ns_m - plain.damping_ns_m == pytest.approx(said, rel=0.02, abs=3e-3)
        said = plain.stiffness_per_delay_n_m_s[which] * late
        assert found.stiffness_n_m - plain.stiffness_n_m == pytest.approx(said, rel=0.05, abs=1.0)


def test_model_stiffness_and_model_damping_are_not_used(rig: Plant) -> None:
    s = 2j * math.pi * 46.0
    values = measured(s, amplitudes(s, TABLE, ABSORBER, 13.5), time_of(3))
    absorber = rig.body[1].model_copy(update={"stiffness_n_m": 1.05 * STIFFNESS_N_M, "damping_ns_m": 30.0})
    wrong = rig.model_copy(update={"body": (rig.body[0], absorber)})
    assert solved(values, wrong).damping_ns_m == solved(values, rig).damping_ns_m


# --- what cannot be solved ----------------------------------------------------------------------------------


def test_absorber_that_stands_still_tells_nothing(rig: Plant) -> None:
    values = measured(2j * math.pi * 50.0, np.zeros(3, complex), time_of(3))
    balance = solved(values, rig)
    assert math.isinf(balance.damping_std_ns_m)
    assert math.isinf(balance.transient_1_s)
    assert math.isfinite(balance.damping_ns_m)


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_dead_sensor_tells_nothing_rather_than_something_wrong(rig: Plant, dead: int) -> None:
    s = 2j * math.pi * 50.0
    values = measured(s, amplitudes(s, TABLE, ABSORBER, 13.5), time_of(4))
    values[3 * SIZE :, dead] = np.nan
    balance = solved(values, rig)
    assert math.isinf(balance.damping_std_ns_m)
    assert math.isfinite(balance.damping_ns_m)


def test_a_few_missing_samples_do_no_harm(rig: Plant) -> None:
    s = 2j * math.pi * 50.0
    values = measured(s, amplitudes(s, TABLE, ABSORBER, 13.5), time_of(4))
    values[3 * SIZE + 100 : 3 * SIZE + 140, 1] = np.nan
    assert solved(values, rig).damping_ns_m == pytest.approx(13.5, abs=1e-2)


@pytest.mark.parametrize("missing", NAMES)
def test_balance_without_one_of_its_signals_is_refused(rig: Plant, missing: str) -> None:
    with pytest.raises(ValueError, match="no recorded sensor measures the"):
        AbsorberBalance(rig, tuple(n for n in NAMES if n != missing))


def test_balance_needs_a_coil_on_an_absorber() -> None:
    with pytest.raises(ValueError, match="no voice coil"):
        AbsorberBalance(load_plant("rig_no_vcm"), NAMES)
