"""The linear model against oracles that share no code with it, and against energy."""

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import lsim

from twin.plant.config import Actuator, Body, DampingTable, ForceActuator, Plant, Sensor, Shaker, VoiceCoil
from twin.plant.discrete import Hold, discretise
from twin.plant.files import load_plant, preset_names
from twin.plant.linear import LinearModel, frequency_response, linear_model, natural_frequencies_hz

Array = NDArray[np.float64]
SWEEP_HZ = np.linspace(0.5, 120.0, 200)


def pick(
    model: LinearModel, response: NDArray[np.complex128], output: str, source: str
) -> NDArray[np.complex128]:
    return np.asarray(response[:, model.outputs.index(output), model.inputs.index(source)])


def without_current_loop(plant: Plant) -> Plant:
    """The plant with its coils driven by a plain voltage; zero volt is a shorted coil."""
    actuators: tuple[Actuator, ...] = tuple(
        a.model_copy(update={"current_loop_kp_v_a": None}) if isinstance(a, VoiceCoil) else a
        for a in plant.actuator
    )
    return plant.model_copy(update={"actuator": actuators})


# --- figures of the thesis's engine -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("hz", "case_um"), [(45.0, 142.27), (47.0, 97.65), (50.0, 1.109), (53.0, 296.5), (55.0, 6859.5)]
)
def test_passive_engine_case_is_quiet_at_its_tuned_frequency_only(hz: float, case_um: float) -> None:
    model = linear_model(load_plant("engine"))
    motion = pick(model, model.response(hz), "case_displacement", "excitation")
    assert abs(motion[0]) * 1000.0 * 1e6 == pytest.approx(case_um, rel=5e-4)


def test_undamped_absorber_takes_the_whole_force_with_its_spring() -> None:
    plant = load_plant("engine").with_damping("absorber", 0.0)
    model = linear_model(plant)
    response = model.response(50.0)
    stroke = pick(model, response, "case_displacement", "excitation") - pick(
        model, response, "absorber_displacement", "excitation"
    )
    assert abs(stroke[0]) * 1000.0 == pytest.approx(1.1433e-3, rel=1e-4)
    assert abs(stroke[0]) == pytest.approx(1.0 / plant.body[1].stiffness_n_m, rel=1e-3)


# --- oracles ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["engine", "engine_vcm", "engine_vcm_large", "rig", "rig_no_vcm", "analogue_2dof"]
)
def test_two_bodies_follow_the_transfer_functions_of_the_absorber(name: str) -> None:
    # thesis eq. 4-4, written out; a coil that carries no current leaves the mechanics alone
    plant = load_plant(name)
    push = ForceActuator(name="test_force", kind="force", on=plant.primary.name)
    sensors = tuple(
        Sensor(name=f"x_{b.name}", kind="displacement", of=b.name, noise_density=1.0) for b in plant.body
    )
    plant = plant.model_copy(update={"actuator": (push,), "sensor": sensors})
    (m1, c1, k1), (m2, c2, k2) = ((b.mass_kg, b.damping_at(None), b.stiffness_n_m) for b in plant.body)
    s = 2j * np.pi * SWEEP_HZ
    link = c2 * s + k2
    lower = (m1 * s**2 + c1 * s + k1 + link) * (m2 * s**2 + link) - link**2
    got = linear_model(plant).response(SWEEP_HZ)[:, :, 0]
    np.testing.assert_allclose(got[:, 0], (m2 * s**2 + link) / lower, rtol=1e-9)
    np.testing.assert_allclose(got[:, 1], link / lower, rtol=1e-9)


def test_two_natural_frequencies_follow_the_quadratic() -> None:
    # thesis eq. 3-17, 3-18
    for name in ("engine", "rig", "analogue_2dof"):
        a, b = load_plant(name).body
        middle = (a.stiffness_n_m + b.stiffness_n_m) / a.mass_kg + b.stiffness_n_m / b.mass_kg
        product = a.stiffness_n_m * b.stiffness_n_m / (a.mass_kg * b.mass_kg)
        squares = (middle + np.array([-1.0, 1.0]) * np.sqrt(middle**2 - 4.0 * product)) / 2.0
        np.testing.assert_allclose(
            natural_frequencies_hz(load_plant(name)), np.sqrt(squares) / (2 * np.pi), rtol=1e-9
        )


