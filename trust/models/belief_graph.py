"""Belief propagation on the graph of who evaluates whom: honest or not, for evaluators and observers alike."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.special import betaln, expit

from trust.evaluation_log import StepRows, exact, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows


@dataclass(frozen=True, kw_only=True, slots=True)
class BeliefGraphParams(StepwiseParams):
    """Parameters of the model `belief_graph`.

    The shapes of detections and self reports were set by percentiles of what honest vehicles say of honest vehicles
    (Helsinki, 30 % equipped, seeds 101 to 103). The other defaults are ours. They were chosen by the area under the ROC
    curve on seeds 101 to 104, so that figures on these seeds are too good.
    """

    prior_honest: Annotated[float, Interval(gt=0.5, lt=1)] = 0.8
    """Probability that a role is honest, before any evidence: the assumption of an honest majority."""
    detections_shape: tuple[float, float] = (7.0, 2.0)
    """Beta distribution of the share of an honest vehicle's detections that an honest evaluator confirms."""
    self_shape: tuple[float, float] = (2.0, 0.8)
    """The same for an honest vehicle's reports of itself."""
    form_shape: tuple[float, float] = (20.0, 0.2)
    """The same for the share of an honest vehicle's messages that do not contradict themselves."""
    decided_shape: tuple[float, float] = (8.0, 3.5)
    """The same for the share of an honest vehicle's evaluations with pos + neg above 1/2."""
    same_role: Annotated[float, Interval(ge=0, le=20)] = 1.0
    """Logarithm of the factor by which it is more likely that both roles of a vehicle are honest."""
    share_shape: tuple[float, float] = (20.0, 6.0)
    """Prior evidence for and against what a sender says, in the share of it that is confirmed."""
    n_sweeps: Annotated[int, Interval(ge=1, le=1000)] = 12
    """Updates of all messages per reading: the bound of the iteration."""
    decay_per_s: Annotated[float, Interval(gt=0, le=1)] = 0.95
    """Share of the evidence that is left after 1 s."""

    def __post_init__(self) -> None:
        for name in ("detections_shape", "self_shape", "form_shape", "decided_shape", "share_shape"):
            shape = getattr(self, name)
            if not all(0 < x <= 1e6 for x in shape):
                raise ValueError(
                    f"trust.{name} = {list(shape)}: both shapes of a Beta distribution are above 0, at most 1e6."
                )


@dataclass(frozen=True, slots=True)
class Graph:
    """Decayed evidence of every edge (evaluator, observer) and of every vehicle."""

    edges: Float[ndarray, "e 4"]  # pos and neg about detections, pos and neg about self reports
    vehicles: Float[ndarray, "p 6"]
    """Steps without and with a withheld list, messages without and with false certainty, evaluations that are decided
    and that are not."""


LARGEST = 20.0
"""Bound of the size of the logarithm of a likelihood ratio, so that no single edge decides alone."""


def log_ratio(pos: Float[ndarray, "n"], neg: Float[ndarray, "n"], shape: tuple[float, float]) -> Float[ndarray, "n"]:
    """Logarithm of the likelihood ratio of "both honest" to "anything", for shares that vary from pair to pair.

    Parameters
    ----------
    pos, neg
        Evidence for and against.
    shape
        Beta distribution of the share of pos where both are honest.

    Returns
    -------
    ln of B(a + pos, b + neg) / B(a, b) over the same with a = b = 1 (Laplace); 0 without evidence, at most `LARGEST` in
    size.
    """
    a, b = shape
    honest = betaln(a + pos, b + neg) - betaln(a, b)
    return np.clip(honest - betaln(1 + pos, 1 + neg), -LARGEST, LARGEST)


def against_chance(
    pos: Float[ndarray, "n"], neg: Float[ndarray, "n"], shape: tuple[float, float]
) -> Float[ndarray, "n"]:
    """As `log_ratio`, of "honest" to "drawn at random", where both outcomes have probability 1/2; at most 0."""
    a, b = shape
    honest = betaln(a + pos, b + neg) - betaln(a, b)
    return np.clip(honest + (pos + neg) * np.log(2.0), -LARGEST, 0.0)


def propagated(
    ends: Int[ndarray, "e 2"], ratio: Float[ndarray, "e"], alone: Float[ndarray, "n"], n_sweeps: int
) -> Float[ndarray, "n"]:
    """Loopy belief propagation for two states per node.

    Parameters
    ----------
    ends
        The two nodes of each edge, as rows of `alone`.
    ratio
        L of each edge: the factor is e^L if both ends are honest, else 1.
    alone
        Log-odds that each node is honest, without the edges.
    n_sweeps
        Updates of all messages; each moves them half of the way.

    Returns
    -------
    Log-odds that each node is honest.

    Notes
    -----
    The message from a node that is honest with probability p, without this edge's own message, is
    ln(1 - p + p e^L). Sums are exact to 2^-32, so that order changes nothing.
    """
    to, source, both = ends.T.ravel(), ends[:, ::-1].T.ravel(), np.concatenate([ratio, ratio])
    message = np.zeros(both.size)  # to the first end of each edge, then to the second
    for _ in range(n_sweeps):
        cavity = (alone + exact_sums(to, message, alone.size))[source] - np.roll(message, ratio.size)
        new = np.logaddexp(-np.logaddexp(0.0, cavity), both - np.logaddexp(0.0, -cavity))
        message = exact((message + new) / 2)
    return alone + exact_sums(to, message, alone.size)


