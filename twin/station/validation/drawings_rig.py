"""Figures of chapters 7 and 8, redrawn: the rig, its filters, its four tests, and the engine with a coil."""

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes

from twin.control.filters import (
    Cutoffs,
    high_pass_phase,
    low_pass_phase,
    paired_low_pass_hz,
    position_path_phase,
)
from twin.plant.linear import linear_model
from twin.plant.semi_active import shunted
from twin.rig.tests_of_chapter_7 import DAMPING_FIT, TestName
from twin.station.validation.canvas import (
    CONTROLLED,
    LIMIT,
    PASSIVE,
    SECOND,
    THESIS,
    THIRD,
    Drawing,
    dress,
    values,
)
from twin.station.validation.chapter_7 import rig_point
from twin.station.validation.chapters_3_to_5 import LIMIT_M
from twin.station.validation.drawings_control import FINE_HZ, growth_against_delay
from twin.station.validation.models import attenuation, point, preset, quiet_beta, sweep


def _rig(axes: list[Axes]) -> None:
    f = np.geomspace(5.0, 100.0, 3000)
    rig = preset("rig")
    cases = (
        (linear_model(preset("rig_no_vcm")), PASSIVE, "without coil"),
        (linear_model(rig, current_driven=("vcm",)), CONTROLLED, "coil open, c₂ = 7"),
        (linear_model(shunted(rig, 0.0)), SECOND, "coil shorted"),
    )
    for model, colour, label in cases:
        shaker = model.inputs.index("shaker")
        table, absorber, current = (
            model.response(f)[:, model.outputs.index(name), shaker]
            for name in ("table_acceleration", "absorber_acceleration", "shaker_current")
        )
        axes[0].loglog(f, 3.0 * np.abs(table) / (2.0 * np.pi * f) ** 2, color=colour, label=label)
        axes[1].loglog(f, np.abs(absorber / table), color=colour, label=label)
        axes[2].plot(f, 3.0 * 11.1 * np.abs(current), color=colour, label=label)
    dress(axes[0], "frequency [Hz]", "table displacement [m]", "table, shaker at 3 V")
    dress(axes[1], "frequency [Hz]", "|absorber / table|", "transmissibility")
    dress(axes[2], "frequency [Hz]", "shaker force [N]", "shaker force: least at the resonances")


def _rig_requirements(axes: list[Axes]) -> None:
    points = [rig_point(f) for f in FINE_HZ]
    axes[0].plot(FINE_HZ, values(points, "current_a"), color=CONTROLLED, label="current [A]")
    axes[0].plot(FINE_HZ, values(points, "joule_peak_w"), color=LIMIT, label="R i_peak² [W]")
    axes[0].plot(FINE_HZ, values(points, "stroke_m", 1e3), color=THIRD, label="stroke [mm]")
    dress(axes[0], "excitation [Hz]", "peak", "rig under gain scheduling, shaker at 3 V")


def _rig_delay(axes: list[Axes]) -> None:
    growth_against_delay(axes[0], "rig", "position", 0.2e-3, "absorber tuned at 50 Hz")
    growth_against_delay(axes[1], "rig_55_hz", "position", 0.2e-3, "absorber tuned at 55 Hz")


def _filters(axes: list[Axes]) -> None:
    f = np.geomspace(5.0, 500.0, 800)
    axes[0].semilogx(
        f, [np.degrees(low_pass_phase(float(x), 200.0)) for x in f], color=CONTROLLED, label="low-pass 200 Hz"
    )
    axes[0].semilogx(
        f, [np.degrees(high_pass_phase(float(x), 1.0)) for x in f], color=SECOND, label="high-pass 1 Hz"
    )
    axes[0].axvspan(45.0, 55.0, color=CONTROLLED, alpha=0.1)
    dress(axes[0], "frequency [Hz]", "phase [°]", "one filter each")
    fixed = [np.degrees(position_path_phase(x, Cutoffs(200.0, 1.0))) for x in FINE_HZ]
    paired = [np.degrees(position_path_phase(x, Cutoffs(paired_low_pass_hz(x, 2.5), 2.5))) for x in FINE_HZ]
    axes[1].plot(FINE_HZ, fixed, color=LIMIT, label="position path, Tests 1 and 2")
    axes[1].plot(FINE_HZ, paired, color=THIRD, label="position path, Tests 3 and 4")
    axes[1].axhline(0.0, color=PASSIVE, linestyle="--", label="velocity path, Tests 3 and 4")
    dress(axes[1], "excitation [Hz]", "phase error [°]", "whole chain")


