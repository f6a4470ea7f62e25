"""False evaluations of others' detections: attacks on the trust that vehicles have in each other."""

from dataclasses import dataclass
from typing import Annotated, TypeVar

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, UInt64
from numpy import ndarray

from cosim.attacks.attack import AttackContext, EvaluationRows, WithParams
from cosim.attacks.past import of_earlier_messages
from cosim.base.bounds import Share
from cosim.messages.content import Detections

Reported = tuple[Float[ndarray, "m"], Float[ndarray, "m"]]


@dataclass(frozen=True, kw_only=True, slots=True)
class IdentitiesParams:
    """Number of identities under which evaluations are sent."""

    n_identities: Annotated[int, Ge(1), Le(20)] = 1
    """Number of identities under which each attacker sends its evaluations, including its own. More than 1 is a Sybil
    attack: each identity has its own pseudonym and messages. SCMS issues 20 certificates that are valid at once."""


P = TypeVar("P", bound=IdentitiesParams)


class _WithIdentities(WithParams[P]):
    """Attackers send under several identities."""

    Params: type = IdentitiesParams

    def identities(self, context: AttackContext) -> Int[ndarray, "n"]:
        """The identities in addition to its own."""
        return np.full(len(context.world), self.params.n_identities - 1)


def _falsified(rows: EvaluationRows, chosen: Bool[ndarray, "m"], evaluation: ndarray | float) -> Reported:
    """All rows, the chosen ones with the given evaluation and full visibility."""
    return np.where(chosen, evaluation, rows.evaluation), np.where(chosen, 1.0, rows.visibility)


def _of_others(rows: EvaluationRows, detections: Detections, context: AttackContext) -> tuple[ndarray, ndarray]:
    """Whether each row is an attacker's evaluation of another vehicle, and the observer of each row."""
    observer = detections.observer[rows.detection]
    return context.attacker[rows.evaluator] & (observer != rows.evaluator), observer


def _accomplices(rows: EvaluationRows, observer: Int[ndarray, "m"], context: AttackContext) -> Bool[ndarray, "m"]:
    """Rows about members of the evaluator's own ring."""
    own_ring = context.ring[rows.evaluator]
    return context.member[observer] & (context.ring[observer] == own_ring)


@dataclass(frozen=True, kw_only=True, slots=True)
class BadMouthingParams(IdentitiesParams):
    """Which vehicles it denies."""

    only_victim: bool = False
    """Whether only detections of the victim are denied. If false, those of all vehicles but accomplices are denied."""


class BadMouthing(_WithIdentities[BadMouthingParams]):
    """Denies the detections of other vehicles, except accomplices: evaluation -1 and visibility 1."""

    Params = BadMouthingParams

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of others denied."""
        chosen, observer = _of_others(rows, detections, context)
        chosen &= ~_accomplices(rows, observer, context)
        if self.params.only_victim:
            chosen &= observer == context.victim_of()[rows.evaluator]
        return _falsified(rows, chosen, -1.0)


class BallotStuffing(_WithIdentities[IdentitiesParams]):
    """Confirms all detections of accomplices, true or fabricated: evaluation 1 and visibility 1."""

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of accomplices confirmed."""
        chosen, observer = _of_others(rows, detections, context)
        return _falsified(rows, chosen & _accomplices(rows, observer, context), 1.0)


class Collusion(_WithIdentities[BadMouthingParams]):
    """The members of a ring confirm each other and deny all others: ballot stuffing and bad-mouthing."""

    Params = BadMouthingParams

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of others confirmed or denied."""
        chosen, observer = _of_others(rows, detections, context)
        friends = _accomplices(rows, observer, context)
        denied = np.ones(len(friends), bool)
        if self.params.only_victim:
            denied = observer == context.victim_of()[rows.evaluator]
        return _falsified(rows, chosen & (friends | denied), np.where(friends, 1.0, -1.0))


@dataclass(frozen=True, kw_only=True, slots=True)
class DiscriminationParams(IdentitiesParams):
    """Which vehicles are denied."""

    group_p: Share = 0.3
    """Share of the vehicles in the group that is denied. It is drawn from their names, and all attackers deny the same
    group."""


class Discrimination(_WithIdentities[DiscriminationParams]):
    """Denies the detections of one group and is honest to all others, so that opinions about the attacker differ."""

    Params = DiscriminationParams

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of the group denied."""
        chosen, observer = _of_others(rows, detections, context)
        group = context.lasting(context.world.name_key)[:, 0] < self.params.group_p
        return _falsified(rows, chosen & group[observer], -1.0)


