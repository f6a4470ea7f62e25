"""A driver that brakes for fused objects that its vehicle's own sensors do not see."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from cosim.addons.driver.lane_path import ahead_on_path
from cosim.base import rng
from cosim.base.bounds import NotNegative100, NotNegative1000, Positive100, Share
from cosim.base.plane import ahead_of
from cosim.base.ragged import differs_from_last, expand
from cosim.base.rows import Rows
from cosim.traffic.driver import Beliefs, Reasons, SpeedCommands
from cosim.world import LABELS, LanePaths, World

_PEDESTRIAN = LABELS.index("pedestrian")
_ALONG = 0.5
"""Cosine of the largest angle between an object's heading and the path at which it counts as driving along it."""
_GATE_M, _FASTEST_MPS = 3.0, 40.0
"""An object of the next sweep is the same one if it is within `_GATE_M` of the expected position. If its speed is not
known yet, the distance that it could have moved at `_FASTEST_MPS` is added."""
_LEVEL_M = 3.0
"""If the bottom of an object is this much higher or lower than the vehicle's, the object is on another road."""
_PERSON_SHARES = (0.5, 1.0)
"""Times at which persons are searched for in the corridor, as shares of `persons_ahead_s`."""
_FASTEST_PERSON_MPS = 3.0
_ACCELERATION_MPS2 = 2.6
"""Largest acceleration of a car, SUMO's default. A speed that a car cannot reach in one step is not commanded."""
_EPS_S = 1e-6


@dataclass(frozen=True, kw_only=True, slots=True)
class CautiousParams:
    """Parameters of `cautious`: which drivers react, to which objects, and how."""

    share_p: Share = 1.0
    """Share of the equipped vehicles whose drivers react. Whether a driver reacts is drawn from the vehicle's name."""
    min_score: Share = 0.25
    """Smallest score of a fused object that drivers react to. Under TruPercept few real objects of one source reach
    0.5."""
    half_width_m: Positive100 = 1.5
    """Half width of the corridor along the lane path [m]. Drivers react to objects in it."""
    horizon_s: Positive100 = 4.0
    """Time ahead at the present speed [s]. Drivers react to objects that the vehicle would reach within it."""
    reaction_s: NotNegative100 = 0.5
    """Time from the fusion of an object to the first command [s]."""
    comfort_mps2: Annotated[float, Gt(0), Le(50)] = 2.5
    """Deceleration with which the driver approaches an object if there is enough distance [m/s2]."""
    emergency_mps2: Annotated[float, Gt(0), Le(50)] = 4.5
    """Largest deceleration if there is not enough distance [m/s2]. If it exceeds the limit of SUMO's vehicle type, that
    limit is lifted."""
    release_s: NotNegative1000 = 1.0
    """Time for which the driver still reacts to an object after it was last fused with enough score [s]."""
    standstill_m: NotNegative1000 = 2.5
    """Gap that the driver leaves to an object [m]. The default is that of SUMO's drivers."""
    persons_ahead_s: Annotated[float, Ge(0)] = 0.0
    """If it is above 0, drivers also brake for persons that would enter the corridor within this time at their observed
    speed [s]. Many persons walk near lanes in a city, and two noisy positions give their speeds poorly."""
    own_persons: bool = False
    """Whether drivers also brake for persons that the own detector reports. SUMO's drivers react to persons at
    crossings only."""


@dataclass(frozen=True, slots=True)
class Believed(Rows):
    """Objects that drivers track from sweep to sweep: K rows, sorted by ego."""

    ego: Int[ndarray, "k"]
    """Actor number of the vehicle that tracks the object."""
    label: UInt8[ndarray, "k"]
    xy_m: Float[ndarray, "k 2"]
    """Predicted centre of the object in this step."""
    seen_xy_m: Float[ndarray, "k 2"]
    """Centre in the sweep in which its message was first fused."""
    lw_m: Float[ndarray, "k 2"]
    yaw_rad: Float[ndarray, "k"]
    velocity_mps: Float[ndarray, "k 2"]
    """Velocity from its last positions. Except for persons, it is along the heading."""
    has_speed: Bool[ndarray, "k"]
    known_s: Float[ndarray, "k"]
    """Time at which it was first fused."""
    seen_s: Float[ndarray, "k"]
    """Time of the last sweep in which it was fused."""
    placed_s: Float[ndarray, "k"]
    """Time of the sweep in which its message was first fused."""
    source_step: Int[ndarray, "k"]
    source: Int[ndarray, "k"]
    source_index: Int[ndarray, "k"]

    def __len__(self) -> int:
        return len(self.ego)

    @staticmethod
    def of(beliefs: Beliefs, rows: Int[ndarray, "k"], world: World, dt_s: float) -> "Believed":
        """Objects that are tracked for the first time, from these rows of the beliefs. Their speeds are unknown."""
        boxes, n = beliefs.boxes, len(rows)
        ego = world.actor[beliefs.ego[rows]]
        xy_m = boxes.xyz_m[rows, :2]
        now_s = np.full(n, world.step * dt_s)
        return Believed(
            ego=ego.astype(np.int64),
            label=beliefs.label[rows],
            xy_m=xy_m,
            seen_xy_m=xy_m,
            lw_m=boxes.lwh_m[rows, :2],
            yaw_rad=boxes.yaw_rad[rows],
            velocity_mps=np.zeros((n, 2)),
            has_speed=np.zeros(n, bool),
            known_s=np.full(n, beliefs.known_s),
            seen_s=now_s,
            placed_s=now_s,
            source_step=beliefs.source_step[rows],
            source=beliefs.source[rows].astype(np.int64),
            source_index=beliefs.source_index[rows].astype(np.int64),
        )


