"""Further attacks with false objects: an approaching vehicle, a hidden one, and old or copied detections."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.attacks.attack import AttackContext, Vouched, fabricated, placed
from cosim.attacks.disguise import ghosts
from cosim.attacks.ghost_insertion import CAR
from cosim.attacks.past import of_earlier_messages
from cosim.base.bounds import NotNegative100, Positive1000
from cosim.base.ragged import differs_from_last, offsets
from cosim.messages.content import FABRICATED, SELF, Detections
from cosim.world import World
from sensors.boxes import Boxes
from sensors.line_of_sight import WallIndex, los_between_actors
from sensors.scene import Scene, Shape


@dataclass(frozen=True, kw_only=True, slots=True)
class ApproachingGhostParams:
    """Distances of the approaching ghost."""

    from_m: Positive1000 = 60.0
    """Distance from the victim's centre in the attacker's first message, straight ahead [m]."""
    step_m: Annotated[float, Ge(0.001), Le(1000)] = 5.0
    """Decrease of the distance per message [m]."""
    to_m: Positive1000 = 5.0
    """Smallest distance [m]. After it, the ghost begins again at `from_m`."""

    def __post_init__(self) -> None:
        if self.to_m >= self.from_m:
            raise ValueError(
                f"attacks.to_m = {self.to_m:g} m is not below attacks.from_m = {self.from_m:g} m, where the ghost "
                "begins. Set a smaller attacks.to_m."
            )


class ApproachingGhost(Vouched[ApproachingGhostParams]):
    """Inserts an oncoming car that comes nearer to a victim with every message, as in VASP (5 m per message).

    Notes
    -----
    Deviations: the distance is measured from the victim's position at the time of the message. The car has the size of
    a real detection (`disguise.ghosts`).
    """

    Params = ApproachingGhostParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with one ghost for each attacker that has a victim."""
        p, world = self.params, context.world
        attacker, victim = context.victims()
        n_messages = np.floor((p.from_m - p.to_m) / p.step_m + 1e-9)
        n_places = int(n_messages) + 1
        ahead_m = p.from_m - p.step_m * (context.n_active[attacker] % n_places)
        n = len(attacker)
        left_m, turn = np.zeros(n), np.full(n, np.pi)
        xyz, yaw = placed(world, victim, ahead_m, left_m, turn)
        xyz[:, 2] = ground_m(world, victim) + CAR_LWH_M[2] / 2
        boxes = Boxes(xyz, np.tile(CAR_LWH_M, (n, 1)), yaw)
        return ghosts(listed, attacker, np.full(n, CAR, np.uint8), boxes, context, victim)


def ground_m(world: World, row: Int[ndarray, "k"]) -> Float[ndarray, "k"]:
    """Height of the road below actors."""
    boxes = world.boxes
    return boxes.xyz_m[row, 2] - boxes.lwh_m[row, 2] / 2


