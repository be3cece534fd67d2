"""How fast the rig's sample clock runs against the station's clock, from when blocks arrive."""

import math
from collections import deque

import numpy as np

WINDOW_BLOCKS = 50
"""Of so many arrivals the quickest counts: the others waited for somebody."""

MAX_WINDOWS = 720


class ClockDrift:
    """Rate of the rig's clock against this machine's [ppm], with its standard deviation.

    A block that arrives late says nothing about clocks; the quickest of a window comes near the wire's own,
    constant delay. A straight line through these minima is the drift (as in Paxson 1998, sec. 4).
    """

    def __init__(self) -> None:
        self._origin: tuple[float, float] | None = None
        self._window: list[tuple[float, float]] = []
        self._quickest: deque[tuple[float, float]] = deque(maxlen=MAX_WINDOWS)

    def take(self, rig_s: float, arrived_s: float) -> None:
        """Note one block.

        Parameters
        ----------
        rig_s
            The block's end by the rig's sample count [s].
        arrived_s
            When it arrived by this machine's monotonic clock [s].
        """
        if self._origin is None:
            self._origin = (rig_s, arrived_s)
        rig, arrived = rig_s - self._origin[0], arrived_s - self._origin[1]
        self._window.append((arrived, rig - arrived))
        if len(self._window) == WINDOW_BLOCKS:
            self._quickest.append(max(self._window, key=lambda point: point[1]))
            self._window = []

    def restart(self) -> None:
        """Forget everything: the rig's count began anew."""
        self._origin, self._window = None, []
        self._quickest.clear()

    @property
    def ppm(self) -> float:
        """How much faster the rig's clock runs; NaN before three windows."""
        return self._fit()[0]

    @property
    def ppm_std(self) -> float:
        """Standard deviation of `ppm`."""
        return self._fit()[1]

    def _fit(self) -> tuple[float, float]:
        n = len(self._quickest)
        if n < 3:
            return math.nan, math.nan
        t, lead = np.array(self._quickest).T
        t = t - t.mean()
        spread = float(t @ t)
        slope = float(t @ lead) / spread
        residual = lead - lead.mean() - slope * t
        std = math.sqrt(float(residual @ residual) / (n - 2) / spread)
        return slope * 1e6, std * 1e6
