"""What people see of a run: frames turned into Rerun series, lanes, curves and text.

Everything is on one timeline, ``time`` since the start of the recording. Raw data is not written here; the
recorder keeps it (``/record``).
"""

from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from estimators.types import StateEstimate
from twin.control.schedule import Command, GainSchedule
from twin.plant.blocks import Channel
from twin.plant.config import MOTION_UNITS, Plant
from twin.plant.linear import Array
from twin.station import palette
from twin.station.blueprint import Layout, blueprint
from twin.station.columns import TIMELINE, Columns, nanoseconds
from twin.station.curve_plot import Axes, axes_for, log_axes, log_curve
from twin.station.frame import ROUTINE, Frame

SHOWN_HZ = 1000.0
_CURVE_PERIOD_S = 0.5
_MICRO, _MILLI = 1e6, 1e3


@dataclass(slots=True)
class _Group:
    """Channels of one unit that share a plot; ``twin`` holds their names as sensors."""

    path: str
    channels: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)


class RerunView:
    """Shows frames on one Rerun stream.

    Parameters
    ----------
    stream
        Where to; a recorder's file stream or a live one, never one with both kinds of sinks.
    plant, sample_rate_hz, channels
        Of the run.
    schedule
        The controller's schedule at the start, from which the gains in use follow; None if unknown.
    setup
        Markdown about the run, shown as it is.
    hold_blocks
        Blocks to collect before series are sent: 1 for people who watch, more for a file.
    trend_s
        Width of the window in which slow quantities are shown [s]; None for the whole run.
    follow
        Whether the viewer keeps up with the end of the data.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        *,
        plant: Plant,
        sample_rate_hz: float,
        channels: tuple[Channel, ...],
        schedule: GainSchedule | None = None,
        setup: str = "",
        hold_blocks: int = 1,
        trend_s: float | None = None,
        follow: bool = True,
    ) -> None:
        self._stream = stream
        self._plant = plant
        self._step = max(1, int(sample_rate_hz // SHOWN_HZ))
        self._channels = channels
        self._schedule = schedule
        self._sent: dict[int, Command] = {}
        self._columns = Columns(stream)
        self._hold, self._held = hold_blocks, 0
        self._lanes: dict[str, str] = {}
        self._axes: Axes | None = None
        self._curve_at_s = -np.inf
        self._groups = _groups(plant, channels)
        self._layout = Layout(
            plant=plant,
            waveforms=tuple((g.path, g.path.removeprefix("waveform/")) for g in self._groups),
            trend_s=trend_s,
            follow=follow,
        )
        self._log_static(setup)

    def show(self, frame: Frame) -> None:
        """Add one frame."""
        end = np.array([frame.block.end_s])
        self._show_waveforms(frame)
        self._show_estimate(frame)
        self._show_health(frame, end)
        self._show_performance(frame, end)
        self._show_damping(frame, end)
        self._show_gains(frame, end)
        self._show_lanes(frame)
        self._show_text(frame)
        self._held += 1
        if self._held >= self._hold:
            self.send()

    def send(self) -> None:
        """Send what is held back; at the end of a run."""
        self._held = 0
        self._columns.send()

    def disconnect(self) -> None:
        """Send what is held back and let go of the stream; for one that only this view uses."""
        self.send()
        self._stream.disconnect()

    def _show_waveforms(self, frame: Frame) -> None:
        block = frame.block
        rows = slice((-block.first_sample) % self._step, None, self._step)
        time_s = (block.first_sample + np.arange(block.n_samples)[rows]) / block.sample_rate_hz
        measured = np.where(block.valid[rows], block.values[rows], np.nan)
        modelled = {name: column for column, name in enumerate(frame.estimate.sensors)}
        nothing = np.full(len(time_s), np.nan)
        for group in self._groups:
            series = [measured[:, c] for c in group.channels]
            series += [frame.twin[rows, modelled[n]] if n in modelled else nothing for n in group.names]
            self._columns.add(group.path, time_s, np.column_stack(series))

    def _show_estimate(self, frame: Frame) -> None:
        block, estimate = frame.block, frame.estimate
        rows = slice((-block.first_sample) % self._step, None, self._step)
        time_s = (block.first_sample + np.arange(block.n_samples)[rows]) / block.sample_rate_hz
        for path, weights, scale in self._estimated(estimate):
            mean = estimate.mean[rows] @ weights * scale
            variance = max(0.0, float(weights @ estimate.covariance @ weights)) * scale**2
            self._columns.add(path, time_s, mean[:, None], np.full((len(mean), 1), variance))

    def _estimated(self, estimate: StateEstimate) -> list[tuple[str, Array, float]]:
        """Paths, rows over the states, and display scale of the displacements worth looking at."""
        index = {name: k for k, name in enumerate(estimate.states)}
        primary = index.get(f"x_{self._plant.primary.name}")
        body = self._plant.absorber
        absorber = None if body is None else index.get(f"x_{body.name}")
        found = []
        if primary is not None:
            weights = np.zeros(len(index))
            weights[primary] = 1.0
            found.append(("estimate/primary", weights, _MICRO))
            if absorber is not None:
                weights = -weights
                weights[absorber] = 1.0
                found.append(("estimate/stroke", weights, _MILLI))
        return found

    def _show_health(self, frame: Frame, end: Array) -> None:
        estimate = frame.estimate
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate.innovation_rms / estimate.innovation_std
        self._columns.add("health/innovation", end, ratio[None, :])
        self._columns.add("health/nis", end, np.array([[estimate.nis, *frame.health.nis_band]]))
        with np.errstate(invalid="ignore", divide="ignore"):
            bias = estimate.innovation_mean / estimate.innovation_std
        self._columns.add("health/bias", end, bias[None, :])
        self._columns.add("health/whiteness", end, estimate.innovation_lag1[None, :])

    def _show_performance(self, frame: Frame, end: Array) -> None:
        if frame.phasors is not None:
            hz, std = frame.phasors.frequency_hz, frame.phasors.frequency_std_hz
            self._columns.add("excitation", end, np.array([[hz]]), np.array([[std**2]]))
        if frame.performance is None:
            return
        p = frame.performance
        shown = np.array([[p.displacement_m, p.passive_m, p.limit_m]]) * _MICRO
        self._columns.add("vibration", end, shown)
        powers = p.powers
        watts = [powers.electrical_mean_w, powers.joule_mean_w, powers.joule_peak_w, p.budget_w]
        self._columns.add("power", end, np.array([watts]))

    def _show_damping(self, frame: Frame, end: Array) -> None:
        curve = frame.curve
        if curve is None:
            return
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        if hz is not None:
            grid = curve.frequency_hz
            learned, std = np.interp(hz, grid, curve.damping_ns_m), np.interp(hz, grid, curve.std_ns_m)
            self._columns.add("damping/learned", end, np.array([[learned]]), np.array([[std**2]]))
            self._columns.add("damping/in_use", end, np.array([[np.interp(hz, grid, curve.in_use_ns_m)]]))
        if frame.block.end_s < self._curve_at_s + _CURVE_PERIOD_S:
            return
        self._curve_at_s = frame.block.end_s
        self._at(frame.block.end_s)
        axes = axes_for(curve, self._axes)
        if axes != self._axes:
            self._axes = axes
            log_axes(self._stream, axes)
        log_curve(self._stream, curve, axes, hz)

    def _show_gains(self, frame: Frame, end: Array) -> None:
        self._sent.update({command.command_id: command for command in frame.commands})
        for answer in frame.acknowledgements:
            command = self._sent.pop(answer.command_id, None)
            if answer.accepted and command is not None and command.schedule is not None:
                self._schedule = command.schedule
        if self._schedule is None or frame.phasors is None:
            return
        gains = self._schedule.at(frame.phasors.frequency_hz)
        for name in ("gamma_n_m", "beta_ns_m", "alpha_kg"):
            self._columns.add(f"gains/{name}", end, np.array([[getattr(gains, name)]]))

    def _show_lanes(self, frame: Frame) -> None:
        on = frame.block.control_on
        now = {
            "control": "unknown" if on is None else "on" if on else "off",
            "damping": "none" if frame.curve is None else frame.curve.status,
            "model": frame.health.verdict,
        }
        for lane, state in now.items():
            if self._lanes.get(lane) != state:
                self._lanes[lane] = state
                self._at(frame.block.start_s)
                self._stream.log(f"state/{lane}", rr.StateChange(state=state))

    def _show_text(self, frame: Frame) -> None:
        rate = frame.block.sample_rate_hz
        for event in frame.events:
            self._say(
                event.sample / rate, event.text, {"warning": "WARN"}.get(event.level, event.level.upper())
            )
        for d in frame.decisions:
            if d.reason not in ROUTINE:
                what = "order" if d.by == "operator" else "proposal"
                word = "accepted" if d.accepted else "declined"
                self._say(d.sample / rate, f"{what} {word} ({d.by}): {d.reason}", "INFO")
        for answer in frame.acknowledgements:
            text = f"rig: command {answer.command_id} " + ("applied" if answer.accepted else "refused")
            reason = f": {answer.reason}" if answer.reason else ""
            self._say(frame.block.start_s, text + reason, "INFO" if answer.accepted else "ERROR")

    def _say(self, time_s: float, text: str, level: str) -> None:
        self._at(time_s)
        self._stream.log("log", rr.TextLog(text, level=level))

    def _at(self, time_s: float) -> None:
        self._stream.set_time(TIMELINE, duration=nanoseconds(time_s)[0])

    def _log_static(self, setup: str) -> None:
        stream = self._stream
        stream.send_blueprint(blueprint(self._layout))
        stream.log(
            "setup",
            rr.TextDocument(setup or describe(self._plant), media_type=rr.MediaType.MARKDOWN),
            static=True,
        )
        units = {c.name: c.unit for c in self._channels}
        for group in self._groups:
            measured = [self._channels[c].name for c in group.channels]
            names = [f"{n} measured [{units[n]}]" for n in measured]
            names += [f"{n} twin [{units[n]}]" for n in group.names]
            n_pairs = len(measured)
            colours = (
                [palette.MEASURED, palette.TWIN]
                if n_pairs == len(group.names) == 1
                else [palette.SERIES[k % len(palette.SERIES)] for k in range(len(names))]
            )
            _lines(stream, group.path, names, colours, [2.0] * n_pairs + [1.2] * len(group.names))
        primary = self._plant.primary.name
        _lines(
            stream,
            "vibration",
            ["measured [µm]", "model, no control [µm]", "limit of any controller [µm]"],
            [palette.MEASURED, palette.PASSIVE, palette.LIMIT],
            [2.5, 1.5, 1.5],
        )
        _lines(
            stream,
            "power",
            ["electrical mean [W]", "Joule mean [W]", "Joule peak [W]", "budget (Joule mean) [W]"],
            [palette.MEASURED, palette.TWIN, palette.SERIES[2], palette.LIMIT],
            [2.0, 2.0, 1.5, 2.5],
        )
        sensors = [s.name for s in self._plant.sensor]
        colours = [palette.SERIES[k % len(palette.SERIES)] for k in range(len(sensors))]
        _lines(
            stream,
            "health/innovation",
            [f"{s} rms/expected [1]" for s in sensors],
            colours,
            [1.0] * len(sensors),
        )
        for path, what in (("health/bias", "mean/std"), ("health/whiteness", "lag-1 autocorrelation")):
            names = [f"{s} {what} [1]" for s in sensors]
            _lines(stream, path, names, colours, [1.0] * len(sensors))
        _lines(
            stream,
            "health/nis",
            ["NIS [1]", "95 % from", "95 % to"],
            [palette.IN_USE, palette.GOOD, palette.GOOD],
            [2.5, 1.5, 1.5],
        )
        _lines(stream, "damping/in_use", ["c2 in use [Ns/m]"], [palette.IN_USE], [2.0])
        _band(stream, "damping/learned", "c2 learned ±1σ", "Ns/m", palette.LEARNED)
        _band(stream, "excitation", "excitation ±1σ", "Hz", palette.TWIN)
        _band(stream, "estimate/primary", f"{primary} displacement ±1σ", "µm", palette.TWIN)
        _band(stream, "estimate/stroke", "stroke ±1σ", "mm", palette.SERIES[2])
        for path, name, colour in (
            ("gains/gamma_n_m", "γ, relative position [N/m]", palette.MEASURED),
            ("gains/beta_ns_m", "β, relative velocity [Ns/m]", palette.TWIN),
            ("gains/alpha_kg", "α, relative acceleration [kg]", palette.SERIES[2]),
        ):
            _lines(stream, path, [name], [colour], [2.0])
        _lane(stream, "control", {"on": palette.GOOD, "off": palette.OFF, "unknown": palette.OFF})
        _lane(
            stream,
            "damping",
            {
                "none": palette.OFF,
                "unestimated": palette.OFF,
                "learning": palette.WAITING,
                "estimated": palette.GOOD,
                "invalid": palette.POOR,
            },
        )
        _lane(
            stream,
            "model",
            {
                "consistent": palette.GOOD,
                "drifting": palette.WARNING,
                "diverged": palette.POOR,
                "no data": palette.OFF,
            },
        )


def describe(plant: Plant) -> str:
    """Markdown table of a plant's bodies, actuators and limits."""
    lines = [f"### {plant.name}", "", "| body | kg | N/m | Ns/m |", "|---|---|---|---|"]
    for body in plant.body:
        damping = f"{body.damping_ns_m:g}" if isinstance(body.damping_ns_m, float) else "table"
        lines.append(f"| {body.name} | {body.mass_kg:g} | {body.stiffness_n_m:g} | {damping} |")
    if plant.limits:
        lines += ["", "| limit | |", "|---|---|"]
        lines += [f"| {key} | {value:g} {plant.limit_units[key]} |" for key, value in plant.limits.items()]
    return "\n".join([*lines, "", f"configuration `{plant.fingerprint}`"])