class Cautious:
    """Follows an object in its path as a virtual leader [1]_ if others report it and its own detector does not.

    The speed of an object that drives along the path is computed from its last two positions, so that the driver reacts
    to it from the second sweep on. Everything else in the path counts as standing, including persons and oncoming
    vehicles. Between two sweeps the positions of objects are predicted from their speeds. The commanded speed is the
    largest one from which the driver can, after one step, stop behind the object with the comfortable deceleration,
    assuming that the object brakes with the same deceleration. The speed falls by no more than the emergency
    deceleration allows.

    Notes
    -----
    With b the comfortable deceleration, t the step, g the gap less the standstill gap and u the object's speed:
    v = -b t + sqrt((b t)^2 + u^2 + 2 b g).   Deviations: only the two decelerations.

    References
    ----------
    .. [1] Krauss, "Microscopic Modeling of Traffic Flow", 1998: safe speed behind a leader.
    """

    Params = CautiousParams
    LARGEST_STEP_S = 0.5

    def __init__(self, params: CautiousParams) -> None:
        self.params = params

    @property
    def memory_s(self) -> float:
        """As in `Driver`."""
        return self.params.release_s

    def commands(
        self, state: object, world: World, beliefs: Beliefs | None, dt_s: float
    ) -> tuple[Believed | None, SpeedCommands]:
        """The tracked objects, and the speeds of vehicles that must brake for one of them."""
        p, now_s, paths = self.params, world.step * dt_s, world.paths
        assert paths is not None, "the traffic offers lane paths to drivers"
        watched = state if isinstance(state, Believed) else None
        if watched is not None:
            drives = np.isin(watched.ego, world.actor[paths.row])
            recent = now_s - watched.seen_s <= p.release_s + _EPS_S
            watched = _moved(watched.take(drives & recent), dt_s)
        if beliefs is not None:
            watched = self._believe(watched, world, paths, beliefs, dt_s)
        if watched is None or not len(watched):
            return None, SpeedCommands.none()
        return watched, self._follow(watched, world, paths, now_s, dt_s)

    def _believe(
        self, watched: Believed | None, world: World, paths: LanePaths, beliefs: Beliefs, dt_s: float
    ) -> Believed | None:
        """The tracked objects after a sweep. Objects that were tracked before keep their history."""
        p, boxes = self.params, beliefs.boxes
        path = _path_of(world, paths)
        own_person = p.own_persons & (beliefs.label == _PEDESTRIAN)
        own = np.flatnonzero(beliefs.ego_detected & ~own_person)
        can = (path >= 0) & self._reacts(world)
        counts = ~beliefs.ego_detected | own_person
        counts &= beliefs.score >= p.min_score
        rows = np.flatnonzero(counts & can[beliefs.ego])
        look_m = self._look_m(world)
        rows = rows[self._within_reach(world, beliefs, rows, look_m)]
        if watched is not None and len(watched):
            watched = watched.take(~_seen_by_own(watched, beliefs, own, world))
        ego = beliefs.ego[rows]
        xy_m = boxes.xyz_m[rows, :2]
        lw_m = boxes.lwh_m[rows, :2]
        yaw_rad = boxes.yaw_rad[rows]
        path, look_m = path[ego], look_m[ego]
        gap_m, _ = ahead_on_path(paths, path, xy_m, lw_m, yaw_rad, look_m, p.half_width_m)
        steps_out = (beliefs.label[rows] == _PEDESTRIAN) & (p.persons_ahead_s > 0)
        found = Believed.of(beliefs, rows[np.isfinite(gap_m) | steps_out], world, dt_s)
        found = found.take(~_seen_by_own(found, beliefs, own, world))
        return found if watched is None or not len(watched) else _continued(watched, found)

    def _within_reach(
        self, world: World, beliefs: Beliefs, rows: Int[ndarray, "k"], look_m: Float[ndarray, "n"]
    ) -> Bool[ndarray, "k"]:
        """Whether objects are on the vehicle's level and may be within the distance that it looks ahead."""
        ego, vehicle = beliefs.ego[rows], world.boxes
        xyz_m, lwh_m = beliefs.boxes.xyz_m[rows], beliefs.boxes.lwh_m[rows]
        own_reach_m = (look_m + vehicle.lwh_m[:, 0])[ego]
        diagonal_m = np.hypot(lwh_m[:, 0], lwh_m[:, 1])
        between_m = xyz_m[:, :2] - vehicle.xyz_m[ego, :2]
        near = np.hypot(*between_m.T) <= own_reach_m + diagonal_m / 2
        footing_m = vehicle.xyz_m[:, 2] - vehicle.lwh_m[:, 2] / 2
        bottom_m = xyz_m[:, 2] - lwh_m[:, 2] / 2
        higher_m = bottom_m - footing_m[ego]
        return near & (np.abs(higher_m) <= _LEVEL_M)

    def _follow(self, watched: Believed, world: World, paths: LanePaths, now_s: float, dt_s: float) -> SpeedCommands:
        """The lowest speed that any tracked object requires, per vehicle."""
        p = self.params
        row = np.searchsorted(world.actor, watched.ego)
        path = _path_of(world, paths)[row]
        look_m = self._look_m(world)[row]
        lw_m, yaw_rad = watched.lw_m, watched.yaw_rad
        gap_m, heading = ahead_on_path(paths, path, watched.xy_m, lw_m, yaw_rad, look_m, p.half_width_m)
        is_person = watched.label == _PEDESTRIAN
        for share in _PERSON_SHARES if p.persons_ahead_s else ():
            then_m = watched.xy_m + share * p.persons_ahead_s * watched.velocity_mps
            later_m, _ = ahead_on_path(paths, path, then_m, lw_m, yaw_rad, look_m, p.half_width_m)
            gap_m = np.where(is_person & watched.has_speed, np.minimum(gap_m, later_m), gap_m)
        along = np.cos(watched.yaw_rad - heading)
        drives = (along > _ALONG) & ~is_person
        due = np.isfinite(gap_m) & (now_s >= watched.known_s + p.reaction_s - _EPS_S)
        due &= ~drives | watched.has_speed
        pace_mps = np.hypot(*watched.velocity_mps.T)
        leader_mps = np.where(drives, pace_mps * np.maximum(along, 0.0), 0.0)
        speed = world.speed_mps[row]
        bt = p.comfort_mps2 * dt_s
        free_m = np.maximum(np.where(due, gap_m, 0.0) - p.standstill_m, 0.0)
        braking = 2 * p.comfort_mps2 * free_m
        safe = -bt + np.sqrt(bt**2 + leader_mps**2 + braking)
        wanted = np.maximum(np.maximum(safe, speed - p.emergency_mps2 * dt_s), 0.0)
        must = np.flatnonzero(due & (wanted < speed + _ACCELERATION_MPS2 * dt_s))
        watched, wanted, gap_m = watched.take(must), wanted[must], gap_m[must]
        order = np.lexsort((watched.source_index, watched.source, wanted, watched.ego))
        lowest = order[differs_from_last(watched.ego[order])]  # of each vehicle
        cause = watched.take(lowest)
        reasons = Reasons(cause.source_step, cause.source, cause.source_index, gap_m[lowest])
        return SpeedCommands(cause.ego, wanted[lowest], reasons)

    def _reacts(self, world: World) -> Bool[ndarray, "n"]:
        """Actors whose drivers react."""
        drawn = rng.uniforms(rng.key(0, rng.Stream.DRIVER), world.name_key)
        return drawn[:, 0] < self.params.share_p

    def _look_m(self, world: World) -> Float[ndarray, "n"]:
        """Distance that each actor looks ahead: the horizon, and at least twice the standstill gap."""
        return np.maximum(world.speed_mps * self.params.horizon_s, 2 * self.params.standstill_m)


