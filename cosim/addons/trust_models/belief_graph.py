"""Belief propagation on the graph of who evaluates whom: honest or not, for evaluators and each kind of claim."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from annotated_types import Interval
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.special import betaln, expit, gammaln

from cosim.base.bounds import PositiveShare
from trust.claims import DETECTION, MISSING, N_OBJECTS, SPEED
from trust.evaluation_log import StepRows, exact, exact_sums
from trust.models.stepwise import Reading, Stepwise, StepwiseParams
from trust.pair_index import with_rows
from trust.params import KINDS, Kind

Shape = tuple[float, ...]

BOTH, SENDER_LIES, EVALUATOR_LIES = range(3)
"""Rows of the shapes of a kind: both ends are honest, only the evaluator is, and only the sender is."""

_SHAPES = ("detections_shapes", "missing_shapes", "speed_shapes", "certain_shapes")


@dataclass(frozen=True, kw_only=True, slots=True)
class BeliefGraphParams(StepwiseParams):
    """Parameters of the model `belief_graph`.

    The shapes of Dirichlet distributions follow those that are most likely for evaluations between honest vehicles, of
    liars, and by liars (Helsinki, 30 % equipped, seeds 1 to 6, in an earlier world with exact poses). The other
    defaults are ours. They were chosen by the area under the ROC curve on the same seeds, so that figures on these
    seeds are too good. Shapes fitted in one drive of the default world lower its mean area from 0.91 to 0.88, so these
    stay.
    """

    evidence: tuple[Kind, ...] = ("detections",)
    """Kinds of evaluations that are made; the same as `trust.evidence`."""
    prior_honest: Annotated[float, Interval(gt=0.5, lt=1)] = 0.8
    """Probability that a role is honest, before any evidence: the assumption of an honest majority."""
    detections_shapes: tuple[Shape, Shape, Shape] = (
        (21.0, 5.0, 1.7, 1.7),
        (2.0, 0.7, 1.1, 0.8),
        (0.6, 1.1, 0.5, 0.5),
    )
    """Dirichlet distributions of the shares of four outcomes of a detection: confirmed, denied while others confirm it,
    denied by all of several, denied by a single one. Where both are honest, only the evaluator is, only the sender."""
    missing_shapes: tuple[Shape, Shape, Shape] = ((30.0, 6.0), (0.3, 1.0), (0.3, 0.8))
    """Likewise of the shares of objects that a message has and lacks."""
    speed_shapes: tuple[Shape, Shape, Shape] = ((20.0, 1.0), (2.0, 3.0), (1.3, 2.8))
    """Likewise of the shares of right and wrong velocities of the sender itself."""
    certain_shapes: tuple[Shape, Shape] = ((60.0, 1.5), (0.5, 0.1))
    """Likewise of the shares of a message's further detections of which the evaluator is not certain and is certain:
    of an honest evaluator and of a liar."""
    honest_p: Annotated[float, Interval(gt=0, lt=1)] = 0.8
    """Probability that an evaluator that lies is honest about a sender all the same."""
    same_role: Annotated[float, Interval(ge=0, le=20)] = 0.5
    """Logarithm of the factor by which it is more likely that two roles of a vehicle are both honest."""
    decided_shape: tuple[float, float] = (8.0, 3.5)
    """Beta distribution of the share of an honest vehicle's evaluations with pos + neg above 1/2."""
    form_shape: tuple[float, float] = (20.0, 0.2)
    """Likewise of the share of an honest vehicle's steps in which it does not withhold what it confirms with."""
    share_shape: tuple[float, float] = (30.0, 5.0)
    """Prior evidence for and against what a sender says, in the share of it that is confirmed."""
    independent_p: PositiveShare = 0.5
    """Share of the evidence that counts as independent: that of successive steps resembles each other."""
    n_sweeps: Annotated[int, Interval(ge=1, le=1000)] = 12
    """Updates of all messages per reading: the bound of the iteration."""
    decay_per_s: PositiveShare = 0.95
    """Share of the evidence that is left after 1 s."""

    def __post_init__(self) -> None:
        shapes = [(name, shape) for name in _SHAPES for shape in getattr(self, name)]
        shapes += [(name, getattr(self, name)) for name in ("decided_shape", "form_shape", "share_shape")]
        for name, shape in shapes:
            n_outcomes = 4 if name == "detections_shapes" else 2
            if len(shape) != n_outcomes or not all(0 < x <= 1e6 for x in shape):
                raise ValueError(
                    f"trust.{name} = {list(shape)}: the shapes of a Dirichlet distribution are above 0, at most 1e6, "
                    "one for each outcome."
                )


