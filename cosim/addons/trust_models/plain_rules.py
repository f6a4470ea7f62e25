"""Two rules of one line, beside which a trust model has to show that it is worth its effort."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from trust.claims import DETECTION
from trust.evaluation_log import StepRows, exact
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import PairIndex, with_rows
from trust.params import KINDS, Kind


@dataclass(frozen=True, kw_only=True, slots=True)
class DeniedShareParams(StepwiseParams):
    """Parameters of the rule `denied_share`: none of its own."""


@dataclass(frozen=True, kw_only=True, slots=True)
class MeanScoreParams(StepwiseParams):
    """Parameters of the rule `mean_score`."""

    evidence: tuple[Kind, ...] = ("detections",)
    """Kinds of evaluations that are made; the same as `trust.evidence`."""


class DeniedShare(Stepwise):
    """Share of a vehicle's evaluated detections that an evaluator confirms, or that none denies.

    Notes
    -----
    Trust is 1 - d / n: of n detections of the vehicle that others could see, d are denied by some (neg > 0) and
    confirmed by none (pos = 0). Evidence never ages. Weight: n. A vehicle without such a detection has 1/2.

    Deviations: none. The rule has no source; it follows from what evaluations mean.
    """

    Params: ClassVar[type] = DeniedShareParams

    def start(self) -> Float[ndarray, "p 2"]:
        """Detections of each pair that were evaluated, and those that were denied only; no pairs yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """The counts after a step."""
        new = with_rows(state, n_pairs).copy()
        confirmed = rows.per_object(rows.object_pos) > 0
        denied = rows.per_object(rows.object_neg) > 0
        for column, counts in enumerate((confirmed | denied, denied & ~confirmed)):
            new[:, column] += np.bincount(rows.sender[counts], minlength=len(new))
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """1 - denied / evaluated."""
        n, denied = state.T
        share = denied / np.maximum(n, 1)
        return Reading(np.where(n > 0, 1 - share, 0.5), n)


class MeanScore(Stepwise):
    """Mean score that a vehicle gives to its own detections. It uses no evaluation.

    Notes
    -----
    Trust is the mean of the scores of all detections that the vehicle has sent. A vehicle is known once anybody has
    evaluated it, as in all models. Weight: the number of its detections. What else a message claims has no score.

    Deviations: none. The rule has no source; it shows what lies betray by their scores alone.
    """

    Params: ClassVar[type] = MeanScoreParams

    def __init__(self, params: Any, dt_s: float) -> None:
        super().__init__(params, dt_s)
        self._senders, self._sums = PairIndex(), np.zeros((0, 2))

    def open_step(
        self,
        step: int,
        pseudonyms: Int[ndarray, "n"],
        observer_row: Int[ndarray, "d"],
        detection_index: Int[ndarray, "d"],
        score: Float[ndarray, "d"],
    ) -> None:
        """Begin a step; see `TrustModel.open_step`."""
        super().open_step(step, pseudonyms, observer_row, detection_index, score)
        if len(self.params.evidence) > 1:
            is_detection = detection_index % len(KINDS) == DETECTION
            observer_row, score = observer_row[is_detection], score[is_detection]
        sender = pseudonyms[observer_row]
        row = self._senders.rows(np.zeros_like(sender), sender)
        self._sums = with_rows(self._sums, len(self._senders))
        added = np.column_stack([exact(score), np.ones(len(row))])
        np.add.at(self._sums, row, added)

    def start(self) -> Float[ndarray, "0"]:
        """No state: scores come with the detections, not with evaluations."""
        return np.zeros(0)

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """The unchanged state."""
        return state

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Sum of scores over their number."""
        _, subject, row = self.log.pairs.sorted()
        at, known = self._senders.find(np.zeros_like(subject), subject)
        total, count = self._sums[at[known]].T
        row = row[known]
        trust = np.full(len(self.log.pairs), 0.5)
        trust[row] = total / count
        n = np.zeros(len(trust))
        n[row] = count
        return Reading(trust, n)
