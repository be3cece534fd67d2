"""Coil damping and absorber stiffness of one block, from the absorber's own force balance.

    m2 a2 + k2 (x2 - x1) + c2 (v2 - v1) = f_act

holds for measured signals whatever the controller does with them, so that filter phase, which a damping found by
turning gains until the table is quiet would contain, never enters. Locked in to the excitation its in-phase part
gives k2, its quadrature part c2. The equation is taken against smooth test functions (`moments`), so that motion
which grows, is swept or shaken from elsewhere keeps it too. Neither a model stiffness nor the controller's delay is
used.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.balance_noise import BalanceNoise
from estimators.moments import MOST_DERIVATIVES, moments
from estimators.types import Phasors
from twin.plant.compiled import kernel
from twin.plant.config import MOTION_UNITS, Plant
from twin.plant.linear import Array, ComplexArray, read_only

DERIVATIVES_MISSING = {kind: order for order, kind in enumerate(reversed(MOTION_UNITS))}
"""How often a motion must be differentiated to become an acceleration."""


@dataclass(frozen=True, slots=True)
class ForceBalance:
    """Damping and stiffness of one block, with standard deviations from its own noise.

    Attributes
    ----------
    damping_ns_m, damping_std_ns_m, stiffness_n_m, stiffness_std_n_m
        Numbers in any case; the standard deviations are infinite where nothing can be told.
    transient_1_s
        How fast the relative motion's amplitude or phase moves, |A'/A|.
    damping_per_delay_ns_m_s, stiffness_per_delay_n_m_s
        (3,) what a second of delay in the motion of the first body, of the second, and in the current would add.
        The three add up to nothing: a delay that all channels share does not matter.
    steady
        Whether the excitation's frequency went on as before.
    """

    frequency_hz: float
    damping_ns_m: float
    damping_std_ns_m: float
    stiffness_n_m: float
    stiffness_std_n_m: float
    transient_1_s: float
    damping_per_delay_ns_m_s: Array
    stiffness_per_delay_n_m_s: Array
    steady: bool = True


class AbsorberBalance:
    """The force balance of one plant's absorber on block phasors, block after block.

    All recorded motions of the two bodies are used, weighted by their own noise. Noise that is common motion of
    both bodies, a draught or a step on the floor, obeys the balance too and does not disturb it: what is left of it
    is learned from the phasors beside the excitation, over the last blocks.

    Parameters
    ----------
    plant
        Gives the absorber's mass, the coil and its force constant.
    channels
        Names of a block's columns.

    Raises
    ------
    ValueError
        If the plant has no voice coil on an absorber, or its motion or current is not recorded.
    """

    def __init__(self, plant: Plant, channels: tuple[str, ...]) -> None:
        coil = plant.voice_coil
        absorber = plant.absorber
        if coil is None or coil.between is None or absorber is None:
            raise ValueError("no voice coil acts between two bodies")
        self.mass_kg = absorber.mass_kg
        self.force_constant_n_a = coil.force_constant_n_a
        motions = _motions(plant, channels, coil.between)
        current = _current(plant, channels, coil.name)
        stated = {s.name: s.noise_density for s in plant.sensor}
        self._columns = np.array([*(column for column, _, _ in motions), current])  # the current last
        self._noise_density = np.array([stated[channels[column]] for column in self._columns])
        self._orders = np.array([order for _, order, _ in motions])
        self._geometry = np.array([weights for _, _, weights in motions])
        self._balance_noise = BalanceNoise(len(motions) + 1)
        sensors = {s.name: s for s in plant.sensor}
        self._stages = [sensors[channels[column]].input_stage for column in self._columns]
        self._has_stages = any(stage(1j) != 1.0 for stage in self._stages)
        self._signs = (-1.0) ** self._orders
        self._shares: dict[bytes, Array | None] = {}

    def solve(self, phasors: Phasors) -> ForceBalance:
        """Damping and stiffness of one block."""
        w = math.tau * phasors.frequency_hz
        variance = phasors.sample_variance[self._columns]
        share = self._share(w ** (2.0 * self._orders) * variance[:-1])
        if share is None or not math.isfinite(variance[-1]):
            return _nothing(phasors)
        tests = self._tests(phasors, share)
        of_stiffness, of_damping, force = tests.terms
        determinant = of_stiffness.real * of_damping.imag - of_stiffness.imag * of_damping.real
        if not abs(determinant) > 1e-12 * abs(of_stiffness) * abs(of_damping):
            return _nothing(phasors)
        inverse = (
            np.array([[of_damping.imag, -of_damping.real], [-of_stiffness.imag, of_stiffness.real]])
            / determinant
        )
        stiffness, damping = (inverse @ (force.real, force.imag)).tolist()
        std = math.sqrt(0.5 * self._noise(tests, stiffness, damping))
        late = -1j * w * tests.bodies_and_coil(stiffness, damping)
        per_delay = inverse @ np.array([late.real, late.imag])
        relative = self._relative(phasors, share)
        return ForceBalance(
            frequency_hz=phasors.frequency_hz,
            damping_ns_m=damping,
            damping_std_ns_m=std * math.hypot(*inverse[1].tolist()),
            stiffness_n_m=stiffness,
            stiffness_std_n_m=std * math.hypot(*inverse[0].tolist()),
            transient_1_s=relative,
            damping_per_delay_ns_m_s=read_only(per_delay[1]),
            stiffness_per_delay_n_m_s=read_only(per_delay[0]),
            steady=phasors.steady,
        )

    def _share(self, variance: Array) -> Array | None:
        """`_weighted`, remembered where only which motions are seen decides."""
        seen = np.isfinite(variance)
        if np.count_nonzero(seen) > 2:
            return _weighted(self._geometry, variance)
        key = seen.tobytes()
        if key not in self._shares:
            self._shares[key] = _weighted(self._geometry, variance)
        return self._shares[key]

    def _tests(self, phasors: Phasors, share: Array) -> "_Tests":
        """The balance against each test function of a block."""
        highest = 2 + int(self._orders.max())
        found = moments(
            phasors.samples[:, self._columns],
            phasors.duration_s,
            phasors.frequency_hz,
            min(highest + self._has_stages, MOST_DERIVATIVES),
        )
        full = found.against_derivatives
        if self._has_stages:
            full = self._before_input_stages(full, math.tau * found.frequency_hz)
        # <a, psi^(m)> = (-1)^n <y, psi^(m+n)> for y that lacks n derivatives, m = 0, 1, 2.
        rows, motions = np.arange(3)[:, None] + self._orders, np.arange(len(self._orders))
        accelerations = (self._signs * full[:, rows, motions]) @ share.T
        # In a channel's own residual common motion would count as noise: that of its sensor is the measure.
        variance = self._noise_density**2 * (0.5 * len(phasors.samples) / phasors.duration_s)
        return _Tests(
            accelerations=accelerations,
            coil_force=self.force_constant_n_a * full[:, 2, -1],
            mass_kg=self.mass_kg,
            share=share,
            orders=self._orders,
            gram=found.gram,
            motion_variance=variance[:-1],
            force_variance=self.force_constant_n_a**2 * float(variance[-1]),
        )

    def _before_input_stages(self, full: ComplexArray, w: Array) -> ComplexArray:
        """Moments of what the sensors felt, from those of what was recorded behind their input stages.

        With ``1/S(s)`` to first order about ``j w``, S the stage: ``x = C y + C' (y' - j w y)``, and a derivative
        of y is one of the test function with the other sign. Exact at steady state, and of first order while
        amplitudes move.
        """
        out = full.copy()
        for k, omega in enumerate(w):
            for c, stage in enumerate(self._stages):
                s, step = 1j * omega, 1e-4j * omega
                if stage(s) == 1.0:
                    continue
                inverse = 1.0 / stage(s)
                slope = (1.0 / stage(s + step) - 1.0 / stage(s - step)) / (2.0 * step)
                out[k, :, c] *= inverse
                out[k, :-1, c] += slope * (-full[k, 1:, c] - s * full[k, :-1, c])
        return out

    def _relative(self, phasors: Phasors, share: Array) -> float:
        """|A'/A| of the relative motion [1/s]."""
        turn = (2j * math.pi * phasors.frequency_hz) ** self._orders
        difference = (share[1] - share[0]) * turn
        size = abs(complex(difference @ phasors.amplitude[self._columns[:-1]]))
        drift = abs(complex(difference @ phasors.slope[self._columns[:-1]]))
        return drift / size if size > 0.0 else math.inf

    def _noise(self, tests: "_Tests", stiffness: float, damping: float) -> float:
        """E|error|² of the balance at the excitation, the first of the tests; the others are beside it."""
        shares, powers = tests.errors(stiffness, damping)
        excess = self._balance_noise.take(shares[1:], powers[1:]) if len(powers) > 1 else 1.0
        return excess * float(shares[0] @ self._balance_noise.factors)


