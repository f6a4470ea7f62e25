"""What liars and broken reporters make of their detections before they say them."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from annotated_types import Ge, Gt, Le
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim import rng
from cosim.v2x.messages import FABRICATED, SENSED, Detections
from cosim.world import LABELS, MALICIOUS, UNRELIABLE, World
from sensors.boxes import Boxes

CAR, PEDESTRIAN = LABELS.index("car"), LABELS.index("pedestrian")
PEDESTRIAN_LWH_M = (0.8, 0.6, 1.75)


@dataclass(frozen=True, kw_only=True, slots=True)
class AdversaryParams:
    """The two ill behaviours of TruPercept's experiments."""

    start_s: Annotated[float, Ge(0)] = 60.0
    """Recorded time from which liars lie and broken reporters break [s]; until then they build up trust."""
    attack: Literal["car_and_pedestrian", "car", "three_cars"] = "car_and_pedestrian"
    """What a malicious vehicle inserts in front of its victim."""
    ahead_m: Annotated[float, Gt(0)] = 8.0
    """Distance of the inserted object ahead of the victim's centre [m]."""
    attack_reach_m: Annotated[float, Gt(0)] = 100.0
    """A malicious vehicle picks the nearest other equipped vehicle within this distance as victim [m]."""
    victim: str = ""
    """SUMO id of the one equipped vehicle that all liars aim at, as in the paper; empty: each picks the nearest."""
    add_p: Annotated[float, Ge(0), Le(1)] = 0.1
    """Chance, per own detection, that an unreliable vehicle adds a copy somewhere in its view."""
    remove_p: Annotated[float, Ge(0), Le(1)] = 0.1
    """Chance, per own detection, that an unreliable vehicle does not report it."""
    add_range_m: Annotated[float, Gt(0)] = 70.0
    """Farthest that an unreliable vehicle adds a copy [m]."""


INSERTED = {
    "car": ((CAR, 0.0, 0.0),),
    "car_and_pedestrian": ((CAR, 0.0, 0.0), (PEDESTRIAN, 0.0, -2.0)),
    "three_cars": ((CAR, 0.0, 0.0), (CAR, 0.0, 4.0), (CAR, 7.0, 2.0)),
}
"""Per attack: class, metres beyond `ahead_m`, metres to the victim's left."""


def tamper(seen: Detections, world: World, time_s: float, seed: int, params: AdversaryParams) -> Detections:
    """Detections as they will be said: some kept back, some invented.

    Malicious: a car (and a pedestrian, or two more cars) as large as the liar's own, oncoming, score 1, in
    front of the nearest other equipped vehicle. Unreliable: each own detection is kept back with `remove_p`,
    and copied to a random place of the reporter's forward view with `add_p` [1]_.

    Deviations: inventions have numbers of their own (the published code re-used those of real detections); the
    published code's unreliable behaviour had no effect, here it works as the paper says. The paper's attack is
    aimed at one ego vehicle by all liars; in a city every liar aims at its nearest neighbour.

    References
    ----------
    .. [1] Hurl, Cohen, Czarnecki, Waslander, "TruPercept", 2020, section "Trust Levels".
    """
    if time_s < params.start_s:
        return seen
    keyed = world.name_key[seen.observer]
    broken = world.behaviour[seen.observer] == UNRELIABLE
    omit = rng.uniforms(rng.key(seed, rng.Stream.OMISSION, world.step), keyed, seen.k)[:, 0]
    said = seen.said & ~(broken & (seen.origin == SENSED) & (omit < params.remove_p))
    honest_part = replace(seen, said=said)
    draws = rng.uniforms(rng.key(seed, rng.Stream.FABRICATION, world.step), keyed, seen.k, n=4)
    copied = np.flatnonzero(broken & (seen.origin != FABRICATED) & (draws[:, 0] < params.add_p))
    misplaced = _misplaced(seen.take(copied), draws[copied, 1:], world, params)
    invented = _in_front_of_victims(world, params)
    last = np.full(len(world), -1)
    np.maximum.at(last, seen.observer, seen.k)
    added = Detections.concat([misplaced, invented])
    return Detections.concat([honest_part, _numbered(added, last)])


