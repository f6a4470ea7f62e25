"""Evaluation: what a vehicle says about what others say."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from trust.params import TrustParams, eta_of
from trust.tables import Detections, Groups, Verdicts, Views


def visibility(n_points: Int[ndarray, "n"], label: UInt8[ndarray, "n"], params: TrustParams) -> Float[ndarray, "n"]:
    """How well an evaluator could have seen a box, from its own returns inside it.

    Returns
    -------
    Phi in [0, 1]; 0 says "I could not have seen it", not "it is false".

    Notes
    -----
    Visibility equation of [1]_: min(1, max(0, p - lower) / (upper - lower)), limits by class.
    Deviations: none (equal limits, undefined there, make a step: visible above them).
    """
    lower = np.asarray(params.gamma_lower_points)[label]
    span = np.asarray(params.gamma_upper_points)[label] - lower
    above = np.maximum(0.0, n_points - lower)
    return np.minimum(1.0, np.divide(above, span, out=np.sign(above), where=span > 0))


def evaluate(
    views: Views,
    groups: Groups,
    detections: Detections,
    n_points: Int[ndarray, "m"],
    plausible: Bool[ndarray, "m"],
    params: TrustParams,
) -> Verdicts:
    """Evaluation and visibility of every detection that each view's owner considers.

    Parameters
    ----------
    n_points
        Returns of the owner's own sweep inside each member's box.
    plausible
        Verdict of the owner's own sweep; read only where `groups.local` is false.

    Notes
    -----
    e = score of the owner's detection that it matched, else eta; Phi = `visibility`, 1 for an implausible
    unmatched detection. A match with the owner itself (its self report) is certain: e = Phi = 1.

    Deviations: the paper has no self reports; a liar certifies its fabrications (`certify_own_lies`).
    """
    member = views.member
    seed = member[groups.seed]
    phi = visibility(n_points, detections.label[member], params)
    e = np.where(groups.local, detections.score[seed], eta_of(params))
    if params.plausibility_in_evaluation:
        phi[~groups.local & ~plausible] = 1.0
    certain = groups.local & detections.is_self[seed]
    if params.certify_own_lies:
        own = detections.sender[member] == views.owner[views.of_member()]
        certain |= own & detections.is_fabricated[member]
    e[certain] = 1.0
    phi[certain] = 1.0
    return Verdicts(e, phi)


def aggregated(
    views: Views, verdicts: Verdicts, n_detections: int, how: str
) -> tuple[Float[ndarray, "d"], Bool[ndarray, "d"]]:
    """One evaluation per detection out of everybody's, whoever they are, and whether there is any.

    Notes
    -----
    M = sum Phi e, or ("mean") sum Phi e / sum Phi, 0 without weight. The published code's quantity;
    the paper weighs with the evaluator's trust, see `trust.fusion`.
    """
    n = np.bincount(views.member, minlength=n_detections)
    num = np.bincount(views.member, verdicts.phi * verdicts.e, n_detections).astype(float)
    if how == "mean":
        den = np.bincount(views.member, verdicts.phi, n_detections)
        num = np.divide(num, den, out=np.zeros_like(num), where=den > 0)
    return num, n > 0
