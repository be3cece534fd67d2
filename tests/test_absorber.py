"""Closed forms of absorbers and chains against matrices, python-control, SciPy and their own invariants."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigvalsh
from scipy.optimize import minimize, minimize_scalar
from scipy.signal import freqs

from twin.plant.absorber import (
    absorber_response,
    absorber_transmissibility,
    den_hartog,
    fixed_points,
    natural_frequencies,
    normalised_amplitude,
    transmissibility,
)
from twin.plant.chains import parallel_chain, series_chain
from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.plant.linear import linear_model, natural_frequencies_hz

positive = st.floats(1e-2, 1e4)
ratio = st.floats(0.01, 1.0)


def two_bodies(plant: Plant) -> dict[str, float]:
    first, second = plant.body
    return {
        "m1_kg": first.mass_kg, "m2_kg": second.mass_kg, "k1_n_m": first.stiffness_n_m,
        "k2_n_m": second.stiffness_n_m, "c1_ns_m": first.damping_at(None), "c2_ns_m": second.damping_at(None),
    }  # fmt: skip


# --- natural frequencies and the response of two bodies ---------------------------------------------------


@pytest.mark.parametrize(
    ("name", "low_hz", "high_hz"),
    [("engine", 2.054, 55.103), ("rig_no_vcm", 11.80, 55.74), ("rig", 11.09, 54.92), ("analogue_2dof", 0.953, 52.44)],
)  # fmt: skip
def test_natural_frequencies_of_the_thesis_plants(name, low_hz, high_hz):
    p = two_bodies(load_plant(name))
    low, high = natural_frequencies(p["m1_kg"], p["m2_kg"], p["k1_n_m"], p["k2_n_m"])
    assert (low, high) == (pytest.approx(low_hz, rel=5e-4), pytest.approx(high_hz, rel=5e-4))
    np.testing.assert_allclose([low, high], natural_frequencies_hz(load_plant(name)), rtol=1e-9)


@given(m1=positive, m2=positive, k1=positive, k2=positive)
def test_natural_frequencies_are_the_roots_of_the_determinant(m1, m2, k1, k2):
    low, high = (2 * np.pi * f for f in natural_frequencies(m1, m2, k1, k2))
    # Vieta, thesis eq. 3-17: sum and product of the squared roots
    assert low**2 + high**2 == pytest.approx((k1 + k2) / m1 + k2 / m2, rel=1e-12)
    assert low**2 * high**2 == pytest.approx(k1 / m1 * k2 / m2, rel=1e-12)
    found = eigvalsh([[k1 + k2, -k2], [-k2, k2]], np.diag([m1, m2]))
    assert high**2 == pytest.approx(found[1], rel=1e-9)
    # the absorber's own frequency and the clamped pair's lie between or at the two
    assert low <= np.sqrt(k2 / m2) * (1 + 1e-12)
    assert high >= np.sqrt(k2 / m2) * (1 - 1e-12)


def test_a_stiff_absorber_costs_the_low_frequency_no_digits():
    low, _ = natural_frequencies(10.0, 1.0, 1.0, 1e14)
    assert low == pytest.approx(np.sqrt(1.0 / 11.0) / (2 * np.pi), rel=1e-12)


@given(
    m1=positive, m2=positive, k1=positive, k2=positive,
    c1=st.floats(0.01, 100.0), c2=st.floats(0.01, 100.0), hz=st.floats(0.01, 100.0),
)  # fmt: skip
def test_absorber_response_is_the_solution_of_the_two_equations(m1, m2, k1, k2, c1, c2, hz):
    w = 2 * np.pi * hz
    dynamics = np.array(
        [
            [k1 + k2 - m1 * w**2 + 1j * w * (c1 + c2), -k2 - 1j * w * c2],
            [-k2 - 1j * w * c2, k2 - m2 * w**2 + 1j * w * c2],
        ]
    )
    x1, x2 = absorber_response(
        hz, m1_kg=m1, m2_kg=m2, k1_n_m=k1, k2_n_m=k2, c1_ns_m=c1, c2_ns_m=c2
    )  # fmt: skip
    force = dynamics @ [x1, x2]
    scale = np.abs(dynamics) @ np.abs([x1, x2])
    np.testing.assert_allclose(force, [1.0, 0.0], atol=1e-12 * scale.max())


@pytest.mark.parametrize("name", ["engine", "rig", "analogue_2dof"])
def test_absorber_response_against_python_control(name):
    p = two_bodies(load_plant(name))
    s = control.tf("s")
    link = p["c2_ns_m"] * s + p["k2_n_m"]
    one = p["m1_kg"] * s**2 + p["c1_ns_m"] * s + p["k1_n_m"]
    two = p["m2_kg"] * s**2 + link
    hz = np.linspace(1.0, 100.0, 67)
    oracle = (two / ((one + link) * two - link * link))(2j * np.pi * hz)
    np.testing.assert_allclose(absorber_response(hz, **p)[0], oracle, rtol=1e-9)


# --- dimensionless form, fixed points, Den Hartog ---------------------------------------------------------


@given(mu=ratio, f=st.floats(0.3, 2.0), zeta=st.floats(0.01, 2.0), g=st.floats(0.05, 3.0))
def test_normalised_amplitude_is_the_response_over_the_static_deflection(mu, f, zeta, g):
    m1, k1 = 3.0, 700.0
    w1 = np.sqrt(k1 / m1)
    x1, _ = absorber_response(
        g * w1 / (2 * np.pi), m1_kg=m1, k1_n_m=k1, m2_kg=mu * m1, k2_n_m=mu * m1 * (f * w1) ** 2,
        c2_ns_m=2 * zeta * mu * m1 * w1,
    )  # fmt: skip
    assert normalised_amplitude(g, f, mu, zeta) == pytest.approx(abs(x1) * k1, rel=1e-9)


@given(mu=ratio, f=st.floats(0.3, 2.0), zetas=st.lists(st.floats(0.0, 50.0), min_size=2, max_size=5))
def test_every_damping_passes_through_the_two_fixed_points(mu, f, zetas):
    p = fixed_points(f, mu)
    assert p.lower < p.upper
    for g, height in ((p.lower, p.lower_amplification), (p.upper, p.upper_amplification)):
        np.testing.assert_allclose(normalised_amplitude(g, f, mu, np.array(zetas)), height, rtol=1e-7)


@given(mu=ratio)
def test_den_hartogs_frequency_makes_the_fixed_points_equally_high(mu):
    best = den_hartog(mu)
    p = fixed_points(best.frequency_ratio, mu)
    assert p.lower_amplification == pytest.approx(p.upper_amplification, rel=1e-6)
    assert p.lower_amplification == pytest.approx(best.amplification, rel=1e-9)


def peak(f: float, zeta: float, mu: float) -> float:
    """Highest amplitude over frequency: a grid, then the exact top of its highest point."""
    g = np.linspace(0.2, 2.0, 4001)
    top = g[normalised_amplitude(g, f, mu, zeta).argmax()]
    found = minimize_scalar(
        lambda x: -float(normalised_amplitude(x, f, mu, zeta)), bounds=(top - 1e-3, top + 1e-3), method="bounded"
    )  # fmt: skip
    return -float(found.fun)


@pytest.mark.parametrize("mu", [0.02, 0.05, 0.2, 0.3])
def test_den_hartogs_absorber_is_within_a_thousandth_of_the_numerical_minimax(mu):
    best = den_hartog(mu)
    height = peak(float(best.frequency_ratio), float(best.damping_ratio), mu)
    found = minimize(
        lambda p: peak(p[0], p[1], mu), [0.9 * best.frequency_ratio, 1.3 * best.damping_ratio],
        method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9},
    )  # fmt: skip
    assert found.fun <= height <= 1.0012 * found.fun
    assert best.frequency_ratio == pytest.approx(found.x[0], rel=5e-4)
    assert best.damping_ratio == pytest.approx(found.x[1], rel=0.015)
    # peaks stand on the fixed points, as the docstring says
    assert best.amplification <= height <= 1.005 * best.amplification


@pytest.mark.parametrize("mu", [0.05, 0.2])
def test_at_den_hartogs_tuning_the_two_peaks_are_nearly_equal(mu):
    best = den_hartog(mu)
    g = np.linspace(0.3, 1.6, 200_001)
    curve = normalised_amplitude(g, best.frequency_ratio, mu, best.damping_ratio)
    split = g < best.frequency_ratio
    assert curve[split].max() == pytest.approx(curve[~split].max(), rel=3e-3)


def test_undamped_absorber_stills_the_primary_at_its_own_frequency():
    assert normalised_amplitude(0.8, 0.8, 0.05, 0.0) == 0.0


# --- isolation and transmissibility -----------------------------------------------------------------------


@given(r=st.floats(0.01, 20.0), zeta=st.floats(0.01, 3.0))
def test_transmissibility_against_scipy(r, zeta):
    _, h = freqs([2 * zeta, 1.0], [1.0, 2 * zeta, 1.0], worN=[r])
    assert transmissibility(r, zeta) == pytest.approx(abs(h[0]), rel=1e-12)


@given(zeta=st.floats(0.0, 5.0))
def test_isolation_begins_at_the_square_root_of_two_for_every_damping(zeta):
    below, at, above = transmissibility(np.sqrt(2.0) * np.array([0.9, 1.0, 1.1]), zeta)
    assert at == pytest.approx(1.0, rel=1e-12)
    assert below >= 1.0 >= above


def test_absorber_transmissibility_is_the_ratio_of_the_two_motions():
    p = two_bodies(load_plant("engine"))
    hz = np.linspace(40.0, 80.0, 41)
    x1, x2 = absorber_response(hz, **p)
    got = absorber_transmissibility(hz, m2_kg=p["m2_kg"], c2_ns_m=p["c2_ns_m"], k2_n_m=p["k2_n_m"])
    np.testing.assert_allclose(got, x2 / x1, rtol=1e-9)
    # at resonance the 2.7 Ns/m found from this curve let through about 1031 times the table's motion
    assert np.abs(got).max() == pytest.approx(np.sqrt(8.862 * 874640) / 2.7, rel=1e-2)


# --- chains -----------------------------------------------------------------------------------------------


def equations(kind: str, m: np.ndarray, k: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """K and C written out row by row from thesis eq. 4-15 and 4-17."""
    n = len(m)
    K, C = np.zeros((n, n)), np.zeros((n, n))
    for target, values in ((K, k), (C, c)):
        for i in range(n):
            if kind == "series":
                target[i, i] = values[i] + (values[i + 1] if i + 1 < n else 0.0)
                if i:
                    target[i, i - 1] = target[i - 1, i] = -values[i]
            else:
                target[i, i] = values.sum() if i == 0 else values[i]
                if i:
                    target[i, 0] = target[0, i] = -values[i]
    return K, C


@settings(max_examples=40)
@given(
    values=st.lists(
        st.tuples(st.floats(0.1, 100.0), st.floats(1.0, 1e5), st.floats(0.1, 50.0)), min_size=1, max_size=6
    ),
    kind=st.sampled_from(["series", "parallel"]),
)  # fmt: skip
def test_chains_obey_the_equations_of_the_thesis(values, kind):
    m, k, c = np.array(values).T
    build = series_chain if kind == "series" else parallel_chain
    model = linear_model(build(list(m), list(k), list(c)))
    K, C = equations(kind, m, k, c)
    n = len(m)
    np.testing.assert_allclose(model.A[n:, :n], -K / m[:, None], rtol=1e-12)
    np.testing.assert_allclose(model.A[n:, n:], -C / m[:, None], rtol=1e-12)
    np.testing.assert_allclose(model.B[n:], np.diag(1 / m), rtol=1e-12)


def test_equal_links_have_the_chain_frequencies_of_the_textbook():
    # fixed at one end, free at the other: w_r = 2 sqrt(k/m) sin((2r-1) pi / (2 (2n+1)))
    n, m, k = 7, 2.0, 5000.0
    r = np.arange(1, n + 1)
    expected = 2 * np.sqrt(k / m) * np.sin((2 * r - 1) * np.pi / (2 * (2 * n + 1))) / (2 * np.pi)
    np.testing.assert_allclose(
        natural_frequencies_hz(series_chain([m] * n, [k] * n, [0.0] * n)), expected, rtol=1e-9
    )


def test_absorbers_side_by_side_each_still_the_primary_at_their_own_frequency():
    plant = parallel_chain([10.0, 1.0, 1.0], [1e4, 4e4, 9e4], [5.0, 0.0, 0.0])
    sensor = {"name": "x", "kind": "displacement", "of": "m1", "noise_density": 1.0}
    model = linear_model(Plant.model_validate(plant.model_dump() | {"sensor": [sensor]}))
    response = np.abs(model.response(np.array([200.0, 250.0, 300.0]) / (2 * np.pi))[:, 0, 0])
    assert response[0] < 1e-12 * response[1]
    assert response[2] < 1e-12 * response[1]


def test_one_body_is_the_plain_oscillator():
    assert series_chain([2.0], [50.0], [0.3]).body == parallel_chain([2.0], [50.0], [0.3]).body
    assert natural_frequencies_hz(series_chain([2.0], [50.0], [0.3])) == pytest.approx(5.0 / (2 * np.pi))


@pytest.mark.parametrize("lists", [([], [], []), ([1.0], [1.0, 2.0], [0.0]), ([-1.0], [1.0], [0.0])])
def test_lists_that_make_no_chain_are_refused(lists):
    for build in (series_chain, parallel_chain):
        with pytest.raises(ValueError, match=r"one of each per body|at least 1 item|greater than 0"):
            build(*lists)
