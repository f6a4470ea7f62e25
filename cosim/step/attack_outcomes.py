"""Success of attacks, for every fabricated or withheld detection and every vehicle that received the message.

This is ground truth. Nothing in the simulation reads it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.codes import AttackEffect
from cosim.base.plane import turned_by
from cosim.base.ragged import expand, stable_order
from cosim.messages.content import FABRICATED, Detections
from cosim.step.comparing import Compared
from cosim.step.exchange import Exchange
from cosim.step.ground_truth import GroundTruth
from cosim.step.known import Known
from cosim.world import World
from results.encounters import Rows
from sensors.boxes import Boxes
from trust.fusion import Fused

_BUCKETS = 1 << 16

PATH_M = 50.0
"""Length of a vehicle's path, straight ahead of its centre [m]: the distance to stop from 80 km/h or less."""


@dataclass(frozen=True, slots=True)
class Inserted:
    """Fabricated detections in the object lists of other vehicles."""

    detection: Int[ndarray, "k"]
    receiver: Int[ndarray, "k"]
    """Row of the vehicles that sense, and of the object list."""
    seed: Int[ndarray, "k"]
    """The detection whose box represents the group."""


@dataclass(frozen=True, slots=True)
class Removed:
    """Withheld detections of real actors, and the vehicles that received the messages without them."""

    detection: Int[ndarray, "k"]
    receiver: Int[ndarray, "k"]
    """Row of the vehicles that sense."""


def attack_outcomes(
    exchange: Exchange, believed: World, messages: Known, compared: Compared, fused: Sequence[Fused | None]
) -> list[Rows]:
    """Rows of the table `attack_outcomes`.

    Parameters
    ----------
    exchange
        Vehicles, senders and attacks of the step.
    believed
        The world with vehicles at their estimated positions.
    messages
        The detections that vehicles know.
    compared
        What vehicles found about these.
    fused
        Fused objects per trust variant; None for a variant that does not fuse.

    Returns
    -------
    Columns of the table, one item per trust variant that fuses; empty if no attack reached a vehicle.
    """
    vehicles, objects, truth, n = exchange.sensing, messages.objects, messages.truth, len(believed)
    inserted, removed = _inserted(exchange, messages, compared), _removed(exchange, messages)
    detection = np.concatenate([inserted.detection, removed.detection])
    receiver = np.concatenate([inserted.receiver, removed.receiver])
    if not len(detection):
        return []
    is_removal = np.arange(len(detection)) >= len(inserted.detection)
    message, senders = messages.detections.message, exchange.senders
    own = np.flatnonzero(truth.is_sensed[: messages.ptr[len(senders)]])
    observer = senders.source[message[own]]
    detected = np.unique(observer * n + truth.actor_row[own])
    common = {
        "effect": np.where(is_removal, AttackEffect.REMOVED, AttackEffect.INSERTED),
        "observer": messages.pseudonym[message[detection]],
        "detection_step": messages.detection_step(detection),
        "detection_index": objects.detection_index[detection],
        "receiver": vehicles.actor[receiver],
        "intended": objects.target[detection] == vehicles.row[receiver],
        "in_path": _in_path(believed.boxes.take(vehicles.row[receiver]), objects.boxes.take(detection)),
        "ego_detected": is_removal & np.isin(receiver * n + truth.actor_row[detection], detected),
    }
    rows = []
    for variant, found in enumerate(fused):
        if found is None:
            continue
        scores = _scores_of_inserted(found, inserted, objects), _scores_of_removed(found, removed, truth, n)
        score, there = (np.concatenate(columns) for columns in zip(*scores, strict=True))
        rows.append(
            {
                "variant": np.full(len(detection), variant),
                **common,
                "score": np.where(there, score, 0.0),
                "score__valid": there,
            }
        )
    return rows


def _scores_of_inserted(
    fused: Fused, inserted: Inserted, objects: Detections
) -> tuple[Float[ndarray, "k"], Bool[ndarray, "k"]]:
    """Score of the fused object that each fabricated detection became, and whether there is one."""
    key = fused.ego * len(objects) + fused.seed
    wanted = inserted.receiver * len(objects) + inserted.seed
    score, there = _best(key, fused.score, wanted)
    return score, there & (objects.origin[inserted.seed] == FABRICATED)


def _scores_of_removed(
    fused: Fused, removed: Removed, truth: GroundTruth, n: int
) -> tuple[Float[ndarray, "k"], Bool[ndarray, "k"]]:
    """Score of the receiver's fused object for each withheld actor, and whether there is one."""
    real = truth.is_real[fused.seed]
    fused_actor = truth.actor_row[fused.seed[real]]
    key = fused.ego[real] * n + fused_actor
    wanted = removed.receiver * n + truth.actor_row[removed.detection]
    return _best(key, fused.score[real], wanted)


def _inserted(exchange: Exchange, messages: Known, compared: Compared) -> Inserted:
    lies = compared.fabricated
    sender = messages.vehicle[messages.detections.message[lies.detection]]
    lies = lies.take(sender != exchange.vehicles.senses[lies.list])
    return Inserted(lies.detection, lies.list, lies.seed)


def _removed(exchange: Exchange, messages: Known) -> Removed:
    received = messages.received
    row = np.flatnonzero(messages.withheld & messages.truth.is_real)
    message = messages.detections.message[row]  # ascending
    concerned = np.zeros(len(messages.ptr), bool)
    concerned[message] = True
    found = np.flatnonzero(concerned[received.message])
    found = found[stable_order(received.message[found])]
    of_found = received.message[found]
    first = np.searchsorted(of_found, message, "left")
    last = np.searchsorted(of_found, message, "right")
    at, which = expand(first, last)
    receiver, detection = received.receiver[found[at]], row[which]
    is_other = exchange.sensing.row[receiver] != messages.truth.actor_row[detection]  # not of itself
    return Removed(detection[is_other], receiver[is_other])


def _best(
    key: Int[ndarray, "f"], score: Float[ndarray, "f"], wanted: Int[ndarray, "k"]
) -> tuple[Float[ndarray, "k"], Bool[ndarray, "k"]]:
    """Largest score of each wanted key, and whether there is one."""
    asked = np.zeros(_BUCKETS, bool)  # few keys are wanted, so the other keys are dropped before sorting
    asked[wanted & _BUCKETS - 1] = True
    rows = np.flatnonzero(asked[key & _BUCKETS - 1])
    key, score = key[rows], score[rows]
    order = np.lexsort((score, key))
    key, score = key[order], score[order]
    at = np.searchsorted(key, wanted, "right") - 1
    there = at >= 0
    there[there] = key[at[there]] == wanted[there]
    return np.where(there, score[at] if len(score) else 0.0, 0.0), there


def _in_path(own: Boxes, boxes: Boxes) -> Bool[ndarray, "k"]:
    """Whether each vehicle would hit the box in the same row if it drove straight on for `PATH_M`."""
    away_m = boxes.xyz_m[:, :2] - own.xyz_m[:, :2]
    ahead_m, left_m = turned_by(-own.yaw_rad, away_m).T
    turn_rad = boxes.yaw_rad - own.yaw_rad
    length_m, width_m, _ = boxes.lwh_m.T
    across_m = length_m * np.abs(np.sin(turn_rad))
    across_m += width_m * np.abs(np.cos(turn_rad))
    reach_m = (own.lwh_m[:, 1] + across_m) / 2
    return (ahead_m > 0) & (ahead_m <= PATH_M) & (np.abs(left_m) <= reach_m)
