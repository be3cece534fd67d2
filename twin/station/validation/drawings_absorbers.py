"""Figures of chapters 3 to 5, redrawn."""

import numpy as np
from matplotlib.axes import Axes

from twin.control.continuous import build_loop
from twin.plant.absorber import (
    absorber_transmissibility,
    den_hartog,
    fixed_points,
    normalised_amplitude,
    transmissibility,
)
from twin.plant.analogue import circuit_of, loop_currents
from twin.plant.shaker import SweepLimits, sweep
from twin.station.validation.canvas import (
    CONTROLLED,
    LIMIT,
    PASSIVE,
    SECOND,
    SHADES,
    THIRD,
    Drawing,
    dress,
)
from twin.station.validation.chapters_3_to_5 import LIMIT_M, MU
from twin.station.validation.models import absorber_of, mechanical, preset


def _isolation(axes: list[Axes]) -> None:
    r = np.linspace(0.01, 3.0, 1500)
    for zeta, colour in zip((0.05, 0.1, 0.2, 0.5, 1.0), SHADES, strict=False):
        axes[0].plot(r, transmissibility(r, zeta), color=colour, label=f"ζ = {zeta:g}")
    axes[0].axvline(np.sqrt(2.0), color=LIMIT, linestyle="--", linewidth=1, label="r = √2")
    axes[0].axhline(1.0, color=PASSIVE, linewidth=0.8)
    axes[0].set_ylim(0.0, 5.0)
    dress(axes[0], "frequency ratio r", "transmissibility")


def _den_hartog(axes: list[Axes]) -> None:
    g = np.linspace(0.6, 1.3, 3000)
    for zeta, colour in ((0.0, PASSIVE), (0.1, CONTROLLED), (0.32, SECOND), (50.0, THIRD)):
        label = "ζ infinite" if zeta == 50.0 else f"ζ = {zeta:g}"
        axes[0].plot(g, np.clip(normalised_amplitude(g, 1.0, MU, zeta), 0.0, 30.0), color=colour, label=label)
    points = fixed_points(1.0, MU)
    axes[0].plot(
        [points.lower, points.upper], [points.lower_amplification, points.upper_amplification], "o",
        color=LIMIT, markersize=6, label="fixed points", zorder=5,
    )  # fmt: skip
    axes[0].set_ylim(0.0, 16.0)
    dress(axes[0], "forced frequency ratio g", "amplitude / static deflection", "f = 1, µ = 0.05")
    best = den_hartog(MU)
    for scale, colour in ((0.5, SECOND), (1.0, CONTROLLED), (2.0, THIRD)):
        zeta = scale * float(best.damping_ratio)
        axes[1].plot(
            g, normalised_amplitude(g, best.frequency_ratio, MU, zeta), color=colour,
            label=f"ζ = {zeta:.3f}" + (" (optimum)" if scale == 1.0 else ""),
        )  # fmt: skip
    axes[1].axhline(float(best.amplification), color=LIMIT, linestyle="--", linewidth=1, label="√(1 + 2/µ)")
    axes[1].set_ylim(0.0, 16.0)
    dress(axes[1], "forced frequency ratio g", "amplitude / static deflection", "f = 1/(1 + µ)")


def _ratios(axes: list[Axes]) -> None:
    g = np.linspace(0.5, 1.5, 3000)
    for zeta, colour in zip((0.0, 0.1, 0.2, 0.32, 0.6), SHADES[1:], strict=False):
        curve = normalised_amplitude(g, 1.0, 0.2, zeta)
        axes[0].plot(g, np.where(curve < 20.0, curve, np.nan), color=colour, label=f"ζ = {zeta:g}")
    axes[0].set_ylim(0.0, 10.0)
    dress(axes[0], "forced frequency ratio g", "amplitude / static deflection", "µ = 0.2, f = 1")
    for mu, colour in zip((0.05, 0.1, 0.2, 0.4), SHADES[1:], strict=False):
        curve = normalised_amplitude(g, 1.0, mu, 0.0)
        axes[1].plot(g, np.where(curve < 20.0, curve, np.nan), color=colour, label=f"µ = {mu:g}")
    axes[1].set_ylim(0.0, 10.0)
    dress(axes[1], "forced frequency ratio g", "amplitude / static deflection", "ζ = 0, f = 1")


def _analogue(axes: list[Axes]) -> None:
    f = np.geomspace(0.3, 100.0, 6000)
    plant = preset("analogue_2dof")
    for c2, colour in ((0.0, PASSIVE), (22.0, CONTROLLED), (220.0, SECOND)):
        circuit = circuit_of(plant.with_damping(absorber_of(plant).name, c2))
        currents = loop_currents(circuit, f)[:, :, 0]
        axes[0].loglog(f, 1.0 / np.abs(currents[:, 0]), color=colour, label=f"R₂ = {c2:g} Ω")
        axes[1].loglog(f, np.abs(currents[:, 1] / currents[:, 0]), color=colour, label=f"R₂ = {c2:g} Ω")
    dress(
        axes[0], "frequency [Hz]", "impedance |V/I₁| [Ω]", "low where the masses resonate: 0.95 and 52.4 Hz"
    )
    dress(axes[1], "frequency [Hz]", "|I₂/I₁|", "all motion in the second loop at 50 Hz")


