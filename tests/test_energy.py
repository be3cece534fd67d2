"""The energy balance: closes whatever drives the plant, agrees with integrated powers, and knows what is passive."""

import math
import time
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from tests.plants import trees
from twin.control.continuous import build_loop
from twin.control.laws import scheduled_law
from twin.plant.config import Body, DampingTable, Plant, Shaker, VoiceCoil
from twin.plant.discrete import Hold, discretise, simulate_block
from twin.plant.energy import EnergyBalance, EnergyMeter
from twin.plant.files import load_plant
from twin.plant.linear import read_only
from twin.rig.excitation import Step, Steps
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import programme

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
CLOSES = 1e-12
"""Largest residual against the energy that flowed; what is asked of it is 1e-9."""


def run(meter: EnergyMeter, rate_hz: float, holds: list[Hold], u: Array, start: Array | None = None) -> Array:
    """States at the samples of ``u``, from ``start`` at the first."""
    d = discretise(meter.model, rate_hz, holds)
    n = len(meter.model.states)
    states = np.empty((len(u), n))
    states[0] = np.zeros(n) if start is None else start
    x = states[0].copy()
    C, D = read_only(np.eye(n)), read_only(np.zeros((n, u.shape[1])))
    simulate_block(d.F, d.B0, d.B1, C, D, x, u[0].copy(), u[1:].copy(), states[1:])
    return states


def plain_voltage(plant: Plant) -> Plant:
    """The plant with its coils driven by a plain voltage; zero volt is a shorted coil."""
    return plant.model_copy(
        update={
            "actuator": tuple(
                a.model_copy(update={"current_loop_kp_v_a": None}) if isinstance(a, VoiceCoil) else a
                for a in plant.actuator
            )
        }
    )


def measured(rig: SimulatedRig) -> list[EnergyBalance]:
    """Balances of a simulated rig's run, one for each stretch in which its plant stayed the same."""
    out = []
    while not rig.finished:
        rig.next_block()
        for truth in rig.truth:
            meter = EnergyMeter(
                rig.programme.true_plant,
                rig.programme.sample_rate_hz,
                truth.holds,
                frequency_hz=truth.frequency_hz,
            )
            out.append(meter.measure(truth.states, truth.inputs))
    return out


# --- the balance closes -------------------------------------------------------------------------------------


def test_energy_of_a_weight_let_go_ends_as_heat_in_its_damper() -> None:
    # One body: e^(-d t) (cos wd t + d/wd sin wd t) x0, and what is stored is known at every instant.
    mass, stiffness, damping, x0 = 2.0, 800.0, 3.0, 0.01
    plant = Plant(
        name="weight",
        body=(
            Body(name="w", mass_kg=mass, attached_to="ground", stiffness_n_m=stiffness, damping_ns_m=damping),
        ),
    )
    meter = EnergyMeter(plant, 100.0, [])
    u = np.zeros((3_001, 0))
    states = run(meter, 100.0, [], u, np.array([x0, 0.0]))
    balance = meter.measure(states, u)
    t = np.arange(3_001) / 100.0
    d = damping / (2.0 * mass)
    wd = math.sqrt(stiffness / mass - d * d)
    x = x0 * np.exp(-d * t) * (np.cos(wd * t) + d / wd * np.sin(wd * t))
    v = -x0 * np.exp(-d * t) * (stiffness / mass / wd) * np.sin(wd * t)
    left = 0.5 * stiffness * x**2 + 0.5 * mass * v**2
    first = 0.5 * stiffness * x0**2
    np.testing.assert_allclose(balance.stored_j.sum(axis=1), left, atol=1e-12 * first)
    np.testing.assert_allclose(np.cumsum(balance.dissipated_j[:, 0]), first - left[1:], atol=1e-12 * first)
    assert balance.dissipated_j.sum() == pytest.approx(first, rel=1e-12)
    assert (balance.stores, balance.losses, balance.sources) == (("mass_w", "spring_w"), ("damper_w",), ())


