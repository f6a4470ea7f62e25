"""Vehicles fuse the objects that they know, and drivers get what these believe."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from cosim.messages.content import (
    Detections,
)
from cosim.messages.trust_hosts import TrustState
from cosim.step.comparing import FusionOf, Used
from cosim.step.evaluate import Matched
from cosim.step.exchange import Exchange
from cosim.step.known import Known
from cosim.step.parts import Parts
from cosim.step.positioning import as_estimated
from cosim.step.trust import LookedUp
from cosim.traffic.driver import Beliefs
from cosim.world import World
from sensors.box_fusion import boxes_of_columns
from sensors.boxes import Boxes
from trust.fusion import Fused
from trust.tables import Evaluations, ObjectLists


def fuse_objects(
    trust: TrustState,
    matched: Matched,
    evaluations: tuple[ObjectLists, Evaluations, Evaluations],
    looked_up: LookedUp,
    parts: Parts,
) -> list[Fused | None]:
    """Fused objects of every vehicle that senses, per trust variant; None if they are not requested.

    `evaluations` are those that the vehicles can use, as `Inbox.evaluations_used` returns them.
    """
    hosts, in_time = parts.trust, parts.config.radio.evaluations == "alone"
    variants = {
        number: FusionOf(found.trust, variant.trust, scorer)
        for number, (variant, found, scorer) in enumerate(
            zip(hosts.variants, looked_up.lookups, hosts.scorers(trust), strict=True)
        ) if variant.fused
    }  # fmt: skip
    used = Used(looked_up.messages, in_time, *evaluations, matched.from_own_m)
    found = dict(zip(variants, matched.objects.fuse(used, list(variants.values())), strict=True))
    return [found.get(number) for number in range(len(hosts.variants))]


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
        boxes = as_estimated(boxes, fused.ego, world.boxes.xyz_m[exchange.vehicles.row[of]], error[of], back=True)
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
