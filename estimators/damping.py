"""Coil damping against frequency, from the absorber's own force balance.

    m2 a2 + k2 (x2 - x1) + c2 (v2 - v1) = f_act

holds for the phasors of measured signals whatever the controller does with them, so that filter phase, which a
damping found by turning gains until the table is quiet would contain, never enters. In phase it gives k2, in
quadrature c2.
"""

import math
from dataclasses import dataclass

import numpy as np

from estimators.kernels import scalar_update
from estimators.types import DampingCurve, DampingStatus, Phasors
from twin.plant.config import DampingTable, Plant
from twin.plant.linear import Array, read_only


@dataclass(frozen=True, slots=True)
class ForceBalance:
    """Damping [Ns/m] and stiffness [N/m] of one block, with standard deviations from its own noise."""

    frequency_hz: float
    damping_ns_m: float
    damping_std_ns_m: float
    stiffness_n_m: float
    stiffness_std_n_m: float
    transient_1_s: float
    """How fast the relative motion's amplitude or phase moves, |A'/A|."""


class AbsorberBalance:
    """The force balance of one plant's absorber on block phasors.

    Parameters
    ----------
    plant
        Gives the absorber's mass, the coil and its force constant.
    channels
        Names of a block's columns.

    Raises
    ------
    ValueError
        If the plant has no voice coil on an absorber, or its accelerations or current are not recorded.
    """

    def __init__(self, plant: Plant, channels: tuple[str, ...]) -> None:
        coil = plant.voice_coil
        absorber = plant.absorber
        if coil is None or coil.between is None or absorber is None:
            raise ValueError("no voice coil acts between two bodies")
        self.mass_kg = absorber.mass_kg
        self.force_constant_n_a = coil.force_constant_n_a
        first, second = coil.between
        self._first = _column(plant, channels, "acceleration", first)
        self._second = _column(plant, channels, "acceleration", second)
        self._current = _column(plant, channels, "current", coil.name)

    def solve(self, phasors: Phasors) -> ForceBalance:
        """Damping and stiffness of one block."""
        w = math.tau * phasors.frequency_hz
        a1, a2 = phasors.amplitude[self._first], phasors.amplitude[self._second]
        relative = complex(a2 - a1)
        drift = complex(phasors.slope[self._second] - phasors.slope[self._first])
        # A moving amplitude: v' + jw v = a, so that v = (a - a'/(jw))/(jw) to first order in the drift.
        velocity = (relative - drift / (1j * w)) / (1j * w)
        displacement = (relative - 2.0 * drift / (1j * w)) / (1j * w) ** 2
        force = self.force_constant_n_a * complex(phasors.amplitude[self._current]) - self.mass_kg * complex(
            a2
        )
        matrix = np.array([[displacement.real, velocity.real], [displacement.imag, velocity.imag]])
        if abs(np.linalg.det(matrix)) < 1e-300:
            return ForceBalance(phasors.frequency_hz, math.nan, math.inf, math.nan, math.inf, math.inf)
        stiffness, damping = np.linalg.solve(matrix, [force.real, force.imag])
        dynamic = stiffness / w**2 - damping / (1j * w)
        noise = (
            self.force_constant_n_a**2 * phasors.variance[self._current]
            + abs(dynamic - self.mass_kg) ** 2 * phasors.variance[self._second]
            + abs(dynamic) ** 2 * phasors.variance[self._first]
        )
        std = math.sqrt(0.5 * noise)
        return ForceBalance(
            frequency_hz=phasors.frequency_hz,
            damping_ns_m=float(damping),
            damping_std_ns_m=std / abs(velocity),
            stiffness_n_m=float(stiffness),
            stiffness_std_n_m=std / abs(displacement),
            transient_1_s=abs(drift) / abs(relative) if relative != 0.0 else math.inf,
        )