@pytest.mark.parametrize("kind", ["open coil", "shorted coil", "current loop"])
@pytest.mark.parametrize("name", ["rig", "engine_vcm", "engine_vcm_large"])
def test_balance_closes_for_any_circuit_of_the_coil(name: str, kind: str) -> None:
    plant = load_plant(name)
    if kind == "shorted coil":
        plant = plain_voltage(plant)
    options = {"current_driven": ["vcm"]} if kind == "open coil" else {}
    holds: list[Hold] = ["zoh", "foh"]
    meter = EnergyMeter(plant, RATE_HZ, holds, **options)
    t = np.arange(50_000) / RATE_HZ
    u = np.zeros((len(t), 2))
    u[:, 1] = (4.0 if name == "rig" else 1000.0) * np.sin(2.0 * np.pi * (45.0 + 5.0 * t) * t)
    if kind == "current loop":
        u[:, 0] = np.random.default_rng(1).normal(size=len(t))
    balance = meter.measure(run(meter, RATE_HZ, holds, u), u)
    assert balance.flow_j > 0.01
    assert balance.closure < CLOSES
    assert np.all(balance.dissipated_j >= 0.0)
    if kind != "current loop":
        assert not balance.supplied_j[:, 0].any()  # a coil without voltage or current takes and gives nothing
    if kind == "shorted coil":
        # ... but shorted it heats up
        assert balance.dissipated_j[:, balance.losses.index("resistance_vcm")].sum() > 1e-3 * balance.flow_j


@pytest.mark.parametrize("test", ["test1", "test3"])
def test_controlled_rig_creates_no_energy(test: str) -> None:
    # Control goes on and off with the band, and Test 1 ends in its clamp.
    run_ = programme(test, seconds=3.0, sweep_hz=(44.0, 57.0)).model_copy(
        update={"disturbance_density_n": 0.0}
    )
    balances = measured(SimulatedRig(run_, keep_truth=True))
    flow = sum(b.flow_j for b in balances)
    missing = sum(float(b.residual_j[-1]) for b in balances)
    assert abs(missing) < CLOSES * flow
    assert all(b.closure < CLOSES for b in balances)
    # The stretches hang together: what one leaves stored the next begins with.
    for before, after in pairwise(balances):
        assert before.stored_j[-1].tobytes() == after.stored_j[0].tobytes()
    by_coil = np.array([b.supplied_j[:, b.sources.index("vcm")].sum() for b in balances])
    assert np.max(np.abs(by_coil)) > 0.01


def test_grid_steps_under_control_close_too() -> None:
    base = programme("test3", seconds=1.0)
    steps = Steps(
        steps=tuple(
            Step(frequency_hz=hz, duration_s=s) for hz, s in ((47.0, 0.35), (50.0, 0.33), (53.0, 0.35))
        ),
        amplitude_v=4.0,
    )
    rig = SimulatedRig(
        base.model_copy(update={"sweep": steps, "disturbance_density_n": 0.0}), keep_truth=True
    )
    balances = measured(rig)
    assert len(balances) == 12  # ten blocks, two of them with a jump inside
    assert all(b.closure < CLOSES for b in balances)


def test_ten_seconds_at_50_kilosamples_take_about_a_second() -> None:
    meter = EnergyMeter(load_plant("rig"), RATE_HZ, ["zoh", "foh"])
    n = 500_001
    u = np.random.default_rng(0).normal(size=(n, 2))
    states = run(meter, RATE_HZ, ["zoh", "foh"], u)
    began = time.perf_counter()
    balance = meter.measure(states, u)
    closure = balance.closure
    assert time.perf_counter() - began < 5.0  # 0.2 s on a quiet machine
    assert closure < CLOSES


# --- every element by itself ------------------------------------------------------------------------------


