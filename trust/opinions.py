"""Opinions of subjective logic: belief, disbelief, uncertainty, as rows (b, d, u) that sum to 1.

Jøsang: Subjective Logic. Springer, 2016. All functions take and return arrays of rows.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

BASE_RATE = 0.5
"""Base rate a: the probability without any evidence."""


def projected(opinion: Float[ndarray, "... 3"], base_rate: float = BASE_RATE) -> Float[ndarray, "..."] | np.floating:
    """Projected probability P = b + a u."""
    return opinion[..., 0] + base_rate * opinion[..., 2]


def of_check(ok: Float[ndarray, "..."], bad: Float[ndarray, "..."], base: float = 1.3) -> Float[ndarray, "... 3"]:
    """Opinion from the weights of checks that an object passed and failed: S = ok + bad, b + d = 1 - base^-S."""
    s = ok + bad
    gained = -np.expm1(-s * np.log(base))
    share = np.divide(gained, s, out=np.zeros_like(gained), where=s > 0)
    return np.stack([ok * share, bad * share, 1 - gained], axis=-1)


def discounted(probability: Float[ndarray, "..."], opinion: Float[ndarray, "... 3"]) -> Float[ndarray, "... 3"]:
    """A source's opinion, discounted by trust P in the source: b = P b', d = P d', u = 1 - P (b' + d')."""
    known = probability[..., None] * opinion[..., :2]
    return np.concatenate([known, 1 - known.sum(axis=-1, keepdims=True)], axis=-1)


def discounted_opposite(source: Float[ndarray, "... 3"], opinion: Float[ndarray, "... 3"]) -> Float[ndarray, "... 3"]:
    """Discounting that favours the opposite belief: b = b b' + d d', d = b d' + d b', u = u + (b + d) u'."""
    b, d, u = np.moveaxis(source, -1, 0)
    ours, theirs, unknown = np.moveaxis(opinion, -1, 0)
    return np.stack([b * ours + d * theirs, b * theirs + d * ours, u + (b + d) * unknown], axis=-1)


def of_evidence(evidence: Float[ndarray, "... 2"]) -> Float[ndarray, "... 3"]:
    """Opinion from (b / u, d / u): the form in which cumulative fusion is a sum."""
    u = 1 / (1 + evidence.sum(axis=-1, keepdims=True))
    return np.concatenate([evidence * u, u], axis=-1)


def evidence_of(opinion: Float[ndarray, "... 3"]) -> Float[ndarray, "... 2"]:
    """Evidence (b / u, d / u) of an opinion; u must be above 0."""
    return opinion[..., :2] / opinion[..., 2:]
