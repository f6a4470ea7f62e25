"""Fusion: final score and pose of each group of detections, for each ego."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.rows import Rows
from trust.group_sums import GroupTotals, MemberSums, sums_of_groups
from trust.object_reports import ObjectReports, ObjectVotes, object_votes
from trust.params import AVERAGES, Method, TrustParams
from trust.tables import FusionInput, SenderTrust


@dataclass(frozen=True, slots=True)
class SensorEvidence(Rows):
    """Evidence from the ego's own sweep about each group's seed; used only if another vehicle detected the seed."""

    n_points: Int[ndarray, "g"]  # returns inside the box; used within the range only
    plausible: Bool[ndarray, "g"]
    in_range: Bool[ndarray, "g"]  # within the range of the sensor (70 m)


@dataclass(frozen=True, slots=True)
class Fused(Rows):
    """Final objects, one per group, in the order of the object lists and of the groups' seeds."""

    ego: Int[ndarray, "f"]  # row of the ego's object list
    group: Int[ndarray, "f"]  # its number among the groups of all lists
    seed: Int[ndarray, "f"]  # detection that gives class and box
    pose: Int[ndarray, "f"]  # detection that gives position and heading
    score: Float[ndarray, "f"]  # in [0, 1]
    ego_detected: Bool[ndarray, "f"]  # the seed is the ego's detection
    n_sources: Int[ndarray, "f"]  # detections in the group
    n_evaluations: Int[ndarray, "f"]  # evaluations behind the score: pairs of a detection and an evaluator
    n_evaluators: Int[ndarray, "f"]  # vehicles that made them
    box: Float[ndarray, "f 7"] | None = None
    """x, y, z, length, width, height, heading; None if it is the seed's with the place of `pose`."""
    variance_m2: Float[ndarray, "f 3"] | None = None
    """Variance of the position relative to the ego: xx, xy, yy; None as the box."""


@dataclass(frozen=True, slots=True)
class GroupSums:
    """Sums per group that the formulas need; "members" are the group's detections."""

    n: Int[ndarray, "g"]  # members
    ego_detected: Bool[ndarray, "g"]  # the seed is the ego's detection
    own: Float[ndarray, "g"]  # score of the seed
    scores: Float[ndarray, "g"]  # sum of the members' scores
    trusted_scores: Float[ndarray, "g"]  # sum of score x trust of its detector
    trust: Float[ndarray, "g"]  # sum of the detectors' trust
    numerator: Float[ndarray, "g"]  # sum over members and evaluators of Phi T e
    weight: Float[ndarray, "g"]  # sum over members and evaluators of Phi T
    parity: "Parity | None"
    """None unless the formulas of the published code are used."""
    evidence: SensorEvidence


@dataclass(frozen=True, slots=True)
class Parity:
    """Sums per group that only the formulas of the published code need."""

    mean_or_own: Float[ndarray, "g"]  # mean of the members' aggregated evaluation, the ego's own score for none
    mean_or_score: Float[ndarray, "g"]  # the same, the member's score for none
    of_seed: Float[ndarray, "g"]  # aggregated evaluation of the seed, 0 for none
    certain: Float[ndarray, "g"]  # sum of certainty x trust, certainty 1 for self reports and -1 else
    certain_score: Float[ndarray, "g"]  # sum of score x certainty x trust


def _ratio(a: ndarray, b: ndarray) -> ndarray:
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0)


def _implausible(g: GroupSums, p: TrustParams) -> Bool[ndarray, "g"]:
    """Groups that the plausibility check removes; never groups that the ego detected."""
    return ~g.ego_detected & ~g.evidence.plausible & p.plausibility_in_fusion