def _engine(axes: list[Axes]) -> None:
    f = np.unique(np.concatenate([np.geomspace(0.5, 100.0, 1500), np.linspace(44.0, 58.0, 1500)]))
    engine = mechanical(preset("engine"))
    for c2, colour in ((0.0, PASSIVE), (2.7, CONTROLLED)):
        loop = build_loop(engine.with_damping("absorber", c2), None)
        found = np.array([loop.steady(float(x), 0.0, 1000.0) for x in f])
        case, absorber = found[:, 0], found[:, 0] - found[:, 1]
        axes[0].loglog(f, np.abs(case), color=colour, label=f"c₂ = {c2:g} Ns/m")
        axes[1].loglog(f, np.abs(absorber), color=colour, label=f"c₂ = {c2:g} Ns/m")
    axes[0].axhline(LIMIT_M, color=LIMIT, linestyle="--", linewidth=1, label="20 µm")
    axes[0].axvspan(47.0, 53.0, color=LIMIT, alpha=0.08)
    axes[0].set_ylim(1e-8, 1.0)
    dress(axes[0], "frequency [Hz]", "case displacement [m]", "engine case, 1000 N")
    dress(axes[1], "frequency [Hz]", "absorber displacement [m]", "absorber, 1000 N")


def _shaker(axes: list[Axes]) -> None:
    f = np.geomspace(5.0, 1000.0, 2000)
    axes[0].loglog(f, sweep(preset("shaker_v721"), f).current_a, color=CONTROLLED)
    for hz, text in zip(
        SweepLimits().crossovers_hz, ("position | velocity", "velocity | acceleration"), strict=True
    ):
        axes[0].axvline(hz, color=PASSIVE, linestyle="--", linewidth=1)
        axes[0].annotate(
            text,
            (hz, 4.0),
            rotation=90,
            fontsize=8,
            color="#455a64",
            xytext=(3, 0),
            textcoords="offset points",
        )
    dress(
        axes[0],
        "frequency [Hz]",
        "armature current [A]",
        "V721, at the tightest of 25.4 mm, 0.7 m/s and 66 g",
    )


def _transmissibility(axes: list[Axes]) -> None:
    f = np.linspace(40.0, 80.0, 3000)
    absorber = absorber_of(preset("engine"))
    for c2, colour in ((1.0, PASSIVE), (2.7, CONTROLLED), (10.0, SECOND)):
        ratio = absorber_transmissibility(
            f, m2_kg=absorber.mass_kg, c2_ns_m=c2, k2_n_m=absorber.stiffness_n_m
        )
        axes[0].semilogy(f, np.abs(ratio), color=colour, label=f"c₂ = {c2:g} Ns/m")
    dress(axes[0], "frequency [Hz]", "|absorber / table|")


DRAWINGS = (
    Drawing(
        "isolation", "Force that reaches the foundation", "Figure 3-5",
        "An isolator lets less force through only above √2 times its own frequency, and the less damping it "
        "has the better it does there.", _isolation, ("isolator.isolation_from_ratio",),
    ),
    Drawing(
        "den_hartog", "Absorber of Den Hartog", "Figure 4-2, eq. 4-6 to 4-8",
        "Left: whatever the damping, all curves pass the same two points. Right: with the absorber tuned a "
        "little below the primary both points are of one height, and the optimum damping makes them the "
        "peaks.", _den_hartog,
        ("denhartog.frequency_ratio", "denhartog.damping_ratio", "denhartog.curves_cross_twice"), 2,
    ),
    Drawing(
        "mass_ratio", "Damping and mass of an absorber", "Figures 11-1, 11-2",
        "A heavier absorber moves the two resonances further apart; damping lowers them and fills the notch "
        "between.", _ratios, (), 2,
    ),
    Drawing(
        "analogue", "The electrical twin of two bodies", "Figures 4-10 to 4-12",
        "Impedance of the circuit of Table 4-2 and the share of current in its second loop. The thesis "
        "reads the upper resonance as 54 Hz; its own values give 52.4 Hz.", _analogue,
        ("analogue.mode1_hz", "analogue.mode2_hz", "analogue.quietest_hz"), 2,
    ),
    Drawing(
        "engine", "The engine with its passive absorber", "Figure 5-2",
        "Case and absorber for 1000 N. The case keeps below 20 µm only close to 50 Hz; between 47 and 53 Hz "
        "(shaded) it has to be helped. Resonances at 2.05 and 55.1 Hz.", _engine,
        ("engine.mode1_hz", "engine.mode2_hz", "engine.stroke_50hz_m", "engine.passive_only_at_50hz"), 2,
    ),
    Drawing(
        "shaker", "Current of the V721 shaker", "Figures 5-6 to 5-8",
        "What the table takes to follow its limits: position, then velocity, then acceleration held; least "
        "current at its resonance of 13.5 Hz.", _shaker,
        ("shaker.resonance_hz", "shaker.velocity_from_hz", "shaker.acceleration_from_hz"),
    ),
    Drawing(
        "absorber_transmissibility", "The engine's absorber on a shaker", "Figure 5-12",
        "Transmissibility from table to absorber. The thesis finds 2.7 Ns/m by laying such a curve over "
        "measured points, which the scan lacks.", _transmissibility, ("engine.absorber_damping_ns_m",),
    ),
)  # fmt: skip
