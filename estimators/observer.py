"""The Kalman observer: one filterpy `KalmanFilter`, advanced a block at a time by compiled kernels.

The filterpy object holds x, P, F, B, H, Q and R; ``predict(u)`` and ``update(z)`` on it are the reference path.
The kernels take x and P from it and put them back: sequential scalar updates with the full covariance after a
model change, then the constant gain of the discrete algebraic Riccati equation once the covariance has settled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from control import dare
from filterpy.kalman import KalmanFilter
from scipy.linalg import expm

from estimators import kernels
from estimators.kernels import ABSURD, full_covariance_block, summarise
from estimators.steady import constant_gain_block, steady_filter
from estimators.types import StateEstimate
from twin.plant.blocks import Block
from twin.plant.config import Plant
from twin.plant.discrete import DiscreteModel
from twin.plant.inputs import DriveReader, InputSource, choose_inputs, driven_model
from twin.plant.linear import Array, LinearModel, read_only

OBSERVED_KINDS = ("displacement", "velocity", "acceleration", "current")

SETTLED = 1e-4
"""Variances this near to the steady ones, relative, count as steady."""


@dataclass(frozen=True, slots=True)
class Disturbances:
    """White disturbances that the model does not know, one-sided densities.

    Attributes
    ----------
    force_n
        Force on every body without a ``disturbance_density_n`` of its own [N/sqrt(Hz)].
    voltage_v
        Voltage in every coil's circuit [V/sqrt(Hz)].
    """

    force_n: float = 0.01
    voltage_v: float = 1e-4


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
    settle_samples
        The full covariance runs in stretches of this many samples until, at the end of one, every variance is
        within `SETTLED` of the steady one; then the gain is frozen. A block with an invalid sample never runs
        frozen.

    Attributes
    ----------
    filter
        The filterpy `KalmanFilter`.
    sensors
        Names of the sensors it uses, in the order of its measurement vector.

    Raises
    ------
    ValueError
        If no sensor that it can use is among the channels.
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
    ) -> None:
        self.sample_rate_hz = sample_rate_hz
        self.sources = tuple(sources if sources is not None else choose_inputs(plant, channels))
        used_up = {s.channel for s in self.sources}
        usable = [s for s in plant.sensor if s.kind in OBSERVED_KINDS]
        chosen = [s for s in usable if s.name in channels and s.name not in used_up]
        if not chosen:
            raise ValueError(
                f"none of the channels {', '.join(channels)} is a sensor of plant '{plant.name}' that its observer "
                f"can use; it knows {', '.join(s.name for s in usable) or 'none'}"
            )
        self.sensors = tuple(s.name for s in chosen)
        self._variance = np.array([s.noise_variance(sample_rate_hz) for s in chosen])
        self._disturbances = disturbances or Disturbances()
        self._settle_samples = settle_samples
        self._sensor_columns = np.array([list(channels).index(name) for name in self.sensors])
        # A converter at the end of its range says "at least this much".
        self._ranges = np.array([min((s.range or ABSURD) * (1.0 - 1e-6), ABSURD) for s in chosen])
        self._limits = np.concatenate([np.full(2 * len(self.sources), ABSURD), self._ranges])
        self._drive = DriveReader(self.sources, channels)
        self._u_before: Array | None = None
        self._settled, self._stretch_done = True, 0

        model, discrete = driven_model(plant, self.sources, sample_rate_hz, frequency_hz)
        n, m, p = len(model.states), len(self.sources), len(chosen)
        self._drifting = [b for b in plant.body if b.disturbance_drift_n_s is not None]
        self.states = (*model.states, *(f"d_{b.name}" for b in self._drifting))
        n += len(self._drifting)
        self.filter = KalmanFilter(dim_x=n, dim_z=p, dim_u=2 * m)
        self.set_model(plant, model, discrete)
        self.filter.x = np.zeros((n, 1))
        self.filter.P = self.steady_covariance.copy()
        self._settled = True

    def set_model(self, plant: Plant, model: LinearModel, discrete: DiscreteModel) -> None:
        """Put another model of the same structure in place; state and covariance are carried over.

        Parameters
        ----------
        plant, model, discrete
            The plant and its `twin.plant.inputs.driven_model` by this observer's ``sources``.
        """
        rows = [model.outputs.index(name) for name in self.sensors]
        A, C = self._with_drift(plant, model, rows)
        pad = ((0, len(self._drifting)), (0, 0))
        B0, B1 = np.pad(discrete.B0, pad), np.pad(discrete.B1, pad)
        kf = self.filter
        kf.F = np.ascontiguousarray(expm(A / self.sample_rate_hz)) if self._drifting else discrete.F.copy()
        kf.B = np.hstack([B0, B1])
        kf.H = C
        kf.R = np.diag(self._variance)
        kf.Q = self._process_noise(plant, A, B0, B1)
        self.feedthrough = read_only(model.D[rows])
        prior, _, _ = dare(kf.F.T, kf.H.T, kf.Q, kf.R)
        prior = 0.5 * (prior + prior.T)
        residual = kf.H @ prior @ kf.H.T + kf.R
        gain = np.linalg.solve(residual, kf.H @ prior).T
        self.steady_covariance = read_only(prior - gain @ residual @ gain.T)
        self._inputs = read_only(B0), read_only(B1)
        self._frozen = steady_filter(
            kf.F, B0, B1, kf.H, self.feedthrough, gain, residual, np.sqrt(np.diag(prior))
        )
        self._modes: tuple[Array, Array] | None = None
        self._settled, self._stretch_done = False, 0

    def advance(self, block: Block) -> StateEstimate:
        """Filter one block; the filterpy object holds the state at its last sample afterwards.

        Invalid samples of sensors are skipped, never replaced; an invalid sample of an input repeats the
        last valid one, since the model must be driven by something.
        """
        kf = self.filter
        # A look at the whole block is cheap; the sensors' columns matter only if it finds something.
        whole = bool(block.valid.all()) or bool(block.valid.take(self._sensor_columns, axis=1).all())
        u = self._drive.gather(block)
        if self._u_before is None:
            self._u_before = np.where(np.abs(u[0]) < ABSURD, u[0], 0.0)
        mean = np.empty((len(u), len(kf.x)))
        sums = np.zeros((kernels.STATISTICS, len(self.sensors)))
        last = np.full(len(self.sensors), np.nan)
        n_full = 0
        while n_full < len(u):
            if whole and self._settled:
                if self._advance_frozen(block, u, n_full, last, mean, sums):
                    break
                whole = False  # it said so, but something in it passes a sensor's range or is no number
            # Counted across blocks, so that where a run is cut does not decide when the gain is frozen.
            stretch = slice(n_full, n_full + self._settle_samples - self._stretch_done)
            n_full += self._advance_full(block, u, stretch, last, mean, sums)
        mean.flags.writeable = False
        return self._estimate(mean, sums)

    def _advance_frozen(
        self, block: Block, u: Array, first: int, last: Array, mean: Array, sums: Array
    ) -> bool:
        """Run from row ``first`` on with the steady gain; False, and nothing is changed, if a sample is invalid."""
        kf, frozen = self.filter, self._frozen
        x = kf.x[:, 0]
        # Modal coordinates are kept: going to the states and back would leave traces of where a run is cut.
        if self._modes is not None and np.array_equal(self._modes[0], x):
            modes = self._modes[1].copy()
        else:
            modes = frozen.inverse @ x
        before, last_now, sums_now = self._u_before.copy(), last.copy(), sums.copy()
        if not constant_gain_block(
            frozen.pairs, frozen.columns, frozen.of_signals, frozen.shapes, frozen.normalised_of_modes,
            frozen.normalised_of_signals, frozen.root, self._limits, modes, before, u[first:], block.values[first:],
            self._sensor_columns, last_now, mean[first:], sums_now,
        ):  # fmt: skip
            return False
        self._u_before, last[:], sums[:] = before, last_now, sums_now
        self._modes = mean[-1].copy(), modes
        kf.x, kf.P = mean[-1][:, None].copy(), self.steady_covariance.copy()
        return True

    def _advance_full(
        self, block: Block, u: Array, stretch: slice, last: Array, mean: Array, sums: Array
    ) -> int:
        """Run some rows with the full covariance; how many there were."""
        kf = self.filter
        x, P = kf.x[:, 0].copy(), np.array(kf.P, dtype=np.float64, order="C")
        z = block.values[stretch].take(self._sensor_columns, axis=1)
        valid = block.valid[stretch].take(self._sensor_columns, axis=1)
        with np.errstate(invalid="ignore"):
            valid &= np.abs(z) < self._ranges
        full_covariance_block(
            kf.F, *self._inputs, kf.H, self.feedthrough, kf.Q, self._variance, x, P, self._u_before,
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

    def _is_steady(self, P: Array) -> bool:
        steady = np.diag(self.steady_covariance)
        return bool(np.all(np.abs(np.diag(P) - steady) <= SETTLED * steady))

    def _with_drift(self, plant: Plant, model: LinearModel, rows: list[int]) -> tuple[Array, Array]:
        """System and measurement matrix with the wandering forces as further states."""
        n, extra = len(model.states), len(self._drifting)
        A, C = np.pad(model.A, ((0, extra), (0, extra))), np.pad(model.C[rows], ((0, 0), (0, extra)))
        for column, body in enumerate(self._drifting, start=n):
            A[model.states.index(f"v_{body.name}"), column] = 1.0 / body.mass_kg
            for row, name in enumerate(self.sensors):
                sensor = next(s for s in plant.sensor if s.name == name)
                bodies = (sensor.of,) if isinstance(sensor.of, str) else sensor.of
                if sensor.kind == "acceleration" and body.name in bodies:
                    C[row, column] = (1.0, -1.0)[bodies.index(body.name)] / body.mass_kg
        return A, C

    def _process_noise(self, plant: Plant, A: Array, B0: Array, B1: Array) -> Array:
        """Process noise over one sample: white forces and voltages by Van Loan, and the noise of measured inputs."""
        intensity = np.zeros_like(A)
        for row, state in enumerate(self.states):
            kind, name = state.split("_", 1)
            if kind == "v":
                body = plant.find_body(name)
                density = body.disturbance_density_n
                density = self._disturbances.force_n if density is None else density
                intensity[row, row] = (density / body.mass_kg) ** 2 / 2.0
            elif kind == "d":
                intensity[row, row] = (plant.find_body(name).disturbance_drift_n_s or 0.0) ** 2 / 2.0
            elif kind == "i":
                inductance = getattr(plant.find_actuator(name), "inductance_h", None) or np.inf
                intensity[row, row] = (self._disturbances.voltage_v / inductance) ** 2 / 2.0
        Q = van_loan(A, intensity, 1.0 / self.sample_rate_hz)
        for j, source in enumerate(self.sources):
            variance = source.noise_density**2 * self.sample_rate_hz / 2.0
            Q += variance * (np.outer(B0[:, j], B0[:, j]) + np.outer(B1[:, j], B1[:, j]))
        return Q


def van_loan(A: Array, intensity: Array, dt: float) -> Array:
    """Covariance that white noise of a given two-sided intensity adds over one sample.

    ``integral of expm(A s) W expm(A s)' ds`` from 0 to dt (Van Loan 1978).
    """
    n = len(A)
    big = np.zeros((2 * n, 2 * n))
    big[:n, :n], big[:n, n:], big[n:, n:] = -A * dt, intensity * dt, A.T * dt
    phi = expm(big)
    Q = phi[n:, n:].T @ phi[:n, n:]
    return np.asarray(0.5 * (Q + Q.T))