@dataclass(frozen=True, slots=True)
class Graph:
    """Decayed evidence of every edge (evaluator, observer) and of every vehicle."""

    edges: Float[ndarray, "e 10"]
    """Four outcomes of detections, two of missing objects, two of velocities, and further detections of which the
    evaluator is not certain and is certain."""
    vehicles: Float[ndarray, "p 5"]
    """Steps without and with a withheld list, evaluations that are decided and that are not, impossible evaluations."""


LARGEST = 20.0
"""Bound of the size of the logarithm of a likelihood ratio, so that no single edge decides alone."""
_IMPOSSIBLE = 10.0
"""Logarithm of the factor by which an impossible evaluation speaks against its evaluator: rounding, or a lie."""
_MOST_IMPOSSIBLE = 200.0
_DETECTIONS, _MISSING = slice(0, 4), slice(4, 6)
_SPEED, _CERTAIN = slice(6, 8), slice(8, 10)


def log_likelihood(counts: Float[ndarray, "n c"], shape: Shape) -> Float[ndarray, "n"]:
    """Logarithm of the likelihood of counts of C outcomes whose shares vary by a Dirichlet distribution.

    Returns
    -------
    ln of B(a + counts) / B(a) with the multivariate Beta function B and a = `shape`; 0 without counts.
    """
    a = np.asarray(shape)
    n = gammaln(a.sum()) - gammaln(a.sum() + counts.sum(axis=1))
    return n + (gammaln(a + counts) - gammaln(a)).sum(axis=1)


