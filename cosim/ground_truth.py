"""Ground truth of detections. Only this file joins it; it fills table columns that the simulation never reads."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.v2x.messages import FABRICATED, SELF, SENSED, Detections
from cosim.world import World
from sensors.boxes import iou_3d
from sensors.evidence import Observability


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Aligned with the detections of a step."""

    is_real: Bool[ndarray, "d"]  # of an existing actor: neither a false positive nor fabricated
    actor_row: Int[ndarray, "d"]  # row in the world, where real
    iou: Float[ndarray, "d"]  # with that actor's true box, where real
    occlusion: Float[ndarray, "d"]  # share of the actor hidden from the observer, where sensed
    is_sensed: Bool[ndarray, "d"]


def ground_truth_of(
    said: Detections,
    world: World,
    sights: Observability,
    observers: Int[ndarray, "e"],
    sensed_is_real: Bool[ndarray, "s"],
    sensed_actor_row: Int[ndarray, "s"],
) -> GroundTruth:
    """Ground truth of each detection.

    `sensed_is_real` and `sensed_actor_row` are aligned with the sensed detections, in the order of their keys.
    """
    sensed = said.origin == SENSED
    is_real = said.origin == SELF
    actor_row = np.where(is_real, said.observer, 0)
    is_real[sensed], actor_row[sensed] = sensed_is_real, sensed_actor_row
    assert not is_real[said.origin == FABRICATED].any()
    rows = np.flatnonzero(is_real)
    iou = np.zeros(len(said))
    iou[rows] = iou_3d(said.boxes.take(rows), world.boxes.take(actor_row[rows]))
    occlusion = np.zeros(len(said))
    rows = np.flatnonzero(sensed & is_real)
    n = len(world)
    at = np.searchsorted(observers[sights.observer] * n + sights.actor, said.observer[rows] * n + actor_row[rows])
    occlusion[rows] = sights.occlusion[at]
    return GroundTruth(is_real, actor_row, iou, occlusion, sensed & is_real)
