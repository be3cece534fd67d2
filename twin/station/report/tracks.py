"""What a run did, block by block, as columns: what reports draw, judge and compare."""

import math
from dataclasses import dataclass, field

import numpy as np

from estimators.types import StateEstimate
from twin.plant.blocks import Channel
from twin.plant.config import GROUND, Plant
from twin.plant.linear import Array, read_only
from twin.station.frame import Frame
from twin.station.performance import PerformanceMeter
from twin.station.summary import SETTLED_S

COLUMNS = (
    "time_s", "duration_s", "frequency_hz", "frequency_std_hz", "control_on", "settled", "excitation",
    "displacement_m", "displacement_std_m", "live_passive_m", "limit_m", "motion_peak_m", "stroke_peak_m",
    "stroke_std_m", "current_peak_a", "joule_mean_w", "joule_peak_w", "electrical_mean_w", "budget_w", "nis",
    "nis_low", "nis_high", "masked", "damping_ns_m", "damping_std_ns_m", "in_use_ns_m",
)  # fmt: skip
"""Numbers of a block: `time_s` is its end, NaN is unknown.

`excitation` is the peak amplitude of what is tracked, in its channel's unit, or the exciting force where nothing
measures it; `settled` is 1 from half a second after the controller came on, `live_passive_m` and `limit_m` are what the
tuner said at the time, `motion_peak_m` and `stroke_peak_m` the largest of the estimate in the block. Damping is read at
the excitation's frequency.
"""


@dataclass(frozen=True, slots=True)
class Tracks:
    """Columns of a run, one row per block.

    Attributes
    ----------
    columns
        (n_blocks,) each, by the names of `COLUMNS`.
    verdict, learner
        (n_blocks,) the model's and the learner's state in words.
    channels
        Of the blocks.
    channel_peak
        (n_blocks, n_channels) largest valid magnitude in the channels' SI units; NaN where none is valid.
    sensors
        Of the observer.
    innovation
        (n_blocks, n_sensors) root mean square of the innovations over what the filter expected.
    reference
        Channel whose phase is tracked; empty without.
    force_estimated
        Whether ``excitation`` is a force that nothing measures.
    """

    columns: dict[str, Array]
    verdict: tuple[str, ...]
    learner: tuple[str, ...]
    channels: tuple[Channel, ...]
    channel_peak: Array
    sensors: tuple[str, ...]
    innovation: Array
    reference: str
    force_estimated: bool

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]

    def __len__(self) -> int:
        return len(self.verdict)


