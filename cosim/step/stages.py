"""The stages of a step, in the order of `cosim.step.cycle.step`: plain functions of arrays and parts."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.adversary.adversary import Active
from cosim.adversary.attack import Sending
from cosim.config.config import Config
from cosim.driver.driver import Beliefs
from cosim.radio.message_round import ChannelAbuse, LinkReceptions, Receptions, Stations
from cosim.ragged import ptr_of
from cosim.step import object_lists
from cosim.step.ground_truth import GroundTruth, ground_truth_of, lies_in_detections, lies_in_evaluations
from cosim.step.object_lists import messages_of, questions_of, received_lists, subset
from cosim.step.parts import Parts
from cosim.step.perception import Observed
from cosim.step.senders import Senders, Vehicles, distinct, lists_of_identities
from cosim.v2x.cpm_generation import InclusionMemory, select_objects
from cosim.v2x.messages import SENSED, Detections, cpm_bytes, piggyback_bytes, with_motion
from cosim.v2x.pseudonyms import PseudonymState
from cosim.v2x.trust_hosts import Lookups, TrustState
from cosim.v2x.trust_server import LinkStats
from cosim.world import World
from sensors.boxes import overlapping_pairs
from sensors.evidence import in_evaluation_area
from sensors.kernel import compiled
from trust import tables
from trust.evaluation import evaluate
from trust.fusion import Fused, SensorEvidence, fuse, votes_of
from trust.matching import match
from trust.tables import EvaluationMessages, Evaluations, Groups, ObjectLists, SenderTrust
from trust.threads import threads_for

_ROWS_PER_BOX = 10
"""Rows of a table that cost as much as to find what overlaps one box."""


@dataclass(frozen=True, slots=True)
class Piggybacked:
    """Evaluations of the last step, waiting for the next detection message."""

    messages: EvaluationMessages
    sender: Int[ndarray, "v"]
    """Actor number and identity of each message's sender, as `Senders.by_actor`."""


@dataclass(frozen=True, slots=True)
class Listed:
    """What every vehicle lists, and transmits or keeps to itself; attacks included."""

    objects: Detections
    truth: GroundTruth
    detections: tables.Detections
    """The same as trust sees them: message as a row of `Senders`."""
    ptr: Int[ndarray, "m+1"]
    """Where the detections of each message begin."""
    withheld: Bool[ndarray, "d"]
    """Made by the detector, and kept from others by an attack."""
    n_dropped: Int[ndarray, "f"]
    """Detections that cannot be sent, by `DetectionFault`."""


def list_objects(
    observed: Observed, senders: Senders, included: InclusionMemory, world: World, acceleration_mps2: ndarray,
    active: Active, vehicles: Vehicles, c: Config, time_s: float,
) -> tuple[Listed, InclusionMemory]:  # fmt: skip
    """Detections as each vehicle lists them, after attacks and generation rules."""
    perceived = with_motion(observed.detections, world.speed_mps, acceleration_mps2)
    objects, n_dropped = active.detections(perceived)
    withheld = (objects.origin == SENSED) & ~objects.transmitted
    lied = lies_in_detections(perceived, objects, active.malicious(len(world)))
    if c.radio.cpm_rules == "etsi":
        chosen, included = select_objects(
            included, objects, world.actor[objects.observer].astype(np.int64) << 16 | objects.identity, time_s
        )
        objects = replace(objects, transmitted=chosen)
    truth = ground_truth_of(
        objects, world, observed.observability, vehicles.row, observed.is_real, observed.actor_row, lied
    )
    message = senders.message_of(objects, vehicles.row)
    detections, ptr = object_lists.for_trust(objects, message, len(senders))
    return Listed(objects, truth, detections, ptr, withheld, n_dropped), included


