"""More objects that are not there: an approaching vehicle, and content that was true elsewhere or before."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.adversary.attack import AttackContext, EvaluationRows, certified, fabricated, placed
from cosim.adversary.ghost_insertion import CAR
from cosim.v2x.messages import FABRICATED, SELF, Detections
from sensors.boxes import Boxes


class Vouched:
    """Attacks whose vehicles vouch for what they fabricate: evaluation and visibility 1."""

    def evaluations(
        self, rows: EvaluationRows, detections: Detections, context: AttackContext
    ) -> tuple[ndarray, ndarray]:
        """The fabricated vouched for."""
        return certified(rows, detections, context)


@dataclass(frozen=True, kw_only=True, slots=True)
class ApproachingGhostParams:
    """How a ghost comes nearer."""

    from_m: Annotated[float, Gt(0), Le(1000)] = 60.0
    """Distance ahead of the victim's centre in the attacker's first message [m]."""
    step_m: Annotated[float, Ge(0.001), Le(1000)] = 5.0
    """Nearer by this in every further message [m]."""
    to_m: Annotated[float, Gt(0), Le(1000)] = 5.0
    """At this distance it begins anew [m]."""

    def __post_init__(self) -> None:
        if self.to_m >= self.from_m:
            raise ValueError(
                f"attacks.to_m = {self.to_m:g} m is not below attacks.from_m = {self.from_m:g} m, where the ghost "
                "begins. Lower it."
            )


class ApproachingGhost(Vouched):
    """An oncoming car that comes nearer to a victim with every message, as in VASP (5 m per message).

    Notes
    -----
    Deviations: the distance is to the victim's place at the time of the message; the car is 4.5 x 2 x 1.6 m, as in
    AdvCP.
    """

    Params = ApproachingGhostParams

    def __init__(self, params: ApproachingGhostParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """One ghost for each attacker with a victim."""
        p, world = self.params, context.world
        attacker, victim = context.victims()
        n_places = int(np.floor((p.from_m - p.to_m) / p.step_m)) + 1
        ahead_m = p.from_m - p.step_m * (context.n_active[attacker] % n_places)
        n = len(attacker)
        lwh = np.tile(CAR_LWH_M, (n, 1))
        xyz, yaw = placed(world, victim, ahead_m, np.zeros(n), np.full(n, np.pi))
        xyz[:, 2] = world.boxes.xyz_m[victim, 2] - world.boxes.lwh_m[victim, 2] / 2 + lwh[:, 2] / 2
        return fabricated(listed, attacker, np.full(n, CAR), Boxes(xyz, lwh, yaw), np.ones(n), victim)


CAR_LWH_M = (4.5, 2.0, 1.6)
"""Ghost car of AdvCP [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayParams:
    """What is said again."""

    n_objects: Annotated[int, Gt(0), Le(255)] = 6
    """Detections replayed in each message; NextGen replays 4 to 8 messages."""
    age_s: Annotated[float, Gt(0), Le(1e4)] = 5.0
    """How old they are at most [s]; default as in NextGen."""
    range_m: Annotated[float, Gt(0), Le(10_000)] = 400.0
    """Largest distance from the attacker to those who made them [m]; default as in NextGen."""


class Replay(Vouched):
    """Others' detections of the last seconds, sent again as the attacker's own of now.

    Notes
    -----
    Deviations: NextGen replays whole messages; here it is detections, of senders within range in the oldest step within
    `age_s`, sender and detection by chance. It is not asked whether the attacker received them.
    """

    Params = ReplayParams

    def __init__(self, params: ReplayParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Rows of an earlier step added to the attackers' lists."""
        p, world = self.params, context.world
        xy = world.boxes.xyz_m[:, :2]
        past = context.memory.setdefault("past", [])
        own_fabrications = context.member[listed.observer] & (listed.origin == FABRICATED)
        received = np.flatnonzero(listed.transmitted & ~own_fabrications)
        while past and past[0][0] < context.time_s - p.age_s - 1e-9:
            past.pop(0)
        old = past[0] if past else None
        now = listed.take(received)
        past.append((context.time_s, now, world.actor[now.observer], world.name_key[now.observer], xy[now.observer]))
        if old is None or not len(old[1]):
            return listed
        _, said, by, name_key, from_xy = old
        attackers = np.flatnonzero(context.attacker)
        first = np.flatnonzero(np.append(True, by[1:] != by[:-1]))  # of each sender's detections
        count = np.diff(np.append(first, len(by)))
        tree = cKDTree(from_xy[first])
        near = cKDTree(xy[attackers]).sparse_distance_matrix(tree, p.range_m, output_type="ndarray")
        a, sender = near["i"], near["j"]
        order = np.lexsort((name_key[first[sender]], a))  # by name, so that no draw depends on actor numbers
        a, sender = a[order], sender[order]
        others = by[first[sender]] != world.actor[attackers[a]]
        a, sender = a[others], sender[others]
        n_near = np.bincount(a, minlength=len(attackers))
        has = np.repeat(np.flatnonzero(n_near), p.n_objects)
        draws = context.uniforms(context.name_key(attackers), n=2 * p.n_objects).reshape(len(attackers), 2, -1)
        one, other = draws[n_near > 0, 0].ravel(), draws[n_near > 0, 1].ravel()
        chosen = sender[np.searchsorted(a, has) + _scaled(one, n_near[has])]
        source = first[chosen] + _scaled(other, count[chosen])
        _, once = np.unique(has * np.int64(len(by)) + source, return_index=True)
        once = np.sort(once)  # as drawn, not by actor numbers
        again = said.take(source[once])
        return fabricated(listed, attackers[has[once]], again.label, again.boxes, again.score)


def _scaled(draw: Float[ndarray, "n"], below: Int[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Integers from 0 to `below` - 1 from uniforms in [0, 1)."""
    return np.minimum((draw * below).astype(np.int64), below - 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class StaleParams:
    """How old content is."""

    n_messages: Annotated[int, Ge(1), Le(10_000)] = 60
    """Every message has the content of the one that was due so many messages ago; default as in F2MD."""


class Stale(Vouched):
    """Old content: what the attacker perceived some messages ago, itself included, sent as of now [F2MD].

    Before there are so many messages, the oldest is sent.
    """

    Params = StaleParams

    def __init__(self, params: StaleParams) -> None:
        self.params = params

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """Own rows hidden, old ones added; the self report stands where the vehicle was then."""
        world = context.world
        rows = np.flatnonzero(context.member[listed.observer] & (listed.identity == 0))
        past = context.memory.setdefault("past", [])
        own = listed.take(rows)
        past.append((own, world.actor[own.observer]))
        del past[: -self.params.n_messages - 1]
        mine = context.own_rows(listed)
        oldest = _oldest(past, world.actor[context.attacker])
        transmitted = listed.transmitted.copy()
        transmitted[mine[listed.origin[mine] != SELF]] = False
        kept = replace(listed, transmitted=transmitted)
        if oldest is None:
            return kept
        old, by = oldest
        row_of = np.full(int(max(by.max(initial=-1), world.actor.max())) + 1, -1)
        row_of[world.actor] = np.arange(len(world))
        observer = row_of[by]
        selves = np.flatnonzero((old.origin == SELF) & (observer >= 0))
        at = np.full(len(world), -1)
        at[observer[selves]] = selves
        now = mine[(listed.origin[mine] == SELF) & (at[listed.observer[mine]] >= 0)]
        was = at[listed.observer[now]]
        xyz, yaw, speed = kept.boxes.xyz_m.copy(), kept.boxes.yaw_rad.copy(), kept.speed_mps.copy()
        xyz[now], yaw[now], speed[now] = old.boxes.xyz_m[was], old.boxes.yaw_rad[was], old.speed_mps[was]
        kept = replace(kept, boxes=replace(kept.boxes, xyz_m=xyz, yaw_rad=yaw), speed_mps=speed)
        again = np.flatnonzero((old.origin != SELF) & (observer >= 0))
        said = old.take(again)
        return fabricated(kept, observer[again], said.label, said.boxes, said.score)


def _oldest(past: list, actor: ndarray) -> tuple[Detections, ndarray] | None:
    """The oldest list of each of these actors that is remembered, and whose it is."""
    left, parts, by = actor, [], []
    for listed, of in past:
        here = np.isin(of, left)
        if here.any():
            parts.append(listed.take(np.flatnonzero(here)))
            by.append(of[here])
            left = np.setdiff1d(left, of[here])
        if not len(left):
            break
    if not parts:
        return None
    columns = [c for c in zip(*(part.columns() for part in parts), strict=True)]
    joined = Detections.of([Boxes.concat(c) if isinstance(c[0], Boxes) else np.concatenate(c) for c in columns])
    return joined, np.concatenate(by)
