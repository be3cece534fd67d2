"""Sensor noise through the loop: Lyapunov against SciPy, simulated samples and what the thesis says of remedies."""

import math

import control
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov

from twin.control.continuous import build_loop
from twin.control.delay import growth_rate_1_s
from twin.control.laws import Law, scheduled_law
from twin.control.lq import (
    bryson_weights,
    force_model,
    kalman_observer,
    lq_gain,
    lqg_controller,
    lqg_loop,
    placed_observer,
    table_6_2_weights,
)
from twin.control.margins import delay_margin_s
from twin.control.noise import (
    TABLE_6_3_VARIANCES,
    law_as_state_gain,
    noise_direct,
    noise_through_low_pass,
    noise_through_observer,
)
from twin.plant.files import load_plant

ENGINE = load_plant("engine")
MODEL = force_model(ENGINE)
RATE_HZ = 1e5
ALL = np.eye(4)


def scheduled(hz: float) -> np.ndarray:
    return law_as_state_gain(ENGINE, scheduled_law(ENGINE.absorber, hz))


def test_law_on_states_is_the_law_on_relative_motion():
    law = scheduled_law(ENGINE.absorber, 47.0)
    np.testing.assert_allclose(
        build_loop(ENGINE, law_as_state_gain(ENGINE, law)).closed_poles, build_loop(ENGINE, law).closed_poles
    )
    with pytest.raises(ValueError, match="acceleration is no state"):
        law_as_state_gain(ENGINE, Law(alpha_kg=1.0))


def test_stationary_deviations_are_those_of_scipy_and_of_simulated_samples():
    K = scheduled(47.0) + np.array([0.0, 0.0, -400.0, 400.0])  # damped, so that a short run is stationary
    rate_hz = 2000.0
    found = noise_direct(MODEL, K, TABLE_6_3_VARIANCES, rate_hz)
    block = np.zeros((8, 8))
    block[:4, :4], block[:4, 4:] = MODEL.A - np.outer(MODEL.b, K), -np.outer(MODEL.b, K)
    step = expm(block / rate_hz)
    F, G = step[:4, :4], step[:4, 4:]
    noise = np.diag(TABLE_6_3_VARIANCES)
    P = solve_discrete_lyapunov(F, G @ noise @ G.T)
    assert found.primary_std_m == pytest.approx(math.sqrt(P[0, 0]), rel=1e-6)
    assert found.force_std_n == pytest.approx(math.sqrt(K @ (P + noise) @ K), rel=1e-6)
    samples = np.random.default_rng(1).normal(size=(200_000, 4)) * np.sqrt(TABLE_6_3_VARIANCES)
    x, force, motion = np.zeros(4), [], []
    for n in samples:
        force.append(-K @ (x + n))
        motion.append(x[0])
        x = F @ x + G @ n
    assert np.std(force) == pytest.approx(found.force_std_n, rel=0.05)
    assert np.std(motion) == pytest.approx(found.primary_std_m, rel=0.1)


def test_observer_that_knows_the_noise_takes_nearly_all_of_it_out_of_the_force():
    K = scheduled(47.0)
    density = np.sqrt(2.0 * np.array(TABLE_6_3_VARIANCES) / RATE_HZ)
    direct = noise_direct(MODEL, K, TABLE_6_3_VARIANCES, RATE_HZ)
    L = kalman_observer(MODEL, ALL, 10.0, density)
    kalman = noise_through_observer(MODEL, K, L, ALL, TABLE_6_3_VARIANCES, RATE_HZ)
    L = placed_observer(MODEL, ALL, K)
    placed = noise_through_observer(MODEL, K, L, ALL, TABLE_6_3_VARIANCES, RATE_HZ)
    assert kalman.force_std_n < 0.02 * direct.force_std_n
    assert kalman.force_std_n < placed.force_std_n < 0.3 * direct.force_std_n


def test_low_pass_helps_below_the_tuned_frequency_and_destabilises_above():
    # thesis 6.9.5
    direct = noise_direct(MODEL, scheduled(47.0), TABLE_6_3_VARIANCES, RATE_HZ)
    below = noise_through_low_pass(MODEL, scheduled(47.0), 200.0, TABLE_6_3_VARIANCES, RATE_HZ)
    above = noise_through_low_pass(MODEL, scheduled(53.0), 200.0, TABLE_6_3_VARIANCES, RATE_HZ)
    assert below.stable
    assert below.force_std_n < 0.1 * direct.force_std_n
    assert not above.stable
    assert above.force_std_n == math.inf


