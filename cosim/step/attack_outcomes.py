"""What attacks achieve: for every fabricated or withheld detection, and every vehicle that it reached or was kept from.

Ground truth of a step; nothing in the simulation reads it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.radio.message_round import Receptions
from cosim.ragged import expand, stable_order
from cosim.step.senders import Senders, Vehicles
from cosim.step.stages import Listed, Matched
from cosim.v2x.messages import FABRICATED
from cosim.world import World
from results.codes import AttackEffect
from results.encounters import Rows
from sensors.boxes import Boxes
from trust.fusion import Fused

_BUCKETS = 1 << 16

PATH_M = 50.0
"""Length of a vehicle's path, straight ahead of its centre [m]: the distance to stop from 80 km/h or less."""


def attack_outcomes(
    world: World, listed: Listed, received: Receptions, matched: Matched, fused: Sequence[Fused | None],
    senders: Senders, vehicles: Vehicles,
) -> list[Rows]:  # fmt: skip
    """Columns of the table `attack_outcomes`, per trust variant that fuses.

    Parameters
    ----------
    received
        Detection messages between vehicles.
    fused
        Per trust variant.
    """
    inserted, seed = _inserted(listed, matched, senders)
    removed = _removed(listed, received, vehicles)
    detection = np.concatenate([inserted[0], removed[0]])
    receiver = np.concatenate([inserted[1], removed[1]])  # rows of vehicles, as are lists
    is_removal = np.arange(len(detection)) >= len(inserted[0])
    if not len(detection):
        return []
    objects, truth = listed.objects, listed.truth
    n = len(world)
    own = np.flatnonzero(truth.is_sensed)
    detected = np.unique(senders.vehicle[listed.detections.message[own]] * n + truth.actor_row[own])
    common = {
        "effect": np.where(is_removal, AttackEffect.REMOVED, AttackEffect.INSERTED),
        "observer": senders.pseudonym[listed.detections.message[detection]],
        "detection_index": objects.detection_index[detection],
        "receiver": vehicles.actor[receiver],
        "intended": objects.target[detection] == vehicles.row[receiver],
        "in_path": _in_path(world, vehicles.row[receiver], objects.boxes.take(detection)),
        "ego_detected": is_removal & np.isin(receiver * n + truth.actor_row[detection], detected),
    }  # fmt: skip
    rows = []
    for variant, found in enumerate(fused):
        if found is None:
            continue
        score, there = np.zeros(len(detection)), np.zeros(len(detection), bool)
        score[~is_removal], there[~is_removal] = _best(
            found.ego * len(objects) + found.seed, found.score, inserted[1] * len(objects) + seed
        )
        there[~is_removal] &= objects.origin[seed] == FABRICATED
        real = truth.is_real[found.seed]
        score[is_removal], there[is_removal] = _best(
            found.ego[real] * n + truth.actor_row[found.seed[real]], found.score[real],
            removed[1] * n + truth.actor_row[removed[0]],
        )  # fmt: skip
        rows.append({
            "variant": np.full(len(detection), variant), **common, "score": np.where(there, score, 0.0),
            "score__valid": there,
        })  # fmt: skip
    return rows


def _inserted(
    listed: Listed, matched: Matched, senders: Senders
) -> tuple[tuple[Int[ndarray, "k"], Int[ndarray, "k"]], Int[ndarray, "k"]]:
    """Fabricated detections in the lists of others: detection and list; the detection that gives its group's box."""
    known, message = matched.known, listed.detections.message
    at = np.flatnonzero((listed.objects.origin == FABRICATED)[known.member])
    of_list = known.of(at)
    foreign = senders.vehicle[message[known.member[at]]] != of_list
    at, of_list = at[foreign], of_list[foreign]
    return (known.member[at], of_list), known.member[matched.groups.seed[at]]


def _removed(listed: Listed, received: Receptions, vehicles: Vehicles) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:
    """Withheld detections of real actors, and the vehicles that received the message without them."""
    row = np.flatnonzero(listed.withheld & listed.truth.is_real)
    message = listed.detections.message[row]  # ascending
    concerned = np.zeros(len(listed.ptr), bool)
    concerned[message] = True
    found = np.flatnonzero(concerned[received.message])
    found = found[stable_order(received.message[found])]
    first, last = (np.searchsorted(received.message[found], message, side) for side in ("left", "right"))
    at, which = expand(first, last)
    receiver, detection = received.receiver[found[at]], row[which]
    other = vehicles.row[receiver] != listed.truth.actor_row[detection]  # no vehicle needs a report of itself
    return detection[other], receiver[other]


def _best(
    key: Int[ndarray, "f"], score: Float[ndarray, "f"], wanted: Int[ndarray, "k"]
) -> tuple[Float[ndarray, "k"], Bool[ndarray, "k"]]:
    """Largest score of each wanted key, and whether it has any."""
    asked = np.zeros(_BUCKETS, bool)  # few keys are wanted: the others are not sorted
    asked[wanted & _BUCKETS - 1] = True
    rows = np.flatnonzero(asked[key & _BUCKETS - 1])
    key, score = key[rows], score[rows]
    order = np.lexsort((score, key))
    key, score = key[order], score[order]
    at = np.searchsorted(key, wanted, "right") - 1
    there = at >= 0
    there[there] = key[at[there]] == wanted[there]
    return np.where(there, score[at] if len(score) else 0.0, 0.0), there


def _in_path(world: World, row: Int[ndarray, "k"], boxes: Boxes) -> Bool[ndarray, "k"]:
    """Boxes that a vehicle would drive into if it went straight on for `PATH_M`."""
    away_m = boxes.xyz_m[:, :2] - world.boxes.xyz_m[row, :2]
    cos, sin = np.cos(world.boxes.yaw_rad[row]), np.sin(world.boxes.yaw_rad[row])
    ahead_m, left_m = cos * away_m[:, 0] + sin * away_m[:, 1], cos * away_m[:, 1] - sin * away_m[:, 0]
    reach_m = (world.boxes.lwh_m[row, 1] + boxes.lwh_m[:, 1]) / 2
    return (ahead_m > 0) & (ahead_m <= PATH_M) & (np.abs(left_m) <= reach_m)