def stations_of(world: World, row: Int[ndarray, "v"], sending: Sending | None, parts: Parts) -> Stations:
    """Antennas of the vehicles in these rows of the world, and of roadside units; `sending` of those vehicles."""
    key = np.concatenate([world.name_key[row], parts.rsus.key])
    xyz_m = np.concatenate([world.boxes.xyz_m[row], parts.rsus.xyz_m])
    roof_m, mast_m = world.boxes.lwh_m[row, 2], parts.config.radio.antenna_above_roof_m
    xyz_m[: len(row), 2] += roof_m / 2 + mast_m
    above_street_m, abuse = np.concatenate([roof_m + mast_m, parts.rsus.above_street_m]), None
    if sending is not None and sending.abuses_channel().any():
        honest = Sending.plain(len(parts.rsus))
        abuse = ChannelAbuse(
            np.concatenate([sending.jam_dbm, honest.jam_dbm]), np.concatenate([sending.react_dbm, honest.react_dbm]),
            np.concatenate([sending.ignores_dcc, honest.ignores_dcc]),
        )  # fmt: skip
    return Stations(key, xyz_m, len(row), above_street_m, abuse)


def cpm_lengths(
    listed: Listed, senders: Senders, sender: Int[ndarray, "m"], piggybacked: Piggybacked | None, c: Config
) -> Int[ndarray, "m"]:
    """Length of each detection message, with the evaluations that it carries; 0 for none [B].

    `sender` names the messages' senders as `Piggybacked` does.
    """
    n_objects = np.bincount(listed.detections.message[listed.objects.transmitted], minlength=len(senders))
    n_carried = np.zeros(len(senders), np.int64)
    if piggybacked is not None:
        _, there, row = np.intersect1d(piggybacked.sender, sender, assume_unique=True, return_indices=True)
        n_carried[row] = np.diff(piggybacked.messages.ptr)[there]
    length = cpm_bytes(n_objects) + np.where(n_carried > 0, piggyback_bytes(n_carried), 0)
    return length if c.radio.cpm_rules == "all" else np.where((n_objects > 0) | (n_carried > 0), length, 0)


@dataclass(frozen=True, slots=True)
class Matched:
    """Object lists, and their members grouped into objects."""

    known: ObjectLists
    """Everything that each vehicle knows of: its own detections and those received; what it fuses."""
    groups: Groups
    """Of `known`."""
    inside: Bool[ndarray, "k"]
    """Members of `known` in the area that the vehicle evaluates."""
    lists: ObjectLists
    """These alone: what each vehicle evaluates."""
    lists_groups: Groups
    """Of `lists`."""


def match_objects(
    listed: Listed, received: Receptions, observed: Observed, senders: Senders, vehicles: Vehicles, world: World,
    c: Config,
) -> Matched:  # fmt: skip
    """One object, several sources: the lists of all vehicles, grouped by overlap."""
    objects = listed.objects
    with threads_for(_ROWS_PER_BOX * len(objects.boxes)):
        pairs = overlapping_pairs(objects.boxes, objects.label, listed.detections.message)
    known = received_lists(received, listed.ptr, objects.transmitted, senders.vehicle, senders.own)
    inside = in_evaluation_area(
        observed.sweeps, known.of_member(), objects.boxes, c.area, known.member, objects.label,
        world.boxes.take(vehicles.row),
    )  # fmt: skip
    lists = subset(known, inside)
    groups, lists_groups = (match(x, listed.detections, pairs, c.trust) for x in (known, lists))
    return Matched(known, groups, inside, lists, lists_groups)


@dataclass(frozen=True, slots=True)
class Evaluated:
    """What every vehicle thinks of the detections before it, by its own sweep; `k` as in `Matched`.

    `v` counts the members of `lists`. All identities of a vehicle evaluate the same.
    """

    n_points_known: Int[ndarray, "k"]
    plausible_known: Bool[ndarray, "k"]
    lists: ObjectLists
    """What is evaluated under each identity; the same object as in `Matched` where no vehicle has a second one."""
    n_points: Int[ndarray, "v"]
    """Returns of its own sweep inside the box."""
    plausible: Bool[ndarray, "v"]
    """Whether its own sweep allows that something stands there; asked of what it did not detect itself."""
    matched: Bool[ndarray, "v"]
    """The vehicle detected the object itself."""
    own: Evaluations
    """As each vehicle makes them."""
    reported: Evaluations
    """As each vehicle transmits them; the same object where no attack altered any."""
    lied: Bool[ndarray, "v"]
    """Transmitted otherwise than made."""
    own_messages: EvaluationMessages
    """A message per vehicle."""
    sent: EvaluationMessages
    """A message per row of `Senders`."""
    kept_messages: EvaluationMessages
    """The same rows with the evaluations that the vehicles keep."""


