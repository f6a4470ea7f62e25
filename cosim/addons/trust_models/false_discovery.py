"""A joint test of all vehicles with a controlled rate of false discoveries."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.special import betainc, gammaincc

from cosim.addons.trust_models.prbi import agreement, numbered
from cosim.base.bounds import PositiveShare, Share
from cosim.base.ragged import place_in_group
from trust.evaluation_log import StepRows, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows

PRIOR_EVIDENCE = 5.0
"""Evidence that the rate of all vehicles counts for in the rate of a vehicle's own past."""
LEAST_EVIDENCE = 0.01
"""Present evidence from which a vehicle is tested."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FalseDiscoveryParams(StepwiseParams):
    """Parameters of the model `false_discovery`; the defaults are ours."""

    level: Annotated[float, Interval(gt=0, lt=1)] = 0.05
    """q: largest expected share of honest vehicles among those with trust of 1/2 or less."""
    present_per_s: Annotated[float, Interval(gt=0, lt=1)] = 0.9
    """Share of the present evidence that is left after 1 s."""
    decay_per_s: PositiveShare = 0.98
    """Share of all evidence that is left after 1 s."""
    correlation: Share = 0.05
    """k: correlation of the evidence about a vehicle. n of it are worth n / (1 + k (n - 1)) independent ones."""


Numbers = Float[ndarray, "n"]
"""A number for each vehicle."""


def tail(denied: Numbers, said: Numbers, rate: Numbers) -> Numbers:
    """Probability of at least `denied` of `said` at this rate: the tail of the binomial distribution, by the beta
    function for numbers that are no integers; 1 if nothing is denied."""
    some = denied > 0
    confirmed = np.maximum(said - denied, 0.0)
    return np.where(some, betainc(np.where(some, denied, 1.0), confirmed + 1, rate), 1.0)


def critical(p: Numbers, holder: Int[ndarray, "n"], level: float) -> Numbers:
    """Largest p-value that is a discovery, by Benjamini and Hochberg, among the vehicles of each one's holder.

    Returns
    -------
    j q / m, j the largest number such that the j-th smallest of m p-values is at most this; q / m if there is none.
    `holder` is ascending.
    """
    order = np.lexsort((p, holder))
    rank = 1 + place_in_group(holder)
    m = np.bincount(holder)[holder]
    found = np.ones(len(p), np.int64)  # by holder
    discovered = p[order] <= rank * level / m
    np.maximum.at(found, holder[discovered], rank[discovered])
    return found[holder] * level / m


class FalseDiscovery(Stepwise):
    """Joint spatial and temporal test of all vehicles with a controlled false discovery rate, after GCP [19]_.

    It should find senders of false content and of false evaluations who differ from the population or from their own
    past, and accuse few honest vehicles, however many there are. It cannot find liars where most vehicles lie, and an
    honest vehicle that errs much more often than others is accused. It does not see removal or false speeds.

    Notes
    -----
    Of the paper: a spatial anomaly (what an agent says now against what others see) and a temporal one (against its own
    past frames) are joined to one p-value for each agent, and the Benjamini-Hochberg procedure at level q says who is
    malicious.

    Ours: what a vehicle says is its detections, denied or confirmed, and its evaluations, contradicted or shared by
    the sender and the other evaluators of the same detection (`prbi.agreement`, all with the same weight). For
    both, with present evidence d of n against the vehicle: the spatial p-value is the binomial tail of d at the
    rate of all vehicles of the holder, the temporal one at the vehicle's own rate before. The four are joined by
    Fisher's method, P(chi2 with 8 degrees of freedom > -2 sum ln p). With t the critical p-value, trust is p / (2
    t) for discoveries, p <= t, and else 1/2 + (p - t) / (2 - 2 t).

    Deviations: as above. The paper's scores are losses of boxes and of reconstructed motion, joined by learned weights,
    and its p-values are ranks among scores of normal agents, which a holder of evaluations does not have.

    [19] Tao, Hu, Hu, An, Cao, Fang: GCP: Guarded Collaborative Perception with Spatial-Temporal Aware Malicious Agent
    Detection. IEEE Transactions on Dependable and Secure Computing, 2026, arXiv:2501.02450.
    """

    Params: ClassVar[type] = FalseDiscoveryParams

    def start(self) -> Float[ndarray, "p 8"]:
        """Columns of `agreement`, of the present and of all time; no pairs yet."""
        return np.zeros((0, 8))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Evidence after a step."""
        new = with_rows(self._left(state, n_steps), n_pairs)
        return new + np.tile(agreement(rows, np.ones(len(new))), 2)

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """Trust from the p-values of the vehicles that are tested."""
        left = self._left(state, n_steps)
        weight = left[:, :4].sum(axis=1)
        trust = np.ones(len(left))
        holder, _, row = self.log.pairs.sorted()
        tested = weight[row] >= LEAST_EVIDENCE
        row, holder = row[tested], numbered(holder[tested])
        left = left[row]
        detections = left[:, [0, 1, 4, 5]]
        evaluations = left[:, [2, 3, 6, 7]]
        log_p = self._log_p(detections, holder) + self._log_p(evaluations, holder)
        p = gammaincc(4.0, -log_p)
        t = critical(p, holder, self.params.level)
        above = (p - t) / (1 - t)
        twice = np.where(p <= t, p / t, 1 + above)
        trust[row] = twice / 2
        return Reading(trust, weight, None, self.horizon_s(self.params.decay_per_s))

    def _log_p(self, evidence: Float[ndarray, "n 4"], holder: Int[ndarray, "n"]) -> Numbers:
        """Sum of the logarithms of both p-values; evidence for and against now, then of all time."""
        now, ever = evidence[:, :2], evidence[:, 2:]
        confirmed, denied = (exact_sums(holder, column, len(holder)) for column in ever.T)
        rate = ((denied + 1) / (confirmed + denied + 2))[holder]
        past = np.maximum(ever - now, 0.0)
        before = past.sum(axis=1) + PRIOR_EVIDENCE
        own = (past[:, 1] + PRIOR_EVIDENCE * rate) / before
        n = now.sum(axis=1)
        worth = 1 / (1 + self.params.correlation * np.maximum(n - 1, 0.0))
        against, n = now[:, 1] * worth, n * worth
        p = tail(against, n, rate), tail(against, n, own)
        return np.log(np.maximum(p, 1e-300)).sum(axis=0)

    def _left(self, state: ndarray, n_steps: int) -> ndarray:
        """What is left of present and of all evidence after some steps."""
        p = self.params
        shares = self.decay(p.present_per_s, n_steps), self.decay(p.decay_per_s, n_steps)
        return state * np.repeat(shares, 4)
