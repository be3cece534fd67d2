"""Pictures of fits: data, model, what is left, and the bands that the errors allow."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from estimators.fits.added_mass import TAU, AddedMassFit
from estimators.fits.damper import DamperFit, DamperRecord
from estimators.fits.decay import DecayFit
from estimators.fits.frf import FrfFit
from estimators.fits.step import StepFit, StepPiece
from estimators.fits.transmissibility import TransmissibilityFit
from twin.plant.errors import InputError
from twin.plant.linear import Array, ComplexArray
from twin.station.validation.canvas import CONTROLLED, LIMIT, PASSIVE, SECOND, SHADES, dress

Draw = Callable[[Figure], None]
DATA, MODEL, OTHER, LEFT = PASSIVE, LIMIT, CONTROLLED, SECOND


def save_plot(draw: Draw, path: Path) -> None:
    """Draw into a .png or .svg file.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    figure = Figure(figsize=(10.4, 5.6), dpi=130, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    draw(figure)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise InputError(f"--plot {path}: cannot be written ({error.strerror or error})") from error


def added_mass_plot(added_kg: Array, hz: Array, fit: AddedMassFit) -> Draw:
    """Resonance against added mass, both fits, and the residuals."""

    def draw(figure: Figure) -> None:
        top, low = _two(figure)
        grid = np.linspace(added_kg.min() - 0.05 * np.ptp(added_kg), added_kg.max() * 1.05, 200)
        k, m = fit.stiffness_n_m.value, fit.mass_kg.value
        grid = grid[grid + m > 0.0]
        curve = np.sqrt(k / (m + grid)) / TAU
        slope = np.column_stack([curve / (2.0 * k), -curve / (2.0 * (m + grid))])
        half = fit.quantile * np.sqrt(np.einsum("ij,jk,ik->i", slope, fit.covariance, slope))
        top.fill_between(
            1e3 * grid, curve - half, curve + half, color=MODEL, alpha=0.2, label="95 % band", lw=0
        )
        top.plot(1e3 * grid, curve, color=MODEL, label=f"maximum likelihood: {k:.0f} N/m, {1e3 * m:.1f} g")
        k7, m7 = fit.printed_stiffness_n_m.value, fit.printed_mass_kg.value
        top.plot(
            1e3 * grid,
            np.sqrt(k7 / (m7 + grid)) / TAU,
            "--",
            color=OTHER,
            label=f"eq. 7-1: {k7:.0f} N/m, {1e3 * m7:.1f} g",
        )
        bars = fit.quantile * fit.frequency_std_hz
        top.errorbar(
            1e3 * added_kg, hz, bars, fmt="o", color="black", ms=4, lw=1, capsize=2, label="measured"
        )
        dress(top, "", "resonance [Hz]", "Resonance against added mass")
        low.errorbar(1e3 * added_kg, hz - fit.model_hz, bars, fmt="o", color="black", ms=4, lw=1, capsize=2)
        low.plot(1e3 * grid, np.sqrt(k7 / (m7 + grid)) / TAU - curve, "--", color=OTHER)
        low.axhline(0.0, color=MODEL, lw=1)
        dress(low, "added mass [g]", "measured - fit [Hz]", legend=False)

    return draw


def response_plot(f: Array, h: Array | ComplexArray, fit: TransmissibilityFit) -> Draw:
    """Transmissibility: magnitude, phase where there is one, residual."""

    def draw(figure: Figure) -> None:
        rows = 3 if np.iscomplexobj(h) else 2
        axes = figure.subplots(rows, 1, sharex=True, height_ratios=[3, 1.4, 1.2][:rows])
        m = fit.mode
        axes[0].semilogy(f, np.abs(h), ".", color=DATA, ms=4, label="measured")
        label = f"{m.frequency_hz:.6g} ± {m.frequency_std_hz:.1g} Hz, ζ {m.damping_ratio:.4g} ± {m.damping_std:.1g}"
        axes[0].semilogy(f, np.abs(fit.model), color=MODEL, lw=1.2, label=label)
        dress(axes[0], "", "transmissibility [-]", "Absorber over table (thesis eq. 5-4)")
        if rows == 3:
            axes[1].plot(f, np.degrees(np.angle(h)), ".", color=DATA, ms=3)
            axes[1].plot(f, np.degrees(np.angle(fit.model)), color=MODEL, lw=1.2)
            dress(axes[1], "", "phase [°]", legend=False)
        left = np.abs(h - fit.model) if rows == 3 else np.abs(np.abs(h) - np.abs(fit.model))
        axes[-1].semilogy(f, np.maximum(left, 1e-12), ".", color=LEFT, ms=3, label="|residual|")
        axes[-1].semilogy(f, fit.noise_std, color="black", lw=1, label="noise (std)")
        dress(axes[-1], "frequency [Hz]", "left over [-]")

    return draw


def frf_plot(f: Array, h: ComplexArray, fit: FrfFit, names: list[str], unit: str) -> Draw:
    """Responses with their model, the stabilisation diagram, and each mode close up."""

    def draw(figure: Figure) -> None:
        shown = sorted(fit.modes, key=lambda m: m.frequency_hz)[:6]
        grid = figure.add_gridspec(2, max(1, len(shown)), height_ratios=[1.5, 1.0])
        wide = figure.add_subplot(grid[0, :])
        for k, name in enumerate(names[:6]):
            colour = SHADES[(2 * k) % len(SHADES)]
            wide.semilogy(f, np.maximum(np.abs(h[:, k]), 1e-12), color=colour, lw=0.7, alpha=0.7, label=name)
            wide.semilogy(f, np.abs(fit.model[:, k]), color=MODEL, lw=1.0, ls="--")
        orders = wide.twinx()
        steady = fit.stabilisation.stable > 0.0
        orders.plot(
            fit.stabilisation.frequency_hz[steady],
            fit.stabilisation.order[steady],
            ".",
            color="#b0bec5",
            ms=2,
            zorder=0,
        )
        orders.set_ylabel("model order of stable poles", fontsize=8, color="#78909c")
        orders.spines["top"].set_visible(False)
        dress(wide, "frequency [Hz]", f"|response| {unit}", "Measured responses; fitted model dashed")
        for column, mode in enumerate(shown):
            axes = figure.add_subplot(grid[1, column])
            half = max(8.0 * float(np.median(np.diff(f))), 5.0 * mode.damping_ratio * mode.frequency_hz)
            near = np.abs(f - mode.frequency_hz) < half
            for k in range(min(6, h.shape[1])):
                axes.plot(f[near], np.abs(h[near, k]), ".", color=SHADES[(2 * k) % len(SHADES)], ms=4)
                axes.plot(f[near], np.abs(fit.model[near, k]), "--", color=MODEL, lw=1)
            std = fit.noise_std[near, 0]
            axes.fill_between(f[near], 0.0, std, color="#cfd8dc", lw=0)
            title = f"{mode.frequency_hz:.3f} ± {mode.frequency_std_hz:.1g} Hz\n"
            title += f"ζ {mode.damping_ratio:.5f} ± {mode.damping_std:.1g}"
            dress(axes, "frequency [Hz]", "|response|" if column == 0 else "", title, legend=False)

    return draw


def decay_plot(values: Array, rate_hz: float, fit: DecayFit, unit: str) -> Draw:
    """Record with its decays, the residual, and frequency and damping over amplitude."""

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 3, height_ratios=[1.0, 1.0])
        record, left = figure.add_subplot(grid[0, :2]), figure.add_subplot(grid[1, :2])
        t = np.arange(len(values)) / rate_hz
        record.plot(t, values, color=DATA, lw=0.5, label="measured")
        for k, (d, model) in enumerate(zip(fit.decays, fit.model, strict=True)):
            part = slice(d.first, d.end)
            record.plot(
                t[part],
                model,
                color=MODEL,
                lw=0.5,
                label="one exponential for all amplitudes" if k == 0 else None,
            )
            left.plot(t[part], values[part] - model, color=LEFT, lw=0.5)
        dress(record, "time [s]", f"signal [{unit}]", f"{len(fit.decays)} free decays found")
        dress(
            left,
            "time [s]",
            f"measured - model [{unit}]",
            "Residual of the model over all amplitudes",
            legend=False,
        )
        frequency, damping = figure.add_subplot(grid[0, 2]), figure.add_subplot(grid[1, 2])
        for axes, name, std, label in (
            (frequency, "frequency_hz", "frequency_std_hz", "frequency [Hz]"),
            (damping, "damping_ratio", "damping_std", "damping ratio [-]"),
        ):
            for band in fit.bands:
                y, s = getattr(band.mode, name), 1.96 * getattr(band.mode, std)
                axes.fill_between(
                    [band.amplitude_from, band.amplitude_to], y - s, y + s, color=MODEL, alpha=0.25, lw=0
                )
                axes.plot([band.amplitude_from, band.amplitude_to], [y, y], color=MODEL, lw=1.6)
            axes.set_xscale("log")
            dress(axes, f"amplitude [{unit}]", label, "By band of amplitude, ± 95 %", legend=False)

    return draw


