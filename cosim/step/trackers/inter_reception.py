"""Packet inter-reception times: between successive messages of one vehicle at another vehicle within range."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.ragged import distinct


@dataclass(frozen=True, slots=True)
class InterReceptionTracker:
    """Pairs within communication range and their last receptions, for one message type."""

    pair: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Sender and receiver in one number, ascending; all pairs within range when the sender last had a message."""
    last: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step of the last reception since they came within range; meaningful only if `received`."""
    received: Bool[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, bool))
    """Whether there was a reception since they came within range."""
    step: Int[ndarray, "p"] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Step in which the sender last had a message."""

    def next(
        self, step: int, sender: Int[ndarray, "p"], receiver: Int[ndarray, "p"], received: Bool[ndarray, "p"],
        silent: Int[ndarray, "v"] | None = None,
    ) -> tuple["InterReceptionTracker", dict[str, ndarray]]:  # fmt: skip
        """Add one round of messages.

        Parameters
        ----------
        step
            Number of the step.
        sender, receiver
            Actor numbers of the pairs within communication range in which the sender had a message, each once, sorted.
        received
            Whether the receiver got the message, over any number of hops.
        silent
            Actor numbers of the vehicles on the road that have no message in this step; their pairs stay as they are.
            None if there are no such vehicles.

        Returns
        -------
        The new tracker, and the columns pir_steps, n_received, n_censored of the table `packet_inter_reception`.
        """
        pair = (sender.astype(np.int64) << 32) | receiver
        _, before, now = np.intersect1d(self.pair, pair, assume_unique=True, return_indices=True)
        last, had_one = np.zeros(len(pair), np.int64), np.zeros(len(pair), bool)
        last[now], had_one[now] = self.last[before], self.received[before]
        lost = self.received.copy()
        lost[before] = False
        stay = np.zeros(len(self.pair), bool) if silent is None else np.isin(self.pair >> 32, silent)
        lost &= ~stay
        ended, cut = step - last[received & had_one], self.step[lost] - self.last[lost]
        size = 1 + max(int(ended.max(initial=0)), int(cut.max(initial=0)))
        n_received, n_censored = np.bincount(ended, minlength=size), np.bincount(cut, minlength=size)
        lengths = np.flatnonzero(n_received + n_censored)
        rows = {"pir_steps": lengths, "n_received": n_received[lengths], "n_censored": n_censored[lengths]}
        last, received, seen = np.where(received, step, last), received | had_one, np.full(len(pair), step)
        if stay.any():
            order = np.argsort(np.concatenate([pair, self.pair[stay]]), kind="stable")
            pair, last, received, seen = (
                np.concatenate([now, earlier[stay]])[order]
                for now, earlier in (
                    (pair, self.pair), (last, self.last), (received, self.received), (seen, self.step)
                )
            )  # fmt: skip
        return InterReceptionTracker(pair, last, received, seen), rows


def unique_pairs(
    one: Int[ndarray, "m"], other: Int[ndarray, "m"], n: int
) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:
    """Distinct pairs of numbers from 0 to n - 1, sorted by the first, then by the second number."""
    first, second = np.divmod(distinct(one.astype(np.int64) * n + other)[0], max(n, 1))
    return first, second
