"""Matching: detections of one object by several sources."""

import numpy as np
from jaxtyping import Float, Int
from numba import njit, prange
from numpy import ndarray

from trust.params import TrustParams
from trust.tables import Detections, Groups, ObjectLists, int64
from trust.threads import threads_for


@njit(cache=True)
def _adjacency(n, i, j, iou, tau):
    """Symmetric compressed rows of the pairs above tau (False for a NaN)."""
    ptr = np.zeros(n + 1, np.int64)
    for p in range(i.size):
        if iou[p] > tau:
            ptr[i[p] + 1] += 1
            ptr[j[p] + 1] += 1
    for r in range(n):
        ptr[r + 1] += ptr[r]
    at = ptr[:-1].copy()
    other = np.empty(ptr[n], np.int32)
    value = np.empty(ptr[n])
    for p in range(i.size):
        if iou[p] > tau:
            for a, b in ((i[p], j[p]), (j[p], i[p])):
                other[at[a]] = b
                value[at[a]] = iou[p]
                at[a] += 1
    return ptr, other, value


@njit(cache=True)
def _candidate(p, after, at, member, block, seed, ptr, other, value):
    """First message after block `after` with a seed for p; of its seeds the one of first maximum IoU.

    Positions are those within one list, from 0 on.
    """
    best, best_iou = -1, 0.0
    for x in range(ptr[member[p]], ptr[member[p] + 1]):
        q = at[other[x]]
        if q < 0 or block[q] <= after or block[q] >= block[p] or seed[q] != q:
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
    """Seed of each position, and whether it is the owner's detection; what is kept per position is that of one list."""
    n_lists = list_ptr.size - 1
    seeds, by_owner = np.empty(members.size, np.int64), np.empty(members.size, np.bool_)
    longest = 0
    for v in range(n_lists):
        longest = max(longest, list_ptr[v + 1] - list_ptr[v])
    for chunk in prange(n_chunks):
        at = np.full(message.size, -1, np.int32)
        block = np.empty(longest, np.int32)  # position at which the detections of p's message start
        seed = np.empty(longest, np.int32)
        n_tried = longest if one_per_vehicle else 0
        tried, choice, winner = np.empty(n_tried, np.int32), np.empty(n_tried, np.int32), np.empty(n_tried, np.int32)
        choice_iou = np.empty(n_tried)
        for v in range(chunk, n_lists, n_chunks):
            member = members[list_ptr[v] : list_ptr[v + 1]]
            n = len(member)
            for p in range(n):
                at[member[p]] = p
                same = p > 0 and message[member[p]] == message[member[p - 1]]
                block[p] = block[p - 1] if same else p
            if not one_per_vehicle:
                for p in range(n):
                    q, _ = _candidate(p, -1, at, member, block, seed, ptr, other, value)
                    seed[p] = q if q >= 0 else p
            else:
                _seeds_one_per_vehicle(at, member, block, ptr, other, value, seed, tried, choice, choice_iou, winner)
            for p in range(n):
                at[member[p]] = -1
                seeds[list_ptr[v] + p] = list_ptr[v] + seed[p]
                by_owner[list_ptr[v] + p] = message[member[seed[p]]] == owner[v]
    return seeds, by_owner


@njit(cache=True)
def _seeds_one_per_vehicle(at, member, block, ptr, other, value, seed, tried, choice, choice_iou, winner):
    """Fill `seed` of one list; the last four arrays are room for its positions."""
    n = len(member)
    for p in range(n):
        seed[p], tried[p], winner[p] = -1, -1, -1
    s = 0
    while s < n:
        t = s + 1
        while t < n and block[t] == s:
            t += 1
        # each message before s in turn: its seeds take their best candidate; the others try the next one
        while True:
            turn = s
            for p in range(s, t):
                choice[p] = -1
                if seed[p] >= 0:
                    continue
                q, iou = _candidate(p, tried[p], at, member, block, seed, ptr, other, value)
                choice[p], choice_iou[p] = q, iou
                if q >= 0 and block[q] < turn:
                    turn = block[q]
            if turn == s:
                break
            for p in range(s, t):
                if choice[p] >= 0 and block[choice[p]] == turn:
                    w = winner[choice[p]]
                    if w < 0 or choice_iou[p] > choice_iou[w]:
                        winner[choice[p]] = p
            for p in range(s, t):
                if choice[p] >= 0 and block[choice[p]] == turn:
                    if winner[choice[p]] == p:
                        seed[p] = choice[p]
                    else:
                        tried[p] = turn
            for p in range(s, t):
                if choice[p] >= 0:
                    winner[choice[p]] = -1
        for p in range(s, t):
            if seed[p] < 0:
                seed[p] = p
        s = t


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
        (i, j, IoU) of the detections of one class and different messages that overlap, each pair once.

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
    i, j, iou = pairs
    ptr, other, value = _adjacency(len(detections), int64(i), int64(j), iou, params.tau)
    with threads_for(lists.member.size) as n:
        return Groups(*_seeds(
            int64(lists.ptr), int64(lists.member), int64(lists.owner), int64(detections.message), ptr, other, value,
            params.one_per_vehicle, n,
        ))  # fmt: skip
