"""Effects of position errors (estimated minus true) on what a vehicle perceives and transmits."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.step.perception import Observed
from cosim.world import World


def as_believed(observed: Observed, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> Observed:
    """Displace sensors, self-reports and detections by the position error of their vehicle.

    The surroundings keep their position relative to the vehicle. Received objects are displaced relative to them by
    the difference of two position errors.

    Parameters
    ----------
    observed
        What vehicles perceived at their true positions.
    rows
        The vehicles' rows of the world.
    error_m
        Position errors east and north, estimated minus true.
    """
    detections = observed.detections
    xyz_m = detections.boxes.xyz_m.copy()
    xyz_m[:, :2] += error_m[np.searchsorted(rows, detections.observer)]
    return replace(
        observed, sweeps=observed.sweeps.displaced(error_m),
        detections=replace(detections, boxes=replace(detections.boxes, xyz_m=xyz_m)),
    )  # fmt: skip


def believed_world(world: World, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> World:
    """The world with equipped vehicles at their estimated positions. They compare received boxes with it.

    Parameters
    ----------
    world
        All actors at their true positions.
    rows
        Rows of the equipped vehicles.
    error_m
        Position errors east and north, estimated minus true.
    """
    xyz_m = world.boxes.xyz_m.copy()
    xyz_m[rows, :2] += error_m
    return replace(world, boxes=replace(world.boxes, xyz_m=xyz_m))
