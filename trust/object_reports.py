"""Who reports an object, and who could see its place and does not: the input of models that score objects."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from numpy import ndarray

from trust.tables import FusionInput, SenderTrust, int64


@dataclass(frozen=True, slots=True)
class ObjectReports:
    """One row per group of detections and vehicle that speaks for or against it, whatever it sent: one vote each.

    A vehicle speaks for the object if one of the group's detections is its own or it matched one of them (e > 0), else
    against it if it could see one (Phi > 0).
    """

    group: Int[ndarray, "r"]  # from 0 to n_groups
    in_favour: Bool[ndarray, "r"]
    visibility: Float[ndarray, "r"]  # largest Phi of the vehicle; 1 for a detector that sent no evaluation
    trust: Float[ndarray, "r"]  # of the ego in the vehicle
    n_groups: int


@dataclass(frozen=True, slots=True)
class ObjectVotes:
    """The same without trust, which is all that differs between the trust variants of a step."""

    group: Int[ndarray, "r"]
    in_favour: Bool[ndarray, "r"]
    visibility: Float[ndarray, "r"]
    received: Int[ndarray, "r"]  # row of the messages that the egos received; -1 for the ego's own vote
    n_groups: int

    def with_trust(self, trust: Float[ndarray, "h"], ego_trust: float) -> ObjectReports:
        """The reports, with the egos' trust in the senders of the messages received, and in themselves."""
        of_vote = np.append(trust, ego_trust)[self.received]
        return ObjectReports(self.group, self.in_favour, self.visibility, of_vote, self.n_groups)


@njit(cache=True, nogil=True, parallel=True)
def _reports(list_ptr, member, owner, group, evaluated_ptr, evaluated, evaluated_by, own_e, own_phi, reported_e,
             reported_phi, received_ptr, received, has_evaluations, message, n_detections, n_messages, n_chunks,
             row_ptr, out_group, out_vehicle, out_received, out_favour, out_phi):  # fmt: skip
    """Counts rows per ego if `out_group` is empty, else fills them; returns the counts."""
    n_rows = np.zeros(owner.size, np.int64)
    fill = out_group.size > 0
    for chunk in prange(n_chunks):
        at = np.full(n_detections, -1, np.int32)
        begin = np.zeros(n_messages, np.int64)
        end = np.zeros(n_messages, np.int64)
        for x in range(chunk, owner.size, n_chunks):
            a, b = list_ptr[x], list_ptr[x + 1]
            if a == b:
                continue
            first, last = group[a], group[a]
            for p in range(a, b):
                at[member[p]] = p
                first, last = min(first, group[p]), max(last, group[p])
                m = message[member[p]]
                if end[m] == 0:
                    begin[m] = p
                end[m] = p + 1
            side = np.zeros(last - first + 1, np.int64)  # 0 silent, 1 against, 2 in favour
            phi_of = np.zeros(last - first + 1)
            touched = np.empty(last - first + 1, np.int64)
            n_out = row_ptr[x]
            for h in range(received_ptr[x] - 1, received_ptr[x + 1]):
                is_own = h < received_ptr[x]
                v = owner[x] if is_own else received[h]
                if not is_own and v == owner[x]:
                    continue
                n_touched = 0
                for p in range(begin[v], end[v]):
                    g = group[p] - first
                    if side[g] == 0:
                        touched[n_touched] = g
                        n_touched += 1
                    side[g], phi_of[g] = 2, -1.0
                if evaluated_by[v] >= 0 and (is_own or has_evaluations[h]):
                    e, phi = (own_e, own_phi) if is_own else (reported_e, reported_phi)
                    for s in range(evaluated_ptr[evaluated_by[v]], evaluated_ptr[evaluated_by[v] + 1]):
                        p = at[evaluated[s]]
                        if p < 0 or not (abs(e[s]) <= 1.0 and phi[s] > 0.0 and phi[s] <= 1.0):
                            continue
                        g, now = group[p] - first, 2 if e[s] > 0.0 else 1
                        if side[g] == 0:
                            touched[n_touched] = g
                            n_touched += 1
                        if now > side[g]:
                            side[g], phi_of[g] = now, phi[s]
                        elif now == side[g]:
                            phi_of[g] = max(phi_of[g], phi[s])
                for k in range(n_touched):
                    g = touched[k]
                    if fill:
                        out_group[n_out], out_vehicle[n_out], out_received[n_out] = first + g, v, h
                        out_favour[n_out] = side[g] == 2
                        out_phi[n_out] = 1.0 if phi_of[g] < 0.0 else phi_of[g]
                    n_out += 1
                    side[g], phi_of[g] = 0, 0.0
            n_rows[x] = n_out - row_ptr[x]
            for p in range(a, b):
                at[member[p]] = -1
                end[message[member[p]]] = 0
                begin[message[member[p]]] = 0
    return n_rows


def object_votes(given: FusionInput, received: SenderTrust, n_threads: int) -> ObjectVotes:
    """Votes on the groups of each ego.

    Parameters
    ----------
    received
        Canonical; rows go with `given.lists`. No trust is read.
    """
    lists, groups, detections, evaluated = given.lists, given.groups, given.detections, given.evaluated
    own, reported = given.own, given.reported
    ptr, message, arrived = received.ptr, received.message, received.arrived()
    seeds, group = groups.seeds(), groups.numbers()
    n_messages = 1 + int(max(a.max(initial=-1) for a in (lists.owner, evaluated.owner, message, detections.message)))
    evaluated_by = np.full(n_messages, -1, np.int64)
    evaluated_by[evaluated.owner] = np.arange(evaluated.owner.size)
    arrays = (
        int64(lists.ptr), int64(lists.member), int64(lists.owner), group, int64(evaluated.ptr), int64(evaluated.member),
        evaluated_by, own.evaluation, own.visibility, reported.evaluation, reported.visibility, int64(ptr),
        int64(message), arrived, int64(detections.message), len(detections), n_messages, n_threads,
    )  # fmt: skip

    def rows(n: int) -> tuple[ndarray, ...]:
        return (*(np.empty(n, np.int64) for _ in range(3)), np.empty(n, bool), np.empty(n))

    n_egos = lists.owner.size
    n_rows = _reports(*arrays, np.zeros(n_egos + 1, np.int64), *rows(0))
    row_ptr = np.concatenate([[0], np.cumsum(n_rows)])
    out = rows(int(row_ptr[-1]))
    if out[0].size:
        _reports(*arrays, row_ptr, *out)
    of_group, _, position, in_favour, visibility = out
    is_own = position < ptr[np.repeat(np.arange(n_egos), n_rows)]
    return ObjectVotes(of_group, in_favour, visibility, np.where(is_own, -1, position), seeds.size)