def test_each_element_takes_what_an_adaptive_integrator_says() -> None:
    plant = load_plant("rig")
    rate = 5_000.0
    holds: list[Hold] = ["zoh", "foh"]
    meter = EnergyMeter(plant, rate, holds)
    rng = np.random.default_rng(4)
    u = rng.normal(size=(40, 2))
    states = run(meter, rate, holds, u)
    balance = meter.measure(states, u)
    table, absorber = plant.body
    vcm, shaker = plant.actuator
    assert isinstance(vcm, VoiceCoil)
    assert isinstance(shaker, Shaker)
    assert meter.model.states == ("x_table", "x_absorber", "v_table", "v_absorber", "i_vcm", "i_shaker")
    assert balance.losses == ("damper_table", "damper_absorber", "resistance_vcm", "resistance_shaker")
    assert balance.sources == ("vcm", "shaker")
    expected = np.zeros((39, 6))
    for k in range(39):

        def powers(t: float, w: Array, k: int = k) -> Array:
            x1, x2, v1, v2, i, j = w[:6]
            volt = u[k, 1] + (u[k + 1, 1] - u[k, 1]) * t * rate
            vcm_volt = 100.0 * (u[k, 0] - i)
            spring, rub = 40714.0 * (x2 - x1), 7.0 * (v2 - v1)
            return np.array([
                v1, v2,
                (-12300.0 * x1 - 5.0 * v1 + spring + rub - 8.0 * i + 11.1 * j) / 2.1,
                (-spring - rub + 8.0 * i) / 0.4125,
                (vcm_volt - 2.7 * i - 8.0 * (v2 - v1)) / 1.3e-3,
                (volt - 1.2 * j - 11.1 * v1) / 1.8e-3,
                5.0 * v1**2, 7.0 * (v2 - v1) ** 2, 2.7 * i**2, 1.2 * j**2, vcm_volt * i, volt * j,
            ])  # fmt: skip

        begin = np.concatenate([states[k], np.zeros(6)])
        end = solve_ivp(powers, (0.0, 1.0 / rate), begin, method="DOP853", rtol=1e-12, atol=1e-16).y[:, -1]
        np.testing.assert_allclose(end[:6], states[k + 1], rtol=1e-9, atol=1e-13)
        expected[k] = end[6:]
    got = np.hstack([balance.dissipated_j, balance.supplied_j])
    for column in range(6):
        size = np.abs(expected[:, column]).max()
        np.testing.assert_allclose(got[:, column], expected[:, column], rtol=1e-9, atol=1e-10 * size)
    x, v = states[:, :2], states[:, 2:4]
    kept = dict(zip(balance.stores, balance.stored_j.T, strict=True))
    np.testing.assert_allclose(kept["mass_table"], 0.5 * table.mass_kg * v[:, 0] ** 2, rtol=1e-12)
    np.testing.assert_allclose(kept["spring_table"], 0.5 * table.stiffness_n_m * x[:, 0] ** 2, rtol=1e-12)
    stretch = x[:, 1] - x[:, 0]
    np.testing.assert_allclose(kept["spring_absorber"], 0.5 * absorber.stiffness_n_m * stretch**2, rtol=1e-12)
    np.testing.assert_allclose(kept["inductance_vcm"], 0.5 * vcm.inductance_h * states[:, 4] ** 2, rtol=1e-12)


def test_engine_under_the_scheduling_rule_draws_50_watts_and_heats_its_coil_with_them() -> None:
    # thesis Table 8-2 at 47 Hz, 1000 N: 50.06 W electrical, R I_peak²/2 = 50.11 W Joule
    plant, hz, rate = load_plant("engine_vcm"), 47.0, 47_000.0
    absorber = plant.absorber
    assert absorber is not None
    loop = build_loop(plant, scheduled_law(absorber, hz), frequency_hz=hz)
    current, voltage = loop.steady(hz, 0.0, 1000.0)[3:]
    holds: list[Hold] = ["foh", "foh"]
    meter = EnergyMeter(plant, rate, holds)
    phasors = np.array([current + voltage / 200.0, 1000.0])  # v = kp (i_ref - i)
    s = 2j * np.pi * hz
    start = np.linalg.solve(s * np.eye(5) - meter.model.A, meter.model.B @ phasors)
    turn = np.exp(s * np.arange(1001) / rate)  # one period
    u = np.real(turn[:, None] * phasors)
    balance = meter.measure(run(meter, rate, holds, u, start.real), u)
    by = {
        name: float(e.sum()) * hz
        for name, e in (
            *zip(balance.losses, balance.dissipated_j.T, strict=True),
            *zip(balance.sources, balance.supplied_j.T, strict=True),
        )
    }
    assert by["vcm"] == pytest.approx(50.06, abs=0.005)
    assert by["resistance_vcm"] == pytest.approx(100.23 / 2.0, abs=0.005)
    assert by["vcm"] + by["excitation"] == pytest.approx(
        by["resistance_vcm"] + by["damper_case"] + by["damper_absorber"], rel=1e-5
    )
    assert balance.closure < CLOSES


# --- any plant ----------------------------------------------------------------------------------------------


