"""The electrical analogue against the mechanics it stands for, there and back."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plants import closed_loop, trees, with_velocities

from twin.plant.analogue import (
    Circuit,
    Feedback,
    circuit_of,
    circuit_toml,
    loop_currents,
    loop_impedance,
    plant_of,
    series_impedance,
)
from twin.plant.chains import parallel_chain, series_chain
from twin.plant.config import DampingTable
from twin.plant.errors import InputError
from twin.plant.files import load_plant, parse_toml
from twin.plant.linear import frequency_response, linear_model

HZ = np.geomspace(0.3, 90.0, 41)


def test_the_two_masses_of_the_thesis_become_the_circuit_of_its_table():
    circuit = circuit_of(load_plant("analogue_2dof"))
    primary, absorber = circuit.loop
    assert (primary.inductance_h, primary.resistance_ohm) == (40.0, 0.1)
    assert (absorber.inductance_h, absorber.resistance_ohm) == (4.0, 0.0)
    # Table 4-2 rounds k1 to 1579 N/m; its 633.257 uF are 1579.137 N/m, 1 Hz with 40 kg
    assert primary.capacitance_f == pytest.approx(633.257e-6, rel=0.5 / 1579)
    stiffness = 1.0 / 633.257e-6
    assert stiffness == pytest.approx(40.0 * (2 * np.pi) ** 2, rel=1e-6)
    assert absorber.capacitance_f == pytest.approx(2.533e-6, rel=1e-6)
    assert absorber.branch_with == "primary"
    assert primary.branch_with is None


@given(plant=trees())
def test_there_and_back_is_the_same_plant_to_the_last_bit(plant):
    circuit = circuit_of(plant)
    assert plant_of(circuit) == plant
    assert circuit_of(plant_of(circuit)) == circuit
    assert parse_toml(circuit_toml(circuit), Circuit, "text") == circuit


@settings(max_examples=60)
@given(plant=trees())
def test_loop_currents_are_body_velocities(plant):
    model = linear_model(with_velocities(plant))
    expected = model.response(HZ)
    got = loop_currents(circuit_of(plant), HZ)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max(initial=0.0))


@pytest.mark.parametrize("name", ["rig", "engine_vcm", "rig_no_vcm", "shaker_v721", "beam"])
def test_coils_driven_by_a_current_are_voltage_sources(name):
    plant = load_plant(name)
    coils = [a.name for a in plant.actuator if a.kind != "force"]
    expected = linear_model(with_velocities(plant), current_driven=coils).response(HZ)
    circuit = circuit_of(plant, current_driven=coils)
    np.testing.assert_allclose(loop_currents(circuit, HZ), expected, rtol=1e-9)
    back = with_velocities(plant_of(circuit))
    np.testing.assert_allclose(linear_model(back).response(HZ), expected, rtol=1e-12)


def test_coils_that_are_not_named_are_left_out():
    assert [s.name for s in circuit_of(load_plant("rig")).source] == []
    assert [s.name for s in circuit_of(load_plant("rig"), current_driven=["vcm"]).source] == ["vcm"]
    with pytest.raises(KeyError):
        circuit_of(load_plant("rig"), current_driven=["no_such"])


def test_damping_against_frequency_needs_a_frequency():
    table = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(14.0, 8.0))
    plant = load_plant("rig").with_damping("absorber", table)
    with pytest.raises(ValueError, match="say at which frequency"):
        circuit_of(plant)
    assert circuit_of(plant, frequency_hz=50.0).loop[1].resistance_ohm == pytest.approx(11.0)


# --- impedance --------------------------------------------------------------------------------------------


def test_one_loop_is_the_series_impedance_of_the_thesis():
    # thesis eq. 4-13 and 4-14: the same number whether the elements are called R, L, C or c, m, k
    w = 2 * np.pi * HZ
    circuit = circuit_of(series_chain([2.0], [50.0], [0.3]))
    np.testing.assert_allclose(
        loop_impedance(circuit, HZ)[:, 0, 0], 0.3 + 1j * (2.0 * w - 50.0 / w), rtol=1e-12
    )
    np.testing.assert_allclose(
        series_impedance(HZ, inductance_h=2.0, resistance_ohm=0.3, elastance_1_f=50.0),
        loop_impedance(circuit, HZ)[:, 0, 0], rtol=1e-12,
    )  # fmt: skip


@pytest.mark.parametrize("build", [series_chain, parallel_chain])
def test_chains_have_the_loop_equations_of_the_thesis(build):
    m, k, c = [3.0, 2.0, 1.0], [900.0, 700.0, 500.0], [1.0, 2.0, 3.0]
    z = [series_impedance(7.0, resistance_ohm=ci, elastance_1_f=ki) for ci, ki in zip(c, k, strict=True)]
    inductors = [series_impedance(7.0, inductance_h=mi) for mi in m]
    if build is series_chain:  # thesis eq. 4-18, with R_i between loops i-1 and i
        shared = [[z[0] + z[1], -z[1], 0], [-z[1], z[1] + z[2], -z[2]], [0, -z[2], z[2]]]
    else:  # thesis eq. 4-16
        shared = [[sum(z), -z[1], -z[2]], [-z[1], z[1], 0], [-z[2], 0, z[2]]]
    got = loop_impedance(circuit_of(build(m, k, c)), 7.0)[0]
    np.testing.assert_allclose(got, np.diag(inductors) + np.array(shared), rtol=1e-12)


@given(plant=trees(), hz=st.floats(0.1, 100.0))
def test_a_passive_circuit_takes_power_at_every_frequency(plant, hz):
    Z = loop_impedance(circuit_of(plant), hz)[0]
    np.testing.assert_allclose(Z, Z.T)
    assert np.linalg.eigvalsh(Z.real).min() >= -1e-9 * np.abs(Z.real).max()


def test_impedance_peaks_where_the_circuit_of_the_thesis_resonates():
    circuit = circuit_of(load_plant("analogue_2dof"))
    for low, high, expected in ((0.5, 2.0, 0.953), (40.0, 60.0, 52.44)):
        hz = np.linspace(low, high, 20_001)
        current = np.abs(loop_currents(circuit, hz)[:, 0, 0])
        assert hz[current.argmax()] == pytest.approx(expected, rel=5e-4)


# --- feedback ---------------------------------------------------------------------------------------------


@settings(max_examples=40)
@given(
    plant=trees(min_bodies=2), data=st.data(),
    alpha=st.floats(0.0, 5.0), beta=st.floats(0.0, 50.0), gamma=st.floats(0.0, 5e3),
)  # fmt: skip
def test_feedback_in_the_circuit_is_the_control_law_on_the_plant(plant, data, alpha, beta, gamma):
    names = data.draw(st.permutations([b.name for b in plant.body]))
    law = Feedback(name="law", first=names[0], second=names[1], alpha_h=alpha, beta_ohm=beta, gamma_1_f=gamma)
    A, B = closed_loop(plant, law)
    n = len(plant.body)
    velocities = np.eye(2 * n)[n:]
    expected = frequency_response(A, B, velocities, np.zeros((n, B.shape[1])), HZ)
    circuit = circuit_of(plant).with_feedback(law)
    np.testing.assert_allclose(
        loop_currents(circuit, HZ), expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max(initial=0.0)
    )


def test_relative_acceleration_feedback_turns_unstable_at_the_reduced_mass():
    # thesis 6.2.3: alpha > -m1 m2/(m1 + m2); its short form alpha > -m2 holds for a heavy primary only
    plant = load_plant("engine_vcm")
    m1, m2 = (b.mass_kg for b in plant.body)
    bound = -m1 * m2 / (m1 + m2)
    assert bound > -m2
    for alpha, is_stable in ((0.999 * bound, True), (1.001 * bound, False), (0.999 * -m2, False)):
        A, _ = closed_loop(plant, Feedback(name="law", first="case", second="absorber", alpha_h=alpha))
        assert (np.linalg.eigvals(A).real.max() < 0.0) == is_stable


def test_a_plant_holds_no_controller():
    law = Feedback(name="law", first="primary", second="absorber", beta_ohm=1.0)
    circuit = circuit_of(load_plant("analogue_2dof")).with_feedback(law)
    with pytest.raises(ValueError, match=r"has feedback \(law\)"):
        plant_of(circuit)


# --- circuits as files ------------------------------------------------------------------------------------

GOOD = """
name = "two"

