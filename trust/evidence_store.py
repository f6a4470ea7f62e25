"""Evidence of the recent steps, shared by trust models that differ in what counts of it and for how long.

`trust.models.trupercept` reads it. Received evaluations wait in the store, one `StepEvidence` per step sums them, and
the models add up the steps of their windows.
"""

from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from trust.evaluator_counts import NEVER, EvaluatorTable
from trust.open_steps import LARGE, OpenStep
from trust.pair_index import PairIndex, with_rows
from trust.step_evidence import Counting, StepEvidence
from trust.tables import ReceivedEvaluations, unpaired


class StoreReader(Protocol):
    """What the store must know of a model that reads it."""

    now: int
    """Newest step that the model has opened."""
    window: int
    """Steps, the present one included, whose evidence may still change in the model."""
    n_rejected: Int[ndarray, "reasons"]
    """Evaluations rejected so far, by `RejectReason`: the store adds those of the window."""


class EvidenceStore:
    """Evidence by step, and a row for each (holder, subject) that any of the steps concerns.

    Every model that reads the store passes each of its calls on to the store, and the store acts on the first of these
    equal calls. All models must have received the same evaluations before any of them computes scores.

    Evaluations wait until `settle`. Many small batches of one step are then checked and added as one.

    Parameters
    ----------
    expires
        Whether evaluators are forgotten when their evaluations leave the windows. False if a model keeps evidence for
        good.
    least_score
        Evaluators of detections with a lower score do not count: `Counting.least_score` of all models.
    """

    def __init__(self, expires: bool = True, least_score: float = 0.0) -> None:
        self.steps: dict[int, StepEvidence] = {}
        self.readers: list[StoreReader] = []
        self.pairs = PairIndex()
        self.evaluators = EvaluatorTable()
        self._expires, self._least_score = expires, least_score
        self._n_uses = np.zeros(0, np.int64)  # of each row: steps that use it, and models that keep it
        self._opened, self._n_bad_detections = -1, 0  # newest step, and detections of it that were rejected
        self._n_added = 0  # calls of `add` that had an effect
        self._waiting: dict[int, list[ReceivedEvaluations]] = {}  # by step

    def open(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> int:
        """Open a step, unless another model has opened it already.

        Parameters
        ----------
        step, pseudonyms, observer_row, detection_index, score
            As for `TrustModel.open_step`.

        Returns
        -------
        Number of detections of the step that were rejected.
        """
        if step > self._opened:
            sent = OpenStep(pseudonyms, observer_row, detection_index, score)
            self.steps[step] = StepEvidence(sent)
            self._opened, self._n_bad_detections = step, sent.n_bad_detections
        return self._n_bad_detections

    def add(self, number: int, received: ReceivedEvaluations) -> bool:
        """Add received evaluations, unless another model has added them already.

        Parameters
        ----------
        number
            How many additions this model has made before.
        received
            Evaluations of one step.

        Returns
        -------
        Whether the step is in the store.
        """
        step = received.messages.step
        if number == self._n_added:
            self._n_added += 1
            if step in self.steps:
                self._waiting.setdefault(step, []).append(received)
                if received.messages.observer.size >= LARGE:
                    self._settle(step)
        return step in self.steps

    def settle(self, until: float = np.inf) -> None:
        """Add the evaluations of steps up to `until` that wait.

        Models call it before they read the store, and before a step leaves their window.
        """
        for step in [step for step in self._waiting if step <= until]:
            self._settle(step)

    def _settle(self, step: int) -> None:
        """Check and add the evaluations of a step that wait, and count the rejected ones for the models."""
        for received in ReceivedEvaluations.joined(self._waiting.pop(step)):
            n_rejected = self._add(self.steps[step], received)
            for reader in self.readers:
                if step > reader.now - reader.window:
                    reader.n_rejected += n_rejected

    def _add(self, evidence: StepEvidence, received: ReceivedEvaluations) -> Int[ndarray, "reasons"]:
        """Check and add evaluations of a step; returns how many were rejected, by `RejectReason`."""
        accepted = evidence.sent.accept(received)
        pairs, evaluators = evidence.add(received.messages, accepted, self._least_score)
        if evidence.row.size < evidence.pairs.size:  # there are new pairs
            self._use(evidence.row, -1)
            evidence.row = self.pairs.rows(*unpaired(evidence.pairs))
            self._use(evidence.row, 1)
        rows = evidence.row[np.searchsorted(evidence.pairs, pairs)]
        self.evaluators.note(rows, evaluators, received.messages.step)
        return accepted.n_rejected

    def of_pairs(
        self, step: int, counting: Counting
    ) -> tuple[Int[ndarray, "p"], Float[ndarray, "p 2"], Int[ndarray, "p"]]:
        """Evidence of a step about each (holder, subject).

        Returns
        -------
        Row of each pair in the store, and what `StepEvidence.of_pairs` returns: sum s T(theta) and sum s, and
        evaluations.
        """
        evidence = self.steps[step]
        return evidence.row, *evidence.of_pairs(counting)

    def expire(self) -> None:
        """Drop the steps that have left the windows of all models, and the pairs that no step uses any more."""
        horizon = min(reader.now - reader.window for reader in self.readers)
        old = [step for step in self.steps if step <= horizon]
        for step in old:
            self._use(self.steps.pop(step).row, -1)
        if old:
            if not self._expires:
                self.settle()  # else a pair that only waiting evaluations use would lose its evaluators
            unused = self._n_uses[: len(self.pairs)] == 0
            self.evaluators.forget(horizon if self._expires else NEVER, unused)
            self.pairs.drop(unused)

    def keep(self, chosen: Bool[ndarray, "rows"]) -> None:
        """Keep the pairs of some rows for good, even when no step uses them any more.

        Parameters
        ----------
        chosen
            Rows to keep, as a mask.
        """
        self._use(np.flatnonzero(chosen), 1)

    def _use(self, rows: Int[ndarray, "p"], change: int) -> None:
        """Count one use more (`change` = 1) or less (-1) of each row."""
        self._n_uses = with_rows(self._n_uses, len(self.pairs))
        self._n_uses[rows] += change
