"""Where vehicles estimate themselves to be, and effects of the errors on what they perceive and transmit.

A positioning error is the estimated minus the true pose.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.plane import turned_by, wrapped
from cosim.config.config import Config
from cosim.step.exchange import Vehicles
from cosim.step.perception import Observed
from cosim.traffic.position_errors import PositionErrors
from cosim.world import World
from sensors.boxes import Boxes
from sensors.tracking import ObjectStates


@dataclass(frozen=True, slots=True)
class Positioned:
    """What vehicles perceive, at their estimated positions."""

    observed: Observed
    world: World
    """The world with every vehicle at its estimated pose; the true world without `[gnss]`. Vehicles compare received
    boxes with it."""
    error: Float[ndarray, "e 3"] | None
    """Errors of each vehicle, estimated minus true: east [m], north [m], heading [rad]; None without `[gnss]`."""
    objects: ObjectStates | None = None
    """What tracking says about the detector's reports, in the order of the detections; None without tracking."""


def position(
    world: World, vehicles: Vehicles, observed: Observed, errors: PositionErrors, config: Config
) -> tuple[PositionErrors, Positioned]:
    """Apply position errors to what vehicles perceive; return the new state of the errors and the result.

    Sensors, self-reports and detections are displaced and turned by the errors of their vehicle. The surroundings keep
    their position relative to the vehicle. Received objects are displaced relative to them by the difference of two
    errors.
    """
    row, gnss, step_s = vehicles.row, config.gnss, config.traffic.step_s
    if gnss.is_exact:
        return errors, Positioned(observed, world, None)
    actor, name_key = vehicles.actor, vehicles.name_key
    errors, error = errors.next(world.step, actor, name_key, gnss, step_s, config.seed)
    if config.roadside:  # where a unit stands is known
        error = np.where(world.is_roadside[row, None], 0.0, error)
    xyz_m, yaw_rad = world.boxes.xyz_m, world.boxes.yaw_rad
    sensing, of_sensing = row[vehicles.senses], error[vehicles.senses]
    detections = observed.detections
    observer = np.searchsorted(sensing, detections.observer)
    boxes = as_estimated(detections.boxes, observer, xyz_m[sensing], of_sensing)
    observed = replace(
        observed, sweeps=observed.sweeps.displaced(of_sensing), detections=replace(detections, boxes=boxes)
    )
    xyz_m = xyz_m.copy()
    xyz_m[row, :2] += error[:, :2]
    if error[:, 2].any():
        yaw_rad = yaw_rad.copy()
        yaw_rad[row] = wrapped(yaw_rad[row] + error[:, 2])
    estimated = replace(world, boxes=replace(world.boxes, xyz_m=xyz_m, yaw_rad=yaw_rad))
    return errors, Positioned(observed, estimated, error)


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
        away_m = xyz_m[:, :2] - centre_m
        xyz_m[:, :2] = centre_m + turned_by(turn_rad, away_m)
        yaw_rad = wrapped(yaw_rad + turn_rad)
    if not back:
        xyz_m[:, :2] += shift_m
    return replace(boxes, xyz_m=xyz_m, yaw_rad=yaw_rad)