def _test(axes: list[Axes], test: TestName) -> None:
    run, passive = sweep(test), sweep("test1", False)
    axes[0].plot(passive[:, 0], passive[:, 1], color=PASSIVE, label="passive, tuned at 50 Hz")
    axes[0].plot(run[:, 0], run[:, 1], color=LIMIT if test == "test1" else CONTROLLED, label="active")
    axes[0].axvspan(45.0, 55.0, color=CONTROLLED, alpha=0.06)
    dress(axes[0], "excitation [Hz]", "table acceleration [m/s²]", "table")
    axes[1].plot(run[:, 0], run[:, 2], color=PASSIVE, label="reference")
    axes[1].plot(run[:, 0], run[:, 3], color=CONTROLLED, linestyle="--", label="coil")
    axes[1].axhline(2.0, color=LIMIT, linestyle=":", linewidth=1, label="amplifier's 2 A")
    axes[1].set_ylim(0.0, 2.4)
    dress(axes[1], "excitation [Hz]", "peak current [A]", "coil current")
    axes[2].plot(run[:, 0], 2.0 * run[:, 5], color=LIMIT, label="R i_peak² (as the thesis)")
    axes[2].plot(run[:, 0], run[:, 5], color=SECOND, label="R i_rms²")
    dress(axes[2], "excitation [Hz]", "power [W]", "coil power")
    for panel in axes:
        panel.set_xticks(range(40, 61, 5))


def _draw_test(test: TestName) -> Callable[[list[Axes]], None]:
    return lambda axes: _test(axes, test)


def _damping(axes: list[Axes]) -> None:
    f = np.arange(45.0, 55.01, 0.5)
    axes[0].plot(f, np.polyval(DAMPING_FIT, f), color=THESIS, label="thesis's fit, found by turning β")
    axes[0].plot(
        f,
        [quiet_beta(float(x)) for x in f],
        color=CONTROLLED,
        marker=".",
        label="β that quiets the model, coil 7 Ns/m",
    )
    axes[0].axhline(7.0, color=THIRD, linestyle="--", label="what the coil does in that model")
    axes[0].set_ylim(0.0, 26.0)
    dress(axes[0], "excitation [Hz]", "-β [Ns/m]")


def _attenuations(axes: list[Axes]) -> None:
    tests: tuple[tuple[TestName, str], ...] = (
        ("test1", LIMIT),
        ("test2", SECOND),
        ("test3", CONTROLLED),
        ("test4", THIRD),
    )
    for test, colour in tests:
        style = "--" if test == "test4" else "-"
        axes[0].plot(
            FINE_HZ,
            [100.0 * attenuation(test, f) for f in FINE_HZ],
            style,
            color=colour,
            label=f"Test {test[-1]}",
        )
    axes[0].axhline(88.0, color=THESIS, linestyle=":", label="thesis: 88 % in Test 2")
    axes[0].axvspan(51.7, 55.0, color=LIMIT, alpha=0.08)
    axes[0].annotate("Test 1 unstable", (53.3, 4.0), ha="center", fontsize=8, color=LIMIT)
    dress(
        axes[0], "excitation [Hz]", "attenuation [%]", "steady state, against the passive rig tuned at 50 Hz"
    )


def _engine_coil(axes: list[Axes]) -> None:
    for force, colour in ((1000.0, CONTROLLED), (3000.0, SECOND)):
        points = [point("engine_vcm", "gain_scheduling", f, force) for f in FINE_HZ]
        label = f"{force:g} N"
        axes[0].plot(FINE_HZ, values(points, "primary_displacement_m", 1e6), color=colour, label=label)
        axes[1].plot(FINE_HZ, values(points, "current_a"), color=colour, label=label)
        axes[2].plot(FINE_HZ, values(points, "voltage_v"), color=colour, label=label)
    axes[0].axhline(1e6 * LIMIT_M, color=LIMIT, linestyle="--", linewidth=1, label="limit 20 µm")
    dress(axes[0], "excitation [Hz]", "case [µm]", "case")
    dress(axes[1], "excitation [Hz]", "peak current [A]", "coil current")
    dress(axes[2], "excitation [Hz]", "peak voltage [V]", "coil voltage")


def _power(axes: list[Axes]) -> None:
    sets = (
        ("engine_vcm", 1000.0, "k = 22.2 N/A, 1000 N"),
        ("engine_vcm", 3000.0, "k = 22.2 N/A, 3000 N"),
        ("engine_vcm_large", 3000.0, "k = 51.6 N/A, 3000 N"),
    )
    for panel, (plant, force, title) in enumerate(sets):
        points = [point(plant, "gain_scheduling", f, force) for f in FINE_HZ]
        axes[panel].plot(
            FINE_HZ, values(points, "joule_peak_w"), color=LIMIT, label="R i_peak² (as the thesis)"
        )
        axes[panel].plot(FINE_HZ, values(points, "joule_mean_w"), color=SECOND, label="R i_rms²")
        axes[panel].plot(
            FINE_HZ,
            values(points, "electrical_mean_w"),
            color=CONTROLLED,
            linestyle="--",
            label="mean of v i",
        )
        axes[panel].axvspan(47.0, 53.0, color=PASSIVE, alpha=0.1)
        budget = 100.0 if panel < 2 else 120.0
        axes[panel].axhline(
            budget, color="black", linestyle=":", linewidth=1, label=f"a tenth of the engine: {budget:g} W"
        )
        dress(axes[panel], "excitation [Hz]", "power [W]", title)


_TEST_CAPTION = (
    "Simulated minute from 40 to 60 Hz at 4 V, control on between 45 and 55 Hz (shaded); the coil damps as the "
    "thesis's fit says. "
)

