"""TruPercept: object trust and vehicle trust over an exact window of evidence."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from trust.evaluator_counts import NEVER, EvaluatorTable
from trust.evidence_store import EvidenceStore
from trust.kernel import compiled
from trust.params import TruPerceptParams, open_window_steps
from trust.step_evidence import RejectReason
from trust.tables import ReceivedEvaluations, TrustScores


@compiled
def _accumulate(step, pair_row, aggregated, n_evaluations, total, count, span):
    """Add a step to the sums of its pairs; steps come in the order of time."""
    for b in range(pair_row.size):
        if aggregated[b, 1] > 0.0:
            a = pair_row[b]
            if count[a, 0] == 0:
                span[a, 1] = step
            span[a, 0] = step
            total[a, 0] += aggregated[b, 0]
            total[a, 1] += aggregated[b, 1]
            count[a, 0] += 1
            if n_evaluations[b] > 0:
                if count[a, 1] == 0:
                    span[a, 3] = step
                span[a, 2] = step
                count[a, 1] += n_evaluations[b]


class _Sums:
    """Per row of the store: sum s T(theta) and sum s; steps and evaluations; newest and oldest step of each."""

    def __init__(self, n: int) -> None:
        self.total = np.zeros((n, 2))
        self.count = np.zeros((n, 2), np.int64)
        self.span = np.zeros((n, 4), np.int64)

    def with_room(self, n: int) -> "_Sums":
        """A copy of n rows."""
        out, m = _Sums(n), len(self.total)
        out.total[:m], out.count[:m], out.span[:m] = self.total, self.count, self.span
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
        self.rejected = np.zeros(len(RejectReason), np.int64)
        """Evaluations rejected so far, by `RejectReason`."""
        self.n_received = 0
        """Evaluations received so far, rejected ones included."""
        self.n_bad_detections = 0
        """Transmitted detections rejected so far: score outside [0, 1], or an index given twice."""
        self.store = store or EvidenceStore(params.weighting == "score", params.unseen == "skip")
        self.store.views.append(self)
        self._opened = -1
        self.folds = params.freshness_s == "off"
        self._folded = _Sums(0) if self.folds else None
        self._folded_evaluators = EvaluatorTable()
        self._folded_until = -1

    @classmethod
    def build_shared(cls, params: list[TruPerceptParams], dt_s: float) -> list["TruPercept"]:
        """Models with one store of evidence for each (weighting, unseen) among them.

        Each has the scores and counters of a model of its own, bit for bit, provided that all of them are given the
        same `open_step` and the same `ReceivedEvaluations` objects before any of them is asked for `scores`.
        """
        stores: dict[tuple[str, str], EvidenceStore] = {}
        models = []
        for p in params:
            model = cls(p, dt_s, stores.get((p.weighting, p.unseen)))
            stores[p.weighting, p.unseen] = model.store
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

    def before_open(self, step: int) -> None:
        """Fold what leaves the window with a step that is about to be opened."""
        if self._folded is not None:
            self._fold(step)

    def expire(self, now_step: int) -> None:
        """Advance to a step: drop, or with `freshness_s = "off"` fold, the evidence that leaves the window."""
        self.now = max(self.now, now_step)
        self.before_open(self.now)
        self.store.expire()

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Add received evaluations, however late; those without effect are counted in `rejected`."""
        n, step = len(received), received.messages.step
        self.n_received += n
        rejected = self.store.add(self, received)
        if step > self.now:
            self.rejected[RejectReason.FUTURE] += n
        elif rejected is None or step <= self.now - self.window:
            self.rejected[RejectReason.LATE] += n
        else:
            self.rejected += rejected

    def scores(self, now_step: int | None = None) -> TrustScores:
        """Trust of every subject with evidence in the window, at step `now_step` (default: the newest one)."""
        if now_step is not None:
            assert now_step >= self.now, "evidence that has expired cannot be restored"
            self.expire(now_step)
        store = self.store
        steps = [step for step in sorted(store.steps) if step > self.now - self.window]
        evidence = [store.aggregated(step) for step in steps]
        n = store.n_uses.size
        sums = _Sums(n) if self._folded is None else self._folded.with_room(n)
        for step, of_step in zip(steps, evidence, strict=True):
            _accumulate(
                step, of_step.pair_row[: of_step.n_assigned], of_step.aggregated, of_step.n_evaluations,
                sums.total, sums.count, sums.span,
            )  # fmt: skip
        has = sums.count[store.rows, 0] > 0
        keys, rows = store.keys[has], store.rows[has]
        weight, n_evaluations, span = sums.total[rows, 1], sums.count[rows, 1], sums.span[rows]
        trust = np.maximum(0.0, sums.total[rows, 0] / weight)
        n_evaluators = store.evaluators.count(n, self.now - self.window, self._folded_evaluators)
        if self._folded is not None:
            n_evaluators += self._folded_evaluators.count(n, NEVER)
        return TrustScores(
            self.now, keys >> 31, keys & (1 << 31) - 1, trust, np.full(keys.size, np.nan), weight, n_evaluations,
            span[:, 0], span[:, 1], span[:, 2], span[:, 3], n_evaluations > 0, n_evaluators[rows],
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Memory, the shared store included [B]."""
        f = self._folded
        own = 0 if f is None else f.total.nbytes + f.count.nbytes + f.span.nbytes
        return self.store.nbytes + own + self._folded_evaluators.nbytes

    def _fold(self, now: int) -> None:
        """Add the steps that are no longer open to the running sums, in the order of time."""
        assert self._folded is not None
        for step in [g for g in sorted(self.store.steps) if self._folded_until < g <= now - self.window]:
            evidence = self.store.aggregated(step)
            self._folded = sums = self._folded.with_room(self.store.n_uses.size)
            known = sums.count[:, 0] > 0
            _accumulate(
                step, evidence.pair_row[: evidence.n_assigned], evidence.aggregated, evidence.n_evaluations,
                sums.total, sums.count, sums.span,
            )  # fmt: skip
            self.store.keep((sums.count[:, 0] > 0) & ~known)
            self._folded_evaluators.note(*evidence.evaluators(), step)
        self._folded_until = max(self._folded_until, now - self.window)
