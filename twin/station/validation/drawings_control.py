"""Figures of chapter 6, redrawn: gains, controlled responses, delay."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from twin.control.analysis import Controller, choose_law
from twin.control.continuous import build_loop
from twin.control.delay import growth_rate_1_s, taylor_error, taylor_poles
from twin.control.laws import Feedback, scheduled_mass, scheduled_stiffness
from twin.control.margins import delay_margin_s
from twin.station.validation.canvas import (
    CONTROLLED,
    LIMIT,
    PASSIVE,
    SECOND,
    SHADES,
    THIRD,
    Drawing,
    dress,
    values,
)
from twin.station.validation.chapters_3_to_5 import LIMIT_M
from twin.station.validation.models import (
    BAND_HZ,
    absorber_of,
    force_loop,
    lq_loop,
    mechanical,
    point,
    preset,
)

FINE_HZ = tuple(float(f) for f in np.arange(45.0, 55.01, 0.25))


def _gains(axes: list[Axes]) -> None:
    mass = absorber_of(preset("engine")).mass_kg
    axes[0].plot(FINE_HZ, [1e-3 * scheduled_stiffness(mass, 50.0, f) for f in FINE_HZ], color=CONTROLLED)
    dress(axes[0], "excitation [Hz]", "γ [kN/m]", "position gain")
    axes[1].plot(FINE_HZ, [scheduled_mass(mass, 50.0, f) for f in FINE_HZ], color=SECOND)
    dress(axes[1], "excitation [Hz]", "α [kg]", "acceleration gain")


def _tracking(axes: list[Axes]) -> None:
    f = np.linspace(40.0, 65.0, 2500)
    engine = mechanical(preset("engine"))
    for panel, (cancel, title) in enumerate(((False, "β = 0"), (True, "β = -c₂"))):
        for k, at in enumerate((45.0, 47.0, 50.0, 53.0, 55.0)):
            law: Any = choose_law(engine, "gain_scheduling", at)
            law = law if cancel else type(law)(gamma_n_m=law.gamma_n_m)
            loop = build_loop(engine, law)
            case = [abs(loop.steady(float(x), 0.0, 1000.0)[0]) for x in f]
            axes[panel].semilogy(f, case, color=SHADES[2 * k], label=f"tuned to {at:g} Hz", linewidth=1.2)
        axes[panel].axhline(LIMIT_M, color=LIMIT, linestyle="--", linewidth=1, label="20 µm")
        axes[panel].set_ylim(1e-8, 1e-1)
        dress(axes[panel], "frequency [Hz]", "case displacement [m]", title)


def _lq(axes: list[Axes]) -> None:
    f = np.linspace(1.0, 100.0, 2500)
    passive = build_loop(mechanical(preset("engine")), None)
    for loop, colour, label in ((passive, PASSIVE, "passive"), (lq_loop(), CONTROLLED, "LQ, Table 6-2")):
        axes[0].semilogy(
            f, [abs(loop.steady(float(x), 0.0, 1000.0)[0]) for x in f], color=colour, label=label
        )
    axes[0].axhline(LIMIT_M, color=LIMIT, linestyle="--", linewidth=1, label="20 µm")
    axes[0].axvspan(45.0, 55.0, color=CONTROLLED, alpha=0.07)
    dress(axes[0], "frequency [Hz]", "case displacement [m]", "1000 N, no delay")


def _requirements(axes: list[Axes]) -> None:
    laws: tuple[tuple[Controller, str, str], ...] = (
        ("passive", PASSIVE, "no control"),
        ("gain_scheduling", CONTROLLED, "gain scheduling"),
        ("lq", SECOND, "LQ, Table 6-2"),
    )
    for name, colour, label in laws:
        points = [point("engine", name, f, 1000.0) for f in FINE_HZ]
        if name != "gain_scheduling":
            axes[0].semilogy(
                FINE_HZ, values(points, "primary_displacement_m", 1e6), color=colour, label=label
            )
        axes[1].plot(FINE_HZ, [1e3 * min(p.stroke_m, 3e-3) for p in points], color=colour, label=label)
        axes[2].plot(FINE_HZ, values(points, "actuator_force_n"), color=colour, label=label)
    axes[0].axhline(1e6 * LIMIT_M, color=LIMIT, linestyle="--", linewidth=1, label="limit 20 µm")
    axes[0].plot([], [], color=CONTROLLED, label="gain scheduling: none left")
    dress(axes[0], "excitation [Hz]", "case [µm]", "case")
    dress(axes[1], "excitation [Hz]", "stroke [mm]", "stroke (cut at 3 mm)")
    dress(axes[2], "excitation [Hz]", "force [N]", "actuator force")


def _taylor(axes: list[Axes]) -> None:
    t = np.linspace(0.0, 0.2, 500)
    x = 2.0 * np.pi * t
    second = np.abs(np.exp(-1j * x) - (1.0 - 1j * x - 0.5 * x * x))
    axes[0].plot(100.0 * t, 100.0 * taylor_error(t), color=CONTROLLED, label="first order, 1 - sτ")
    axes[0].plot(100.0 * t, 100.0 * second, color=SECOND, label="second order")
    axes[0].axhline(10.0, color=LIMIT, linestyle="--", linewidth=1, label="10 %")
    axes[0].set_ylim(0.0, 60.0)
    dress(axes[0], "delay [% of the period]", "error [%]")


def growth_against_delay(axes: Axes, plant: str, feedback: Feedback, longest_s: float, title: str) -> None:
    """Largest real part of the poles against the delay, one curve per excitation frequency."""
    delays = np.linspace(1e-6, longest_s, 50)
    for f, colour in zip(BAND_HZ, SHADES, strict=False):
        loop = force_loop(plant, f, feedback)
        growth = [growth_rate_1_s(loop, float(d)) for d in delays]
        axes.plot(1e3 * delays, growth, color=colour, label=f"{f:g} Hz", linewidth=1.3)
    axes.axhline(0.0, color="black", linewidth=0.8)
    dress(axes, "delay [ms]", "largest real part of a pole [1/s]", title, legend=False)
    axes.legend(fontsize=7, ncols=2, frameon=True, framealpha=0.9, edgecolor="#e0e4e7")


def _growth(axes: list[Axes]) -> None:
    growth_against_delay(axes[0], "engine", "position", 0.5e-3, "position and velocity feedback")
    growth_against_delay(axes[1], "engine", "acceleration", 0.5e-3, "acceleration and velocity feedback")


def _margins(axes: list[Axes]) -> None:
    above = np.arange(50.25, 55.01, 0.25)
    for plant, colour in (("engine", CONTROLLED), ("rig", SECOND)):
        margin = [delay_margin_s(force_loop(plant, float(f))) or np.nan for f in above]
        axes[0].semilogy(above, 1e3 * np.array(margin), color=colour, marker=".", label=plant)
    axes[0].axhline(0.03, color=LIMIT, linestyle="--", linewidth=1, label="rig's own 30 µs")
    axes[0].axvspan(45.0, 50.0, color=THIRD, alpha=0.1)
    axes[0].annotate("any delay\nbelow 8 ms", (47.5, 0.1), ha="center", fontsize=9, color=THIRD)
    axes[0].set_xlim(45.0, 55.2)
    axes[0].set_yticks([0.02, 0.05, 0.1, 0.2, 0.5], ["0.02", "0.05", "0.1", "0.2", "0.5"])
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    dress(axes[0], "excitation [Hz]", "delay margin [ms]", "exact, position and velocity feedback, β = -c₂")


def _invented(axes: list[Axes]) -> None:
    delays = np.geomspace(1e-6, 1e-3, 60)
    loop = force_loop("engine", 47.0, "acceleration")
    axes[0].loglog(
        1e3 * delays,
        [taylor_poles(loop, float(d)).real.max() for d in delays],
        color=LIMIT,
        label="1 - sτ: largest real part",
    )
    exact = [-growth_rate_1_s(loop, float(d)) for d in delays]
    axes[0].loglog(1e3 * delays, exact, color=CONTROLLED, label="exact: decay rate (stable)")
    dress(axes[0], "delay [ms]", "rate [1/s]", "acceleration feedback at 47 Hz")


def _lq_delay(axes: list[Axes]) -> None:
    delays = np.geomspace(1e-8, 2e-3, 80)
    loop = lq_loop()
    axes[0].semilogx(
        delays,
        np.sign([growth_rate_1_s(loop, float(d)) for d in delays]),
        color=CONTROLLED,
        label="exact delay",
    )
    axes[0].semilogx(
        delays,
        0.94 * np.sign([taylor_poles(loop, float(d)).real.max() for d in delays]),
        color=SECOND,
        label="1 - sτ",
        linestyle="--",
    )
    axes[0].axvline(1.19e-3, color=LIMIT, linestyle=":", label="thesis: 1.19 ms")
    axes[0].set_yticks([-1, 1], ["stable", "unstable"])
    axes[0].set_ylim(-1.4, 1.4)
    dress(axes[0], "delay [s]", "", "LQ with the weights of Table 6-2")


DRAWINGS = (
    Drawing(
        "gains", "Gains that move the absorber's resonance", "Figure 6-3, eq. 6-5",
        "Position and acceleration gain for the engine against the excitation; both vanish at 50 Hz, where "
        "the absorber is tuned.", _gains,
        ("engine.alpha_45hz_kg", "engine.alpha_49hz_kg", "engine.alpha_52hz_kg"), 2,
    ),
    Drawing(
        "tracking", "The zero follows the excitation", "Figures 6-5, 6-6, 11-4, 11-6",
        "Response of the case with the gains of five excitations. The notch lies at the excitation and "
        "takes the upper resonance along; with the absorber's damping cancelled it goes all the way down.",
        _tracking, ("engine.gain_scheduling_below_20um", "engine.acceleration_below_20um"), 2,
    ),
    Drawing(
        "lq", "LQ control of the engine", "Figures 6-10, 6-11",
        "State feedback with the weights of Table 6-2 flattens both resonances and keeps the case below 20 "
        "µm from 45 to 55 Hz, as long as nothing is late.", _lq, ("engine.lq_below_20um",),
    ),
    Drawing(
        "requirements", "What active damping asks for", "Figures 6-12, 6-13",
        "Steady state against the excitation for 1000 N. The two laws ask for much the same force; without "
        "control the stroke leaves the picture.", _requirements,
        ("engine.gain_scheduling_below_20um", "engine.lq_below_20um", "engine.transient_45hz_s"), 3,
    ),
    Drawing(
        "taylor", "Error of a Taylor series for a delay", "Figure 6-21",
        "The first-order form is 10 % wrong at a delay of 7.1 % of the period, the second-order form at "
        "13.5 %.", _taylor, ("delay.taylor_first_order_10_percent", "delay.taylor_second_order_10_percent"),
    ),
    Drawing(
        "delay_engine", "Delay destabilises above the tuning", "Figures 6-22, 6-30",
        "Largest real part of the engine's closed-loop poles, the delay exact. Below 50 Hz every curve "
        "stays under zero; above it crosses after tens of microseconds. With acceleration feedback the "
        "picture is the same: the thesis had to leave a pole out to see it.", _growth,
        (
            "engine.position_stable_below_50hz", "engine.acceleration_stable_below_50hz",
            "engine.acceleration_unstable_from_hz",
        ),
        2,
    ),
    Drawing(
        "delay_margin", "Delay margin against the excitation", "Figures 6-22, 7-14",
        "The least delay that destabilises. Sampling, converter and hold of the rig, 30 µs, are more than "
        "it tolerates at 53 Hz with an ideal force and no damping left; the shaker's own damping helps the "
        "real rig out.", _margins,
        ("engine.delay_margin_51hz_s", "engine.delay_margin_53hz_s", "rig.delay_margin_53hz_s"),
    ),
    Drawing(
        "invented_pole", "The pole that 1 - sτ invents", "Figures 6-25 to 6-29",
        "Acceleration feedback at 47 Hz. The first-order form has an unstable pole at about (1 - 1/d)/τ for "
        "every delay; the loop itself is stable.", _invented,
        ("engine.taylor_unstable_below_50hz", "engine.acceleration_stable_below_50hz"),
    ),
    Drawing(
        "delay_lq", "LQ control and delay", "Figures 6-32, 6-33",
        "With the printed weights the loop tolerates 0.65 µs, not the 1.19 ms of the text; those weights "
        "cannot be the ones behind the thesis's plot.", _lq_delay, ("engine.lq_delay_margin_s",),
    ),
)  # fmt: skip
