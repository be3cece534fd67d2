"""The Kalman observer: one filterpy `KalmanFilter`, advanced a block at a time by compiled kernels.

The filterpy object holds x, P, F, B, H, Q and R; ``predict(u)`` and ``update(z)`` on it are the reference path.
The kernels take x and P from it and put them back: sequential scalar updates with the full covariance after a
model change, then the constant gain of the discrete algebraic Riccati equation once the covariance has settled.

When is it settled? The full covariance runs in stretches of ``settle_samples``, counted across blocks. At the end of
each, if every variance lies within `SETTLED` of the Riccati solution, relative, the gain is frozen, until the model
changes or a block comes with a sample that cannot be used.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray

from estimators import kernels
from estimators.augmented import Disturbances, FilterModel, UnknownForce, filter_model
from estimators.kernels import ABSURD, full_covariance_block, summarise
from estimators.riccati import steady_prior
from estimators.steady import constant_gain_block, steady_filter
from estimators.types import StateEstimate
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.discrete import DiscreteModel
from twin.plant.errors import InputError
from twin.plant.inputs import DriveReader, InputSource, choose_inputs, driven_model
from twin.plant.linear import Array, LinearModel, read_only

OBSERVED_KINDS = ("displacement", "velocity", "acceleration", "current")

SETTLED = 1e-4
"""Variances this near to the steady ones, relative, count as steady."""


class Observer:
    """Kalman observer of a plant from its recorded channels.

    Parameters
    ----------
    plant
        The model; its damping may be given against frequency.
    channels
        Names of a block's columns: which sensors are there, and what drives the actuators.
    sample_rate_hz
        Samples per second.
    frequency_hz
        Where damping against frequency is read at the start [Hz].
    disturbances
        Supposed to act beside what the plant file says.
    sources
        What drives each actuator; None chooses from the channels.
    settle_samples
        The full covariance runs in stretches of this many samples until, at the end of one, every variance is
        within `SETTLED` of the steady one; then the gain is frozen. A block with an invalid sample never runs
        frozen.
    unknown_force
        A sinusoidal force that nothing measures, estimated along; the filter starts knowing no more of it than how
        large it may be.

    Attributes
    ----------
    filter
        The filterpy `KalmanFilter`.
    sensors
        Names of the sensors it uses, in the order of its measurement vector.
    states
        Names of the states, of `filter_model`.
    drive
        Reads the inputs out of blocks.
    steady_covariance
        (n, n) covariance after a sample that the filter settles at, read-only.

    Raises
    ------
    InputError
        If no sensor that it can use is among the channels, or those there are do not tell all that wanders.
    """

    def __init__(
        self,
        plant: Plant,
        channels: Sequence[str],
        sample_rate_hz: float,
        *,
        frequency_hz: float | None = None,
        disturbances: Disturbances | None = None,
        sources: Sequence[InputSource] | None = None,
        settle_samples: int = 200,
        unknown_force: UnknownForce | None = None,
    ) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.sources = tuple(sources if sources is not None else choose_inputs(plant, channels))
        used_up = {s.channel for s in self.sources}
        usable = [s for s in plant.sensor if s.kind in OBSERVED_KINDS]
        chosen = [s for s in usable if s.name in channels and s.name not in used_up]
        if not chosen:
            raise InputError(
                f"none of the channels {', '.join(channels)} is a sensor of plant '{plant.name}' that its observer "
                f"can use; it knows {', '.join(s.name for s in usable) or 'none'}"
            )
        self.sensors = tuple(s.name for s in chosen)
        self._variance = np.array([s.noise_variance(sample_rate_hz) for s in chosen])
        self._disturbances, self._unknown_force = disturbances or Disturbances(), unknown_force
        if unknown_force is not None and unknown_force.body not in {b.name for b in plant.body}:
            raise InputError(
                f"unknown force: plant '{plant.name}' has no body '{unknown_force.body}'; it has "
                f"{', '.join(b.name for b in plant.body)}"
            )
        self._settle_samples = settle_samples
        self._sensor_columns = np.array([list(channels).index(name) for name in self.sensors])
        # A converter at the end of its range says "at least this much".
        self._ranges = np.array([min((s.range or ABSURD) * (1.0 - 1e-6), ABSURD) for s in chosen])
        self._limits = np.concatenate([np.full(2 * len(self.sources), ABSURD), self._ranges])
        self.drive = DriveReader(self.sources, channels)
        self._u_before: Array | None = None
        self._modes: tuple[Array, Array] | None = None
        self._stretch_done = 0
        self._driven = plant, *driven_model(plant, self.sources, sample_rate_hz, frequency_hz)
        known = self._known()
        self.states, n = known.states, len(known.states)
        self.filter = KalmanFilter(dim_x=n, dim_z=len(chosen), dim_u=2 * len(self.sources))
        self._use(known)
        # At the Riccati solution: states as slow as an input stage's coupling would take minutes to get there.
        self.filter.x, self.filter.P = np.zeros((n, 1)), self.steady_covariance.copy()
        self._settled = unknown_force is None
        if unknown_force is not None:
            rows = [self.states.index(name) for name in unknown_force.states]
            self.filter.P[rows, rows] += unknown_force.amplitude_n**2

    @property
    def unknown_force(self) -> UnknownForce | None:
        """The unknown force at its present frequency, if there is one."""
        return self._unknown_force

    @property
    def input_before(self) -> Array | None:
        """Inputs at the last sample taken in, read-only; None before the first."""
        return None if self._u_before is None else read_only(self._u_before)

    def set_model(self, plant: Plant, model: LinearModel, discrete: DiscreteModel) -> None:
        """Put another model of the same structure in place; state and covariance are carried over.

        Parameters
        ----------
        plant, model, discrete
            The plant and its `twin.plant.inputs.driven_model` by this observer's ``sources``.
        """
        self._driven = plant, model, discrete
        self._use(self._known())

    def set_excitation_frequency(self, frequency_hz: float) -> None:
        """Move the frequency of the unknown force, between two blocks; the force and its phase go on as they are.

        Parameters
        ----------
        frequency_hz
            Where the excitation is now [Hz].

        Raises
        ------
        InputError
            If the observer was made without an unknown force, or the frequency is not above zero.
        """
        if self._unknown_force is None:
            raise InputError("this observer has no unknown force: give it unknown_force=UnknownForce(...)")
        if frequency_hz != self._unknown_force.frequency_hz:
            self._unknown_force = replace(self._unknown_force, frequency_hz=frequency_hz)
            self.set_model(*self._driven)

    def advance(self, block: Block, *, freeze: bool = True) -> StateEstimate:
        """Filter one block; the filterpy object holds the state at its last sample afterwards.

        Invalid samples of sensors are skipped, never replaced; an invalid sample of an input repeats the
        last valid one, since the model must be driven by something.

        Parameters
        ----------
        freeze
            Whether the gain may be frozen once it is settled.
        """
        kf = self.filter
        # A look at the whole block is cheap; the sensors' columns matter only if it finds something.
        whole = bool(block.valid.all()) or bool(block.valid.take(self._sensor_columns, axis=1).all())
        u = self.drive.gather(block)
        before = self._u_before
        if before is None:
            before = np.where(np.abs(u[0]) < ABSURD, u[0], 0.0)
        mean = np.empty((len(u), len(kf.x)))
        sums = np.zeros((kernels.STATISTICS, len(self.sensors)))
        last = np.full(len(self.sensors), np.nan)
        n_full = 0
        while n_full < len(u):
            if whole and freeze and self._settled:
                if self._advance_frozen(block, before, u, n_full, last, mean, sums):
                    break
                whole = False  # it said so, but something in it passes a sensor's range or is no number
            # Counted across blocks, so that where a run is cut does not decide when the gain is frozen.
            stretch = slice(n_full, n_full + self._settle_samples - self._stretch_done)
            n_full += self._advance_full(block, before, u, stretch, last, mean, sums)
        self._u_before = before
        mean.flags.writeable = False
        return self._estimate(mean, sums)

    def measurements(self, block: Block, rows: slice = slice(None)) -> tuple[Array, NDArray[np.bool_]]:
        """Samples of its sensors and which of them it uses: valid, finite and within the sensor's range."""
        z = block.values[rows].take(self._sensor_columns, axis=1)
        valid = block.valid[rows].take(self._sensor_columns, axis=1)
        with np.errstate(invalid="ignore"):
            valid &= np.abs(z) < self._ranges
        return z, valid

    def _advance_frozen(
        self, block: Block, before: Array, u: Array, first: int, last: Array, mean: Array, sums: Array
    ) -> bool:
        """Run from row ``first`` on with the steady gain; False, and nothing is changed, if a sample is invalid."""
        kf, frozen = self.filter, self._frozen
        x = kf.x[:, 0]
        # Modal coordinates are kept: going to the states and back would leave traces of where a run is cut.
        if self._modes is not None and np.array_equal(self._modes[0], x):
            modes = self._modes[1].copy()
        else:
            modes = frozen.inverse @ x
        before_now, last_now, sums_now = before.copy(), last.copy(), sums.copy()
        if not constant_gain_block(
            frozen.pairs, frozen.columns, frozen.of_signals, frozen.shapes, frozen.normalised_of_modes,
            frozen.normalised_of_signals, frozen.root, self._limits, modes, before_now, u[first:], block.values[first:],
            self._sensor_columns, last_now, mean[first:], sums_now,
        ):  # fmt: skip
            return False
        before[:], last[:], sums[:] = before_now, last_now, sums_now
        self._modes = mean[-1].copy(), modes
        kf.x, kf.P = mean[-1][:, None].copy(), self.steady_covariance.copy()
        return True

    def _advance_full(
        self, block: Block, before: Array, u: Array, stretch: slice, last: Array, mean: Array, sums: Array
    ) -> int:
        """Run some rows with the full covariance; how many there were."""
        kf = self.filter
        x, P = kf.x[:, 0].copy(), np.array(kf.P, dtype=np.float64, order="C")
        z, valid = self.measurements(block, stretch)
        full_covariance_block(
            kf.F, *self._inputs, kf.H, self.feedthrough, kf.Q, self._variance, x, P, before,
            u[stretch], z, valid, last, mean[stretch], sums,
        )  # fmt: skip
        kf.x, kf.P = x[:, None], P
        self._stretch_done += len(z)
        self._settled = False
        if self._stretch_done == self._settle_samples:
            self._settled, self._stretch_done = self._is_steady(P), 0
        return len(z)

    def _estimate(self, mean: Array, sums: Array) -> StateEstimate:
        figures = np.empty((7, len(self.sensors)))
        summarise(sums, figures)
        figures.flags.writeable = False
        count, average, rms, std, lag1, nis, prediction = figures
        total = float(count.sum())
        return StateEstimate(
            states=self.states,
            mean=mean,
            covariance=read_only(self.filter.P),
            innovation_rms=rms,
            innovation_std=std,
            nis=float(sums[kernels.NIS].sum()) / total if total else float("nan"),
            sensors=self.sensors,
            innovation_count=count,
            innovation_mean=average,
            innovation_lag1=lag1,
            nis_per_sensor=nis,
            prediction_rms=prediction,
        )

    def _known(self) -> FilterModel:
        return filter_model(
            *self._driven, self.sources, self.sensors, self.sample_rate_hz, self._disturbances,
            self._unknown_force,
        )  # fmt: skip

    def _use(self, known: FilterModel) -> None:
        """Put a model into the filterpy object and work out where it settles."""
        kf = self.filter
        kf.F, kf.B, kf.H = np.array(known.F), np.hstack([known.B0, known.B1]), np.array(known.H)
        kf.Q, kf.R = np.array(known.Q), np.diag(self._variance)
        self.feedthrough, self._inputs = known.D, (known.B0, known.B1)
        try:
            prior = steady_prior(kf.F, kf.H, kf.Q, kf.R)
        except np.linalg.LinAlgError as error:
            raise InputError(
                f"plant '{self._driven[0].name}': {error}; its observer uses {', '.join(self.sensors)}"
            ) from error
        residual = kf.H @ prior @ kf.H.T + kf.R
        gain = np.linalg.solve(residual, kf.H @ prior).T
        self.steady_covariance = read_only(prior - gain @ residual @ gain.T)
        self._frozen = steady_filter(
            kf.F, *self._inputs, kf.H, self.feedthrough, gain, residual, np.sqrt(np.diag(prior))
        )
        self._modes = None
        self._settled, self._stretch_done = False, 0

    def _is_steady(self, P: Array) -> bool:
        steady = np.diag(self.steady_covariance)
        return bool(np.all(np.abs(np.diag(P) - steady) <= SETTLED * steady))