DRAWINGS = (
    Drawing(
        "rig",
        "The rig without coil, with an open and with a shorted one", "Figures 7-4, 7-7 to 7-11",
        "Table 7-1 and Table 7-3 with the shaker at 3 V. Short-circuited, the coil damps by k²/R and, by "
        "its inductance, stiffens the absorber a little: the notch moves up. The thesis lays this to an "
        "added mass, which would move it down.", _rig,
        (
            "rig_no_vcm.mode1_hz", "rig_no_vcm.mode2_hz", "rig.mode1_hz",
            "rig.mode2_hz", "rig.shorted_damping_ns_m",
        ),
        3,
    ),
    Drawing(
        "rig_requirements", "What the rig's coil has to do", "Figure 7-13",
        "Steady state of the model that the thesis steps through from 45 to 55 Hz: most at 45 Hz, least at "
        "50 Hz, more again above.", _rig_requirements, ("rig.most_power_hz", "rig.least_power_hz"),
    ),
    Drawing(
        "rig_delay",
        "Delay on the rig, and the absorber tuned higher", "Figures 7-14, 7-16",
        "Poles of the rig with position and velocity feedback against the delay, ideal force. Tuned at 55 "
        "Hz the band up to 54 Hz is safe.", _rig_delay,
        ("rig.stable_below_50hz", "rig.tuned_at_55hz_stable", "rig.delay_margin_53hz_s"), 2,
    ),
    Drawing(
        "filters", "Phase of the filters", "Figures 7-28, 7-29, eq. 7-14",
        "A 200 Hz low-pass lags by 18.5 to 22.8° over the band, which is more than a millisecond. The "
        "pairing of Test 3 nulls the velocity path; the position path keeps the lead of its second "
        "high-pass.", _filters,
        (
            "filter.low_pass_phase_45hz_deg", "filter.low_pass_phase_55hz_deg",
            "filter.high_pass_phase_45hz_deg", "filter.pairing_nulls_position",
        ),
        2,
    ),
    Drawing(
        "test1", "Test 1: filters of 200 and 1 Hz", "Figures 7-20 to 7-22",
        _TEST_CAPTION + "The loop is unstable from 51.7 Hz and the amplifier at its limit from 52.7 Hz.",
        _draw_test("test1"),
        ("test1.first_unstable_hz", "test1.saturates_hz", "test1.current_45hz_a", "test1.joule_peak_45hz_w"),
        3,
    ),
    Drawing(
        "damping", "What the thesis's c₂(f) is made of", "Figure 7-23",
        "Turning β until the table is quiet finds coil damping plus what filter phase makes of the position "
        "gain. A model whose coil damps with 7 Ns/m throughout gives a curve of the same kind.", _damping,
        ("test2.quiet_beta_45hz_ns_m", "test2.quiet_beta_50hz_ns_m", "test2.quiet_beta_55hz_ns_m"),
    ),
    Drawing(
        "test2", "Test 2: absorber tuned at 55 Hz", "Figures 7-24 to 7-27",
        _TEST_CAPTION + "Stable throughout, and more current at 45 Hz than in Test 1. The model is not as quiet "
        "as the rig was: see the figure before.",
        _draw_test("test2"), ("test2.stable", "test2.mean_attenuation", "test2.more_current_than_test1"), 3,
    ),
    Drawing(
        "test3", "Test 3: paired cutoffs", "Figures 7-31 to 7-33",
        _TEST_CAPTION + "Back at 50 Hz, stable, quiet, and with less power than Test 2.", _draw_test("test3"),
        ("test3.stable", "test3.mean_attenuation", "test3.less_power_than_test2"), 3,
    ),
    Drawing(
        "test4",
        "Test 4: the absorber's accelerometer alone", "Figures 7-35 and following",
        _TEST_CAPTION + "Absolute feedback does as well as relative.", _draw_test("test4"),
        ("test4.stable", "test4.as_quiet_as_test3"), 3,
    ),
    Drawing(
        "attenuation", "Attenuation of the four tests", "7.9, 7.10",
        "Steady state of the rig's sampled model. An unstable loop has no steady state: what is drawn for "
        "Test 1 above 51.7 Hz is never reached.", _attenuations,
        ("test2.mean_attenuation", "test3.mean_attenuation", "test4.as_quiet_as_test3"),
    ),
    Drawing(
        "engine_coil", "The engine with a voice coil", "Figure 8-2",
        "Position and velocity feedback through a current loop of kp = 200. The case stays below 20 µm for "
        "1000 N.", _engine_coil, ("engine_vcm.below_20um", "engine_vcm.current_47hz_a"), 3,
    ),
    Drawing(
        "power", "Power against the excitation", "Figures 8-3, 8-4",
        "The thesis's power is R i_peak². The mean, which heats the coil and loads the engine, is half of "
        "it. A coil of more than twice the force constant takes less than a fifth.", _power,
        (
            "engine_vcm.joule_peak_47hz_w", "engine_vcm.joule_peak_47hz_3kn_w",
            "engine_vcm.power_ratio_3kn", "engine_vcm_large.joule_peak_47hz_3kn_w",
        ),
        3,
    ),
)  # fmt: skip
