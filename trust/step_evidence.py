"""Evidence about the detections of one step: sums over the evaluations that holders have received.

A *pair* is a holder and a subject of whose detections the holder has received evaluations. Each pair has a block of
slots, one per detection of the subject. A slot holds sums over the evaluations of its detection. The sums are integers,
so that no order of arrival, no batching and no delay can change one.

Received evaluations come here in this order: `OpenStep.accept` drops invalid ones, `StepEvidence.add` adds the others
to the sums, and `StepEvidence.of_pairs` turns the sums of a pair into equations 3 and 4 of TruPercept. `EvidenceStore`
keeps one `StepEvidence` per step.

Arrays that end in `ptr` are those of compressed rows: row i has the items ptr[i]:ptr[i + 1] of another array. In the
kernels, evaluators and subjects are rows of the pseudonyms of the step.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import offsets, owner_of_rows, ranges
from trust.open_steps import AcceptedEvaluations, OpenStep
from trust.tables import EvaluationMessages, float64, pair_key, unpaired

ONE = float(1 << 44)
"""Fixed point of the sums: the error is 3e-14 per evaluation, and there is room for half a million of them."""


@compiled
def _terms_of_evaluations(ptr, evaluator, subject, evaluation, visibility):
    """What each accepted evaluation adds to `StepEvidence.sums` and `n_evaluations`: one row per evaluation each.

    Message i has the evaluations ptr[i]:ptr[i + 1], all by evaluator[i].
    """
    terms = np.zeros((subject.size, 2), np.int64)
    counts = np.zeros((subject.size, 2), np.int32)
    for message in range(evaluator.size):
        for k in range(ptr[message], ptr[message + 1]):
            counts[k, 0] = 1
            if subject[k] != evaluator[message]:
                phi = visibility[k]
                terms[k, 0] = np.int64(np.rint(phi * ONE))
                phi_e = phi * evaluation[k]
                terms[k, 1] = np.int64(np.rint(phi_e * ONE))
                counts[k, 1] = terms[k, 0] > 0
    return terms, counts


@compiled
def _add_to_slots(receptions, pairs, block, ptr, subject, offset, terms, counts, sums, n_evaluations):
    """Add the terms of every evaluation to the slot of its detection, for every holder that received it.

    `receptions` has the messages that each holder received, `pairs` the subjects that these messages evaluate, and
    `block` the first slot of each pair; `offset` is the number of a detection within that block. In NumPy, the sum
    would need a row per holder and evaluation: gigabytes in a large city.
    """
    received_ptr, message = receptions
    pair_ptr, subject_of_pair = pairs
    block_of_subject = np.zeros(subject_of_pair.max() + 1, np.int64)  # for one holder at a time
    for holder in range(received_ptr.size - 1):
        for pair in range(pair_ptr[holder], pair_ptr[holder + 1]):
            block_of_subject[subject_of_pair[pair]] = block[pair]
        for r in range(received_ptr[holder], received_ptr[holder + 1]):
            for k in range(ptr[message[r]], ptr[message[r] + 1]):
                slot = block_of_subject[subject[k]] + offset[k]
                for column in range(2):
                    sums[slot, column] += terms[k, column]
                    n_evaluations[slot, column] += counts[k, column]


@compiled
def _distinct_subjects(group_ptr, message, ptr, subject, is_chosen, n_subjects):
    """Subjects of the chosen evaluations in the messages of each group, each subject once, as compressed rows.

    They are counted first and written then: an upper bound of their number would be gigabytes in a large city.
    """
    last_seen = np.full(n_subjects, -1, np.int64)  # of each subject: the newest group, counted over both passes
    n_groups = group_ptr.size - 1
    found_ptr = np.zeros(n_groups + 1, np.int64)
    found = np.empty(0, np.int64)
    for is_second_pass in range(2):
        n = 0
        for group in range(n_groups):
            now = group + is_second_pass * n_groups
            for r in range(group_ptr[group], group_ptr[group + 1]):
                for k in range(ptr[message[r]], ptr[message[r] + 1]):
                    if is_chosen[k] and last_seen[subject[k]] != now:
                        last_seen[subject[k]] = now
                        if is_second_pass:
                            found[n] = subject[k]
                        n += 1
            found_ptr[group + 1] = n
        if not is_second_pass:
            found = np.empty(n, np.int64)
    return found_ptr, found


class Counting(NamedTuple):
    """Which detections count in the trust of their sender, and how much."""

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
        has_room = sent.pseudonyms.size <= np.iinfo(np.uint16).max
        kind = np.uint16 if has_room else np.uint32
        self.n_evaluations: UInt[ndarray, "s 2"] = np.zeros((0, 2), kind)
        """Per slot: all evaluations, and those by others that could see (Phi > 0). Each pseudonym counts once."""
        self._of_pairs: dict[Counting, tuple[ndarray, ndarray]] = {}
        """Results of `of_pairs`, until evaluations are added."""

    def add(
        self, messages: EvaluationMessages, accepted: AcceptedEvaluations, least_score: float
    ) -> tuple[Int[ndarray, "q"], Int[ndarray, "q"]]:
        """Add the accepted part of some messages to the sums.

        Returns
        -------
        Pair (`pair_key` of holder and subject) and pseudonym of every evaluator that could see a detection of the
        subject with at least this score. None is there twice.
        """
        evaluation = float64(messages.evaluation[accepted.kept])
        visibility = float64(messages.visibility[accepted.kept])
        ptr, evaluator, subject = accepted.ptr, accepted.evaluator, accepted.observer
        terms, counts = _terms_of_evaluations(ptr, evaluator, subject, evaluation, visibility)
        self._add_terms(accepted, terms, counts)
        is_scored = self.sent.score[accepted.detection] >= least_score
        is_evidence = (counts[:, 1] > 0) & is_scored
        return self._pairs_and_evaluators(accepted, is_evidence)

    def _add_terms(
        self, accepted: AcceptedEvaluations, terms: Int[ndarray, "k 2"], counts: Int[ndarray, "k 2"]
    ) -> None:
        """Add what each evaluation adds, for every holder that received its message."""
        holders, holder_row = np.unique(accepted.holder, return_inverse=True)
        received_ptr = offsets(np.bincount(holder_row, minlength=holders.size))
        message = accepted.message_row[np.argsort(holder_row, kind="stable")]
        ptr, subject = accepted.ptr, accepted.observer
        pseudonyms, every = self.sent.pseudonyms, np.ones(subject.size, bool)
        pair_ptr, pair_subject = _distinct_subjects(received_ptr, message, ptr, subject, every, pseudonyms.size)
        keys = pair_key(np.repeat(holders, np.diff(pair_ptr)), pseudonyms[pair_subject])
        if not keys.size:
            return
        self._make_room(keys)
        block = self.block[np.searchsorted(self.pairs, keys)]
        offset = accepted.detection - self.sent.first[subject]
        receptions, pairs = (received_ptr, message), (pair_ptr, pair_subject)
        _add_to_slots(receptions, pairs, block, ptr, subject, offset, terms, counts, self.sums, self.n_evaluations)
        self._of_pairs = {}

    def _pairs_and_evaluators(
        self, accepted: AcceptedEvaluations, is_evidence: Bool[ndarray, "k"]
    ) -> tuple[Int[ndarray, "q"], Int[ndarray, "q"]]:
        """What `add` returns; `is_evidence` says of each evaluation whether its evaluator counts."""
        pseudonyms, message = self.sent.pseudonyms, accepted.message_row
        each = np.arange(accepted.evaluator.size + 1)  # every message is a group of its own
        ptr, subject = _distinct_subjects(each, each, accepted.ptr, accepted.observer, is_evidence, pseudonyms.size)
        n = np.diff(ptr)[message]  # subjects of each received message
        subject = pseudonyms[subject[ranges(ptr[message], n)]]
        evaluator = pseudonyms[accepted.evaluator[message]]
        return pair_key(np.repeat(accepted.holder, n), subject), np.repeat(evaluator, n)

    def of_pairs(self, counting: Counting) -> tuple[Float[ndarray, "p 2"], Int[ndarray, "p"]]:
        """Equations 3 and 4 within the step, and how many evaluations are behind them; both are kept until `add`.

        Returns
        -------
        Per pair sum s T(theta) and sum s over the detections, and the evaluations by others that could see.
        """
        if counting in self._of_pairs:
            return self._of_pairs[counting]
        phi, phi_e = self.sums.T
        n, n_seeing = self.n_evaluations.T
        n_slots = np.diff(self.block)
        pair_of_slot = owner_of_rows(n_slots)
        first_detection = self.sent.first[self._subjects(self.pairs)]
        score = self.sent.score[ranges(first_detection, n_slots)]
        is_counted = (n > 0) & (score >= counting.least_score)
        if counting.skip_unseen:
            is_counted &= phi > 0
        weight = np.where(is_counted, score if counting.by_score else 1.0, 0.0)
        trust = np.divide(phi_e, phi, out=np.zeros(phi.size), where=phi > 0)  # T(theta); 0 for an unseen detection

        def per_pair(column: ndarray) -> ndarray:
            return np.bincount(pair_of_slot, column, self.pairs.size)

        sums = np.column_stack([per_pair(weight * trust), per_pair(weight)]).astype(float)
        n_evaluations = per_pair(n_seeing * is_counted).astype(np.int64)
        self._of_pairs[counting] = sums, n_evaluations
        return sums, n_evaluations

    def _make_room(self, keys: Int[ndarray, "k"]) -> None:
        """Make blocks for pairs that have none. The other pairs keep their sums."""
        before, n_before = self.pairs, np.diff(self.block)
        self.pairs = np.union1d(before, keys)
        if self.pairs.size == before.size:
            return
        n_slots = np.diff(self.sent.first)[self._subjects(self.pairs)]
        self.block = offsets(n_slots)
        slots = ranges(self.block[np.searchsorted(self.pairs, before)], n_before)  # where the old ones are now
        for name in ("sums", "n_evaluations"):
            old = getattr(self, name)
            new = np.zeros((self.block[-1], 2), old.dtype)
            new[slots] = old
            setattr(self, name, new)

    def _subjects(self, pairs: Int[ndarray, "p"]) -> Int[ndarray, "p"]:
        """Row of each pair's subject among the pseudonyms."""
        return np.searchsorted(self.sent.pseudonyms, unpaired(pairs)[1])
