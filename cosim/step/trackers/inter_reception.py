"""Packet inter-reception times: between successive messages of one vehicle at another vehicle within range."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from sensors.kernel import compiled


@dataclass(frozen=True, slots=True)
class InterReceptionTracker:
    """Pairs within communication range and their last receptions, for one message type."""

    pair: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender and receiver in one number, ascending; all pairs within range in the last step."""
    last: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step of the last reception since they came within range; meaningful only if `received`."""
    received: Bool[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, bool))
    """Whether there was a reception since they came within range."""
    step: int = 0
    """Last step with a round of messages."""

    def next(
        self, step: int, sender: Int[ndarray, "p"], receiver: Int[ndarray, "p"], received: Bool[ndarray, "p"]
    ) -> tuple["InterReceptionTracker", dict[str, ndarray]]:
        """Add one round of messages.

        Parameters
        ----------
        step
            Number of the step.
        sender, receiver
            Actor numbers of the pairs within communication range in which the sender had a message, each once, sorted.
        received
            Whether the receiver got the message, over any number of hops.

        Returns
        -------
        The new tracker, and the columns pir_steps, n_received, n_censored of the table `packet_inter_reception`.
        """
        pair = (sender.astype(np.int64) << 32) | receiver
        last, received, n_received, n_censored = _carried_on(
            self.pair, self.last, self.received, pair, received, step, self.step
        )
        lengths = np.flatnonzero(n_received + n_censored)
        rows = {"pir_steps": lengths, "n_received": n_received[lengths], "n_censored": n_censored[lengths]}
        return InterReceptionTracker(pair, last, received, step), rows


@compiled
def _carried_on(held, held_last, held_received, pair, received, step, last_step):
    """Last reception of each pair, and counts of intervals by length: those that end, and those that are censored.

    Both lists of pairs are sorted.
    """
    longest = 0
    for at in range(len(held)):
        longest = max(longest, step - held_last[at] if held_received[at] else 0)
    n_ended, n_cut = np.zeros(longest + 1, np.int64), np.zeros(longest + 1, np.int64)
    last, has_last = np.empty(len(pair), np.int64), np.empty(len(pair), np.bool_)
    at = 0
    for row in range(len(pair) + 1):
        while at < len(held) and (row == len(pair) or held[at] < pair[row]):
            if held_received[at]:
                n_cut[last_step - held_last[at]] += 1
            at += 1
        if row == len(pair):
            break
        before, had_one = 0, False
        if at < len(held) and held[at] == pair[row]:
            before, had_one = held_last[at], held_received[at]
            at += 1
        ends = received[row] & had_one
        n_ended[ends * (step - before)] += ends
        last[row], has_last[row] = step if received[row] else before, received[row] | had_one
    return last, has_last, n_ended, n_cut


@compiled
def reached(sender, receiver, n, by, to):
    """Whether each sorted pair (sender, receiver) is among the pairs (by, to).

    `to` is ascending. All numbers are below n.
    """
    at = np.zeros(n + 1, np.int64)
    for row in range(len(sender)):
        at[sender[row] + 1] += 1
    for i in range(n):
        at[i + 1] += at[i]
    end = at[1:].copy()
    found = np.zeros(len(sender), np.bool_)
    for k in range(len(by)):
        row, last = at[by[k]], end[by[k]]
        while row < last and receiver[row] < to[k]:
            row += 1
        at[by[k]] = row
        if row < last and receiver[row] == to[k]:
            found[row] = True
    return found


@compiled
def unique_pairs(one, other, n):
    """Distinct pairs of numbers below n, sorted. It takes one pass if they are sorted except for repetitions."""
    found, of, seen = np.empty(len(one), np.int64), np.empty(len(one), np.int64), np.full(n, -1)
    m = 0
    for row in range(len(one)):
        a, b = one[row], other[row]
        if seen[b] == a:
            continue
        if m > 0 and (a < found[m - 1] or (a == found[m - 1] and b < of[m - 1])):
            return _sorted_pairs(one, other, n)
        seen[b], found[m], of[m] = a, a, b
        m += 1
    return found[:m], of[:m]


@compiled
def _sorted_pairs(one, other, n):
    """Distinct pairs by counting sort: first by `other`, then by `one`."""
    by_one, by_other = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    for row in range(len(one)):
        by_one[one[row] + 1] += 1
        by_other[other[row] + 1] += 1
    by_one, by_other = np.cumsum(by_one), np.cumsum(by_other)
    put, first = by_other[:-1].copy(), np.empty(len(one), np.int32)
    for row in range(len(one)):
        first[put[other[row]]] = one[row]
        put[other[row]] += 1
    put, second = by_one[:-1].copy(), np.empty(len(one), np.int32)
    for value in range(n):
        for row in range(by_other[value], by_other[value + 1]):
            k = put[first[row]]
            if k == by_one[first[row]] or second[k - 1] != value:
                second[k] = value
                put[first[row]] += 1
    kept = np.sum(put - by_one[:-1])
    found, of = np.empty(kept, np.int64), np.empty(kept, np.int64)
    m = 0
    for value in range(n):
        for k in range(by_one[value], put[value]):
            found[m], of[m] = value, second[k]
            m += 1
    return found, of
