"""Whether model and measurements agree, watched live by the observer's own innovations.

Of a consistent filter the normalised innovations are white, of mean 0 and variance 1. Three statistics of every sensor
say whether they are, over the newest block and over a memory that fades exponentially: the NIS against its chi-square
band, the mean, and the autocorrelation from one sample to the next (`estimators.consistency`).

With thousands of samples in a block the bands are so narrow that every model is outside of them. A verdict therefore
asks whether a statistic is beyond what is tolerated by more than chance would carry it there, at a level so low that it
does not happen within a day.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from estimators.consistency import (
    BIAS,
    LAG1,
    NIS,
    FadingStatistics,
    Statistics,
    bias_band,
    nis_band,
    statistics_of,
    whiteness_band,
)
from estimators.isolation import ALIKE, innovation_signatures, suspect_of_excess, suspect_of_offset
from estimators.observer import Observer
from estimators.signal_check import Finding
from estimators.types import StateEstimate
from twin.plant.blocks import Block, Channel
from twin.plant.linear import Array

ALL_CHANNELS = "all channels"
"""Named where a block brought nothing."""

Verdict = Literal["consistent", "drifting", "diverged", "no data"]
HealthTest = Literal["", "signal", "bias", "noise", "nis", "whiteness"]

BAND_LEVEL = 0.05
"""Outside of the band that people see a consistent filter is this often."""

LIKELY = 0.8
"""Cosine between pattern and signature from which on an offset, which may be on the move, is a sensor's."""

VERDICT_LEVEL = 1e-7
"""Beyond the tolerated by chance a statistic is at most this often; of 24 looks per block of 0.1 s, once in 12 h."""


@dataclass(frozen=True, slots=True)
class HealthSettings:
    """What is tolerated, and how long things are remembered.

    Attributes
    ----------
    nis
        Between these a sensor's NIS is consistent, chance aside.
    nis_diverged
        From here on the filter's covariance is no description of its error any more.
    bias, bias_diverged
        Likewise for the mean of the normalised innovations. An accelerometer's offset bends the estimate of
        displacement by far more of its standard deviation than it shows here.
    whiteness
        Tolerated autocorrelation from sample to sample; colour alone never makes a filter diverged.
    memory_s
        Time constant of the fading memory [s].
    hold_s
        A masked signal is held against its channel this long after it was last seen [s].
    spikes
        Fewer spikes than these within ``hold_s`` are masked without a word.
    """

    nis: tuple[float, float] = (0.6, 1.25)
    nis_diverged: float = 1.5
    bias: float = 0.02
    bias_diverged: float = 0.5
    whiteness: float = 0.1
    memory_s: float = 1.0
    hold_s: float = 0.5
    spikes: int = 3


@dataclass(frozen=True, slots=True)
class Health:
    """Verdict over one block, in words a person can act on.

    Attributes
    ----------
    verdict
        ``consistent``, ``drifting`` (the estimate suffers), ``diverged`` (it must not be relied on) or ``no data``.
    channel
        Who says so; empty while consistent.
    test
        Which test says so: ``signal`` (masked samples), ``bias``, ``noise``, ``nis`` or ``whiteness``.
    reason
        The finding with channel, size and likely cause; empty while consistent.
    nis, nis_band
        Mean NIS over the block's scalar measurements, and where 95 % of a consistent filter's are; NaN without any.
    bias, whiteness
        Mean and autocorrelation of the normalised innovations of ``channel``, or of the sensor nearest to the edge;
        NaN without any.
    since_sample
        First sample of the block with which the verdict began.
    """

    verdict: Verdict
    channel: str
    test: HealthTest
    reason: str
    nis: float
    nis_band: tuple[float, float]
    bias: float
    whiteness: float
    since_sample: int


class _Cause(NamedTuple):
    severity: int
    channel: str
    test: HealthTest
    reason: str


class _Masked(NamedTuple):
    cause: _Cause
    until_sample: int


