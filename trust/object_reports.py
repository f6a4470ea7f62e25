"""Who reports an object, and who could see its place and does not: the input of models that score objects."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import offsets, owner_of_rows
from cosim.base.threads import in_ranges
from trust.group_sums import KernelInput
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
    """`ObjectReports` without trust, which is the only difference between the trust variants of a step."""

    group: Int[ndarray, "r"]
    in_favour: Bool[ndarray, "r"]
    visibility: Float[ndarray, "r"]
    received: Int[ndarray, "r"]  # row of the messages that the egos received; -1 for the ego's own vote
    n_groups: int

    def with_trust(self, trust: Float[ndarray, "h"], ego_trust: Float[ndarray, "g"]) -> ObjectReports:
        """The votes as reports.

        Parameters
        ----------
        trust
            Trust of the ego in the sender of each received message: the rows are those of the table from which
            `object_votes` made the votes.
        ego_trust
            For each group, trust of its ego in itself.
        """
        of_vote = ego_trust[self.group]
        by_others = self.received >= 0
        of_vote[by_others] = trust[self.received[by_others]]
        return ObjectReports(self.group, self.in_favour, self.visibility, of_vote, self.n_groups)


class _Received(NamedTuple):
    """Messages that each ego has received, and whether their evaluations arrived too."""

    ptr: ndarray
    message: ndarray
    has_evaluations: ndarray


class _Votes(NamedTuple):
    """A vote per row: its group, what it says, and the position of its message; the ego's own vote is before these."""

    group: ndarray
    position: ndarray
    in_favour: ndarray
    visibility: ndarray

    @staticmethod
    def of(n: int) -> "_Votes":
        """Room for n votes."""
        return _Votes(
            group=np.empty(n, np.int64),
            position=np.empty(n, np.int64),
            in_favour=np.empty(n, bool),
            visibility=np.empty(n),
        )


@compiled
def _reports(begin_ego, end_ego, lists, evaluated_by, own, reported, messages, row_ptr, n_rows, out):
    """Count the rows of the egos `begin_ego` to `end_ego` into `n_rows`, and fill them unless `out` is empty."""
    list_ptr, member, owner, group, message, _ = lists
    received_ptr, received, has_evaluations = messages
    out_group, out_position, out_favour, out_visibility = out
    fill = out_group.size > 0
    at = np.full(message.size, -1, np.int32)
    begin = np.zeros(evaluated_by.size, np.int64)
    end = np.zeros(evaluated_by.size, np.int64)
    for x in range(begin_ego, end_ego):
        a, b = list_ptr[x], list_ptr[x + 1]
        if a == b:
            continue
        first, last = group[a], group[a]
        for p in range(a, b):
            at[member[p]] = p
            first = min(first, group[p])
            last = max(last, group[p])
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
            row = evaluated_by[v]
            if row >= 0 and (is_own or has_evaluations[h]):
                of = own if is_own else reported
                e, phi = of.evaluation, of.visibility
                for s in range(of.ptr[row], of.ptr[row + 1]):
                    p = at[of.member[s]]
                    if p < 0 or phi[s] == 0.0:
                        continue
                    g = group[p] - first
                    now = 2 if e[s] > 0.0 else 1
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
                    out_group[n_out], out_position[n_out] = first + g, h
                    out_favour[n_out] = side[g] == 2
                    out_visibility[n_out] = 1.0 if phi_of[g] < 0.0 else phi_of[g]
                n_out += 1
                side[g], phi_of[g] = 0, 0.0
        n_rows[x] = n_out - row_ptr[x]
        for p in range(a, b):
            at[member[p]] = -1
            end[message[member[p]]] = 0
            begin[message[member[p]]] = 0


def object_votes(given: FusionInput, sender_trust: SenderTrust) -> ObjectVotes:
    """Votes on the groups of each ego. They do not depend on trust, so several fusions can share them.

    Parameters
    ----------
    given
        What the egos fuse.
    sender_trust
        The messages that each ego has received; its lists are those of `given.lists`. No trust is read.

    Returns
    -------
    Votes by ego; those of one ego are in the order of the received messages, after its own.
    """
    received = sender_trust.canonical()
    messages = _Received(int64(received.ptr), int64(received.message), received.arrived())
    arrays = KernelInput.of(given, received.message)
    n_egos = given.lists.owner.size
    n_rows = np.zeros(n_egos, np.int64)

    def report(row_ptr: ndarray, out: _Votes) -> None:
        in_ranges(lambda begin, end: _reports(begin, end, *arrays, messages, row_ptr, n_rows, out), n_egos)

    report(np.zeros(n_egos + 1, np.int64), _Votes.of(0))
    row_ptr = offsets(n_rows)
    votes = _Votes.of(int(row_ptr[-1]))
    if votes.group.size:
        report(row_ptr, votes)
    is_own = votes.position < messages.ptr[owner_of_rows(n_rows)]
    received_row = np.where(is_own, -1, votes.position)
    return ObjectVotes(votes.group, votes.in_favour, votes.visibility, received_row, given.groups.seeds().size)
