"""How the views are arranged: what an engineer at the rig wants at a glance, the rest one click away."""

from dataclasses import dataclass

import rerun.blueprint as rrb

from twin.plant.config import ForceActuator, Plant
from twin.station import curve_plot
from twin.station.columns import TIMELINE
from twin.station.view import spectrum_plot
from twin.station.view.spectrum import BINS
from twin.station.view.still import ROOT as SCHEMATIC

_BACKGROUND = [13, 16, 17]


@dataclass(frozen=True, slots=True)
class Layout:
    """What the arrangement depends on.

    Attributes
    ----------
    waveforms
        (path, name) of every plot.
    spectrum
        Name and unit of the channel whose spectrum is shown; empty if there is none.
    bounds
        Ranges of x and y of the schematic.
    waveform_s
        Width of the window in which waveforms are shown [s].
    trend_s, follow
        As of `twin.station.rerun_view.Pace`.
    """

    plant: Plant
    waveforms: tuple[tuple[str, str], ...]
    spectrum: str
    bounds: tuple[tuple[float, float], tuple[float, float]]
    waveform_s: float
    trend_s: float | None
    follow: bool


def blueprint(layout: Layout) -> rrb.Blueprint:
    """Arrange the views for about 1600 x 1000 pixels: lanes on top, then three columns.

    On the left the machine itself, in the middle how it goes against limits and model, on the right what is behind it.
    """
    primary = layout.plant.primary.name
    trend = None if layout.trend_s is None else _window(layout.trend_s)
    has_coil = layout.plant.voice_coil is not None

    lanes = rrb.StateTimelineView(
        origin="state", name="Alarms, control, damping learner, model", time_ranges=trend
    )
    schematic = rrb.Spatial2DView(
        origin=SCHEMATIC,
        name="The rig in slow motion, enlarged: motion estimated, forces and current",
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=layout.bounds[0], y_range=layout.bounds[1]),
    )
    waves = rrb.Tabs(*_waveforms(layout), active_tab=0, name="Waveforms")
    health = rrb.Tabs(
        _trend("health/nis", "Model health: NIS, 1 = consistent", trend),
        _trend("health/innovation", "Innovations", trend),
        _trend("health/bias", "Bias", trend),
        _trend("health/whiteness", "Whiteness", trend),
        active_tab=0,
        name="Model health",
    )
    excitation = _trend("excitation", "Excitation [Hz]", trend)
    log = rrb.TextLogView(
        origin="log",
        name="Events, alarms, decisions",
        columns=rrb.TextLogColumns(
            # The time is part of the text: the column is too narrow to show it.
            timeline_columns=[rrb.encodings.TimelineColumn(TIMELINE, visible=False)],
            text_log_columns=["loglevel", "body"],
        ),
    )
    words = rrb.Tabs(log, rrb.TextDocumentView(origin="setup", name="Set-up"), active_tab=0)
    spectrum = (
        _spectrum(layout.spectrum) if layout.spectrum else _trend("excitation", "Excitation [Hz]", trend)
    )
    if has_coil:
        vibration = _trend("vibration", f"Vibration of the {primary} at the excitation [µm]", trend)
        power = _trend("power", "Coil power against budget [W]", trend)
        left = rrb.Vertical(schematic, spectrum, words, row_shares=[5, 5, 3.4])
        middle = rrb.Vertical(vibration, power, health, row_shares=[5, 5, 3.4])
        behind = rrb.Tabs(*_estimates(layout, trend), excitation, _gains(trend), active_tab=0)
        right = rrb.Vertical(waves, _damping(trend), behind, row_shares=[5, 5, 3.4])
        body = rrb.Horizontal(left, middle, right, column_shares=[1, 1, 1])
    else:
        left = rrb.Vertical(schematic, spectrum, row_shares=[1, 1])
        right = rrb.Vertical(
            waves,
            rrb.Horizontal(health, rrb.Tabs(*_estimates(layout, trend), excitation, active_tab=0)),
            words,
            row_shares=[5, 5, 3.4],
        )
        body = rrb.Horizontal(left, right, column_shares=[1, 1.3])
    return rrb.Blueprint(
        rrb.Vertical(lanes, body, row_shares=[2.95, 10]),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if layout.follow else "paused"
        ),
        auto_layout=False,
        auto_views=False,
    )


def _waveforms(layout: Layout) -> list[rrb.TimeSeriesView]:
    return [
        _waveform(path, f"{name}: measured, twin" if k == 0 else name, layout.waveform_s)
        for k, (path, name) in enumerate(layout.waveforms)
    ]


def _estimates(layout: Layout, trend: rrb.VisibleTimeRange | None) -> list[rrb.TimeSeriesView]:
    """What nothing measures, with one standard deviation to either side."""
    plant = layout.plant
    views = [_waveform("estimate/primary", f"{plant.primary.name} estimated ±1σ [µm]", layout.waveform_s)]
    if plant.absorber is not None:
        views.append(_waveform("estimate/stroke", "Stroke ±1σ [mm]", layout.waveform_s))
    if plant.voice_coil is not None and any(isinstance(a, ForceActuator) for a in plant.actuator):
        views.append(_trend("estimate/force", "Unmeasured force ±1σ [N]", trend))
    return views


def _damping(trend: rrb.VisibleTimeRange | None) -> rrb.Tabs:
    curve = rrb.Spatial2DView(
        origin=curve_plot.ROOT,
        name="c2 [Ns/m] over f [Hz]: learned ±1σ, in use",
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-12.0, curve_plot.WIDTH + 6.0], y_range=[-curve_plot.HEIGHT - 6.0, 12.0]
        ),
    )
    at_excitation = rrb.TimeSeriesView(
        origin="damping",
        contents=["/damping/learned", "/damping/in_use"],
        name="c2 at the excitation",
        time_ranges=trend,
        plot_legend=_legend(trend),
    )
    return rrb.Tabs(curve, at_excitation, active_tab=0, name="Coil damping")


def _spectrum(name: str) -> rrb.Spatial2DView:
    p = spectrum_plot
    return rrb.Spatial2DView(
        origin=p.ROOT,
        name=f"Spectrum and waterfall over f [Hz]: {name}",
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-26.0, BINS + 8.0], y_range=[-p.SPACE - p.HEIGHT - 8.0, p.ROWS + 3.0]
        ),
    )


def _gains(trend: rrb.VisibleTimeRange | None) -> rrb.Horizontal:
    return rrb.Horizontal(
        *(_trend(f"gains/{g}", f"Gain {g}", trend) for g in ("gamma_n_m", "beta_ns_m", "alpha_kg")),
        name="Gains",
    )


def _window(width_s: float) -> rrb.VisibleTimeRange:
    return rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-width_s),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )


def _trend(origin: str, name: str, window: rrb.VisibleTimeRange | None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, time_ranges=window, plot_legend=_legend(window))


def _legend(window: rrb.VisibleTimeRange | None) -> rrb.PlotLegend:
    """Legend away from the newest data in a rolling window, and from the eventful start in a whole run."""
    return rrb.PlotLegend(rrb.Corner2D.RightTop if window is None else rrb.Corner2D.LeftTop)


def _waveform(origin: str, name: str, width_s: float) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        time_ranges=_window(width_s),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