@dataclass(frozen=True, slots=True)
class LearnerSettings:
    """How the damping curve is learned.

    Attributes
    ----------
    from_hz, to_hz, step_hz
        Knots of the piecewise-linear curve [Hz].
    prior_std_ns_m, prior_length_hz
        Before anything is measured, the curve may be off by this much, alike over about this many hertz.
    forgetting_ns_m_sqrt_s
        Random walk of the knots beside the excitation [Ns/m per sqrt(s)]; the others keep what they know.
    floor_std_ns_m
        No single block is believed better than this: phase of sensors, curvature between knots.
    transient_std_ns
        And by so much less the faster its amplitudes move [Ns/m per 1/s].
    floor_std_n_m
        The stiffness is not believed better than this, however many blocks agree [N/m].
    rate_limit_ns_m_s
        How fast the value in use follows the learned one.
    max_block_std_ns_m, max_transient_1_s
        Gates: a block with less excitation, or faster transients, is not taken in.
    outlier_sigmas
        A block further from the curve than this is not taken in, unless it is one of several in a row.
    """

    from_hz: float = 35.0
    to_hz: float = 65.0
    step_hz: float = 1.0
    prior_std_ns_m: float = 8.0
    prior_length_hz: float = 10.0
    forgetting_ns_m_sqrt_s: float = 0.05
    floor_std_ns_m: float = 0.03
    transient_std_ns: float = 0.3
    floor_std_n_m: float = 5.0
    rate_limit_ns_m_s: float = 5.0
    max_block_std_ns_m: float = 1.0
    max_transient_1_s: float = 1.0
    outlier_sigmas: float = 6.0


