"""Look at a block before anybody believes it: stuck, saturated, spiking and missing samples are masked.

A sensor with noise does not show the same number for long. How long it may follows from its stated noise and from
the steps its converter makes, which the check learns from the data: a recording in coarse codes repeats them
rightfully, a dead channel does not. What is masked is skipped by the estimators, never replaced.
"""

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimators.signal_kernels import BINS, LOWEST, mark_missing, mark_runs, mark_spikes, scan, trailing_runs
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.linear import Array, read_only

FindingKind = Literal["missing", "stuck", "saturated", "spiking"]

FALSE_ALARM = 1e-12
"""Probability per sample that a sound sensor's run of equal codes is called stuck."""

NOISE_MARGIN = 3.0
"""A plant file may overstate a sensor's noise by this factor before repeated codes are misjudged."""

SHORTEST_RUN = 10
"""No fewer equal samples than these are ever called stuck."""

SPIKE_SIGMAS = 8.0
"""A sample this many standard deviations off the median of five is a spike."""

MOVING_SIGMAS = 20.0
"""A channel with this range over a block, in standard deviations, shows that the rig moves."""

LEAST_STEPS = 50
"""Steps to be seen before a converter's resolution counts as known."""

_KINDS: dict[int, FindingKind] = {1: "missing", 2: "saturated", 3: "stuck", 4: "spiking"}
_FADE = 0.2  # weight of the newest block in the roughness
_ROUGHNESS_OF_NOISE = math.sqrt(6.0) * math.sqrt(2.0 / math.pi)  # E|second difference| of unit white noise
_NEVER = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class Finding:
    """Samples of one channel that were masked in one block, and why.

    Attributes
    ----------
    channel, unit
        Which.
    kind
        ``missing`` (not valid when it came), ``stuck``, ``saturated`` or ``spiking``.
    samples
        How many.
    share
        Of the block's samples.
    value
        Where a stuck or saturated channel stands, in its unit; the largest spike; NaN where nothing came.
    """

    channel: str
    unit: str
    kind: FindingKind
    samples: int
    share: float
    value: float


@dataclass(frozen=True, slots=True)
class CheckedBlock:
    """A block with all that cannot be trusted masked, and what was found."""

    block: Block
    findings: tuple[Finding, ...]