def _groups(plant: Plant, channels: tuple[Channel, ...]) -> list[_Group]:
    """Plots of waveforms: the primary body's motion by itself, everything else by unit."""
    sensors = {s.name: s for s in plant.sensor}
    motion = set(MOTION_UNITS.values())
    groups: dict[str, _Group] = {}
    for column, channel in enumerate(channels):
        sensor = sensors.get(channel.name)
        if sensor is not None and channel.unit in motion and sensor.of == plant.primary.name:
            key = plant.primary.name
        else:
            key = {
                "m/s²": "acceleration",
                "m/s": "velocity",
                "m": "displacement",
                "A": "current",
                "V": "voltage",
            }.get(channel.unit, "force" if channel.unit == "N" else "other")
        group = groups.setdefault(key, _Group(f"waveform/{key}"))
        group.channels.append(column)
        if sensor is not None:
            group.names.append(channel.name)
    return list(groups.values())


def _lines(
    stream: rr.RecordingStream, path: str, names: list[str], colours: list[int], widths: list[float]
) -> None:
    stream.log(path, rr.SeriesLines(names=names, colors=palette.array(colours), widths=widths), static=True)


def _band(stream: rr.RecordingStream, path: str, name: str, unit: str, colour: int) -> None:
    style = rr.Measurements.from_fields(
        names=[name], units=[unit], colors=palette.array([colour]), widths=[2.0]
    )
    stream.log(path, style, static=True)


def _lane(stream: rr.RecordingStream, lane: str, colours: dict[str, int]) -> None:
    style = rr.StateConfiguration(values=list(colours), colors=palette.array(colours.values()))
    stream.log(f"state/{lane}", style, static=True)
