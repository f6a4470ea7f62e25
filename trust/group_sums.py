"""Sums over the detections of each group that an ego fuses: of scores, of trust, and of evaluations weighted by it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numba import prange
from numpy import ndarray

from trust.kernel import compiled, inlined, parallel
from trust.params import TrustParams
from trust.tables import Detections, Evaluations, ObjectLists, SenderTrust, int64
from trust.threads import threads_for


class _Lists(NamedTuple):
    """Object lists of the egos, group of each of their positions, and message and score of each detection."""

    ptr: ndarray
    member: ndarray
    owner: ndarray
    group: ndarray
    message: ndarray
    score: ndarray


class _Evaluated(NamedTuple):
    """Evaluations by list of their evaluator, without those out of range."""

    ptr: ndarray
    member: ndarray
    evaluation: ndarray
    visibility: ndarray

    @staticmethod
    def of(lists: ObjectLists, given: Evaluations) -> "_Evaluated":
        """In the types of the kernel."""
        ptr, member, e, phi = int64(lists.ptr), lists.member.astype(np.int32), given.evaluation, given.visibility
        valid = (np.abs(e) <= 1.0) & (phi >= 0.0) & (phi <= 1.0)
        if not valid.all():
            rows = np.flatnonzero(valid)
            ptr, member, e, phi = np.searchsorted(rows, ptr), member[rows], e[rows], phi[rows]
        return _Evaluated(ptr, member, e, phi)


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


class MemberSums(NamedTuple):
    """Sums per position of the egos' lists over evaluators; without rows where they are not asked for."""

    num: Float[ndarray, "m"]  # of Phi T e
    den: Float[ndarray, "m"]  # of Phi T
    n: Int[ndarray, "m"]  # evaluations
    detector: Float[ndarray, "m"]  # trust of the detection's detector

    @staticmethod
    def of(m: int) -> "MemberSums":
        """Room for m positions."""
        return MemberSums(np.empty(m), np.empty(m), np.empty(m, np.int32), np.empty(m))


class GroupTotals(NamedTuple):
    """Sums per group over its members."""

    size: Int[ndarray, "g"]  # members
    scores: Float[ndarray, "g"]
    trusted_scores: Float[ndarray, "g"]  # of score x trust of its detector
    trust: Float[ndarray, "g"]  # of the detectors' trust
    numerator: Float[ndarray, "g"]  # of Phi T e, over evaluators too
    weight: Float[ndarray, "g"]  # of Phi T, over evaluators too
    n_evaluations: Int[ndarray, "g"]  # pairs of a member and an evaluator
    n_evaluators: Int[ndarray, "g"]  # different ones

    @staticmethod
    def zeros(n: int) -> "GroupTotals":
        """Of n groups."""
        whole, real = np.zeros((3, n), np.int64), np.zeros((5, n))
        return GroupTotals(whole[0], real[0], real[1], real[2], real[3], real[4], whole[1], whole[2])


class _OfEgo(NamedTuple):
    """Room for one ego's list: sums of its members as in `MemberSums`, and the group of each; per group, the last
    message that spoke of it, and how many did. Groups are numbered from the ego's first one."""

    num: ndarray
    den: ndarray
    n: ndarray
    group: ndarray
    last: ndarray
    n_evaluators: ndarray


@inlined
def _add(of, begin, end, t, message, at, ego):
    """Add the evaluations of one message, with the ego's trust in its sender.

    Unsigned numbers of rows, because signed ones are tested for being negative at each access.
    """
    for s in range(np.uint64(begin), np.uint64(end)):
        found = at[np.uint32(of.member[s])]
        if found >= 0:
            p = np.uint32(found)
            w = of.visibility[s] * t
            ego.num[p] += w * of.evaluation[s]
            ego.den[p] += w
            ego.n[p] += 1
            g = np.uint32(ego.group[p])
            ego.n_evaluators[g] += ego.last[g] != message
            ego.last[g] = message


