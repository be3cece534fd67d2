"""Plants, laws and sweeps that several figures share, worked out once."""

from functools import cache

import numpy as np
from scipy.optimize import brentq

from estimators.excitation import ExcitationTracker, choose_reference
from tuning.loop import LoopFacts, RigModel
from twin.control.analysis import Controller, OperatingPoint, analyse_point, choose_law
from twin.control.continuous import Loop, build_loop
from twin.control.laws import Feedback
from twin.plant.blocks import make_block
from twin.plant.config import Body, Plant, VoiceCoil
from twin.plant.files import load_plant
from twin.plant.linear import Array
from twin.rig.simulated import SimulatedRig
from twin.rig.tests_of_chapter_7 import DRIVE_V, TestName, plant_of, programme

BAND_HZ = tuple(float(f) for f in range(45, 56))
GRID_HZ = tuple(float(f) for f in range(47, 54))


@cache
def preset(name: str) -> Plant:
    """Plant that ships with the program."""
    return load_plant(name)


def absorber_of(plant: Plant) -> Body:
    """The plant's absorber, which every plant of the thesis but the bare shaker has."""
    if plant.absorber is None:
        raise ValueError(f"plant '{plant.name}' has no absorber")
    return plant.absorber


def coil_of(plant: Plant) -> VoiceCoil:
    """The plant's voice coil."""
    if plant.voice_coil is None:
        raise ValueError(f"plant '{plant.name}' has no voice coil")
    return plant.voice_coil


def tuned_hz(plant: Plant) -> float:
    """Frequency of the passive absorber alone [Hz]."""
    absorber = absorber_of(plant)
    return float(np.sqrt(absorber.stiffness_n_m / absorber.mass_kg) / (2.0 * np.pi))


@cache
def point(
    plant: str, controller: Controller, frequency_hz: float, force_n: float, feedback: Feedback = "position"
) -> OperatingPoint:
    """Operating point of a preset with a force on its primary [N]."""
    subject = preset(plant)
    law = choose_law(subject, controller, frequency_hz, feedback)
    return analyse_point(subject, law, frequency_hz, excitation=force_n)


def mechanical(plant: Plant) -> Plant:
    """The plant's bodies alone: whatever acts on them is then an ideal force."""
    return plant.model_copy(update={"actuator": (), "sensor": (), "limits": {}})


@cache
def force_loop(plant: str, frequency_hz: float, feedback: Feedback = "position") -> Loop:
    """Gain scheduling with an ideal force on a preset's bodies; ``rig_55_hz`` is the rig of Test 2."""
    subject = mechanical(plant_of("test2") if plant == "rig_55_hz" else preset(plant))
    law = choose_law(subject, "gain_scheduling", frequency_hz, feedback)
    return build_loop(subject, law, frequency_hz=frequency_hz)


@cache
def lq_loop(frequency_hz: float = 50.0) -> Loop:
    """The engine under the state feedback of Table 6-2."""
    engine = preset("engine")
    return build_loop(engine, choose_law(engine, "lq", frequency_hz), frequency_hz=frequency_hz)


@cache
def steady_test(
    test: TestName, frequency_hz: float, damping_ns_m: float | None = None, beta_ns_m: float | None = None
) -> tuple[float, float, float, float]:
    """Steady state of a test of chapter 7 at one frequency: table, passive table [m], current [A], decay [1/s].

    Exact for the sampled rig: converter's hold, discrete filters, a sample of delay.

    Parameters
    ----------
    damping_ns_m, beta_ns_m
        In place of the thesis's c2(f) and of the test's own gain.
    """
    run = programme(test)
    facts = LoopFacts(run.sample_rate_hz, run.loop_delay_samples, run.measurement == "relative")
    damping = run.true_damping.at(frequency_hz) if damping_ns_m is None else damping_ns_m
    model = RigModel(run.plant, facts, frequency_hz, damping)
    gains = run.schedule.at(frequency_hz)
    response = model.response(frequency_hz)[0]
    beta = gains.beta_ns_m if beta_ns_m is None else beta_ns_m
    paths = model.paths(frequency_hz, gains.low_pass_hz, gains.high_pass_hz)[0]
    law = paths @ np.array([gains.alpha_kg, beta, gains.gamma_n_m])
    asked = law * response[2, 1] / (1.0 - law * response[2, 0]) * DRIVE_V
    table = response[0, 1] * DRIVE_V + response[0, 0] * asked
    current = response[3, 1] * DRIVE_V + response[3, 0] * asked
    return abs(table), abs(response[0, 1]) * DRIVE_V, abs(current), model.decay_rate_1_s(gains)


def attenuation(test: TestName, frequency_hz: float) -> float:
    """Share of the table's motion that is gone, against the passive rig tuned at 50 Hz, in steady state."""
    return 1.0 - steady_test(test, frequency_hz)[0] / steady_test("test1", frequency_hz)[1]


def mean_attenuation(test: TestName, from_hz: float = 45.0, to_hz: float = 55.0) -> float:
    """Mean of `attenuation` in steps of half a hertz, ends included."""
    return float(np.mean([attenuation(test, float(f)) for f in np.arange(from_hz, to_hz + 0.01, 0.5)]))


@cache
def quiet_beta(frequency_hz: float, damping_ns_m: float = 7.0) -> float:
    """Velocity gain, its sign turned, that makes the table quietest in Test 2 with constant coil damping [Ns/m].

    What the thesis turned by hand to find c2(f) (7.9.2).
    """

    def slope(beta: float) -> float:
        step = 0.01
        return (
            steady_test("test2", frequency_hz, damping_ns_m, -beta - step)[0]
            - steady_test("test2", frequency_hz, damping_ns_m, -beta + step)[0]
        )

    return float(brentq(slope, 0.0, 40.0, xtol=1e-4))


@cache
def sweep(test: TestName, controlled: bool = True) -> Array:
    """A test's minute on the simulated rig, block by block.

    Returns
    -------
    ndarray
        (600, 6): excitation [Hz], table acceleration at the excitation [m/s²], peak
        current reference [A], peak coil current [A], peak coil voltage [V], mean Joule power [W].
    """
    run = programme(test, controlled=controlled)
    rig = SimulatedRig(run)
    names = tuple(c.name for c in rig.channels)
    tracker = ExcitationTracker(choose_reference(run.plant, names) or "", names)
    column = {name: names.index(name) for name in ("vcm", "vcm_current", "vcm_voltage", "table_acceleration")}
    resistance = coil_of(run.plant).resistance_ohm
    rows = []
    while not rig.finished:
        first = rig.next_sample
        middle = rig.frequency_at(first + run.block_samples // 2)
        values, _, _ = rig.next_block()
        phasors = tracker.advance(make_block(first, run.sample_rate_hz, values, rig.channels))
        at_excitation = np.nan if phasors is None else abs(phasors.amplitude[column["table_acceleration"]])
        size = np.abs(values).max(axis=0)
        heat = resistance * float(np.mean(values[:, column["vcm_current"]].astype(np.float64) ** 2))
        rows.append(
            (
                middle,
                at_excitation,
                float(size[column["vcm"]]),
                float(size[column["vcm_current"]]),
                float(size[column["vcm_voltage"]]),
                heat,
            )
        )
    return np.array(rows)
