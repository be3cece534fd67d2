"""Which recorded channel drives an actuator, and what stands in where a sample of it is missing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from twin.plant.blocks import Block, Channel, make_block
from twin.plant.config import DampingTable, ForceActuator, Plant, Sensor
from twin.plant.discrete import simulate_block
from twin.plant.files import load_plant
from twin.plant.inputs import DampedModels, DriveReader, InputSource, choose_inputs, driven_model
from twin.plant.modal import modal_model
from twin.plant.parallel import ParallelPlant

RATE_HZ = 50_000.0
ALL = (
    "table_acceleration", "absorber_acceleration", "vcm_current", "vcm_voltage",
    "shaker_current", "shaker_voltage", "vcm", "shaker",
)  # fmt: skip


@pytest.fixture(scope="module")
def rig() -> Plant:
    return load_plant("rig")


def sources_of(plant: Plant, *channels: str) -> dict[str, InputSource]:
    return {s.actuator: s for s in choose_inputs(plant, channels)}


def test_a_recorded_command_comes_before_any_measurement_because_the_rig_holds_it(rig: Plant) -> None:
    chosen = sources_of(rig, *ALL)
    assert chosen["vcm"] == InputSource("vcm", "vcm", "zoh")
    assert chosen["shaker"] == InputSource("shaker", "shaker", "zoh")


def test_shaker_without_command_is_driven_by_its_voltage_joined_between_samples(rig: Plant) -> None:
    shaker = sources_of(rig, *ALL[:-2])["shaker"]
    assert (shaker.channel, shaker.hold, shaker.by_current) == ("shaker_voltage", "foh", False)
    assert shaker.noise_density == 1e-5


def test_shaker_with_neither_command_nor_voltage_is_driven_by_its_current(rig: Plant) -> None:
    shaker = sources_of(rig, "table_acceleration", "shaker_current")["shaker"]
    assert (shaker.channel, shaker.hold, shaker.by_current) == ("shaker_current", "foh", True)


def test_coil_behind_a_current_loop_takes_its_current_before_its_jumping_voltage(rig: Plant) -> None:
    vcm = sources_of(rig, "table_acceleration", "vcm_voltage", "vcm_current")["vcm"]
    assert (vcm.channel, vcm.by_current) == ("vcm_current", True)
    assert sources_of(rig, "table_acceleration", "vcm_voltage")["vcm"].channel is None


def test_what_nothing_recorded_tells_is_left_at_zero(rig: Plant) -> None:
    assert sources_of(rig, "table_acceleration")["shaker"] == InputSource("shaker", None, "zoh")


def test_ideal_force_is_driven_by_its_force_sensor() -> None:
    engine = load_plant("engine")
    force = Sensor(name="push", kind="force", of="excitation", noise_density=0.1)
    plant = Plant.model_validate(engine.model_copy(update={"sensor": (*engine.sensor, force)}).model_dump())
    source = sources_of(plant, "case_displacement", "push")["excitation"]
    assert (source.channel, source.hold, source.noise_density) == ("push", "foh", 0.1)


def test_force_commanded_in_volt_is_not_driven_by_newtons() -> None:
    engine = load_plant("engine")
    piezo = ForceActuator(name="excitation", kind="force", on="case", force_constant_n_v=2.0)
    force = Sensor(name="push", kind="force", of="excitation", noise_density=0.1)
    plant = engine.model_copy(update={"actuator": (piezo,), "sensor": (*engine.sensor, force)})
    assert sources_of(plant, "push")["excitation"].channel is None


def test_a_current_as_input_takes_the_coils_circuit_out_of_the_model(rig: Plant) -> None:
    sources = choose_inputs(rig, ("shaker_voltage", "vcm_current"))
    model, discrete = driven_model(rig, sources, RATE_HZ, 50.0)
    assert "i_vcm" not in model.states
    assert "i_shaker" in model.states
    assert discrete.B1.any(axis=0).all()  # both measured, both joined


# --- reading ----------------------------------------------------------------------------------------------


def block_of(first: int, values: NDArray[np.float64], names: tuple[str, ...]) -> Block:
    return make_block(first, RATE_HZ, values, tuple(Channel(n, "V") for n in names))


def test_a_gap_in_a_drive_repeats_its_last_valid_sample_and_across_blocks_too() -> None:
    reader = DriveReader([InputSource("shaker", "v", "foh"), InputSource("vcm", None, "zoh")], ("a", "v"))
    nan = np.nan
    first = reader.gather(block_of(0, np.array([[9.0, nan], [9.0, 1.0], [nan, nan], [9.0, 3.0]]), ("a", "v")))
    np.testing.assert_array_equal(first, [[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [3.0, 0.0]])
    second = reader.gather(block_of(4, np.array([[9.0, nan], [9.0, nan]]), ("a", "v")))
    np.testing.assert_array_equal(second[:, 0], [3.0, 3.0])
    third = reader.gather(block_of(6, np.array([[9.0, nan], [9.0, 5.0]]), ("a", "v")))
    np.testing.assert_array_equal(third[:, 0], [3.0, 5.0])


@settings(deadline=None, max_examples=60)
@given(
    samples=st.lists(st.one_of(st.none(), st.floats(-10.0, 10.0)), min_size=1, max_size=40),
    cuts=st.lists(st.integers(0, 40), max_size=4),
)
def test_what_drives_the_model_is_the_latest_valid_sample_however_blocks_are_cut(
    samples: list[float | None], cuts: list[int]
) -> None:
    expected, latest = [], 0.0
    for sample in samples:
        latest = latest if sample is None else sample
        expected.append(latest)
    values = np.array([[np.nan if s is None else s] for s in samples])
    reader, got, first = DriveReader([InputSource("shaker", "v", "zoh")], ("v",)), [], 0
    for piece in np.split(values, sorted(c for c in cuts if c < len(values))):
        got.append(reader.gather(block_of(first, piece, ("v",)))[:, 0])
        first += len(piece)
    np.testing.assert_array_equal(np.concatenate(got), expected)


def test_plant_in_parallel_settles_to_the_response_of_its_recorded_drive(rig: Plant) -> None:
    names = ("shaker_voltage", "vcm_current")
    sources = choose_inputs(rig, names)
    model, discrete = driven_model(rig, sources, RATE_HZ, 50.0)
    parallel = ParallelPlant(DriveReader(sources, names), model, discrete)
    t = np.arange(200_000) / RATE_HZ
    values = np.stack([4.0 * np.sin(2 * np.pi * 47.0 * t), 0.3 * np.cos(2 * np.pi * 47.0 * t)], axis=1)
    y = np.concatenate(
        [parallel.advance(block_of(k, values[k : k + 5000], names)) for k in range(0, len(t), 5000)]
    )
    per_input = model.response(47.0)[0]  # inputs in the plant's order: vcm, shaker
    phasor = per_input @ np.array([0.3, -4j])
    late = t > 3.0
    expected = (phasor[:, None] * np.exp(2j * np.pi * 47.0 * t[late])).real.T
    scale = np.abs(phasor)
    assert np.max(np.abs(y[late] - expected) / scale) < 1e-4


@pytest.mark.parametrize("preset", ["rig", "engine_vcm"])
def test_models_of_one_damping_after_another_are_those_worked_out_anew(preset: str) -> None:
    plant = load_plant(preset)
    assert plant.absorber is not None
    names = [s.name for s in plant.sensor] + [a.name for a in plant.actuator]
    sources = choose_inputs(plant, names)
    models = DampedModels(plant, sources, 50_000.0)
    for damping in (0.0, 2.7, 20.5):
        model, discrete = models.at(damping, 50.0)
        fresh = driven_model(plant.with_damping(plant.absorber.name, damping), sources, 50_000.0, 50.0)
        assert (model.states, model.inputs, model.outputs) == (
            fresh[0].states,
            fresh[0].inputs,
            fresh[0].outputs,
        )
        for found, wanted in ((model, fresh[0]), (discrete, fresh[1])):
            for key in ("A", "B", "C", "D") if found is model else ("F", "B0", "B1", "C", "D"):
                np.testing.assert_allclose(getattr(found, key), getattr(wanted, key), rtol=1e-13, atol=1e-12)


def test_models_follow_what_other_bodies_lose_at_another_frequency() -> None:
    rig = load_plant("rig")
    table = DampingTable(frequency_hz=(45.0, 55.0), ns_m=(5.0, 9.0))
    plant = rig.with_damping(rig.primary.name, table)
    sources = choose_inputs(plant, [s.name for s in plant.sensor])
    models = DampedModels(plant, sources, 50_000.0)
    assert plant.absorber is not None
    for frequency_hz in (45.0, 52.0):
        fresh, _ = driven_model(plant.with_damping(plant.absorber.name, 3.0), sources, 50_000.0, frequency_hz)
        np.testing.assert_allclose(models.at(3.0, frequency_hz)[0].A, fresh.A, rtol=1e-13)
    with pytest.raises(ValueError, match="no absorber"):
        DampedModels(load_plant("shaker_v721"), sources, 50_000.0)


@pytest.mark.parametrize("preset", ["rig", "engine_vcm"])
def test_plant_in_its_modes_is_the_plant_whatever_the_blocks_and_while_its_damping_moves(preset: str) -> None:
    plant = load_plant(preset)
    names = tuple(a.name for a in plant.actuator)
    sources = choose_inputs(plant, names)
    models = DampedModels(plant, sources, RATE_HZ)
    rng = np.random.default_rng(4)
    values = np.cumsum(rng.standard_normal((3000, len(names))), axis=0)
    wanted = [s.name for s in plant.sensor if s.kind in ("acceleration", "current")][::-1]
    model, discrete = models.at(7.0, 50.0)
    parallel = ParallelPlant(DriveReader(sources, names), model, discrete, wanted)
    rows = [model.outputs.index(name) for name in wanted]
    assert modal_model(discrete, discrete.C[rows], discrete.D[rows]) is not None
    x, before = np.zeros(len(model.states)), values[0].copy()
    for k, (first, end) in enumerate(((0, 1), (1, 120), (120, 1000), (1000, 1241), (1241, 3000))):
        model, discrete = models.at(7.0 + k, 50.0)
        parallel.set_model(discrete)
        expected = np.empty((end - first, len(rows)))
        d = discrete
        simulate_block(d.F, d.B0, d.B1, d.C[rows], d.D[rows], x, before, values[first:end], expected)
        found = parallel.advance(block_of(first, values[first:end], names))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10 * np.abs(expected).max())
