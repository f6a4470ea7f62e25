"""Fusion: final score and pose of each group of detections, for each ego."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from numpy import ndarray

from trust.object_reports import ObjectReports, ObjectVotes, object_votes
from trust.params import AVERAGES, Method, TrustParams
from trust.tables import Detections, Evaluations, Groups, ObjectLists, int64
from trust.threads import threads_for


@dataclass(frozen=True, slots=True)
class SenderTrust:
    """Messages that each ego has received in this step, and its trust in their senders; sorted within an ego."""

    ptr: Int[ndarray, "e+1"]  # ego x received message[ptr[x]:ptr[x + 1]]
    message: Int[ndarray, "h"]  # message row
    trust: Float[ndarray, "h"]  # the value that the ego uses for the sender
    has_evaluations: Bool[ndarray, "h"] | None = None  # whether its evaluations of this step arrived too; None: all did


@dataclass(frozen=True, slots=True)
class SensorEvidence:
    """Evidence of the ego's own sweep about each group's seed; read only where another vehicle detected the seed."""

    n_points: Int[ndarray, "g"]  # returns inside the box
    plausible: Bool[ndarray, "g"]
    in_range: Bool[ndarray, "g"]  # within the range of the sensor (70 m)


@dataclass(frozen=True, slots=True)
class Fused:
    """Final objects, one per group, in the order of the object lists and of the groups' seeds."""

    ego: Int[ndarray, "f"]  # row of the ego's object list
    seed: Int[ndarray, "f"]  # detection that gives class and box
    pose: Int[ndarray, "f"]  # detection that gives position and heading
    score: Float[ndarray, "f"]  # in [0, 1]
    ego_detected: Bool[ndarray, "f"]  # the seed is the ego's detection
    n_sources: Int[ndarray, "f"]  # detections in the group
    n_evaluations: Int[ndarray, "f"]  # evaluations behind the score: pairs of a detection and an evaluator
    n_evaluators: Int[ndarray, "f"]  # vehicles that made them

    def take(self, rows: ndarray) -> "Fused":
        """The chosen rows (a mask or row numbers)."""
        rows = np.flatnonzero(rows) if rows.dtype == bool else rows
        return Fused(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


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
    """None where the formulas are not those of the published code."""
    evidence: SensorEvidence


@dataclass(frozen=True, slots=True)
class Parity:
    """Per group what only the published code's formulas need."""

    mean_or_own: Float[ndarray, "g"]  # mean of the members' aggregated evaluation, the ego's own score for none
    mean_or_score: Float[ndarray, "g"]  # the same, the member's score for none
    of_seed: Float[ndarray, "g"]  # aggregated evaluation of the seed, 0 for none
    certain: Float[ndarray, "g"]  # sum of certainty x trust, certainty 1 for self reports and -1 else
    certain_score: Float[ndarray, "g"]  # sum of score x certainty x trust


class _Lists(NamedTuple):
    """Object lists of the egos, and message and score of each detection."""

    ptr: ndarray
    member: ndarray
    owner: ndarray
    message: ndarray
    score: ndarray


class _Evaluated(NamedTuple):
    """Evaluations by list of their evaluator; `by` is that list's row per message row, -1 for none."""

    ptr: ndarray
    member: ndarray
    by: ndarray
    own_e: ndarray
    own_phi: ndarray
    reported_e: ndarray
    reported_phi: ndarray


class _Weights(NamedTuple):
    """Trust of each ego in the messages it received, and what stands in for the rest."""

    ptr: ndarray
    message: ndarray
    trust: ndarray
    has_evaluations: ndarray
    ego_trust: float
    ego_computed: bool
    default_trust: float
    unit_trust: bool


class _MemberSums(NamedTuple):
    """Per position of the egos' lists: sum Phi T e, sum Phi T, number of evaluations, trust of its detector, group.

    Per group: number of evaluators, and the last one as a row of the received messages.
    """

    num: ndarray
    den: ndarray
    n: ndarray
    detector: ndarray
    group: ndarray
    n_evaluators: ndarray
    last: ndarray


class _Totals(NamedTuple):
    """Per group, over its members: their number, and sums as in `GroupSums`."""

    size: ndarray
    scores: ndarray
    trusted_scores: ndarray
    trust: ndarray
    numerator: ndarray
    weight: ndarray
    n_evaluations: ndarray

    @staticmethod
    def zeros(n: int) -> "_Totals":
        """Of n groups."""
        whole, real = np.zeros((2, n), np.int64), np.zeros((5, n))
        return _Totals(whole[0], real[0], real[1], real[2], real[3], real[4], whole[1])


@njit(cache=True, nogil=True, parallel=True)
def _accumulate(lists, of, weights, n_chunks, sums, totals):
    """Fill the sums of all members, and those of all groups."""
    list_ptr, member, owner, message, score = lists
    evaluated_ptr, evaluated, evaluated_by, own_e, own_phi, reported_e, reported_phi = of
    received_ptr, received, trust, has_evaluations, ego_trust, ego_computed, default_trust, unit_trust = weights
    num, den, n, detector, group, n_evaluators, last = sums
    size, scores, trusted, trusts, numerator, weight, n_evaluations = totals
    n_detections = message.size
    n_messages = evaluated_by.size
    for chunk in prange(n_chunks):
        at = np.full(n_detections, -1, np.int32)
        known = np.full(n_messages, default_trust)
        for x in range(chunk, owner.size, n_chunks):
            ego = owner[x]
            for h in range(received_ptr[x], received_ptr[x + 1]):
                known[received[h]] = trust[h]
            if not ego_computed:
                known[ego] = ego_trust
            for p in range(list_ptr[x], list_ptr[x + 1]):
                at[member[p]] = p
                detector[p] = known[message[member[p]]]
            for h in range(received_ptr[x] - 1, received_ptr[x + 1]):
                is_own = h < received_ptr[x]
                v = ego if is_own else received[h]
                if evaluated_by[v] < 0 or (not is_own and (v == ego or not has_evaluations[h])):
                    continue
                e, phi = (own_e, own_phi) if is_own else (reported_e, reported_phi)
                t = 1.0 if unit_trust else known[v]
                for s in range(evaluated_ptr[evaluated_by[v]], evaluated_ptr[evaluated_by[v] + 1]):
                    p = at[evaluated[s]]
                    if p >= 0 and abs(e[s]) <= 1.0 and phi[s] >= 0.0 and phi[s] <= 1.0:
                        w = phi[s] * t
                        num[p] += w * e[s]
                        den[p] += w
                        n[p] += 1
                        g = group[p]
                        if last[g] != h:
                            last[g] = h
                            n_evaluators[g] += 1
            for p in range(list_ptr[x], list_ptr[x + 1]):
                at[member[p]] = -1
                g, s = group[p], score[member[p]]
                size[g] += 1
                scores[g] += s
                trusted[g] += s * detector[p]
                trusts[g] += detector[p]
                numerator[g] += num[p]
                weight[g] += den[p]
                n_evaluations[g] += n[p]
            for h in range(received_ptr[x], received_ptr[x + 1]):
                known[received[h]] = default_trust
            known[ego] = default_trust


def _ratio(a: ndarray, b: ndarray) -> ndarray:
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0)


