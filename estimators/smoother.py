"""Smoothing of recordings: what every sample says about every state, later samples included.

The fixed-interval smoother of Rauch, Tung and Striebel (1965), in the form of Bryson and Frazier: backwards it carries
what the samples to come say of the state, so that no covariance is inverted (Bierman 1977, ch. X). Memory stays
bounded however long the recording is: forwards only the filter's state between blocks is kept, backwards each block is
filtered once more.
"""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimators.kernels import ABSURD, STATISTICS, full_covariance_block
from estimators.observer import Observer
from estimators.small_matrices import multiply, multiply_transposed
from estimators.types import StateEstimate
from twin.plant.blocks import Block
from twin.plant.compiled import kernel
from twin.plant.errors import InputError
from twin.plant.inputs import DriveReader
from twin.plant.linear import Array, read_only


@dataclass(frozen=True, slots=True)
class SmoothedEstimate:
    """States over one block, from the whole recording.

    Attributes
    ----------
    first_sample
        Of the block.
    states
        Names, as the observer's.
    mean, std
        (n_samples, n_states) smoothed means and standard deviations, read-only.
    filtered_std
        (n_samples, n_states) standard deviations before smoothing, never smaller; read-only.
    first_covariance
        (n_states, n_states) smoothed covariance at the block's first sample, read-only.
    """

    first_sample: int
    states: tuple[str, ...]
    mean: Array
    std: Array
    filtered_std: Array
    first_covariance: Array


@dataclass(frozen=True, slots=True)
class _Passed:
    """What the way forwards left between two blocks: filter before the block, and its model then."""

    first_sample: int
    x: Array
    P: Array
    before: Array | None
    drive: DriveReader
    F: Array
    B: Array
    H: Array
    D: Array
    Q: Array


class RecordingSmoother:
    """Fixed-interval smoother: every block forwards through `filter`, then every block backwards through `smooth`.

    The filter runs with its full covariance throughout. Between blocks its model may be changed by the observer's
    own methods; each block is smoothed with the model it was filtered with.

    Parameters
    ----------
    observer
        As it stands before the first block; it is advanced.
    """

    def __init__(self, observer: Observer) -> None:
        self.observer = observer
        self._passed: list[_Passed] = []
        n = len(observer.states)
        self._moment, self._information = np.zeros(n), np.zeros((n, n))
        self._backwards = False

    def filter(self, block: Block) -> StateEstimate:
        """Take the next block forwards; its filtered estimate.

        Raises
        ------
        InputError
            If smoothing has begun.
        """
        if self._backwards:
            raise InputError("the smoother is on its way back: filter all blocks first, then smooth")
        observer, kf = self.observer, self.observer.filter
        # The model's matrices are replaced, never changed: to keep them costs nothing while they stay.
        passed = _Passed(
            block.first_sample, kf.x[:, 0].copy(), np.array(kf.P, dtype=np.float64, order="C"),
            observer.input_before, copy.copy(observer.drive), kf.F, kf.B, kf.H, observer.feedthrough, kf.Q,
        )  # fmt: skip
        estimate = observer.advance(block, freeze=False)
        self._passed.append(passed)
        return estimate

    def smooth(self, block: Block) -> SmoothedEstimate:
        """Take the last block that has not been smoothed yet.

        Raises
        ------
        InputError
            If it is another block than that.
        """
        self._backwards = True
        if not self._passed or self._passed[-1].first_sample != block.first_sample:
            due = f"the one from sample {self._passed[-1].first_sample}" if self._passed else "none"
            raise InputError(
                f"blocks are smoothed last to first: {due} is due, not that from sample {block.first_sample}"
            )
        passed = self._passed.pop()
        z, valid = self.observer.measurements(block)
        u = passed.drive.gather(block)
        before, m = passed.before, u.shape[1]
        if before is None:
            before = np.where(np.abs(u[0]) < ABSURD, u[0], 0.0)
        mean, std = np.empty((len(z), len(passed.x))), np.empty((len(z), len(passed.x)))
        filtered_std, P = np.empty_like(std), passed.P.copy()
        smooth_block(
            passed.F, np.ascontiguousarray(passed.B[:, :m]), np.ascontiguousarray(passed.B[:, m:]), passed.H,
            passed.D, passed.Q, np.ascontiguousarray(np.diag(self.observer.filter.R)), passed.x.copy(), P,
            before, u, z, valid, self._moment, self._information, mean, std, filtered_std,
        )  # fmt: skip
        for values in (mean, std, filtered_std):
            values.flags.writeable = False
        return SmoothedEstimate(
            block.first_sample, self.observer.states, mean, std, filtered_std, read_only(P)
        )


def smoothed(observer: Observer, blocks: Sequence[Block]) -> Iterator[SmoothedEstimate]:
    """Smooth a recording, its last block first.

    Parameters
    ----------
    observer
        As it stands before the first block.
    blocks
        Consecutive; read twice, forwards and backwards, so that they may come from a file one at a time.
    """
    smoother = RecordingSmoother(observer)
    for block in blocks:
        smoother.filter(block)
    for block in reversed(blocks):
        yield smoother.smooth(block)