@dataclass(slots=True)
class TrackLog:
    """Collects the columns frame by frame.

    Parameters
    ----------
    plant, channels
        Of the run.
    """

    plant: Plant
    channels: tuple[Channel, ...]
    _rows: list[tuple[float, ...]] = field(default_factory=list)
    _verdict: list[str] = field(default_factory=list)
    _learner: list[str] = field(default_factory=list)
    _peaks: list[Array] = field(default_factory=list)
    _innovation: list[Array] = field(default_factory=list)
    _sensors: tuple[str, ...] = ()
    _reference: str = ""
    _forced: bool = False
    _on_for_s: float = 0.0
    _meter: PerformanceMeter = field(init=False)

    def __post_init__(self) -> None:
        self._meter = PerformanceMeter(self.plant, tuple(c.name for c in self.channels))

    def add(self, frame: Frame) -> None:
        """Take one frame in."""
        block, estimate, phasors, p = frame.block, frame.estimate, frame.phasors, frame.performance
        length_s = block.n_samples / block.sample_rate_hz
        self._on_for_s = self._on_for_s + length_s if block.control_on else 0.0
        nan = math.nan
        tracked = (nan,) * 5
        if phasors is not None:
            column = phasors.channels.index(phasors.reference)
            self._reference = phasors.reference
            self._forced = self._forced or frame.force_n is not None
            size = abs(phasors.amplitude[column]) if frame.force_n is None else frame.force_n[0]
            motion = self._meter.displacement(phasors), self._meter.displacement_std(phasors)
            tracked = (phasors.frequency_hz, phasors.frequency_std_hz, float(size), *motion)
        curve = frame.curve
        damping = (nan,) * 3
        if curve is not None and phasors is not None:
            grids = (curve.damping_ns_m, curve.std_ns_m, curve.in_use_ns_m)
            learned, std, in_use = (float(np.interp(tracked[0], curve.frequency_hz, g)) for g in grids)
            damping = (learned, std, in_use)
        powers = (
            (nan,) * 5
            if p is None
            else (
                p.powers.joule_mean_w, p.powers.joule_peak_w, p.powers.electrical_mean_w, p.passive_m, p.limit_m
            )
        )  # fmt: skip
        valid = frame.checked.block.valid
        row = {
            "time_s": block.end_s,
            "duration_s": length_s,
            "frequency_hz": tracked[0],
            "frequency_std_hz": tracked[1],
            "control_on": nan if block.control_on is None else float(block.control_on),
            "settled": float(self._on_for_s > SETTLED_S),
            "excitation": tracked[2],
            "displacement_m": tracked[3],
            "displacement_std_m": tracked[4],
            "live_passive_m": powers[3],
            "limit_m": powers[4],
            "current_peak_a": nan if p is None else p.current_peak_a,
            "joule_mean_w": powers[0],
            "joule_peak_w": powers[1],
            "electrical_mean_w": powers[2],
            "budget_w": nan if p is None else p.budget_w,
            "nis": estimate.nis,
            "nis_low": frame.health.nis_band[0],
            "nis_high": frame.health.nis_band[1],
            "masked": float(valid.size - int(valid.sum())),
            "damping_ns_m": damping[0],
            "damping_std_ns_m": damping[1],
            "in_use_ns_m": damping[2],
            **self._largest(estimate),
        }
        self._rows.append(tuple(row[name] for name in COLUMNS))
        self._verdict.append(frame.health.verdict)
        self._learner.append("" if curve is None else curve.status)
        taken = frame.checked.block
        size_of = np.where(taken.valid, np.abs(taken.values), -1.0).max(axis=0, initial=-1.0)
        self._peaks.append(np.where(size_of < 0.0, nan, size_of))
        with np.errstate(invalid="ignore", divide="ignore"):
            self._innovation.append(estimate.innovation_rms / estimate.innovation_std)
        self._sensors = estimate.sensors

    def _largest(self, estimate: StateEstimate) -> dict[str, float]:
        """Largest motion and stroke of the estimate, the latter with its standard deviation."""
        found = {"motion_peak_m": math.nan, "stroke_peak_m": math.nan, "stroke_std_m": math.nan}
        states = {name: k for k, name in enumerate(estimate.states)}
        primary = states.get(f"x_{self.plant.primary.name}")
        if primary is not None and len(estimate.mean):
            found["motion_peak_m"] = float(np.max(np.abs(estimate.mean[:, primary])))
        coil, absorber = self.plant.voice_coil, self.plant.absorber
        ends = None if absorber is None else (self.plant.primary.name, absorber.name)
        ends = coil.between if coil is not None and coil.between is not None else ends
        if ends is None or not all(e == GROUND or f"x_{e}" in states for e in ends):
            return found
        weights = np.zeros(len(states))
        for end, sign in zip(ends, (-1.0, 1.0), strict=True):
            if end != GROUND:
                weights[states[f"x_{end}"]] = sign
        stroke = estimate.mean @ weights
        found["stroke_peak_m"] = float(np.max(np.abs(stroke), initial=0.0))
        found["stroke_std_m"] = math.sqrt(max(0.0, float(weights @ estimate.covariance @ weights)))
        return found

    def tracks(self) -> Tracks:
        """All columns so far."""
        table = np.array(self._rows, dtype=np.float64).reshape(-1, len(COLUMNS))
        return Tracks(
            columns={name: read_only(table[:, k]) for k, name in enumerate(COLUMNS)},
            verdict=tuple(self._verdict),
            learner=tuple(self._learner),
            channels=self.channels,
            channel_peak=read_only(np.array(self._peaks).reshape(len(self._rows), len(self.channels))),
            sensors=self._sensors,
            innovation=read_only(np.array(self._innovation).reshape(len(self._rows), len(self._sensors))),
            reference=self._reference,
            force_estimated=self._forced,
        )
