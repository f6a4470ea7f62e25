"""Beta reputation in which what one evaluator says again counts less."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy import ndarray

from cosim.addons.trust_models.median_groups import MedianGroups
from cosim.base.bounds import PositiveShare, Share
from trust.evaluation_log import exact_sums
from trust.models.beta import read_beta
from trust.models.stepwise import Reading, StepwiseParams


@dataclass(frozen=True, kw_only=True, slots=True)
class BetaCorrelatedParams(StepwiseParams):
    """Parameters of the model `beta_correlated`; the defaults are ours."""

    correlation: Share = 0.05
    """k: correlation of two evaluations that one evaluator makes of one sender. With 0 the model is `beta`; with 1 an
    evaluator counts as one evaluation, however often it speaks. `evidence.repeats.agreement.kappa` measures it (group
    same evaluator): 0.02 to 0.05 in Helsinki."""
    decay_per_s: PositiveShare = 0.98
    """lambda: share of the evidence that is left after 1 s."""


class BetaCorrelated(MedianGroups):
    """Beta reputation [2]_ over the effective number of evaluations [17]_.

    The evaluations that one vehicle makes of another share a line of sight, a detector and a position error. m of them
    with correlation k are worth m / (1 + (m - 1) k) independent ones, and never more than 1 / k.

    It should stop bad-mouthing and praise by the repetition of few evaluators. It cannot stop those of many
    (Sybil vehicles, colluders), because a model knows pseudonyms only.

    Notes
    -----
    r_vi and s_vi are the decayed sums of pos and neg of evaluator v about sender i, m_vi = r_vi + s_vi, and w_vi =
    1 / (1 + k max(m_vi - 1, 0)). Trust is (r + 1) / (r + s + 2) with r = sum over v of w_vi r_vi and s likewise.

    Deviations: [17]_ counts observations; here m is the sum of their visibilities after decay. The decay is that of
    `beta`.

    [2] Jøsang, Ismail: The Beta Reputation System. 15th Bled Electronic Commerce Conference, 2002.
    [17] Stata Technical Bulletin 60, insert sts18, 2001: the correction of Kish (1965) for intraclass correlation.
    """

    Params: ClassVar[type] = BetaCorrelatedParams

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Expectation of the Beta distribution of the effective evidence."""
        _, target, edge = self.log.edges.sorted()
        known = edge < len(state)
        target = target[known]
        sums = state[edge[known]] * self.decay(self.params.decay_per_s, n_steps)
        more = np.maximum(sums.sum(axis=1) - 1, 0)
        weight = 1 / (1 + self.params.correlation * more)
        n = len(self.log.pairs)
        evidence = np.column_stack([exact_sums(target, weight * one, n) for one in sums.T])
        return read_beta(evidence, self.horizon_s(self.params.decay_per_s))