_CONSISTENT = _Cause(0, "", "", "")
_VERDICTS: tuple[Verdict, ...] = ("consistent", "drifting", "no data", "diverged")
_DRIFTING, _NO_DATA, _DIVERGED = 1, 2, 3


class HealthMonitor:
    """Watch one observer's consistency block by block.

    Parameters
    ----------
    channels
        The blocks' columns, for the units in what is said.
    settings
        See `HealthSettings`.
    """

    def __init__(self, channels: Sequence[Channel], settings: HealthSettings | None = None) -> None:
        self.settings = settings or HealthSettings()
        self._units = {c.name: c.unit for c in channels}
        self._memory: FadingStatistics | None = None
        self._masked: dict[str, _Masked] = {}
        self._spikes: dict[str, float] = {}
        self._verdict: Verdict = "consistent"
        self._since = 0
        self._cause = _CONSISTENT
        self._rival = ""
        self._worst_until = 0

    def advance(
        self,
        block: Block,
        estimate: StateEstimate,
        findings: Sequence[Finding],
        observer: Observer,
        frequency_hz: float,
    ) -> Health:
        """Judge one block.

        Parameters
        ----------
        estimate
            The observer's over the block.
        findings
            What was masked in it.
        observer
            Asked how errors of its sensors spread, when there is one to name.
        frequency_hz
            Of the excitation, where a sensor's wrong gain shows.
        """
        elapsed_s = block.n_samples / block.sample_rate_hz
        signal = self._judge_signals(block, estimate, findings, elapsed_s)
        now = statistics_of(estimate)
        if self._memory is None:
            self._memory = FadingStatistics(len(estimate.sensors))
        if signal.severity < _NO_DATA:  # what a lost signal does to the others is no news
            self._memory.add(now, math.exp(-elapsed_s / self.settings.memory_s))
        fading = self._memory.statistics()
        of_now = self._severity(now)
        of_memory = self._severity(fading)
        if signal.severity:
            # A masked signal explains what the innovations show besides; the worse of both says how bad it is.
            cause = signal._replace(severity=max(signal.severity, of_now))
        elif of_now or (of_memory and not self._cause.severity):
            statistics = now if of_now else fading
            cause = self._name(statistics, estimate, observer, frequency_hz)
            cause = self._steady(cause._replace(severity=max(of_now, of_memory)))
        elif of_memory:
            # While only the memory still knows of it, what was said first stands.
            cause = self._cause._replace(severity=of_memory)
        else:
            cause = _CONSISTENT
        cause = self._held(cause, block)
        verdict = _VERDICTS[cause.severity]
        if verdict != self._verdict:
            self._verdict, self._since = verdict, block.first_sample
        self._cause = cause
        return self._health(estimate, now, cause)

    def _steady(self, cause: _Cause) -> _Cause:
        """Keep to the channel named first until another one is worse in two blocks running."""
        known, rival = self._cause, self._rival
        self._rival = cause.channel
        if known.severity and known.test != "signal" and cause.channel not in (known.channel, rival):
            return known._replace(severity=cause.severity)
        return cause

    def _held(self, cause: _Cause, block: Block) -> _Cause:
        """Let a verdict become better only after it has been so for a while."""
        if cause.severity >= self._cause.severity:
            self._worst_until = block.end_sample + round(self.settings.hold_s * block.sample_rate_hz)
        elif block.end_sample < self._worst_until:
            return self._cause
        else:
            self._worst_until = block.end_sample + round(self.settings.hold_s * block.sample_rate_hz)
        return cause

    def _health(self, estimate: StateEstimate, now: Statistics, cause: _Cause) -> Health:
        bias = whiteness = math.nan
        if now.samples[NIS].any():
            named = [k for k, name in enumerate(estimate.sensors) if name == cause.channel]
            if named and now.samples[NIS, named[0]] > 0.0:
                worst = named[0]
            else:
                worst = int(np.argmax(np.nan_to_num(np.abs(now.value[BIAS])) * np.sqrt(now.samples[BIAS])))
            bias, whiteness = float(now.value[BIAS, worst]), float(now.value[LAG1, worst])
        return Health(
            verdict=_VERDICTS[cause.severity],
            channel=cause.channel,
            test=cause.test,
            reason=cause.reason,
            nis=estimate.nis,
            nis_band=nis_band(float(now.samples[NIS].sum()), BAND_LEVEL),
            bias=bias,
            whiteness=whiteness,
            since_sample=self._since,
        )

    def _severity(self, s: Statistics) -> int:
        """0 to 3 by the worst statistic of any sensor; NaN, of a sensor that said nothing, is beyond no bound."""
        settings, severity = self.settings, 0
        for counts, values in zip(s.samples.T.tolist(), s.value.T.tolist(), strict=True):
            low, high = nis_band(counts[NIS], VERDICT_LEVEL)
            nis, off, colour = values[NIS], abs(values[BIAS]), abs(values[LAG1])
            chance = bias_band(counts[BIAS], VERDICT_LEVEL)
            if nis > settings.nis_diverged * high or off > settings.bias_diverged + chance:
                return _DIVERGED
            if (
                nis > settings.nis[1] * high
                or nis < settings.nis[0] * low
                or off > settings.bias + chance
                or colour > settings.whiteness + whiteness_band(counts[LAG1], VERDICT_LEVEL)
            ):
                severity = _DRIFTING
        return severity

    def _name(
        self, s: Statistics, estimate: StateEstimate, observer: Observer, frequency_hz: float
    ) -> _Cause:
        """Find the test and the channel that says most, and put it in words."""
        nis = np.where(np.isfinite(s.value[NIS]), s.value[NIS], 1.0)
        mean, lag1 = np.nan_to_num(s.value[BIAS]), np.nan_to_num(s.value[LAG1])
        bands = np.array([nis_band(n, VERDICT_LEVEL) for n in s.samples[NIS].tolist()])
        low, high = np.nan_to_num(bands[:, 0]), np.where(s.samples[NIS] > 0.0, bands[:, 1], np.inf)
        chance = np.array([bias_band(n, VERDICT_LEVEL) for n in s.samples[BIAS].tolist()])
        excess = np.maximum(nis - 1.0 - mean**2, 0.0)
        biased = (np.abs(mean) - self.settings.bias) / chance
        over = nis > self.settings.nis[1] * high
        if biased.max() > 1.0 and (not over.any() or np.sum(mean**2) > 0.5 * np.sum(excess)):
            return self._name_bias(mean, int(np.argmax(biased)), estimate, observer)
        if over.any():
            return self._name_excess(
                nis, excess, lag1, int(np.argmax(nis / high)), estimate, observer, frequency_hz
            )
        under = nis < self.settings.nis[0] * low
        if under.any():
            worst = int(np.argmin(np.where(under, nis, np.inf)))
            name = estimate.sensors[worst]
            text = f"{name} is quieter than stated (NIS {nis[worst]:.2g})"
            return _Cause(0, name, "noise", f"{text}: its noise_density is too large, or it is dead")
        worst = int(np.argmax(np.abs(lag1)))
        name = estimate.sensors[worst]
        text = f"innovations of {name} are coloured (lag-1 autocorrelation {lag1[worst]:+.2f})"
        return _Cause(0, name, "whiteness", f"{text}: dynamics the model lacks, or filtered noise")

    def _name_bias(self, mean: Array, worst: int, estimate: StateEstimate, observer: Observer) -> _Cause:
        found = suspect_of_offset(mean, innovation_signatures(observer, 0.0))
        if found.likeness < LIKELY:
            name = estimate.sensors[worst]
            text = f"{name} is off its prediction by {mean[worst]:+.2g} standard deviations on average"
            return _Cause(0, name, "bias", f"{text}: an offset, or a steady force the model lacks")
        name = estimate.sensors[found.sensor]
        std = math.sqrt(float(np.asarray(observer.filter.R)[found.sensor, found.sensor]))
        size = f"{found.error * std:+.2g} {self._units.get(name, '')}"
        text = f"{name} has an offset of about {size}"
        return _Cause(0, name, "bias", f"{text}: check its zero, its supply and its mounting")

    def _name_excess(
        self,
        nis: Array,
        excess: Array,
        lag1: Array,
        worst: int,
        estimate: StateEstimate,
        observer: Observer,
        frequency_hz: float,
    ) -> _Cause:
        name = estimate.sensors[worst]
        if abs(lag1[worst]) < 0.25 and nis[worst] - 1.0 > 2.0 * np.sum(np.delete(excess, worst)):
            text = f"{name} is noisier than stated by a factor of {math.sqrt(nis[worst]):.2g}"
            return _Cause(0, name, "noise", f"{text}: check cable and connector, or its noise_density")
        found = suspect_of_excess(excess, innovation_signatures(observer, frequency_hz))
        if found.likeness >= ALIKE:
            name = estimate.sensors[found.sensor]
            text = f"model and {name} disagree at the excitation (NIS {nis[found.sensor]:.3g})"
            return _Cause(0, name, "nis", f"{text}: check its gain, then the model of what it measures")
        text = f"the model disagrees with the rig, most in {name} (NIS {nis[worst]:.3g})"
        return _Cause(0, name, "nis", f"{text}: check masses, stiffnesses and coil constants")

    def _judge_signals(
        self, block: Block, estimate: StateEstimate, findings: Sequence[Finding], elapsed_s: float
    ) -> _Cause:
        """Hold what was masked against its channel for a while; return the worst that stands."""
        settings = self.settings
        until = block.end_sample + round(settings.hold_s * block.sample_rate_hz)
        fade = math.exp(-elapsed_s / settings.hold_s)
        self._spikes = {name: count * fade for name, count in self._spikes.items() if count > 0.1}
        for finding in findings:
            if finding.kind == "spiking":
                self._spikes[finding.channel] = self._spikes.get(finding.channel, 0.0) + finding.samples
                if self._spikes[finding.channel] < settings.spikes:
                    continue
            cause = _cause_of(finding)
            if (
                cause.channel not in self._masked
                or cause.severity >= self._masked[cause.channel].cause.severity
            ):
                self._masked[cause.channel] = _Masked(cause, until)
        if block.n_samples and float(estimate.innovation_count.sum()) == 0.0:
            text = "no valid sample of any sensor in the block: check the connection to the rig"
            self._masked = {ALL_CHANNELS: _Masked(_Cause(_NO_DATA, ALL_CHANNELS, "signal", text), until)}
        self._masked = {n: m for n, m in self._masked.items() if m.until_sample > block.first_sample}
        causes = [m.cause for m in self._masked.values()]
        return max(causes, key=lambda c: c.severity) if causes else _CONSISTENT


def _cause_of(finding: Finding) -> _Cause:
    """Say what a masked signal means."""
    name, at = finding.channel, f"{finding.value:.4g} {finding.unit}"
    much = finding.share >= 0.5
    match finding.kind:
        case "missing":
            text = f"{name} sends no valid samples: check its connection"
            return _Cause(_NO_DATA if much else _DRIFTING, name, "signal", text)
        case "stuck":
            dead = "dead, it shows 0" if finding.value == 0.0 else f"stuck at {at}"
            text = f"{name} is {dead} where its noise should move it: check sensor, cable and supply"
            return _Cause(_DIVERGED if much else _DRIFTING, name, "signal", text)
        case "saturated":
            text = f"{name} is at the end of its range ({at}): reduce the excitation or its amplification"
            return _Cause(_DIVERGED if much else _DRIFTING, name, "signal", text)
        case "spiking":
            text = f"{name} has spikes, up to {at}: check cable, connector and shielding"
            return _Cause(_DRIFTING, name, "signal", text)
