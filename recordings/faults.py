"""What goes wrong in a recorded case: done to the samples between the rig and everything that looks at them."""

from typing import Any

import numpy as np

from twin.plant.errors import InputError
from twin.plant.linear import Array


class Fault:
    """One fault of a case's configuration.

    Parameters
    ----------
    config
        ``kind`` (``stuck``: the last value stays, ``lost``: every second block never arrives, ``clipped``: at
        ``limit`` in the channel's SI unit), ``from_s``, ``to_s``, and ``channel`` but for lost blocks.
    channels
        Names of the columns.
    sample_rate_hz
        Of the samples.

    Raises
    ------
    InputError
        If there is no such fault or channel.
    """

    def __init__(self, config: dict[str, Any], channels: tuple[str, ...], sample_rate_hz: float) -> None:
        self._kind, self._rate = config["kind"], sample_rate_hz
        self._range_s = (config["from_s"], config["to_s"])
        self._limit = config.get("limit")
        self._held: float | None = None
        self._blocks = 0
        if self._kind not in ("stuck", "lost", "clipped"):
            raise InputError(f"fault.kind '{self._kind}' is not known; use stuck, lost or clipped")
        self._column = 0
        if self._kind != "lost":
            if config["channel"] not in channels:
                raise InputError(
                    f"fault.channel '{config['channel']}' is not recorded; use one of {channels}"
                )
            self._column = channels.index(config["channel"])

    def apply(self, values: Array, first_sample: int) -> Array:
        """The block's values (n, n_channels) as they arrive; NaN where nothing does."""
        low, high = self._range_s
        middle_s = (first_sample + 0.5 * len(values)) / self._rate
        if not low <= middle_s < high:
            return values
        out, column = np.array(values, dtype=np.float64), self._column
        self._blocks += 1
        if self._kind == "lost":
            if self._blocks % 2:
                out[:] = np.nan
        elif self._kind == "stuck":
            self._held = float(out[0, column]) if self._held is None else self._held
            out[:, column] = self._held
        else:
            np.clip(out[:, column], -self._limit, self._limit, out=out[:, column])
        return out
