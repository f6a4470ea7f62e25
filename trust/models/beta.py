"""Beta reputation: positive and negative evidence that decays exponentially."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Gt, Interval, Le
from jaxtyping import Float, Int
from numpy import ndarray

from trust.open_steps import OpenSteps
from trust.pair_index import PairIndex, with_rows
from trust.params import grace_steps
from trust.tables import ReceivedEvaluations, TrustScores, pair_key

_NEGLIGIBLE = 2.0**-40
_CLEAN_EVERY_STEPS = 64


@dataclass(frozen=True, kw_only=True, slots=True)
class BetaParams:
    """Parameters of the model `beta`."""

    decay_per_s: Annotated[float, Interval(gt=0, le=1)] = 0.98
    """lambda: share of the evidence that is left after 1 s; the default is ours."""
    grace_s: Annotated[float, Gt(0), Le(1e8)] = 10.0
    """Age at which evidence is folded into running sums [s]: evaluations that arrive later have no effect."""


class Beta:
    """Beta reputation system of [2]_.

    Notes
    -----
    r = sum of lambda^age pos and s = sum of lambda^age neg over the evaluations of a subject by others, age in seconds
    since the step of the detection; expectation (r + 1) / (r + s + 2), uncertainty 2 / (r + s + 2), weight r + s.
    pos and neg are those of `ReceivedEvaluations.rows`. Pairs whose weight has decayed below 2^-40 are dropped.

    Deviations: evidence has the age of its detection, not of its arrival, so that a late message and a timely one
    come to the same; the feedback is a graded evaluation.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    """

    Params: ClassVar[type] = BetaParams

    def __init__(self, params: BetaParams, dt_s: float) -> None:
        self.params, self.dt_s = params, dt_s
        self.steps = OpenSteps(grace_steps(params.grace_s, dt_s))
        # of each open step: `pair_key` ascending; pos, neg and number of evaluations of each pair
        self._open: dict[int, tuple[Int[ndarray, "k"], Float[ndarray, "k 3"]]] = {}
        self._pairs = PairIndex()
        self._evidence = np.zeros((0, 2))  # r and s of each pair at the step `_folded`
        self._n = np.zeros(0, np.int64)  # evaluations
        self._span = np.zeros((0, 2), np.int64)  # newest and oldest step
        self._folded = -1

    def open_step(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step; see `TrustModel`."""
        self.steps.open(step, pseudonyms, observer_row, detection_index, score)
        self._open[step] = np.empty(0, np.int64), np.zeros((0, 3))
        self._fold()

    def add_evaluations(self, received: ReceivedEvaluations) -> None:
        """Add received evaluations; see `TrustModel`."""
        accepted = self.steps.accepted(received)
        if accepted is None:
            return
        rows = accepted.by_observer()
        keys, sums = self._open[received.messages.step]
        merged, at = np.unique(np.concatenate([keys, pair_key(rows.holder, rows.observer)]), return_inverse=True)
        values = np.concatenate([sums, np.column_stack([rows.pos, rows.neg, rows.n])])
        totals = [np.bincount(at, column, merged.size) for column in values.T]
        self._open[received.messages.step] = merged, np.column_stack(totals)

    def scores(self, now_step: int | None = None) -> TrustScores:
        """Trust of every subject with evidence; see `TrustModel`."""
        now = self.steps.now if now_step is None else now_step
        self.steps.advance(now)
        self._fold()
        evidence, n, span = self._evidence, self._n, self._span
        evidence = evidence * self._decay(now - self._folded)
        n, span = n.copy(), span.copy()
        for step in sorted(self._open):
            evidence, n, span = self._added(step, now, evidence, n, span)
        holder, subject, row = self._pairs.sorted()
        r, s = evidence[row].T
        newest, oldest = span[row].T
        return TrustScores(
            now, holder, subject, (r + 1) / (r + s + 2), 2 / (r + s + 2), r + s, n[row],
            newest, oldest, newest.copy(), oldest.copy(), n[row] > 0,
        )  # fmt: skip

    @property
    def rejected(self) -> Int[ndarray, "reasons"]:
        """Evaluations rejected so far, by `RejectReason`."""
        return self.steps.rejected

    def _decay(self, n_steps: int) -> float:
        return self.params.decay_per_s ** (n_steps * self.dt_s)

    def _added(self, step: int, now: int, evidence: ndarray, n: ndarray, span: ndarray):
        """The columns at step `now` with those of an open step added."""
        keys, sums = self._open[step]
        rows = self._pairs.rows(keys >> 31, keys & (1 << 31) - 1)
        evidence, n, span = (with_rows(column, len(self._pairs)) for column in (evidence, n, span))
        evidence[rows] += self._decay(now - step) * sums[:, :2]
        span[rows, 1] = np.where(n[rows] == 0, step, span[rows, 1])
        span[rows, 0] = step
        n[rows] += sums[:, 2].astype(np.int64)
        return evidence, n, span

    def _fold(self) -> None:
        """Add the steps that are no longer open to the running sums, in the order of time."""
        for step in sorted(s for s in self._open if s <= self.steps.now - self.steps.n_steps):
            self._evidence = self._evidence * self._decay(step - self._folded)
            self._folded = step
            self._evidence, self._n, self._span = self._added(step, step, self._evidence, self._n, self._span)
            del self._open[step]
            if step % _CLEAN_EVERY_STEPS == 0:
                self._drop_negligible()

    def _drop_negligible(self) -> None:
        in_use = np.zeros(len(self._pairs), bool)
        for keys, _ in self._open.values():
            rows, found = self._pairs.find(keys >> 31, keys & (1 << 31) - 1)
            in_use[rows[found]] = True
        n = len(self._pairs)
        self._evidence, self._n, self._span = (with_rows(c, n) for c in (self._evidence, self._n, self._span))
        kept = self._pairs.drop((self._evidence[:n].sum(axis=1) < _NEGLIGIBLE) & ~in_use)
        self._evidence, self._n, self._span = self._evidence[kept], self._n[kept], self._span[kept]