def _misplaced(copied: Detections, draws: Float[ndarray, "c 3"], world: World, params: AdversaryParams) -> Detections:
    ahead = params.add_range_m * draws[:, 0]
    left = ahead * (draws[:, 1] - 0.5)
    turn = np.pi * (draws[:, 2] - 0.5)
    xyz, yaw = _relative(world, copied.observer, ahead, left, turn)
    xyz[:, 2] = copied.boxes.xyz_m[:, 2]
    return _inventions(copied.observer, copied.label, xyz, copied.boxes.lwh_m, yaw, copied.score)


def _in_front_of_victims(world: World, params: AdversaryParams) -> Detections:
    equipped = np.flatnonzero(world.equipped)
    the_one = rng.name_key("vehicle/" + params.victim)
    named = equipped[world.name_key[equipped] == the_one] if params.victim else equipped
    liars = np.flatnonzero(world.equipped & (world.behaviour == MALICIOUS))
    xy = world.boxes.xyz_m[:, :2]
    if params.victim and len(named):
        (one,) = named
        reached = np.linalg.norm(xy[liars] - xy[one], axis=1) <= params.attack_reach_m
        liars = liars[reached & (liars != one)]
        victim = np.full(len(liars), one)
    elif len(named) > 1 and len(liars):
        distance, near = cKDTree(xy[equipped]).query(xy[liars], k=2)
        nearest = equipped[near]
        other = np.where(nearest[:, 0] == liars, 1, 0)  # the liar itself is at distance 0, mostly first
        pick = np.arange(len(liars)), other
        within = distance[pick] <= params.attack_reach_m
        liars, victim = liars[within], nearest[pick][within]
    else:
        liars = victim = np.zeros(0, int)
    objects = INSERTED[params.attack]
    label = np.tile([o[0] for o in objects], len(liars)).astype(np.uint8)
    ahead = params.ahead_m + np.tile([o[1] for o in objects], len(liars))
    left = np.tile([o[2] for o in objects], len(liars))
    liars, victim = np.repeat(liars, len(objects)), np.repeat(victim, len(objects))
    xyz, yaw = _relative(world, victim, ahead, left, np.full(len(victim), np.pi))
    lwh = np.where((label == CAR)[:, None], world.boxes.lwh_m[liars], PEDESTRIAN_LWH_M)
    ground = world.boxes.xyz_m[victim, 2] - world.boxes.lwh_m[victim, 2] / 2
    xyz[:, 2] = ground + lwh[:, 2] / 2
    return _inventions(liars, label, xyz, lwh, yaw, np.ones(len(liars)))


def _relative(world: World, row: ndarray, ahead: ndarray, left: ndarray, turn: ndarray) -> tuple[ndarray, ndarray]:
    yaw = world.boxes.yaw_rad[row]
    c, s = np.cos(yaw), np.sin(yaw)
    xyz = world.boxes.xyz_m[row].copy()
    xyz[:, 0] += c * ahead - s * left
    xyz[:, 1] += s * ahead + c * left
    turned = yaw + turn
    return xyz, np.pi - np.mod(np.pi - turned, 2 * np.pi)


def _inventions(
    observer: Int[ndarray, "c"], label: ndarray, xyz: ndarray, lwh: ndarray, yaw: ndarray, score: ndarray
) -> Detections:
    n = len(observer)
    return Detections(
        observer=observer, k=np.arange(n), label=label.astype(np.uint8), boxes=Boxes(xyz, lwh, yaw),
        score=score, n_points=np.zeros(n, np.int32), origin=np.full(n, FABRICATED, np.uint8), said=np.ones(n, bool),
    )  # fmt: skip


def _numbered(added: Detections, last_k: Int[ndarray, "n"]) -> Detections:
    """Inventions numbered on from each observer's last detection."""
    first_of_observer = np.searchsorted(added.observer, added.observer)
    k = last_k[added.observer] + 1 + np.arange(len(added)) - first_of_observer
    return replace(added, k=k)
