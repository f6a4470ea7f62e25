"""Evaluator trust: whoever disagrees with the others about detections has less weight, and less trust."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Ge
from jaxtyping import Float
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows, exact, exact_sums
from trust.models.beta import expectation
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluatorTrustParams(StepwiseParams):
    """Parameters of the model `evaluator_trust`; the defaults are ours."""

    claim_weight: Annotated[float, Ge(0)] = 0.5
    """Vote of a detection's sender for it, in units of an evaluation with full visibility."""
    decay_per_s: PositiveShare = 0.98
    """Share of the evidence that is left after 1 s."""


def reliability(evidence: Float[ndarray, "p 4"]) -> Float[ndarray, "p"]:
    """Expected agreement of each evaluator with the others, (A + 1) / (A + D + 2); 1/2 without evidence.

    Parameters
    ----------
    evidence
        r, s, A and D of each pair: evidence for and against a sender, agreement and disagreement of an evaluator.
    """
    return expectation(evidence[:, 2:])


class EvaluatorTrust(Stepwise):
    """Reputation as sender and as evaluator, after the experience with advisers of Zhang and Cohen [12]_ and [5]_.

    An evaluation is compared with the verdict of everyone else on the same detection: its other evaluators, each with
    its own reliability, and its sender. Trust is the product of both reputations, so that neither makes up for the
    other.

    It should stop bad-mouthing, random evaluations and collusion, as long as honest evaluators of the same detections
    have more weight, and the senders of false content. It cannot stop a colluding majority at one place, Sybil vehicles
    that confirm each other where few honest ones look, or evaluators that are alone with what they say. It does not
    see removal, false speeds, or confirmations of true detections.

    Notes
    -----
    Before a step an evaluator v has the weight w_v = (A_v + 1) / (A_v + D_v + 2). The verdict that v is compared with
    is the sum over the others' w (pos - neg), plus `claim_weight` times w of the sender; A_v or D_v grows by pos + neg
    where the signs agree or differ, and by nothing where the verdict is 0. The sender's r and s grow by w_v pos and
    w_v neg. All decay. Trust is (r + 1) / (r + s + 2) times (A + 1) / (A + D + 1).

    Deviations: [12]_ compares an adviser with the buyer's own experience, and with the ratings of all others where
    there is too little of it; here all verdicts are of others (`self_first` has the own experience). [5]_ has no trust
    in evaluators apart from that in senders. Equations from memory of both papers.

    [12] Zhang, Cohen: Evaluating the trustworthiness of advice about seller agents in e-marketplaces: a personalized
    approach. Electronic Commerce Research and Applications, 2008.
    """

    Params: ClassVar[type] = EvaluatorTrustParams

    def start(self) -> Float[ndarray, "p 4"]:
        """r, s, A and D of each pair; no pairs yet."""
        return np.zeros((0, 4))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Both reputations after a step."""
        new = with_rows(state * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        weight = reliability(new)
        vote = self.weight(weight, rows)
        pos, neg, row = rows.object_pos, rows.object_neg, rows.row
        signed = exact(vote[row] * (pos - neg))
        claim = exact(self.params.claim_weight * weight)[rows.sender]
        others = (rows.per_object(signed) + claim)[rows.object] - signed
        agrees = (others > 0) == (pos > neg)
        judged = np.where(others != 0, pos + neg, 0.0)
        added = [
            rows.per_observer(vote * rows.pos, len(new)),
            rows.per_observer(vote * rows.neg, len(new)),
            exact_sums(rows.by, np.where(agrees, judged, 0.0), len(new)),
            exact_sums(rows.by, np.where(agrees, 0.0, judged), len(new)),
        ]
        return new + np.stack(added, axis=1)

    def weight(self, weight: Float[ndarray, "p"], rows: StepRows) -> Float[ndarray, "n"]:
        """How much the evaluations of each row count.

        Parameters
        ----------
        weight
            Reliability of each pair before the step.
        rows
            Evidence of the step.
        """
        return weight[rows.evaluator]

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Product of both reputations."""
        per_s = self.params.decay_per_s
        now_left = state * self.decay(per_s, n_steps)
        agreed, differed = now_left[:, 2], now_left[:, 3]
        as_sender = now_left[:, :2]
        trust = expectation(as_sender) * (agreed + 1) / (agreed + differed + 1)
        weight = as_sender.sum(axis=1)
        return Reading(trust, weight, 2 / (weight + 2), self.horizon_s(per_s))
