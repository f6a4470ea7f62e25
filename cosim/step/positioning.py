"""Effects of positioning errors (estimated minus true) on boxes that a vehicle perceives and transmits."""

from dataclasses import replace

from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.plane import turned_by, wrapped
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
        away_m = xyz_m[:, :2] - centre_m
        xyz_m[:, :2] = centre_m + turned_by(turn_rad, away_m)
        yaw_rad = wrapped(yaw_rad + turn_rad)
    if not back:
        xyz_m[:, :2] += shift_m
    return replace(boxes, xyz_m=xyz_m, yaw_rad=yaw_rad)