@st.composite
def wired(draw: st.DrawFn) -> Plant:
    """Bodies on bodies, pushed by forces, currents and a coil with a circuit."""
    plant = draw(trees())
    places = draw(st.permutations([*(b.name for b in plant.body[1:]), "ground"]))
    coil = VoiceCoil(
        name="coil",
        kind="voice_coil",
        between=(plant.body[0].name, places[0]) if places[0] != "ground" else ("ground", plant.body[0].name),
        force_constant_n_a=draw(st.floats(0.1, 50.0)),
        resistance_ohm=draw(st.floats(0.1, 100.0)),
        inductance_h=draw(st.floats(1e-4, 0.1)),
        current_loop_kp_v_a=draw(st.none() | st.floats(1.0, 300.0)),
    )
    return plant.model_copy(update={"actuator": (*plant.actuator, coil)})


@settings(deadline=None, max_examples=60)
@given(
    plant=wired(),
    rate=st.sampled_from([100.0, 2_000.0, 50_000.0]),
    joined=st.booleans(),
    seed=st.integers(0, 100),
)
def test_no_plant_loses_or_creates_energy(plant: Plant, rate: float, joined: bool, seed: int) -> None:
    holds: list[Hold] = ["foh" if joined == (j % 2 == 0) else "zoh" for j in range(len(plant.actuator))]
    meter = EnergyMeter(plant, rate, holds)
    u = np.random.default_rng(seed).normal(size=(300, len(holds)))
    balance = meter.measure(run(meter, rate, holds, u), u)
    assert balance.closure < 1e-9
    assert np.all(balance.dissipated_j >= -1e-14 * balance.flow_j)
    assert np.all(balance.stored_j >= 0.0)


@settings(deadline=None, max_examples=60)
@given(plant=wired(), rate=st.sampled_from([100.0, 50_000.0]), seed=st.integers(0, 100))
def test_left_to_itself_every_plant_only_loses_energy(plant: Plant, rate: float, seed: int) -> None:
    plant = plain_voltage(plant)  # no current loop: zero volt is a shorted coil
    holds: list[Hold] = ["zoh"] * len(plant.actuator)
    meter = EnergyMeter(plant, rate, holds)
    u = np.zeros((300, len(holds)))
    start = np.random.default_rng(seed).normal(size=len(meter.model.states))
    balance = meter.measure(run(meter, rate, holds, u, start), u)
    stored = balance.stored_j.sum(axis=1)
    assert np.all(np.diff(stored) <= 1e-12 * stored[0])
    assert stored[-1] < stored[0]
    assert not balance.supplied_j.any()
    assert balance.closure < 1e-9


# --- what is refused ------------------------------------------------------------------------------------------


def test_states_and_inputs_must_pair_up() -> None:
    meter = EnergyMeter(load_plant("rig"), RATE_HZ, ["zoh", "foh"])
    with pytest.raises(ValueError, match="got 3 and 4"):
        meter.measure(np.zeros((3, 6)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="at least 2"):
        meter.measure(np.zeros((1, 6)), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="2 inputs need 2 holds, got 1"):
        EnergyMeter(load_plant("rig"), RATE_HZ, ["zoh"])
    still = meter.measure(np.zeros((3, 6)), np.zeros((3, 2)))
    assert still.closure == 0.0


def test_damping_against_frequency_is_read_where_it_is_said() -> None:
    table = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(1.0, 21.0))
    plant = load_plant("rig").with_damping("absorber", table)
    u = np.zeros((3, 2))
    states = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0], (3, 1))
    holds: list[Hold] = ["zoh", "zoh"]
    lost = [
        EnergyMeter(plant, 1e6, holds, **options).measure(states, u).dissipated_j[0, 1]
        for options in ({"frequency_hz": 50.0}, {"damping_ns_m": {"absorber": 22.0}})
    ]
    assert lost[1] / lost[0] == pytest.approx(2.0, rel=1e-4)
    with pytest.raises(ValueError, match="at which frequency"):
        EnergyMeter(plant, 1e6, holds)


def test_run_with_its_truth_kept_has_the_same_bits() -> None:
    run_ = programme("test3", seconds=0.5, sweep_hz=(47.0, 50.0), seed=2)
    plain, kept = SimulatedRig(run_), SimulatedRig(run_, keep_truth=True)
    while not plain.finished:
        assert plain.next_block()[0].tobytes() == kept.next_block()[0].tobytes()
        assert plain.truth == []
        (truth,) = kept.truth
        assert truth.states.shape == (run_.block_samples + 1, 6)