@pytest.mark.parametrize("name", preset_names())
def test_frequency_response_is_that_of_python_control(name: str) -> None:
    model = linear_model(load_plant(name))
    system = control.ss(model.A, model.B, model.C, model.D)
    theirs = np.moveaxis(system(2j * np.pi * SWEEP_HZ, squeeze=False), 2, 0)
    np.testing.assert_allclose(model.response(SWEEP_HZ), theirs, rtol=1e-7, atol=1e-14 * np.abs(theirs).max())


@pytest.mark.parametrize("hold", ["zoh", "foh"])
@pytest.mark.parametrize("name", ["rig", "engine_vcm"])
def test_stepped_response_is_that_of_python_control_and_scipy(name: str, hold: Hold) -> None:
    model = linear_model(load_plant(name))
    t = np.arange(0.0, 0.2, 2e-5)
    u = np.random.default_rng(4).normal(size=(len(t), len(model.inputs)))
    u[0] = 0.0
    steps, x, outputs = discretise(model, 50_000.0, [hold] * len(model.inputs)), np.zeros(len(model.A)), []
    for before, now in zip(np.vstack([u[:1], u[:-1]]), u, strict=True):
        x = steps.F @ x + steps.B0 @ before + steps.B1 @ now
        outputs.append(steps.C @ x + steps.D @ now)
    ours = np.array(outputs)
    scale = np.abs(ours).max(axis=0)
    _, by_scipy, _ = lsim((model.A, model.B, model.C, model.D), u, t, interp=hold == "foh")
    np.testing.assert_allclose(ours / scale, by_scipy / scale, atol=1e-9)
    system = control.ss(model.A, model.B, model.C, model.D)
    if hold == "foh":
        by_control = control.forced_response(system, t, u.T).outputs.T
    else:
        by_control = control.forced_response(control.sample_system(system, 2e-5), t, u.T).outputs.T
    np.testing.assert_allclose(ours / scale, by_control / scale, atol=1e-9)


bodies = st.integers(1, 7)
numbers = st.floats(0.0, 1.0)


@st.composite
def trees(draw: st.DrawFn) -> Plant:
    """A plant of one to seven bodies, each attached to the ground or to a body before or after it."""
    n = draw(bodies)
    order = draw(st.permutations(range(n)))
    made = []
    for rank, index in enumerate(order):
        parent = draw(st.integers(-1, rank - 1))
        made.append(
            Body(
                name=f"b{index}",
                mass_kg=0.1 * 10.0 ** (2.0 * draw(numbers)),
                attached_to="ground" if parent < 0 else f"b{order[parent]}",
                stiffness_n_m=1e3 * 10.0 ** (3.0 * draw(numbers)),
                damping_ns_m=20.0 * draw(numbers) + 0.1,
            )
        )
    made.sort(key=lambda b: b.name)  # a body may come before the one that carries it
    first, second = draw(st.integers(0, n - 1)), draw(st.integers(0, n - 1))
    actuators: tuple[Actuator, ...] = (
        ForceActuator(name="f", kind="force", on=f"b{first}", force_constant_n_v=3.0),
    )
    if first != second:
        actuators += (ForceActuator(name="g", kind="force", between=(f"b{first}", f"b{second}")),)
    sensors = [
        Sensor(name=f"{kind}_{b.name}", kind=kind, of=b.name, noise_density=1.0)
        for b in made
        for kind in ("displacement", "velocity", "acceleration")
    ]
    if first != second:
        sensors.append(
            Sensor(name="rel", kind="acceleration", of=(f"b{first}", f"b{second}"), noise_density=1.0)
        )
    return Plant(name="tree", body=tuple(made), actuator=actuators, sensor=tuple(sensors))


def brute_force(plant: Plant, hz: float, forces: dict[str, complex]) -> dict[str, complex]:
    """Displacements [m] by Newton's law for every body in turn, spring by spring."""
    s = 2j * np.pi * hz
    names = [b.name for b in plant.body]
    Z = np.zeros((len(names), len(names)), dtype=complex)
    for b in plant.body:
        i, z = names.index(b.name), b.stiffness_n_m + s * b.damping_at(None)
        Z[i, i] += s**2 * b.mass_kg + z
        if b.attached_to != "ground":
            j = names.index(b.attached_to)
            Z[j, j] += z
            Z[i, j] -= z
            Z[j, i] -= z
    x = np.linalg.solve(Z, [forces.get(name, 0.0) for name in names])
    return dict(zip(names, x, strict=True))


