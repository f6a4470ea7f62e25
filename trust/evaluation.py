"""Evaluation of received detections by their receiver."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from trust.params import TrustParams, eta_of
from trust.tables import Evaluations, Groups, ObjectLists, SentDetections


def visibility(
    n_points: Int[ndarray, "n"],
    label: UInt8[ndarray, "n"],
    params: TrustParams,
) -> Float[ndarray, "n"]:
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


def miss_p(
    recall: Float[ndarray, "n"],
    permitted: Float[ndarray, "n"] | float,
    compared: Float[ndarray, "n"] | float,
) -> Float[ndarray, "n"]:
    """Probability that an evaluator finds no match for an object that is there, and sees what it sees at its place.

    Parameters
    ----------
    recall
        Probability that the evaluator's detector reports an object that can be seen so well, in [0, 1].
    permitted
        Share of the places where the object may be that free space in the evaluator's sweep permits, in [0, 1].
    compared
        Share of the region where the object may be that the evaluator compared, in [0, 1].

    Returns
    -------
    Probability q, relative to that without an object.

    Notes
    -----
    The object is with probability k in the region that was compared. There, the sweep permits it in the share s of the
    places; and where it is permitted, the detector misses it with probability 1 - r. Outside nothing was compared, so
    that there is no match anyway: q = 1 - k + k s (1 - r) = 1 - k (1 - s (1 - r)).

    Deviations: the rule is ours; [1]_ weighs a miss by the visibility alone.
    """
    return 1.0 - compared * (1.0 - permitted * (1.0 - recall))


def denial_weight(missed_p: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """What an evaluator without a match knows about an object, as the weight of a denial.

    Parameters
    ----------
    missed_p
        Probability q of this if the object is there, relative to that without it (`miss_p`), in [0, 1].

    Returns
    -------
    Weight (1 - q) / (1 + q) in [0, 1], but 0 where q is above 1/2.

    Notes
    -----
    The odds that the object is there are multiplied by q. From even odds they become q, so that the object is there
    with probability q / (1 + q). An evaluation is 1 for an object that is there, and -1 for one that is not; its
    expectation is 2 q / (1 + q) - 1 = -(1 - q) / (1 + q). A denial is an evaluation of -1; with this weight it has this
    expectation.

    Where q is above 1/2, an evaluator would more likely than not find no match although the object is there. It then
    knows nothing, and the weight is 0. A small weight instead would count fully if nobody else evaluates the detection,
    because equation 3 of [1]_ divides by the sum of the weights.

    Deviations: the rule is ours; [1]_ gives every miss the weight of its visibility.
    """
    return np.where(missed_p <= 0.5, (1.0 - missed_p) / (1.0 + missed_p), 0.0)


def evaluate(
    lists: ObjectLists,
    groups: Groups,
    detections: SentDetections,
    n_points: Int[ndarray, "m"],
    plausible: Bool[ndarray, "m"] | Float[ndarray, "m"],
    params: TrustParams,
    recall: Float[ndarray, "m"] | None = None,
    compared: Float[ndarray, "m"] | None = None,
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
    compared
        Share of the region in which each box may be that the owner has compared, in [0, 1]; read only where
        `groups.ego_detected` is false. None: boxes are exact.

    Returns
    -------
    One row per position of `lists.member`.

    Notes
    -----
    e is the score of the owner's detection that matched, else eta. Phi is `visibility`, and 1 for an implausible
    unmatched detection. Where the place of the box is uncertain, Phi is the mean of both over its places. A match with
    the owner itself (its self report) is certain: e = Phi = 1. A denial counts by `compared`: the object may be where
    the owner did not look. With `recall`, Phi of an unmatched detection is `denial_weight` instead. The object is then
    reported with the probability that it could be seen (`visibility`) times the recall.

    Deviations: the paper has no self reports, does not know how often a detector misses, and takes boxes to be exact.
    """
    assert (recall is None) == (params.denials == "visibility"), "recall is given where denials are weighed by it"
    member = lists.member
    seed = member[groups.seed]
    phi = visibility(n_points, detections.label[member], params)
    e = np.where(groups.ego_detected, detections.score[seed], eta_of(params))
    unmatched = ~groups.ego_detected
    seen = phi[unmatched]
    permitted = plausible[unmatched].astype(float) if params.plausibility_in_evaluation else 1.0
    share = 1.0 if compared is None else compared[unmatched]
    if recall is None:  # a place that free space excludes is as good as seen
        phi[unmatched] = share * (seen + (1.0 - permitted) * (1.0 - seen))
    else:
        q = miss_p(seen * recall[unmatched], permitted, share)
        phi[unmatched] = denial_weight(q)
    certain = groups.ego_detected & detections.is_self[seed]
    e[certain] = 1.0
    phi[certain] = 1.0
    return Evaluations(e, phi)
