"""Matching: detections of one object by several sources."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import partners
from cosim.base.threads import in_ranges
from trust.params import TrustParams
from trust.tables import Groups, ObjectLists, SentDetections, float64, int64


@compiled
def _candidate(d, after, at, block, ptr, other, value):
    """First message after block `after` with a seed for detection d; of its seeds the one of first maximum IoU.

    Unsigned numbers of rows, because signed ones are tested for being negative at each access.
    """
    best, best_iou = -1, 0.0
    begin = np.uint64(ptr[d])
    end = np.uint64(ptr[d + 1])
    for x in range(begin, end):
        q = at[np.uint32(other[x])]
        if q < 0 or block[q] <= after:
            continue
        is_better = best < 0 or block[q] < block[best]
        if not is_better and block[q] == block[best]:
            is_better = value[x] > best_iou or (value[x] == best_iou and q < best)
        if is_better:
            best, best_iou = q, value[x]
    return best, best_iou


@compiled
def _offer(s, t, member, seed, first, ptr, other, value, v, offer, offer_iou, offer_list):
    """Note the seeds of one message, s to t, at the detections for which they are the first candidates.

    `first` says where each position's message begins. A message further on in the list never replaces an earlier one.
    """
    for p in range(s, t):
        if seed[p] != p:
            continue
        begin = np.uint64(ptr[member[p]])
        end = np.uint64(ptr[member[p] + 1])
        for x in range(begin, end):
            d = np.uint32(other[x])
            if offer_list[d] == v:
                is_of_this_message = first[offer[d]] == s
                if not (is_of_this_message and value[x] > offer_iou[d]):
                    continue
            offer[d] = p
            offer_iou[d] = value[x]
            offer_list[d] = v


@compiled
def _seeds(begin, end, list_ptr, members, owner, message, ptr, other, value, one_per_vehicle, seeds, by_owner):
    """Write the seed of each position of the lists `begin` to `end`, and whether it is the owner's detection."""
    longest = 0
    for v in range(begin, end):
        longest = max(longest, list_ptr[v + 1] - list_ptr[v])
    # of the list under way, by position in it: where the detections of the same message start, and the seed
    block = np.empty(longest, np.int32)
    seed = np.empty(longest, np.int32)
    # of each detection: its position if it is a seed of an earlier message; its first candidate, in which list
    at = np.full(message.size, -1, np.int32)
    offer = np.empty(message.size, np.int32)
    offer_iou = np.zeros(message.size)
    offer_list = np.full(message.size, -1, np.int32)
    n_choices = longest if one_per_vehicle else 0
    choice, winner, waiting = np.empty((3, n_choices), np.int32)
    choice_iou = np.empty(n_choices)
    for v in range(begin, end):
        member = members[list_ptr[v] : list_ptr[v + 1]]
        s = np.int64(0)  # a literal would be a type of its own, for which kernels are compiled once more
        while s < len(member):
            t = s
            of_message = message[member[s]]
            while t < len(member) and message[member[t]] == of_message:
                block[t] = s
                t += 1
            for p in range(s, t):
                has_offer = offer_list[member[p]] == v
                seed[p] = offer[member[p]] if has_offer else p
                if one_per_vehicle:
                    choice[p] = offer[member[p]] if has_offer else -1
                    choice_iou[p] = offer_iou[member[p]]
            if one_per_vehicle:
                _one_per_vehicle(s, t, member, at, block, ptr, other, value, seed, choice, choice_iou, winner, waiting)
            for p in range(s, t):
                if seed[p] == p:
                    at[member[p]] = p
            _offer(s, t, member, seed, block, ptr, other, value, v, offer, offer_iou, offer_list)
            s = t
        for p in range(len(member)):
            at[member[p]] = -1
            row = list_ptr[v] + p
            seeds[row] = list_ptr[v] + seed[p]
            by_owner[row] = message[member[seed[p]]] == owner[v]