@settings(deadline=None)
@given(trees(), st.floats(0.5, 300.0))
def test_any_tree_of_bodies_moves_as_newton_says(plant: Plant, hz: float) -> None:
    model = linear_model(plant)
    response = model.response(hz)[0]
    s = 2j * np.pi * hz
    for column, actuator in enumerate(plant.actuator):
        constant = 3.0 if actuator.name == "f" else 1.0
        x = brute_force(plant, hz, {place: sign * constant for place, sign in actuator.pushes})
        expected = []
        for sensor in plant.sensor:
            motion = x[sensor.of] if isinstance(sensor.of, str) else x[sensor.of[0]] - x[sensor.of[1]]
            expected.append(motion * {"displacement": 1.0, "velocity": s, "acceleration": s**2}[sensor.kind])
        scale = max(map(abs, expected))
        np.testing.assert_allclose(response[:, column], expected, rtol=1e-6, atol=1e-8 * scale)


@settings(deadline=None)
@given(trees())
def test_natural_frequencies_are_where_the_undamped_tree_rings(plant: Plant) -> None:
    silent = linear_model(plant, damping_ns_m={b.name: 0.0 for b in plant.body})
    ringing = np.sort(np.abs(np.linalg.eigvals(silent.A).imag))[::2] / (2.0 * np.pi)
    np.testing.assert_allclose(natural_frequencies_hz(plant), ringing, rtol=1e-5)


@settings(deadline=None)
@given(trees())
def test_every_damped_tree_comes_to_rest(plant: Plant) -> None:
    assert np.linalg.eigvals(linear_model(plant).A).real.max() < 0.0


def test_slow_force_meets_the_springs_alone() -> None:
    plant = load_plant("engine")
    model = linear_model(plant)
    still = model.response(1e-6)[0]
    compliance = 1.0 / plant.primary.stiffness_n_m
    np.testing.assert_allclose(still[:2, 0], [compliance, compliance], rtol=1e-6)


# --- coils: energy and passivity --------------------------------------------------------------------------


@settings(deadline=None)
@given(st.sampled_from(["rig", "engine_vcm", "rig_no_vcm"]), st.integers(0, 2**32 - 1))
def test_power_into_each_coil_is_heat_field_and_work(name: str, seed: int) -> None:
    # v i = R i² + d/dt(L i²/2) + f (x2' - x1'), at every state and input
    plant = without_current_loop(load_plant(name))
    model = linear_model(plant)
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=len(model.A)), rng.normal(size=len(model.inputs))
    rate = model.A @ x + model.B @ u
    state = dict(zip(model.states, x, strict=True))
    for a in plant.actuator:
        if isinstance(a, ForceActuator):
            continue
        current, row = state[f"i_{a.name}"], model.states.index(f"i_{a.name}")
        speed = sum(sign * state[f"v_{place}"] for place, sign in a.pushes)
        assert a.resistance_ohm is not None
        assert a.inductance_h is not None
        heat, field = a.resistance_ohm * current**2, a.inductance_h * current * rate[row]
        work = a.force_constant_n_a * current * speed
        parts = [u[model.inputs.index(a.name)] * current, heat, field, work]
        assert parts[0] == pytest.approx(sum(parts[1:]), abs=1e-9 * max(map(abs, parts)))


@settings(deadline=None)
@given(st.sampled_from(["rig", "engine_vcm", "rig_no_vcm"]), st.integers(0, 2**32 - 1))
def test_stored_energy_grows_by_what_comes_in_less_heat(name: str, seed: int) -> None:
    plant = without_current_loop(load_plant(name))
    model = linear_model(plant)
    rng = np.random.default_rng(seed)
    x, u = rng.normal(size=len(model.A)), rng.normal(size=len(model.inputs))
    rate = model.A @ x + model.B @ u
    at = dict(zip(model.states, range(len(x)), strict=True))
    stored = came_in = heat = 0.0
    for b in plant.body:
        own, base = (at[f"x_{b.name}"], at[f"v_{b.name}"]), b.attached_to
        stretch = x[own[0]] - (0.0 if base == "ground" else x[at[f"x_{base}"]])
        speed = x[own[1]] - (0.0 if base == "ground" else x[at[f"v_{base}"]])
        stored += b.mass_kg * x[own[1]] * rate[own[1]] + b.stiffness_n_m * stretch * speed
        heat += b.damping_at(None) * speed**2
    for a in plant.actuator:
        value = u[model.inputs.index(a.name)]
        if isinstance(a, ForceActuator):
            came_in += value * sum(sign * x[at[f"v_{place}"]] for place, sign in a.pushes)
            continue
        i = at[f"i_{a.name}"]
        assert a.resistance_ohm is not None
        assert a.inductance_h is not None
        stored += a.inductance_h * x[i] * rate[i]
        heat += a.resistance_ohm * x[i] ** 2
        came_in += value * x[i]
    assert stored == pytest.approx(came_in - heat, abs=1e-9 * (abs(stored) + abs(came_in) + heat))


