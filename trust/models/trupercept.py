"""TruPercept: object trust and vehicle trust over an exact window of evidence."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import compiled
from trust.evaluator_counts import NEVER
from trust.evidence_store import EvidenceStore
from trust.open_steps import RejectReason
from trust.params import TruPerceptParams, open_window_steps
from trust.step_evidence import Counting
from trust.tables import ReceivedEvaluations, TrustScores


@compiled
def _accumulate(step, row_of_pair, evidence, n_evaluations, total, count, span):
    """Add a step to `_Sums`, given what `EvidenceStore.of_pairs` returns; steps come in the order of time."""
    for pair in range(row_of_pair.size):
        if evidence[pair, 1] > 0.0:
            row = row_of_pair[pair]
            if count[row, 0] == 0:
                span[row, 1] = step
            span[row, 0] = step
            total[row, 0] += evidence[pair, 0]
            total[row, 1] += evidence[pair, 1]
            count[row, 0] += 1
            if n_evaluations[pair] > 0:
                if count[row, 1] == 0:
                    span[row, 3] = step
                span[row, 2] = step
                count[row, 1] += n_evaluations[pair]


class _Sums:
    """Sums over steps, for each row of the store."""

    def __init__(self, n: int) -> None:
        self.total = np.zeros((n, 2))  # sum s T(theta), sum s
        self.count = np.zeros((n, 2), np.int64)  # steps with evidence, evaluations
        self.span = np.zeros((n, 4), np.int64)  # newest and oldest step with evidence, then those with evaluations

    def with_room(self, n: int) -> "_Sums":
        """A copy with n rows; the new ones are 0."""
        out, n_before = _Sums(n), len(self.total)
        out.total[:n_before] = self.total
        out.count[:n_before] = self.count
        out.span[:n_before] = self.span
        return out


class TruPercept:
    """Vehicle trust of [1]_ for any number of holders.

    One instance serves a central trust server (every message has the holder `SERVER`) or all vehicles, each the holder
    of its own scores. Holders, pseudonyms and steps are integers in [0, 2^31).

    Notes
    -----
    Equations 3 and 4 of [1]_: object trust T(theta) = sum Phi e / sum Phi over the evaluators other than the
    detector; vehicle trust = sum s T(theta) / sum s over its detections of the window, at least 0.

    Deviations: an unseen detection, 0/0 in the paper, counts as 0 with weight s (`unseen`); the window has
    f steps, not f + 1 (`window`). Of two contradicting evaluations of one detection by one evaluator the first
    to arrive counts. The model has no uncertainty.
    """

    Params: ClassVar[type] = TruPerceptParams

    def __init__(self, params: TruPerceptParams, dt_s: float, store: EvidenceStore | None = None) -> None:
        self.params = params
        self.window = open_window_steps(params, dt_s)
        self.now = -1
        self.n_rejected = np.zeros(len(RejectReason), np.int64)
        """Evaluations rejected so far, by `RejectReason`, without those that still wait in the store."""
        self.n_received = 0
        """Evaluations received so far, rejected ones included."""
        self.n_bad_detections = 0
        """Transmitted detections rejected so far: score outside [0, 1], or an index given twice."""
        self._folded = _Sums(0) if params.freshness_s == "off" else None
        """Sums over all steps that are no longer open; None if evidence expires."""
        self._folded_until = -1
        self.store = store or EvidenceStore(self._folded is None, params.least_score)
        self._counting = Counting(params.weighting == "score", params.unseen == "skip", params.least_score)
        self.store.readers.append(self)
        self._opened, self._n_added = -1, 0

    @classmethod
    def build_shared(cls, params: list[TruPerceptParams], dt_s: float) -> list["TruPercept"]:
        """Models with one store of evidence for each `least_score`.

        Models whose evidence never expires have other stores. They share one if they agree in weighting and unseen,
        too, and in the age at which they stop to accept evaluations. Each model has the scores and counters of a
        model of its own, bit for bit, provided that all of them are given the same `open_step` and the same
        `ReceivedEvaluations` objects before any of them is asked for `scores`.
        """
        stores: dict[tuple, EvidenceStore] = {}
        models = []
        for p in params:
            expires = p.freshness_s != "off"
            key = (p.least_score,) if expires else (p.least_score, p.weighting, p.unseen, p.grace_s)
            model = cls(p, dt_s, stores.get(key))
            stores[key] = model.store
            models.append(model)
        return models

    def open_step(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step: the pseudonyms present and the detections that were transmitted; old steps expire.

        Parameters
        ----------
        pseudonyms
            Ascending; those without detections included.
        observer_row
            Row in `pseudonyms` of each detection's observer.
        """
        assert step >= self.now and step > self._opened, "steps are opened once and in order"
        self.n_bad_detections += self.store.open(step, pseudonyms, observer_row, detection_index, score)
        self._opened = step
        self.expire(step)

    def expire(self, now_step: int) -> None:
        """Advance to a step: drop, or with `freshness_s = "off"` fold, the evidence that leaves the window."""
        self.store.settle(now_step - self.window)
        self.now = max(self.now, now_step)
        if self._folded is not None:
            self._fold(self._folded)
        self.store.expire()

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Add received evaluations, however late; those without effect are counted in `rejected`."""
        n, step = len(received), received.messages.step
        self.n_received += n
        is_open = self.store.add(self._n_added, received)
        self._n_added += 1
        if step > self.now:
            self.n_rejected[RejectReason.FUTURE] += n
        elif not is_open or step <= self.now - self.window:
            self.n_rejected[RejectReason.LATE] += n

    def scores(self, now_step: int | None = None) -> TrustScores:
        """Trust of every subject with evidence in the window, at step `now_step` (default: the newest one)."""
        self.store.settle()
        if now_step is not None:
            assert now_step >= self.now, "evidence that has expired cannot be restored"
            self.expire(now_step)
        store, n = self.store, len(self.store.pairs)
        sums = _Sums(n) if self._folded is None else self._folded.with_room(n)
        for step in sorted(store.steps):
            if step > self.now - self.window:
                evidence = store.of_pairs(step, self._counting)
                _accumulate(step, *evidence, sums.total, sums.count, sums.span)
        holder, subject, row = store.pairs.sorted()
        has_evidence = sums.count[row, 0] > 0
        holder, subject, row = (column[has_evidence] for column in (holder, subject, row))
        weight = sums.total[row, 1]
        n_evaluations = sums.count[row, 1]
        span = sums.span[row]
        before_window = self.now - self.window if self._folded is None else NEVER
        n_evaluators = store.evaluators.count(n, before_window)
        return TrustScores(
            step=self.now,
            holder=holder,
            subject=subject,
            trust=np.maximum(0.0, sums.total[row, 0] / weight),
            uncertainty=np.full(row.size, np.nan),
            weight=weight,
            n_evaluations=n_evaluations,
            newest_step=span[:, 0],
            oldest_step=span[:, 1],
            newest_evaluation_step=span[:, 2],
            oldest_evaluation_step=span[:, 3],
            is_evaluated=n_evaluations > 0,
            n_evaluators=n_evaluators[row],
        )

    @property
    def rejected(self) -> Int[ndarray, "reasons"]:
        """Evaluations rejected so far, by `RejectReason`."""
        self.store.settle()
        return self.n_rejected

    def _fold(self, folded: _Sums) -> None:
        """Add the steps that are no longer open to the running sums, in the order of time."""
        for step in sorted(self.store.steps):
            if self._folded_until < step <= self.now - self.window:
                self._folded = folded = folded.with_room(len(self.store.pairs))
                is_kept = folded.count[:, 0] > 0
                evidence = self.store.of_pairs(step, self._counting)
                _accumulate(step, *evidence, folded.total, folded.count, folded.span)
                self.store.keep((folded.count[:, 0] > 0) & ~is_kept)
        self._folded_until = max(self._folded_until, self.now - self.window)
