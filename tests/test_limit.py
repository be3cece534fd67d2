"""The physical limit against brute force and the cone program; the power that a displacement takes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tuned import FACTS, RIG, VOLTS

from tuning.limit import CoilLimits, LimitProgram, discs, electrical_square, least_power, physical_limit
from tuning.loop import RigModel
from tuning.steady import SteadyPaths, steady_paths
from twin.plant.config import Plant
from twin.plant.errors import RunError
from twin.plant.files import load_plant

ENGINE = load_plant("engine_vcm")
PROGRAM = LimitProgram()


def at(plant: Plant, hz: float, amplitude: float) -> SteadyPaths:
    return steady_paths(RigModel(plant, FACTS, hz), hz, amplitude)


@pytest.mark.parametrize(
    ("hz", "watt", "um"), [(47.0, 25.0, 28.19), (53.0, 25.0, 50.776), (47.0, 50.0, 2.4425), (47.0, 52.9, 0.0)]
)
def test_engine_with_coil_can_be_no_quieter_than_its_power_allows(hz: float, watt: float, um: float) -> None:
    found = physical_limit(at(ENGINE, hz, 1000.0), CoilLimits(watt, 1e3, 1.0, 3.0))
    assert found.displacement_m * 1e6 == pytest.approx(um, rel=1e-3, abs=1e-3)


def test_least_power_that_stills_the_engine_at_47_hz_is_52_8_w() -> None:
    found = least_power(at(ENGINE, 47.0, 1000.0), CoilLimits(1.0, 1e3, 1.0, 3.0), 0.0)
    assert found.power_w == pytest.approx(52.8, abs=0.05)


@settings(deadline=None, max_examples=60)
@given(
    hz=st.floats(44.0, 57.0),
    watt=st.floats(0.01, 20.0),
    amps=st.floats(0.1, 5.0),
    volts=st.floats(0.2, 8.0),
    travel=st.floats(0.2, 3.0),
    terminal=st.floats(0.5, 30.0),
    electric=st.floats(0.05, 20.0),
)
def test_closed_form_is_the_cone_program_with_any_limits(
    hz: float, watt: float, amps: float, volts: float, travel: float, terminal: float, electric: float
) -> None:  # fmt: skip
    paths = at(RIG, hz, volts)
    limits = CoilLimits(watt, amps, travel * 1e-3, 2.7, terminal, electric)
    try:
        found = physical_limit(paths, limits)
    except RunError:
        with pytest.raises(RunError, match="no current keeps"):
            PROGRAM.nearest(paths.motion, discs(paths, limits))
        return
    assert all(d.excess(found.reference_a) < 1e-8 for d in discs(paths, limits))
    try:
        reference, _ = PROGRAM.nearest(paths.motion, discs(paths, limits))
    except RunError:
        return  # a sliver of a common part, thinner than the solver sees
    by_cone = abs(paths.motion[0] * reference + paths.motion[1])
    assert found.displacement_m == pytest.approx(by_cone, rel=1e-4, abs=1e-4 * abs(paths.motion[1]))


@pytest.mark.parametrize("hz", [46.0, 52.0, 55.0])
@pytest.mark.parametrize("share", [0.6, 0.9, 1.2])
def test_with_stroke_and_current_bound_no_reference_on_a_fine_grid_does_better(
    hz: float, share: float
) -> None:
    paths = at(RIG, hz, VOLTS)
    motion, current, stroke = paths.motion, paths.current, paths.stroke
    still = -motion[1] / motion[0]
    allowed = CoilLimits(1e3, 0.8 * abs(still), share * abs(stroke[0] * still + stroke[1]), 2.7)
    radius = np.linspace(0.0, 1.2 * allowed.current_peak_a, 400)
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    r = (radius[:, None] * np.exp(1j * angle)).ravel()
    inside = (np.abs(current[0] * r + current[1]) <= allowed.current_peak_a) & (
        np.abs(stroke[0] * r + stroke[1]) <= allowed.stroke_m
    )
    if not inside.any():
        with pytest.raises(RunError, match="current and stroke: no current keeps the limits"):
            physical_limit(paths, allowed)
        return
    least = float(np.min(np.abs(motion[0] * r + motion[1])[inside]))
    found = physical_limit(paths, allowed)
    assert (
        0.97 * least - 1e-8 <= found.displacement_m <= least * (1.0 + 1e-6)
    )  # what the grid's steps may miss


def test_price_of_a_limit_is_what_one_more_unit_of_it_buys() -> None:
    paths = at(RIG, 46.0, VOLTS)
    still = -paths.motion[1] / paths.motion[0]
    amps = 0.5 * abs(still)
    travel = 0.5 * (abs(paths.stroke[1]) + abs(paths.stroke[0] * still + paths.stroke[1]))
    free = CoilLimits(1e6, 1e3, 1.0, 2.7)
    half = paths.at(0.5 * still)
    cases = {
        "power": ("joule_mean_w", 0.5 * 2.7 * amps**2),
        "current": ("current_peak_a", amps),
        "stroke": ("stroke_m", travel),
        "voltage": ("voltage_peak_v", half.voltage_peak_v),
        "electrical": ("electrical_mean_w", half.powers.electrical_mean_w),
    }
    for name, (field, value) in cases.items():
        found = physical_limit(paths, replace(free, **{field: value}))
        assert [a.name for a in found.active] == [name]
        ends = [physical_limit(paths, replace(free, **{field: value * (1.0 + d)})) for d in (-1e-3, 1e-3)]
        slope = (ends[0].displacement_m - ends[1].displacement_m) / (2e-3 * value)
        assert found.active[0].price == pytest.approx(slope, rel=1e-3)


@settings(deadline=None, max_examples=40)
@given(hz=st.floats(44.0, 57.0), real=st.floats(-3.0, 3.0), imag=st.floats(-3.0, 3.0))
def test_electrical_power_is_the_convex_square_it_is_written_as(hz: float, real: float, imag: float) -> None:
    paths, r = at(RIG, hz, VOLTS), complex(real, imag)
    slope, offset, least = electrical_square(paths)
    expected = paths.at(r).powers.electrical_mean_w
    assert abs(slope * r + offset) ** 2 + least == pytest.approx(expected, rel=1e-9, abs=1e-9)
    # Joule heat is the least that an ampere costs: bodies only take energy.
    assert abs(slope) ** 2 >= 0.5 * 2.7 * abs(paths.current[0]) ** 2 * (1.0 - 1e-6)


@pytest.mark.parametrize("kind", ["joule_mean", "joule_peak", "electrical"])
def test_least_power_for_a_displacement_is_the_budget_whose_limit_it_is(kind: str) -> None:
    paths, free = at(ENGINE, 47.0, 1000.0), CoilLimits(1e9, 1e3, 1.0, 3.0)
    found = least_power(paths, free, 20e-6, kind)  # type: ignore[arg-type]
    watt = found.power_w
    limits = {
        "joule_mean": replace(free, joule_mean_w=watt),
        "joule_peak": replace(free, joule_mean_w=0.5 * watt),
        "electrical": replace(free, electrical_mean_w=watt),
    }[kind]
    assert physical_limit(paths, limits).displacement_m == pytest.approx(20e-6, rel=1e-6)
    if kind == "joule_mean":
        per_force = paths.motion[0] / paths.current[0]
        alone = paths.motion[1] - per_force * paths.current[1]
        least_current = (abs(alone) - 20e-6) / abs(per_force)
        assert watt == pytest.approx(1.5 * least_current**2, rel=1e-9)
    more = least_power(paths, free, 20e-6 * (1.0 - 1e-5), kind).power_w  # type: ignore[arg-type]
    assert found.active[0].price == pytest.approx((more - watt) / (20e-6 * 1e-5), rel=1e-3)


def test_limit_that_nothing_binds_has_no_price_and_stills_the_table() -> None:
    paths = at(RIG, 50.0, VOLTS)
    found = physical_limit(paths, CoilLimits(33.0, 2.0, 0.0095, 2.7))
    assert found.active == ()
    assert found.displacement_m < 1e-9 * abs(paths.motion[1])


def test_excitation_that_alone_breaks_the_stroke_has_no_solution() -> None:
    with pytest.raises(RunError, match="stroke: no current keeps the limits"):
        physical_limit(at(RIG, 50.0, VOLTS), CoilLimits(33.0, 1e-4, 1e-6, 2.7))
    with pytest.raises(RunError, match="no current keeps"):
        PROGRAM.nearest(
            at(RIG, 50.0, VOLTS).motion, discs(at(RIG, 50.0, VOLTS), CoilLimits(33.0, 1e-4, 1e-6, 2.7))
        )


def test_terminal_voltage_and_current_are_those_of_the_circuit() -> None:
    paths = at(RIG, 47.0, VOLTS)
    got = paths.at(0.3 + 0.2j)
    current, stroke = ((pair[0] * (0.3 + 0.2j) + pair[1]) for pair in (paths.current, paths.stroke))
    w = math.tau * 47.0
    voltage = (2.7 + 1j * w * 0.0013) * current - 8.0 * 1j * w * stroke
    assert got.voltage_peak_v == pytest.approx(abs(voltage), rel=1e-12)
    assert got.powers.electrical_mean_w == pytest.approx(0.5 * (voltage * np.conj(current)).real, rel=1e-12)
