"""Exact discretisation, and the kernel that steps a plant through a block."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import expm

from twin.plant.compiled import kernel
from twin.plant.linear import Array, LinearModel, read_only
from twin.plant.stretches import STRETCH, add_product, recursion

Hold = Literal["zoh", "foh"]


@dataclass(frozen=True, slots=True)
class DiscreteModel:
    """``x_k = F x_{k-1} + B0 u_{k-1} + B1 u_k``, ``y_k = C x_k + D u_k``: causal for both kinds of hold.

    A zero-order hold leaves its column of ``B1`` zero; a first-order hold joins the samples by straight lines.
    Arrays are read-only: F (n, n), B0 and B1 (n, m), C (p, n), D (p, m).
    """

    F: Array
    B0: Array
    B1: Array
    C: Array
    D: Array


def discretise(model: LinearModel, sample_rate_hz: float, holds: Sequence[Hold]) -> DiscreteModel:
    """Discretise a model exactly for inputs held (``zoh``) or joined linearly (``foh``) between samples.

    One matrix exponential of ``[[A, B, 0], [0, 0, I], [0, 0, 0]] dt`` holds all three integrals (Van Loan 1978).

    Parameters
    ----------
    holds
        One per input of the model.
    """
    n, m = model.B.shape
    if len(holds) != m:
        raise ValueError(f"{m} inputs need {m} holds, got {len(holds)}")
    dt = 1.0 / sample_rate_hz
    big = np.zeros((n + 2 * m, n + 2 * m))
    big[:n, :n] = model.A * dt
    big[:n, n : n + m] = model.B * dt
    big[n : n + m, n + m :] = np.eye(m)
    phi = expm(big)
    level, ramp = phi[:n, n : n + m], phi[:n, n + m :]
    joined = np.array([hold == "foh" for hold in holds])
    B1 = np.where(joined, ramp, 0.0)
    return DiscreteModel(
        F=read_only(phi[:n, :n]),
        B0=read_only(level - B1),
        B1=read_only(B1),
        C=model.C,
        D=model.D,
    )


@kernel
def simulate_block(
    F: Array, B0: Array, B1: Array, C: Array, D: Array, x: Array, u_before: Array, u: Array, y: Array
) -> None:
    """Step a `DiscreteModel` through a block, in place.

    Parameters
    ----------
    x
        (n,) state at the sample before the block; on return, at its last sample.
    u_before
        (m,) input at the sample before the block; on return, the block's last.
    u
        (N, m) inputs.
    y
        (N, p) receives the outputs.
    """
    n, m, p, n_samples = F.shape[0], u.shape[1], C.shape[0], u.shape[0]
    B = np.empty((n, 2 * m))
    B[:, :m], B[:, m:] = B0, B1
    columns, state = F.T.copy(), np.empty((STRETCH, n))
    inputs, now, drift = np.zeros((2 * m, STRETCH)), np.zeros((m, STRETCH)), np.zeros((n, STRETCH))
    states, outputs = np.zeros((n, STRETCH)), np.zeros((p, STRETCH))
    for first in range(0, n_samples, STRETCH):
        count = min(STRETCH, n_samples - first)
        for k in range(count):
            for j in range(m):
                inputs[j, k], inputs[m + j, k], now[j, k] = u_before[j], u[first + k, j], u[first + k, j]
                u_before[j] = u[first + k, j]
        drift[:] = 0.0
        outputs[:] = 0.0
        add_product(B, inputs, drift, count)
        recursion(columns, drift, x, state, 0, count)
        for k in range(count):
            for i in range(n):
                states[i, k] = state[k, i]
        add_product(C, states, outputs, count)
        add_product(D, now, outputs, count)
        for k in range(count):
            for i in range(p):
                y[first + k, i] = outputs[i, k]