@kernel
def smooth_block(
    F: Array,
    B0: Array,
    B1: Array,
    H: Array,
    D: Array,
    Q: Array,
    variance: Array,
    x: Array,
    P: Array,
    u_before: Array,
    u: Array,
    z: Array,
    valid: NDArray[np.bool_],
    moment: Array,
    information: Array,
    mean: Array,
    std: Array,
    filtered_std: Array,
) -> None:
    """Filter a block once more and smooth it, in place.

    Parameters
    ----------
    x, P
        State (n,) and covariance (n, n) before the block. On return P is the smoothed one at the first sample.
    u_before
        (m,) input at the sample before the block.
    moment, information
        (n,) and (n, n): what the samples after the block say of the state at its last one, zero at a recording's
        end. The smoothed mean is ``x - P moment``, the covariance ``P - P information P``. On return, what those
        from the block's first on say of the state before.
    mean, std, filtered_std
        (N, n) receive the smoothed mean and both standard deviations.

    Others as `full_covariance_block`.
    """
    n_samples, n, m, p = len(z), len(x), u.shape[1], len(variance)
    covariances, filtered = np.empty((n_samples + 1, n, n)), np.empty((n_samples + 1, n))
    inputs = np.empty((n_samples + 1, m))
    last, sums = np.full(p, np.nan), np.zeros((STATISTICS, p))
    covariances[0], filtered[0], inputs[0] = P, x, u_before
    now = u_before.copy()
    for k in range(n_samples):
        full_covariance_block(
            F, B0, B1, H, D, Q, variance, x, P, now, u[k : k + 1], z[k : k + 1], valid[k : k + 1], last,
            filtered[k + 1 : k + 2], sums,
        )  # fmt: skip
        covariances[k + 1], inputs[k + 1] = P, now
    half, prior, gain, gains = np.empty((n, n)), np.empty((n, n)), np.empty(n), np.empty((p, n))
    spread, surprise = np.empty(p), np.empty(p)
    turned = np.empty(n)
    for k in range(n_samples, 0, -1):
        # Smoothed at this sample, from what comes after it.
        multiply(covariances[k], information, half)
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += covariances[k, i, j] * moment[j]
            mean[k - 1, i] = filtered[k, i] - total
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += half[i, j] * covariances[k, i, j]
            filtered_std[k - 1, i] = np.sqrt(covariances[k, i, i])
            std[k - 1, i] = np.sqrt(min(max(covariances[k, i, i] - total, 0.0), covariances[k, i, i]))
        if k == 1:
            multiply(half, covariances[k], prior)
            for i in range(n):
                for j in range(n):
                    P[i, j] = covariances[k, i, j] - prior[i, j]
        # The prediction of this sample, and its measurements one by one as the filter took them.
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += F[i, j] * filtered[k - 1, j]
            for j in range(m):
                total += B0[i, j] * inputs[k - 1, j] + B1[i, j] * inputs[k, j]
            x[i] = total
        multiply(F, covariances[k - 1], half)
        multiply_transposed(half, F, prior)
        for i in range(n):
            for j in range(n):
                prior[i, j] += Q[i, j]
        for r in range(p):
            spread[r] = 0.0
            if not valid[k - 1, r] or not abs(z[k - 1, r]) < ABSURD:
                continue
            e, s = z[k - 1, r], variance[r]
            for i in range(n):
                e -= H[r, i] * x[i]
                total = 0.0
                for j in range(n):
                    total += prior[i, j] * H[r, j]
                gain[i] = total
                s += H[r, i] * total
            for j in range(m):
                e -= D[r, j] * inputs[k, j]
            spread[r], surprise[r] = s, e
            for i in range(n):
                gains[r, i] = gain[i] / s
                x[i] += gains[r, i] * e
                for j in range(n):
                    prior[i, j] -= gain[i] * gain[j] / s
        # Backwards through them: with C = I - K h, moment <- C' moment - h e / s, information <- C' I C + h' h / s.
        for r in range(p - 1, -1, -1):
            if spread[r] == 0.0:
                continue
            along, twice = 0.0, 0.0
            for i in range(n):
                along += gains[r, i] * moment[i]
                total = 0.0
                for j in range(n):
                    total += information[i, j] * gains[r, j]
                turned[i] = total
                twice += gains[r, i] * total
            for i in range(n):
                moment[i] -= H[r, i] * (along + surprise[r] / spread[r])
                for j in range(n):
                    information[i, j] += H[r, i] * H[r, j] * (twice + 1.0 / spread[r]) - (
                        H[r, i] * turned[j] + turned[i] * H[r, j]
                    )
        multiply(information, F, half)
        for i in range(n):
            turned[i] = 0.0
            for q in range(n):
                turned[i] += F[q, i] * moment[q]
            for j in range(i + 1):
                total = 0.0
                for q in range(n):
                    total += F[q, i] * half[q, j]
                information[i, j] = information[j, i] = total
        for i in range(n):
            moment[i] = turned[i]
