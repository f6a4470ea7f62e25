"""Evidence of the recent steps, shared by the models that differ only in how long they use it."""

from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from trust.evaluator_counts import EvaluatorTable
from trust.step_evidence import RejectReason, StepEvidence, open_step_evidence
from trust.tables import ReceivedEvaluations, int64, pair_key

_RECENT = 3
"""Steps after which nearly all evaluations of a step have arrived."""


class View(Protocol):
    """What a store has to know of a model that reads it."""

    now: int
    """Newest step that the model knows of."""
    window: int
    """Steps, the present one included, whose evidence may still change in the model."""
    folds: bool
    """Whether it reads a step's evaluators once more when the step leaves its window."""

    def before_open(self, step: int) -> None:
        """The step is about to be opened."""
        ...


class _Addition:
    """One `ReceivedEvaluations` as it was added, until every view has been given it."""

    def __init__(self, received: ReceivedEvaluations, rejected: Int[ndarray, "reasons"] | None) -> None:
        self.received = received
        self.rejected = rejected
        self.taken_by: list[View] = []


class EvidenceStore:
    """Evidence by step, and one row per (holder, subject) that any of the steps concerns.

    Every view is given every open_step and every `ReceivedEvaluations` object; each is stored once. What one view has
    been given, all must have been given before any of them is asked for scores.
    """

    def __init__(self, by_score: bool, skip_unseen: bool) -> None:
        self.steps: dict[int, StepEvidence] = {}
        self.views: list[View] = []
        self.keys: Int[ndarray, "p"] = np.empty(0, np.int64)  # `pair_key`, ascending
        self.rows: Int[ndarray, "p"] = np.empty(0, np.int64)  # row of each key
        self.n_uses = np.zeros(16, np.int64)  # of each row: steps that use it, and views that keep it
        self.evaluators = EvaluatorTable()
        self._by_score, self._skip_unseen = by_score, skip_unseen
        self._opened, self._n_bad = -1, 0
        self._additions: list[_Addition] = []

    def open(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> int:
        """Open a step, once; returns the number of detections rejected."""
        if step > self._opened:
            for view in self.views:
                view.before_open(step)
            self.steps[step], self._n_bad = open_step_evidence(pseudonyms, observer_row, detection_index, score)
            self._opened = step
            if older := self.steps.get(step - _RECENT):
                older.trim(keep_noted=any(view.folds for view in self.views))
            age = _RECENT
            while age <= step - next(iter(self.steps)):  # again and again, since late evaluations unpack a step
                if older := self.steps.get(step - age):
                    older.pack()
                age *= 2
        return self._n_bad

    def add(self, view: View, received: ReceivedEvaluations) -> Int[ndarray, "reasons"] | None:
        """Add evaluations, once for all views; returns the rejected by reason, or None where the step is not stored."""
        for addition in self._additions:
            if addition.received is received and not any(v is view for v in addition.taken_by):
                break
        else:
            addition = _Addition(received, self._add(received))
            self._additions.append(addition)
        addition.taken_by.append(view)
        if len(addition.taken_by) == len(self.views):
            self._additions = [a for a in self._additions if a is not addition]
        return addition.rejected

    def _add(self, received: ReceivedEvaluations) -> Int[ndarray, "reasons"] | None:
        evidence = self.steps.get(received.messages.step)
        if evidence is None:
            return None
        rejected = np.zeros(len(RejectReason), np.int64)
        evidence.add(received.messages, int64(received.holder), int64(received.message_row), rejected)
        return rejected

    def expire(self) -> None:
        """Drop the steps that have left the windows of all views."""
        horizon = self._horizon()
        old = [step for step in self.steps if step <= horizon]
        for step in old:
            evidence = self.steps.pop(step)
            self.n_uses[evidence.pair_row[: evidence.n_assigned]] -= 1
        if old:
            in_use = self.n_uses[self.rows] > 0
            self.keys, self.rows = self.keys[in_use], self.rows[in_use]

    def _horizon(self) -> int:
        """Newest step that has left the windows of all views."""
        return min(view.now - view.window for view in self.views)

    def aggregated(self, step: int) -> StepEvidence:
        """The step's evidence with its sums up to date and a row for each of its pairs."""
        evidence = self.steps[step]
        if evidence.is_current:
            return evidence
        evidence.aggregate(self._by_score, self._skip_unseen)
        self._assign(evidence)
        rows, evaluators = evidence.evaluators(evidence.n_noted)
        self.evaluators.note(rows, evaluators, step, self._horizon())
        evidence.n_noted = int(evidence.n_used[3])
        evidence.is_current = True
        return evidence

    def keep(self, chosen: Bool[ndarray, "rows"]) -> None:
        """Keep rows beyond the steps that use them."""
        self.n_uses[: chosen.size] += chosen

    def _assign(self, evidence: StepEvidence) -> None:
        """Give the step's new blocks their rows."""
        n = int(evidence.n_used[0])
        if n == evidence.n_assigned:
            return
        new = evidence.blocks[evidence.n_assigned : n]
        keys = pair_key(new[:, 0], evidence.pseudonyms[new[:, 1]])
        at = np.searchsorted(self.keys, keys)
        there = at < self.keys.size
        there[there] = self.keys[at[there]] == keys[there]
        unknown = np.sort(keys[~there])
        if unknown.size:
            free = np.flatnonzero(self.n_uses == 0)
            if free.size < unknown.size:
                size = max(2 * self.n_uses.size, self.n_uses.size + unknown.size)
                self.n_uses = np.concatenate([self.n_uses, np.zeros(size - self.n_uses.size, np.int64)])
                free = np.flatnonzero(self.n_uses == 0)
            at = np.searchsorted(self.keys, unknown)
            self.keys = np.insert(self.keys, at, unknown)
            self.rows = np.insert(self.rows, at, free[: unknown.size])
        rows = self.rows[np.searchsorted(self.keys, keys)]
        evidence.pair_row[evidence.n_assigned : n] = rows
        self.n_uses[rows] += 1
        evidence.n_assigned = n

    @property
    def nbytes(self) -> int:
        """Memory [B]."""
        own = self.keys.nbytes + self.rows.nbytes + self.n_uses.nbytes
        return own + self.evaluators.nbytes + sum(evidence.nbytes for evidence in self.steps.values())
