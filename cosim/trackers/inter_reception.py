"""Packet inter-reception times: between successive messages of one vehicle at another, while within range."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numba import njit
from numpy import ndarray


@dataclass(slots=True)
class InterReceptionTracker:
    """Of one message type: the pairs within communication range, and the step of the last reception of each.

    It takes plain arrays of actor numbers and can be copied deeply and pickled at any time.
    """

    _pair: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender and receiver in one number, ascending; all pairs within range in the last step."""
    _last: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step of the last reception since they came within range; meaningless where there was none."""
    _received: Bool[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, bool))
    """Whether there was one."""
    _step: int = 0
    """Last step with a round of messages."""

    def update(
        self,
        step: int,
        sender: Int[ndarray, "p"],
        receiver: Int[ndarray, "p"],
        received: Bool[ndarray, "p"],
    ) -> dict[str, ndarray]:
        """Add one round of messages.

        Parameters
        ----------
        sender, receiver
            Pairs within communication range in which the sender had a message, each once, sorted.
        received
            Whether the receiver got it, over any number of hops.

        Returns
        -------
        Columns pir_steps, n_received, n_censored of the table `packet_inter_reception`.
        """
        pair = (sender.astype(np.int64) << 32) | receiver
        last, has_last, gone = _carried_on(self._pair, self._last, self._received, pair)
        ended = step - last[received & has_last]
        censored = self._step - self._last[gone & self._received]
        n_received, n_censored = np.bincount(ended), np.bincount(censored)
        lengths = np.union1d(np.flatnonzero(n_received), np.flatnonzero(n_censored))
        self._pair, self._step = pair, step
        self._last, self._received = np.where(received, step, last), received | has_last
        return {
            "pir_steps": lengths,
            "n_received": _at(n_received, lengths),
            "n_censored": _at(n_censored, lengths),
        }


@njit(cache=True, nogil=True)
def _carried_on(held, held_last, held_received, pair):
    """What is held of each pair, and which held pairs are not among them; both are sorted."""
    last, has_last = np.zeros(len(pair), np.int64), np.zeros(len(pair), np.bool_)
    gone = np.ones(len(held), np.bool_)
    at = 0
    for row in range(len(pair)):
        while at < len(held) and held[at] < pair[row]:
            at += 1
        if at < len(held) and held[at] == pair[row]:
            last[row], has_last[row], gone[at] = held_last[at], held_received[at], False
    return last, has_last, gone


def _at(count: Int[ndarray, "k"], lengths: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Counts of these lengths; 0 beyond the longest that was counted."""
    return np.pad(count, (0, max(0, int(lengths.max(initial=-1)) + 1 - len(count))))[lengths]


@njit(cache=True, nogil=True)
def contained(one, other, of_one, of_other):
    """Whether each pair is among some others; both are sorted."""
    found = np.zeros(len(one), np.bool_)
    at = 0
    for row in range(len(one)):
        while at < len(of_one) and (of_one[at] < one[row] or (of_one[at] == one[row] and of_other[at] < other[row])):
            at += 1
        found[row] = at < len(of_one) and of_one[at] == one[row] and of_other[at] == other[row]
    return found


@njit(cache=True, nogil=True)
def unique_pairs(one, other, n):
    """Pairs of numbers below n, sorted, each once: sorts by counting, by `other` and then by `one`."""
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
