"""Gains of the rig's own law nearest to a wanted reference, with a modulus margin: a quadratic program (OSQP).

    minimise |phi g - target|²   subject to   Re(e^{-j p_k} (1 + L_k g)) >= M   on a frequency grid

The loop gain is linear in the gains, so each row is affine; a few rounds move the p_k to arg(1 + L_k). Few of a
grid's rows ever bind: each round takes those that are nearest to -1, together with those that bound the last one, so
the program has `ROWS` of them whatever the grid. It makes the starting point of a `search`, which then looks at the
motion itself and at every other limit.
"""

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy import sparse

from twin.plant.errors import RunError
from twin.plant.linear import Array, ComplexArray

ROWS, KEPT = 20, 6
ROUNDS = 8
PROXIMAL = 0.1
REGULARITY = 1e-9
PENALTIES = (0.1, 1.0, 10.0)
"""OSQP's step size: the first serves nearly always, the others where it creeps."""


class GainProgram:
    """The quadratic program; set up once, updated and warm-started after.

    Parameters
    ----------
    scale
        (3,) typical size of alpha, beta, gamma [kg, Ns/m, N/m]: what the solver sees is of order one.
    bounds
        (3, 2) lower and upper bound of each gain in SI units.
    """

    def __init__(self, scale: Array, bounds: Array) -> None:
        self._scale = scale
        self._bounds = bounds / scale[:, None]
        self._multipliers = np.zeros(ROWS + 3)
        self._solver: osqp.OSQP | None = None

    def solve(
        self, fit: ComplexArray, target: complex, terms: ComplexArray, modulus_margin: float, start: Array
    ) -> Array:
        """Gains (alpha, beta, gamma) in SI units.

        Parameters
        ----------
        fit
            (3,) reference [A] per unit of each gain in closed loop at the wanted motion.
        target
            The wanted reference [A].
        terms
            (n, 3) loop gain per unit of each gain on a grid of any length from `ROWS`.
        modulus_margin
            Least |1 + L| on the grid.
        start
            (3,) gains whose loop phases the first round linearises about, in SI units.

        Raises
        ------
        RunError
            If the solver finds no gains with that margin.
        """
        if target == 0.0:
            return np.zeros(3)
        phi = fit * self._scale / abs(target)
        wanted = target / abs(target)
        scaled = terms * self._scale
        # The three terms are nearly parallel around one frequency, which first-order solvers crawl on: solve in
        # coordinates in which the rows of fit and loop together are orthonormal.
        gram = len(scaled) * (phi.conj()[:, None] * phi).real + (scaled.conj().T @ scaled).real
        basis = np.linalg.inv(np.linalg.cholesky(gram / len(scaled) + REGULARITY * np.eye(3))).T
        phi, scaled = phi @ basis, scaled @ basis
        stacked = np.vstack([phi.real, phi.imag])
        # Two equations, three gains: a proximal term picks the solution nearest to the last round's and fades
        # as the rounds converge, where a ridge would bias the fit.
        hessian = 2.0 * (stacked.T @ stacked + PROXIMAL * np.eye(3))
        pull = -2.0 * stacked.T @ np.array([wanted.real, wanted.imag])
        y = np.linalg.solve(basis, start / self._scale)
        self._multipliers = np.zeros(ROWS + 3)  # those of the last question would colour this answer
        kept = np.zeros(0, dtype=np.int64)
        for _ in range(ROUNDS):
            one_plus = 1.0 + scaled @ y
            rows = _nearest(np.abs(one_plus), kept)
            turn = np.exp(-1j * np.angle(one_plus[rows]))
            matrix = np.vstack([(turn[:, None] * scaled[rows]).real, basis])
            lower = np.concatenate([modulus_margin - turn.real, self._bounds[:, 0]])
            upper = np.concatenate([np.full(ROWS, np.inf), self._bounds[:, 1]])
            linear = pull - 2.0 * PROXIMAL * y
            previous, y = y, self._step(hessian, linear, matrix, lower, upper, y)
            kept = rows[np.argsort(self._multipliers[:ROWS], kind="stable")[:KEPT]]
            if np.max(np.abs(y - previous)) < 1e-4:
                break
        return np.asarray(basis @ y * self._scale)

    def _step(
        self,
        hessian: Array,
        linear: Array,
        matrix: Array,
        lower: NDArray[np.floating],
        upper: NDArray[np.floating],
        warm: NDArray[np.floating],
    ) -> Array:
        # Dense patterns written out in full, so that a zero today does not change the structure tomorrow.
        upper_part = np.concatenate([hessian[: j + 1, j] for j in range(3)])
        columns = matrix.T.ravel()
        if self._solver is None:
            self._solver = osqp.OSQP()
            self._solver.setup(
                sparse.csc_matrix(np.triu(np.ones((3, 3)))), linear, sparse.csc_matrix(np.ones(matrix.shape)),
                lower, upper, verbose=False, eps_abs=1e-5, eps_rel=1e-5, max_iter=1_000,
                rho=PENALTIES[0], scaling=0, adaptive_rho=False,  # both would carry bits of one question into the next
            )  # fmt: skip
        # Also after setup, so that the first question is answered to the same bits as when it is asked again.
        self._solver.update(Px=upper_part, q=linear, Ax=columns, l=lower, u=upper)
        x, y = np.asarray(warm), np.zeros(ROWS + 3)  # rows change places: their multipliers are no start
        for penalty in PENALTIES:
            self._solver.update_settings(rho=penalty)
            self._solver.warm_start(x=x, y=y)
            result = self._solver.solve(raise_error=False)
            if result.info.status_val != osqp.SolverStatus.OSQP_MAX_ITER_REACHED:
                break
            x, y = result.x, result.y
        if result.info.status_val not in (
            osqp.SolverStatus.OSQP_SOLVED,
            osqp.SolverStatus.OSQP_SOLVED_INACCURATE,
        ):
            raise RunError(f"no gains keep the margin ({result.info.status})")
        self._multipliers = np.asarray(result.y, dtype=np.float64)
        return np.asarray(result.x, dtype=np.float64)


def _nearest(distance: Array, kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """`ROWS` rows in rising order: those kept, the bottoms of all valleys, and what is nearest to -1 then."""
    inner = np.zeros(len(distance), dtype=np.bool_)
    inner[1:-1] = (distance[1:-1] <= distance[:-2]) & (distance[1:-1] < distance[2:])
    bottoms = np.nonzero(inner)[0]
    bottoms = bottoms[np.argsort(distance[bottoms], kind="stable")][: ROWS - KEPT]
    order = np.concatenate([kept, bottoms, np.argsort(distance, kind="stable")])
    _, first = np.unique(order, return_index=True)
    return np.sort(order[np.sort(first)[:ROWS]])