@compiled
def _one_per_vehicle(s, t, member, at, block, ptr, other, value, seed, choice, choice_iou, winner, waiting):
    """Fill `seed` for the detections of one message, s to t.

    `choice` are their first candidates; `winner` and `waiting` are room.
    """
    n_waiting = 0
    for p in range(s, t):
        seed[p] = p
        if choice[p] >= 0:
            waiting[n_waiting] = p
            n_waiting += 1
    # each message before s in turn: its seeds take their best candidate; the others try the next one
    while n_waiting > 0:
        turn = s
        for p in waiting[:n_waiting]:
            turn = min(turn, block[choice[p]])
            winner[choice[p]] = -1
        for p in waiting[:n_waiting]:
            q = choice[p]
            if block[q] == turn:
                if winner[q] < 0 or choice_iou[p] > choice_iou[winner[q]]:
                    winner[q] = p
        n_left = 0
        for p in waiting[:n_waiting]:
            if block[choice[p]] == turn:
                if winner[choice[p]] == p:
                    seed[p] = choice[p]
                    continue
                following, iou = _candidate(member[p], turn, at, block, ptr, other, value)
                choice[p], choice_iou[p] = following, iou
                if following < 0:
                    continue
            waiting[n_left] = p
            n_left += 1
        n_waiting = n_left


Pairs = tuple[Int[ndarray, "q"], Int[ndarray, "q"], Float[ndarray, "q"]]
"""Rows of two detections, and how well they agree."""


class Partners(NamedTuple):
    """The detections with which each detection may be of one object; detection d has the rows ptr[d]:ptr[d + 1]."""

    ptr: Int[ndarray, "d+1"]
    other: Int[ndarray, "2*q"]
    value: Float[ndarray, "2*q"]
    """How well they agree."""

    @staticmethod
    def of(pairs: Pairs, n: int, params: TrustParams) -> "Partners":
        """Of n detections, from pairs as `match` takes them."""
        least = params.tau if params.matching == "iou" else 0.0  # pairs within gates are no others
        kept = pairs[2] > least  # False for a NaN
        i, j, value = pairs if kept.all() else (column[kept] for column in pairs)
        i, j = (np.ascontiguousarray(rows, np.int32) for rows in (i, j))
        return Partners(*partners(i, j, float64(value), n))


def match(
    lists: ObjectLists,
    detections: SentDetections,
    pairs: Pairs,
    params: TrustParams,
) -> Groups:
    """Groups of detections that each object list attributes to one object.

    Parameters
    ----------
    lists
        A message appears at most once in a list: its detections are contiguous.
    pairs
        (i, j, IoU) of the detections of one class and different messages that overlap, each pair once. With
        `matching = "gates"`: those that may be of one object, and how well they agree.

    Notes
    -----
    Matching of [1]_ as its published code has it: vehicle by vehicle in the order of the list, a detection
    joins the first vehicle that has a seed with IoU > tau, there the seed of (first) maximum IoU; if there
    is none it opens a group.
    With `one_per_vehicle` a seed takes only the best of the detections that one vehicle has for it; the
    others try the next vehicle, or open groups.

    Deviations: the paper matches against the ego's detections only and one per vehicle; here detections that
    the ego lacks form groups too, which its later sections need, and one per vehicle is an option.
    """
    return match_partners(lists, detections, Partners.of(pairs, len(detections), params), params)


def match_partners(lists: ObjectLists, detections: SentDetections, partners: Partners, params: TrustParams) -> Groups:
    """Groups as `match` finds them. Several sets of lists may share the partners."""
    of_list = int64(lists.ptr), int64(lists.member), int64(lists.owner)
    given = *of_list, int64(detections.message), *partners, params.one_per_vehicle
    n = lists.member.size
    groups = Groups(np.empty(n, np.int64), np.empty(n, bool))

    def find(begin: int, end: int) -> None:
        _seeds(begin, end, *given, groups.seed, groups.ego_detected)

    in_ranges(find, lists.owner.size)
    return groups
