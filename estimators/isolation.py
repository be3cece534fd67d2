"""Which sensor is it? What an error of each sensor alone would do to the innovations of all of them.

The filter spreads a sensor's error: an offset of one accelerometer may stand out most in the innovations of another
sensor. How it spreads is known, since the innovations are a linear filter of the measurements, and so the sensor whose
error explains the whole pattern can be told from the one that merely shows it best (the isolation step of the
generalised likelihood ratio, Willsky and Jones 1976, for an error that is constant or a sine).
"""

from dataclasses import dataclass

import numpy as np

from estimators.observer import Observer
from twin.plant.linear import Array, ComplexArray

ALIKE = 0.97
"""Cosine between pattern and signature from which on one sensor's error is taken to explain the pattern."""


@dataclass(frozen=True, slots=True)
class Suspect:
    """The sensor whose error explains the innovations best.

    Attributes
    ----------
    sensor
        Its index.
    likeness
        Cosine between what is seen and what an error of this sensor would cause: 1 explains all.
    error
        The size of its error, in standard deviations of its noise.
    """

    sensor: int
    likeness: float
    error: float


def innovation_signatures(observer: Observer, frequency_hz: float) -> ComplexArray:
    """Response of the normalised innovations to an error of each sensor at one frequency, in the steady state.

    With the steady gain K, ``e = (I - H F (z I - (I - K H) F)^-1 K) f``; normalised by the innovations' Cholesky
    factor as the sequential filter does.

    Parameters
    ----------
    frequency_hz
        0 for an offset.

    Returns
    -------
    ComplexArray
        (p, p): row the innovation, column the sensor in error by one standard deviation of its noise.
    """
    kf = observer.filter
    F, H, R = np.asarray(kf.F), np.asarray(kf.H), np.asarray(kf.R)
    n, p = len(F), len(H)
    K = observer.steady_covariance @ H.T @ np.linalg.inv(R)
    S = np.linalg.inv(np.linalg.inv(R) @ (np.eye(p) - H @ K))
    z = np.exp(2j * np.pi * frequency_hz / observer.sample_rate_hz)
    state = np.linalg.solve(z * np.eye(n) - (np.eye(n) - K @ H) @ F, K)
    response = np.eye(p) - H @ F @ state
    whitening = np.linalg.inv(np.linalg.cholesky(0.5 * (S + S.T)))
    return np.asarray(whitening @ response * np.sqrt(np.diag(R)))


def suspect_of_offset(mean: Array, signatures: ComplexArray) -> Suspect:
    """Sensor whose offset explains mean normalised innovations (p,)."""
    return _closest(mean, signatures.real)


def suspect_of_excess(excess: Array, signatures: ComplexArray) -> Suspect:
    """Sensor whose error at the signatures' frequency explains the innovations' excess power (p,)."""
    found = _closest(np.sqrt(np.maximum(excess, 0.0)), np.abs(signatures))
    # The power of a sine of amplitude a is a²/2.
    return Suspect(found.sensor, found.likeness, found.error * np.sqrt(2.0))


def _closest(pattern: Array, signatures: Array) -> Suspect:
    sizes = np.linalg.norm(signatures, axis=0)
    size = float(np.linalg.norm(pattern))
    # An error that leaves no trace in any innovation explains nothing.
    along = np.divide(pattern @ signatures, sizes, out=np.zeros(len(sizes)), where=sizes > 1e-9)
    best = int(np.argmax(np.abs(along)))
    if size == 0.0 or sizes[best] <= 1e-9:
        return Suspect(best, 0.0, 0.0)
    return Suspect(best, float(abs(along[best]) / size), float(along[best] / sizes[best]))
