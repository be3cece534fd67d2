"""The loop that the analysis looks at, in time: any excitation, exact at its samples."""

import numpy as np
from numpy.typing import ArrayLike

from twin.control.continuous import SIGNALS, Loop
from twin.plant.discrete import discretise, simulate_block
from twin.plant.linear import Array, LinearModel, read_only


def closed_model(loop: Loop) -> LinearModel:
    """Closed loop without delay from its excitation to its signals, as a plant.

    Returns
    -------
    LinearModel
        One input, ``excitation``; outputs `twin.control.continuous.SIGNALS` in m, m, N, A, V, NaN where there is
        no driven coil.

    Raises
    ------
    ValueError
        If the law answers its own force instantly with the same: such a loop has no solution.
    """
    rest = 1.0 - loop.d
    if rest == 0.0:
        raise ValueError(
            "the law answers its own force with the same force at once: the loop has no solution"
        )
    asked, feed = loop.c / rest, loop.h / rest
    return LinearModel(
        A=read_only(loop.A + np.outer(loop.b, asked)),
        B=read_only((loop.e + loop.b * feed)[:, None]),
        C=read_only(loop.rows + np.outer(loop.feed, asked)),
        D=read_only((loop.feed * feed)[:, None]),
        states=tuple(f"s{k}" for k in range(len(loop.A))),
        inputs=("excitation",),
        outputs=SIGNALS,
    )


def loop_response(
    loop: Loop, excitation: ArrayLike, sample_rate_hz: float, start: ArrayLike | None = None
) -> Array:
    """Signals of a closed loop without delay, its excitation joined by straight lines between the samples.

    There is no step error: the loop is discretised exactly. A sampled controller with its delay, its hold and its
    clamp is `twin.rig.simulated.SimulatedRig`.

    Parameters
    ----------
    excitation
        (N,) in the unit of the loop's excitation.
    start
        (n,) states at the first sample; None is rest.

    Returns
    -------
    ndarray
        (N, 5) in the order and units of `twin.control.continuous.SIGNALS`.

    Raises
    ------
    ValueError
        As `closed_model`.
    """
    model = closed_model(loop)
    u = np.ascontiguousarray(np.asarray(excitation, dtype=np.float64).reshape(-1, 1))
    x = np.zeros(len(model.A)) if start is None else np.array(start, dtype=np.float64)
    d = discretise(model, sample_rate_hz, ["foh"])
    y = np.empty((len(u), len(model.C)))
    if len(u):
        y[0] = model.C @ x + model.D @ u[0]
        simulate_block(d.F, d.B0, d.B1, d.C, d.D, x, u[0].copy(), u[1:], y[1:])
    return y
