"""Exported circuits in the real ngspice against the state space of the mechanics."""

import subprocess

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ngspice import run_deck
from numpy.typing import NDArray
from plants import closed_loop, trees, with_velocities
from scipy.integrate import solve_ivp

from twin.plant.analogue import Circuit, Feedback, circuit_of
from twin.plant.chains import parallel_chain, series_chain
from twin.plant.config import Plant
from twin.plant.files import load_plant
from twin.plant.linear import frequency_response, linear_model
from twin.plant.netlist import AcSweep, Transient, spice_deck

Array = NDArray[np.float64]


def coils(plant: Plant) -> list[str]:
    return [a.name for a in plant.actuator if a.kind != "force"]


@pytest.fixture
def spice(requires_debian, tmp_path):
    ngspice = requires_debian("ngspice")
    return lambda deck: run_deck(ngspice, deck, tmp_path)


def currents(found: dict[str, NDArray[np.complex128]], circuit: Circuit) -> NDArray[np.complex128]:
    return np.stack([found[f"i(vi_{loop.name.casefold()})"] for loop in circuit.loop], axis=1)


def assert_sweep_agrees(spice, circuit: Circuit, A: Array, B: Array, column: int) -> None:
    """Loop currents of the deck against velocities of ``x' = A x + B u``, each to 1e-6 of itself.

    Below 1e-9 of the largest, in the depth of an antiresonance, what is left of a difference is not compared.
    """
    source = circuit.source[column].name
    found = spice(spice_deck(circuit, AcSweep(source, 0.5, 80.0, 160)))
    n = len(circuit.loop)
    velocities = np.eye(len(A))[n : 2 * n]
    expected = frequency_response(A, B, velocities, np.zeros((n, B.shape[1])), found["frequency"].real)
    expected = expected[:, :, column]
    np.testing.assert_allclose(
        currents(found, circuit), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max()
    )


PLANTS = {
    name: load_plant(name) for name in ("analogue_2dof", "engine", "engine_vcm", "rig", "beam", "shaker_v721")
}
PLANTS["series"] = series_chain([5.0, 2.0, 1.0, 0.5], [9e3, 4e4, 2e4, 1e4], [20.0, 1.0, 2.0, 0.0])
PLANTS["parallel"] = parallel_chain([5.0, 0.5, 0.4, 0.3], [9e3, 4e4, 3e4, 2e4], [20.0, 0.0, 1.0, 0.5])


@pytest.mark.parametrize("name", PLANTS)
def test_loop_currents_in_spice_are_body_velocities(name, spice):
    plant = PLANTS[name]
    circuit = circuit_of(plant, current_driven=coils(plant))
    model = linear_model(plant, current_driven=coils(plant))
    for column in range(len(circuit.source)):
        assert_sweep_agrees(spice, circuit, model.A, model.B, column)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(plant=trees())
def test_any_tree_of_bodies_runs_in_spice(plant, spice):
    model = linear_model(with_velocities(plant))
    assert_sweep_agrees(spice, circuit_of(plant), model.A, model.B, 0)


LAWS = {
    "charge": {"gamma_1_f": 8.862 * (2 * np.pi) ** 2 * (53.0**2 - 50.0**2)},
    "rate of current": {"alpha_h": 8.862 * (50.0**2 / 53.0**2 - 1.0)},
    "current and charge": {"beta_ohm": -2.7, "gamma_1_f": 8.862 * (2 * np.pi) ** 2 * (47.0**2 - 50.0**2)},
    "current and rate of current": {"alpha_h": 8.862 * (50.0**2 / 47.0**2 - 1.0), "beta_ohm": 40.0},
    "all three": {"alpha_h": 0.7, "beta_ohm": 15.0, "gamma_1_f": -2e4},
}


def controlled(law: Feedback) -> tuple[Circuit, Array, Array]:
    plant = load_plant("engine")
    A, B = closed_loop(plant, law)
    return circuit_of(plant).with_feedback(law), A, B


@pytest.mark.parametrize("kind", LAWS)
def test_controlled_sources_of_the_appendix_are_the_control_law(kind, spice):
    # thesis 11.7 to 11.10
    law = Feedback(name="law", first="case", second="absorber", **LAWS[kind])
    circuit, A, B = controlled(law)
    assert_sweep_agrees(spice, circuit, A, B, 0)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    plant=trees(min_bodies=2), data=st.data(),
    alpha=st.floats(0.0, 5.0), beta=st.floats(0.0, 50.0), gamma=st.floats(0.0, 5e3),
)  # fmt: skip
def test_feedback_between_any_two_loops_runs_in_spice(plant, data, alpha, beta, gamma, spice):
    names = data.draw(st.permutations([b.name for b in plant.body]))
    law = Feedback(name="law", first=names[0], second=names[1], alpha_h=alpha, beta_ohm=beta, gamma_1_f=gamma)
    circuit = circuit_of(plant).with_feedback(law)
    assert_sweep_agrees(spice, circuit, *closed_loop(plant, law), 0)


