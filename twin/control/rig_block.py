"""One block of a rig in software: sampled plant, sensors, filter chain, gains, clamp and delay, sample by sample."""

import math

import numpy as np

from twin.control.chain import chain_step
from twin.plant.compiled import kernel
from twin.plant.linear import Array


@kernel
def rig_block(
    F: Array,
    B0: Array,
    B1: Array,
    C: Array,
    D: Array,
    kick: Array,
    x: Array,
    u_before: Array,
    chain: Array,
    delay_line: Array,
    drive: Array,
    disturbance: Array,
    noise: Array,
    ranges: Array,
    pick: Array,
    gains_from: Array,
    gains_to: Array,
    on: bool,
    clamp: float,
    dt: float,
    coil_input: int,
    exciter_input: int,
    y: Array,
    reference: Array,
    truth: Array,
) -> float:
    """Run plant and controller through one block, in place.

    Parameters
    ----------
    F, B0, B1, C, D
        Discrete plant, as `DiscreteModel`.
    kick
        (n,) change of state per newton of disturbance held over a sample.
    x, u_before, chain, delay_line
        State carried from block to block: plant (n,), last inputs (m,), filter chain (6,), commands computed
        but not yet at the converter (d,) [A].
    drive
        (N,) input of the exciting actuator, in its unit.
    disturbance
        (N,) force on the primary body [N], held over the sample before.
    noise
        (N, p) sensor noise.
    ranges
        (p,) largest magnitude each sensor can show; the controller sees what the converter shows.
    pick
        (p,) weights that form the relative acceleration from the sensors.
    gains_from, gains_to
        (5,) alpha/k, beta/k, gamma/k [A per SI unit] and tan(pi f dt) of both cutoffs at the block's ends;
        linear between.
    on
        Whether the controller acts; the filter chain runs in any case.
    clamp
        Largest current reference [A].
    y
        (N, p) receives the measured sensors.
    reference
        (N,) receives the current reference at the converter [A].
    truth
        (N, n) receives the true states; with no rows it is left alone.

    Returns
    -------
    float
        Largest filtered relative displacement in the block [m].
    """
    n_samples, n, m, p = len(drive), F.shape[0], B0.shape[1], C.shape[0]
    d = len(delay_line)
    fresh, u = np.empty(n), np.empty(m)
    stroke = 0.0
    for k in range(n_samples):
        for j in range(m):
            u[j] = 0.0
        # What the converter holds from this sample on was computed d samples ago.
        u[coil_input] = delay_line[0]
        u[exciter_input] = drive[k]
        for i in range(n):
            total = kick[i] * disturbance[k]
            for j in range(n):
                total += F[i, j] * x[j]
            for j in range(m):
                total += B0[i, j] * u_before[j] + B1[i, j] * u[j]
            fresh[i] = total
        relative = 0.0
        for i in range(n):
            x[i] = fresh[i]
        for j in range(m):
            u_before[j] = u[j]
        if len(truth) > 0:
            for i in range(n):
                truth[k, i] = x[i]
        for i in range(p):
            total = noise[k, i]
            for j in range(n):
                total += C[i, j] * x[j]
            for j in range(m):
                total += D[i, j] * u[j]
            total = min(max(total, -ranges[i]), ranges[i])
            y[k, i] = total
            relative += pick[i] * total
        reference[k] = u[coil_input]

        w = k / n_samples
        g_low = gains_from[3] + w * (gains_to[3] - gains_from[3])
        g_high = gains_from[4] + w * (gains_to[4] - gains_from[4])
        a, v, s = chain_step(chain, relative, g_low, g_high, dt)
        command = 0.0
        if on:
            command = (
                (gains_from[0] + w * (gains_to[0] - gains_from[0])) * a
                + (gains_from[1] + w * (gains_to[1] - gains_from[1])) * v
                + (gains_from[2] + w * (gains_to[2] - gains_from[2])) * s
            )
            # Gains beyond all measure make inf - inf: what is no number must not reach the converter.
            command = 0.0 if math.isnan(command) else min(max(command, -clamp), clamp)
        for j in range(d - 1):
            delay_line[j] = delay_line[j + 1]
        delay_line[d - 1] = command
        stroke = max(stroke, abs(s))
    return stroke
