"""Beta reputation: positive and negative evidence that decays exponentially."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.base.bounds import PositiveShare
from trust.evaluation_log import StepRows
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class BetaParams(StepwiseParams):
    """Parameters of the model `beta`."""

    decay_per_s: PositiveShare = 0.98
    """lambda: share of the evidence that is left after 1 s; the default is ours."""


def expectation(evidence: Float[ndarray, "p 2"]) -> Float[ndarray, "p"]:
    """Expectation of the Beta distribution, (r + 1) / (r + s + 2).

    Parameters
    ----------
    evidence
        r and s, the sums of positive and of negative evidence.

    Returns
    -------
    Expectation in (0, 1); 1/2 without evidence.
    """
    return (evidence[:, 0] + 1) / (evidence.sum(axis=1) + 2)


def read_beta(evidence: Float[ndarray, "p 2"], horizon_s: float) -> Reading:
    """Expectation, uncertainty and weight of positive and negative evidence.

    Parameters
    ----------
    evidence
        r and s of each pair, decayed to the present.
    horizon_s
        As `Reading.horizon_s`.
    """
    weight = evidence.sum(axis=1)
    return Reading(expectation(evidence), weight, 2 / (weight + 2), horizon_s)


class Beta(Stepwise):
    """Beta reputation system of [2]_.

    Notes
    -----
    r = sum of lambda^age pos and s = sum of lambda^age neg over the evaluations of a subject by others, age in seconds
    since the step of the detection; expectation (r + 1) / (r + s + 2), uncertainty 2 / (r + s + 2), weight r + s.
    pos and neg are those of `ReceivedEvaluations.rows`. A subject has no row once less than 2^-40 of its
    newest evidence is left.

    Deviations: evidence has the age of its detection, not of its arrival, so that a late message and a timely one
    come to the same; the feedback is a graded evaluation.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    """

    Params: ClassVar[type] = BetaParams

    def start(self) -> Float[ndarray, "p 2"]:
        """r and s of each pair; no pairs yet."""
        return np.zeros((0, 2))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """r and s of each pair after a step."""
        new = with_rows(state * self.decay(self.params.decay_per_s, n_steps), n_pairs)
        weight = self.weight(new, rows)
        new[:, 0] += rows.per_observer(weight * rows.pos, len(new))
        new[:, 1] += rows.per_observer(weight * rows.neg, len(new))
        return new

    def weight(self, state: ndarray, rows: StepRows) -> Float[ndarray, "n"] | float:
        """How much the evidence of each row counts.

        Parameters
        ----------
        state
            r and s of each pair before the step, decayed to the step.
        rows
            Evidence of the step.

        Returns
        -------
        Factor of pos and neg, for each row or for all.
        """
        return 1.0

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Expectation of the Beta distribution."""
        per_s = self.params.decay_per_s
        return read_beta(state * self.decay(per_s, n_steps), self.horizon_s(per_s))
