"""Vehicles fuse the objects that they know, and drivers get what these believe."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.base.ragged import ptr_of, stable_order
from cosim.messages.content import Detections
from cosim.messages.trust_hosts import ObjectScorer
from cosim.step.comparing import ObjectGroups
from cosim.step.exchange import Exchange
from cosim.step.known import Known
from cosim.step.parts import Parts
from cosim.step.positioning import as_estimated
from cosim.step.trust import LookedUp
from cosim.traffic.driver import Beliefs
from cosim.world import World
from sensors.box_fusion.fuse import fuse_boxes
from sensors.box_fusion.views import ObjectViews, ViewLists, boxes_of_columns, overlap_p
from sensors.boxes import Boxes
from trust.fusion import Fused, fuse
from trust.object_reports import object_votes
from trust.params import TrustParams
from trust.tables import Evaluations, FusionInput, ObjectLists, SenderTrust


def fuse_objects(
    scorers: Sequence[ObjectScorer | None],
    groups: ObjectGroups,
    evaluations: tuple[ObjectLists, Evaluations, Evaluations],
    looked_up: LookedUp,
    parts: Parts,
) -> list[Fused | None]:
    """Fused objects of every vehicle that senses, per trust variant; None if they are not requested.

    `scorers` are the methods of the variants' models that score objects, as `TrustHosts.scorers` returns them, and
    `evaluations` those that the vehicles can use, as `Inbox.evaluations_used` returns them.
    """
    hosts = parts.trust
    given = FusionInput(groups.lists, groups.groups, groups.detections, *evaluations)
    wanted = [number for number, variant in enumerate(hosts.variants) if variant.fused]
    in_time = parts.config.radio.evaluations == "alone"
    trust_of = trust_in_senders(looked_up, wanted, in_time, len(groups.lists.owner))
    fused: dict[int, Fused] = {}
    votes = None
    numbers_by_mode: dict[str, list[int]] = defaultdict(list)  # variants whose boxes are fused from all detections
    for number, sender_trust in trust_of.items():
        params, scorer = hosts.variants[number].trust, scorers[number]
        if scorer is not None and votes is None:
            votes = object_votes(given, sender_trust)
        distance_m = None
        if groups.accuracy is None or params.fused_boxes == "best":
            distance_m = groups.from_own_m
        else:
            numbers_by_mode[params.fused_boxes].append(number)
        fused[number] = fuse(given, sender_trust, groups.of_seeds, distance_m, params, scorer, votes, params.min_score)
    for mode, numbers in numbers_by_mode.items():
        of_mode = {number: fused[number] for number in numbers}
        params_of = [hosts.variants[number].trust for number in numbers]
        fused |= _with_boxes(of_mode, params_of, groups, trust_of, mode)
    return [fused.get(number) for number in range(len(hosts.variants))]


def trust_in_senders(looked_up: LookedUp, wanted: Sequence[int], in_time: bool, n_egos: int) -> dict[int, SenderTrust]:
    """Trust of each vehicle that senses in the senders of all messages that it uses, by number of the trust variant.

    Without `in_time`, evaluations arrive a step after their detections, too late for fusion.
    """
    reports, further = looked_up.messages, looked_up.further
    order = stable_order(np.concatenate([reports.key(), further.key()]))
    message = np.concatenate([reports.message, further.message])[order]
    ptr = ptr_of(np.concatenate([reports.receiver, further.receiver])[order], n_egos)
    has_evaluations = (order < len(reports.message)) & in_time
    found = {}
    for number in wanted:
        in_reports, in_further = looked_up.lookups[number].trust, looked_up.of_further[number]
        trust = np.concatenate([in_reports, in_further])[order]
        own = None if looked_up.own is None else looked_up.own[number]
        found[number] = SenderTrust(ptr, message, trust, has_evaluations, own)
    return found


def _with_boxes(
    fused: Mapping[int, Fused],
    params: Sequence[TrustParams],
    groups: ObjectGroups,
    trust_of: Mapping[int, SenderTrust],
    mode: str,
) -> dict[int, Fused]:
    """The objects with boxes from all their detections, and with scores that say how well the boxes may fit.

    What a vehicle states counts by the receiver's trust in it. From the trust of a stranger on, it counts fully.

    Parameters
    ----------
    fused
        Objects by number of the trust variant.
    params
        Section [trust] of each of these variants.
    trust_of
        Trust in the senders, likewise.
    mode
        Their `fused_boxes`.
    """
    assert groups.accuracy is not None
    lists, detections = groups.lists, groups.detections
    senders = trust_of[next(iter(fused))]  # their messages are those of all variants
    known = ViewLists(
        ptr=lists.ptr,
        member=lists.member,
        owner=lists.owner,
        group=groups.groups.numbers(),
        seed=lists.member[groups.groups.seeds()],
        received_ptr=senders.ptr,
        received=senders.message,
    )
    weights, wanted = [], []
    for of_variant, (number, objects) in zip(params, fused.items(), strict=True):
        of_stranger = max(of_variant.default_trust, 1e-9)
        weights.append(np.minimum(trust_of[number].trust / of_stranger, 1.0))
        is_wanted = np.zeros(len(known.seed), bool)
        is_wanted[objects.group] = True
        wanted.append(is_wanted)
    views = ObjectViews(groups.boxes, detections.label, detections.message, groups.accuracy)
    boxes = fuse_boxes(views, known, weights, wanted, mode == "aligned")
    found = {}
    for of_variant, (number, objects), fused_boxes in zip(params, fused.items(), boxes, strict=True):
        score = objects.score
        if of_variant.least_overlap > 0:
            score = score * overlap_p(fused_boxes, of_variant.least_overlap)
        objects = replace(objects, box=fused_boxes.columns(), variance_m2=fused_boxes.variance_m2, score=score)
        found[number] = objects.take(score >= of_variant.min_score)
    return found


def boxes_of(fused: Fused, objects: Detections) -> Boxes:
    """Boxes of fused objects; `objects` are the detections that the vehicles know."""
    if fused.box is not None:
        return boxes_of_columns(fused.box)
    boxes = objects.boxes.take(fused.seed)
    pose = objects.boxes.take(fused.pose)
    return replace(boxes, xyz_m=pose.xyz_m, yaw_rad=pose.yaw_rad)


def beliefs_of(
    fused: Fused | None, exchange: Exchange, messages: Known, world: World, error: Float[ndarray, "e 3"] | None
) -> Beliefs:
    """Fused objects for the drivers, moved from the estimated to the true poses of the vehicles.

    Parameters
    ----------
    fused
        Fused objects of the acting variant.
    exchange, messages
        Vehicles of the step, and the detections that they know.
    world
        All actors at their true positions.
    error
        As `Positioned.error`.
    """
    assert fused is not None, "the acting variant is always fused"
    driven = ~exchange.world.is_roadside[exchange.sensing.row[fused.ego]]
    if not driven.all():  # roadside units do not drive
        fused = fused.take(np.flatnonzero(driven))
    objects, message = messages.objects, messages.detections.message[fused.seed]
    boxes = boxes_of(fused, objects)
    if error is not None:
        of = exchange.vehicles.senses
        true_m = world.boxes.xyz_m[exchange.vehicles.row[of]]
        boxes = as_estimated(boxes, fused.ego, true_m, error[of], back=True)
    return Beliefs(
        known_s=exchange.now.fused_s,
        ego=exchange.sensing.row[fused.ego],
        label=objects.label[fused.seed],
        boxes=boxes,
        score=fused.score,
        ego_detected=fused.ego_detected,
        source=messages.pseudonym[message],
        source_step=messages.step[message],
        source_index=objects.detection_index[fused.seed],
    )
