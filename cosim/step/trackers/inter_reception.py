"""Packet inter-reception times: between successive messages of one vehicle at another vehicle within range.

In a city with 50,000 vehicles that send, some eight million pairs are within range. So both functions pass over the
pairs once, and make no arrays of pairs besides their results.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.rows import no_rows


@dataclass(frozen=True, slots=True)
class InterReceptionTracker:
    """Pairs within communication range and their last receptions, for one message type."""

    pair: Int[ndarray, "p"] = no_rows(np.int64)
    """Actor number of the sender x 2**32 + that of the receiver, ascending; all pairs within range when the sender last
    had a message."""
    last: Int[ndarray, "p"] = no_rows(np.int32)
    """Step of the last reception since they came within range; -1 if there was none."""
    step: Int[ndarray, "p"] = no_rows(np.int32)
    """Step in which the sender last had a message."""

    def next(
        self,
        step: int,
        pair: Int[ndarray, "p"],
        received: Bool[ndarray, "p"],
        silent: Int[ndarray, "v"],
    ) -> tuple["InterReceptionTracker", dict[str, ndarray]]:
        """Add one round of messages.

        Parameters
        ----------
        step
            Number of the step.
        pair
            The pairs within communication range in which the sender had a message, as `InterReceptionTracker.pair`.
        received
            Whether the receiver got the message, over any number of hops.
        silent
            Actor numbers, ascending, of the vehicles on the road that have no message in this step; their pairs stay as
            they are.

        Returns
        -------
        The new tracker, and the columns pir_steps, n_received, n_censored of the table `packet_inter_reception`.
        """
        *now, n_received, n_censored = _next(
            step,
            self.pair,
            self.last,
            self.step,
            pair,
            received,
            silent,
        )
        lengths = np.flatnonzero(n_received + n_censored)
        rows = {"pir_steps": lengths, "n_received": n_received[lengths], "n_censored": n_censored[lengths]}
        return InterReceptionTracker(*now), rows


@compiled
def _next(step, before, last, seen, pair, received, silent):
    """Pairs, their last receptions and steps after a round, and how many intervals of each length ended or were cut."""
    n_received = np.zeros(step + 2, np.int64)
    n_censored = np.zeros(step + 2, np.int64)
    # a pair whose sender is silent stays though it is not among the new ones
    size = len(pair) + (len(before) if len(silent) else 0)
    new_pair = np.empty(size, np.int64)
    new_last = np.empty(size, np.int32)
    new_seen = np.empty(size, np.int32)
    m, i, s = 0, 0, 0
    for row in range(len(pair) + 1):
        is_end = row == len(pair)
        while i < len(before) and (is_end or before[i] < pair[row]):  # a pair that is no longer within range, or waits
            sender = before[i] >> 32
            while s < len(silent) and silent[s] < sender:
                s += 1
            if s < len(silent) and silent[s] == sender:
                new_pair[m] = before[i]
                new_last[m] = last[i]
                new_seen[m] = seen[i]
                m += 1
            elif last[i] >= 0:
                n_censored[seen[i] - last[i]] += 1
            i += 1
        if is_end:
            break
        earlier = -1
        if i < len(before) and before[i] == pair[row]:
            earlier = last[i]
            i += 1
        if received[row]:
            if earlier >= 0:
                n_received[step - earlier] += 1
            earlier = step
        new_pair[m] = pair[row]
        new_last[m] = earlier
        new_seen[m] = step
        m += 1
    return new_pair[:m], new_last[:m], new_seen[:m], n_received, n_censored


@compiled
def pairs_within_range(station, message, receiver, hop, author, heard, heard_by, actor, n_messages):
    """Pairs of vehicles within range in one round, each once, sorted.

    Parameters
    ----------
    station
        Station that sends each message. Vehicles have the numbers below len(actor); other stations are left out.
    message, receiver, hop
        Of every frame and every station within its range, in any order. Only the first hop counts.
    author
        Vehicle of each message that a vehicle received.
    heard, heard_by
        Message and vehicle of every reception, over any number of hops.
    actor
        Actor number of each vehicle, ascending.
    n_messages
        Messages of each vehicle, one per identity; a copy is no other message.

    Returns
    -------
    The pairs as `InterReceptionTracker.pair`, whether the receiver got a message of the sender, and the number of
    messages within whose range each vehicle is.
    """
    n = len(actor)
    ptr, near = _by_sender(station, message, receiver, hop, n)
    heard_ptr, listener = _by_sender(author, heard, heard_by, hop[:0], n)
    m = 0
    stamp = np.full(n, -1, np.int64)
    for i in range(n):  # the receivers of each sender once, in place, ascending
        first = m
        for k in range(ptr[i], ptr[i + 1]):
            j = near[k]
            if stamp[j] != i:
                stamp[j] = i
                place = m
                while place > first and near[place - 1] > j:  # they mostly come in order
                    near[place] = near[place - 1]
                    place -= 1
                near[place] = j
                m += 1
        ptr[i] = first
    ptr[n] = m
    pair = np.empty(m, np.int64)
    got = np.empty(m, np.bool_)
    n_in_range = np.zeros(n, np.int64)
    stamp[:] = -1
    for i in range(n):
        for k in range(heard_ptr[i], heard_ptr[i + 1]):
            stamp[listener[k]] = i
        for k in range(ptr[i], ptr[i + 1]):
            j = near[k]
            pair[k] = (actor[i] << 32) | actor[j]
            got[k] = stamp[j] == i
            n_in_range[j] += n_messages[i]
    return pair, got, n_in_range


@compiled
def _by_sender(station, message, receiver, hop, n):
    """The receivers of each sender, compressed rows, in their order. Later hops, if `hop` has any, are left out."""
    ptr = np.zeros(n + 1, np.int64)
    for row in range(len(message)):
        sender = station[message[row]]
        is_direct = len(hop) == 0 or hop[row] == 1
        if sender < n and receiver[row] < n and is_direct:
            ptr[sender + 1] += 1
    for i in range(n):
        ptr[i + 1] += ptr[i]
    of_sender, at = np.empty(ptr[n], np.int32), ptr.copy()
    for row in range(len(message)):
        sender = station[message[row]]
        is_direct = len(hop) == 0 or hop[row] == 1
        if sender < n and receiver[row] < n and is_direct:
            of_sender[at[sender]] = receiver[row]
            at[sender] += 1
    return ptr, of_sender
