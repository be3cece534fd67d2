"""What people see of a run: frames turned into Rerun series, drawings, lanes, curves and text.

Everything is on one timeline, ``time`` since the start of the recording. Raw data is not written here; the
recorder keeps it (``/record``).
"""

import math

import numpy as np
import rerun as rr

from estimators.types import StateEstimate
from tuning.types import BudgetKind
from twin.control.schedule import Command, GainSchedule
from twin.plant.blocks import Channel
from twin.plant.config import Plant
from twin.plant.linear import Array
from twin.station.alarms import AlarmWatch
from twin.station.blueprint import Layout, blueprint
from twin.station.columns import TIMELINE, Columns, nanoseconds
from twin.station.curve_plot import Axes, axes_for, log_axes, log_curve
from twin.station.frame import ROUTINE, Frame
from twin.station.view.groups import groups_of, spectrum_column
from twin.station.view.pace import WATCHED, Pace
from twin.station.view.schematic import Schematic
from twin.station.view.spectrum_plot import SpectrumPlot
from twin.station.view.styles import log_styles

SHOWN_HZ = 1000.0
WAVEFORM_PERIODS = 6.0
_MICRO, _MILLI = 1e6, 1e3
_BAND_95 = 1.96

SHOWN_NIS = 10.0
"""A larger one is drawn as this: what it was before the filter had settled would leave no room for the rest."""

