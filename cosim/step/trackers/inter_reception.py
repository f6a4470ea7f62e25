"""Packet inter-reception times: between successive messages of one vehicle at another, while within range."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from sensors.kernel import compiled


@dataclass(frozen=True, slots=True)
class InterReceptionTracker:
    """Of one message type: the pairs within communication range, and the step of the last reception of each."""

    pair: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender and receiver in one number, ascending; all pairs within range in the last step."""
    last: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step of the last reception since they came within range; meaningless where there was none."""
    received: Bool[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, bool))
    """Whether there was one."""
    step: int = 0
    """Last step with a round of messages."""

    def next(
        self, step: int, sender: Int[ndarray, "p"], receiver: Int[ndarray, "p"], received: Bool[ndarray, "p"]
    ) -> tuple["InterReceptionTracker", dict[str, ndarray]]:
        """The same after one more round of messages, and what ended in it.

        All numbers are actor numbers.

        Parameters
        ----------
        sender, receiver
            Pairs within communication range in which the sender had a message, each once, sorted.
        received
            Whether the receiver got it, over any number of hops.

        Returns
        -------
        The tracker, and the columns pir_steps, n_received, n_censored of the table `packet_inter_reception`.
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
    """Step of the last reception of each pair, if there was one; intervals that end, and that are cut off, by length.

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
    """Which of these sorted pairs are among others, `by` and `to`, of which `to` ascends; all are numbers below n."""
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
    """Pairs of numbers below n, sorted, each once; in one pass where they are sorted but for repetitions."""
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
    """The same, sorted by counting: by `other` and then by `one`."""
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
