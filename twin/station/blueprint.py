"""How the views are arranged: what an engineer at the rig wants at a glance, the rest one click away."""

from dataclasses import dataclass

import rerun.blueprint as rrb

from twin.plant.config import Plant
from twin.station.columns import TIMELINE
from twin.station.curve_plot import HEIGHT, WIDTH

_WAVEFORM_S = 0.12


@dataclass(frozen=True, slots=True)
class Layout:
    """What the arrangement depends on: the plant, (path, name) of the waveform plots, windows, following."""

    plant: Plant
    waveforms: tuple[tuple[str, str], ...]
    trend_s: float | None
    follow: bool


def blueprint(layout: Layout) -> rrb.Blueprint:
    """Arrange the views for about 1600 x 1000 pixels."""
    primary = layout.plant.primary.name
    trend = None if layout.trend_s is None else _window(layout.trend_s)
    has_coil = layout.plant.voice_coil is not None

    lanes = rrb.StateTimelineView(origin="state", name="State of control, damping learner, model")
    vibration = _trend("vibration", f"Vibration of the {primary} at the excitation [µm]", trend)
    waveforms = [
        _waveform(path, f"{name}: measured and twin" if k == 0 else name)
        for k, (path, name) in enumerate(layout.waveforms)
    ]
    estimates = [_waveform("estimate/primary", f"{primary} displacement, estimated [µm]")]
    if layout.plant.absorber is not None:
        estimates.append(_waveform("estimate/stroke", "stroke, estimated [mm]"))
    waves = rrb.Tabs(*waveforms, *estimates, active_tab=0, name="Waveforms")
    health = rrb.Tabs(
        _trend("health/nis", "Model health: NIS, 1 = consistent", trend),
        _trend("health/innovation", "Innovations", trend),
        _trend("health/bias", "Bias of innovations", trend),
        _trend("health/whiteness", "Whiteness of innovations", trend),
        active_tab=0,
        name="Model health",
    )
    excitation = _trend("excitation", "Excitation [Hz]", trend)
    log = rrb.TextLogView(
        origin="log",
        name="Events and decisions",
        columns=rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"]),
    )
    setup = rrb.TextDocumentView(origin="setup", name="Set-up")
    gains = rrb.Vertical(
        *(_trend(f"gains/{g}", f"Gain {g}", trend) for g in ("gamma_n_m", "beta_ns_m", "alpha_kg")),
        name="Gains",
    )
    if has_coil:
        power = _trend("power", "Coil power against budget [W]", trend)
        at_excitation = rrb.TimeSeriesView(
            origin="damping",
            contents=["/damping/learned", "/damping/in_use"],
            name="Coil damping c2 at the excitation [Ns/m]",
            time_ranges=trend,
            plot_legend=_legend(trend),
        )
        curve = rrb.Spatial2DView(
            origin="damping/curve",
            name="c2 [Ns/m] over f [Hz]: learned ±1σ green, in use white",
            background=[13, 16, 17],
            visual_bounds=rrb.VisualBounds2D(x_range=[-12.0, WIDTH + 6.0], y_range=[-HEIGHT - 6.0, 12.0]),
        )
        body = rrb.Vertical(
            rrb.Horizontal(vibration, waves, column_shares=[3, 2]),
            rrb.Horizontal(power, curve, at_excitation, column_shares=[1, 1, 1]),
            rrb.Horizontal(
                health, rrb.Tabs(excitation, gains, active_tab=0), rrb.Tabs(log, setup, active_tab=0),
                column_shares=[1, 1, 1],
            ),
            row_shares=[5, 4, 3.5],
        )  # fmt: skip
    else:
        body = rrb.Vertical(
            rrb.Horizontal(vibration, waves, column_shares=[3, 2]),
            rrb.Horizontal(health, excitation, rrb.Tabs(log, setup, active_tab=0)),
            row_shares=[1, 1],
        )
    return rrb.Blueprint(
        rrb.Vertical(lanes, body, row_shares=[2.5, 10]),
        rrb.TopPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(
            state="collapsed", timeline=TIMELINE, play_state="following" if layout.follow else "paused"
        ),
        auto_layout=False,
        auto_views=False,
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


def _waveform(origin: str, name: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        time_ranges=_window(_WAVEFORM_S),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