@dataclass(frozen=True, slots=True)
class _Tests:
    """``k2 <a_r, psi> - c2 <a_r, psi'> = <f_act - m2 a2, psi''>`` for K test functions, the excitation's first."""

    accelerations: ComplexArray
    """(K, 3, 2) <a, psi^(m)> of both bodies."""
    coil_force: ComplexArray
    """(K,) <f_act, psi''>."""
    mass_kg: float
    share: Array
    orders: NDArray[np.int64]
    gram: ComplexArray
    motion_variance: Array
    force_variance: float

    @property
    def terms(self) -> tuple[complex, complex, complex]:
        """What stands beside the stiffness, beside the damping, and on the other side, at the excitation."""
        (x0, y0), (x1, y1), (_, y2) = self.accelerations[0].tolist()
        return y0 - x0, x1 - y1, complex(self.coil_force[0]) - self.mass_kg * y2

    def bodies_and_coil(self, stiffness: float, damping: float) -> ComplexArray:
        """(3,) what the first body's motion, the second's and the coil's force add to the error at the excitation."""
        (x0, y0), (x1, y1), (_, y2) = self.accelerations[0].tolist()
        first, second = stiffness * x0 - damping * x1, stiffness * y0 - damping * y1
        return np.array([first, -second - self.mass_kg * y2, self.coil_force[0]])

    def errors(self, stiffness: float, damping: float) -> tuple[Array, Array]:
        """(K, n + 1) E|error|² by the stated noise of each motion and of the current, and (K,) |error|² itself."""
        K, n = len(self.coil_force), len(self.orders)
        shares, powers = np.zeros((K, n + 1)), np.empty(K)
        bodies = np.array([[stiffness, -damping, 0.0], [-stiffness, damping, -self.mass_kg]])
        errors_of_tests(
            self.accelerations, self.coil_force, self.gram, bodies, self.share, self.orders, self.motion_variance,
            self.force_variance, shares, powers,
        )  # fmt: skip
        return shares, powers