class RandomEvaluations(_WithIdentities[IdentitiesParams]):
    """Evaluates all other vehicles at random: evaluations from U(-1, 1) with full visibility."""

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of others drawn."""
        chosen, _ = _of_others(rows, detections, context)
        at = np.flatnonzero(chosen)
        detection = rows.detection[at]
        draws = context.uniforms(
            context.name_key(rows.evaluator[at]),
            context.name_key(detections.observer[detection]),
            detections.identity[detection],
            detections.detection_index[detection],
        )
        drawn = np.zeros(len(chosen))
        drawn[at] = 2.0 * draws[:, 0] - 1.0
        return _falsified(rows, chosen, drawn)


class MajorityCopying(_WithIdentities[IdentitiesParams]):
    """Reports the mean evaluation of the other vehicles for each detection, with their mean visibility.

    Notes
    -----
    Deviations: the attacker knows all evaluations of the same step, as if it waited for all of them, and none of other
    steps. Where vehicles sense at steps of their own, it reports visibility 0 about most detections.
    """

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, replaced by the mean of other vehicles. If there is none, visibility is 0."""
        chosen, _ = _of_others(rows, detections, context)
        at = rows.about
        n = int(at.max(initial=-1)) + 1
        of_own = rows.evaluator == detections.observer[rows.detection]
        honest = ~context.attacker[rows.evaluator] & ~of_own
        weight = np.where(honest, rows.visibility, 0.0)
        total = np.bincount(at, weight, n)
        voters = np.bincount(at, weight > 0, n)
        said = np.bincount(at, weight * rows.evaluation, n)
        mean = np.divide(said, total, out=np.zeros(n), where=total > 0)
        loud = np.divide(total, voters, out=np.zeros(n), where=voters > 0)
        evaluation = np.where(chosen, mean[at], rows.evaluation)
        visibility = np.where(chosen, loud[at], rows.visibility)
        return evaluation, visibility


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayedEvaluationsParams(IdentitiesParams):
    """Age of the evaluations."""

    n_messages: Annotated[int, Gt(0), Le(10_000)] = 10
    """Age of the attacker's own evaluations that it sends, in messages."""


class ReplayedEvaluations(_WithIdentities[ReplayedEvaluationsParams]):
    """Sends old evaluations again, as if they were about the detections that are received now.

    The attacker uses its own evaluations of that time with visibility above 0. It sends the one of the same sender and
    detection index. If there is none, it sends a random one of the same sender, or else a random one of any sender.

    Notes
    -----
    Deviations: the first messages repeat the oldest evaluations. An attacker without old evaluations sends its present
    ones.
    """

    Params = ReplayedEvaluationsParams

    def evaluations(self, rows: EvaluationRows, detections: Detections, context: AttackContext) -> Reported:
        """The rows, with evaluations of others replaced by old ones."""
        chosen, observer = _of_others(rows, detections, context)
        at, name = np.flatnonzero(chosen), context.name_key
        detection = rows.detection[at]
        number = detections.detection_index[detection] if rows.number is None else rows.number[at]
        index = detections.identity[detection] << 20 | number
        by, of_sender = name(rows.evaluator[at]), name(observer[at])
        key = np.column_stack([by, of_sender, index.astype(np.uint64)])
        seen = np.flatnonzero(rows.visibility[at] > 0)
        seen = seen[np.lexsort(key[seen].T[::-1])]  # a draw picks the same evaluation whatever the order of the rows
        of = at[seen]
        own = key[seen], rows.evaluation[of], rows.visibility[of]
        past = of_earlier_messages(context, context.attacker, own, rows.evaluator[of], self.params.n_messages)
        old_key, old_e, old_phi = _joined(past, own)
        draw = context.uniforms(by, of_sender, index)[:, 0]
        source = np.full(len(at), -1)
        for n_columns in (3, 2, 1):  # the number of equal columns of (evaluator, sender, detection)
            left = np.flatnonzero(source < 0)
            old, wanted = old_key[:, :n_columns], key[left, :n_columns]
            source[left] = _one_of(old, wanted, draw[left])
        e, phi = rows.evaluation.copy(), rows.visibility.copy()
        known = source >= 0
        e[at[known]] = old_e[source[known]]
        phi[at[known]] = old_phi[source[known]]
        return e, phi


def _joined(past: list, like: tuple[ndarray, ...]) -> list[ndarray]:
    """Columns of what `of_earlier_messages` returns; empty ones like the given columns if it returns nothing."""
    parts = [[column[:0] for column in like]]
    for old, rows, _ in past:
        parts.append([column[rows] for column in old])
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _one_of(
    old: UInt64[ndarray, "o c"],
    key: UInt64[ndarray, "k c"],
    draw: Float[ndarray, "k"],
) -> Int[ndarray, "k"]:
    """For each key, a row of `old` that equals it, chosen by a uniform in [0, 1); -1 if there is none."""
    _, which = np.unique(np.concatenate([old, key]), axis=0, return_inverse=True)
    group, wanted = np.split(which.reshape(-1), [len(old)])
    order = np.argsort(group, kind="stable")
    first, last = (np.searchsorted(group[order], wanted, side) for side in ("left", "right"))
    if not len(order):
        return np.full(len(key), -1)
    n = last - first
    drawn = np.minimum((draw * n).astype(np.int64), n - 1)
    row = order[np.clip(first + drawn, 0, len(order) - 1)]
    return np.where(n > 0, row, -1)