@compiled
def _of_egos(chunk, n_chunks, longest, lists, evaluated_by, own, reported, weights, sums, totals):
    """The same for every `n_chunks`-th ego."""
    received_ptr, received, trust, has_evaluations, ego_trust, ego_computed, default_trust, unit_trust = weights
    at = np.full(lists.message.size, -1, np.int32)
    known = np.full(evaluated_by.size, default_trust)
    room = _OfEgo(
        np.empty(longest), np.empty(longest), np.empty(longest, np.int32), np.empty(longest, np.int32),
        np.empty(longest, np.int32), np.empty(longest, np.int32),
    )  # fmt: skip
    for x in range(chunk, lists.owner.size, n_chunks):
        ego, begin, end = lists.owner[x], lists.ptr[x], lists.ptr[x + 1]
        if begin == end:
            continue
        for h in range(received_ptr[x], received_ptr[x + 1]):
            known[received[h]] = trust[h]
        if not ego_computed:
            known[ego] = ego_trust
        first = lists.group[begin]
        for p in range(begin, end):
            first = min(first, lists.group[p])
        for k in range(end - begin):
            at[lists.member[begin + k]] = k
            room.num[k], room.den[k], room.n[k] = 0.0, 0.0, 0
            room.group[k], room.last[k], room.n_evaluators[k] = lists.group[begin + k] - first, -1, 0
        v = evaluated_by[ego]
        if v >= 0:
            _add(own, own.ptr[v], own.ptr[v + 1], 1.0 if unit_trust else known[ego], ego, at, room)
        for h in range(received_ptr[x], received_ptr[x + 1]):
            message = received[h]
            v = evaluated_by[message]
            if v >= 0 and message != ego and has_evaluations[h]:
                t = 1.0 if unit_trust else known[message]
                _add(reported, reported.ptr[v], reported.ptr[v + 1], t, message, at, room)
        for k in range(end - begin):
            d = lists.member[begin + k]
            at[d] = -1
            g, s, t = first + room.group[k], lists.score[d], known[lists.message[d]]
            totals.size[g] += 1
            totals.scores[g] += s
            totals.trusted_scores[g] += s * t
            totals.trust[g] += t
            totals.numerator[g] += room.num[k]
            totals.weight[g] += room.den[k]
            totals.n_evaluations[g] += room.n[k]
            if room.n_evaluators[k] > 0:
                totals.n_evaluators[first + k] = room.n_evaluators[k]
            if sums.num.size:
                sums.num[begin + k], sums.den[begin + k] = room.num[k], room.den[k]
                sums.n[begin + k], sums.detector[begin + k] = room.n[k], t
        for h in range(received_ptr[x], received_ptr[x + 1]):
            known[received[h]] = default_trust
        known[ego] = default_trust


@parallel
def _accumulate(longest, lists, evaluated_by, own, reported, weights, n_chunks, sums, totals):
    """Fill the sums of all groups, and those of all members where there is room for them.

    `evaluated_by` is the row of the evaluator's list per message row, -1 for none; no ego's list is longer than
    `longest`.
    """
    for chunk in prange(
        n_chunks
    ):  # an unsigned number once it is parallel: for each of both a kernel would be compiled
        _of_egos(np.int64(chunk), n_chunks, longest, lists, evaluated_by, own, reported, weights, sums, totals)


def sums_of_groups(
    lists: ObjectLists, group: Int[ndarray, "m"], n_groups: int, detections: Detections, evaluated: ObjectLists,
    own: Evaluations, reported: Evaluations, sender_trust: SenderTrust, params: TrustParams,
) -> tuple[GroupTotals, MemberSums]:  # fmt: skip
    """Sums of all groups of all egos; those of each member only where `code_parity` needs them.

    The arguments are those of `trust.fusion.fuse`; `group` numbers the groups of one ego after those of another.
    """
    t = sender_trust
    assert np.all(t.trust >= 0)
    rows = (lists.owner, evaluated.owner, t.message, detections.message)
    evaluated_by = np.full(1 + int(max(a.max(initial=-1) for a in rows)), -1, np.int64)
    evaluated_by[evaluated.owner] = np.arange(evaluated.owner.size)
    of_lists = _Lists(
        int64(lists.ptr), int64(lists.member), int64(lists.owner), group, int64(detections.message), detections.score
    )
    weights = _Weights(
        int64(t.ptr), int64(t.message), t.trust, t.arrived(), params.ego_trust,
        params.code_parity or params.ego_trust_from == "computed", params.default_trust, params.code_parity,
    )  # fmt: skip
    made = _Evaluated.of(evaluated, own)
    sent = made if reported is own else _Evaluated.of(evaluated, reported)
    members, totals = MemberSums.of(lists.member.size * params.code_parity), GroupTotals.zeros(n_groups)
    n_sums = lists.member.size + t.message.size * evaluated.member.size / max(1, evaluated.owner.size)
    longest = int(np.diff(lists.ptr).max(initial=0))
    with threads_for(n_sums) as n_threads:
        _accumulate(longest, of_lists, evaluated_by, made, sent, weights, n_threads, members, totals)
    return totals, members
