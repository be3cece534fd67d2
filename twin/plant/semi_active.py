"""A coil whose terminals lie on a resistor: a damper that is set by its load and pays in electrical power.

The coil of resistance R and inductance L on a load r carries ``i = -k v / (R + r + jwL)`` when its ends move
apart at velocity v, and resists with ``k i`` (thesis 3.6, eq. 3-27 and 3-28, energy-conserving sign). Seen from
the mechanics this is a damper k²/(R + r) in series with a spring k²/L: the inductance stiffens the absorber, it
does not add mass to it (against thesis 7.5.3). An infinite load is the open coil, zero the shorted one.
"""

import numpy as np
from numpy.typing import ArrayLike

from twin.plant.config import DampingTable, Plant, VoiceCoil
from twin.plant.linear import Array, ComplexArray

TAU = 2.0 * np.pi


def coil_impedance(coil: VoiceCoil, load_ohm: ArrayLike, frequency_hz: ArrayLike) -> ComplexArray:
    """Mechanical impedance k²/(R + r + jwL) [Ns/m]: force against the motion over velocity between the ends.

    Parameters
    ----------
    load_ohm
        Resistance across the terminals [ohm], 0 or more; broadcasts with ``frequency_hz``.

    Raises
    ------
    ValueError
        If a load is negative or not a number; that would be an amplifier.
    """
    load = np.asarray(load_ohm, dtype=np.float64)
    if not np.all(load >= 0.0):
        raise ValueError(f"load_ohm must not be below 0 ohm, got {load!s}")
    reactance = TAU * np.asarray(frequency_hz, dtype=np.float64) * coil.inductance_h
    resistance, reactance = np.broadcast_arrays(coil.resistance_ohm + load, reactance)
    electrical = np.array(resistance + 0j)
    electrical.imag = reactance
    with np.errstate(invalid="ignore"):
        impedance = coil.force_constant_n_a**2 / electrical
    return np.asarray(np.where(np.isinf(resistance), 0j, impedance))


def equivalent_damping(coil: VoiceCoil, load_ohm: ArrayLike, frequency_hz: ArrayLike) -> Array:
    """Damping [Ns/m] that the loaded coil adds between its ends at a frequency: the impedance's real part.

    Arguments and errors as `coil_impedance`.
    """
    return np.asarray(coil_impedance(coil, load_ohm, frequency_hz).real)


def equivalent_stiffness(coil: VoiceCoil, load_ohm: ArrayLike, frequency_hz: ArrayLike) -> Array:
    """Stiffness [N/m] that the loaded coil adds between its ends at a frequency, never negative.

    The part of the impedance a spring has, -w Im Z = k² w² L / ((R + r)² + w² L²). Arguments and errors as
    `coil_impedance`.
    """
    w = TAU * np.asarray(frequency_hz, dtype=np.float64)
    return np.asarray(-w * coil_impedance(coil, load_ohm, frequency_hz).imag + 0.0)


def harvested_power(
    coil: VoiceCoil, load_ohm: ArrayLike, frequency_hz: ArrayLike, velocity_m_s: ArrayLike
) -> tuple[Array, Array]:
    """Mean power [W] in the load and in the coil's own resistance.

    Their sum is the mean mechanical power taken from the motion, ``equivalent_damping |v|²/2``.

    Parameters
    ----------
    velocity_m_s
        Amplitude (peak, may be complex) of the velocity between the coil's ends [m/s].
    """
    load = np.asarray(load_ohm, dtype=np.float64)
    # the load's share of the resistance; nothing flows in an infinite one
    share = load / (coil.resistance_ohm + np.where(np.isinf(load), 1.0, load))
    share = np.where(np.isinf(load), 0.0, share)
    total = equivalent_damping(coil, load, frequency_hz) * np.abs(np.asarray(velocity_m_s)) ** 2 / 2.0
    return np.asarray(share * total), np.asarray((1.0 - share) * total)