CAR_LWH_M = (4.5, 2.0, 1.6)
"""Length, width and height of AdvCP's ghost car [m]."""
SENSOR_ABOVE_ROOF_M = 0.23
"""Height of sensors above the roof that an attacker assumes [m]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GhostInShadowParams:
    """Places at which the attacker searches."""

    n_angles: Annotated[int, Ge(1), Le(360)] = 12
    """Number of directions around the attacker in which it searches, evenly spaced, beginning straight ahead."""
    distances_m: tuple[float, ...] = (15.0, 30.0, 45.0)
    """Distances from the attacker at which it searches, in order of preference [m]."""
    seen_within_m: Positive1000 = 75.0
    """Distance within which other equipped vehicles may see the place [m]. The default is `area.range_m` plus the
    length of a car."""
    clear_m: NotNegative100 = 5.0
    """Smallest distance of the ghost from the centres of real actors [m]."""

    def __post_init__(self) -> None:
        if not self.distances_m or not all(0 < d <= 1000 for d in self.distances_m):
            raise ValueError(
                f"attacks.distances_m = {list(self.distances_m)}: give at least one distance, above 0 and up to 1000 m."
            )


class GhostInShadow(Vouched[GhostInShadowParams]):
    """Inserts a car at a place that no other equipped vehicle can see.

    The attacker searches places around it, in the order of `distances_m` and beginning straight ahead. It takes the
    first place that is outside buildings, is far enough from real actors, and is not in line of sight of another
    equipped vehicle within `seen_within_m`. Buildings and the bodies of other actors obstruct the line from the sensor
    to the centre of the ghost. If there is no such place, the attacker adds nothing. With `trust.unseen = "skip"`
    there is no evidence against such a ghost. With `trust.unseen = "zero"` it counts as 0.

    Notes
    -----
    Deviations: this attack has no source. The attacker knows the positions of all equipped vehicles from their self
    reports, and the buildings from a map. It does not use the sensors' fields of view. The car has the size of a real
    detection (`disguise.ghosts`).
    """

    Params = GhostInShadowParams

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with one ghost for each attacker that finds a place."""
        world, n_angles = context.world, self.params.n_angles
        attackers = np.flatnonzero(context.attacker)
        n_places = n_angles * len(self.params.distances_m)
        turns = 2 * np.pi * np.arange(n_angles) / n_angles
        turn = np.tile(turns, len(self.params.distances_m))
        distance_m = np.repeat(self.params.distances_m, n_angles)
        row = np.repeat(attackers, n_places)
        ahead_m = np.tile(distance_m * np.cos(turn), len(attackers))
        left_m = np.tile(distance_m * np.sin(turn), len(attackers))
        xyz, yaw = placed(world, row, ahead_m, left_m, np.zeros(len(row)))
        xyz[:, 2] = ground_m(world, row) + CAR_LWH_M[2] / 2
        hidden = self._hidden(context, row, xyz).reshape(len(attackers), n_places)
        finds = np.flatnonzero(hidden.any(axis=1))
        at = finds * n_places + hidden[finds].argmax(axis=1)
        lwh = np.tile(CAR_LWH_M, (len(at), 1))
        label = np.full(len(at), CAR, np.uint8)
        boxes = Boxes(xyz[at], lwh, yaw[at])
        return ghosts(listed, row[at], label, boxes, context)

    def _hidden(
        self, context: AttackContext, row: Int[ndarray, "c"], xyz_m: Float[ndarray, "c 3"]
    ) -> Bool[ndarray, "c"]:
        """Whether each place is free, and no equipped vehicle but the attacker can see it. `row` is the attacker."""
        world, n_places = context.world, len(xyz_m)
        hidden = np.ones(n_places, bool)
        if not n_places:
            return hidden
        actors = cKDTree(world.boxes.xyz_m[:, :2])
        places = cKDTree(xyz_m[:, :2])
        nearest_m, _ = actors.query(xyz_m[:, :2])
        hidden &= nearest_m >= self.params.clear_m
        walls = WallIndex.of(Scene.empty().buildings) if context.walls is None else context.walls
        hidden &= ~walls.indoors(xyz_m)
        near = places.sparse_distance_matrix(actors, self.params.seen_within_m, output_type="ndarray")
        place = near["i"].astype(np.int64)
        viewer = near["j"].astype(np.int64)
        is_other = world.equipped[viewer] & (viewer != row[place])
        looks = hidden[place] & is_other
        place, viewer = place[looks], viewer[looks]
        # Places are flat bodies below the centres of the ghosts. Lines end above their tops, so that they hide nothing.
        thin_m = CAR_LWH_M[2] / 2 - SENSOR_ABOVE_ROOF_M
        lower_m = CAR_LWH_M[2] / 2 - thin_m / 2
        lwh_m = np.tile([0.1, 0.1, thin_m], (n_places, 1))
        flat = Boxes(xyz_m - [0.0, 0.0, lower_m], lwh_m, np.zeros(n_places))
        boxes = Boxes.concat([world.boxes, flat])
        flat_shape = np.full(n_places, Shape.CAR, world.shape.dtype)
        shape = np.concatenate([world.shape, flat_shape])
        body = len(world) + place
        in_sight = los_between_actors(walls, boxes, shape, viewer, body, SENSOR_ABOVE_ROOF_M)
        hidden[place[in_sight]] = False
        return hidden


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayParams:
    """Which detections are replayed."""

    n_objects: Annotated[int, Gt(0), Le(255)] = 6
    """Number of detections that are replayed in each message. NextGen replays 4 to 8 messages."""
    age_s: Annotated[float, Gt(0), Le(1e4)] = 5.0
    """Largest age of replayed detections [s]. The default is NextGen's."""
    range_m: Annotated[float, Gt(0), Le(10_000)] = 400.0
    """Largest distance from the attacker to the vehicles that made them [m]. The default is NextGen's."""


