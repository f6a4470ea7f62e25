"""Evidence about the detections of one step.

A *pair* is a holder and a subject of whose detections the holder has received evaluations. The pairs are sorted. Each
has a block of slots, one per detection of the subject, and a slot holds sums over the evaluations of that detection.
The sums are integers, so that no order of arrival, no batching and no delay can change one.
"""

from itertools import chain
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from numpy import ndarray

from trust.open_steps import AcceptedEvaluations, OpenStep
from trust.tables import EvaluationMessages, float64, pair_key, ranges, unpaired

ONE = float(1 << 44)
"""Fixed point of the sums: the error is 3e-14 per evaluation, and there is room for half a million of them."""


@njit(cache=True, nogil=True)
def _terms(ptr, evaluator, observer, evaluation, visibility):
    """What each evaluation adds to `StepEvidence.sums` and `n_evaluations`."""
    terms, counts = np.zeros((observer.size, 2), np.int64), np.zeros((observer.size, 2), np.int32)
    for message in range(evaluator.size):
        for k in range(ptr[message], ptr[message + 1]):
            counts[k, 0] = 1
            if observer[k] != evaluator[message]:
                terms[k, 0] = np.int64(np.rint(visibility[k] * ONE))
                terms[k, 1] = np.int64(np.rint(visibility[k] * evaluation[k] * ONE))
                counts[k, 1] = terms[k, 0] > 0
    return terms, counts


@njit(cache=True, nogil=True)
def _add(receptions, pairs, block, messages, subject, index, terms, counts, sums, n_evaluations):
    """Add the terms of every evaluation to the slots of its detection, for every holder that received it.

    Of the compressed rows `receptions` (holder x message) and `pairs` (holder x subject), `block` is the first slot of
    each of the latter. In NumPy the sum would need a row per holder and evaluation: gigabytes in a large city.
    """
    received_ptr, message = receptions
    pair_ptr, subject_of_pair = pairs
    block_of = np.zeros(subject_of_pair.max() + 1, np.int64)
    for holder in range(received_ptr.size - 1):
        for pair in range(pair_ptr[holder], pair_ptr[holder + 1]):
            block_of[subject_of_pair[pair]] = block[pair]
        for r in range(received_ptr[holder], received_ptr[holder + 1]):
            for p in range(messages[message[r]], messages[message[r] + 1]):
                slot = block_of[subject[p]] + index[p]
                for k in range(2):
                    sums[slot, k] += terms[p, k]
                    n_evaluations[slot, k] += counts[p, k]


@njit(cache=True, nogil=True)
def _distinct(group_ptr, message, ptr, subject, counts, n_subjects):
    """Compressed rows of the subjects that the messages of each group evaluate, each once; `counts` chooses among the
    evaluations. Counted first and filled then: a bound of the size would be gigabytes in a large city."""
    mark = np.full(n_subjects, -1, np.int64)
    n_groups = group_ptr.size - 1
    found_ptr = np.zeros(n_groups + 1, np.int64)
    found = np.empty(0, np.int64)
    for fills in range(2):
        n = 0
        for group in range(n_groups):
            for r in range(group_ptr[group], group_ptr[group + 1]):
                for p in range(ptr[message[r]], ptr[message[r] + 1]):
                    if counts[p] and mark[subject[p]] != group + fills * n_groups:
                        mark[subject[p]] = group + fills * n_groups
                        if fills:
                            found[n] = subject[p]
                        n += 1
            found_ptr[group + 1] = n
        if not fills:
            found = np.empty(n, np.int64)
    return found_ptr, found


class Counting(NamedTuple):
    """What counts of the evidence."""

    by_score: bool
    """Detections count by their scores. Otherwise all count alike."""
    skip_unseen: bool
    """Detections that no evaluator could see do not count."""
    least_score: float
    """Detections with lower scores do not count."""


