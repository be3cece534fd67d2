"""Figures of chapter 6: gains, stability bounds, LQ, noise and delay on the engine."""

import itertools
import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

from twin.control.analysis import Controller, choose_law
from twin.control.continuous import build_loop
from twin.control.delay import growth_rate_1_s, taylor_error, taylor_poles
from twin.control.laws import Feedback, Law, scheduled_law, scheduled_mass
from twin.control.margins import delay_margin_s
from twin.control.routh import characteristic_polynomial, gain_bounds, is_hurwitz
from twin.station.validation.chapters_3_to_5 import LIMIT_M, SCAN
from twin.station.validation.models import (
    BAND_HZ,
    absorber_of,
    force_loop,
    lq_loop,
    mechanical,
    point,
    preset,
)
from twin.station.validation.rows import ABOUT, Figure, Tolerance, digits

PRINTED_ALPHA = {
    45: 2.0787,
    46: 1.6082,
    47: 1.1674,
    48: 0.7533,
    49: 0.3654,
    51: -0.3441,
    52: -0.6685,
    53: -0.9743,
}
SHORT_S = 0.1e-3
DOUBTFUL = Tolerance(1e-3, "the last digit is doubtful in the scan")


def _alpha(f: float) -> Callable[[], float]:
    return lambda: scheduled_mass(absorber_of(preset("engine")).mass_kg, 50.0, f)


def _margin(f: float) -> Callable[[], float]:
    def compute() -> float:
        found = delay_margin_s(force_loop("engine", f))
        return math.inf if found is None else found

    return compute


def _bound(gain: str) -> Callable[[], float]:
    """Least value of one gain, the others zero, that leaves the engine stable, by halving (eq. 6-4)."""

    def compute() -> float:
        engine = preset("engine")
        bounds = gain_bounds(engine)
        stable = 0.0
        unstable = 20.0 * getattr(bounds, gain)
        for _ in range(100):
            middle = 0.5 * (stable + unstable)
            if is_hurwitz(characteristic_polynomial(engine, Law(**{gain: middle}))):
                stable = middle
            else:
                unstable = middle
        return stable

    return compute


def _absolute_bounds_suffice() -> bool:
    """Whether gains above the bounds of 6.2.3 are stable with absolute measurement, primary undamped, on a grid."""
    engine = preset("engine").with_damping("case", 0.0)
    bounds = gain_bounds(engine)
    shares = (0.9, 0.5, 0.0, -0.5)
    laws = (
        Law(a * bounds.alpha_kg, b * bounds.beta_ns_m, c * bounds.gamma_n_m, "absolute")
        for a, b, c in itertools.product(shares, shares, shares)
    )
    return all(is_hurwitz(characteristic_polynomial(engine, law)) for law in laws)


def _absolute_is_quiet() -> bool:
    """Whether absolute feedback leaves the case as quiet as relative feedback, from 45 to 55 Hz."""
    engine = mechanical(preset("engine"))
    quiet = [
        abs(
            build_loop(engine, choose_law(engine, "gain_scheduling", f, "position", "absolute")).steady(
                f, 0.0, 1e3
            )[0]
        )
        for f in BAND_HZ
    ]
    return bool(max(quiet) < 1e-9)


def _below_limit(controller: Controller, feedback: Feedback = "position") -> Callable[[], bool]:
    return lambda: all(
        point("engine", controller, f, 1000.0, feedback).primary_displacement_m < LIMIT_M for f in BAND_HZ
    )


def _time_constant_45hz() -> float:
    return float(-1.0 / force_loop("engine", 45.0).closed_poles.real.max())


def _error_ten_percent(order: int) -> float:
    """Delay over period at which a Taylor form of e^(-j 2 pi t) is 10 % wrong (eq. 6-22)."""

    def error(t: float) -> float:
        if order == 1:
            return float(taylor_error(t))
        x = 2.0 * math.pi * t
        return float(abs(np.exp(-1j * x) - (1.0 - 1j * x - 0.5 * x * x)))

    return float(brentq(lambda t: error(t) - 0.1, 1e-3, 0.2))


def _first_unstable_hz(feedback: Feedback, delay_s: float) -> float:
    for f in BAND_HZ:
        if growth_rate_1_s(force_loop("engine", f, feedback), delay_s) > 0.0:
            return f
    return math.inf


