"""Figures of chapters 3 to 5: isolators, absorbers, the electrical analogy, the engine and the V721 shaker."""

import math
from functools import cache

import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar

from twin.control.continuous import build_loop
from twin.plant.absorber import den_hartog, fixed_points, normalised_amplitude, transmissibility
from twin.plant.analogue import circuit_of, loop_currents
from twin.plant.linear import Array, natural_frequencies_hz
from twin.plant.shaker import SweepLimits
from twin.station.validation.models import absorber_of, mechanical, point, preset, tuned_hz
from twin.station.validation.rows import EXACT, PLOT, Figure, Tolerance, digits

MU = 0.05
LIMIT_M = 20e-6
SCAN = "Shown in a plot only, which the scan lacks; computed here."


@cache
def _flattest() -> tuple[float, float]:
    """Frequency and damping ratio of the lowest peak of eq. 4-6, found by search."""
    g = np.linspace(0.7, 1.3, 4001)

    def peak(x: Array) -> float:
        return float(normalised_amplitude(g, x[0], MU, abs(x[1])).max())

    options = {"xatol": 1e-7, "fatol": 1e-9}
    found = minimize(peak, np.array([0.97, 0.1]), method="Nelder-Mead", options=options)  # type: ignore[call-overload]
    return float(found.x[0]), float(abs(found.x[1]))


def _curves_cross() -> bool:
    points = fixed_points(1.0, MU)
    heights = [
        normalised_amplitude(g, 1.0, MU, zeta)
        for zeta in (0.05, 0.1, 0.3)
        for g in (points.lower, points.upper)
    ]
    return bool(np.allclose(heights[0::2], heights[0]) and np.allclose(heights[1::2], heights[1]))


def _mode(plant: str, number: int) -> float:
    return float(natural_frequencies_hz(preset(plant))[number])


def _quietest_hz() -> float:
    """Where the first loop of the analogue carries least current, with no resistor in the second."""
    plant = preset("analogue_2dof")
    circuit = circuit_of(plant.with_damping(absorber_of(plant).name, 0.0))
    found = minimize_scalar(
        lambda f: float(abs(loop_currents(circuit, f)[0, 0, 0])), bounds=(48.0, 52.0), method="bounded",
        options={"xatol": 1e-9},
    )  # fmt: skip
    return float(found.x)


def _undamped_stroke() -> float:
    engine = preset("engine")
    undamped = engine.with_damping(absorber_of(engine).name, 0.0)
    return float(abs(build_loop(undamped, None).steady(50.0, 0.0, 1000.0)[1]))


def _phase_deg(signal: str) -> float:
    """Phase of case or absorber motion at 50 Hz against the force [deg]."""
    case, stroke = _passive_phasors()
    phasor = case if signal == "case" else case - stroke
    return math.degrees(np.angle(phasor))


def _passive_phasors() -> tuple[complex, complex]:
    """Phasors of case and of case against absorber at 50 Hz, passive, per newton."""
    found = build_loop(mechanical(preset("engine")), None).steady(50.0)
    return complex(found[0]), complex(found[1])


def _passive(f: float) -> float:
    return point("engine", "passive", f, 1000.0).primary_displacement_m


def _stiffness_for_50_hz() -> float:
    return absorber_of(preset("engine")).mass_kg * (2.0 * math.pi * 50.0) ** 2


def _passive_row(f: float, note: str = "") -> Figure:
    return Figure(
        f"engine.passive_{f:g}hz_m",
        "Figures 5-2, 6-12",
        "m",
        None,
        lambda: _passive(f),
        None,
        f"{SCAN} {note}".strip(),
    )


def _table_on_absorber() -> float:
    """Upper mode of the bare V721 table with the engine's absorber on it [Hz]."""
    table, absorber = preset("shaker_v721").primary, absorber_of(preset("engine"))
    bodies = (table, absorber.model_copy(update={"attached_to": table.name}))
    both = preset("shaker_v721").model_copy(
        update={"body": bodies, "actuator": (), "sensor": (), "limits": {}}
    )
    return float(natural_frequencies_hz(both)[1])