def evaluate_objects(
    matched: Matched, listed: Listed, observed: Observed, senders: Senders, vehicles: Vehicles, step: int,
    active: Active, parts: Parts,
) -> Evaluated:  # fmt: skip
    """Evaluation, visibility and plausibility, and the messages that carry them."""
    c = parts.config
    known, groups, lists = matched.known, matched.lists_groups, matched.lists
    foreign = np.zeros(len(known.member), bool)  # members of which a vehicle asks its sweep whether they can be there
    foreign[matched.groups.seeds()] = True
    foreign &= ~matched.groups.ego_detected
    foreign[np.flatnonzero(matched.inside)[~groups.ego_detected]] = True
    asked, counted, tested = questions_of(
        known, matched.inside, foreign, listed.objects.boxes, listed.detections, c.area
    )
    points, possible = np.zeros(len(known.member), np.int32), np.ones(len(known.member), bool)
    points[counted], possible[tested] = parts.perception.answers(observed.sweeps, asked)
    n_points, plausible, ego = points[matched.inside], possible[matched.inside], groups.ego_detected
    recall = None
    if parts.recall is not None:
        b, label = lists.member, listed.detections.label[lists.member]
        range_m = _distance_m(listed.objects.boxes.xyz_m, b, observed.sweeps.poses.origin_m, lists.of_member())
        recall = parts.recall(n_points, label, range_m)
    own = evaluate(lists, groups, listed.detections, n_points, plausible, c.trust, recall)
    reported = object_lists.as_reported(active, own, lists, listed.objects, vehicles.row)
    lied = lies_in_evaluations(own, reported)

    def carried(by: ObjectLists, values: Evaluations) -> EvaluationMessages:
        return messages_of(step, senders.pseudonym, by, listed.detections, values, listed.objects.transmitted)

    own_messages = carried(lists, own)
    lists, at = lists_of_identities(lists, senders)
    if at is not None:
        n_points, plausible, ego, lied = n_points[at], plausible[at], ego[at], lied[at]
        own, reported = (Evaluations(e.evaluation[at], e.visibility[at]) for e in (own, reported))
    kept = own_messages if at is None else carried(lists, own)
    sent = carried(lists, reported)
    return Evaluated(points, possible, lists, n_points, plausible, ego, own, reported, lied, own_messages, sent, kept)


def update_trust(
    trust: TrustState, step: int, listed: Listed, own: EvaluationMessages, carried: Piggybacked | None,
    links: LinkReceptions, begin_s: float, senders: Senders, sender: Int[ndarray, "m"], vehicles: Vehicles,
    names: PseudonymState, parts: Parts,
) -> tuple[TrustState, LinkStats]:  # fmt: skip
    """Trust learns what was transmitted, what vehicles think themselves, and the evaluations that arrived.

    Parameters
    ----------
    carried, links, begin_s
        Evaluation messages, and the round that carried them to other vehicles and to roadside units.
    sender
        Names of the messages' senders, as `Piggybacked` has them.
    """
    transmitted, detections, linkage = listed.objects.transmitted, listed.detections, parts.linkage
    message, index = detections.message[transmitted], detections.detection_index[transmitted]
    subject = linkage.subjects(names, senders.pseudonym)
    _, index = linkage.keys(names, senders.pseudonym[message], index)
    if linkage.renames:
        subject, message = distinct(subject, message)
    trust = parts.trust.open_step(trust, step, subject, message, index, detections.score[transmitted])
    trust = parts.trust.add_own(trust, linkage.messages(names, own), vehicles.actor)
    if carried is None:
        return trust, LinkStats()
    row = np.full(len(senders), -1)  # of each message of this step among those carried
    _, which, at = np.intersect1d(carried.sender, sender, assume_unique=True, return_indices=True)
    row[at] = which
    sent = linkage.messages(names, carried.messages)
    got = links.vehicles.take(row[links.vehicles.message] >= 0)
    trust = parts.trust.add_received(trust, sent, vehicles.actor[got.receiver], row[got.message])
    up = links.uplink.take(row[links.uplink.message] >= 0)
    return parts.trust.report_by_rsu(trust, sent, row[up.message], begin_s + up.received_s)