def _taylor_unstable_below_50() -> bool:
    loops = [force_loop("engine", f, "acceleration") for f in BAND_HZ if f < 50.0]
    return all(bool(taylor_poles(loop, SHORT_S).real.max() > 0.0) for loop in loops)


def _exact_stable_below_50() -> bool:
    loops = [force_loop("engine", f, "acceleration") for f in BAND_HZ if f < 50.0]
    return all(growth_rate_1_s(loop, SHORT_S) < 0.0 for loop in loops)


def _position_stable_below_50() -> bool:
    loops = [force_loop("engine", f) for f in BAND_HZ if f < 50.0]
    return all(growth_rate_1_s(loop, d) < 0.0 for loop in loops for d in np.linspace(0.05e-3, 0.5e-3, 10))


def _margin_row(f: float) -> Figure:
    return Figure(
        f"engine.delay_margin_{f:g}hz_s", "6.10.1.1, Figure 6-22", "s", None, _margin(f), None,
        f"Position and velocity feedback, beta = -c2, ideal force; exact delay. {SCAN}",
    )  # fmt: skip


FIGURES = (
    *(
        Figure(
            f"engine.alpha_{f}hz_kg", "eq. 6-5, Figure 11-17", "kg", value, _alpha(f), DOUBTFUL,
            "Acceleration gain that moves the absorber there; printed in the legend of the appendix's "
            "figure.",
        )
        for f, value in PRINTED_ALPHA.items()
    ),
    Figure(
        "engine.alpha_54hz_kg", "eq. 6-5, Figure 11-17", "kg", -1.2842, _alpha(54), digits(1.2842, 0.0001),
        "The digit is doubtful in the scan: the formula gives -1.2643, and 6 and 8 look alike there.",
        comparable=False,
    ),
    Figure(
        "engine.alpha_55hz_kg", "eq. 6-5, Figures 6-3, 11-17", "kg", None, _alpha(55), None,
        "Unreadable in the scan.",
    ),
    Figure(
        "engine.gamma_45hz_n_m", "eq. 6-5, Figure 6-3", "N/m", None,
        lambda: scheduled_law(absorber_of(preset("engine")), 45.0).gamma_n_m, None, SCAN,
    ),
    Figure(
        "engine.gamma_55hz_n_m", "eq. 6-5, Figure 6-3", "N/m", None,
        lambda: scheduled_law(absorber_of(preset("engine")), 55.0).gamma_n_m, None, SCAN,
    ),
    Figure(
        "engine.alpha_bound_kg", "6.2.3", "kg", -8.862, _bound("alpha_kg"), digits(8.862, 0.001),
        "The thesis simplifies by m1 >> m2. With relative acceleration feedback the loop is unstable from "
        "-m1 m2/(m1 + m2) = -7.299 kg down, as the condition before the simplification says; -m2 is too low.",
    ),
    Figure(
        "engine.beta_bound_ns_m", "6.2.3", "Ns/m", -2.7, _bound("beta_ns_m"), digits(2.7, 0.1),
        "-c2 is safe but not the bound: the engine's own c1 carries the loop down to -8.94 Ns/m.",
    ),
    Figure("engine.gamma_bound_n_m", "6.2.3", "N/m", -874640.0, _bound("gamma_n_m"), digits(874640.0, 1.0)),
    Figure(
        "engine.absolute_bounds_suffice", "6.2.3, 6.2.2", "true/false", True, _absolute_bounds_suffice, None,
        "The thesis carries the three bounds over to absolute measurement. On the engine with its c1 they "
        "hold; on an undamped primary a position gain above m2 k1/(m1 + m2), well inside them, drives the "
        "slow mode.",
    ),
    Figure(
        "engine.absolute_keeps_the_zero", "6.2.2, eq. 6-6", "true/false", True, _absolute_is_quiet, None,
        "Absolute feedback leaves the case as quiet as relative feedback, 45 to 55 Hz.",
    ),
    Figure(
        "engine.gain_scheduling_below_20um", "6.8, Figure 6-12", "true/false", True,
        _below_limit("gain_scheduling"), None,
        "1000 N, position feedback, beta = -c2, ideal force, 45 to 55 Hz.",
    ),
    Figure(
        "engine.acceleration_below_20um", "6.3, Figure 6-6", "true/false", True,
        _below_limit("gain_scheduling", "acceleration"), None,
    ),
    Figure(
        "engine.lq_below_20um", "6.4.3, Figure 6-10", "true/false", True, _below_limit("lq"), None,
        "Weights of Table 6-2 on the plant's states, no delay: 13.7 µm at 45 Hz, 9.2 µm at 55 Hz.",
    ),
    Figure(
        "engine.transient_45hz_s", "6.8, Figure 6-12", "s", 2.0, _time_constant_45hz, ABOUT,
        "Time constant of the slowest closed-loop pole; the text gives no definition of its two seconds.",
    ),
    Figure(
        "engine.actuator_force_45hz_n", "6.8, Figure 6-12", "N", None,
        lambda: point("engine", "gain_scheduling", 45.0, 1000.0).actuator_force_n, None, SCAN,
    ),
    Figure(
        "engine.actuator_force_55hz_n", "6.8, Figure 6-12", "N", None,
        lambda: point("engine", "gain_scheduling", 55.0, 1000.0).actuator_force_n, None, SCAN,
    ),
    Figure(
        "noise.within_three_sigma", "6.9.1, Figure 6-15", "1", 0.999, lambda: math.erf(3.0 / math.sqrt(2.0)),
        digits(0.999, 0.001),
        "Three standard deviations of a Gaussian hold 99.73 %, not 99.9 %.",
    ),
    Figure(
        "noise.force", "6.9, Figures 6-16 to 6-19", "N", None, None, None,
        "The thesis gives variances without the sample time of its noise blocks, on which the force depends.",
    ),
    Figure(
        "delay.taylor_first_order_10_percent", "6.10, Figure 6-21", "1", 0.06, lambda: _error_ten_percent(1),
        digits(0.06, 0.01),
        "Delay over period at 10 % error. Eq. 6-22 gives 7.1 %; at 6 % the error is 7.1 %: the two were "
        "mixed up.",
    ),
    Figure(
        "delay.taylor_second_order_10_percent", "6.10, Figure 6-21", "1", 0.15, lambda: _error_ten_percent(2),
        digits(0.15, 0.01), "13.5 %.",
    ),
    Figure(
        "engine.position_stable_below_50hz", "6.10.1.1, Figure 6-22", "true/false", True,
        _position_stable_below_50, None,
        "For every delay up to 0.5 ms; in fact for any below 8 ms.",
    ),
    _margin_row(51.0),
    _margin_row(52.0),
    _margin_row(53.0),
    _margin_row(54.0),
    _margin_row(55.0),
    Figure(
        "engine.taylor_unstable_below_50hz", "6.10.1.2, Figure 6-25", "true/false", True,
        _taylor_unstable_below_50, None,
        "The first-order Taylor form, as the thesis used it.",
    ),
    Figure(
        "engine.acceleration_stable_below_50hz", "6.10.1.2, Figure 6-27", "true/false", True,
        _exact_stable_below_50, None,
        "The exact delay of 0.1 ms: the instability was the Taylor form's own, as the thesis found.",
    ),
    Figure(
        "engine.acceleration_unstable_from_hz", "6.10.1.2, Figure 6-27", "Hz", 53.0,
        lambda: _first_unstable_hz("acceleration", SHORT_S), digits(53.0, 1.0),
        "Delay 0.1 ms, acceleration and velocity feedback. The poles are unstable from 52 Hz (margin 0.071 "
        "ms), but in the five seconds that the thesis stays there the amplitude grows 2.6-fold, at 53 Hz "
        "17-fold.",
    ),
    Figure(
        "engine.lq_delay_margin_s", "6.10.2, Figures 6-32, 6-33", "s", 1.19e-3,
        lambda: delay_margin_s(lq_loop()) or 0.0, Tolerance(0.005, "the digits that are printed"),
        "The thesis is wrong or used other weights: with those of Table 6-2 the gain is 5e8 N/m and the "
        "loop tolerates 0.65 µs. Claims that LQ tolerates more delay than gain scheduling rest on this "
        "figure.",
    ),
    Figure(
        "engine.lq_gain_n_m", "6.4.3, Table 6-2", "N/m", None,
        lambda: float(np.abs(np.asarray(choose_law(preset("engine"), "lq", 50.0)))[0]), None,
        "Gain on the case's displacement; the thesis does not print K.",
    ),
)  # fmt: skip
