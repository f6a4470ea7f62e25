"""Ground truth of detections. Only this file joins it. It fills table columns that the simulation never reads."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.base.plane import wrapped
from cosim.base.ragged import rows_of
from cosim.base.rows import Rows
from cosim.messages.content import FABRICATED, SELF, SENSED, Detections
from cosim.step.perception import Observed
from cosim.world import World
from sensors.boxes import iou_3d
from trust.tables import Evaluations


@dataclass(frozen=True, slots=True)
class GroundTruth(Rows):
    """Ground truth of the detections of a step; rows are aligned with the detections."""

    is_real: Bool[ndarray, "d"]
    """The actor exists: neither a false positive nor fabricated."""
    actor_row: Int[ndarray, "d"]
    """Row of the actor in the world, if real."""
    iou: Float[ndarray, "d"]
    """With the actor's true box, if real."""
    occlusion: Float[ndarray, "d"]
    """Share of the actor that is hidden from the observer, if sensed."""
    is_sensed: Bool[ndarray, "d"]
    lied: Bool[ndarray, "d"]
    """The sent detection differs from the perceived one by more than noise."""
    is_phantom: Bool[ndarray, "d"]
    """An object of an attacker made the observer's detector report it."""


def ground_truth_of(
    said: Detections,
    world: World,
    observed: Observed,
    observers: Int[ndarray, "e"],
    lied: Bool[ndarray, "d"],
) -> GroundTruth:
    """Ground truth of each detection.

    Parameters
    ----------
    said
        Detections as vehicles list them.
    world
        All actors.
    observed
        What vehicles perceive, and its ground truth.
    observers
        Rows of the world of the vehicles that sense.
    lied
        Whether each detection is a lie, as `lies_in_detections` finds it.
    """
    sensed = said.origin == SENSED
    is_real = said.origin == SELF
    actor_row = np.where(is_real, said.observer, 0)
    is_real[sensed], actor_row[sensed] = observed.is_real, observed.actor_row
    assert not is_real[said.origin == FABRICATED].any()
    rows = np.flatnonzero(is_real)
    iou = np.zeros(len(said))
    true_boxes = world.boxes.take(actor_row[rows])
    iou[rows] = iou_3d(said.boxes.take(rows), true_boxes)
    occlusion = np.zeros(len(said))
    rows = np.flatnonzero(sensed & is_real)
    sights = observed.observability
    pair_of_sight = observers[sights.observer] * len(world) + sights.actor
    pair = said.observer[rows] * len(world) + actor_row[rows]
    occlusion[rows] = sights.occlusion[np.searchsorted(pair_of_sight, pair)]
    is_phantom = np.zeros(len(said), bool)
    if observed.caused_by is not None:
        is_phantom[sensed] = observed.caused_by >= 0
    return GroundTruth(
        is_real=is_real,
        actor_row=actor_row,
        iou=iou,
        occlusion=occlusion,
        is_sensed=sensed & is_real,
        lied=lied,
        is_phantom=is_phantom,
    )


NOISE_M, NOISE_RAD, NOISE_SIZE, NOISE_SCORE, NOISE_MPS = 0.5, np.radians(10.0), 0.2, 0.1, 0.5
"""A larger change of a box is a lie: position, heading, relative size, score, and speed, velocity or acceleration.
Stated standard deviations are compared like sizes."""

NOISE_EVALUATION = 0.1
"""A larger change of an evaluation times its visibility is a lie."""


def lies_in_detections(perceived: Detections, sent: Detections, on_purpose: Bool[ndarray, "n"]) -> Bool[ndarray, "d"]:
    """Which sent detections are lies: fabricated, falsified by more than noise, or withheld.

    A detection that a fault removes is not a lie, because it looks like one that the sensor missed.

    Parameters
    ----------
    perceived
        Detections as vehicles perceive them, sorted by their key.
    sent
        The same lists after attacks have changed, hidden and added detections.
    on_purpose
        By row of the world, whether the actor attacks on purpose.

    Returns
    -------
    Aligned with `sent`.
    """
    lied = np.ones(len(sent), bool)
    at, is_there = rows_of(sent.numbers(), perceived.numbers())
    same = (sent.origin != FABRICATED) & (sent.identity == 0) & is_there
    rows = np.flatnonzero(same)
    now, perceived = sent.take(rows), perceived.take(at[rows])
    a, b = now.boxes, perceived.boxes
    moved_m = np.linalg.norm(a.xyz_m - b.xyz_m, axis=1)
    turned = np.abs(wrapped(a.yaw_rad - b.yaw_rad))
    resized = np.abs(a.lwh_m / b.lwh_m - 1)
    changed = (moved_m > NOISE_M) | (turned > NOISE_RAD)
    changed |= (resized > NOISE_SIZE).any(axis=1)
    changed |= now.label != perceived.label
    changed |= np.abs(now.score - perceived.score) > NOISE_SCORE
    changed |= np.abs(now.speed_mps - perceived.speed_mps) > NOISE_MPS  # false if there is no speed
    changed |= np.abs(now.acceleration_mps2 - perceived.acceleration_mps2) > NOISE_MPS
    changed |= np.linalg.norm(now.velocity_mps - perceived.velocity_mps, axis=1) > NOISE_MPS
    was_known = ~np.isnan(perceived.velocity_mps).any(axis=1)
    is_known = ~np.isnan(now.velocity_mps).any(axis=1)
    changed |= is_known & ~was_known  # made up
    changed |= np.abs(np.log(now.accuracy_factor)) > np.log1p(NOISE_SIZE)
    withheld = perceived.transmitted & ~now.transmitted & on_purpose[now.observer]
    lied[rows] = changed | withheld
    return lied


def lies_in_evaluations(own: Evaluations, reported: Evaluations) -> Bool[ndarray, "m"]:
    """Which reported evaluations are lies: evaluation times visibility differs by more than `NOISE_EVALUATION`.

    Parameters
    ----------
    own
        Evaluations as vehicles make them.
    reported
        The same rows as they are sent. No row is a lie if this is `own` itself.
    """
    if reported is own:
        return np.zeros(len(own.evaluation), bool)
    made, sent = (e.evaluation * e.visibility for e in (own, reported))
    return np.abs(sent - made) > NOISE_EVALUATION