@pytest.mark.parametrize("name", ["rig", "rig_no_vcm", "engine_vcm", "engine_vcm_large"])
def test_shorted_coil_is_passive(name: str) -> None:
    model = linear_model(without_current_loop(load_plant(name)))
    assert np.linalg.eigvals(model.A).real.max() < 0.0
    # and so is its impedance: the real part of i/v is nowhere negative
    for a in model.inputs:
        if f"i_{a}" in model.states:
            row = np.eye(1, len(model.A), model.states.index(f"i_{a}"))
            column = model.B[:, [model.inputs.index(a)]]
            admittance = frequency_response(
                model.A, column, row, np.zeros((1, 1)), np.geomspace(0.1, 1e5, 400)
            )
            assert admittance.real.min() > 0.0


def test_shorting_the_coil_adds_damping_and_the_other_sign_would_make_it_swing_up() -> None:
    rig = without_current_loop(load_plant("rig"))
    open_coil, shorted = linear_model(rig, current_driven=("vcm",)), linear_model(rig)
    assert _slowest_near(shorted, 54.0) < 2.0 * _slowest_near(open_coil, 54.0) < 0.0
    wrong = shorted.A.copy()
    wrong[shorted.states.index("i_vcm"), 2:4] *= -1.0  # the back-EMF as the thesis prints it
    assert np.linalg.eigvals(wrong).real.max() > 0.0


def _slowest_near(model: LinearModel, hz: float) -> float:
    poles = np.linalg.eigvals(model.A)
    return float(poles[np.argmin(np.abs(np.abs(poles.imag) / (2 * np.pi) - hz))].real)


def test_slow_shorted_coil_is_a_damper_of_k_squared_over_r() -> None:
    # far below R/L the coil's force is -k²/R times the velocity across it
    coil = VoiceCoil(
        name="c",
        kind="voice_coil",
        between=("ground", "m"),
        resistance_ohm=2.0,
        inductance_h=1e-9,
        force_constant_n_a=8.0,
    )
    body = Body(name="m", mass_kg=1.0, attached_to="ground", stiffness_n_m=1e4, damping_ns_m=3.0)
    poles = np.linalg.eigvals(linear_model(Plant(name="p", body=(body,), actuator=(coil,))).A)
    assert max(poles.real) == pytest.approx(-(3.0 + 8.0**2 / 2.0) / 2.0, rel=1e-6)


def test_current_loop_makes_the_current_follow_its_reference() -> None:
    # v = kp (i_ref - i): i/i_ref = kp/(kp + R) when slow (thesis eq. 7-4)
    model = linear_model(load_plant("rig"))
    current = pick(model, model.response(1e-3), "vcm_current", "vcm")[0]
    assert current == pytest.approx(100.0 / 102.7, rel=1e-6)
    x, u = np.random.default_rng(2).normal(size=len(model.A)), np.array([0.7, 0.0])
    volts = (model.C @ x + model.D @ u)[model.outputs.index("vcm_voltage")]
    assert volts == pytest.approx(100.0 * (0.7 - x[model.states.index("i_vcm")]))


# --- what is measured and what is left out ---------------------------------------------------------------


def test_accelerometers_measure_the_rate_of_the_velocity() -> None:
    plant = load_plant("rig")
    model = linear_model(plant)
    for row, name in ((2, "table_acceleration"), (3, "absorber_acceleration")):
        output = model.outputs.index(name)
        np.testing.assert_array_equal(model.C[output], model.A[row])
        np.testing.assert_array_equal(model.D[output], model.B[row])


def test_sensor_between_two_bodies_measures_the_first_against_the_second() -> None:
    sensor = Sensor(name="gap", kind="velocity", of=("case", "absorber"), noise_density=1.0)
    model = linear_model(load_plant("engine").model_copy(update={"sensor": (sensor,)}))
    np.testing.assert_array_equal(model.C, [[0.0, 0.0, 1.0, -1.0]])


def test_current_as_input_leaves_the_circuit_out() -> None:
    model = linear_model(load_plant("engine_vcm"), current_driven=("vcm",))
    assert model.states == ("x_case", "x_absorber", "v_case", "v_absorber")
    np.testing.assert_allclose(model.B[2:, 0], [-22.2 / 45.53, 22.2 / 9.483])
    np.testing.assert_allclose(model.D[model.outputs.index("vcm_current")], [1.0, 0.0])


