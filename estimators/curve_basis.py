"""Families of curves against frequency whose coefficients a filter can learn."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from twin.plant.linear import Array, read_only


class CurveBasis(Protocol):
    """A curve that is linear in its coefficients."""

    @property
    def knots_hz(self) -> Array:
        """(n_knots,) frequencies at which the curve is told; straight lines between them."""
        ...

    @property
    def size(self) -> int:
        """Number of coefficients."""
        ...

    def weights(self, frequency_hz: float) -> Array:
        """(size,) what each coefficient adds to the curve at a frequency."""
        ...

    def start(self, values: Array) -> Array:
        """(size,) coefficients of the curve closest to values at the knots."""
        ...

    def prior(self, std: float, length_hz: float) -> Array:
        """(size, size) covariance of coefficients of curves off by ``std``, alike over ``length_hz``."""
        ...

    def forgetting(self, frequency_hz: float, variance: float) -> Array:
        """(size, size) covariance that makes the curve less certain at a frequency, elsewhere as little as can be."""
        ...


@dataclass(frozen=True)
class PiecewiseLinear:
    """Straight lines between knots: supposes no shape but that neighbours are alike.

    Attributes
    ----------
    from_hz, to_hz, step_hz
        First and last knot and the distance between knots [Hz].
    """

    from_hz: float
    to_hz: float
    step_hz: float

    @cached_property
    def knots_hz(self) -> Array:
        """(n,) knots [Hz]."""
        return _grid(self.from_hz, self.to_hz, self.step_hz)

    @property
    def size(self) -> int:
        """Number of knots."""
        return len(self.knots_hz)

    def weights(self, frequency_hz: float) -> Array:
        """Hat functions of the knots at a frequency; held beyond the ends."""
        knots = self.knots_hz
        f = min(max(frequency_hz, float(knots[0])), float(knots[-1]))
        return np.maximum(0.0, 1.0 - np.abs(knots - f) / self.step_hz)

    def start(self, values: Array) -> Array:
        """The values themselves."""
        return np.array(values, dtype=np.float64)

    def prior(self, std: float, length_hz: float) -> Array:
        """Matérn covariance of order 3/2: the slope goes on, its change is anyone's guess."""
        scaled = np.sqrt(3.0) * np.abs(self.knots_hz[:, None] - self.knots_hz[None, :]) / length_hz
        return np.asarray(std**2 * (1.0 + scaled) * np.exp(-scaled))

    def forgetting(self, frequency_hz: float, variance: float) -> Array:
        """On the knots beside the frequency."""
        h = self.weights(frequency_hz)
        return np.diag(h * (variance / float(h @ h)))


@dataclass(frozen=True)
class Quadratic:
    """``c + a f + b f²``, the family that the thesis fits its Test 2 with (Table 7-6).

    The coefficients are those of 1, u and u² with u from -1 at ``from_hz`` to 1 at ``to_hz``.

    Attributes
    ----------
    from_hz, to_hz, step_hz
        Where the curve is told [Hz].
    """

    from_hz: float
    to_hz: float
    step_hz: float

    @cached_property
    def knots_hz(self) -> Array:
        """(n,) frequencies at which the curve is told [Hz]."""
        return _grid(self.from_hz, self.to_hz, self.step_hz)

    @property
    def size(self) -> int:
        """Three."""
        return 3

    def weights(self, frequency_hz: float) -> Array:
        """1, u and u²; held beyond the ends."""
        u = (2.0 * frequency_hz - self.from_hz - self.to_hz) / (self.to_hz - self.from_hz)
        u = min(max(u, -1.0), 1.0)
        return np.array([1.0, u, u * u])

    def start(self, values: Array) -> Array:
        """Least squares over the knots."""
        rows = np.array([self.weights(float(f)) for f in self.knots_hz])
        return np.asarray(np.linalg.lstsq(rows, np.asarray(values, dtype=np.float64))[0])

    def prior(self, std: float, length_hz: float) -> Array:
        """Independent coefficients; slope and curvature as large as the length allows over the range."""
        reach = 0.5 * (self.to_hz - self.from_hz) / length_hz
        return np.diag([std**2, (std * reach) ** 2, (std * reach**2 / 2.0) ** 2])

    def forgetting(self, frequency_hz: float, variance: float) -> Array:
        """Along the one direction that the frequency sees."""
        h = self.weights(frequency_hz)
        return np.outer(h, h) * (variance / float(h @ h) ** 2)


def _grid(from_hz: float, to_hz: float, step_hz: float) -> Array:
    return read_only(np.arange(from_hz, to_hz + 0.5 * step_hz, step_hz))