def _average(g: GroupSums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_own if g.parity else _ratio(g.numerator, g.weight)


def _trupercept_1(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(_implausible(g, p), 0.0, _average(g, p))


def _local_bias(g: GroupSums, p: TrustParams) -> ndarray:
    value = _average(g, p)
    biased = np.where(g.ego_detected, (value + g.own) / 2, value)
    return np.where(_implausible(g, p), 0.0, biased)


def _unchecked_2(g: GroupSums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_score if g.parity else g.numerator / g.n


def _trupercept_2(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(_implausible(g, p), 0.0, _unchecked_2(g, p))


def _trupercept_3(g: GroupSums, p: TrustParams) -> ndarray:
    if g.parity:
        near, far = g.own, g.parity.of_seed
    else:
        near = far = _unchecked_2(g, p)
    unseen = (g.evidence.n_points < p.blind_points) & ~_implausible(g, p)
    in_range = np.where(unseen, near, 0.0)
    foreign = np.where(g.evidence.in_range, in_range, far)
    return np.where(g.ego_detected, g.own, foreign)


def _local(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(g.ego_detected, g.own, 0.0)


def _any(g: GroupSums, p: TrustParams) -> ndarray:
    return np.ones(g.n.size)


def _any_confirmed(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(g.n > 1, 1.0, g.own)


def _confirmed_or_local(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(g.n > 1, 1.0, _local(g, p))


def _local_confirmed(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(g.ego_detected, _any_confirmed(g, p), 0.0)


def _averaging(g: GroupSums, p: TrustParams) -> ndarray:
    if g.parity:
        return _ratio(g.parity.certain_score, g.n * g.parity.certain)
    return _ratio(g.trusted_scores, g.trust)


def _additive(g: GroupSums, p: TrustParams) -> ndarray:
    return g.parity.certain_score if g.parity else g.trusted_scores


def _half_additive(g: GroupSums, p: TrustParams) -> ndarray:
    return (g.scores + np.where(g.ego_detected, g.own, 0.0)) / 2


METHODS: dict[Method, Callable[[GroupSums, TrustParams], ndarray]] = {
    "trupercept_1": _trupercept_1,
    "trupercept_2": _trupercept_2,
    "trupercept_3": _trupercept_3,
    "corrected": _local,
    "trupercept_3_corrected": _trupercept_3,
    "trupercept_1_local_bias": _local_bias,
    "local": _local,
    "any": _any,
    "any_confirmed": _any_confirmed,
    "confirmed_or_local": _confirmed_or_local,
    "local_confirmed": _local_confirmed,
    "averaging": _averaging,
    "additive": _additive,
    "half_additive": _half_additive,
}
"""Score of every group by the method's name, before it is clipped to [0, 1]."""

CORRECTED: frozenset[Method] = frozenset({"corrected", "trupercept_3_corrected"})
"""Methods that take position and heading from the closest detector."""


def fuse(
    given: FusionInput,
    sender_trust: SenderTrust,
    evidence: SensorEvidence,
    distance_m: Float[ndarray, "d"] | None,
    params: TrustParams,
    score_objects: Callable[[ObjectReports], Float[ndarray, "g"]] | None = None,
    votes: ObjectVotes | None = None,
    min_score: float = 0.0,
) -> Fused:
    """Final score and pose of each group of each ego.

    Parameters
    ----------
    given
        Detections in groups, and their evaluations.
    sender_trust
        Messages that each ego has received, with its trust in the senders; one list per list of `given.lists`. An ego
        uses the reported evaluations of these messages.
    evidence
        One row per row of `given.groups.seeds()`.
    distance_m
        Distance of each detection from the sensor of its detector [m]. With `matching = "gates"`: standard deviation of
        its position. None if each object is where its seed is.
    params
        Method of the fusion and its parameters.
    score_objects
        Method of a trust model that scores objects. It replaces the scores of `params.method`.
    votes
        Result of `object_votes` for the same arguments, if several fusions differ only in trust; computed by default.
    min_score
        Groups of a lower score are left out.

    Returns
    -------
    One row per group. Groups whose seed is the ego's report of itself are left out.

    Notes
    -----
    Equations 5 and 6 of [1]_ with pairs (member, evaluator) of weight Phi T(evaluator). `trust/README.md` has the
    formulas of all methods and the variants of `code_parity`.

    Deviations: the sums run over every evaluator of every member, as the text of the paper implies; its equations name
    only the detectors. The additive sum is divided by the number of members, so that an object does not count once per
    message. "Phi < 10" in TruPercept 3 is read as fewer than 10 returns.
    """
    lists, groups, detections = given.lists, given.groups, given.detections
    seeds = groups.seeds()
    row, ego_detected = lists.member[seeds], groups.ego_detected[seeds]
    sender_trust = sender_trust.canonical()
    totals, members = sums_of_groups(given, sender_trust, params)
    if score_objects is None:
        score = _scores_of_method(given, totals, members, evidence, params)
    else:
        votes = object_votes(given, sender_trust) if votes is None else votes
        of_egos = sender_trust.of_egos(params.fixed_ego_trust)
        of_egos = np.where(np.isnan(of_egos), params.default_trust, of_egos)
        score = score_objects(votes.with_trust(sender_trust.trust, of_egos[lists.of(seeds)]))

    pose = row
    if distance_m is None:
        pass  # the caller makes boxes of all detections of a group
    elif params.method in CORRECTED and not params.code_parity:
        pose = np.where(score > 0, _closest(given, distance_m, params.self_report_poses), row)
    elif params.matching == "gates":  # an own detection stays: it has no error of another vehicle's position
        pose = np.where(ego_detected | (score <= 0), row, _closest(given, distance_m, self_reports=True))
    fused = Fused(
        ego=lists.of(seeds),
        group=np.arange(len(seeds)),
        seed=row,
        pose=pose,
        score=score,
        ego_detected=ego_detected,
        n_sources=totals.size,
        n_evaluations=totals.n_evaluations,
        n_evaluators=totals.n_evaluators,
    )
    return fused.take(~(ego_detected & detections.is_self[row]) & (score >= min_score))


def _scores_of_method(
    given: FusionInput, totals: GroupTotals, members: MemberSums, evidence: SensorEvidence, params: TrustParams
) -> Float[ndarray, "g"]:
    """Score of each group by `params.method`."""
    row = given.lists.member[given.groups.seeds()]
    sums = GroupSums(
        n=totals.size,
        ego_detected=given.groups.ego_detected[given.groups.seeds()],
        own=given.detections.score[row],
        scores=totals.scores,
        trusted_scores=totals.trusted_scores,
        trust=totals.trust,
        numerator=totals.numerator,
        weight=totals.weight,
        parity=_parity(given, members, params) if params.code_parity else None,
        evidence=evidence,
    )
    return np.clip(METHODS[params.method](sums, params), 0.0, 1.0)


def _closest(given: FusionInput, distance_m: Float[ndarray, "d"], self_reports: bool) -> Int[ndarray, "g"]:
    """For each group, the detection closest to its own detector. Self reports come last unless they are wanted."""
    member, group = given.lists.member, given.groups.numbers()
    far = distance_m[member]
    if not self_reports:
        far = np.where(given.detections.is_self[member], np.inf, far)
    return member[first_least(group, far, int(group.max(initial=-1)) + 1)]


@compiled
def first_least(group, value, n_groups):
    """Position of the least value of each group, the first of equal ones. A NaN is larger than all other values."""
    best = np.full(n_groups, -1, np.int64)
    for p in range(len(group)):
        q = best[group[p]]
        is_less = q < 0 or value[p] < value[q]
        if is_less or (np.isnan(value[q]) and not np.isnan(value[p])):
            best[group[p]] = p
    return best


def _parity(given: FusionInput, members: MemberSums, params: TrustParams) -> Parity:
    """Sums per group for the formulas of the published code."""
    lists, detections, group = given.lists, given.detections, given.groups.numbers()
    seeds = given.groups.seeds()
    score, is_self = detections.score[lists.member], detections.is_self[lists.member]
    by_ego = detections.message[lists.member] == lists.owner[lists.of_member()]

    def total(x: ndarray) -> ndarray:
        return np.bincount(group, x, seeds.size).astype(float)  # integers where there is nothing

    num, den, n, detector = members
    mean = params.method in AVERAGES if params.code_aggregate == "by_method" else params.code_aggregate == "mean"
    aggregate = _ratio(num, den) if mean else num
    certain = np.where(is_self, 1.0, -1.0) * detector
    size = total(np.ones(len(num)))
    own_score = np.where(by_ego, score, 0.0)
    return Parity(
        mean_or_own=total(np.where(n > 0, aggregate, own_score)) / size,
        mean_or_score=total(np.where(n > 0, aggregate, score)) / size,
        of_seed=aggregate[seeds],
        certain=total(certain),
        certain_score=total(score * certain),
    )