class StepEvidence:
    """What was transmitted in one step, and the sums over the evaluations of it that holders have received."""

    def __init__(self, sent: OpenStep) -> None:
        self.sent = sent
        self.pairs: Int[ndarray, "p"] = np.empty(0, np.int64)
        """`pair_key` of holder and subject, ascending."""
        self.row: Int[ndarray, "p"] = np.empty(0, np.int64)
        """Row of each pair in the store."""
        self.block: Int[ndarray, "p+1"] = np.zeros(1, np.int64)
        """Slots of pair i are block[i]:block[i + 1], one per detection of its subject."""
        self.sums: Int[ndarray, "s 2"] = np.zeros((0, 2), np.int64)
        """Per slot, over the evaluations by others than the subject: Phi and Phi e in units of 1 / ONE."""
        self.n_evaluations: Int[ndarray, "s 2"] = np.zeros((0, 2), np.int32)
        """Per slot: all evaluations, and those by others that could see (Phi > 0)."""
        self._of_pairs: dict[Counting, tuple[ndarray, ndarray]] = {}

    def add(self, messages: EvaluationMessages, accepted: AcceptedEvaluations) -> tuple[ndarray, ndarray]:
        """Add the accepted part of some messages to the sums.

        Returns
        -------
        Pair (`pair_key` of holder and subject) and pseudonym of every evaluator that could see a detection of the
        subject. None is there twice.
        """
        ptr, observer = accepted.ptr, accepted.observer
        e, phi = (float64(a[accepted.kept]) for a in (messages.evaluation, messages.visibility))
        terms, counts = _terms(ptr, accepted.evaluator, observer, e, phi)
        n_messages, n_subjects = accepted.evaluator.size, self.sent.pseudonyms.size
        holders, holder_row = np.unique(accepted.holder, return_inverse=True)
        received_ptr = np.append(0, np.cumsum(np.bincount(holder_row, minlength=holders.size)))
        message = accepted.message_row[np.argsort(holder_row, kind="stable")]
        every = np.ones(observer.size, bool)
        pair_ptr, subject = _distinct(received_ptr, message, ptr, observer, every, n_subjects)
        keys = pair_key(np.repeat(holders, np.diff(pair_ptr)), self.sent.pseudonyms[subject])  # who holds what of whom
        if keys.size:
            self._make_room(keys)
            _add(
                (received_ptr, message), (pair_ptr, subject),
                self.block[np.searchsorted(self.pairs, keys)], ptr, observer,
                accepted.detection - self.sent.first[observer], terms, counts, self.sums, self.n_evaluations,
            )  # fmt: skip
            self._of_pairs = {}

        each = np.arange(n_messages + 1)
        seen_ptr, seen = _distinct(each, each, ptr, observer, counts[:, 1] > 0, n_subjects)
        n = np.diff(seen_ptr)[accepted.message_row]
        subject = self.sent.pseudonyms[seen[ranges(seen_ptr[accepted.message_row], n)]]
        evaluator = self.sent.pseudonyms[accepted.evaluator[accepted.message_row]]
        return pair_key(np.repeat(accepted.holder, n), subject), np.repeat(evaluator, n)

    def of_pairs(self, counting: Counting) -> tuple[Float[ndarray, "p 2"], Int[ndarray, "p"]]:
        """Equations 3 and 4 within the step, and how many evaluations are behind them; both are kept until `add`.

        Returns
        -------
        Per pair sum s T(theta) and sum s over the detections, and the evaluations by others that could see.
        """
        if counting not in self._of_pairs:
            n, n_slots = self.pairs.size, np.diff(self.block)
            pair = np.repeat(np.arange(n), n_slots)
            phi = self.sums[:, 0]
            score = self.sent.score[ranges(self.sent.first[self._subjects(self.pairs)], n_slots)]
            counts = self.n_evaluations[:, 0] > 0
            counts &= ~(counting.skip_unseen & (phi == 0))
            counts &= score >= counting.least_score
            weight = np.where(counts, score if counting.by_score else 1.0, 0.0)
            trust = np.divide(self.sums[:, 1], phi, out=np.zeros(phi.size), where=phi > 0)
            sums = [np.bincount(pair, x, n) for x in (weight * trust, weight, self.n_evaluations[:, 1] * counts)]
            both = np.column_stack(sums[:2]).astype(float)
            self._of_pairs[counting] = both, sums[2].astype(np.int64)
        return self._of_pairs[counting]

    @property
    def nbytes(self) -> int:
        """Memory [B]."""
        arrays = self.pairs, self.row, self.block, self.sums, self.n_evaluations
        computed = chain.from_iterable(self._of_pairs.values())
        return self.sent.nbytes + sum(a.nbytes for a in chain(arrays, computed))

    def _make_room(self, keys: Int[ndarray, "k"]) -> None:
        """Blocks for pairs that have none; the others keep their sums."""
        before, block = self.pairs, self.block
        self.pairs = np.union1d(before, keys)
        if self.pairs.size == before.size:
            return
        n_slots = np.diff(self.sent.first)[self._subjects(self.pairs)]
        self.block = np.concatenate([[0], np.cumsum(n_slots)])
        slots = ranges(self.block[np.searchsorted(self.pairs, before)], np.diff(block))
        for name in ("sums", "n_evaluations"):
            old = getattr(self, name)
            new = np.zeros((self.block[-1], 2), old.dtype)
            new[slots] = old
            setattr(self, name, new)

    def _subjects(self, pairs: Int[ndarray, "p"]) -> Int[ndarray, "p"]:
        """Row of each pair's subject among the pseudonyms."""
        return np.searchsorted(self.sent.pseudonyms, unpaired(pairs)[1])
