"""How far a delayed loop is from instability: exact delay margin, modulus margin, unstable poles counted twice.

A pair of closed-loop poles crosses the imaginary axis at jw when ``L(jw) e^(-jw tau) = -1``, hence only where
``|L(jw)| = 1``. It crosses to the right where |L| falls with frequency and to the left where it rises, whatever
tau is (Cooke and van den Driessche, 1986). The crossings are found as eigenvalues of a Hamiltonian matrix, so no
grid can step over a sharp one.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from twin.control.continuous import Loop
from twin.plant.linear import Array, ComplexArray

LONGEST_DELAY_S = 8e-3
"""Delays are searched below this one: longer than any chain of converters and filters is late."""


@dataclass(frozen=True, slots=True)
class Crossing:
    """A frequency at which |L| = 1, and what delay does there.

    Attributes
    ----------
    angular_frequency
        w [rad/s].
    first_delay_s
        Least delay that puts a pole pair on the axis there; it recurs every period 2 pi/w.
    destabilises
        True if the pair goes to the right as the delay grows.
    """

    angular_frequency: float
    first_delay_s: float
    destabilises: bool


def is_stable_without_delay(loop: Loop) -> bool:
    """Whether all closed-loop poles lie left of the axis when there is no delay; on it does not count."""
    return unstable_poles_without_delay(loop) == 0


def unstable_poles_without_delay(loop: Loop) -> int:
    """Closed-loop poles on the imaginary axis or right of it without delay, up to rounding."""
    poles = loop.closed_poles
    if not np.isfinite(poles).all():
        return len(poles)
    size = np.abs(poles)
    return int(np.count_nonzero(poles.real >= -1e-12 * size - 1e-15 * size.max()))


def crossings(loop: Loop) -> tuple[Crossing, ...]:
    """All frequencies above zero at which the loop gain has magnitude 1, ascending."""
    found = []
    edges = _separators(loop)
    level = _excess(loop, edges)
    clear = np.abs(level) > 1e-9  # a separator may hit a crossing to the last digit
    edges, level = edges[clear], level[clear]
    for k in np.nonzero(level[:-1] * level[1:] < 0.0)[0]:
        w = brentq(lambda x: float(_excess(loop, np.array([x]))[0]), edges[k], edges[k + 1], rtol=1e-14)
        gain = complex(loop.gain(1j * w)[0])
        found.append(Crossing(w, (math.atan2(-gain.imag, -gain.real) % math.tau) / w, bool(level[k] > 0.0)))
    return tuple(found)


def delay_margin_s(loop: Loop, longest_s: float = LONGEST_DELAY_S) -> float | None:
    """Least delay that makes a loop unstable, exact [s].

    Counted from no delay at all: a delay that the loop already has uses the margin up.

    Returns
    -------
    float or None
        None if no delay below ``longest_s`` destabilises; 0.0 if the loop is unstable without delay, or if any
        delay however short destabilises it (a direct path of magnitude 1 or more, as strong acceleration feedback
        through an ideal force has: ``alpha (1/m1 + 1/m2)``).
    """
    if not is_stable_without_delay(loop) or abs(loop.d) >= 1.0:
        return 0.0
    delays = [x.first_delay_s for x in crossings(loop) if x.destabilises]
    least = min(delays, default=math.inf)
    return least if least < longest_s else None


def unstable_poles(loop: Loop, delay_s: float) -> float:
    """Closed-loop poles not left of the axis at a delay, counted along the delay from none; may be infinite."""
    count: float = unstable_poles_without_delay(loop)
    if delay_s == 0.0:
        return count
    if abs(loop.d) >= 1.0:
        return math.inf
    for x in crossings(loop):
        if x.first_delay_s <= delay_s:
            times = 1 + math.floor((delay_s - x.first_delay_s) * x.angular_frequency / math.tau)
            count += 2 * times if x.destabilises else -2 * times
    return count


def unstable_poles_by_winding(loop: Loop, delay_s: float) -> int:
    """Count closed-loop poles right of the axis by the argument principle: turns of ``1 + L e^(-s tau)`` around 0.

    Independent of `unstable_poles`. Needs an open loop without poles on the axis and, with a delay, a direct path
    of magnitude below 1. Counts of a thousand and more are too low: the delay turns the curve faster, up there, than
    it is sampled.
    """
    top = 100.0 * float(np.abs(loop.open_poles).max())
    while abs(_excess(loop, np.array([top]))[0] + 1.0) > 0.5 + 0.5 * abs(loop.d) and top < 1e12:
        top *= 10.0
    w = np.concatenate([[0.0], _around_poles(loop, top), np.geomspace(1e-3, top, 400)])
    if delay_s > 0.0:
        w = np.concatenate([w, np.arange(0.0, min(top, 4e3 / delay_s), 0.5 / delay_s)])
    w = np.unique(w[w <= top])
    value = _one_plus(loop, w, delay_s)
    for _ in range(60):
        turn = np.abs(np.angle(value[1:] / value[:-1]))
        wide = np.nonzero((turn > 0.5) & (np.diff(w) > 1e-13 * w[1:]))[0]
        if not len(wide):
            break
        middle = 0.5 * (w[wide] + w[wide + 1])
        w = np.insert(w, wide + 1, middle)
        value = np.insert(value, wide + 1, _one_plus(loop, middle, delay_s))
    turned = float(np.sum(np.angle(value[1:] / value[:-1])))
    # Beyond the top the curve stays right of 0 and ends on the positive real axis.
    turned -= float(np.angle(value[-1])) if abs(loop.d) < 1.0 else 0.0
    right = int(np.count_nonzero(loop.open_poles.real > 0.0))
    return right - round(turned / math.pi)


def modulus_margin(loop: Loop, delay_s: float = 0.0) -> float:
    """Least distance of the delayed loop gain from -1 over all frequencies, min |1 + L|.

    A grid that is dense around every pole, then each of its deepest valleys narrowed down; the limits at zero and
    infinite frequency count. Of an unstable loop the distance is no margin, and with gains that keep |L| above 1 over
    thousands of turns of the delay it is found to a few digits only.
    """
    poles = np.concatenate([loop.open_poles, loop.closed_poles])
    top = 10.0 * float(np.abs(poles[np.isfinite(poles)]).max())
    w = np.concatenate([_around_poles(loop, top), np.geomspace(1e-3, top, 3000)])
    if delay_s > 0.0:
        loud = np.abs(loop.gain(1j * np.geomspace(1.0, top, 300))) > 0.02
        reach = float(np.geomspace(1.0, top, 300)[loud].max()) if loud.any() else 0.0
        step = 0.3 / delay_s
        w = np.concatenate([w, np.arange(step, min(reach, 2e4 * step), step)])
    w = np.unique(w)
    w = w[np.diff(w, prepend=0.0) > 1e-9 * w]  # twins would pinch a valley between them
    size = np.abs(_one_plus(loop, w, delay_s))
    inner = np.nonzero((size[1:-1] <= size[:-2]) & (size[1:-1] <= size[2:]))[0] + 1
    best = min(float(size.min()), abs(complex(_one_plus(loop, np.array([0.0]), 0.0)[0])))
    best = min(best, abs(1.0 - loop.d) if delay_s == 0.0 else abs(1.0 - abs(loop.d)))
    for k in inner[np.argsort(size[inner])[:12]]:
        near = np.array([w[k - 1], w[k + 1]])
        for _ in range(10):  # each pass narrows the valley tenfold
            near = np.linspace(near[0], near[-1], 21)
            depth = np.abs(_one_plus(loop, near, delay_s))
            lowest = int(np.argmin(depth))
            best = min(best, float(depth[lowest]))
            near = near[[max(lowest - 1, 0), min(lowest + 1, 20)]]
    return best


def _one_plus(loop: Loop, w: Array, delay_s: float) -> ComplexArray:
    s = 1j * w
    return np.asarray(1.0 + loop.gain(s) * np.exp(-s * delay_s))


def _excess(loop: Loop, w: Array) -> Array:
    """|L| - 1, (n,)."""
    return np.asarray(np.abs(loop.gain(1j * w)) - 1.0)


def _around_poles(loop: Loop, top: float) -> Array:
    """Frequencies [rad/s] around every pole of open and closed loop, as dense as the pole is sharp."""
    spread = np.concatenate([np.linspace(0.05, 2.0, 14), np.geomspace(2.3, 60.0, 12)])
    spread = np.concatenate([-spread[::-1], spread])
    poles = np.concatenate([loop.open_poles, loop.closed_poles[np.isfinite(loop.closed_poles)]])
    poles = poles[poles.imag >= 0.0]
    width = np.maximum(np.abs(poles.real), 1e-7 * np.abs(poles))
    points = (np.abs(poles)[:, None] + width[:, None] * spread).ravel()
    return np.unique(points[(points > 0.0) & (points < top)])


def _separators(loop: Loop) -> Array:
    """Frequencies [rad/s] between which |L| = 1 happens at most once.

    The crossings are imaginary eigenvalues of the Hamiltonian of ``|L|² - 1``. All its eigenvalues serve, so that
    none is lost to a tolerance: a crossing lies between the midpoints around one of them.
    """
    A, b, c = loop.balanced
    level = float(np.linalg.norm(c)) / max(float(np.linalg.norm(b)), 1e-300)
    b, c = b * math.sqrt(level), c / math.sqrt(max(level, 1e-300))
    top = 100.0 * float(np.abs(loop.open_poles).max())
    points = [_around_poles(loop, top), np.geomspace(1e-4, 1e3 * top, 60)]
    rest = 1.0 - loop.d**2
    if rest != 0.0:
        shifted = A + np.outer(b, c) * (loop.d / rest)
        hamiltonian = np.block(
            [
                [shifted, np.outer(b, b) / rest],
                [-np.outer(c, c) * (1.0 + loop.d**2 / rest), -shifted.T],
            ]
        )
        exact = np.sort(np.abs(np.linalg.eigvals(hamiltonian).imag))
        exact = exact[exact > 1e-9]
        if len(exact):
            near = np.concatenate([[0.5 * exact[0]], 0.5 * (exact[1:] + exact[:-1]), [2.0 * exact[-1]]])
            points.append(near[near > 0.0])
    return np.unique(np.concatenate(points))