class BeliefGraph(Stepwise):
    """Markov random field over the roles of vehicles, solved by loopy belief propagation [11]_.

    Every vehicle has two roles, sender and evaluator, and each is honest or not. Where both ends of an edge are honest,
    the evaluator confirms as large a share as the sensors let it; where one is not, the share may be anything. A liar
    about honest vehicles contradicts many of them at once, and each of its victims is contradicted by few: the
    evaluator is what is wrong. Three properties need no second vehicle, and speak only against it. A vehicle that
    confirms with its own detections and sends none withholds them. A vehicle that is certain of more than one detection
    of one sender (e = Phi = 1, which is due to its own body only) claims more than a detector can. And values that
    exceed 1/2 as often as not look drawn.

    It should stop false content (ghosts, replays, offsets), bad-mouthing, collusion, Sybil vehicles whose places others
    can see, and the removal of all detections. It cannot stop a colluding majority among the vehicles that see each
    other, accomplices that confirm true detections, liars that nobody else checks, partial removal, or values that
    nobody evaluates (speed). Two of the three checks can be
    evaded by an attacker that knows them: the second by values that a detector can give, the third by values drawn from
    those of an honest detector.

    Notes
    -----
    Edge (evaluator v, sender i): L = ln [B(a + r, b + s) / B(a, b)] - ln B(1 + r, 1 + s) of the decayed sums r, s of
    pos and neg, for detections and for self reports, added. The roles of one vehicle share an edge with L =
    `same_role`. Every role has the log-odds of `prior_honest`; that of the evaluator has such ratios of the three
    properties too, where they are negative, the third against the Binomial distribution of 1/2. Trust is the product of
    the beliefs in both roles after `n_sweeps` and of the share of the sender's evidence that is positive, each
    evaluator weighted by its belief. Weight is the sum of evidence about the sender.

    Deviations: the factors are ours; [11]_ gives the algorithm. Messages are damped by half and rounded to 2^-32.

    [11] Pearl: Probabilistic Reasoning in Intelligent Systems. Morgan Kaufmann, 1988.
    """

    Params: ClassVar[type] = BeliefGraphParams

    def start(self) -> Graph:
        """No edges and no vehicles yet."""
        return Graph(np.zeros((0, 4)), np.zeros((0, 6)))

    def advance(self, state: Graph, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Graph:
        """Evidence of edges and vehicles after a step."""
        kept = self.decay(self.params.decay_per_s, n_steps)
        edges = with_rows(state.edges * kept, len(self.log.edges))
        vehicles = with_rows(state.vehicles * kept, n_pairs)
        pos, neg, row, n_rows = rows.object_pos, rows.object_neg, rows.row, rows.n.size
        for column, of_self in ((0, False), (2, True)):
            mine = rows.is_self == of_self
            edges[rows.edge, column] += exact_sums(row, np.where(mine, pos, 0.0), n_rows)
            edges[rows.edge, column + 1] += exact_sums(row, np.where(mine, neg, 0.0), n_rows)

        def counted(of: Int[ndarray, "k"], which: Bool[ndarray, "k"], n: int = len(vehicles)) -> ndarray:
            return np.bincount(of, which, n)

        by, decided = rows.evaluator[row], pos + neg > 0.5
        detects = counted(by, (pos > 0) & (pos < 1)) > 0  # 1 would be a match with the evaluator's own body
        silent = counted(rows.evaluator, rows.n_sent <= 1) > 0
        certain = counted(row, pos == 1, n_rows) > 1
        vehicles[:, 0] += detects & ~silent
        vehicles[:, 1] += detects & silent
        vehicles[:, 2] += counted(rows.evaluator, ~certain)
        vehicles[:, 3] += counted(rows.evaluator, certain)
        vehicles[:, 4] += counted(by, decided)
        vehicles[:, 5] += counted(by, ~decided)
        return Graph(edges, vehicles)

    def read(self, state: Graph, n_steps: int, now: int) -> Reading:
        """Belief that both roles of each subject are honest."""
        p = self.params
        kept = self.decay(p.decay_per_s, n_steps)
        source, target, edge = self.log.edges.sorted()
        known = edge < len(state.edges)
        source, target = source[known], target[known]
        about, form, n = state.edges[edge[known]] * kept, state.vehicles * kept, len(state.vehicles)
        ratio = log_ratio(about[:, 0], about[:, 1], p.detections_shape)
        ratio += log_ratio(about[:, 2], about[:, 3], p.self_shape)
        alone = np.full(2 * n, np.log(p.prior_honest) - np.log1p(-p.prior_honest))  # evaluators, then senders
        alone[:n] += np.minimum(log_ratio(form[:, 0], form[:, 1], p.form_shape), 0.0)
        alone[:n] += np.minimum(log_ratio(form[:, 2], form[:, 3], p.form_shape), 0.0)
        alone[:n] += against_chance(form[:, 4], form[:, 5], p.decided_shape)
        both = np.column_stack([np.arange(n), n + np.arange(n)])
        ends = np.concatenate([np.column_stack([source, n + target]), both])
        belief = expit(propagated(ends, np.concatenate([ratio, np.full(n, p.same_role)]), alone, p.n_sweeps))
        weight = exact_sums(target, about.sum(axis=1), n)
        pos = p.share_shape[0] + exact_sums(target, belief[source] * (about[:, 0] + about[:, 2]), n)
        neg = p.share_shape[1] + exact_sums(target, belief[source] * (about[:, 1] + about[:, 3]), n)
        trust = belief[:n] * belief[n:] * pos / (pos + neg)
        return Reading(trust, weight, None, self.horizon_s(p.decay_per_s))