[[loop]]
name = "one"
inductance_h = 40.0
resistance_ohm = 0.1
capacitance_f = 633.257e-6

[[loop]]
name = "two"
inductance_h = 4.0
resistance_ohm = 0.0
capacitance_f = 2.533e-6
branch_with = "one"

[[source]]
name = "v"
on = "one"

[[feedback]]
name = "law"
first = "one"
second = "two"
gamma_1_f = -100.0
"""


def test_a_circuit_is_a_file_with_capacitances():
    circuit = parse_toml(GOOD, Circuit, "two.toml")
    assert circuit.loop[1].capacitance_f == pytest.approx(2.533e-6, rel=1e-15)
    assert parse_toml(circuit_toml(circuit), Circuit, "again") == circuit
    assert tomllib.loads(circuit_toml(circuit))["feedback"][0]["gamma_1_f"] == -100.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('branch_with = "one"', 'branch_with = "three"', "names no loop"),
        ('capacitance_f = 633.257e-6', 'capacitance_f = 633.257e-6\nbranch_with = "two"', "runs in a loop"),
        ('first = "one"', 'first = "three"', "names no loop"),
        ('second = "two"', 'second = "one"', "are the same loop"),
        ('name = "law"', 'name = "v"', "two things are called 'v'"),
        ('name = "v"', 'name = "two"', "two things are called 'two'"),
        ("capacitance_f = 2.533e-6", "capacitance_f = 0.0", "finite number of F above 0"),
        ("capacitance_f = 2.533e-6", "capacitance_f = true", "finite number of F above 0"),
        ("capacitance_f = 2.533e-6", "capacitance_f = 1e-6\nelastance_1_f = 1e6", "not both"),
        ("capacitance_f = 2.533e-6", "", "elastance_1_f: missing"),
        ("inductance_h = 4.0", "inductance_h = -4.0", "must be greater than 0"),
        ('on = "one"', 'on = "one"\ncommand = "A"', "needs volts_per_unit"),
        ('on = "one"', 'on = "three"', "names no loop"),
    ],
)  # fmt: skip
def test_a_circuit_that_hangs_in_the_air_is_refused(old, new, message):
    assert old in GOOD
    with pytest.raises(InputError, match=message):
        parse_toml(GOOD.replace(old, new, 1), Circuit, "two.toml")


def test_feedback_of_a_loop_that_is_not_there_is_refused():
    law = Feedback(name="law", first="primary", second="absorbr", beta_ohm=1.0)
    with pytest.raises(ValueError, match="'absorbr' names no loop"):
        circuit_of(load_plant("analogue_2dof")).with_feedback(law)