def step_plot(pieces: list[StepPiece], rate_hz: float, fit: StepFit, unit: str) -> Draw:
    """First step with its model, all residuals, and the single results."""

    def draw(figure: Figure) -> None:
        grid = figure.add_gridspec(2, 3, height_ratios=[1.5, 1.0])
        top, low = figure.add_subplot(grid[0, :2]), figure.add_subplot(grid[1, :2])
        scale, prefix = _time_scale(max(len(p.output) for p in pieces) / rate_hz)
        for k, (p, model) in enumerate(zip(pieces, fit.model, strict=True)):
            t = scale * (np.arange(len(p.output)) - p.edge) / rate_hz
            if k < 2:
                top.plot(t, p.output, ".", color=DATA, ms=2.5, label="measured" if k == 0 else None)
                top.plot(t, model, color=MODEL, lw=1.0, label=f"fit ({fit.method})" if k == 0 else None)
            low.plot(t, p.output - model, color=SHADES[k % len(SHADES)], lw=0.5)
        dress(
            top,
            f"time after the edge [{prefix}s]",
            f"output [{unit}]",
            f"First {min(2, len(pieces))} of {len(pieces)} steps",
        )
        dress(
            low,
            f"time after the edge [{prefix}s]",
            f"residual [{unit}]",
            "What is left, all steps",
            legend=False,
        )
        each = figure.add_subplot(grid[:, 2])
        hz = np.array([m.frequency_hz for m in fit.each])
        zeta = np.array([m.damping_ratio for m in fit.each])
        each.errorbar(
            hz, zeta, 1.96 * np.array([m.damping_std for m in fit.each]),
            1.96 * np.array([m.frequency_std_hz for m in fit.each]), fmt="o", color=OTHER, ms=3, lw=0.8,
            label="single steps",
        )  # fmt: skip
        m = fit.mode
        each.errorbar(
            [m.frequency_hz], [m.damping_ratio], [1.96 * m.damping_std], [1.96 * m.frequency_std_hz],
            fmt="s", color=MODEL, ms=5, lw=2, label="all steps, ± 95 %",
        )  # fmt: skip
        each.tick_params(axis="x", rotation=30)
        dress(each, "natural frequency [Hz]", "damping ratio [-]", "Step by step")

    return draw


