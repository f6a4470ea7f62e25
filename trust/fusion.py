"""Fusion: what an ego finally believes about each group of detections."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit, prange
from numpy import ndarray

from trust.params import AVERAGES, Method, TrustParams
from trust.tables import Detections, Groups, Verdicts, Views, int64
from trust.threads import threads_for


@dataclass(frozen=True, slots=True)
class Heard:
    """Whom each ego has heard this step, and how far it trusts them; sorted by vehicle within an ego."""

    ptr: Int[ndarray, "e+1"]  # ego x heard vehicle[ptr[x]:ptr[x + 1]]
    vehicle: Int[ndarray, "h"]  # row of the heard vehicle among the step's vehicles
    trust: Float[ndarray, "h"]  # the value that the ego uses for it
    judged: Bool[ndarray, "h"] | None = None  # whether its verdicts on this step came too; unset, all did


@dataclass(frozen=True, slots=True)
class Sight:
    """What the ego's own sweep says of each group's seed; read for foreign seeds only."""

    n_points: Int[ndarray, "g"]  # returns inside the box
    plausible: Bool[ndarray, "g"]
    near: Bool[ndarray, "g"]  # within the range of the sensor (70 m)


@dataclass(frozen=True, slots=True)
class Fused:
    """Final objects, one per group, in the order of the views and of the groups' seeds."""

    view: Int[ndarray, "f"]  # row of the ego's view
    seed: Int[ndarray, "f"]  # detection that gives class and box
    pose: Int[ndarray, "f"]  # detection that gives position and heading
    score: Float[ndarray, "f"]  # in [0, 1]
    local: Bool[ndarray, "f"]  # the ego opened the group
    n_witnesses: Int[ndarray, "f"]  # detections in the group
    n_verdicts: Int[ndarray, "f"]  # verdicts behind the score

    def take(self, rows: ndarray) -> "Fused":
        """The chosen rows (a mask or row numbers)."""
        return Fused(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


@dataclass(frozen=True, slots=True)
class Sums:
    """Per group what the formulas need; "members" are the group's detections."""

    n: Int[ndarray, "g"]  # members
    local: Bool[ndarray, "g"]  # the ego opened the group
    own: Float[ndarray, "g"]  # score of the seed
    scores: Float[ndarray, "g"]  # sum of the members' scores
    believed: Float[ndarray, "g"]  # sum of score x trust of its detector
    trust: Float[ndarray, "g"]  # sum of the detectors' trust
    for_: Float[ndarray, "g"]  # sum over members and evaluators of Phi T e
    weight: Float[ndarray, "g"]  # sum over members and evaluators of Phi T
    parity: "Parity"
    sight: Sight


@dataclass(frozen=True, slots=True)
class Parity:
    """Per group what only the published code's formulas need."""

    mean_or_own: Float[ndarray, "g"]  # mean of the members' aggregated evaluation, the ego's own score for none
    mean_or_score: Float[ndarray, "g"]  # the same, the member's score for none
    of_seed: Float[ndarray, "g"]  # aggregated evaluation of the seed, 0 for none
    certain: Float[ndarray, "g"]  # sum of certainty x trust, certainty 1 for self reports and -1 else
    certain_score: Float[ndarray, "g"]  # sum of score x certainty x trust


@njit(cache=True, parallel=True)
def _accumulate(view_ptr, member, owner, n_detections, said_ptr, said, said_by, e, phi, heard_ptr, heard, trust,
                judged, ego_trust, ego_computed, default_trust, flat, sender, n_chunks,
                num, den, n, detector):  # fmt: skip
    """Per position of the fusing views: sum Phi T e, sum Phi T, number of verdicts, trust of its detector."""
    n_vehicles = said_by.size
    for chunk in prange(n_chunks):
        at = np.full(n_detections, -1, np.int64)
        known = np.full(n_vehicles, default_trust)
        for x in range(chunk, owner.size, n_chunks):
            ego = owner[x]
            for h in range(heard_ptr[x], heard_ptr[x + 1]):
                known[heard[h]] = trust[h]
            if not ego_computed:
                known[ego] = ego_trust
            for p in range(view_ptr[x], view_ptr[x + 1]):
                at[member[p]] = p
                detector[p] = known[sender[member[p]]]
            for h in range(heard_ptr[x] - 1, heard_ptr[x + 1]):
                v = ego if h < heard_ptr[x] else heard[h]
                if said_by[v] < 0 or (h >= heard_ptr[x] and (v == ego or not judged[h])):
                    continue
                t = 1.0 if flat else known[v]
                for s in range(said_ptr[said_by[v]], said_ptr[said_by[v] + 1]):
                    p = at[said[s]]
                    if p >= 0 and abs(e[s]) <= 1.0 and phi[s] >= 0.0 and phi[s] <= 1.0:
                        w = phi[s] * t
                        num[p] += w * e[s]
                        den[p] += w
                        n[p] += 1
            for p in range(view_ptr[x], view_ptr[x + 1]):
                at[member[p]] = -1
            for h in range(heard_ptr[x], heard_ptr[x + 1]):
                known[heard[h]] = default_trust
            known[ego] = default_trust


def _ratio(a: ndarray, b: ndarray) -> ndarray:
    return np.divide(a, b, out=np.zeros_like(a), where=b != 0)


def _denied(g: Sums, p: TrustParams) -> Bool[ndarray, "g"]:
    """Groups that the plausibility check removes: never the ego's own."""
    return ~g.local & ~g.sight.plausible & p.plausibility_in_fusion


def _average(g: Sums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_own if p.code_parity else _ratio(g.for_, g.weight)


def _trupercept_1(g: Sums, p: TrustParams) -> ndarray:
    return np.where(_denied(g, p), 0.0, _average(g, p))


def _local_bias(g: Sums, p: TrustParams) -> ndarray:
    value = _average(g, p)
    return np.where(_denied(g, p), 0.0, np.where(g.local, (value + g.own) / 2, value))


def _unchecked_2(g: Sums, p: TrustParams) -> ndarray:
    return g.parity.mean_or_score if p.code_parity else g.for_ / g.n


def _trupercept_2(g: Sums, p: TrustParams) -> ndarray:
    return np.where(_denied(g, p), 0.0, _unchecked_2(g, p))


def _trupercept_3(g: Sums, p: TrustParams) -> ndarray:
    near, far = (g.own, g.parity.of_seed) if p.code_parity else (_unchecked_2(g, p), _unchecked_2(g, p))
    unseen = (g.sight.n_points < p.blind_points) & ~_denied(g, p)
    foreign = np.where(g.sight.near, np.where(unseen, near, 0.0), far)
    return np.where(g.local, g.own, foreign)


def _local(g: Sums, p: TrustParams) -> ndarray:
    return np.where(g.local, g.own, 0.0)


def _any(g: Sums, p: TrustParams) -> ndarray:
    return np.ones(g.n.size)


def _any_confirmed(g: Sums, p: TrustParams) -> ndarray:
    return np.where(g.n > 1, 1.0, g.own)


def _confirmed_or_local(g: Sums, p: TrustParams) -> ndarray:
    return np.where(g.n > 1, 1.0, _local(g, p))


def _local_confirmed(g: Sums, p: TrustParams) -> ndarray:
    return np.where(g.local, _any_confirmed(g, p), 0.0)


def _averaging(g: Sums, p: TrustParams) -> ndarray:
    if p.code_parity:
        return _ratio(g.parity.certain_score, g.n * g.parity.certain)
    return _ratio(g.believed, g.trust)


def _additive(g: Sums, p: TrustParams) -> ndarray:
    return g.parity.certain_score if p.code_parity else g.believed


def _half_additive(g: Sums, p: TrustParams) -> ndarray:
    return (g.scores + np.where(g.local, g.own, 0.0)) / 2


METHODS: dict[Method, Callable[[Sums, TrustParams], ndarray]] = {
    "trupercept_1": _trupercept_1,
    "trupercept_2": _trupercept_2,
    "trupercept_3": _trupercept_3,
    "corrected": _local,
    "trupercept_3_corrected": _trupercept_3,
    "trupercept_1_local_bias": _local_bias,
    "local": _local,
    "any": _any,
    "any_confirmed": _any_confirmed,
    "confirmed_or_local": _confirmed_or_local,
    "local_confirmed": _local_confirmed,
    "averaging": _averaging,
    "additive": _additive,
    "half_additive": _half_additive,
}
"""Score of every group by the method's name, before it is clipped to [0, 1]."""

CORRECTED: frozenset[Method] = frozenset({"corrected", "trupercept_3_corrected"})
"""Methods that take position and heading from the closest detector."""


def fuse(
    views: Views,
    groups: Groups,
    detections: Detections,
    said: Views,
    verdicts: Verdicts,
    heard: Heard,
    sight: Sight,
    distance_m: Float[ndarray, "d"],
    params: TrustParams,
) -> Fused:
    """Final score and pose of each group of each ego.

    Parameters
    ----------
    views, groups
        What the egos fuse: not cut to the sensor's area.
    said, verdicts
        All evaluations of the step; an ego uses its own and those of the vehicles it has heard.
    heard
        Rows go with `views`.
    sight
        Rows go with `groups.seeds()`.
    distance_m
        Of each detection from its own detector's sensor [m].

    Returns
    -------
    One row per group; groups opened by the ego's report of itself are left out.

    Notes
    -----
    Equations 5 and 6 of [1]_ with pairs (member, evaluator) of weight Phi T(evaluator). Formulas by method,
    and what `code_parity` makes of them: `trust/README.md`.

    Deviations: the sums run over every evaluator of every member, which the text means, not over the
    detectors alone, which the equations say; the additive sum is divided by the number of members, so that an
    object does not count once per message; "Phi < 10" in TruPercept 3 is read as fewer than 10 returns.
    """
    m = views.member.size
    num, den, detector = np.zeros(m), np.zeros(m), np.zeros(m)
    n = np.zeros(m, np.int64)
    n_vehicles = 1 + int(max(a.max(initial=-1) for a in (views.owner, said.owner, heard.vehicle, detections.sender)))
    said_by = np.full(n_vehicles, -1, np.int64)
    said_by[said.owner] = np.arange(said.owner.size)
    computed = params.code_parity or params.ego_trust_from == "computed"
    heard = _canonical(heard)
    assert np.all(heard.trust >= 0)
    judged = np.ones(heard.vehicle.size, bool) if heard.judged is None else heard.judged
    n_sums = m + heard.vehicle.size * said.member.size / max(1, said.owner.size)
    with threads_for(n_sums) as n_threads:
        _accumulate(
            int64(views.ptr), int64(views.member), int64(views.owner), len(detections),
            int64(said.ptr), int64(said.member), said_by, verdicts.e, verdicts.phi,
            int64(heard.ptr), int64(heard.vehicle), heard.trust, judged,
            params.ego_trust, computed, params.default_trust, params.code_parity,
            int64(detections.sender), n_threads, num, den, n, detector,
        )  # fmt: skip

    seeds = groups.seeds()
    group = np.searchsorted(seeds, groups.seed)
    member, row = views.member, views.member[seeds]
    own = detections.score[member]

    def total(x: ndarray) -> ndarray:
        return np.bincount(group, x, seeds.size).astype(float)  # whole numbers where there is nothing

    size = np.bincount(group, minlength=seeds.size)
    mean = params.method in AVERAGES if params.code_aggregate == "by_method" else params.code_aggregate == "mean"
    aggregate = _ratio(num, den) if mean else num
    certain = np.where(detections.is_self[member], 1.0, -1.0) * detector
    mine = np.where(detections.sender[member] == views.owner[views.of_member()], own, 0.0)
    parity = Parity(
        mean_or_own=total(np.where(n > 0, aggregate, mine)) / size,
        mean_or_score=total(np.where(n > 0, aggregate, own)) / size,
        of_seed=aggregate[seeds],
        certain=total(certain),
        certain_score=total(own * certain),
    )
    sums = Sums(
        size, groups.local[seeds], own[seeds], total(own), total(own * detector), total(detector),
        total(num), total(den), parity, sight,
    )  # fmt: skip
    score = np.clip(METHODS[params.method](sums, params), 0.0, 1.0)

    pose = row
    if params.method in CORRECTED and not params.code_parity:
        far = distance_m[member]
        if not params.self_report_poses:
            far = np.where(detections.is_self[member], np.inf, far)
        order = np.lexsort((far, group))
        pose = member[order[np.searchsorted(group[order], np.arange(seeds.size))]]
        pose = np.where(score > 0, pose, row)
    fused = Fused(
        views.of_member()[seeds], row, pose, score, sums.local, size,
        total(n.astype(float)).astype(np.int64),
    )  # fmt: skip
    return fused.take(~(sums.local & detections.is_self[row]))


def _canonical(heard: Heard) -> Heard:
    """Each ego's vehicles ascending, and once."""
    ego = np.repeat(np.arange(heard.ptr.size - 1), np.diff(heard.ptr))
    key = ego << 32 | heard.vehicle
    if np.all(key[1:] > key[:-1]):
        return heard
    key, first = np.unique(key, return_index=True)
    ptr = np.searchsorted(key >> 32, np.arange(heard.ptr.size))
    return Heard(ptr, heard.vehicle[first], heard.trust[first], None if heard.judged is None else heard.judged[first])
