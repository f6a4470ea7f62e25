"""What a message claims beyond its boxes: that it leaves nothing out, and that its velocities are right.

An evaluator answers such a claim with an evaluation of its own kind (`KINDS`). To a trust model it is the evaluation of
one more detection, whose number `claim_number` gives.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from trust.params import KINDS, TrustParams, eta_of
from trust.tables import Evaluations

DETECTION, MISSING, SPEED = range(len(KINDS))
"""A detection; that a message lacks nothing; that the velocity of a detection is right."""


def claim_number(detection_index: Int[ndarray, "n"], kind: UInt8[ndarray, "n"]) -> Int[ndarray, "n"]:
    """The number by which trust models know a claim; `divmod` by the number of `KINDS` inverts it.

    Parameters
    ----------
    detection_index
        Number of the detection in its message; that of the self report for the claim that the message lacks nothing.
    kind
        Position in `KINDS`.
    """
    return detection_index.astype(np.int64) * len(KINDS) + kind


def completeness(
    pair: Int[ndarray, "n"], expected_p: Float[ndarray, "n"], reported: Bool[ndarray, "n"], n_pairs: int
) -> Float[ndarray, "p"]:
    """How much the objects that an evaluator sees say for or against the completeness of a message.

    Parameters
    ----------
    pair
        Pair of evaluator and message of each of N objects, from 0 to `n_pairs` - 1.
    expected_p
        Probability that an honest sender reports the object: that it exists, times the recall of the sender's detector
        at its range and visibility.
    reported
        Whether the message has a detection at the object's place.

    Returns
    -------
    Support in (-1, 1) per pair: the evaluation that is expected if withholding and honesty are equally likely before; 0
    for a pair without objects.

    Notes
    -----
    Two hypotheses: the sender withholds nothing, or it withholds each detection with probability 1/2. It then reports
    an object with probability a, or a / 2. The logarithm of their likelihood ratio is a sum over the objects, of log 2
    for a reported one and log((1 - a) / (1 - a / 2)) for a missing one. With even prior odds and the sum L, the
    posterior probability of honesty less that of withholding is tanh(L / 2).

    Deviations: ours. [1]_ has no evidence about objects that a message lacks. Misses are taken as independent; those of
    a real detector persist.
    """
    a = np.minimum(expected_p, 1.0 - 1e-6)
    log_ratio = np.where(reported, np.log(2.0), np.log1p(-a) - np.log1p(-0.5 * a))
    counts = a > 0  # an object that cannot be expected says nothing, reported or not
    return np.tanh(0.5 * np.bincount(pair[counts], log_ratio[counts], n_pairs))


def velocity_support(
    difference_mps: Float[ndarray, "n 2"], variance: Float[ndarray, "n 2"], prior_variance: Float[ndarray, "n 2"],
    wrong_p: float = 0.1,
) -> Float[ndarray, "n"]:  # fmt: skip
    """How much an evaluator's track says for or against a claimed velocity.

    Parameters
    ----------
    difference_mps
        Claimed minus tracked velocity, along and across the axis of the track.
    variance
        Variance of that difference if the claim is honest: as the track states it, plus that of the claim [m2/s2].
    prior_variance
        Variance of the velocity of an object of that class about which nothing is known [m2/s2].
    wrong_p
        Probability that an honest difference is larger than the variances say: in turns, and where the track follows
        another object.

    Returns
    -------
    Support in (-1, 1), 2 P - 1, where P in [0, 1] is the probability of an honest claim.

    Notes
    -----
    An honest difference is normal with `variance`, or, with probability `wrong_p`, with `variance + prior_variance`. A
    liar's claim is any velocity of that class, so its difference is normal with `variance + prior_variance`. With f and
    g the two densities, w for `wrong_p` and even prior odds, P = ((1 - w) f + w g) / ((1 - w) f + (1 + w) g).

    Deviations: ours; [1]_ has no velocities. The contaminated normal distribution is Tukey's (1960).
    """
    wide = variance + prior_variance
    log_f, log_g = (-0.5 * (difference_mps**2 / v + np.log(v)).sum(axis=1) for v in (variance, wide))
    ratio = np.exp(log_f - log_g)  # f / g, which is bounded by sqrt(|wide| / |variance|)
    return (1.0 - wrong_p) * (ratio - 1.0) / ((1.0 - wrong_p) * ratio + 1.0 + wrong_p)


def answers(support: Float[ndarray, "n"], params: TrustParams) -> Evaluations:
    """Evaluations of claims: e is 1 or eta, as of matched and unmatched detections, and Phi is the size of the support.

    The support is thus the expectation of the evaluation, as with `evaluation.denial_weight`.
    """
    return Evaluations(np.where(support >= 0, 1.0, eta_of(params)), np.abs(support))
