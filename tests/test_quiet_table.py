"""Thesis Test 2 with a coil whose damping is 7 Ns/m throughout: what a quiet table finds, and what is there.

The absorber is tuned at 55 Hz and the loop filtered at 200 Hz and 1 Hz. Turning beta until the table is quiet cancels
the coil's damping together with what the filters' phase makes of gamma; the force balance sees the coil alone.
"""

import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from estimators.damping import DampingLearner
from estimators.excitation import ExcitationTracker
from estimators.force_balance import AbsorberBalance
from tuning.loop import LoopFacts, RigModel
from tuning.retune import predict
from tuning.rule import scheduled_stiffness
from twin.control.schedule import Gains, GainSchedule
from twin.plant.blocks import make_block
from twin.plant.config import DampingTable, Plant
from twin.rig.programme import Programme, Tone
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import plant_of

RATE_HZ = 50_000.0
TRUE_NS_M = 7.0
CONSTANT = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(TRUE_NS_M, TRUE_NS_M))
QUIET = {45.0: 23.1, 47.5: 19.6, 50.0: 15.8, 52.5: 11.6, 55.0: 7.1}
"""Damping that a quiet table suggests [Ns/m], by frequency [Hz]: the model's, at rest at each."""

ON_RIG = (45.0, 50.0, 55.0)
OFFSETS_NS_M = (-2.0, -1.0, 1.0, 2.0)
SECONDS, SETTLED_S = 6.0, 4.5


class Run(NamedTuple):
    """The rig at one frequency and one beta, after it has settled."""

    table_m_s2: float
    damping_ns_m: np.ndarray
    std_ns_m: np.ndarray


@pytest.fixture(scope="module")
def plant() -> Plant:
    return plant_of("test2")


def gains_at(plant: Plant, hz: float, beta: float) -> Gains:
    assert plant.absorber is not None
    return Gains(0.0, beta, scheduled_stiffness(plant.absorber.mass_kg, 55.0, hz), 200.0, 1.0)


def run_at(plant: Plant, hz: float, beta: float, learner: DampingLearner | None = None) -> Run:
    gains = gains_at(plant, hz, beta)
    schedule = GainSchedule(
        frequency_hz=(hz,),
        alpha_kg=(0.0,),
        beta_ns_m=(beta,),
        gamma_n_m=(gains.gamma_n_m,),
        low_pass_hz=(200.0,),
        high_pass_hz=(1.0,),
        on_from_hz=hz,
        on_to_hz=hz,
    )
    programme = Programme(
        plant=plant,
        true_damping=CONSTANT,
        sweep=Tone(frequency_hz=hz, duration_s=SECONDS, amplitude_v=1.0),
        schedule=schedule,
        seed=round(10 * hz + beta),
    )
    rig = SimulatedRig(programme)
    names = tuple(c.name for c in rig.channels)
    tracker, balance = ExcitationTracker("shaker_voltage", names), AbsorberBalance(plant, names)
    table, found = [], []
    while not rig.finished:
        first = rig.next_sample
        values, on, _ = rig.next_block()
        assert on
        phasors = tracker.advance(make_block(first, RATE_HZ, values, rig.channels))
        assert phasors is not None
        solved = balance.solve(phasors)
        if learner is not None:
            learner.advance(solved, 0.1)
        if first >= SETTLED_S * RATE_HZ:
            table.append(complex(phasors.amplitude[names.index("table_acceleration")]))
            found.append((solved.damping_ns_m, solved.damping_std_ns_m))
    damping, std = np.array(found).T
    assert not rig.tripped
    return Run(float(np.sqrt(np.mean(np.abs(table) ** 2))), damping, std)


@pytest.fixture(scope="module")
def learner(plant: Plant) -> DampingLearner:
    return DampingLearner(plant)


@pytest.fixture(scope="module")
def runs(plant: Plant, learner: DampingLearner) -> dict[float, dict[float, Run]]:
    """Runs of the whole simulated rig by frequency and beta, around the beta that quiets the model's table."""
    return {
        hz: {-QUIET[hz] + d: run_at(plant, hz, -QUIET[hz] + d, learner) for d in OFFSETS_NS_M}
        for hz in ON_RIG
    }


@pytest.mark.parametrize("hz", QUIET)
def test_model_of_the_loop_says_which_beta_quiets_the_table(plant: Plant, hz: float) -> None:
    true = plant.with_damping("absorber", CONSTANT)
    model = RigModel(true, LoopFacts(RATE_HZ, 1), hz)

    def motion(beta: float) -> float:
        return predict(model, gains_at(plant, hz, -beta), hz, 4.0).displacement_m

    found = float(minimize_scalar(motion, bounds=(0.0, 40.0), method="bounded").x)
    assert found == pytest.approx(QUIET[hz], abs=0.3)


@pytest.mark.parametrize("hz", ON_RIG)
def test_quiet_table_of_the_simulated_rig_fakes_a_damping_that_falls_with_frequency(
    runs: dict[float, dict[float, Run]], hz: float
) -> None:
    # The table's motion is proportional to |beta - beta_quiet| and a rest: its square is a parabola in beta.
    beta = np.array(list(runs[hz]))
    square = np.array([run.table_m_s2**2 for run in runs[hz].values()])
    a, b, _ = np.polyfit(beta - beta.mean(), square, 2)
    quiet = -(beta.mean() - 0.5 * b / a)
    assert a > 0.0
    assert quiet == pytest.approx({45.0: 23.0, 50.0: 16.0, 55.0: 7.0}[hz], abs=0.7)


@pytest.mark.parametrize("hz", ON_RIG)
def test_force_balance_finds_the_coils_own_damping_in_the_same_data(
    runs: dict[float, dict[float, Run]], hz: float
) -> None:
    for run in runs[hz].values():
        assert np.mean(run.damping_ns_m) == pytest.approx(TRUE_NS_M, abs=0.15)
        assert np.all(np.abs(run.damping_ns_m - TRUE_NS_M) < 5.0 * run.std_ns_m + 0.1)


def test_learner_that_saw_all_of_it_has_7_everywhere(
    runs: dict[float, dict[float, Run]], learner: DampingLearner
) -> None:
    assert len(runs) == len(ON_RIG)
    curve = learner.curve()
    for hz in ON_RIG:
        at = int(np.argmin(np.abs(curve.frequency_hz - hz)))
        assert curve.damping_ns_m[at] == pytest.approx(TRUE_NS_M, abs=0.15)
        assert abs(curve.damping_ns_m[at] - TRUE_NS_M) < 3.0 * curve.std_ns_m[at]
    assert math.isfinite(curve.stiffness_n_m)
