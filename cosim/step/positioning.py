"""Effects of positioning errors (estimated minus true) on what a vehicle perceives and transmits."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.plane import turned_by, wrapped
from cosim.step.perception import Observed
from cosim.world import World
from sensors.boxes import Boxes


def as_estimated(
    boxes: Boxes,
    rows: Int[ndarray, "n"],
    true_m: Float[ndarray, "e 3"],
    error: Float[ndarray, "e 3"],
    back: bool = False,
) -> Boxes:
    """Boxes that a vehicle measured relative to itself, placed where it estimates them to be.

    Parameters
    ----------
    boxes
        Boxes in the world frame, relative to the vehicles' true poses.
    rows
        For each box, the row of its vehicle in `true_m` and `error`.
    true_m
        True positions of the vehicles.
    error
        Errors east [m], north [m], and of the heading [rad]: estimated minus true.
    back
        Do the opposite: place boxes of the estimated frame where they are relative to the true poses.

    Returns
    -------
    The boxes, turned around their vehicles by the error of the heading and displaced by that of the position.
    """
    xyz_m, yaw_rad = boxes.xyz_m.copy(), boxes.yaw_rad
    shift_m, turn_rad = error[rows, :2], error[rows, 2]
    if back:
        xyz_m[:, :2] -= shift_m
    if turn_rad.any():
        turn_rad = -turn_rad if back else turn_rad
        centre_m = true_m[rows, :2]
        xyz_m[:, :2] = centre_m + turned_by(turn_rad, xyz_m[:, :2] - centre_m)
        yaw_rad = wrapped(yaw_rad + turn_rad)
    if not back:
        xyz_m[:, :2] += shift_m
    return replace(boxes, xyz_m=xyz_m, yaw_rad=yaw_rad)


def as_believed(observed: Observed, world: World, rows: Int[ndarray, "e"], error: Float[ndarray, "e 3"]) -> Observed:
    """Displace and turn sensors, self-reports and detections by the errors of their vehicle.

    The surroundings keep their position relative to the vehicle. Received objects are displaced relative to them by
    the difference of two errors.

    Parameters
    ----------
    observed
        What vehicles perceived at their true positions.
    world
        All actors at their true positions.
    rows
        The vehicles' rows of the world.
    error
        As in `as_estimated`.
    """
    detections = observed.detections
    true_m, of = world.boxes.xyz_m[rows], np.searchsorted(rows, detections.observer)
    return replace(
        observed,
        sweeps=observed.sweeps.displaced(error),
        detections=replace(detections, boxes=as_estimated(detections.boxes, of, true_m, error)),
    )


def believed_world(world: World, rows: Int[ndarray, "e"], error: Float[ndarray, "e 3"]) -> World:
    """The world with equipped vehicles at their estimated poses. They compare received boxes with it.

    Parameters
    ----------
    world
        All actors at their true positions.
    rows
        Rows of the equipped vehicles.
    error
        As in `as_estimated`.
    """
    xyz_m, yaw_rad = world.boxes.xyz_m.copy(), world.boxes.yaw_rad
    xyz_m[rows, :2] += error[:, :2]
    if error[:, 2].any():
        yaw_rad = yaw_rad.copy()
        yaw_rad[rows] = wrapped(yaw_rad[rows] + error[:, 2])
    return replace(world, boxes=replace(world.boxes, xyz_m=xyz_m, yaw_rad=yaw_rad))
