"""Tests 1 to 4 of thesis chapter 7 as programmes of the simulated rig: fixed gains, the damping that was measured.

All four sweep the shaker at 4 V from 40 to 60 Hz in a minute and act between 45 and 55 Hz (Tables 7-4 to 7-6). They
differ in where the absorber is tuned, in beta, in the cutoffs and in what is measured.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tuning.rule import scheduling_rule
from twin.plant.config import DampingTable, Plant
from twin.plant.files import load_plant
from twin.rig.programme import Programme, Sweep

TestName = Literal["test1", "test2", "test3", "test4"]
TABLE_HZ = tuple(float(f) for f in np.arange(45.0, 55.01, 0.5))
DRIVE_V = 4.0
DAMPING_FIT = (-0.103, 9.58, -208.0)
"""Polynomial of c2(f) [Ns/m] that the thesis fits to what Test 2 found (Table 7-6, with the sign that damps)."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What sets one test apart from the others.

    Attributes
    ----------
    tuned_hz
        Where the passive absorber resonates [Hz].
    beta_ns_m
        Velocity gain; None for -c2(f).
    low_pass_hz
        Cutoff; None for the pairing f²/f_hp of thesis eq. 7-14.
    """

    tuned_hz: float
    beta_ns_m: float | None
    low_pass_hz: float | None
    high_pass_hz: float
    measurement: Literal["relative", "absolute"]
    source: str


TESTS: dict[TestName, Settings] = {
    "test1": Settings(50.0, -14.0, 200.0, 1.0, "relative", "Table 7-4"),
    "test2": Settings(55.0, None, 200.0, 1.0, "relative", "Table 7-5"),
    "test3": Settings(50.0, None, None, 2.5, "relative", "Table 7-6"),
    "test4": Settings(50.0, None, None, 2.5, "absolute", "7.10"),
}


def measured_damping() -> DampingTable:
    """Damping of the coil [Ns/m] as the thesis has it from Test 2, 45 to 55 Hz, held beyond."""
    return DampingTable(frequency_hz=TABLE_HZ, ns_m=tuple(np.polyval(DAMPING_FIT, TABLE_HZ).tolist()))


def plant_of(test: TestName) -> Plant:
    """The rig as it stood in a test, with the open coil's 7 Ns/m of Table 7-3.

    For Test 2 the absorber is tuned to 55 Hz. The thesis does not say how; here its spring is stiffened and the mass,
    which the gains are computed with, stays.
    """
    plant, tuned_hz = load_plant("rig"), TESTS[test].tuned_hz
    absorber = plant.absorber
    if absorber is None:
        raise ValueError("the rig has no absorber")
    if tuned_hz == 50.0:
        return plant
    stiffer = absorber.model_copy(
        update={"stiffness_n_m": absorber.mass_kg * (math.tau * tuned_hz) ** 2},
    )
    bodies = tuple(stiffer if b is absorber else b for b in plant.body)
    return plant.model_copy(update={"name": f"{plant.name}_{tuned_hz:g}_hz", "body": bodies})


def programme(
    test: TestName,
    *,
    seconds: float = 60.0,
    sweep_hz: tuple[float, float] = (40.0, 60.0),
    seed: int = 0,
    controlled: bool = True,
) -> Programme:
    """Programme of one of the thesis's tests; the defaults are the thesis's own minute.

    Parameters
    ----------
    seconds
        Duration of the sweep.
    sweep_hz
        Excitation at its two ends [Hz].
    controlled
        False leaves the controller off throughout: the passive rig that a test is compared with.

    Raises
    ------
    KeyError
        If there is no such test.
    """
    settings = TESTS[test]
    plant, damping = plant_of(test), measured_damping()
    if plant.absorber is None:
        raise ValueError("the rig has no absorber")
    schedule = scheduling_rule(
        plant.with_damping(plant.absorber.name, damping),
        TABLE_HZ,
        high_pass_hz=settings.high_pass_hz,
        low_pass_hz=settings.low_pass_hz,
    )
    if settings.beta_ns_m is not None:
        schedule = schedule.model_copy(update={"beta_ns_m": (settings.beta_ns_m,) * len(TABLE_HZ)})
    run = Programme(
        plant=plant,
        true_damping=damping,
        sweep=Sweep(from_hz=sweep_hz[0], to_hz=sweep_hz[1], duration_s=seconds, amplitude_v=DRIVE_V),
        schedule=schedule,
        measurement=settings.measurement,
        seed=seed,
    )
    if controlled:
        return run
    below = 0.5 * min(*sweep_hz)
    off = schedule.model_copy(update={"on_from_hz": below, "on_to_hz": below})
    return run.model_copy(update={"schedule": off})
