"""Pseudo-random Bayesian inference: groups of vehicles are verified, and suspicion is inferred from the groups."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.bounds import PositiveShare, Share
from cosim.base.rng import draws
from trust.evaluation_log import StepRows, exact, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows

PRIOR_VERIFICATIONS = 2.0
"""Verifications that the prior probability counts for in the long-term memory."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PrbiParams(StepwiseParams):
    """Parameters of the model `prbi`. The defaults are ours, but for `n_vehicles`, the paper's number."""

    n_vehicles: Annotated[int, Interval(ge=2, le=1000)] = 5
    """Vehicles that are divided into two groups."""
    least_agreement: Annotated[float, Interval(gt=0, lt=1)] = 0.5
    """epsilon: share of what a group says that must agree with the reference. The paper's similarity is that of two
    frames, and its epsilon 0.35."""
    prior_benign: Annotated[float, Interval(gt=0.5, lt=1)] = 0.8
    """Probability that a vehicle is benign, before any evidence."""
    memory: Share = 0.5
    """Weight of the last posterior against the share of verifications passed, in the next prior."""
    missed_p: Annotated[float, Interval(gt=0, lt=1)] = 0.3
    """Probability that a group passes although a member is malicious; 0 in the paper."""
    decay_per_s: PositiveShare = 0.98
    """Share of the verifications that is left after 1 s."""


def agreement(rows: StepRows, reliable: Float[ndarray, "p"]) -> Float[ndarray, "p 4"]:
    """How much others agree with what each vehicle says in a step.

    Parameters
    ----------
    reliable
        Weight of each vehicle's word; rows as in `EvaluationLog.pairs`.

    Returns
    -------
    Confirmed and denied of its detections, then confirmed and contradicted of its evaluations. An evaluation is judged
    by the sender and the other evaluators of the same detection: confirmed is a confirmation that they share,
    contradicted any evaluation against theirs. A denial that they share counts nothing.
    """
    by, pos, neg, n = rows.by, rows.object_pos, rows.object_neg, len(reliable)
    vote = exact(reliable[by] * (pos - neg))
    verdict = exact(reliable[rows.sender]) + rows.per_object(vote)
    others = verdict[rows.object] - vote
    true, false = others > 0, others < 0
    said = [
        (rows.about, reliable[by] * pos),
        (rows.about, reliable[by] * neg),
        (by, pos * true),
        (by, neg * true + pos * false),
    ]
    return np.stack([exact_sums(who, values, n) for who, values in said], axis=1)


def numbered(values: Int[ndarray, "k"]) -> Int[ndarray, "k"]:
    """Number of each value among the different ones, ascending from 0."""
    return np.unique(values, return_inverse=True)[1].reshape(-1)


def dealt(
    holder: Int[ndarray, "k"],
    draw: Float[ndarray, "k"],
    benign: Float[ndarray, "k"],
    n_suspects: Int[ndarray, "k"],
    n_vehicles: int,
) -> Int[ndarray, "k"]:
    """Divide vehicles into groups: each few of a holder, drawn at random, into the most suspicious and the rest.

    Parameters
    ----------
    holder
        Ascending.
    draw
        A random number for each vehicle.
    benign
        Probability that each vehicle is benign.
    n_suspects
        Vehicles in the group of the most suspicious. Both groups have at least one, if there are two vehicles.

    Returns
    -------
    Number of each vehicle's group, from 0.
    """
    begin, number = np.searchsorted(holder, holder), np.arange(len(holder))
    rank, place = np.zeros((2, len(holder)), np.int64)
    rank[np.lexsort((draw, holder))] = number - begin
    table = begin + rank // n_vehicles * n_vehicles
    order = np.lexsort((draw, benign, table))
    place[order] = number - np.searchsorted(table[order], table[order])
    most = np.maximum(np.bincount(table)[table] - 1, 1)
    is_rest = place >= np.clip(n_suspects, 1, most)
    return numbered(2 * table + is_rest)