def damper_plot(records: list[DamperRecord], fit: DamperFit, units: tuple[str, str, str]) -> Draw:
    """Force over velocity and over displacement, and what the linear fit leaves."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots(1, 3)
        r, one = records[0], fit.records[0]
        lines = (
            (r.force, DATA, "measured"),
            (one.curve_force, LEFT, f"friction + viscous ({100 * one.friction_nrmse:.0f} %)"),
            (r.force - one.residual, MODEL, f"linear ({100 * one.nrmse:.0f} %)"),
        )
        for panel, x, label in (
            (axes[0], r.velocity, f"velocity [{units[2]}]"),
            (axes[1], r.displacement, f"displacement [{units[1]}]"),
        ):
            for y, colour, name in lines:
                panel.plot(x, y, ".", color=colour, ms=1.2 if colour == DATA else 0.8, label=name)
            dress(panel, label, f"force [{units[0]}]", f"{r.name}")
            panel.legend(fontsize=8, markerscale=8, edgecolor="#e0e4e7")
        axes[2].plot(r.velocity, one.residual, ".", color=MODEL, ms=1.2)
        axes[2].axhline(0.0, color="black", lw=0.8)
        verdict = "adequate" if fit.linear_adequate else "NOT adequate"
        what = f"velocity [{units[2]}]"
        dress(
            axes[2],
            what,
            f"left by the linear fit [{units[0]}]",
            f"A linear damper is {verdict}",
            legend=False,
        )
        for panel in axes:
            panel.locator_params(axis="x", nbins=5)

    return draw


def _two(figure: Figure) -> tuple[Axes, Axes]:
    top, low = figure.subplots(2, 1, sharex=True, height_ratios=[2.5, 1])
    return top, low


def _time_scale(seconds: float) -> tuple[float, str]:
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "µ")):
        if seconds * factor > 1.0:
            return factor, prefix
    return 1e9, "n"
