"""Steps whose evaluations are still accepted: the check that received evaluations pass in every trust model."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from cosim.base.ragged import rows_of
from trust.pair_index import merged
from trust.tables import ReceivedEvaluations, float64, int64, pair_key

MAX_DETECTIONS = 1 << 18
"""Detection indices are below this."""

LARGE = 10_000
"""Evaluations in a batch that is checked at once. Smaller batches of a step may wait, to be checked as one."""


class RejectReason(IntEnum):
    """Why an evaluation has no effect."""

    ACCEPTED = 0
    LATE = 1  # of a step that has left the window
    FUTURE = 2  # of a step that has not begun
    BAD_VALUE = 3  # e outside [-1, 1], Phi outside [0, 1], or not a number
    UNKNOWN_EVALUATOR = 4  # not present in that step
    UNKNOWN_OBSERVER = 5  # its observer was not present in that step
    UNKNOWN_DETECTION = 6  # was not transmitted
    DUPLICATE = 7  # the holder has a message of this evaluator already, or the message has this detection already


@dataclass(frozen=True, slots=True)
class AcceptedEvaluations:
    """The part of some received evaluations that counts; rows of pseudonyms and detections are those of the step."""

    holder: Int[ndarray, "m"]  # of each reception of a message
    message_row: Int[ndarray, "m"]  # message that was received
    evaluator: Int[ndarray, "v"]  # row of each message's evaluator; -1 where it was not present
    ptr: Int[ndarray, "v+1"]  # message i has the evaluations ptr[i]:ptr[i + 1] of the columns below
    kept: Int[ndarray, "k"]  # row of each accepted evaluation in the messages as they were received
    observer: Int[ndarray, "k"]  # row of the pseudonym whose detection it is
    detection: Int[ndarray, "k"]  # row of the detection
    n_rejected: Int[ndarray, "reasons"]  # received evaluations without effect, by `RejectReason`


_ACCEPTED = int(RejectReason.ACCEPTED)
_BAD_VALUE = int(RejectReason.BAD_VALUE)
_UNKNOWN_EVALUATOR = int(RejectReason.UNKNOWN_EVALUATOR)
_UNKNOWN_OBSERVER = int(RejectReason.UNKNOWN_OBSERVER)
_UNKNOWN_DETECTION = int(RejectReason.UNKNOWN_DETECTION)
_DUPLICATE = int(RejectReason.DUPLICATE)


@compiled
def _checked(ptr, is_known, row, is_present, index, evaluation, visibility, first, score):
    """`RejectReason` and detection row of each evaluation; no row where it is rejected.

    Parameters
    ----------
    ptr, is_known
        First row of each message, and whether its evaluator is known.
    row, is_present
        Row of each observer, and whether it was present.
    index, evaluation, visibility
        Of each evaluation.
    first, score
        As in `OpenStep`.
    """
    reason = np.zeros(row.size, np.uint8)
    detection = np.zeros(row.size, np.int64)
    mark = np.full(score.size, -1, np.int64)  # of each detection: the last message that evaluates it
    for message in range(is_known.size):
        for k in range(ptr[message], ptr[message + 1]):
            observer = row[k]
            at = first[observer] + index[k]  # means nothing where the index is out of range
            if not is_known[message]:
                reason[k] = _UNKNOWN_EVALUATOR
            elif not is_present[k]:
                reason[k] = _UNKNOWN_OBSERVER
            elif not 0 <= index[k] < first[observer + 1] - first[observer]:
                reason[k] = _UNKNOWN_DETECTION
            elif not score[at] >= 0.0:
                reason[k] = _UNKNOWN_DETECTION
            elif not abs(evaluation[k]) <= 1.0 or not 0.0 <= visibility[k] <= 1.0:
                reason[k] = _BAD_VALUE
            elif mark[at] == message:
                reason[k] = _DUPLICATE
            else:
                mark[at] = message
                detection[k] = at
    return reason, detection


@compiled
def _opened(n, row, index, score):
    """`OpenStep.first` and `score` of n pseudonyms, and how many detections are left out."""
    valid = (score >= 0.0) & (score <= 1.0) & (index >= 0) & (index < MAX_DETECTIONS)
    first = np.zeros(n + 1, np.int64)
    for d in np.flatnonzero(valid):
        after = row[d] + 1
        first[after] = max(first[after], index[d] + 1)
    first = np.cumsum(first)
    of_detection, n_bad = np.full(first[-1], np.nan), score.size
    for d in np.flatnonzero(valid):
        at = first[row[d]] + index[d]
        if np.isnan(of_detection[at]):
            of_detection[at] = score[d]
            n_bad -= 1
    return first, of_detection, n_bad


class OpenStep:
    """What was transmitted in one step, and which messages of evaluations about it holders have received.

    An evaluator sends one message of evaluations per step. If a holder receives several, the first counts; if a
    message evaluates one detection several times, its first valid evaluation counts.
    """

    def __init__(
        self,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step; the arguments are those of `TrustModel.open_step`."""
        assert np.all(pseudonyms[1:] > pseudonyms[:-1]), "pseudonyms are ascending"
        first, of_detection, n_bad = _opened(
            pseudonyms.size, int64(observer_row), int64(detection_index), float64(score)
        )
        self.pseudonyms = int64(pseudonyms)
        """Present in the step, ascending."""
        self.first: Int[ndarray, "n+1"] = first
        """Detections of pseudonym row r are first[r]:first[r + 1], in the order of detection_index."""
        self.score: Float[ndarray, "s"] = of_detection
        """Of each detection; NaN where a detection_index was not transmitted."""
        self.n_bad_detections: int = n_bad
        """Detections left out: score outside [0, 1], index out of range or given twice."""
        self._received = np.empty(0, np.int64)  # `pair_key` of holder and evaluator row, ascending

    def accept(self, received: ReceivedEvaluations) -> AcceptedEvaluations:
        """Check evaluations of this step, and remember the messages as received.

        Parameters
        ----------
        received
            Evaluations of detections of this step, with any content.

        Returns
        -------
        What counts of them, and how many were rejected for which reason.
        """
        messages = received.messages
        evaluator, is_known = rows_of(int64(messages.evaluator), self.pseudonyms)
        receptions = self._new_receptions(received, evaluator, is_known)
        observer, is_present = rows_of(int64(messages.observer), self.pseudonyms)
        reason, detection = _checked(
            int64(messages.ptr),
            is_known,
            observer,
            is_present,
            int64(messages.detection_index),
            float64(messages.evaluation),
            float64(messages.visibility),
            self.first,
            self.score,
        )
        holder = int64(received.holder)[receptions]
        message_row = int64(received.message_row)[receptions]

        n_of_message = np.bincount(message_row, minlength=evaluator.size)
        n_receptions = np.repeat(n_of_message, np.diff(messages.ptr))
        n_rejected = np.bincount(reason, n_receptions, len(RejectReason)).astype(np.int64)
        n_rejected[RejectReason.ACCEPTED] = 0
        n_rejected[RejectReason.DUPLICATE] += len(received) - int(n_receptions.sum())

        kept = np.flatnonzero(reason == _ACCEPTED)
        return AcceptedEvaluations(
            holder=holder,
            message_row=message_row,
            evaluator=np.where(is_known, evaluator, -1),
            ptr=np.searchsorted(kept, messages.ptr),
            kept=kept,
            observer=observer[kept],
            detection=detection[kept],
            n_rejected=n_rejected,
        )

    def _new_receptions(
        self, received: ReceivedEvaluations, evaluator: Int[ndarray, "v"], is_known: Bool[ndarray, "v"]
    ) -> Int[ndarray, "k"]:
        """Receptions of messages that their holders do not have yet.

        Those of unknown evaluators are not remembered, nor are those without an evaluation: a message about another
        step comes along without rows, and what its sender says of this step may follow.
        """
        n_evaluations = np.diff(received.messages.ptr)
        is_remembered = is_known & (n_evaluations > 0)
        known = is_remembered[received.message_row]
        rows = np.flatnonzero(known)
        sender = evaluator[received.message_row[rows]]
        keys, first = np.unique(pair_key(int64(received.holder)[rows], sender), return_index=True)
        _, is_old = rows_of(keys, self._received)
        self._received = merged(self._received, keys[~is_old])
        of_known = rows[first[~is_old]]
        of_unknown = np.flatnonzero(~known)
        return np.sort(np.concatenate([of_known, of_unknown]))