def test_high_cutoff_is_no_filter():
    K = scheduled(47.0)
    direct = noise_direct(MODEL, K, TABLE_6_3_VARIANCES, 1000.0)
    wide = noise_through_low_pass(MODEL, K, 1e6, TABLE_6_3_VARIANCES, 1000.0)
    assert wide.primary_std_m == pytest.approx(direct.primary_std_m, rel=0.02)
    assert wide.force_std_n == pytest.approx(direct.force_std_n, rel=0.05)


def test_lq_of_table_6_2_makes_kilonewtons_of_noise():
    # the thesis finds it less sensitive than gain scheduling: those weights are not the ones behind its figures
    K = lq_gain(MODEL, *table_6_2_weights(2))
    assert noise_direct(MODEL, K, TABLE_6_3_VARIANCES, RATE_HZ).force_std_n > 1e5


# --- LQ and observers -------------------------------------------------------------------------------------


def test_riccati_equation_holds():
    Q, R = bryson_weights([2e-5, np.inf, 6e-3, np.inf]), bryson_weights(100.0)
    assert Q[0, 0] == pytest.approx(2.5e9)
    assert Q[1, 1] == 0.0
    K = lq_gain(MODEL, Q, R)
    A = MODEL.A - np.outer(MODEL.b, K)
    assert np.linalg.eigvals(A).real.max() < 0.0
    # the cost of K from any start does not fall when K is changed a little
    cost = _cost(K, Q, R)
    for k in range(4):
        for factor in (0.99, 1.01):
            other = K.copy()
            other[k] *= factor
            assert _cost(other, Q, R) >= cost * (1.0 - 1e-9)


def _cost(K, Q, R):
    from scipy.linalg import solve_continuous_lyapunov

    A = MODEL.A - np.outer(MODEL.b, K)
    return np.trace(
        solve_continuous_lyapunov(A.T, -(Q + R[0, 0] * np.outer(K, K))) @ np.diag([1, 1, 1e-4, 1e-4])
    )


def test_observer_has_the_controllers_poles_four_times_as_far_out_and_keeps_them_apart():
    K = lq_gain(MODEL, bryson_weights([2e-5, 1.0, 6e-3, 100.0]), bryson_weights(100.0))
    C = np.eye(2, 4)
    L = placed_observer(MODEL, C, K)
    wanted = 4.0 * np.linalg.eigvals(MODEL.A - np.outer(MODEL.b, K))
    got = np.linalg.eigvals(MODEL.A - L @ C)
    assert np.abs(got[:, None] - wanted).min(axis=1) == pytest.approx(0.0, abs=1e-5 * np.abs(wanted).max())
    controller = lqg_controller(MODEL, C, K, L)
    whole = np.block([[MODEL.A, np.outer(MODEL.b, controller.C)], [controller.B @ C, controller.A]])
    both = np.concatenate([wanted, wanted / 4.0])
    apart = np.abs(np.linalg.eigvals(whole)[:, None] - both).min(axis=1)
    assert np.all(apart < 1e-5 * np.abs(both).max())


def test_exact_delay_margin_of_lqg_puts_a_pole_pair_on_the_axis():
    K = lq_gain(MODEL, bryson_weights([2e-5, 1.0, 6e-3, 100.0]), bryson_weights(100.0))
    C = np.eye(2, 4)
    L = placed_observer(MODEL, C, K)
    loop = lqg_loop(ENGINE, C, K, L)
    # Separation: the closed loop has the regulator's poles and the observer's.
    apart = np.concatenate([
        np.linalg.eigvals(MODEL.A - np.outer(MODEL.b, K)), np.linalg.eigvals(MODEL.A - L @ C)
    ])  # fmt: skip
    nearest = np.abs(loop.closed_poles[:, None] - apart).min(axis=1)
    assert np.all(nearest < 1e-5 * np.abs(apart).max())
    # The loop gain is controller times plant, by python-control; the controller's own sign is that of f = -K x.
    s = 2j * math.pi * np.array([1.0, 20.0, 50.0, 55.0, 120.0])
    controller = lqg_controller(MODEL, C, K, L)
    plant = control.ss(MODEL.A, MODEL.b[:, None], C, np.zeros((2, 1)))
    expected = -np.array([(controller(point) @ plant(point)).item() for point in s])
    np.testing.assert_allclose(loop.gain(s), expected, rtol=1e-6)
    margin = delay_margin_s(loop)
    assert margin is not None
    assert margin > 0.0
    assert growth_rate_1_s(loop, 0.98 * margin) < 0.0 < growth_rate_1_s(loop, 1.02 * margin)


@pytest.mark.parametrize("largest", [[0.0], [-1.0], [np.nan]])
def test_bryson_refuses_what_is_no_size(largest):
    with pytest.raises(ValueError, match="Bryson"):
        bryson_weights(largest)