@kernel
def errors_of_tests(
    accelerations: ComplexArray,
    coil_force: ComplexArray,
    gram: ComplexArray,
    bodies: Array,
    share: Array,
    orders: NDArray[np.int64],
    motion_variance: Array,
    force_variance: float,
    shares: Array,
    powers: Array,
) -> None:
    """Power of the balance's error against each test function, and what noise would give it, in place.

    Parameters
    ----------
    accelerations, coil_force, gram
        (K, 3, 2), (K,) and (K, d + 1, d + 1), see `_Tests` and `estimators.moments`.
    bodies
        (2, 3) what each body's <a, psi>, <a, psi'> and <a, psi''> add to the error.
    share
        (2, n) weights that make two bodies' accelerations of n measured motions.
    orders
        (n,) derivatives that each motion lacks to be an acceleration.
    motion_variance, force_variance
        (n,) of one sample of each motion, and of the coil's force.
    shares, powers
        (K, n + 1) and (K,), receive the results.
    """
    n = len(orders)
    weights = np.zeros((n, 3))
    for c in range(n):
        for m in range(3):
            weights[c, m] = share[0, c] * bodies[0, m] + share[1, c] * bodies[1, m]
    for k in range(len(coil_force)):
        error = coil_force[k]
        for m in range(3):
            error += bodies[0, m] * accelerations[k, m, 0] + bodies[1, m] * accelerations[k, m, 1]
        powers[k] = error.real * error.real + error.imag * error.imag
        for c in range(n):
            power, at = 0.0, orders[c]
            for m in range(3):
                for q in range(3):
                    power += weights[c, m] * weights[c, q] * gram[k, at + m, at + q].real
            shares[k, c] = power * motion_variance[c]
        shares[k, n] = force_variance * gram[k, 2, 2].real


def _nothing(phasors: Phasors) -> ForceBalance:
    none = read_only(np.zeros(3))
    return ForceBalance(
        phasors.frequency_hz, 0.0, math.inf, 0.0, math.inf, math.inf, none, none, phasors.steady
    )  # fmt: skip


def _weighted(geometry: Array, variance: Array) -> Array | None:
    """(2, n) weights that make two bodies' accelerations of n measured ones; None if those do not tell both."""
    seen = np.isfinite(variance)
    if np.linalg.matrix_rank(geometry[seen]) < 2:
        return None
    share = np.zeros((2, len(variance)))
    if np.count_nonzero(seen) == 2:
        share[:, seen] = np.linalg.inv(geometry[seen])
        return share
    floor = 1e-12 * max(float(variance[seen].max()), 1e-300)
    weight = geometry[seen] / np.maximum(variance[seen], floor)[:, None]
    share[:, seen] = np.linalg.solve(weight.T @ geometry[seen], weight.T)
    return share


def _motions(
    plant: Plant, channels: tuple[str, ...], between: tuple[str, str]
) -> list[tuple[int, int, tuple[float, float]]]:
    """Column, derivatives missing and what it measures of the first and the second body."""
    found = []
    for sensor in plant.sensor:
        if sensor.kind not in MOTION_UNITS or sensor.name not in channels:
            continue
        pair = (sensor.of,) if isinstance(sensor.of, str) else sensor.of
        weights = dict(zip(pair, (1.0, -1.0), strict=False))
        if set(weights) <= set(between):
            of = (weights.get(between[0], 0.0), weights.get(between[1], 0.0))
            found.append((channels.index(sensor.name), DERIVATIVES_MISSING[sensor.kind], of))
    for body, place in zip(between, (0, 1), strict=True):
        if not any(weights[place] for _, _, weights in found):
            raise ValueError(f"no recorded sensor measures the motion of '{body}'")
    if np.linalg.matrix_rank(np.array([weights for _, _, weights in found])) < 2:
        raise ValueError(
            f"the recorded sensors measure only the difference of '{between[0]}' and '{between[1]}': "
            "one must measure either against the ground"
        )
    return found


def _current(plant: Plant, channels: tuple[str, ...], coil: str) -> int:
    for sensor in plant.sensor:
        if sensor.kind == "current" and sensor.of == coil and sensor.name in channels:
            return channels.index(sensor.name)
    raise ValueError(f"no recorded sensor measures the current of '{coil}'")