def assert_transient_agrees(
    spice, circuit: Circuit, A: Array, B: Array, column: int, tolerance: float
) -> None:
    run = Transient(circuit.source[column].name, 1.0, 47.0, 0.4, 1e-5)
    found = spice(spice_deck(circuit, run))
    t = found["time"].real
    assert t[-1] == pytest.approx(0.4)

    def motion(time: float, x: Array) -> Array:
        return np.asarray(A @ x + B[:, column] * np.sin(2 * np.pi * 47.0 * time))

    oracle = solve_ivp(motion, (0.0, 0.4), np.zeros(len(A)), "DOP853", t[t <= 0.4], rtol=1e-10, atol=1e-16)
    n = len(circuit.loop)
    expected = oracle.y[n : 2 * n].T
    error = currents(found, circuit).real[: len(expected)] - expected
    assert np.abs(error).max(axis=0) == pytest.approx(0.0, abs=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("name", ["analogue_2dof", "rig", "series"])
def test_a_sine_from_rest_in_spice_is_the_motion_of_the_bodies(name, spice):
    plant = PLANTS[name]
    model = linear_model(plant, current_driven=coils(plant))
    circuit = circuit_of(plant, current_driven=coils(plant))
    assert_transient_agrees(spice, circuit, model.A, model.B, len(circuit.source) - 1, 1e-4)


@pytest.mark.parametrize("kind", LAWS)
def test_the_controlled_circuit_settles_as_the_closed_loop_does(kind, spice):
    law = Feedback(name="law", first="case", second="absorber", **LAWS[kind])
    assert_transient_agrees(spice, *controlled(law), 0, 1e-4)


def test_the_deck_prints_its_currents_without_a_raw_file(requires_debian, tmp_path):
    deck = tmp_path / "deck.cir"
    circuit = circuit_of(load_plant("analogue_2dof"))
    for analysis, head in (
        (AcSweep("excitation", 49.0, 51.0, 3), "AC Analysis"),
        (Transient("excitation", 1.0, 50.0, 0.01, 1e-3), "Transient Analysis"),
    ):
        deck.write_text(spice_deck(circuit, analysis), encoding="utf-8")
        done = subprocess.run(
            [requires_debian("ngspice"), "-b", deck], capture_output=True, text=True, check=True
        )
        assert "vi_primary#bran" in done.stdout
        assert head in done.stdout


# --- what needs no simulator ------------------------------------------------------------------------------


def elements(deck: str) -> dict[str, list[str]]:
    return {line.split()[0]: line.split()[1:] for line in deck.splitlines() if line[0] not in "*."}


def test_the_deck_of_the_thesis_example_has_the_elements_of_its_table():
    deck = spice_deck(circuit_of(load_plant("analogue_2dof")), AcSweep("excitation", 1.0, 100.0, 100))
    values = {
        name: float(parts[2]) for name, parts in elements(deck).items() if name[:2] in ("L_", "R_", "C_")
    }
    assert values == {
        "L_primary": 40.0,
        "R_primary": 0.1,
        "C_primary": pytest.approx(633.257e-6, rel=0.5 / 1579),
        "L_absorber": 4.0,  # a damper of zero is no resistor at all
        "C_absorber": pytest.approx(2.533e-6, rel=1e-6),
    }


def test_numpy_numbers_leave_no_trace_in_the_deck():
    run = Transient("excitation", np.float64(1.0), np.float64(50.0), np.float64(0.1), np.float64(1e-3))
    assert "np" not in spice_deck(circuit_of(load_plant("analogue_2dof")), run)


def test_names_that_only_case_tells_apart_are_refused():
    plant = series_chain([1.0, 1.0], [1.0, 1.0], [1.0, 1.0])
    upper = plant.body[1].model_copy(update={"name": "F1"})
    circuit = circuit_of(
        plant.model_copy(update={"body": (plant.body[0], upper), "actuator": plant.actuator[:1]})
    )
    with pytest.raises(ValueError, match="differ in case only"):
        spice_deck(circuit, AcSweep("f1", 1.0, 2.0, 9))


@pytest.mark.parametrize(
    ("analysis", "message"),
    [
        (AcSweep("nobody", 1.0, 2.0, 2), "names no source of the circuit; known: excitation"),
        (AcSweep("excitation", 0.0, 2.0, 9), "AC sweep needs"),
        (AcSweep("excitation", 3.0, 2.0, 9), "AC sweep needs"),
        (AcSweep("excitation", 1.0, float("inf"), 9), "AC sweep needs"),
        (AcSweep("excitation", 1.0, 2.0, 2), "AC sweep needs"),
        (Transient("excitation", 1.0, 50.0, 1.0, 0.0), "transient needs"),
        (Transient("excitation", 1.0, 50.0, 1.0, 2.0), "transient needs"),
        (Transient("excitation", 1.0, 0.0, 1.0, 0.1), "transient needs"),
        (Transient("excitation", float("nan"), 50.0, 1.0, 0.1), "transient needs"),
    ],
)
def test_an_analysis_that_cannot_be_run_is_refused(analysis, message):
    with pytest.raises(ValueError, match=message):
        spice_deck(circuit_of(load_plant("analogue_2dof")), analysis)
