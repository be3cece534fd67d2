"""A pure delay in the loop: exactly, and as the first-order Taylor form that invents a pole (thesis 6.10).

The Taylor form ``1 - s tau`` (eq. 6-21) is good for margins far shorter than the loop's quickest mode. With
acceleration feedback it raises the order of the loop, and the pole that it adds lies in the right half plane for
every delay once alpha is positive: a loop that is stable comes out unstable. The exact loop has instead an endless
row of poles at ``Re s = ln|d|/tau``, stable for a direct path d of magnitude below 1.
"""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import eig

from twin.control.continuous import Loop
from twin.plant.linear import Array, ComplexArray


def taylor_error(normalised_delay: ArrayLike) -> Array:
    """Relative error of ``1 - j 2 pi t`` for ``e^(-j 2 pi t)``, t the delay over the period (thesis eq. 6-22)."""
    angle = math.tau * np.asarray(normalised_delay, dtype=np.float64)
    return np.asarray(np.abs(np.exp(-1j * angle) - (1.0 - 1j * angle)))


def taylor_poles(loop: Loop, delay_s: float) -> ComplexArray:
    """Closed-loop poles [rad/s] with the delay as ``1 - s tau`` (thesis eq. 6-24, 6-26, for any loop).

    One more than the loop has states where there is a direct path (acceleration feedback through an ideal force).
    """
    if delay_s == 0.0:
        return loop.closed_poles
    n = len(loop.A)
    # x' = A x + b u;  u = law - tau law', law = c x + d u
    left, right = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    left[:n, :n] = np.eye(n)
    left[n, :n], left[n, n] = delay_s * loop.c, delay_s * loop.d
    right[:n, :n], right[:n, n] = loop.A, loop.b
    right[n, :n], right[n, n] = loop.c, loop.d - 1.0
    poles = eig(right, left, right=False)
    return np.asarray(poles[np.isfinite(poles) & (np.abs(poles) < 1e15)])


def invented_pole(loop: Loop, delay_s: float) -> float | None:
    """Where the Taylor form puts the pole that the loop does not have: near ``(1 - 1/d)/tau`` [rad/s].

    d is the direct path, ``-alpha (1/m1 + 1/m2)`` for relative acceleration feedback. Positive, and so unstable for
    however short a delay, with alpha above zero: excitations below the tuned frequency (thesis Figure 6-25).

    Returns
    -------
    float or None
        None if there is no direct path and nothing is invented.
    """
    return None if loop.d == 0.0 else (1.0 - 1.0 / loop.d) / delay_s


def delayed_poles(loop: Loop, delay_s: float, nodes: int = 24) -> ComplexArray:
    """Closed-loop poles [rad/s] with the exact delay, those nearest to the origin first.

    The delay is a line of Chebyshev nodes along which the command travels; the poles of that system are polished by
    Newton's method on the exact characteristic equation. Those the line invents far out do not converge and are
    left out, so the list holds the poles with ``|s tau|`` below about half the number of nodes.
    """
    if delay_s == 0.0:
        return loop.closed_poles[np.argsort(np.abs(loop.closed_poles))]
    D = _chebyshev(nodes) * (2.0 / delay_s)
    n = len(loop.A)
    # Line z from 1 (enters: z = law) to the end (leaves: u = z); z' = -D z along it.
    whole = np.zeros((n + nodes, n + nodes))
    whole[:n, :n], whole[:n, -1] = loop.A, loop.b
    whole[n:, n:] = -D[1:, 1:]
    whole[n:, :n] -= np.outer(D[1:, 0], loop.c)
    whole[n:, -1] -= D[1:, 0] * loop.d
    guesses = np.linalg.eigvals(whole)
    guesses = guesses[(np.abs(guesses) * delay_s < 0.5 * nodes) | (guesses.real > 0.0)]
    found = [_polish(loop, delay_s, complex(s)) for s in guesses]
    poles = np.array([s for s in found if s is not None])
    return np.asarray(poles[np.argsort(np.abs(poles))])


def growth_rate_1_s(loop: Loop, delay_s: float) -> float:
    """Largest real part of the closed-loop poles with the exact delay [1/s]; below 0 is stable."""
    return float(delayed_poles(loop, delay_s).real.max())


def _polish(loop: Loop, delay_s: float, s: complex) -> complex | None:
    """Newton's method on det(s - A - b c q/(1 - d q)), q = exp(-s tau); None if it runs away."""
    start, eye, outer = s, np.eye(len(loop.A)), np.outer(loop.b, loop.c)
    for _ in range(30):
        late = np.exp(-s * delay_s)
        rest = 1.0 - loop.d * late
        matrix = s * eye - loop.A - outer * (late / rest)
        slope = eye + outer * (delay_s * late / rest**2)
        try:
            step = 1.0 / complex(np.trace(np.linalg.solve(matrix, slope)))
        except np.linalg.LinAlgError:
            return s
        s -= step
        if not np.isfinite(s) or abs(s - start) > 1e-3 * abs(start) + 1e-3:
            return None
        if abs(step) < 1e-12 * abs(s):
            break
    return s


def _chebyshev(nodes: int) -> Array:
    """Differentiation matrix on the nodes cos(pi k/n) mirrored to run from -1 to 1, (n + 1, n + 1)."""
    k = np.arange(nodes + 1)
    x = -np.cos(np.pi * k / nodes)
    weight = np.where((k == 0) | (k == nodes), 2.0, 1.0) * (-1.0) ** k
    apart = x[:, None] - x + np.eye(nodes + 1)
    D = np.outer(weight, 1.0 / weight) / apart
    return np.asarray(D - np.diag(D.sum(axis=1)))
