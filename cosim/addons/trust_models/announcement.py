"""Reputation-based announcement: ratings that age, averaged per rater, then over raters."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Int
from numpy import ndarray

from trust.evaluation_log import StepRows, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows

_UNIT = float(1 << 20)  # of a rating


@dataclass(frozen=True, kw_only=True, slots=True)
class AnnouncementParams(StepwiseParams):
    """Parameters of the model `announcement`; all defaults are ours."""

    validity_s: Annotated[float, Interval(ge=0.001, le=1e8)] = 600.0
    """Psi: age at which a rating counts nothing any more [s]."""


@dataclass(frozen=True, slots=True)
class Ratings:
    """Ratings within the validity, and sums of them; integers, so that what expires is taken off exactly."""

    sums: Int[ndarray, "edges 4"]  # per (rater, subject): number, sum of steps, of ratings, of rating x step
    newest: Int[ndarray, "pairs"]  # step of the newest rating of each subject
    history: tuple[tuple[int, ndarray, ndarray, ndarray], ...] = ()  # step, edges, ratings, evaluations behind each
    has_expired: bool = False  # whether any rating has

    def added(self, sign: int, step: int, edge: ndarray, rating: ndarray) -> None:
        """Add the ratings of a step to the sums, or subtract them, in place.

        Parameters
        ----------
        sign
            1 adds, -1 subtracts.
        step
            Step of the ratings.
        edge
            Row of (rater, subject) in `EvaluationLog.edges`, for each rating.
        rating
            Ratings in units of 2^-20.
        """
        terms = np.ones_like(rating), np.full_like(rating, step), rating, rating * step
        for column, term in zip(self.sums.T, terms, strict=True):
            np.add.at(column, edge, sign * term)

    def counted(self, subject: Int[ndarray, "edges"], n_pairs: int) -> Int[ndarray, "n_pairs 3"]:
        """Evaluations behind the ratings of each subject, newest and oldest step of them.

        Parameters
        ----------
        subject
            Row of each edge's subject.
        """
        none = np.zeros(0, np.int64)
        parts = [(none, none, none)]
        for step, edge, _, n in self.history:
            parts.append((np.full(len(edge), step), subject[edge], n))
        steps, of, made = (np.concatenate(column) for column in zip(*parts, strict=True))
        counted = np.zeros((n_pairs, 3), np.int64)
        np.add.at(counted[:, 0], of, made)
        counted[of, 1] = steps  # of several values the last one stays
        counted[of[::-1], 2] = steps[::-1]
        return counted


class Announcement(Stepwise):
    """Reputation of the announcement scheme of Li et al. [6]_.

    Notes
    -----
    A rating is pos / (pos + neg) of one evaluator's evaluations of a subject in one step. Per rater the mean of its
    ratings with weight 1 - age / Psi, 0 beyond Psi; then the mean over raters; then times 1 - age / Psi of the newest
    rating, as the certificate that states it ages. Weight: number of raters.

    Deviations: equations from memory of the paper; a rating is graded; a certificate is issued with each rating. The
    trust of a vehicle that nobody has rated, in the paper a start value, is `trust.default_trust` (0.7 is ours).

    [6] Li, Malip, Martin, Ng, Zhang: A Reputation-Based Announcement Scheme for VANETs. IEEE Transactions on
    Vehicular Technology, 2012.
    """

    Params: ClassVar[type] = AnnouncementParams

    def start(self) -> Ratings:
        """No ratings."""
        return Ratings(np.zeros((0, 4), np.int64), np.zeros(0, np.int64))

    def advance(self, state: Ratings, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Ratings:
        """Ratings with those of a step, and without those that have expired."""
        new = self._valid(state, step, len(self.log.edges))
        total = rows.pos + rows.neg
        rated = np.flatnonzero(total > 0)
        share = rows.pos[rated] / total[rated]
        rating = np.rint(share * _UNIT).astype(np.int64)
        edge = rows.edge[rated]
        new.added(1, step, edge, rating)
        newest = with_rows(state.newest, n_pairs).copy()
        newest[rows.observer[rated]] = step
        history = (*new.history, (step, edge, rating, rows.n[rated]))
        return Ratings(new.sums, newest, history, new.has_expired)

    def read(self, state: Ratings, n_steps: int, now: int) -> Reading:
        """Mean over the raters of each one's mean rating, reduced by the age of the newest rating."""
        validity = self.params.validity_s / self.dt_s
        valid = self._valid(state, now, len(self.log.edges))
        n, steps, ratings, rated_steps = valid.sums.T
        weight = n - (now * n - steps) / validity
        value = (ratings - (now * ratings - rated_steps) / validity) / _UNIT
        _, subject, row = self.log.edges.sorted()
        weight, value = weight[row], value[row]
        has = n[row] > 0
        size = len(self.log.pairs)
        counted = valid.counted(subject[np.argsort(row)], size) if valid.has_expired else None
        raters = np.bincount(subject[has], minlength=size)
        total = exact_sums(subject[has], value[has] / weight[has], size)
        mean = np.clip(total / np.maximum(raters, 1), 0, 1)
        newest = with_rows(state.newest, size)[:size]
        age = np.clip(1 - (now - newest) / validity, 0, 1)
        return Reading(mean * age, raters.astype(float), None, self.params.validity_s, counted)

    def _valid(self, state: Ratings, now: int, n_edges: int) -> Ratings:
        """A copy without what has expired."""
        new = Ratings(with_rows(state.sums, n_edges).copy(), state.newest)
        n_old = 0
        for step, edge, rating, _ in state.history:
            if self.is_younger(now - step, self.params.validity_s):
                break
            new.added(-1, step, edge, rating)
            n_old += 1
        has_expired = state.has_expired or n_old > 0
        return Ratings(new.sums, state.newest, state.history[n_old:], has_expired)