class OpenSteps:
    """The recent steps, and counters of what was received about them: for trust models that are written in NumPy."""

    def __init__(self, n_steps: int) -> None:
        self.n_steps = n_steps
        """Steps, the present one included, whose evaluations are accepted."""
        self.now = -1
        self.rejected = np.zeros(len(RejectReason), np.int64)
        """Evaluations rejected so far, by `RejectReason`."""
        self.n_received = 0
        """Evaluations received so far, rejected ones included."""
        self._steps: dict[int, OpenStep] = {}

    def __contains__(self, step: int) -> bool:
        """Whether evaluations of the step are accepted."""
        return step in self._steps

    def open(self, step: int, pseudonyms, observer_row, detection_index, score) -> None:
        """Begin a step; the arguments are those of `TrustModel.open_step`."""
        self._steps[step] = OpenStep(pseudonyms, observer_row, detection_index, score)
        self.advance(step)

    def advance(self, now_step: int) -> None:
        """Close the steps that are older than `n_steps`."""
        assert now_step >= self.now, "steps come in the order of time"
        self.now = now_step
        for step in [s for s in self._steps if s <= now_step - self.n_steps]:
            del self._steps[step]

    def accepted(self, received: ReceivedEvaluations) -> ReceivedEvaluations | None:
        """The part of received evaluations that counts; the rest is counted in `rejected`.

        Parameters
        ----------
        received
            Evaluations of the detections of one step, with any content.

        Returns
        -------
        Valid evaluations of messages that their holders did not have yet; None if the step is not open.
        """
        messages, step = received.messages, received.messages.step
        self.n_received += len(received)
        if step not in self._steps:
            reason = RejectReason.FUTURE if step > self.now else RejectReason.LATE
            self.rejected[reason] += len(received)
            return None
        part = self._steps[step].accept(received)
        self.rejected += part.n_rejected
        valid = messages.with_rows(part.kept, messages.evaluator, part.ptr)
        return ReceivedEvaluations(valid, part.holder, part.message_row, received.eta, received.is_own)
