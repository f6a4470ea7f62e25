"""What position errors (estimated minus true) do to what a vehicle perceives and transmits."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.step.perception import Observed
from cosim.world import World


def as_believed(observed: Observed, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> Observed:
    """What vehicles perceived, in the world as they believe it: their sensors, their reports of themselves and all that
    they detect are displaced by their own errors.

    A vehicle's own view of its surroundings stays right; what it hears is displaced against it by the difference of
    two errors. `rows` are the vehicles' rows of the world.
    """
    sweeps, detections = observed.sweeps, observed.detections
    origin_m, xyz_m = sweeps.poses.origin_m.copy(), detections.boxes.xyz_m.copy()
    origin_m[:, :2] += error_m
    xyz_m[:, :2] += error_m[np.searchsorted(rows, detections.observer)]
    return replace(
        observed, sweeps=replace(sweeps, poses=replace(sweeps.poses, origin_m=origin_m)),
        detections=replace(detections, boxes=replace(detections.boxes, xyz_m=xyz_m)),
    )  # fmt: skip


def believed_world(world: World, rows: Int[ndarray, "e"], error_m: Float[ndarray, "e 2"]) -> World:
    """The world with equipped vehicles where they believe to be: what they compare received boxes with."""
    xyz_m = world.boxes.xyz_m.copy()
    xyz_m[rows, :2] += error_m
    return replace(world, boxes=replace(world.boxes, xyz_m=xyz_m))