def fuse_objects(
    matched: Matched, evaluated: Evaluated, listed: Listed, observed: Observed, senders: Senders, used: Receptions,
    lookups: list[Lookups], trust: TrustState, parts: Parts,
) -> list[Fused | None]:  # fmt: skip
    """Every vehicle's final objects, per trust variant; None where they are not asked for.

    Parameters
    ----------
    used
        Messages whose senders' trust each vehicle has looked up; rows of `lookups`.
    """
    c, known, boxes = parts.config, matched.known, listed.objects.boxes
    origin_m = observed.sweeps.poses.origin_m
    seeds = matched.groups.seeds()
    away_m = _distance_m(boxes.xyz_m, known.member[seeds], origin_m, known.of(seeds))
    evidence = SensorEvidence(
        evaluated.n_points_known[seeds], evaluated.plausible_known[seeds], away_m < c.area.range_m
    )
    from_own_m = _distance_m(boxes.xyz_m, np.arange(len(boxes)), origin_m, senders.vehicle[listed.detections.message])
    ptr = ptr_of(used.receiver, len(known.owner))
    in_time = np.full(len(used.message), c.radio.evaluations == "alone")
    given = known, matched.groups, listed.detections, evaluated.lists, evaluated.own, evaluated.reported
    fused: list[Fused | None] = []
    votes = None
    for variant, found, scorer in zip(parts.trust.variants, lookups, parts.trust.scorers(trust), strict=True):
        if not variant.fused:
            fused.append(None)
            continue
        sender_trust = SenderTrust(ptr, used.message, found.trust, in_time)
        if scorer is not None and votes is None:
            votes = votes_of(*given, sender_trust)
        trust_of = variant.trust
        fused.append(fuse(*given, sender_trust, evidence, from_own_m, trust_of, scorer, votes, trust_of.min_score))
    return fused


def beliefs_of(
    fused: Fused, listed: Listed, senders: Senders, vehicles: Vehicles, position_error_m: ndarray | None, known_s: float
) -> Beliefs:
    """Fused objects as drivers see them, from where they are and not from where they believe to be."""
    boxes, pose = listed.objects.boxes.take(fused.seed), listed.objects.boxes.take(fused.pose)
    boxes = replace(boxes, xyz_m=pose.xyz_m, yaw_rad=pose.yaw_rad)
    if position_error_m is not None:
        apart_m = np.column_stack([position_error_m[fused.ego], np.zeros(len(fused.ego))])
        boxes = replace(boxes, xyz_m=boxes.xyz_m - apart_m)
    label = listed.objects.label[fused.seed]
    source = senders.pseudonym[listed.detections.message[fused.seed]], listed.objects.detection_index[fused.seed]
    return Beliefs(known_s, vehicles.row[fused.ego], label, boxes, fused.score, fused.ego_detected, *source)


@compiled
def _distance_m(a_m, i, b_m, j):
    """Distance of each row i of `a_m` from the row j of `b_m`."""
    out = np.empty(len(i))
    for k in range(len(i)):
        x, y, z = a_m[i[k], 0] - b_m[j[k], 0], a_m[i[k], 1] - b_m[j[k], 1], a_m[i[k], 2] - b_m[j[k], 2]
        out[k] = np.sqrt(x * x + y * y + z * z)
    return out
