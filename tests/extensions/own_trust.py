"""A trust model of one's own: Beta reputation (Jøsang and Ismail 2002) without any decay."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import PairIndex, TrustScores, with_rows


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [trust] that belong to this model."""

    prior: float = 1.0
    """Evidence assumed for and against everyone before any has been seen."""


class Beta:
    """Expectation of a Beta distribution over positive and negative evidence."""

    Params = Params

    def __init__(self, params):
        self.params, self.step = params, 0
        self.pairs = PairIndex()
        self.sums = np.zeros((0, 3))  # positive, negative, number of evaluations
        self.newest = np.zeros(0, int)  # step of the newest evaluation

    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        self.step = step

    def add_evaluations(self, received):
        rows = received.rows()
        at = self.pairs.rows(rows.holder, rows.observer)
        self.sums, self.newest = with_rows(self.sums, len(self.pairs)), with_rows(self.newest, len(self.pairs))
        np.add.at(self.sums, at, np.column_stack([rows.pos, rows.neg, np.ones(len(at))]))
        np.maximum.at(self.newest, at, received.messages.step)

    def scores(self, now_step=None):
        holder, subject, at = self.pairs.sorted()
        r, s, n = self.sums[at].T
        total = r + s + 2 * self.params.prior
        return TrustScores.of(
            self.step,
            holder,
            subject,
            (r + self.params.prior) / total,
            newest_step=self.newest[at],
            n_evaluations=n,
            uncertainty=2 * self.params.prior / total,
            weight=r + s,
        )
