"""Steps whose evaluations are still accepted: the input check of trust models that are written in NumPy."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from trust.step_evidence import MAX_DETECTIONS, RejectReason
from trust.tables import EvaluationMessages, ReceivedEvaluations, int64, pair_key


class OpenSteps:
    """What was transmitted in the recent steps, and which evaluations of it holders have received.

    An evaluator sends one message per step: of several that a holder receives, the first counts, and of several
    evaluations of one detection in a message the first.
    """

    def __init__(self, n_steps: int) -> None:
        self.n_steps = n_steps
        """Steps, the present one included, whose evaluations are accepted."""
        self.now = -1
        self.rejected = np.zeros(len(RejectReason), np.int64)
        """Evaluations rejected so far, by `RejectReason`."""
        self.n_received = 0
        """Evaluations received so far, rejected ones included."""
        self._pseudonyms: dict[int, Int[ndarray, "n"]] = {}
        self._detections: dict[int, Int[ndarray, "d"]] = {}  # `pair_key` of pseudonym and detection_index, ascending
        self._received: dict[int, Int[ndarray, "m"]] = {}  # `pair_key` of holder and evaluator, ascending

    def open(self, step: int, pseudonyms, observer_row, detection_index, score) -> None:
        """Begin a step; the arguments are those of `TrustModel.open_step`."""
        valid = (score >= 0) & (score <= 1) & (detection_index >= 0) & (detection_index < MAX_DETECTIONS)
        keys = pair_key(int64(pseudonyms)[observer_row[valid]], int64(detection_index)[valid])
        self._pseudonyms[step], self._detections[step] = int64(pseudonyms), np.unique(keys)
        self._received[step] = np.empty(0, np.int64)
        self.advance(step)

    def advance(self, now_step: int) -> None:
        """Close the steps that are older than `n_steps`."""
        assert now_step >= self.now, "steps come in the order of time"
        self.now = now_step
        for of_step in (self._pseudonyms, self._detections, self._received):
            for step in [s for s in of_step if s <= now_step - self.n_steps]:
                del of_step[step]

    def accepted(self, received: ReceivedEvaluations) -> ReceivedEvaluations | None:
        """The part that may count, None if the step is not open; the rest is counted in `rejected`."""
        t, step = received.messages, received.messages.step
        self.n_received += len(received)
        if step not in self._pseudonyms:
            self.rejected[RejectReason.FUTURE if step > self.now else RejectReason.LATE] += len(received)
            return None
        first = self._first_of(received)
        reason = self._reasons(t)
        n_copies = np.bincount(received.message_row[first], minlength=t.evaluator.size)
        copies = np.repeat(n_copies, np.diff(t.ptr))
        self.rejected += np.bincount(reason, copies, len(RejectReason)).astype(np.int64) * (
            np.arange(len(RejectReason)) != RejectReason.ACCEPTED
        )
        self.rejected[RejectReason.DUPLICATE] += len(received) - int(copies.sum())
        kept = reason == RejectReason.ACCEPTED
        sent_by = np.repeat(np.arange(t.evaluator.size), np.diff(t.ptr))[kept]
        ptr = np.searchsorted(sent_by, np.arange(t.evaluator.size + 1))
        messages = EvaluationMessages(
            step, t.evaluator, ptr, t.observer[kept], t.detection_index[kept], t.evaluation[kept], t.visibility[kept]
        )
        return ReceivedEvaluations(messages, received.holder[first], received.message_row[first], received.eta)

    def _first_of(self, received: ReceivedEvaluations) -> Int[ndarray, "k"]:
        """Receptions of messages that their holders do not have yet."""
        step = received.messages.step
        keys = pair_key(int64(received.holder), int64(received.messages.evaluator)[received.message_row])
        new, first = np.unique(keys, return_index=True)
        known = np.isin(new, self._received[step], assume_unique=True)
        self._received[step] = np.sort(np.concatenate([self._received[step], new[~known]]))
        return np.sort(first[~known])

    def _reasons(self, t: EvaluationMessages) -> Int[ndarray, "n"]:
        """`RejectReason` of each evaluation."""
        sent_by = np.repeat(np.arange(t.evaluator.size), np.diff(t.ptr))
        observer, index = int64(t.observer), int64(t.detection_index)
        present, transmitted = self._pseudonyms[t.step], self._detections[t.step]
        at, is_transmitted = _find(pair_key(observer, index), transmitted)
        is_transmitted &= (index >= 0) & (index < MAX_DETECTIONS) & (observer >= 0)
        is_present = is_transmitted.copy()
        others = np.flatnonzero(~is_transmitted)
        is_present[others] = _find(observer[others], present)[1]
        known = np.flatnonzero(is_transmitted)
        numbers = sent_by[known] * transmitted.size + at[known]
        order = np.argsort(numbers, kind="stable")  # in time proportional to their number where lists are by observer
        repeated = np.zeros(sent_by.size, bool)
        repeated[known[order[1:][numbers[order[1:]] == numbers[order[:-1]]]]] = True
        with np.errstate(invalid="ignore"):
            valid = (np.abs(t.evaluation) <= 1.0) & (t.visibility >= 0.0) & (t.visibility <= 1.0)
        return np.select(
            [
                ~_find(int64(t.evaluator), present)[1][sent_by],
                ~is_present,
                ~is_transmitted,
                ~valid,
                repeated,
            ],
            [
                RejectReason.UNKNOWN_EVALUATOR,
                RejectReason.UNKNOWN_OBSERVER,
                RejectReason.UNKNOWN_DETECTION,
                RejectReason.BAD_VALUE,
                RejectReason.DUPLICATE,
            ],
            RejectReason.ACCEPTED,
        )


def _find(values: Int[ndarray, "n"], ascending: Int[ndarray, "m"]) -> tuple[Int[ndarray, "n"], Bool[ndarray, "n"]]:
    """Position of each value, and whether it is there."""
    if not ascending.size:
        return np.zeros(values.shape, np.int64), np.zeros(values.shape, bool)
    at = np.minimum(np.searchsorted(ascending, values), ascending.size - 1)
    return at, ascending[at] == values
