"""What the tuner's tests share: the rig with the thesis's damping, and its simulation in steady state."""

import numpy as np
from numpy.typing import NDArray

from tuning.loop import LoopFacts
from tuning.rule import scheduling_rule
from twin.control.schedule import Gains, GainSchedule
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.rig.programme import Programme, Sweep
from twin.rig.simulated import SimulatedRig

Array = NDArray[np.float64]
RATE_HZ = 50_000.0
FACTS = LoopFacts(RATE_HZ, 1)
VOLTS = 4.0
GRID_HZ = tuple(np.linspace(45.0, 55.0, 21).tolist())
THESIS_DAMPING = DampingTable(
    frequency_hz=GRID_HZ, ns_m=tuple(9.58 * f - 0.103 * f**2 - 208.0 for f in GRID_HZ)
)
RIG = load_plant("rig").with_damping("absorber", THESIS_DAMPING)
TEST_3 = scheduling_rule(RIG, GRID_HZ)


def unlimited(plant: Plant) -> Plant:
    """Without sensor noise to speak of, and with limits that nothing reaches."""
    sensors = tuple(s.model_copy(update={"noise_density": 1e-14, "range": None}) for s in plant.sensor)
    limits = {"vcm_current_a": 1e6, "vcm_power_w": 1e12, "stroke_m": 1e3}
    return plant.model_copy(update={"sensor": sensors, "limits": limits})


def constant(gains: Gains, hz: float) -> GainSchedule:
    return GainSchedule(
        frequency_hz=(hz,),
        alpha_kg=(gains.alpha_kg,),
        beta_ns_m=(gains.beta_ns_m,),
        gamma_n_m=(gains.gamma_n_m,),
        low_pass_hz=(gains.low_pass_hz,),
        high_pass_hz=(gains.high_pass_hz,),
        on_from_hz=hz,
        on_to_hz=hz,
    )


def simulate(
    plant: Plant, gains: Gains, hz: float, duration_s: float, volts: float
) -> tuple[Array, SimulatedRig]:
    damping = plant.body[1].damping_at(hz)
    rig = SimulatedRig(
        Programme(
            plant=plant,
            true_damping=DampingTable(frequency_hz=(hz, hz + 1.0), ns_m=(damping, damping)),
            sweep=Sweep(from_hz=hz, to_hz=hz, duration_s=duration_s, amplitude_v=volts),
            schedule=constant(gains, hz),
            disturbance_density_n=0.0,
        )
    )
    blocks = []
    while not rig.finished:
        blocks.append(rig.next_block()[0])
    return np.concatenate(blocks).astype(np.float64), rig


def phasors(y: Array, hz: float) -> NDArray[np.complex128]:
    n = 50_000
    t = (np.arange(len(y)) / RATE_HZ)[-n:]
    return np.asarray(2.0 * np.mean(y[-n:] * np.exp(-2j * np.pi * hz * t)[:, None], axis=0))