class SignalCheck:
    """Judge the samples of one recording or rig, block by block.

    What it decides follows from the blocks alone, so that a replay decides the same.

    Parameters
    ----------
    plant
        Gives the sensors' noise and range.
    channels
        Names of a block's columns. A column that is no sensor, such as a command, has no noise: only samples that
        came invalid are found in it.
    sample_rate_hz
        Samples per second.
    used
        Channels that a model rests on: only there spikes are looked for. None for all sensors.
    """

    def __init__(
        self,
        plant: Plant,
        channels: Sequence[str],
        sample_rate_hz: float,
        used: Collection[str] | None = None,
    ) -> None:
        sensors = {s.name: s for s in plant.sensor}
        n = len(channels)
        self._std = np.full(n, math.inf)
        self._range = np.full(n, math.inf)
        self._spikes = np.zeros(n, dtype=np.bool_)
        for column, name in enumerate(channels):
            if name in sensors:
                sensor = sensors[name]
                self._std[column] = math.sqrt(sensor.noise_variance(sample_rate_hz))
                self._range[column] = (sensor.range or math.inf) * (1.0 - 1e-6)
                self._spikes[column] = used is None or name in used
        self._noisy = np.isfinite(self._std)
        self._longest_start = max(LEAST_STEPS, math.ceil(0.05 * sample_rate_hz))
        self._roughness = np.full(n, math.nan)
        self._steps = np.zeros((n, BINS))
        self._run_length = np.zeros(n, dtype=np.int64)
        self._tail = np.full((4, n), math.nan)
        self._moving = np.zeros(n, dtype=np.bool_)
        self._spacing: dict[int, tuple[int, int]] = {}

    def advance(self, block: Block) -> CheckedBlock:
        """Check one block.

        Returns
        -------
        CheckedBlock
            The same block if nothing was found, else one with a smaller ``valid``; values that are not finite are
            zero in it.
        """
        values, came = block.values, block.valid
        n = block.n_samples
        if n == 0:
            return CheckedBlock(block, ())
        self._know_roughness(values, came)
        bound = SPIKE_SIGMAS * np.fmax(self._std, self._roughness / _ROUGHNESS_OF_NOISE)
        bound[~self._spikes] = math.inf
        counts, levels = np.empty((3, len(bound)), dtype=np.int64), np.empty((3, len(bound)))
        scan(values, self._tail[2:], self._range, bound, self._std, self._noisy, self._steps, counts, levels)
        (beyond, same, jumps), (rough, low, high) = counts, levels
        runs = self._noisy & (same + self._run_length >= SHORTEST_RUN)
        findings: list[Finding] = []
        valid = came
        whole = bool(came.all())
        if not whole or beyond.any() or jumps.any() or runs.any():
            kinds = np.zeros(values.shape, dtype=np.uint8)
            if beyond.any() or not whole:
                mark_missing(values, came, self._range, kinds)
            for c in np.flatnonzero(self._noisy):
                if runs[c]:
                    mark_runs(
                        values[:, c],
                        self._longest_run(int(c)),
                        self._run_length[c],
                        self._tail[3, c],
                        kinds[:, c],
                    )
                if jumps[c] and math.isfinite(bound[c]):
                    # One sample in the next code of a coarse converter is no spike.
                    code = self._code(int(c)) * self._std[c] or _least_step(values[:, c])
                    least = max(bound[c], 2.5 * code)
                    mark_spikes(values[:, c], came[:, c], self._tail[:, c], least, kinds[:, c])
            if kinds.any():
                valid = came & (kinds == 0)
                valid.flags.writeable = False
                findings = self._findings(block, kinds)
        tail = values[-4:] if whole else np.where(came[-4:], values[-4:], math.nan)
        self._remember(tail, values, same, rough, low, high)
        if not whole:
            # What stands in the place of a missing sample is no reading: it starts no run.
            self._run_length[~came.all(axis=0)] = 1
        if not findings:
            return CheckedBlock(block, ())
        if not np.isfinite(values).all():
            values = np.where(np.isfinite(values), values, 0.0)
            values.flags.writeable = False
        return CheckedBlock(replace(block, values=values, valid=valid), tuple(findings))

    def warm_up(self, block: Block) -> None:
        """Compile what a block needs, on copies; to be called before the first block."""
        values, valid = read_only(block.values), np.array(block.valid)
        valid.flags.writeable = False  # as blocks come: a kernel for other arrays would be another kernel
        kinds = np.zeros(values.shape, dtype=np.uint8)
        p = values.shape[1]
        counts, levels = np.empty((3, p), dtype=np.int64), np.empty((3, p))
        steps = self._steps.copy()
        scan(values, self._tail[2:], self._range, self._std, self._std, self._noisy, steps, counts, levels)
        mark_missing(values, valid, self._range, kinds)
        mark_runs(values[:, 0], 10, self._run_length[0], self._tail[3, 0], kinds[:, 0])
        mark_spikes(values[:, 0], valid[:, 0], self._tail[:, 0], 1.0, kinds[:, 0])
        trailing_runs(values, self._run_length, np.zeros(values.shape[1], dtype=np.int64))

    def _know_roughness(self, values: Array, came: NDArray[np.bool_]) -> None:
        """Roughness of a channel at its first block: the median, which spikes do not move."""
        for c in np.flatnonzero(self._spikes & ~np.isfinite(self._roughness)):
            signal = values[came[:, c], c]
            signal = signal[np.isfinite(signal)]
            if len(signal) >= 5:
                second = np.abs(np.diff(signal, 2))
                # The median of |normal| is 0.845 of its mean.
                self._roughness[c] = float(np.median(second)) / 0.845

    def _code(self, column: int) -> float:
        """Step of a channel's converter, at most, in standard deviations; 0 while it is not known."""
        steps = self._steps[column]
        total = steps.sum()
        if total < LEAST_STEPS:
            return 0.0
        return float(2.0 ** (int(np.argmax(np.cumsum(steps) >= max(5.0, 0.02 * total))) + LOWEST))

    def _longest_run(self, column: int) -> int:
        """Number of equal samples from which on a channel is stuck."""
        code = self._code(column)
        if code == 0.0:
            others = self._moving.copy()
            others[column] = False
            return self._longest_start if others.any() else _NEVER
        # Resting in the middle of a code, every sample falls into it with this probability.
        stay = math.erf(code * NOISE_MARGIN / (2.0 * math.sqrt(2.0)))
        if stay >= 1.0:
            return _NEVER
        return max(SHORTEST_RUN, math.ceil(math.log(FALSE_ALARM) / math.log(max(stay, 1e-300))))

    def _findings(self, block: Block, kinds: NDArray[np.uint8]) -> list[Finding]:
        findings = []
        for c, channel in enumerate(block.channels):
            if not kinds[:, c].any():
                continue
            for code, kind in _KINDS.items():
                rows = kinds[:, c] == code
                samples = int(rows.sum())
                if kind == "missing":
                    samples = self._unexpectedly_missing(c, rows, block.first_sample)
                if not samples:
                    continue
                there = block.values[rows, c]
                value = math.nan if kind == "missing" else float(there[np.argmax(np.abs(there))])
                if kind == "stuck" and self._is_flat_top(value, block.values[:, c], c):
                    kind = "saturated"  # noqa: PLW2901
                findings.append(
                    Finding(channel.name, channel.unit, kind, samples, samples / block.n_samples, value)
                )
        return findings

    def _unexpectedly_missing(self, column: int, missing: NDArray[np.bool_], first_sample: int) -> int:
        """How many samples are missing of a channel that may be sampled more slowly than the block.

        Such a channel has a sample at every so many rows; the spacing is taken from the data once it is even.
        """
        there = np.flatnonzero(~missing) + first_sample
        apart = np.diff(there)
        if (apart == 1).any():
            self._spacing.pop(column, None)
        elif len(apart) and (apart == apart[0]).all():
            self._spacing[column] = (int(apart[0]), int(there[0]) % int(apart[0]))
        spacing, phase = self._spacing.get(column, (1, 0))
        if spacing == 1:
            return int(missing.sum())
        due = (np.arange(len(missing)) + first_sample) % spacing == phase
        return int((missing & due).sum())

    def _is_flat_top(self, value: float, signal: Array, column: int) -> bool:
        """Whether a repeated value is the end of a range the channel moved through in the same block."""
        low, high = float(np.nanmin(signal)), float(np.nanmax(signal))
        wide = high - low > MOVING_SIGMAS * self._std[column]
        return wide and value in {low, high} and value != 0.0

    def _remember(
        self,
        tail: Array,
        values: Array,
        same: NDArray[np.int64],
        rough: Array,
        low: Array,
        high: Array,
    ) -> None:
        n = len(values)
        sound = np.isfinite(rough) & np.isfinite(self._roughness) & (same < 0.5 * n)
        self._roughness[sound] += _FADE * (rough[sound] - self._roughness[sound])
        self._moving = self._noisy & (high - low > MOVING_SIGMAS * self._std)
        self._tail = np.vstack([self._tail, tail])[-4:]
        self._run_length = trailing_runs(values, self._run_length, same)


def _least_step(signal: Array) -> float:
    """Smallest difference between neighbours that are not equal; 0 if all are."""
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.abs(np.diff(signal))
    steps = steps[(steps > 0.0) & np.isfinite(steps)]
    return float(steps.min()) if len(steps) else 0.0
