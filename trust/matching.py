"""Matching: detections of one object by several sources."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit, prange
from numpy import ndarray
from scipy.sparse import coo_array

from trust.params import TrustParams
from trust.tables import Detections, Groups, ObjectLists, int64
from trust.threads import threads_for


@njit(cache=True, nogil=True)
def _candidate(d, after, at, block, ptr, other, value):
    """First message after block `after` with a seed for detection d; of its seeds the one of first maximum IoU."""
    best, best_iou = -1, 0.0
    for x in range(ptr[d], ptr[d + 1]):
        q = at[other[x]]
        if q < 0 or block[q] <= after:
            continue
        if (
            best < 0
            or block[q] < block[best]
            or (block[q] == block[best] and (value[x] > best_iou or (value[x] == best_iou and q < best)))
        ):
            best, best_iou = q, value[x]
    return best, best_iou


@njit(cache=True, nogil=True, parallel=True)
def _seeds(list_ptr, members, owner, message, ptr, other, value, one_per_vehicle, n_chunks):
    """Seed of each position, and whether it is the owner's detection."""
    n_lists = list_ptr.size - 1
    seeds, by_owner = np.empty(members.size, np.int64), np.empty(members.size, np.bool_)
    longest = 0
    for v in range(n_lists):
        longest = max(longest, list_ptr[v + 1] - list_ptr[v])
    for chunk in prange(n_chunks):
        # of the list under way, by position in it: where the detections of the same message start, and the seed
        block, seed = np.empty(longest, np.int32), np.empty(longest, np.int32)
        at = np.full(message.size, -1, np.int32)  # position of each detection that is a seed of an earlier message
        n_tried = longest if one_per_vehicle else 0
        tried, choice, winner = np.empty(n_tried, np.int32), np.empty(n_tried, np.int32), np.empty(n_tried, np.int32)
        choice_iou = np.empty(n_tried)
        for v in range(chunk, n_lists, n_chunks):
            member = members[list_ptr[v] : list_ptr[v + 1]]
            s = np.int64(0)  # a literal would be a type of its own, for which kernels are compiled once more
            while s < len(member):
                t = s
                while t < len(member) and message[member[t]] == message[member[s]]:
                    block[t] = s
                    t += 1
                if one_per_vehicle:
                    _one_per_vehicle(
                        s, t, member, at, block, ptr, other, value, seed, tried, choice, choice_iou, winner
                    )
                else:
                    for p in range(s, t):
                        q, _ = _candidate(member[p], np.int32(-1), at, block, ptr, other, value)
                        seed[p] = q if q >= 0 else p
                for p in range(s, t):
                    if seed[p] == p:
                        at[member[p]] = p
                s = t
            for p in range(len(member)):
                at[member[p]] = -1
                seeds[list_ptr[v] + p] = list_ptr[v] + seed[p]
                by_owner[list_ptr[v] + p] = message[member[seed[p]]] == owner[v]
    return seeds, by_owner


@njit(cache=True, nogil=True)
def _one_per_vehicle(s, t, member, at, block, ptr, other, value, seed, tried, choice, choice_iou, winner):
    """Fill `seed` for the detections of one message, s to t; the last four arrays are room."""
    for p in range(s, t):
        seed[p], tried[p] = -1, -1
    # each message before s in turn: its seeds take their best candidate; the others try the next one
    while True:
        turn = s
        for p in range(s, t):
            choice[p] = -1
            if seed[p] >= 0:
                continue
            q, iou = _candidate(member[p], tried[p], at, block, ptr, other, value)
            choice[p], choice_iou[p] = q, iou
            if q >= 0:
                winner[q] = -1
                turn = min(turn, block[q])
        if turn == s:
            break
        for p in range(s, t):
            q = choice[p]
            if q >= 0 and block[q] == turn and (winner[q] < 0 or choice_iou[p] > choice_iou[winner[q]]):
                winner[q] = p
        for p in range(s, t):
            if choice[p] >= 0 and block[choice[p]] == turn:
                if winner[choice[p]] == p:
                    seed[p] = choice[p]
                else:
                    tried[p] = turn
    for p in range(s, t):
        if seed[p] < 0:
            seed[p] = p


def match(
    lists: ObjectLists,
    detections: Detections,
    pairs: tuple[Int[ndarray, "q"], Int[ndarray, "q"], Float[ndarray, "q"]],
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
    least = params.tau if params.matching == "iou" else 0.0  # pairs within gates are no others
    i, j, iou = (column[pairs[2] > least] for column in pairs)  # False for a NaN
    ends = np.concatenate([i, j]), np.concatenate([j, i])
    both = coo_array((np.tile(iou, 2), ends), (len(detections), len(detections)))
    both.has_canonical_format = True  # each pair is there once: its rows need not be sorted to see that
    of = both.tocsr()
    with threads_for(lists.member.size) as n:
        return Groups(*_seeds(
            int64(lists.ptr), int64(lists.member), int64(lists.owner), int64(detections.message), of.indptr,
            of.indices, of.data, params.one_per_vehicle, n,
        ))  # fmt: skip
