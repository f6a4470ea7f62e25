"""Variance of sums over pairs of actors, in which pairs that share an actor depend on each other."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


def sum_of_products(
    scores: Float[ndarray, "n k"],
    a: Int[ndarray, "n"],
    b: Int[ndarray, "n"],
) -> Float[ndarray, "k k"]:
    """Sum of the products of the scores of any two rows that share an actor [1]_, a row with itself included.

    Parameters
    ----------
    scores
        Derivatives of the log-likelihood of each row.
    a, b
        The two actors of each row. The same two may occur several times.

    Returns
    -------
    A matrix without negative eigenvalues: those that chance makes are set to 0.

    References
    ----------
    .. [1] Aronow, Samii, Assenova, "Cluster-robust variance estimation for dyadic data", Political Analysis 23, 2015.
    """
    units, at_unit = np.unique(np.r_[a, b], return_inverse=True)
    one, other = at_unit[: len(a)], at_unit[len(a) :]
    low, high = np.minimum(one, other), np.maximum(one, other)
    _, pair = np.unique(low * len(units) + high, return_inverse=True)
    twice_over = np.tile(scores.T, 2)
    of_unit = np.column_stack([np.bincount(at_unit, column) for column in twice_over])
    of_pair = np.column_stack([np.bincount(pair, column) for column in scores.T])
    twice = of_pair.T @ of_pair  # rows that share both actors are counted for each of them
    values, vectors = np.linalg.eigh(of_unit.T @ of_unit - twice)
    return vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T