def _path_of(world: World, paths: LanePaths) -> Int[ndarray, "n"]:
    """Row of `paths` of each actor; -1 if it has none."""
    path = np.full(len(world), -1)
    path[paths.row] = np.arange(len(paths.row))
    return path


def _moved(watched: Believed, dt_s: float) -> Believed:
    """The objects after one step at their present velocity."""
    return replace(watched, xy_m=watched.xy_m + watched.velocity_mps * dt_s)


def _pairs(
    a: Int[ndarray, "a"],
    b: Int[ndarray, "b"],
) -> tuple[ndarray, ndarray]:
    """Rows of all pairs of equal numbers in `a` and `b`, sorted by row of `a`."""
    order = np.argsort(b, kind="stable")
    first, stop = (np.searchsorted(b[order], a, side) for side in ("left", "right"))
    at, which = expand(first, stop)
    return which, order[at]


def _seen_by_own(watched: Believed, beliefs: Beliefs, own: Int[ndarray, "o"], world: World) -> Bool[ndarray, "k"]:
    """Whether the own detector reports something at each object: the centres are at most half a length apart."""
    row, other = _pairs(watched.ego, world.actor[beliefs.ego[own]])
    seen = beliefs.boxes.take(own[other])
    between_m = watched.xy_m[row] - seen.xyz_m[:, :2]
    lengths_m = watched.lw_m[row, 0] + seen.lwh_m[:, 0]
    near = np.hypot(*between_m.T) <= lengths_m / 4
    return np.bincount(row[near], minlength=len(watched)) > 0