class Replay(Vouched[ReplayParams]):
    """Sends other vehicles' detections of the last seconds again, as the attacker's own present detections.

    Notes
    -----
    Deviations: NextGen replays whole messages, while this attack replays single detections. They are of the oldest
    message within `age_s` of each sender that was within range then. Sender and detection are drawn at random. The
    attacker need not have received them.
    """

    Params = ReplayParams
    remembers = True

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with detections of an earlier step added to those of attackers."""
        p, world = self.params, context.world
        xy = world.boxes.xyz_m[:, :2]
        past = context.memory.setdefault("past", [])
        own_fabrications = context.member[listed.observer] & (listed.origin == FABRICATED)
        received = np.flatnonzero(listed.transmitted & ~own_fabrications)
        while past and past[0][0] < context.time_s - p.age_s - 1e-9:
            past.pop(0)
        now = listed.take(received)
        earlier = [of for of in past if len(of[1])]
        sender = now.observer
        names = world.actor[sender], world.name_key[sender]
        past.append((context.time_s, now, *names, xy[sender]))
        attackers = np.flatnonzero(context.attacker)
        if not len(attackers) or not earlier:
            return listed
        lists = [of[1] for of in earlier]
        _, _, *columns = zip(*earlier, strict=True)
        by, name_key, from_xy = map(np.concatenate, columns)
        begins = differs_from_last(by)
        n_of_step = np.array([len(said) for said in lists])
        begins[offsets(n_of_step)[:-1]] = True  # also where the next step begins
        begin = np.flatnonzero(begins)  # of each message, the oldest ones first
        size = np.diff(np.append(begin, len(by)))
        _, oldest = np.unique(by[begin], return_index=True)  # of each sender
        first, count = begin[oldest], size[oldest]
        tree = cKDTree(from_xy[first])
        near = cKDTree(xy[attackers]).sparse_distance_matrix(tree, p.range_m, output_type="ndarray")
        a, sender = near["i"], near["j"]
        order = np.lexsort((name_key[first[sender]], a))  # by name, so that no draw depends on actor numbers
        a, sender = a[order], sender[order]
        others = by[first[sender]] != world.actor[attackers[a]]
        a, sender = a[others], sender[others]
        n_near = np.bincount(a, minlength=len(attackers))
        has = np.repeat(np.flatnonzero(n_near), p.n_objects)
        draws = context.uniforms(context.name_key(attackers), n=2 * p.n_objects)
        of_sender, of_object = np.hsplit(draws[n_near > 0], 2)
        nth = _scaled(of_sender.ravel(), n_near[has])
        chosen = sender[np.searchsorted(a, has) + nth]
        source = first[chosen] + _scaled(of_object.ravel(), count[chosen])
        pair = has * np.int64(len(by)) + source
        _, once = np.unique(pair, return_index=True)
        once = np.sort(once)  # as drawn, not by actor numbers
        again = _rows_of(lists, source[once])
        return fabricated(
            listed,
            attackers[has[once]],
            again.label,
            again.boxes,
            again.score,
            n_points=again.n_points,
            velocity_mps=again.velocity_mps,
        )


def _rows_of(parts: Sequence[Detections], rows: Int[ndarray, "k"]) -> Detections:
    """These rows of all parts, which are numbered part after part."""
    begin = offsets(np.array([len(part) for part in parts]))
    of = np.searchsorted(begin, rows, "right") - 1
    found = []
    for k, part in enumerate(parts):
        mine = rows[of == k]
        found.append(part.take(mine - begin[k]))
    order = np.argsort(of, kind="stable")
    return Detections.concat(found).take(np.argsort(order, kind="stable"))


def _scaled(
    draw: Float[ndarray, "n"],
    below: Int[ndarray, "n"],
) -> Int[ndarray, "n"]:
    """Integers from 0 to `below` - 1 from uniforms in [0, 1)."""
    return np.minimum((draw * below).astype(np.int64), below - 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class StaleParams:
    """Age of the content."""

    n_messages: Annotated[int, Ge(1), Le(10_000)] = 60
    """Age of the content of every message, in messages. The default is F2MD's."""


class Stale(Vouched[StaleParams]):
    """Sends old content as new: what the attacker perceived some messages ago, including its own pose (F2MD).

    The first messages have the content of the oldest one.
    """

    Params = StaleParams
    remembers = True

    def detections(self, listed: Detections, context: AttackContext) -> Detections:
        """The lists, with own detections replaced by old ones, and the self report by the old pose."""
        world = context.world
        rows = np.flatnonzero(context.member[listed.observer] & (listed.identity == 0))
        own, by = listed.take(rows), listed.observer[rows]
        sends = np.zeros(len(world), bool)
        sends[by] = True
        past = of_earlier_messages(context, sends, own, by, self.params.n_messages)
        mine = context.own_rows(listed)
        transmitted = listed.transmitted.copy()
        transmitted[mine[listed.origin[mine] != SELF]] = False
        kept = replace(listed, transmitted=transmitted)
        if not past:
            return kept
        old = Detections.concat([of_step.take(which) for of_step, which, _ in past])
        observer = np.concatenate([row for _, _, row in past])
        observer[~context.attacker[observer]] = -1
        selves = np.flatnonzero((old.origin == SELF) & (observer >= 0))
        at = np.full(len(world), -1)
        at[observer[selves]] = selves
        of_now = at[listed.observer[mine]]
        has_old = (listed.origin[mine] == SELF) & (of_now >= 0)
        now, was = mine[has_old], of_now[has_old]
        boxes, speed = kept.boxes, kept.speed_mps.copy()
        xyz, yaw = boxes.xyz_m.copy(), boxes.yaw_rad.copy()
        xyz[now] = old.boxes.xyz_m[was]
        yaw[now] = old.boxes.yaw_rad[was]
        speed[now] = old.speed_mps[was]
        kept = replace(kept, boxes=replace(boxes, xyz_m=xyz, yaw_rad=yaw), speed_mps=speed)
        again = np.flatnonzero((old.origin != SELF) & (observer >= 0))
        said = old.take(again)
        return fabricated(
            kept,
            observer[again],
            said.label,
            said.boxes,
            said.score,
            n_points=said.n_points,
            velocity_mps=said.velocity_mps,
        )