FIGURES = (
    Figure(
        "isolator.isolation_from_ratio", "3.2.3, eq. 3-26", "1", math.sqrt(2.0),
        lambda: float(brentq(lambda r: float(transmissibility(r, 0.1)) - 1.0, 1.1, 2.0)), EXACT,
        "Where the transmissibility falls to 1, found on the curve.",
    ),
    Figure(
        "denhartog.frequency_ratio", "eq. 4-7, mu = 0.05 of Figure 4-2", "1", 1.0 / (1.0 + MU),
        lambda: float(den_hartog(MU).frequency_ratio), EXACT,
        "1/(1 + mu); the thesis prints the formula.",
    ),
    Figure(
        "denhartog.damping_ratio", "eq. 4-8, mu = 0.05 of Figure 4-2", "1",
        math.sqrt(3.0 * MU / (8.0 * (1.0 + MU) ** 3)), lambda: float(den_hartog(MU).damping_ratio), EXACT,
        "sqrt(3 mu / (8 (1 + mu)³)): the equation is hardly readable in the scan, this is the classic form "
        "for the main mass's displacement, with damping referred to the primary's frequency.",
    ),
    Figure(
        "denhartog.frequency_ratio_by_search", "eq. 4-6, 4-7", "1", 1.0 / (1.0 + MU), lambda: _flattest()[0],
        Tolerance(0.005, "fixed points of equal height are nearly, not exactly, peaks of equal height"),
        "Lowest peak of eq. 4-6 over frequency and damping ratio, without the formula.",
    ),
    Figure(
        "denhartog.damping_ratio_by_search", "eq. 4-6, 4-8", "1",
        math.sqrt(3.0 * MU / (8.0 * (1.0 + MU) ** 3)), lambda: _flattest()[1],
        Tolerance(0.02, "the formula is a mean of the two that level one fixed point each"),
        "The same search.",
    ),
    Figure(
        "denhartog.curves_cross_twice", "4.1, Figure 4-2", "true/false", True, _curves_cross, None,
        "All damping ratios give the same amplitude at two frequencies.",
    ),
    Figure(
        "analogue.capacitance_1_f", "Table 4-2", "F", 633.257e-6,
        lambda: circuit_of(preset("analogue_2dof")).loop[0].capacitance_f,
        Tolerance(5e-4, "k1 is printed with four digits"), "1/k1.",
    ),
    Figure(
        "analogue.capacitance_2_f", "Table 4-2", "F", 2.533e-6,
        lambda: circuit_of(preset("analogue_2dof")).loop[1].capacitance_f, digits(2.533, 0.001), "1/k2.",
    ),
    Figure(
        "analogue.mode1_hz", "4.3.4, Figure 4-11", "Hz", 1.0, lambda: _mode("analogue_2dof", 0),
        digits(1.0, 1.0),
    ),
    Figure(
        "analogue.mode2_hz", "4.3.4, Figure 4-11", "Hz", 54.0, lambda: _mode("analogue_2dof", 1),
        digits(54.0, 1.0),
        "The thesis is wrong: its own Table 4-2 in its own eq. 3-18 gives 52.44 Hz.",
    ),
    Figure(
        "analogue.quietest_hz", "4.3.4, Figure 4-12", "Hz", 50.0, _quietest_hz, digits(50.0, 1.0),
        "Where the first loop carries no current.",
    ),
    Figure(
        "engine.mode1_hz", "5.2", "Hz", 2.0, lambda: _mode("engine", 0),
        digits(2.0, 1.0, "the text says 2 Hz"), "Natural frequency without damping.",
    ),
    Figure(
        "engine.mode2_hz", "5.2, 6.8, 7.8.1", "Hz", 54.8, lambda: _mode("engine", 1), PLOT,
        "Table 5-1 in eq. 3-18 gives 55.10 Hz; 54.8 is how the plot was read.",
    ),
    Figure(
        "engine.absorber_tuned_hz", "5.1, Table 5-1", "Hz", 50.0, lambda: tuned_hz(preset("engine")),
        digits(50.0, 0.1),
    ),
    Figure(
        "engine.stiffness_table_5_1_n_m", "Table 5-1", "N/m", 874640.0, _stiffness_for_50_hz,
        digits(874640.0, 10.0), "What 8.862 kg need for 50 Hz.",
    ),
    Figure(
        "engine.stiffness_table_6_1_n_m", "Table 6-1", "N/m", 87464.0, _stiffness_for_50_hz,
        digits(87464.0, 1.0),
        "The thesis is wrong here: a digit is missing. 874640 N/m of Table 5-1 is right; with 87464 N/m the "
        "absorber would be tuned to 15.8 Hz.",
    ),
    Figure(
        "engine.stroke_50hz_m", "5.1", "m", 1.15e-3, _undamped_stroke,
        Tolerance(0.02, "the text says around"),
        "1000 N, c2 = 0: the absorber's inertia balances the force, F/(m2 w²).",
    ),
    Figure(
        "engine.absorber_phase_50hz_deg", "5.2", "deg", -180.0, lambda: -abs(_phase_deg("absorber")),
        Tolerance(0.01, "the text says out of phase"),
    ),
    Figure(
        "engine.case_phase_50hz_deg", "5.2", "deg", -90.0, lambda: _phase_deg("case"),
        Tolerance(0.02, "the text says 90° behind"),
        "With c2 = 2.7 Ns/m; without damping the case stands still.",
    ),
    _passive_row(45.0),
    _passive_row(47.0),
    _passive_row(50.0, "1000 N, c2 = 2.7 Ns/m: the absorber works at its own frequency."),
    _passive_row(53.0),
    _passive_row(55.0, "Next to the resonance at 55.1 Hz, so very sensitive to it."),
    Figure(
        "engine.passive_only_at_50hz", "5.2, 6.8", "true/false", True,
        lambda: _passive(50.0) < LIMIT_M < min(_passive(47.0), _passive(53.0)), None,
        "Without control the case keeps below 20 µm at 50 Hz and not at 47 or 53 Hz.",
    ),
    Figure(
        "shaker.resonance_hz", "5.3, Figure 5-8", "Hz", 13.5,
        lambda: float(natural_frequencies_hz(preset("shaker_v721"))[0]), digits(13.5, 0.1),
    ),
    Figure(
        "shaker.velocity_from_hz", "5.3", "Hz", 8.8, lambda: SweepLimits().crossovers_hz[0], digits(8.8, 0.1),
        "Only if 25.4 mm is the stroke from end to end; the thesis calls it an amplitude, which gives 4.4 "
        "Hz.",
    ),
    Figure(
        "shaker.acceleration_from_hz", "5.3", "Hz", 150.0, lambda: SweepLimits().crossovers_hz[1],
        Tolerance(0.05, "the text says approximately"), "0.7 m/s and 66 g meet at 147.2 Hz.",
    ),
    Figure(
        "shaker.with_absorber_hz", "5.4, Figure 5-12", "Hz", 63.0, _table_on_absorber, None,
        "The thesis lays dynamics at 63 Hz to the table with the absorber on it. The fixed part of the "
        "absorber on the table is not given; the bare table of 4.41 kg gives 87.4 Hz, 15.3 kg would give 63 "
        "Hz.", comparable=False,
    ),
    Figure(
        "engine.absorber_damping_ns_m", "5.4, Figure 5-12", "Ns/m", 2.7, None, None,
        "Fitted to a measured transmissibility that is not printed as numbers. (The text gives it in Nm/s.)",
    ),
    Figure(
        "engine.measured_acceleration", "5.4, Figure 5-10", "m/s²", None, None, None,
        "Measured on an engine at the maker's; the data are not in the thesis.",
    ),
)  # fmt: skip
