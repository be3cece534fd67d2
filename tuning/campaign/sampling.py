"""How the scattered parameters of all draws are chosen: at random, on a Latin hypercube or a Sobol' sequence.

Everything goes through normal scores: a point of the unit cube becomes normal numbers, these are correlated where the
specification says so (a Gaussian copula; Nelsen, *An Introduction to Copulas*, 2006), and each is turned into its
parameter by the inverse of its distribution. At random, a draw's number and a parameter's name alone decide what is
drawn; the other two fill the cube evenly and therefore depend on the number of draws and on the list of parameters.
"""

import math
from functools import lru_cache
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from tuning.campaign.scatter import LogNormal, Normal, Uniform, draw_factors, stream
from twin.plant.config import Frozen
from twin.plant.linear import Array, read_only

Kind = Literal["random", "latin_hypercube", "sobol"]
Distribution = Uniform | Normal | LogNormal


class Correlation(Frozen):
    """Two scattered parameters that vary together.

    Attributes
    ----------
    between
        Their names.
    coefficient
        Correlation of their normal scores; of two normal distributions it is Pearson's.
    """

    between: tuple[str, str]
    coefficient: float = Field(gt=-1.0, lt=1.0)

    @model_validator(mode="after")
    def _of_two(self) -> Self:
        if self.between[0] == self.between[1]:
            raise ValueError(f"{self.between[0]} is named twice; name two parameters")
        return self


def correlation_root(names: tuple[str, ...], correlations: tuple[Correlation, ...]) -> Array:
    """Lower Cholesky factor of the normal scores' correlation, (d, d) in the order of the names.

    Raises
    ------
    ValueError
        If a name is not scattered, a pair is there twice, or no such set of numbers can be drawn.
    """
    matrix = np.eye(len(names))
    for item in correlations:
        for name in item.between:
            if name not in names:
                raise ValueError(
                    f"correlation: '{name}' is not scattered; known: {', '.join(names) or 'none'}"
                )
        a, b = (names.index(name) for name in item.between)
        if matrix[a, b] != 0.0:
            raise ValueError(f"correlation: {' and '.join(item.between)} is there twice; give each pair one")
        matrix[a, b] = matrix[b, a] = item.coefficient
    if float(np.linalg.eigvalsh(matrix).min()) < 1e-9:
        raise ValueError(
            "correlation: the coefficients contradict each other (their matrix is not positive definite); make them "
            "smaller"
        )
    return np.asarray(np.linalg.cholesky(matrix))


@lru_cache(maxsize=4)
def _table(
    scatter: tuple[Distribution, ...],
    correlations: tuple[Correlation, ...],
    kind: Kind,
    seed: int,
    draws: int,
) -> Array:
    """Values of all draws, (draws, parameters)."""
    names = tuple(s.parameter for s in scatter)
    rng = np.random.default_rng(stream(seed, 0, f"plan {kind}"))
    if kind == "sobol":
        # Whole powers of two keep the sequence balanced; the first of them are taken.
        points = qmc.Sobol(len(names), rng=rng).random_base2(max(0, math.ceil(math.log2(draws))))[:draws]
    else:
        points = qmc.LatinHypercube(len(names), rng=rng).random(draws)
    scores = ndtri(np.clip(points, 2.0**-53, 1.0 - 2.0**-53)) @ correlation_root(names, correlations).T
    return read_only(_values(scatter, scores))


def _values(scatter: tuple[Distribution, ...], scores: Array) -> Array:
    """What normal scores (n, d) stand for."""
    shares = ndtr(scores)
    return np.column_stack([s.at(shares[:, k]) for k, s in enumerate(scatter)])


def drawn_values(
    scatter: tuple[Distribution, ...],
    correlations: tuple[Correlation, ...],
    kind: Kind,
    seed: int,
    draws: int,
    draw: int,
) -> dict[str, float]:
    """What one of ``draws`` draws gives each parameter: a factor or a value, as its scale says.

    Raises
    ------
    InputError
        If a distribution leaves hardly a value above 0.
    """
    if not scatter:
        return {}
    if kind != "random":
        row = _table(scatter, correlations, kind, seed, draws)[draw]
        return {s.parameter: float(row[k]) for k, s in enumerate(scatter)}
    values = draw_factors(scatter, seed, draw)
    tied = {name for item in correlations for name in item.between}
    if not tied:
        return values
    # Those that are not correlated keep the values that they have without the others.
    some = tuple(s for s in scatter if s.parameter in tied)
    root = correlation_root(tuple(s.parameter for s in some), correlations)
    scores = np.array(
        [np.random.default_rng(stream(seed, draw, s.parameter)).standard_normal() for s in some]
    )
    row = _values(some, (root @ scores)[None])[0]
    return values | {s.parameter: float(row[k]) for k, s in enumerate(some)}
