"""A trust model: the share of positive evidence about each vehicle."""

from dataclasses import dataclass

import numpy as np

from cosim.extend import PairIndex, TrustScores, with_rows


@dataclass(frozen=True, kw_only=True)
class Params:
    """Keys of the section [trust] that belong to this model."""

    prior: float = 1.0  # positive and negative evidence about every vehicle at the beginning


class MyTrust:
    Params = Params

    def __init__(self, params, dt_s):  # dt_s: seconds per step
        self.params, self.step = params, 0
        self.pairs = PairIndex()  # one row for each (holder, subject): the vehicle that trusts, and the trusted one
        self.sums = np.zeros((0, 3))  # per row: positive evidence, negative evidence, number of evaluations
        self.newest = np.zeros(0, int)  # per row: step of the newest evidence

    def open_step(self, step, pseudonyms, observer_row, detection_index, score):
        self.step = step  # a new step begins; the other arguments are the transmitted detections

    def add_evaluations(self, received):  # evaluations that holders received
        rows = received.rows()  # one row for each evaluation of rows.observer that rows.holder received
        at = self.pairs.rows(rows.holder, rows.observer)
        self.sums = with_rows(self.sums, len(self.pairs))
        self.newest = with_rows(self.newest, len(self.pairs))
        evidence = np.column_stack([rows.pos, rows.neg, np.ones(len(at))])
        np.add.at(self.sums, at, evidence)
        np.maximum.at(self.newest, at, received.messages.step)

    def scores(self, now_step=None):  # trust in [0, 1] for every (holder, subject) with evidence
        now_step = self.step if now_step is None else now_step
        holder, subject, at = self.pairs.sorted()
        positive, negative, n = self.sums[at].T
        prior = self.params.prior
        trust = (positive + prior) / (positive + negative + 2 * prior)
        return TrustScores.of(
            now_step, holder, subject, trust, newest_step=self.newest[at], n_evaluations=n.astype(int)
        )
