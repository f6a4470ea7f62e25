"""A trust model of one's own: Beta reputation (Jøsang and Ismail 2002) without any decay."""

from dataclasses import dataclass

import numpy as np

from trust.pair_index import PairIndex
from trust.tables import TrustScores


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [trust] that belong to this model."""

    prior: float = 1.0
    """Evidence assumed for and against everyone before any has been seen."""


class Beta:
    """Expectation of a Beta distribution over positive and negative evidence."""

    Params = Params

    def __init__(self, params, dt_s):
        self.params, self.step = params, 0
        self.pairs = PairIndex()
        self.sums = np.zeros((0, 3))  # positive, negative, number of evaluations

    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        self.step = step

    def add_evaluations(self, received):
        rows = received.rows()
        at = self.pairs.rows(rows.holder, rows.observer)
        self.sums = np.concatenate([self.sums, np.zeros((len(self.pairs) - len(self.sums), 3))])
        np.add.at(self.sums, at, np.column_stack([rows.pos, rows.neg, np.ones(len(at))]))

    def scores(self, now_step=None):
        holder, subject, at = self.pairs.sorted()
        r, s, n = self.sums[at].T
        total = r + s + 2 * self.params.prior
        step = np.full(len(n), self.step)
        return TrustScores(
            self.step, holder, subject, (r + self.params.prior) / total, 2 * self.params.prior / total, r + s,
            n.astype(int), step, step, step, step, n > 0,
        )  # fmt: skip
