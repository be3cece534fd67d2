"""The projection of gains by quadratic program, and the exact steps of the gain search."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from tuned import FACTS, RATE_HZ, RIG, TEST_3, VOLTS, Array

from tuning.active_set import solve_step
from tuning.gains import GainProgram
from tuning.loop import RigModel, margin_grid
from tuning.steady import steady_paths
from twin.control.schedule import Gains
from twin.plant.errors import RunError
from twin.plant.linear import natural_frequencies_hz


def question(
    hz: float, volts: float = VOLTS
) -> tuple[NDArray[np.complex128], complex, NDArray[np.complex128], Array]:
    """Fit, target and loop of one frequency, for the unlimited wish."""
    gains = TEST_3.at(hz)
    model = RigModel(RIG, FACTS, hz)
    response = model.response(hz)[0]
    paths = steady_paths(model, hz, volts)
    wish = -paths.motion[1] / paths.motion[0]
    acceleration = response[2, 0] * wish + response[2, 1] * volts
    grid = margin_grid(RATE_HZ, natural_frequencies_hz(RIG), 60)
    fit = model.paths(hz, gains.low_pass_hz, gains.high_pass_hz)[0] * acceleration
    return fit, wish, model.loop_terms(grid, gains.low_pass_hz, gains.high_pass_hz), grid


SCALE = np.array([0.4125, 0.4125 * 314.2, 40714.0])
BOUNDS = np.array([[-0.5, 1.0], [-1.0, 1.0], [-0.8, 2.0]]) * SCALE[:, None]


@pytest.mark.parametrize("hz", [46.0, 50.0, 54.0])
def test_without_a_margin_the_gains_reach_the_wish_exactly(hz: float) -> None:
    fit, wish, terms, _ = question(hz)
    gains = GainProgram(SCALE, BOUNDS).solve(fit, wish, terms, 0.0, np.zeros(3))
    assert abs(fit @ gains - wish) / abs(wish) < 2e-3


@pytest.mark.parametrize("hz", [46.0, 50.0, 53.0, 55.0])
@pytest.mark.parametrize("margin", [0.1, 0.3, 0.5])
def test_with_a_margin_the_gains_keep_it_and_brute_force_finds_little_better(
    hz: float, margin: float
) -> None:
    fit, wish, terms, _ = question(hz)
    gains = GainProgram(SCALE, BOUNDS).solve(fit, wish, terms, margin, np.zeros(3))
    assert np.min(np.abs(1.0 + terms @ gains)) >= margin - 0.01
    assert np.all(gains >= BOUNDS[:, 0] - 1e-3 * SCALE)
    assert np.all(gains <= BOUNDS[:, 1] + 1e-3 * SCALE)

    def miss(y: Array) -> float:
        return float(abs(fit @ (y * SCALE) - wish) / abs(wish))

    best = math.inf
    for seed in range(6):
        start = gains / SCALE if seed == 0 else 0.2 * np.random.default_rng(seed).standard_normal(3)
        found = minimize(
            lambda y: miss(y) ** 2, start, method="SLSQP", bounds=BOUNDS / SCALE[:, None],
            constraints={"type": "ineq", "fun": lambda y: np.abs(1.0 + terms @ (y * SCALE)) ** 2 - margin**2},
            options={"maxiter": 300, "ftol": 1e-10},
        )  # fmt: skip
        y = found.x
        stays = np.min(np.abs(1.0 + terms @ (y * SCALE))) >= margin - 1e-4
        # Gains on the far side of -1 keep the distance too, but encircle it.
        if stays and RigModel(RIG, FACTS, hz).decay_rate_1_s(_gains(y * SCALE, hz)) < 0.0:
            best = min(best, miss(y))
    assert miss(gains / SCALE) <= best + 0.05


def _gains(numbers: Array, hz: float) -> Gains:
    return replace(
        TEST_3.at(hz), alpha_kg=float(numbers[0]), beta_ns_m=float(numbers[1]), gamma_n_m=float(numbers[2])
    )


def test_answer_does_not_depend_on_what_was_asked_before() -> None:
    first, second = question(47.0), question(53.0)
    program = GainProgram(SCALE, BOUNDS)
    a = program.solve(first[0], first[1], first[2], 0.3, np.zeros(3))
    b = program.solve(second[0], second[1], second[2], 0.3, np.zeros(3))
    again = program.solve(first[0], first[1], first[2], 0.3, np.zeros(3))
    assert a.tobytes() == again.tobytes()
    assert a.tobytes() != b.tobytes()
    fresh = GainProgram(SCALE, BOUNDS).solve(second[0], second[1], second[2], 0.3, np.zeros(3))
    assert b.tobytes() == fresh.tobytes()


def test_nothing_wished_for_needs_no_gains() -> None:
    fit, _, terms, _ = question(50.0)
    assert not GainProgram(SCALE, BOUNDS).solve(fit, 0.0, terms, 0.3, np.zeros(3)).any()


def test_margin_that_no_gains_can_keep_is_said() -> None:
    fit, wish, terms, _ = question(50.0)
    with pytest.raises(RunError, match="no gains keep the margin"):
        GainProgram(SCALE, BOUNDS).solve(fit, wish, terms, 5.0, np.zeros(3))


@pytest.mark.parametrize("seed", range(12))
def test_step_is_the_minimum_that_its_multipliers_prove(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3))
    hessian, gradient = root @ root.T + 1e-3 * np.eye(3), 3.0 * rng.standard_normal(3)
    rows, upper = rng.standard_normal((1500, 3)), rng.uniform(0.05, 1.0, 1500)
    if seed % 2:  # neighbours on a grid are nearly parallel
        angle = np.linspace(0.0, 1.0, 1500)
        rows = np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.cos(3.0 * angle)])
    found = solve_step(hessian, gradient, rows, upper)
    assert found is not None
    assert np.max(rows @ found.step - upper) < 1e-8
    assert np.all(found.multipliers >= 0.0)
    pull = hessian @ found.step + gradient + rows[found.rows].T @ found.multipliers
    np.testing.assert_allclose(
        pull, 0.0, atol=1e-8 * (1.0 + np.abs(gradient).max() + found.multipliers.sum())
    )
    np.testing.assert_allclose(rows[found.rows] @ found.step, upper[found.rows], atol=1e-8)


def test_step_between_rows_that_leave_no_room_is_none() -> None:
    rows = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert solve_step(np.eye(3), np.ones(3), rows, np.array([-1.0, -1.0])) is None
