"""Evaluation of received detections by their receiver."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from trust.params import TrustParams, eta_of
from trust.tables import Evaluations, Groups, ObjectLists, SentDetections


def visibility(n_points: Int[ndarray, "n"], label: UInt8[ndarray, "n"], params: TrustParams) -> Float[ndarray, "n"]:
    """Visibility of a box to an evaluator, from the evaluator's own returns inside it.

    Parameters
    ----------
    n_points
        Returns of the evaluator's own sweep inside each box.
    label
        Class of each box, as in `SentDetections.label`.
    params
        Limits by class: `gamma_lower_points` and `gamma_upper_points`.

    Returns
    -------
    Phi in [0, 1]; 0 means "could not have been seen", not "is false".

    Notes
    -----
    Visibility equation of [1]_: min(1, max(0, p - lower) / (upper - lower)), limits by class.
    Deviations: none. Equal limits, for which the equation is undefined, make a step: a box with more returns has Phi =
    1.
    """
    lower = np.asarray(params.gamma_lower_points)[label]
    span = np.asarray(params.gamma_upper_points)[label] - lower
    above = np.maximum(0.0, n_points - lower)
    return np.minimum(1.0, np.divide(above, span, out=np.sign(above), where=span > 0))


def denial_weight(recall: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """What a miss of the evaluator's detector says against an object that could be seen.

    Parameters
    ----------
    recall
        Probability r that the evaluator's detector reports, and matches, such an object if it is there, in [0, 1].

    Returns
    -------
    Weight r / (2 - r) in [0, 1]: 0 where the detector finds nothing, 1 where it misses nothing.

    Notes
    -----
    The detector misses the object with probability 1 - r if it is there, and with probability 1 if it is not there (the
    detector takes nothing else for it). The likelihood ratio of "not there" to "there" is therefore 1 / (1 - r). With a
    prior of 1/2, the posterior probability that the object is there is (1 - r) / (2 - r). An evaluation is 1 for an
    object that is there, and -1 for one that is not. Its expectation is therefore 2 (1 - r) / (2 - r) - 1 = -r / (2 -
    r). A denial is an evaluation of -1; with the weight r / (2 - r) it has this expectation.

    Deviations: the rule is ours; [1]_ gives every miss the full weight.
    """
    return recall / (2.0 - recall)


def evaluate(
    lists: ObjectLists,
    groups: Groups,
    detections: SentDetections,
    n_points: Int[ndarray, "m"],
    plausible: Bool[ndarray, "m"] | Float[ndarray, "m"],
    params: TrustParams,
    recall: Float[ndarray, "m"] | None = None,
    certainty: Float[ndarray, "m"] | None = None,
) -> Evaluations:
    """Evaluation and visibility of every detection in the object lists, by the list's owner.

    Parameters
    ----------
    lists, groups, detections
        Object lists of the evaluators, and the groups that `matching.match` formed in them.
    n_points
        Returns of the owner's own sweep inside each member's box.
    plausible
        Whether free space in the owner's own sweep permits the box; of a box whose place is uncertain, the share of its
        places that it permits. Read only where `groups.ego_detected` is false.
    params
        Parameters of the evaluation.
    recall
        Probability that the owner's detector reports an object with so many returns, if it is there, in [0, 1]. It is
        given only with `params.denials = "recall"`, and read only where `groups.ego_detected` is false.

    certainty
        Share of the region in which each box may be that the owner has compared, in [0, 1]; read only where
        `groups.ego_detected` is false. None: boxes are exact.

    Returns
    -------
    One row per position of `lists.member`.

    Notes
    -----
    e is the score of the owner's detection that matched, else eta. Phi is `visibility`, and 1 for an implausible
    unmatched detection. Where the place of the box is uncertain, Phi is the mean of both over its places. A match with
    the owner itself (its self report) is certain: e = Phi = 1. With `recall`, Phi of a plausible unmatched detection is
    multiplied by `denial_weight`. A denial counts by `certainty`: the object may be where the owner did not look.

    Deviations: the paper has no self reports, does not know how often a detector misses, and takes boxes to be exact.
    """
    assert (recall is None) == (params.denials == "visibility"), "recall is given where denials are weighed by it"
    member = lists.member
    seed = member[groups.seed]
    phi = visibility(n_points, detections.label[member], params)
    e = np.where(groups.ego_detected, detections.score[seed], eta_of(params))
    if recall is not None:
        phi[~groups.ego_detected] *= denial_weight(recall[~groups.ego_detected])
    if params.plausibility_in_evaluation:
        denied = ~groups.ego_detected
        phi[denied] += (1.0 - plausible[denied]) * (1.0 - phi[denied])
    if certainty is not None:
        phi[~groups.ego_detected] *= certainty[~groups.ego_detected]
    certain = groups.ego_detected & detections.is_self[seed]
    e[certain] = 1.0
    phi[certain] = 1.0
    return Evaluations(e, phi)