def _implausible(g: GroupSums, p: TrustParams) -> Bool[ndarray, "g"]:
    """Groups that the plausibility check removes: never those that the ego detected."""
    return ~g.ego_detected & ~g.evidence.plausible & p.plausibility_in_fusion


def _average(g: GroupSums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_own if g.parity else _ratio(g.numerator, g.weight)


def _trupercept_1(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(_implausible(g, p), 0.0, _average(g, p))


def _local_bias(g: GroupSums, p: TrustParams) -> ndarray:
    value = _average(g, p)
    return np.where(_implausible(g, p), 0.0, np.where(g.ego_detected, (value + g.own) / 2, value))


def _unchecked_2(g: GroupSums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_score if g.parity else g.numerator / g.n


def _trupercept_2(g: GroupSums, p: TrustParams) -> ndarray:
    return np.where(_implausible(g, p), 0.0, _unchecked_2(g, p))


def _trupercept_3(g: GroupSums, p: TrustParams) -> ndarray:
    near, far = (g.own, g.parity.of_seed) if g.parity else (_unchecked_2(g, p), _unchecked_2(g, p))
    unseen = (g.evidence.n_points < p.blind_points) & ~_implausible(g, p)
    foreign = np.where(g.evidence.in_range, np.where(unseen, near, 0.0), far)
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
    lists: ObjectLists,
    groups: Groups,
    detections: Detections,
    evaluated: ObjectLists,
    own: Evaluations,
    reported: Evaluations,
    sender_trust: SenderTrust,
    evidence: SensorEvidence,
    distance_m: Float[ndarray, "d"],
    params: TrustParams,
    score_objects: Callable[[ObjectReports], Float[ndarray, "g"]] | None = None,
    votes: ObjectVotes | None = None,
) -> Fused:
    """Final score and pose of each group of each ego.

    Parameters
    ----------
    lists, groups
        What the egos fuse: not cut to the sensor's area.
    evaluated
        Detections that were evaluated, a list per evaluator; rows go with `own` and `reported`.
    own
        Evaluations as each vehicle made them: an ego's contribution to its own fusion.
    reported
        Evaluations as transmitted: the others' contribution, where the ego has received it. The same object as
        `own` where no evaluation was altered.
    sender_trust
        Rows go with `lists`.
    evidence
        Rows go with `groups.seeds()`.
    distance_m
        Of each detection from its own detector's sensor [m].
    score_objects
        Scores of a trust model that scores objects, instead of those of `params.method`.
    votes
        What `votes_of` makes of these arguments, where several fusions differ in trust alone; else it is made here.

    Returns
    -------
    One row per group; groups whose seed is the ego's report of itself are left out.

    Notes
    -----
    Equations 5 and 6 of [1]_ with pairs (member, evaluator) of weight Phi T(evaluator). Formulas by method,
    and the variants of `code_parity`: `trust/README.md`.

    Deviations: the sums run over every evaluator of every member, which the text means, not over the
    detectors alone, which the equations say; the additive sum is divided by the number of members, so that an
    object does not count once per message; "Phi < 10" in TruPercept 3 is read as fewer than 10 returns.
    """
    m = lists.member.size
    seeds = groups.seeds()
    group = groups.numbers()
    n_evaluators = np.zeros(seeds.size, np.int64)
    num, den, detector = np.zeros(m), np.zeros(m), np.zeros(m)
    n = np.zeros(m, np.int64)
    rows = (lists.owner, evaluated.owner, sender_trust.message, detections.message)
    evaluated_by = np.full(1 + int(max(a.max(initial=-1) for a in rows)), -1, np.int64)
    evaluated_by[evaluated.owner] = np.arange(evaluated.owner.size)
    computed = params.code_parity or params.ego_trust_from == "computed"
    sender_trust = _canonical(sender_trust)
    assert np.all(sender_trust.trust >= 0)
    n_received = sender_trust.message.size
    arrived = np.ones(n_received, bool) if sender_trust.has_evaluations is None else sender_trust.has_evaluations
    n_sums = m + n_received * evaluated.member.size / max(1, evaluated.owner.size)
    with threads_for(n_sums) as n_threads:
        of_lists = _Lists(
            int64(lists.ptr), int64(lists.member), int64(lists.owner), int64(detections.message), detections.score
        )
        of_evaluations = _Evaluated(
            int64(evaluated.ptr), int64(evaluated.member), evaluated_by, own.evaluation, own.visibility,
            reported.evaluation, reported.visibility,
        )  # fmt: skip
        weights = _Weights(
            int64(sender_trust.ptr), int64(sender_trust.message), sender_trust.trust, arrived,
            params.ego_trust, computed, params.default_trust, params.code_parity,
        )  # fmt: skip
        sums_of_members = _MemberSums(num, den, n, detector, group, n_evaluators, np.full(seeds.size, -2))
        totals = _Totals.zeros(seeds.size)
        _accumulate(of_lists, of_evaluations, weights, n_threads, sums_of_members, totals)

    member, row = lists.member, lists.member[seeds]
    parity = None
    if params.code_parity:
        by_ego = detections.message[member] == lists.owner[lists.of_member()]

        def total(x: ndarray) -> ndarray:
            return np.bincount(group, x, seeds.size).astype(float)  # integers where there is nothing

        score_of_member, is_self = detections.score[member], detections.is_self[member]
        parity = _parity(num, den, n, score_of_member, is_self, detector, by_ego, seeds, total, params)
    sums = GroupSums(
        totals.size, groups.ego_detected[seeds], detections.score[row], totals.scores, totals.trusted_scores,
        totals.trust, totals.numerator, totals.weight, parity, evidence,
    )  # fmt: skip
    if score_objects is None:
        score = np.clip(METHODS[params.method](sums, params), 0.0, 1.0)
    else:
        if votes is None:
            votes = votes_of(lists, groups, detections, evaluated, own, reported, sender_trust)
        score = score_objects(votes.with_trust(sender_trust.trust, params.ego_trust))

    pose = row
    if params.method in CORRECTED and not params.code_parity:
        far = distance_m[member]
        if not params.self_report_poses:
            far = np.where(detections.is_self[member], np.inf, far)
        order = np.lexsort((far, group))
        pose = member[order[np.searchsorted(group[order], np.arange(seeds.size))]]
        pose = np.where(score > 0, pose, row)
    fused = Fused(lists.of(seeds), row, pose, score, sums.ego_detected, totals.size, totals.n_evaluations, n_evaluators)
    return fused.take(~(sums.ego_detected & detections.is_self[row]))


def votes_of(
    lists: ObjectLists, groups: Groups, detections: Detections, evaluated: ObjectLists, own: Evaluations,
    reported: Evaluations, sender_trust: SenderTrust,
) -> ObjectVotes:  # fmt: skip
    """Votes on the groups of each ego; the arguments are those of `fuse`, and no trust is read."""
    t = _canonical(sender_trust)
    arrived = np.ones(t.message.size, bool) if t.has_evaluations is None else t.has_evaluations
    received = t.ptr, t.message, arrived
    with threads_for(t.message.size * evaluated.member.size / max(1, evaluated.owner.size)) as n_threads:
        return object_votes(lists, groups, detections, evaluated, own, reported, received, n_threads)


def _parity(
    num: Float[ndarray, "m"], den: Float[ndarray, "m"], n: Int[ndarray, "m"], score: Float[ndarray, "m"],
    is_self: Bool[ndarray, "m"], detector: Float[ndarray, "m"], by_ego: Bool[ndarray, "m"], seeds: Int[ndarray, "g"],
    total: Callable[[ndarray], ndarray], params: TrustParams,
) -> Parity:  # fmt: skip
    """Per group what the published code's formulas need; arguments per member, `total` sums them per group."""
    mean = params.method in AVERAGES if params.code_aggregate == "by_method" else params.code_aggregate == "mean"
    aggregate = _ratio(num, den) if mean else num
    certain, size = np.where(is_self, 1.0, -1.0) * detector, total(np.ones(len(num)))
    return Parity(
        mean_or_own=total(np.where(n > 0, aggregate, np.where(by_ego, score, 0.0))) / size,
        mean_or_score=total(np.where(n > 0, aggregate, score)) / size,
        of_seed=aggregate[seeds],
        certain=total(certain),
        certain_score=total(score * certain),
    )


def _canonical(sender_trust: SenderTrust) -> SenderTrust:
    """Each ego's messages ascending, and once."""
    t = sender_trust
    ego = np.repeat(np.arange(t.ptr.size - 1), np.diff(t.ptr))
    key = ego << 32 | t.message
    if np.all(key[1:] > key[:-1]):
        return t
    key, first = np.unique(key, return_index=True)
    ptr = np.searchsorted(key >> 32, np.arange(t.ptr.size))
    arrived = None if t.has_evaluations is None else t.has_evaluations[first]
    return SenderTrust(ptr, t.message[first], t.trust[first], arrived)
