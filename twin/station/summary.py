"""What a run came to, in figures: collected frame by frame, worked out once at the end."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.types import DampingCurve
from twin.plant.config import DampingTable
from twin.plant.linear import Array
from twin.station.audit import Audit
from twin.station.frame import Frame
from twin.station.instability import InstabilityLog

BAND_HZ = (45.0, 55.0)
SETTLED_S = 0.5
"""The attenuation counts from this long after the controller came on: before, it is the transient's."""


@dataclass(slots=True)
class RunLog:
    """Per-block figures of a run."""

    frequency_hz: list[float] = field(default_factory=list)
    settled: list[bool] = field(default_factory=list)
    controlled: list[bool] = field(default_factory=list)
    displacement_m: list[float] = field(default_factory=list)
    passive_m: list[float] = field(default_factory=list)
    current_peak_a: list[float] = field(default_factory=list)
    joule_mean_w: list[float] = field(default_factory=list)
    joule_peak_w: list[float] = field(default_factory=list)
    electrical_mean_w: list[float] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    curve: DampingCurve | None = None
    blocks: int = 0
    samples: int = 0
    masked: int = 0
    commands: int = 0
    questions: int = 0
    outdated: int = 0
    audit: Audit = field(default_factory=Audit)
    instability: InstabilityLog = field(default_factory=InstabilityLog)
    consistent: int = 0
    distortion: list[float] = field(default_factory=list)
    force_n: tuple[float, float] | None = None
    _on_for_s: float = 0.0

    def add(self, frame: Frame) -> None:
        """Take one frame in."""
        block = frame.block
        self.blocks += 1
        self.samples += block.n_samples
        valid = frame.checked.block.valid
        self.masked += valid.size - int(valid.sum())
        self.commands += len(frame.commands)
        if frame.decision is not None and frame.decision.reason.startswith("outdated"):
            self.outdated += 1
        self.instability.add(frame)
        self.questions += frame.asked is not None
        if frame.audited is not None:
            self.audit.points.append(frame.audited)
        self.curve = frame.curve or self.curve
        self.consistent += frame.health is not None and frame.health.verdict == "consistent"
        if frame.phasors is not None:
            self.distortion.append(frame.phasors.distortion_of(frame.phasors.reference))
        self.force_n = frame.force_n or self.force_n
        self._on_for_s = self._on_for_s + block.n_samples / block.sample_rate_hz if block.control_on else 0.0
        self.nis.append(frame.estimate.nis)
        p = frame.performance
        self.frequency_hz.append(frame.phasors.frequency_hz if frame.phasors is not None else math.nan)
        self.settled.append(self._on_for_s > SETTLED_S)
        self.controlled.append(bool(block.control_on))
        self.displacement_m.append(p.displacement_m if p else math.nan)
        self.passive_m.append(p.passive_m if p else math.nan)
        self.current_peak_a.append(p.current_peak_a if p else math.nan)
        self.joule_mean_w.append(p.powers.joule_mean_w if p else math.nan)
        self.joule_peak_w.append(p.powers.joule_peak_w if p else math.nan)
        self.electrical_mean_w.append(p.powers.electrical_mean_w if p else math.nan)

    def attenuation(self, passive_m: Array | None = None) -> Array:
        """1 - controlled/passive motion of the settled, controlled blocks inside the band.

        Parameters
        ----------
        passive_m
            (n_blocks,) motion of the passive rig [m]; the model's prediction where not given.
        """
        f = np.array(self.frequency_hz)
        inside = np.array(self.settled, dtype=bool) & (f >= BAND_HZ[0]) & (f <= BAND_HZ[1])
        reference = np.array(self.passive_m) if passive_m is None else passive_m[: len(f)]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(1.0 - np.array(self.displacement_m)[inside] / reference[inside])

    def figures(self, passive_m: Array | None = None, truth: DampingTable | None = None) -> dict[str, Any]:
        """Figures by name; None where the run cannot tell.

        Powers and current are the largest of any block: a budget is kept by the worst of them, not the mean.
        """
        attenuation = self.attenuation(passive_m)
        finite = attenuation[np.isfinite(attenuation)]
        return {
            "attenuation_mean": float(finite.mean()) if len(finite) else None,
            "attenuation_worst": float(finite.min()) if len(finite) else None,
            "current_peak_a": _largest(self.current_peak_a),
            "joule_mean_w": _largest(self.joule_mean_w),
            "joule_peak_w": _largest(self.joule_peak_w),
            "electrical_mean_w": _largest(self.electrical_mean_w),
            "damping_rmse_ns_m": None
            if truth is None or self.curve is None
            else damping_rmse(self.curve, truth),
            "nis_median": _median(self.nis),
            "blocks": self.blocks,
            "samples": self.samples,
            "masked_samples": self.masked,
            "commands": self.commands,
            "outdated_proposals": self.outdated if self.questions else None,
            "audit": self.audit.summary() if self.audit.points else None,
            "instability": self.instability.figures(),
        }

    def estimation(self) -> dict[str, Any]:
        """What the estimators say of themselves at the end, by name; None where there is no such part."""
        curve, force = self.curve, self.force_n
        return {
            "consistent_share": self.consistent / self.blocks if self.blocks else None,
            "excitation_distortion_median": _median(self.distortion),
            "force_n": None if force is None else force[0],
            "force_std_n": None if force is None else force[1],
            "learner_status": None if curve is None else curve.status,
            "learner_progress": None if curve is None else curve.progress,
            "learner_reason": None if curve is None else curve.reason,
            "stiffness_n_m": None if curve is None else _finite(curve.stiffness_n_m),
            "stiffness_std_n_m": None if curve is None else _finite(curve.stiffness_std_n_m),
        }


def damping_rmse(curve: DampingCurve, truth: DampingTable) -> float:
    """Root mean square of learned minus true damping over the band [Ns/m]."""
    f = np.linspace(*BAND_HZ, 101)
    learned = np.interp(f, curve.frequency_hz, curve.damping_ns_m)
    return float(np.sqrt(np.mean((learned - np.array([truth.at(x) for x in f])) ** 2)))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _largest(values: list[float]) -> float | None:
    known = [v for v in values if math.isfinite(v)]
    return max(known) if known else None


def _median(values: list[float]) -> float | None:
    known = [v for v in values if math.isfinite(v)]
    return float(np.median(known)) if known else None