REPEAT_S = 10.0
"""What is said when it changes is said again so often, for a viewer that has come since and does not have it all."""


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
    budget_kind
        Which power the budget bounds, at the start.
    setup
        Markdown about the run, shown as it is.
    pace
        `WATCHED` or `KEPT`.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        *,
        plant: Plant,
        sample_rate_hz: float,
        channels: tuple[Channel, ...],
        schedule: GainSchedule | None = None,
        budget_kind: BudgetKind = "joule_mean",
        setup: str = "",
        pace: Pace = WATCHED,
    ) -> None:
        self._stream, self._plant, self._channels, self._pace = stream, plant, channels, pace
        self._step = max(1, int(sample_rate_hz // SHOWN_HZ))
        self._schedule = schedule
        self._alarms = AlarmWatch(plant, budget_kind)
        self._sent: dict[int, Command] = {}
        self._fast, self._slow = Columns(stream, pace.hold_blocks), Columns(stream, pace.hold_slow_blocks)
        self._lanes: dict[str, str] = {}
        self._axes: Axes | None = None
        self._curve_at_s = -np.inf
        self._repeat_at_s = REPEAT_S
        self._groups = groups_of(plant, channels)
        own_hz = _own_hz(plant)
        self._schematic = Schematic(stream, self._fast, plant, pace.text_s)
        self._spectral = spectrum_column(plant, channels)
        self._spectrum: SpectrumPlot | None = None
        spectrum_name = ""
        if self._spectral is not None:
            channel = channels[self._spectral]
            spectrum_name = f"{channel.name} [{channel.unit}]"
            self._spectrum = SpectrumPlot(
                stream, sample_rate_hz, _top_hz(own_hz), whole=pace.trend_s is None,
                line_s=pace.spectrum_s, image_s=pace.image_s,
            )  # fmt: skip
        layout = Layout(
            plant=plant,
            waveforms=tuple((g.path, g.path.removeprefix("waveform/")) for g in self._groups),
            spectrum=spectrum_name,
            bounds=self._schematic.bounds,
            waveform_s=WAVEFORM_PERIODS / own_hz,
            trend_s=pace.trend_s,
            follow=pace.follow,
        )
        stream.send_blueprint(blueprint(layout))
        text = rr.TextDocument(setup or describe(plant), media_type=rr.MediaType.MARKDOWN)
        stream.log("setup", text, static=True)
        log_styles(stream, plant, channels, self._groups, budget_kind)

    def show(self, frame: Frame) -> None:
        """Add one frame."""
        end = np.array([frame.block.end_s])
        if self._pace.trend_s is not None and frame.block.end_s >= self._repeat_at_s:
            self._repeat(frame.block.end_s)
        self._show_waveforms(frame)
        self._show_estimate(frame)
        self._schematic.add(frame)
        self._show_spectrum(frame)
        self._show_health(frame, end)
        self._show_performance(frame, end)
        self._show_damping(frame, end)
        self._show_gains(frame, end)
        self._show_text(frame)
        self._show_lanes(frame)
        self._fast.end_block()
        self._slow.end_block()

    def send(self) -> None:
        """Send what is held back; at the end of a run."""
        self._fast.send()
        self._slow.send()

    def disconnect(self) -> None:
        """Send what is held back and let go of the stream; for one that only this view uses."""
        self.send()
        self._stream.disconnect()

    def _repeat(self, now_s: float) -> None:
        self._repeat_at_s = now_s + REPEAT_S
        self._lanes.clear()
        self._axes = None
        self._schematic.repeat()
        if self._spectrum is not None:
            self._spectrum.repeat()

    def _show_spectrum(self, frame: Frame) -> None:
        if self._spectrum is None or self._spectral is None:
            return
        block, name = frame.block, self._channels[self._spectral].name
        measured = np.where(block.valid[:, self._spectral], block.values[:, self._spectral], np.nan)
        sensors = frame.estimate.sensors
        twin = frame.twin[:, sensors.index(name)] if name in sensors else np.zeros(block.n_samples)
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        self._spectrum.add(block.end_s, np.column_stack([measured, twin]), hz)

    def _show_waveforms(self, frame: Frame) -> None:
        block = frame.block
        rows = slice((-block.first_sample) % self._step, None, self._step)
        time_s = (block.first_sample + np.arange(block.n_samples)[rows]) / block.sample_rate_hz
        measured = np.where(block.valid[rows], block.values[rows], np.nan)
        modelled = {name: column for column, name in enumerate(frame.estimate.sensors)}
        nothing = np.full(len(time_s), np.nan)
        for group in self._groups:
            series = [measured[:, c] for c in group.channels]
            series += [frame.twin[rows, modelled[n]] if n in modelled else nothing for n in group.twin]
            self._fast.add(group.path, time_s, np.column_stack(series))

    def _show_estimate(self, frame: Frame) -> None:
        block, estimate = frame.block, frame.estimate
        rows = slice((-block.first_sample) % self._step, None, self._step)
        time_s = (block.first_sample + np.arange(block.n_samples)[rows]) / block.sample_rate_hz
        for path, weights, scale in self._estimated(estimate):
            mean = estimate.mean[rows] @ weights * scale
            variance = max(0.0, float(weights @ estimate.covariance @ weights)) * scale**2
            self._fast.add(path, time_s, mean[:, None], np.full((len(mean), 1), variance))

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
        """Innovations against what the filter expects of them, with the bounds that 95 of 100 keep."""
        estimate = frame.estimate
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = estimate.innovation_rms / estimate.innovation_std
            bias = estimate.innovation_mean / estimate.innovation_std
        n = max(1.0, float(np.median(estimate.innovation_count)))
        band = _BAND_95 / np.sqrt(n)
        half = band / np.sqrt(2.0)
        for name, values, low, high in (
            ("innovation", ratio, 1.0 - half, 1.0 + half),
            ("bias", bias, -band, band),
            ("whiteness", estimate.innovation_lag1, -band, band),
        ):
            self._slow.add(f"health/{name}", end, np.array([[*values, low, high]]))
        self._slow.add("health/nis", end, np.array([[min(estimate.nis, SHOWN_NIS), *frame.health.nis_band]]))

    def _show_performance(self, frame: Frame, end: Array) -> None:
        if frame.phasors is not None:
            hz, std = frame.phasors.frequency_hz, frame.phasors.frequency_std_hz
            self._slow.add("excitation", end, np.array([[hz]]), np.array([[std**2]]))
        if frame.force_n is not None:
            force, force_std = frame.force_n
            self._slow.add("estimate/force", end, np.array([[force]]), np.array([[force_std**2]]))
        if frame.performance is None:
            return
        p = frame.performance
        shown = np.array([[p.displacement_m, p.passive_m, p.limit_m]]) * _MICRO
        self._slow.add("vibration", end, shown)
        powers = p.powers
        watts = [powers.electrical_mean_w, powers.joule_mean_w, powers.joule_peak_w, p.budget_w]
        self._slow.add("power", end, np.array([watts]))

    def _show_damping(self, frame: Frame, end: Array) -> None:
        curve = frame.curve
        if curve is None:
            return
        hz = None if frame.phasors is None else frame.phasors.frequency_hz
        if hz is not None:
            grid = curve.frequency_hz
            learned, std = np.interp(hz, grid, curve.damping_ns_m), np.interp(hz, grid, curve.std_ns_m)
            self._slow.add("damping/learned", end, np.array([[learned]]), np.array([[std**2]]))
            self._slow.add("damping/in_use", end, np.array([[np.interp(hz, grid, curve.in_use_ns_m)]]))
        if frame.block.end_s < self._curve_at_s + self._pace.curve_s:
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
            self._slow.add(f"gains/{name}", end, np.array([[getattr(gains, name)]]))

    def _show_lanes(self, frame: Frame) -> None:
        if (
            frame.ordered is not None
            and frame.ordered.order is not None
            and frame.ordered.order.goal is not None
        ):
            self._alarms.kind = frame.ordered.order.goal.budget_kind
        on = frame.block.control_on
        alarm, words = self._alarms.take(frame.performance)
        now = {
            "alarm": alarm,
            "control": "unknown" if on is None else "on" if on else "off",
            "damping": "none" if frame.curve is None else frame.curve.status,
            "model": frame.health.verdict,
        }
        if words and self._lanes.get("alarm") != alarm:
            self._say(frame.block.end_s, f"{alarm}: {words}", "ERROR" if alarm == "at a limit" else "WARN")
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
        self._stream.log("log", rr.TextLog(f"{time_s:.1f} s  {text}", level=level))

    def _at(self, time_s: float) -> None:
        self._stream.set_time(TIMELINE, duration=nanoseconds(time_s)[0])


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


def _own_hz(plant: Plant) -> float:
    """Natural frequency of the absorber, or of the plant's only body: about how fast it shakes."""
    body = plant.absorber or plant.primary
    return math.sqrt(body.stiffness_n_m / body.mass_kg) / math.tau


def _top_hz(own_hz: float) -> float:
    """Highest frequency of the spectrum: five times the plant's own, rounded."""
    round_ones = np.array([1.0, 2.5, 5.0, 10.0]) * 10.0 ** np.floor(np.log10(5.0 * own_hz))
    return float(round_ones[np.argmin(np.abs(np.log(round_ones / (5.0 * own_hz))))])