def _continued(watched: Believed, found: Believed) -> Believed:
    """Merge new objects with those that were tracked before. Objects that are not found again are kept for a while."""
    new, old = _pairs(found.ego, watched.ego)
    again = _same_message(found, new, watched, old)
    moved_m = found.xy_m[new] - watched.xy_m[old]
    away_m = np.where(again, 0.0, np.hypot(*moved_m.T))
    since_s = found.seen_s[new] - watched.placed_s[old]
    gate_m = _GATE_M + np.where(watched.has_speed[old], 0.0, _FASTEST_MPS * since_s)
    same = (away_m <= gate_m) & (found.label[new] == watched.label[old])
    pairs = np.flatnonzero(same)
    keys = old, ~again, away_m, new
    order = pairs[np.lexsort([key[pairs] for key in keys])]
    nearest = order[differs_from_last(new[order])]
    new, old, again = new[nearest], old[nearest], again[nearest]
    moved_m = found.seen_xy_m[new] - watched.seen_xy_m[old]
    is_person = found.label[new] == _PEDESTRIAN
    shown = _possible(moved_m / since_s[nearest, None], found.yaw_rad[new], is_person)
    before = np.where(watched.has_speed[old, None], watched.velocity_mps[old], shown)
    velocity = found.velocity_mps.copy()
    has_speed = found.has_speed.copy()
    known_s = found.known_s.copy()
    velocity[new] = (before + shown) / 2
    has_speed[new] = True
    known_s[new] = watched.known_s[old]
    found = replace(found, velocity_mps=velocity, has_speed=has_speed, known_s=known_s)
    found = _repeated(found, new[again], watched, old[again])
    left = np.setdiff1d(np.arange(len(watched)), old)
    both = Believed.concat([found, watched.take(left)])
    return both.take(np.lexsort((both.source_index, both.source, both.ego)))


def _possible(
    velocity_mps: Float[ndarray, "n 2"], yaw_rad: Float[ndarray, "n"], is_person: Bool[ndarray, "n"]
) -> Float[ndarray, "n 2"]:
    """Velocities without their impossible part: vehicles drive forward, and persons are not faster than they run."""
    heading = ahead_of(yaw_rad)
    along_mps = np.sum(velocity_mps * heading, axis=1)
    forward_mps = np.clip(along_mps, 0, _FASTEST_MPS)
    pace_mps = np.maximum(np.hypot(*velocity_mps.T), 1e-9)
    share = np.minimum(1, _FASTEST_PERSON_MPS / pace_mps)
    of_person = velocity_mps * share[:, None]
    return np.where(is_person[:, None], of_person, forward_mps[:, None] * heading)


def _same_message(
    found: Believed, new: Int[ndarray, "p"], watched: Believed, old: Int[ndarray, "p"]
) -> Bool[ndarray, "p"]:
    """Whether pairs of objects come from the same detection: a vehicle may sense more often than the sender."""
    same = found.source[new] == watched.source[old]
    same &= found.source_index[new] == watched.source_index[old]
    return same & (found.source_step[new] == watched.source_step[old])


def _repeated(found: Believed, new: Int[ndarray, "r"], watched: Believed, old: Int[ndarray, "r"]) -> Believed:
    """The objects `found`, of which `new` say once more what is known: their positions show no speed.

    They keep what their message showed first. Where the speed is known, they are at the predicted position.
    """
    kept = {}
    for name in ("seen_xy_m", "placed_s", "velocity_mps", "has_speed"):
        kept[name] = getattr(found, name).copy()
        kept[name][new] = getattr(watched, name)[old]
    xy_m = found.xy_m.copy()
    is_predicted = watched.has_speed[old]
    xy_m[new[is_predicted]] = watched.xy_m[old[is_predicted]]
    return replace(found, xy_m=xy_m, **kept)