def most_damping_load(coil: VoiceCoil, frequency_hz: ArrayLike) -> Array:
    """Load [ohm] of most damping at a frequency: ``max(0, wL - R)``.

    The shorted coil (thesis 3.6) up to R/(2 pi L), above that a load that makes the resistances as large as
    the reactance; the damping is then k²/(2 w L).
    """
    reactance = TAU * np.asarray(frequency_hz, dtype=np.float64) * coil.inductance_h
    return np.asarray(np.maximum(0.0, reactance - coil.resistance_ohm))


def most_power_load(
    coil: VoiceCoil, frequency_hz: ArrayLike, mobility_m_ns: ArrayLike | complex = 0.0
) -> Array:
    """Load [ohm] that harvests most at a frequency: as large as the rest of the circuit, ``|R + jwL + k² Y|``.

    Parameters
    ----------
    mobility_m_ns
        Mobility Y of what the coil works against: velocity between its ends per force between them [m/(Ns)],
        with the coil open; complex. 0 is a motion that the coil cannot slow down.
    """
    w = TAU * np.asarray(frequency_hz, dtype=np.float64)
    host = coil.force_constant_n_a**2 * np.asarray(mobility_m_ns, dtype=np.complex128)
    return np.asarray(np.abs(coil.resistance_ohm + 1j * w * coil.inductance_h + host))


def shunted(plant: Plant, load_ohm: float) -> Plant:
    """The plant with its voice coil on a load: a copy whose coil has R + r and no current loop.

    With zero voltage on that input, the model of the copy is the semi-active plant.

    Raises
    ------
    ValueError
        If the plant has no voice coil or the load is negative or not finite (leave an open coil to
        ``linear_model(..., current_driven=...)``).
    """
    coil = plant.voice_coil
    if coil is None:
        raise ValueError(f"plant '{plant.name}' has no voice coil to put a load on")
    if not 0.0 <= load_ohm < np.inf:
        raise ValueError(f"load_ohm must be finite and not below 0 ohm, got {load_ohm}")
    loaded = coil.model_copy(
        update={"resistance_ohm": coil.resistance_ohm + load_ohm, "current_loop_kp_v_a": None}
    )
    return plant.model_copy(update={"actuator": tuple(loaded if a is coil else a for a in plant.actuator)})


def compensated(plant: Plant, load_ohm: float = 0.0) -> Plant:
    """The plant with its coil on a load and the inductive drop made good by ``v = L di/dt``.

    What is left of the circuit is ``R i = -k (x2' - x1')``: a plain damper k²/(R + r) between the coil's two
    bodies, without the spring k²/L that shifts the absorber's resonance (thesis 7.5.4, validation test 3).

    Returns
    -------
    Plant
        A copy without the coil, its damping added to the absorber's at every frequency.

    Raises
    ------
    ValueError
        If the plant has no voice coil across the absorber's own spring, or the load cannot be.
    """
    loaded = shunted(plant, load_ohm).voice_coil
    absorber = plant.absorber
    if loaded is None or loaded.between is None or absorber is None:
        raise ValueError(f"plant '{plant.name}' has no voice coil between two bodies")
    if loaded.between != (absorber.attached_to, absorber.name):
        raise ValueError(f"actuator '{loaded.name}' does not act across the spring of '{absorber.name}'")
    extra = loaded.force_constant_n_a**2 / loaded.resistance_ohm
    damping = absorber.damping_ns_m
    if isinstance(damping, DampingTable):
        damping = damping.model_copy(update={"ns_m": tuple(c + extra for c in damping.ns_m)})
    else:
        damping = damping + extra
    others = tuple(a for a in plant.actuator if a.name != loaded.name)
    sensors = tuple(s for s in plant.sensor if s.of != loaded.name)
    limits = {k: v for k, v in plant.limits.items() if not k.startswith(f"{loaded.name}_")}
    damped = plant.with_damping(absorber.name, damping)
    return damped.model_copy(update={"actuator": others, "sensor": sensors, "limits": limits})
