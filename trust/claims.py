"""What a message claims beyond its boxes: that it withholds no object, and that its velocities are right.

An evaluator answers such a claim with an evaluation of its own kind (`KINDS`). To a trust model it is the evaluation of
one more detection, whose number `claim_number` gives.
"""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from trust.params import KINDS, TrustParams, eta_of
from trust.tables import Evaluations

DETECTION, MISSING, SPEED = range(len(KINDS))
"""A detection; that an object is not withheld; that the velocity of a detection is right."""

N_OBJECTS = 16
"""An evaluator asks for the first objects of its own list in the messages of others: its surest ones."""


_WRONG_P = 0.1
"""Probability that an honest difference of velocities is larger than the variances say: in turns, and where the track
follows another object."""


def claim_number(
    number: Int[ndarray, "n"],
    kind: UInt8[ndarray, "n"] | int,
) -> Int[ndarray, "n"]:
    """The number by which trust models know a claim; `divmod` by the number of `KINDS` inverts it.

    Parameters
    ----------
    number
        Number of the detection in its message. For `MISSING`, that of the object in the message of the evaluator.
    kind
        Position in `KINDS`.
    """
    return number.astype(np.int64) * len(KINDS) + kind


def claims_of_messages(
    message: Int[ndarray, "d"],
    detection_index: Int[ndarray, "d"],
    score: Float[ndarray, "d"],
) -> tuple[Int[ndarray, "c"], Int[ndarray, "c"], Float[ndarray, "c"]]:
    """Message, number and score of all claims of some messages with these detections.

    A detection and its velocity have the detector's score. That an object is not withheld has the score 1/2, about the
    mean of detections: all objects together weigh as much as the detections of a message.
    """
    senders = np.unique(message)
    withheld = np.tile(np.arange(N_OBJECTS), len(senders))
    numbers = [
        claim_number(detection_index, DETECTION),
        claim_number(detection_index, SPEED),
        claim_number(withheld, MISSING),
    ]
    messages = [message, message, np.repeat(senders, N_OBJECTS)]
    scores = [score, score, np.full(len(withheld), 0.5)]
    return np.concatenate(messages), np.concatenate(numbers), np.concatenate(scores)


def presence_support(
    expected_p: Float[ndarray, "n"],
    is_reported: Bool[ndarray, "n"],
) -> Float[ndarray, "n"]:
    """How much an object that an evaluator sees says for or against the honesty of a message.

    Parameters
    ----------
    expected_p
        Probability that an honest sender reports the object: that it exists, times the recall of the sender's detector
        at its range and visibility.
    is_reported
        Whether the message has a detection at the object's place.

    Returns
    -------
    Support in (-1, 1): 1/3 for a reported object, -a / (4 - 3 a) for a missing one with a = `expected_p`; 0 where none
    can be expected.

    Notes
    -----
    Two hypotheses: the sender withholds nothing, or it withholds each detection with probability 1/2. It then reports
    the object with probability a, or a / 2. The likelihood ratio of the first to the second is 2 for a reported object
    and (1 - a) / (1 - a / 2) for a missing one. With even prior odds and the ratio R, the posterior probability of
    honesty less that of withholding is (R - 1) / (R + 1).

    Deviations: ours. [1]_ has no evidence about objects that a message lacks.
    """
    a = expected_p
    of_missing = -a / (4.0 - 3.0 * a)
    support = np.where(is_reported, 1.0 / 3.0, of_missing)
    return np.where(a > 0, support, 0.0)


def velocity_support(
    difference_mps: Float[ndarray, "n 2"],
    variance: Float[ndarray, "n 2"],
    prior_variance: Float[ndarray, "n 2"],
) -> Float[ndarray, "n"]:
    """How much an evaluator's track says for or against a claimed velocity.

    Parameters
    ----------
    difference_mps
        Claimed minus tracked velocity, along and across the axis of the track.
    variance
        Variance of that difference if the claim is honest: as the track states it, plus that of the claim [m2/s2].
    prior_variance
        Variance of the velocity of an object of that class about which nothing is known [m2/s2].

    Returns
    -------
    Support in (-1, 1), 2 P - 1, where P in [0, 1] is the probability of an honest claim.

    Notes
    -----
    An honest difference is normal with `variance`, or, with probability w (`_WRONG_P`), with `variance +
    prior_variance`. A liar's claim is any velocity of that class, so its difference is normal with `variance +
    prior_variance`. With f and g the two densities and even prior odds,
    P = ((1 - w) f + w g) / ((1 - w) f + (1 + w) g).

    Deviations: ours; [1]_ has no velocities. The contaminated normal distribution is Tukey's (1960).
    """
    wide = variance + prior_variance
    log_f = _log_density(difference_mps, variance)
    log_g = _log_density(difference_mps, wide)
    ratio = np.exp(log_f - log_g)  # f / g, which is bounded by sqrt(|wide| / |variance|)
    honest_less_lying = (1.0 - _WRONG_P) * (ratio - 1.0)
    both = (1.0 - _WRONG_P) * ratio + 1.0 + _WRONG_P
    return honest_less_lying / both


def _log_density(
    x: Float[ndarray, "n 2"],
    variance: Float[ndarray, "n 2"],
) -> Float[ndarray, "n"]:
    """Logarithm of the normal density of two independent components around 0, without its constant."""
    return -0.5 * (x**2 / variance + np.log(variance)).sum(axis=1)


def answers(support: Float[ndarray, "n"], params: TrustParams) -> Evaluations:
    """Evaluations of claims: e is 1 or eta, as of matched and unmatched detections, and Phi is the size of the support.

    The support is thus the expectation of the evaluation, as with `evaluation.denial_weight`.
    """
    return Evaluations(np.where(support >= 0, 1.0, eta_of(params)), np.abs(support))
