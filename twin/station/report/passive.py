"""Attenuation in hindsight: motion beside that of the same plant without control, with the damping known at the end."""

from dataclasses import dataclass

import numpy as np

from estimators.types import DampingCurve
from twin.plant.config import ForceActuator, Plant, Shaker, VoiceCoil
from twin.plant.linear import Array, frequency_response, linear_model
from twin.station.report.tracks import Tracks

MOST_FREQUENCIES = 2000
"""More different frequencies than this are interpolated between as many."""


@dataclass(frozen=True, slots=True)
class Hindsight:
    """Motion without control and what it makes of the measured one, block by block.

    Attributes
    ----------
    passive_m, passive_std_m
        (n_blocks,) peak of the primary at the excitation without control [m]; the standard deviation is by the
        damping's. NaN where the excitation or the plant cannot tell.
    attenuation, attenuation_std
        (n_blocks,) 1 - measured/passive; 1 is perfect. NaN while the control is not settled.
    why_not
        Why there is none; empty where there is.
    """

    passive_m: Array
    passive_std_m: Array
    attenuation: Array
    attenuation_std: Array
    why_not: str = ""


def in_hindsight(plant: Plant, tracks: Tracks, curve: DampingCurve | None) -> Hindsight:
    """Work out the motion without control for every block with an excitation.

    Parameters
    ----------
    curve
        The damping as known in the end; None takes the plant's own.
    """
    nothing = np.full(len(tracks), np.nan)
    source = _exciter(plant, tracks)
    if isinstance(source, str):
        return Hindsight(nothing, nothing, nothing, nothing, source)
    column, driven = source
    hz = tracks["frequency_hz"]
    known = np.isfinite(hz) & (hz > 0.0) & np.isfinite(tracks["excitation"])
    if not known.any():
        return Hindsight(nothing, nothing, nothing, nothing, "no excitation was found")
    grid = np.unique(hz[known])
    if len(grid) > MOST_FREQUENCIES:
        grid = np.linspace(grid[0], grid[-1], MOST_FREQUENCIES)
    per_unit, spread = _per_unit(plant, grid, column, driven, curve)
    passive, std = nothing.copy(), nothing.copy()
    passive[known] = np.interp(hz[known], grid, per_unit) * tracks["excitation"][known]
    std[known] = np.interp(hz[known], grid, spread) * tracks["excitation"][known]
    settled = tracks["settled"] > 0.0
    motion, noise = tracks["displacement_m"], tracks["displacement_std_m"]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(settled & (passive > 0.0), motion / passive, np.nan)
        attenuation_std = np.hypot(noise / passive, ratio * std / passive)
    return Hindsight(passive, std, 1.0 - ratio, np.where(np.isfinite(ratio), attenuation_std, np.nan))


def _exciter(plant: Plant, tracks: Tracks) -> tuple[int, tuple[str, ...]] | str:
    """Column of the exciting actuator and the coils whose current is given; in words where it cannot be told."""
    open_coil = tuple(
        a.name for a in plant.actuator if isinstance(a, VoiceCoil) and a.current_loop_kp_v_a is None
    )
    if not tracks.reference and not tracks.force_estimated:
        return "no excitation was found"
    for k, actuator in enumerate(plant.actuator):
        if isinstance(actuator, VoiceCoil):
            continue
        if tracks.force_estimated and isinstance(actuator, ForceActuator):
            return k, open_coil
        of_it = {s.name: s.kind for s in plant.sensor if s.of == actuator.name}
        kind = of_it.get(tracks.reference)
        if tracks.reference == actuator.name or (kind == "voltage" and actuator.input_unit == "V"):
            return k, open_coil
        if kind == "current" and isinstance(actuator, Shaker):
            return k, (*open_coil, actuator.name)
        if kind == "force" and isinstance(actuator, ForceActuator) and actuator.input_unit == "N":
            return k, open_coil
    return f"'{tracks.reference}' is tracked, which does not say how strong the excitation is"


def _per_unit(
    plant: Plant, grid: Array, column: int, driven: tuple[str, ...], curve: DampingCurve | None
) -> tuple[Array, Array]:
    """Motion of the primary per unit of excitation, and how far one standard deviation of damping moves it."""
    absorber = plant.absorber

    def motion(hz: float, offset: float) -> float:
        damping = {}
        if curve is not None and absorber is not None:
            learned = np.interp(hz, curve.frequency_hz, curve.damping_ns_m)
            std = np.interp(hz, curve.frequency_hz, curve.std_ns_m)
            damping = {absorber.name: max(0.0, float(learned + offset * std))}
        model = linear_model(plant, frequency_hz=hz, damping_ns_m=damping, current_driven=driven)
        row = np.zeros((1, len(model.states)))
        row[0, model.states.index(f"x_{plant.primary.name}")] = 1.0
        D = np.zeros((1, model.B.shape[1]))
        return float(abs(frequency_response(model.A, model.B, row, D, hz)[0, 0, column]))

    mean = np.array([motion(hz, 0.0) for hz in grid])
    if curve is None or absorber is None:
        return mean, np.zeros(len(grid))
    spread = [0.5 * abs(motion(hz, 1.0) - motion(hz, -1.0)) for hz in grid]
    return mean, np.array(spread)
