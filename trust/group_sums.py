"""Sums over the detections of each group that an ego fuses: of scores, of trust, and of evaluations weighted by it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled, inlined
from cosim.base.threads import in_ranges
from trust.params import TrustParams
from trust.tables import Evaluations, FusionInput, ObjectLists, SenderTrust, int64


class EgoLists(NamedTuple):
    """Object lists of the egos, group of each of their positions, and message and score of each detection."""

    ptr: ndarray
    member: ndarray
    owner: ndarray
    group: ndarray
    message: ndarray
    score: ndarray


class ListedEvaluations(NamedTuple):
    """Evaluations by list of their evaluator, without those out of range."""

    ptr: ndarray
    member: ndarray
    evaluation: ndarray
    visibility: ndarray

    @staticmethod
    def of(lists: ObjectLists, given: Evaluations) -> "ListedEvaluations":
        """The evaluations with e in [-1, 1] and Phi in [0, 1], in the types of the kernel."""
        ptr = int64(lists.ptr)
        member = lists.member.astype(np.int32)
        e, phi = given.evaluation, given.visibility
        valid = (np.abs(e) <= 1.0) & (phi >= 0.0) & (phi <= 1.0)
        if not valid.all():
            rows = np.flatnonzero(valid)
            ptr = np.searchsorted(rows, ptr)
            member = member[rows]
            e, phi = e[rows], phi[rows]
        return ListedEvaluations(ptr, member, e, phi)


class KernelInput(NamedTuple):
    """What all egos of a step fuse, in the types of the kernels."""

    lists: EgoLists
    evaluated_by: ndarray
    """Row of each message's list among the evaluated ones; -1 where its sender evaluated nothing."""
    own: ListedEvaluations
    reported: ListedEvaluations

    @staticmethod
    def of(given: FusionInput, received: Int[ndarray, "h"]) -> "KernelInput":
        """The tables of a step, in the types of the kernels.

        Parameters
        ----------
        given
            What the egos fuse.
        received
            Message rows that any ego has received, in any order: `evaluated_by` is long enough for them.
        """
        lists, detections, evaluated = given.lists, given.detections, given.evaluated
        rows = (lists.owner, evaluated.owner, received, detections.message)
        last = max(int(of_messages.max(initial=-1)) for of_messages in rows)
        evaluated_by = np.full(1 + last, -1, np.int64)
        evaluated_by[evaluated.owner] = np.arange(evaluated.owner.size)
        of_lists = EgoLists(
            ptr=int64(lists.ptr),
            member=int64(lists.member),
            owner=int64(lists.owner),
            group=given.groups.numbers(),
            message=int64(detections.message),
            score=detections.score,
        )
        own = ListedEvaluations.of(evaluated, given.own)
        reported = own if given.reported is given.own else ListedEvaluations.of(evaluated, given.reported)
        return KernelInput(of_lists, evaluated_by, own, reported)


class _Weights(NamedTuple):
    """Trust of each ego in the messages it received, and what stands in for the rest."""

    ptr: ndarray
    message: ndarray
    trust: ndarray
    has_evaluations: ndarray
    of_egos: ndarray
    """Trust of each ego in itself; where it is NaN, as among the messages, or the default."""
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
        return MemberSums(
            num=np.empty(m),
            den=np.empty(m),
            n=np.empty(m, np.int32),
            detector=np.empty(m),
        )


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
        counts = ("size", "n_evaluations", "n_evaluators")
        kinds = [np.int64 if name in counts else np.float64 for name in GroupTotals._fields]
        return GroupTotals(*(np.zeros(n, kind) for kind in kinds))


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
def _accumulate(begin, end, longest, lists, evaluated_by, own, reported, weights, sums, totals):
    """Fill the sums of the groups of the egos `begin` to `end`, and those of all members where there is room for them.

    `evaluated_by` is the row of the evaluator's list per message row, -1 for none; no ego's list is longer than
    `longest`.
    """
    received_ptr, received, trust, has_evaluations, of_egos, default_trust, unit_trust = weights
    at = np.full(lists.message.size, -1, np.int32)
    known = np.full(evaluated_by.size, default_trust)
    room = _OfEgo(
        np.empty(longest),
        np.empty(longest),
        np.empty(longest, np.int32),
        np.empty(longest, np.int32),
        np.empty(longest, np.int32),
        np.empty(longest, np.int32),
    )
    for x in range(begin, end):
        ego = lists.owner[x]
        first_row, stop = lists.ptr[x], lists.ptr[x + 1]
        if first_row == stop:
            continue
        for h in range(received_ptr[x], received_ptr[x + 1]):
            known[received[h]] = trust[h]
        if not np.isnan(of_egos[x]):
            known[ego] = of_egos[x]
        first = lists.group[first_row]
        for p in range(first_row, stop):
            first = min(first, lists.group[p])
        for k in range(stop - first_row):
            at[lists.member[first_row + k]] = k
            room.num[k] = room.den[k] = 0.0
            room.n[k] = room.n_evaluators[k] = 0
            room.last[k] = -1
            room.group[k] = lists.group[first_row + k] - first
        v = evaluated_by[ego]
        if v >= 0:
            t = 1.0 if unit_trust else known[ego]
            _add(own, own.ptr[v], own.ptr[v + 1], t, ego, at, room)
        for h in range(received_ptr[x], received_ptr[x + 1]):
            message = received[h]
            v = evaluated_by[message]
            if v >= 0 and message != ego and has_evaluations[h]:
                t = 1.0 if unit_trust else known[message]
                _add(reported, reported.ptr[v], reported.ptr[v + 1], t, message, at, room)
        for k in range(stop - first_row):
            d = lists.member[first_row + k]
            at[d] = -1
            g = first + room.group[k]
            s = lists.score[d]
            t = known[lists.message[d]]
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
                row = first_row + k
                sums.num[row] = room.num[k]
                sums.den[row] = room.den[k]
                sums.n[row] = room.n[k]
                sums.detector[row] = t
        for h in range(received_ptr[x], received_ptr[x + 1]):
            known[received[h]] = default_trust
        known[ego] = default_trust


def sums_of_groups(
    given: FusionInput, sender_trust: SenderTrust, params: TrustParams
) -> tuple[GroupTotals, MemberSums]:
    """Sums over all groups of all egos, and over each member where `code_parity` needs them.

    Parameters
    ----------
    given
        What the egos fuse.
    sender_trust
        As `SenderTrust.canonical` returns it; its lists are those of `given.lists`. No trust is negative.
    params
        Trust of an ego in itself and in unknown vehicles, and `code_parity`.

    Returns
    -------
    Totals of the groups, in the order of `given.groups.seeds()`, and sums of the positions of `given.lists.member`; the
    latter have no rows without `code_parity`.
    """
    t, lists = sender_trust, given.lists
    assert np.all(t.trust >= 0)
    weights = _Weights(
        ptr=int64(t.ptr),
        message=int64(t.message),
        trust=t.trust,
        has_evaluations=t.arrived(),
        of_egos=t.of_egos(params.fixed_ego_trust),
        default_trust=params.default_trust,
        unit_trust=params.code_parity,
    )
    members = MemberSums.of(lists.member.size * params.code_parity)
    totals = GroupTotals.zeros(given.groups.seeds().size)
    longest = int(np.diff(lists.ptr).max(initial=0))
    arrays = KernelInput.of(given, t.message)

    def add(begin: int, end: int) -> None:
        _accumulate(begin, end, longest, *arrays, weights, members, totals)

    in_ranges(add, lists.owner.size)
    return totals, members