def ratios(
    counts: Float[ndarray, "n c"], shapes: tuple[Shape, Shape, Shape], honest_p: float
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Logarithms of two likelihood ratios of each edge: both ends are honest, or only the evaluator is, to neither.

    Parameters
    ----------
    counts
        Evidence of each outcome.
    shapes
        Shapes where both are honest, where the sender lies, and where the evaluator lies.
    honest_p
        Probability that an evaluator that lies is honest about a sender.
    """
    both, sender, evaluator = (log_likelihood(counts, shape) for shape in shapes)
    liar_is_honest = np.log(honest_p) + both
    liar = np.logaddexp(liar_is_honest, np.log1p(-honest_p) + evaluator)
    to_both, to_sender = both - liar, sender - liar
    return np.clip(to_both, -LARGEST, LARGEST), np.clip(to_sender, -LARGEST, LARGEST)


def log_ratio(
    pos: Float[ndarray, "n"],
    neg: Float[ndarray, "n"],
    shape: tuple[float, float],
) -> Float[ndarray, "n"]:
    """As `log_likelihood` of two outcomes, less that of uniform shares (Laplace); at most `LARGEST` in size."""
    a, b = shape
    honest = betaln(a + pos, b + neg) - betaln(a, b)
    return np.clip(honest - betaln(1 + pos, 1 + neg), -LARGEST, LARGEST)


def against_chance(
    pos: Float[ndarray, "n"],
    neg: Float[ndarray, "n"],
    shape: tuple[float, float],
) -> Float[ndarray, "n"]:
    """As `log_ratio`, of "honest" to "drawn at random", where both outcomes have probability 1/2; at most 0."""
    a, b = shape
    honest = betaln(a + pos, b + neg) - betaln(a, b)
    return np.clip(honest + (pos + neg) * np.log(2.0), -LARGEST, 0.0)


def propagated(
    ends: Int[ndarray, "e 2"],
    ratio: Float[ndarray, "e 2"],
    alone: Float[ndarray, "n"],
    n_sweeps: int,
) -> Float[ndarray, "n"]:
    """Loopy belief propagation for two states per node.

    Parameters
    ----------
    ends
        Evaluator and sender of each edge, as rows of `alone`.
    ratio
        L and M of each edge: the factor is e^L if both ends are honest, e^M if the first alone is, else 1.
    alone
        Log-odds that each node is honest, without the edges.
    n_sweeps
        Updates of all messages; each moves them half of the way.

    Returns
    -------
    Log-odds that each node is honest.

    Notes
    -----
    With the log-odds c of the other end, without this edge's own message, the message to the sender is
    ln(1 + e^(c + L)) - ln(1 + e^(c + M)), that to the evaluator ln(e^M + e^(c + L)) - ln(1 + e^c). Sums are exact to
    2^-32, so that order changes nothing.
    """
    evaluator, sender = ends.T
    both, first = ratio.T
    to = np.concatenate([evaluator, sender])
    message = np.zeros(to.size)
    for _ in range(n_sweeps):
        odds = alone + exact_sums(to, message, alone.size)
        of_evaluator, of_sender = np.split(odds[to] - message, 2)
        new = np.concatenate(
            [
                np.logaddexp(first, of_sender + both) - np.logaddexp(0.0, of_sender),
                np.logaddexp(0.0, of_evaluator + both) - np.logaddexp(0.0, of_evaluator + first),
            ]
        )
        message = exact((message + new) / 2)
    return alone + exact_sums(to, message, alone.size)


class BeliefGraph(Stepwise):
    """Markov random field over the roles of vehicles, solved by loopy belief propagation [11]_.

    Every vehicle has several roles, each honest or not: evaluator, sender of detections, and, with these kinds of
    evidence, sender of all that it sees, and of its velocity. An evaluator and a sender share an edge. Denials that
    others contradict speak against the evaluator, denials that no other contradicts against the sender, and a lone
    denial says little. A liar about honest vehicles contradicts many of them at once, and each of its victims is
    contradicted by few: the evaluator is what is wrong. Four properties concern the form of evaluations. A vehicle
    that confirms with its own detections and sends none withholds them. A vehicle that is certain of several
    detections of one sender (e = Phi = 1, which is due to its own body only) claims more than a detector can.
    Values that exceed 1/2 as often as not look drawn. And no honest evaluation of a missing object is above 1/3 or
    certain, and none of a velocity certain.

    It should stop false content (ghosts, replays, offsets), bad-mouthing, collusion, Sybil vehicles whose places
    others can see; with the further kinds of evidence also removal and false speeds. It cannot stop a colluding
    majority among the vehicles that see each other, liars that no other checks, or accomplices that confirm true
    detections with values that a detector can give: such praise is true. An attacker that knows the checks of form
    can evade them.

    Notes
    -----
    Edge (evaluator v, sender i): L and M are logarithms of likelihood ratios of the decayed counts times
    `independent_p` (`ratios`). To both of detections, the ratio of `certain_shapes` is added, where it is negative.
    The role of evaluator and every other role of a vehicle share an edge with L = `same_role`. Every role has the
    log-odds of `prior_honest`; the evaluator has those of its form too, where they are negative. After `n_sweeps`,
    the evidence about each sender is added up, each evaluator weighted by its belief. Trust is the product of the
    belief in the evaluator, of the square of the share of its detections that are confirmed, denials that others
    contradict left out, and for each further kind of the probability of honesty with prior 0.9, if its log-odds
    grow by at most 1. Weight is the sum of evidence about the sender.

    Deviations: the factors are ours; [11]_ gives the algorithm. Messages are damped by half and rounded to 2^-32.

    [11] Pearl: Probabilistic Reasoning in Intelligent Systems. Morgan Kaufmann, 1988.
    """

    Params: ClassVar[type] = BeliefGraphParams

    def start(self) -> Graph:
        """No edges and no vehicles yet."""
        return Graph(np.zeros((0, 10)), np.zeros((0, 5)))

    def advance(self, state: Graph, n_steps: int, step: int, rows: StepRows, n_pairs: int) -> Graph:
        """Evidence of edges and vehicles after a step."""
        kept = self.decay(self.params.decay_per_s, n_steps)
        has_claims = len(self.params.evidence) > 1
        edges = with_rows(state.edges * kept, len(self.log.edges))
        vehicles = with_rows(state.vehicles * kept, n_pairs)
        row, by, n_rows = rows.row, rows.by, rows.n.size
        kind = rows.index % len(KINDS) if has_claims else np.full(rows.index.size, DETECTION)
        is_detection = kind == DETECTION
        columns = range(_SPEED.stop if has_claims else _DETECTIONS.stop)
        for column, values in zip(columns, _outcomes(rows, kind), strict=False):
            edges[rows.edge, column] += exact_sums(row, values, n_rows)

        def counted(
            of: Int[ndarray, "k"],
            which: Bool[ndarray, "k"],
            n: int = len(vehicles),
        ) -> ndarray:
            return np.bincount(of, which, n)

        pos, neg = rows.object_pos, rows.object_neg
        n_made = counted(row, is_detection, n_rows)
        further = np.maximum(counted(row, is_detection & (pos == 1), n_rows) - 1, 0)
        edges[rows.edge, 8] += np.maximum(n_made - 1, 0) - further
        edges[rows.edge, 9] += further
        n_sent = (rows.n_sent - N_OBJECTS) // 2 if has_claims else rows.n_sent  # as `claims_of_messages` makes claims
        detects = counted(by, is_detection & (pos > 0) & (pos < 1)) > 0  # 1 would be a match with the evaluator itself
        silent = counted(rows.evaluator, n_sent <= 1) > 0
        vehicles[:, 0] += detects & ~silent
        vehicles[:, 1] += detects & silent
        vehicles[:, 2] += counted(by, is_detection & (pos + neg > 0.5))
        vehicles[:, 3] += counted(by, is_detection & (pos + neg <= 0.5))
        is_impossible = (pos + neg >= 1.0) | (kind == MISSING) & (pos > 0.34)
        vehicles[:, 4] += counted(by, ~is_detection & is_impossible)
        return Graph(edges, vehicles)

    def read(self, state: Graph, n_steps: int, now: int) -> Reading:
        """Belief in the evaluator, and what those who are believed say of the sender."""
        p = self.params
        kept = self.decay(p.decay_per_s, n_steps)
        source, target, edge = self.log.edges.sorted()
        known = edge < len(state.edges)
        source, target = source[known], target[known]
        about = state.edges[edge[known]] * kept
        n = len(state.vehicles)
        counts = p.independent_p * about
        found = [self._ratios(counts, about)]
        claims = []
        if "missing" in p.evidence:
            claims.append((counts[:, _MISSING], p.missing_shapes))
        if "speed" in p.evidence:
            claims.append((counts[:, _SPEED], p.speed_shapes))
        found += [np.column_stack(ratios(of, shapes, p.honest_p)) for of, shapes in claims]
        ends, ratio = [], []
        for role, of_role in enumerate(found, 1):  # nodes of a vehicle: evaluator, then one role per kind
            of_edges = np.column_stack([source, role * n + target])
            of_vehicles = np.arange(n)[:, None] + [0, role * n]
            ends += [of_edges, of_vehicles]
            ratio += [of_role, np.full((n, 2), [p.same_role, 0.0])]
        prior = np.log(p.prior_honest) - np.log1p(-p.prior_honest)
        alone = np.full((1 + len(found), n), prior)
        alone[0] += self._form(state.vehicles * kept)
        odds = propagated(np.concatenate(ends), np.concatenate(ratio), alone.ravel(), p.n_sweeps)
        belief = expit(odds[:n])
        believed = belief[source]

        def said(of: Float[ndarray, "e c"]) -> Float[ndarray, "n c"]:
            return np.column_stack([exact_sums(target, believed * x, n) for x in of.T])

        confirmed, _, jointly, alone_denied = said(counts[:, _DETECTIONS]).T
        prior_pos, prior_neg = p.share_shape
        pos, neg = prior_pos + confirmed, prior_neg + jointly + alone_denied
        trust = belief * (pos / (pos + neg)) ** 2
        for of, shapes in claims:
            total = said(of)
            gain = log_likelihood(total, shapes[BOTH]) - log_likelihood(total, shapes[SENDER_LIES])
            trust = trust * expit(np.log(9.0) + np.minimum(gain, 1.0))
        weight = exact_sums(target, about[:, : _CERTAIN.start].sum(axis=1), n)
        return Reading(trust, weight, None, self.horizon_s(p.decay_per_s))

    def _ratios(
        self,
        counts: Float[ndarray, "e 10"],
        about: Float[ndarray, "e 10"],
    ) -> Float[ndarray, "e 2"]:
        """Ratios of the edges of detections, and of how often the evaluator is certain."""
        p = self.params
        both, first = ratios(counts[:, _DETECTIONS], p.detections_shapes, p.honest_p)
        honest, liar = (log_likelihood(about[:, _CERTAIN], shape) for shape in p.certain_shapes)
        to_either = honest - np.logaddexp(honest, liar)
        certain = np.clip(to_either + np.log(2.0), -LARGEST, 0.0)
        return np.column_stack([both + certain, first + certain])

    def _form(self, vehicles: Float[ndarray, "n 5"]) -> Float[ndarray, "n"]:
        """Log-odds by which the form of a vehicle's evaluations speaks against it; at most 0."""
        listed, withheld, decided, undecided, impossible = vehicles.T
        found = np.minimum(log_ratio(listed, withheld, self.params.form_shape), 0.0)
        found += against_chance(decided, undecided, self.params.decided_shape)
        return found - np.minimum(_IMPOSSIBLE * impossible, _MOST_IMPOSSIBLE)


def _outcomes(rows: StepRows, kind: Int[ndarray, "k"]) -> Iterator[Float[ndarray, "k"]]:
    """Evidence of every single evaluation for each of the first eight columns of `Graph.edges`."""
    pos, neg = rows.object_pos, rows.object_neg
    confirms, denies = pos > 0, neg > 0
    others_confirm = rows.per_object(confirms.astype(float))[rows.object] > confirms
    others_deny = rows.per_object(denies.astype(float))[rows.object] > denies
    is_detection = kind == DETECTION
    denied = np.where(is_detection, neg, 0.0)
    yield np.where(is_detection, pos, 0.0)
    yield np.where(others_confirm, denied, 0.0)
    yield np.where(~others_confirm & others_deny, denied, 0.0)
    yield np.where(~others_confirm & ~others_deny, denied, 0.0)
    for of_kind in (kind == MISSING, (kind == SPEED) & (rows.index == SPEED)):  # the speed of the sender itself
        yield np.where(of_kind, pos, 0.0)
        yield np.where(of_kind, neg, 0.0)
