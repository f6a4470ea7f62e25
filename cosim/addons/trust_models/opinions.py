"""Opinions of subjective logic: belief, disbelief, uncertainty, as rows (b, d, u) that sum to 1.

Jøsang: Subjective Logic. Springer, 2016. All functions take and return arrays of rows.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

BASE_RATE = 0.5
"""Base rate a: the probability without any evidence."""


def projected(opinion: Float[ndarray, "... 3"]) -> Float[ndarray, "..."]:
    """Projected probability of each opinion, P = b + a u with the base rate a, in [0, 1]."""
    return opinion[..., 0] + BASE_RATE * opinion[..., 2]


def of_check(
    ok: Float[ndarray, "..."],
    bad: Float[ndarray, "..."],
    base: float = 1.3,
) -> Float[ndarray, "... 3"]:
    """Opinion on an object from the checks that it passed and failed.

    Parameters
    ----------
    ok, bad
        Total weight, at least 0, of the checks that the object passed, and of those that it failed.
    base
        How fast evidence reduces uncertainty; above 1.

    Returns
    -------
    (b, d, u) with u = base^-S for S = ok + bad. Belief and disbelief share the rest in the ratio of ok to bad.
    """
    s = ok + bad
    gained = -np.expm1(-s * np.log(base))
    share = np.divide(gained, s, out=np.zeros_like(gained), where=s > 0)
    return np.stack([ok * share, bad * share, 1 - gained], axis=-1)


def discounted(
    probability: Float[ndarray, "..."],
    opinion: Float[ndarray, "... 3"],
) -> Float[ndarray, "... 3"]:
    """A source's opinion, discounted by trust in the source.

    Parameters
    ----------
    probability
        Trust P in the source, in [0, 1].
    opinion
        Opinion (b', d', u') of the source.

    Returns
    -------
    b = P b', d = P d', u = 1 - P (b' + d').
    """
    known = probability[..., None] * opinion[..., :2]
    return np.concatenate([known, 1 - known.sum(axis=-1, keepdims=True)], axis=-1)


def discounted_opposite(
    source: Float[ndarray, "... 3"],
    opinion: Float[ndarray, "... 3"],
) -> Float[ndarray, "... 3"]:
    """A source's opinion, discounted so that distrust in the source favours the opposite belief.

    Parameters
    ----------
    source
        Opinion (b, d, u) on the source.
    opinion
        Opinion (b', d', u') of the source.

    Returns
    -------
    Belief b b' + d d', disbelief b d' + d b', uncertainty u + (b + d) u'.
    """
    b, d, u = np.moveaxis(source, -1, 0)
    ours, theirs, unknown = np.moveaxis(opinion, -1, 0)
    belief = b * ours + d * theirs
    disbelief = b * theirs + d * ours
    uncertainty = u + (b + d) * unknown
    return np.stack([belief, disbelief, uncertainty], axis=-1)


def of_evidence(evidence: Float[ndarray, "... 2"]) -> Float[ndarray, "... 3"]:
    """Opinion from evidence in the form in which cumulative fusion is a sum.

    Parameters
    ----------
    evidence
        (b / u, d / u), at least 0.

    Returns
    -------
    (b, d, u); without evidence (0, 0, 1).
    """
    u = 1 / (1 + evidence.sum(axis=-1, keepdims=True))
    return np.concatenate([evidence * u, u], axis=-1)


def evidence_of(opinion: Float[ndarray, "... 3"]) -> Float[ndarray, "... 2"]:
    """Evidence behind an opinion, in the form in which cumulative fusion is a sum.

    Parameters
    ----------
    opinion
        (b, d, u) with u above 0.

    Returns
    -------
    (b / u, d / u).
    """
    return opinion[..., :2] / opinion[..., 2:]