def test_current_as_input_leaves_the_shaker_its_circuit_and_drops_voltages_without_one() -> None:
    model = linear_model(load_plant("rig"), current_driven=("vcm",))
    assert model.states[-1] == "i_shaker"
    assert "i_vcm" not in model.states
    assert "vcm_voltage" not in model.outputs
    assert "shaker_voltage" in model.outputs
    np.testing.assert_array_equal(model.D[model.outputs.index("shaker_voltage")], [0.0, 1.0])


def test_open_coil_leaves_the_mechanics_alone() -> None:
    model = linear_model(load_plant("rig"), current_driven=("vcm", "shaker"))
    bare = load_plant("rig").model_copy(update={"actuator": (), "sensor": ()})
    np.testing.assert_array_equal(model.A, linear_model(bare).A)


def test_force_sensor_of_each_actuator_is_in_newton() -> None:
    plant = load_plant("rig")
    force = tuple(
        Sensor(name=f"f_{a.name}", kind="force", of=a.name, noise_density=1.0) for a in plant.actuator
    )
    push = ForceActuator(name="push", kind="force", on="table", force_constant_n_v=5.0)
    ideal = Shaker(name="ideal", kind="shaker", drive="current", on="table", force_constant_n_a=7.0)
    more = tuple(Sensor(name=f"f_{n}", kind="force", of=n, noise_density=1.0) for n in ("push", "ideal"))
    model = linear_model(
        plant.model_copy(update={"actuator": (*plant.actuator, push, ideal), "sensor": force + more})
    )
    at = {name: column for column, name in enumerate(model.states)}
    assert (model.C[0, at["i_vcm"]], model.C[1, at["i_shaker"]]) == (8.0, 11.1)
    np.testing.assert_array_equal(model.D[2:], [[0.0, 0.0, 5.0, 0.0], [0.0, 0.0, 0.0, 7.0]])


def test_shaker_driven_by_current_pushes_with_its_constant() -> None:
    # thesis eq. 5-3
    plant = load_plant("shaker_v721")
    model = linear_model(plant)
    s = 2j * np.pi * SWEEP_HZ
    expected = 159.0 * s**2 / (4.41 * s**2 + 170.0 * s + 31500.0)
    np.testing.assert_allclose(
        pick(model, model.response(SWEEP_HZ), "table_acceleration", "shaker"), expected
    )
    assert pick(model, model.response(10.0), "shaker_current", "shaker")[0] == 1.0


def test_positive_voltage_pulls_the_beam_to_negative_readings() -> None:
    model = linear_model(load_plant("beam"))
    still = pick(model, model.response(1e-4), "tip_displacement", "piezo")[0]
    assert still == pytest.approx(-1.876e-4 / 118.3, rel=1e-6)


def test_damping_is_read_at_the_frequency_or_replaced() -> None:
    table = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(14.0, 7.0))
    plant = load_plant("rig").with_damping("absorber", table)
    at_50, given_10_5 = (
        linear_model(plant, frequency_hz=50.0),
        linear_model(plant, damping_ns_m={"absorber": 10.5}),
    )
    np.testing.assert_array_equal(at_50.A, given_10_5.A)
    with pytest.raises(ValueError, match="say at which frequency"):
        linear_model(plant)
    assert natural_frequencies_hz(plant) == pytest.approx([11.09, 54.92], abs=0.01)


def test_names_that_are_not_in_the_plant_are_no_silent_no_op() -> None:
    with pytest.raises(KeyError):
        linear_model(load_plant("rig"), damping_ns_m={"absorbr": 1.0})
    with pytest.raises(KeyError):
        linear_model(load_plant("rig"), current_driven=("vmc",))


def test_arrays_of_a_model_cannot_be_written_to() -> None:
    model = linear_model(load_plant("rig"))
    for array in (model.A, model.B, model.C, model.D):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1.0


def test_plant_without_sensors_or_actuators_has_a_model_all_the_same() -> None:
    body = Body(name="m", mass_kg=1.0, attached_to="ground", stiffness_n_m=1.0, damping_ns_m=0.0)
    model = linear_model(Plant(name="p", body=(body,)))
    assert (model.A.shape, model.B.shape, model.C.shape, model.D.shape) == ((2, 2), (2, 0), (0, 2), (0, 0))
    assert model.response([1.0, 2.0]).shape == (2, 0, 0)
