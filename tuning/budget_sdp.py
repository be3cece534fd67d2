"""The power-budgeted LQ problem with several limits as a semidefinite program, for its multipliers.

    minimise tr(J S)   subject to   A X + X A' + b y + y'b' + N N' = 0,   tr(M_i S) <= 1,
                                    S = [X y'; y z] positive semidefinite

S holds the stationary second moments of state and force (with ``y = -K X``), in which every limit is linear
(Boyd et al., *Linear Matrix Inequalities in System and Control Theory*, 1994, ch. 7). The gain ``-y X^-1`` is not to
be used: with a narrow line X is nearly singular. The multipliers of the limits are good starts, and `power_lq`
makes them exact.
"""

import warnings
from collections.abc import Sequence

import cvxpy as cp
import numpy as np

from twin.plant.linear import Array


class BudgetProgram:
    """The program for one number of states and limits: built once, parametrised (DPP), solved by Clarabel.

    Parameters
    ----------
    states
        Of the plant with its oscillator.
    limits
        How many forms are bounded.
    """

    def __init__(self, states: int, limits: int) -> None:
        n = states
        self._S = cp.Variable((n + 1, n + 1), PSD=True)
        X, y = self._S[:n, :n], self._S[n:, :n]
        self._A, self._b, self._noise = cp.Parameter((n, n)), cp.Parameter((n, 1)), cp.Parameter((n, n))
        self._objective = cp.Parameter((n + 1, n + 1))
        self._forms = [cp.Parameter((n + 1, n + 1)) for _ in range(limits)]
        flow = self._A @ X + self._b @ y
        # The upper triangle alone: the equation is symmetric, and twice the same row is one too many.
        stationary = cp.upper_tri(flow + flow.T + self._noise) == 0
        diagonal = cp.diag(flow + flow.T + self._noise) == 0
        self._limits = [cp.trace(form @ self._S) <= 1.0 for form in self._forms]
        self._problem = cp.Problem(
            cp.Minimize(cp.trace(self._objective @ self._S)), [stationary, diagonal, *self._limits]
        )
        if not self._problem.is_dcp(dpp=True):
            raise RuntimeError("the budget program lost its DPP form")

    def multipliers(
        self,
        A: Array,
        b: Array,
        noise: Array,
        objective: Array,
        forms: Sequence[Array],
    ) -> Array | None:
        """Lagrange multipliers of the limits, (limits,), none below zero; None if the solver finds none.

        Parameters
        ----------
        A, b, noise
            (n, n), (n,), (n,) of ``x' = A x + b u + noise n`` in scaled units.
        objective, forms
            (n + 1, n + 1) each, on (x, u).
        """
        self._A.value, self._b.value = A, b[:, None]
        self._noise.value = np.outer(noise, noise)
        self._objective.value = objective
        for parameter, form in zip(self._forms, forms, strict=True):
            parameter.value = form
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of inaccuracy, which the caller makes good
                self._problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
        if self._problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
            return None
        found = [0.0 if c.dual_value is None else float(np.max(c.dual_value)) for c in self._limits]
        return np.asarray(np.maximum(found, 0.0))