class Prbi(Stepwise):
    """Pseudo-random Bayesian inference without a trusted ego [18]_, on evaluations.

    It should find senders of false content and of false evaluations without trust in any vehicle, the holder included,
    at two verifications for five vehicles and step. It cannot find a lie that is small beside what the other members
    of a group say truthfully, and honest members of a failed group are suspected with it. It fails where most liars
    agree with each other.

    Notes
    -----
    Of the paper: in every frame the vehicles are divided into the m most suspicious and the rest, m = log2(1 / eta),
    eta the share of verifications passed, because a random half without k malicious vehicles has probability 2^-k.
    Each group is verified against what was reliable in the frame before. P = P(benign) of a member of a failed group
    follows from Bayes' theorem: the prior mixes the last P with the share of its verifications passed, and the
    likelihood is the share failed among the groups without it.

    Ours: evaluations have no objects that last from step to step. The reference is therefore not the detections of the
    step before but the vehicles with P >= 1/2 after it. A group passes if at least epsilon of what its members say
    agrees with them (`agreement`). A holder deals all vehicles into fives first, the paper's number, by lots from time
    and their evidence, so that no pseudonym decides. A passed group is evidence too: its likelihoods are the share
    passed, and `missed_p` for a malicious member. Trust is the next prior.

    Deviations: as above; no test of convergence, and no final set of attackers, because vehicles come and go;
    verifications decay. The first frame need not be true. From summaries of the paper, not from its equations.

    [18] Yu, Wu, Zhang, Qiu, Huo, Feng: All Vehicles Can Lie: Efficient Adversarial Defense in Fully Untrusted-Vehicle
    Collaborative Perception via Pseudo-Random Bayesian Inference. CVPR, 2026, arXiv:2603.08498.
    """

    Params: ClassVar[type] = PrbiParams

    def start(self) -> Float[ndarray, "p 5"]:
        """No pairs yet. Of each: verifications passed and failed, the same over group sizes, and `prior_benign` - P."""
        return np.zeros((0, 5))

    def advance(self, state: ndarray, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> ndarray:
        """Verifications and probabilities after a step."""
        p = self.params
        new = with_rows(self._left(state, n_steps), n_pairs)
        known = np.round(self._benign(new), 6)  # so that rounding errors decide no tie
        said = agreement(rows, known * (known >= 0.5))
        holder, _, row = self.log.pairs.sorted()
        holder = numbered(holder)
        passed = exact_sums(holder, new[row, 2], len(row))
        failed = exact_sums(holder, new[row, 3], len(row))
        speaks = np.flatnonzero(said[row].sum(axis=1) > 0)
        if not speaks.size:
            return new
        holder, row = holder[speaks], row[speaks]
        passed, failed = passed[holder], failed[holder]
        known, said = known[row], said[row]
        n_malicious = np.log2((passed + failed + 1) / (passed + 1))
        lot = tuple((said.T * 2**32).astype(np.uint64))
        draw = draws(0, round(step * self.dt_s * 1000), lot)[:, 0]
        n_suspects = np.floor(n_malicious + 1e-9).astype(np.int64)
        group = dealt(holder, draw, known, n_suspects, p.n_vehicles)
        agreed = said[:, 0] + said[:, 2]
        good = exact_sums(group, agreed, len(row))
        total = exact_sums(group, said.sum(axis=1), len(row))
        fails = (good < p.least_agreement * total)[group]
        passed -= new[row, 0]  # those of groups without the vehicle are left
        failed -= new[row, 1]
        anomaly = (failed + 1) / (passed + failed + 2)
        if_benign = known * np.where(fails, anomaly, 1 - anomaly)
        if_malicious = (1 - known) * np.where(fails, 1.0, p.missed_p)
        new[row, 4] = p.prior_benign - if_benign / (if_benign + if_malicious)
        outcome = np.stack([~fails, fails], axis=1)
        new[row, :2] += outcome
        size = np.bincount(group)[group]
        new[row, 2:4] += outcome / size[:, None]
        return new

    def read(self, state: ndarray, n_steps: int, now: int) -> Reading:
        """The prior of the next verification."""
        left, horizon_s = self._left(state, n_steps), self.horizon_s(self.params.decay_per_s)
        return Reading(self._benign(left), left[:, :2].sum(axis=1), None, horizon_s)

    def _left(self, state: ndarray, n_steps: int) -> ndarray:
        """What is left of the verifications after some steps; the last posterior stays."""
        return state * np.append(np.full(4, self.decay(self.params.decay_per_s, n_steps)), 1.0)

    def _benign(self, state: ndarray) -> Float[ndarray, "p"]:
        """Probability that each vehicle is benign, before its next verification."""
        p, n = self.params, PRIOR_VERIFICATIONS
        passed, failed, _, _, doubt = state.T
        share = (passed + n * p.prior_benign) / (passed + failed + n)
        return p.memory * (p.prior_benign - doubt) + (1 - p.memory) * share