class DampingLearner:
    """A Kalman filter on the knots of a piecewise-linear damping curve.

    Parameters
    ----------
    plant
        Gives the curve to start from.
    """

    def __init__(self, plant: Plant, settings: LearnerSettings | None = None) -> None:
        absorber = plant.absorber
        if absorber is None:
            raise ValueError("the plant has no absorber")
        self.settings = settings = settings or LearnerSettings()
        self._knots = np.arange(settings.from_hz, settings.to_hz + 0.5 * settings.step_hz, settings.step_hz)
        self._mean = np.array([absorber.damping_at(f) for f in self._knots])
        self._in_use = self._mean.copy()
        distance = np.abs(self._knots[:, None] - self._knots[None, :])
        self._prior = settings.prior_std_ns_m**2 * np.exp(-distance / settings.prior_length_hz)
        self._covariance = self._prior.copy()
        self._accepted = self._strays = 0
        self._reason = "nothing measured yet"
        self._stiffness, self._stiffness_variance = math.nan, math.inf
        self._stiffness_weight = self._stiffness_scatter = 0.0

    def advance(self, balance: ForceBalance | None, elapsed_s: float, objection: str = "") -> DampingCurve:
        """Take one block in, unless a gate objects, and move the value in use.

        Parameters
        ----------
        balance
            The block's; None if it had no phasors.
        elapsed_s
            Duration of the block [s].
        objection
            Reason of the caller's not to learn from this block.
        """
        self._reason = objection or self._gate(balance)
        if balance is not None and not self._reason:
            self._take(balance, elapsed_s)
        step = self.settings.rate_limit_ns_m_s * elapsed_s
        wanted = np.maximum(self._mean, 0.0)
        self._in_use += np.clip(wanted - self._in_use, -step, step)
        return self.curve()

    def warm_up(self) -> None:
        """Compile what a block needs, on copies."""
        scalar_update(self._mean.copy(), self._covariance.copy(), np.zeros(len(self._mean)), 1.0, 0.0)

    def curve(self) -> DampingCurve:
        """Copy of what is known at present."""
        variance = np.maximum(np.diag(self._covariance), 0.0)
        coverage = np.clip(1.0 - variance / np.diag(self._prior), 0.0, 1.0)
        return DampingCurve(
            frequency_hz=read_only(self._knots),
            damping_ns_m=read_only(self._mean),
            std_ns_m=read_only(np.sqrt(variance)),
            in_use_ns_m=read_only(self._in_use),
            coverage=read_only(coverage),
            status=self._status(),
            reason=self._reason,
            stiffness_n_m=self._stiffness,
            stiffness_std_n_m=math.sqrt(self._stiffness_variance) if self._accepted else math.nan,
        )

    def table(self) -> DampingTable:
        """Return the curve in use, as a plant takes it."""
        return DampingTable(
            frequency_hz=tuple(float(f) for f in self._knots), ns_m=tuple(float(c) for c in self._in_use)
        )

    def std_at(self, frequency_hz: float) -> float:
        """Standard deviation of the learned value at a frequency [Ns/m]."""
        h = self._weights(frequency_hz)
        return math.sqrt(max(float(h @ self._covariance @ h), 0.0))

    def _take_stiffness(self, balance: ForceBalance) -> None:
        """Weighted mean of the blocks' stiffness; its scatter from block to block says how well it is known."""
        noise = balance.stiffness_std_n_m**2 + (self.settings.floor_std_n_m**2)
        previous = self._stiffness if self._accepted else balance.stiffness_n_m
        innovation = balance.stiffness_n_m - previous
        self._stiffness_weight += 1.0 / noise
        step = innovation / (noise * self._stiffness_weight)
        self._stiffness = previous + step
        self._stiffness_scatter += innovation * (innovation - step) / noise
        # Blocks disagree by more than their noise: model error, shared by neighbours, does not average away.
        excess = max(1.0, self._stiffness_scatter / max(self._accepted, 1))
        self._stiffness_variance = excess * (1.0 / self._stiffness_weight + self.settings.floor_std_n_m**2)

    def _status(self) -> DampingStatus:
        if not np.all(np.isfinite(self._mean)):
            return "invalid"
        if self._accepted == 0:
            return "unestimated"
        return "estimated" if self._accepted >= 10 and not self._reason else "learning"

    def _gate(self, balance: ForceBalance | None) -> str:
        settings = self.settings
        if balance is None:
            return "no excitation"
        if not settings.from_hz <= balance.frequency_hz <= settings.to_hz:
            return f"excitation outside {settings.from_hz:g} to {settings.to_hz:g} Hz"
        if not balance.damping_std_ns_m <= settings.max_block_std_ns_m:
            return "too little excitation"
        if balance.transient_1_s > settings.max_transient_1_s:
            return "transient"
        h = self._weights(balance.frequency_hz)
        sigma = math.sqrt(float(h @ self._covariance @ h) + self._variance(balance))
        if abs(balance.damping_ns_m - float(h @ self._mean)) > settings.outlier_sigmas * sigma:
            self._strays += 1
            if self._strays < 5:
                return "outlier"
            # Several in a row: it is the curve that is wrong, here; what is known elsewhere stays known.
            self._covariance += np.diag((h > 0.0) * np.diag(self._prior))
        self._strays = 0
        return ""

    def _take(self, balance: ForceBalance, elapsed_s: float) -> None:
        settings = self.settings
        h = self._weights(balance.frequency_hz)
        self._covariance += np.diag(h * settings.forgetting_ns_m_sqrt_s**2 * elapsed_s)
        scalar_update(self._mean, self._covariance, h, self._variance(balance), balance.damping_ns_m)
        self._covariance = 0.5 * (self._covariance + self._covariance.T)
        self._take_stiffness(balance)
        self._accepted += 1

    def _variance(self, balance: ForceBalance) -> float:
        """Variance of a block's damping [(Ns/m)²]: its noise, and what the phasors of a moving state get wrong."""
        settings = self.settings
        model_error = settings.floor_std_ns_m + settings.transient_std_ns * balance.transient_1_s
        return balance.damping_std_ns_m**2 + model_error**2

    def _weights(self, frequency_hz: float) -> Array:
        """Hat functions of the knots at a frequency."""
        return np.maximum(0.0, 1.0 - np.abs(self._knots - frequency_hz) / self.settings.step_hz)


def _column(plant: Plant, channels: tuple[str, ...], kind: str, of: str) -> int:
    for sensor in plant.sensor:
        if sensor.kind == kind and sensor.of == of and sensor.name in channels:
            return channels.index(sensor.name)
    raise ValueError(f"no recorded sensor measures the {kind} of '{of}'")
