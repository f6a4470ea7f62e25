"""What several vehicles state of objects, and the boxes that follow from it."""

from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from sensors.boxes import Boxes


class StatedAccuracy(NamedTuple):
    """What vehicles state of the accuracy of D detections in M messages."""

    variance_m2: Float[ndarray, "d 3"]
    """Variance of each position relative to its vehicle: xx, xy, yy."""
    heading_variance: Float[ndarray, "d"]
    """Relative to its vehicle [rad2]."""
    size_variance: Float[ndarray, "d"]
    """Variance of the logarithm of length, width and height."""
    origin_m: Float[ndarray, "m 2"]
    """Where the vehicle of each message believes itself to be."""
    pose_variance: Float[ndarray, "m 2"]
    """Variance of that position along each axis [m2], and of the heading [rad2]."""


class ObjectViews(NamedTuple):
    """D detections in M messages."""

    boxes: Boxes
    """In the world's frame, where each vehicle believes it to be."""
    label: UInt8[ndarray, "d"]
    message: Int[ndarray, "d"]
    accuracy: StatedAccuracy


class ViewLists(NamedTuple):
    """What E receivers know of D detections in M messages."""

    ptr: Int[ndarray, "e+1"]
    """Receiver e knows the detections `member[ptr[e]:ptr[e + 1]]`, those of one message side by side."""
    member: Int[ndarray, "p"]
    owner: Int[ndarray, "e"]
    """Its own message."""
    group: Int[ndarray, "p"]
    """Group of each of `member`. The groups of a receiver are consecutive."""
    seed: Int[ndarray, "g"]
    """Detection that represents each group."""
    received_ptr: Int[ndarray, "e+1"]
    """Receiver e weighs the messages `received[received_ptr[e]:received_ptr[e + 1]]`. Others have weight 1."""
    received: Int[ndarray, "h"]


class FusedBoxes(NamedTuple):
    """Boxes of G objects in the frame in which their receivers believe themselves to be."""

    boxes: Boxes
    variance_m2: Float[ndarray, "g 3"]
    """Variance of each position relative to the receiver: xx, xy, yy."""

    def columns(self) -> Float[ndarray, "g 7"]:
        """x, y, z, length, width, height, heading."""
        return np.column_stack([self.boxes.xyz_m, self.boxes.lwh_m, self.boxes.yaw_rad])


def boxes_of_columns(box: Float[ndarray, "g 7"]) -> Boxes:
    """Boxes from columns x, y, z, length, width, height, heading."""
    xyz_m, lwh_m, yaw_rad = np.split(box, (3, 6), axis=1)
    return Boxes(xyz_m, lwh_m, yaw_rad[:, 0])


def overlap_p(fused: FusedBoxes, least_iou: float) -> Float[ndarray, "g"]:
    """Probability that each box overlaps its object by more than an IoU, by the variance of its position.

    Notes
    -----
    Two equal boxes with axes in parallel, displaced by the share a of their length and by the share b of their width,
    have the IoU u / (2 - u) with u = (1 - a) (1 - b). It exceeds t if u exceeds c = 2 t / (1 + t), that is, if
    a < 1 - c and b < 1 - c / (1 - a). For normal errors, the probability of the first is an error function. That of the
    second is averaged over a by a Gauss-Legendre rule in the probability of a. Deviations: the correlation of errors
    along and across the box, heading, size and height are left out.
    """
    xx, xy, yy = fused.variance_m2.T
    turn = 2.0 * fused.boxes.yaw_rad
    twice = xx + yy
    cos, sin = np.cos(turn), np.sin(turn)
    spread = (xx - yy) * cos + 2.0 * xy * sin
    length_m, width_m, _ = fused.boxes.lwh_m.T
    length = length_m / np.sqrt(twice + spread)
    width = width_m / np.sqrt(twice - spread)
    least = 2.0 * least_iou / (1.0 + least_iou)
    first = scipy.special.erf(length * (1.0 - least))
    second = np.zeros(len(first))
    for place, weight in zip(*_RULE, strict=True):
        a = np.minimum(scipy.special.erfinv(place * first) / length, 1.0 - least)
        within = width * (1.0 - least / (1.0 - a))
        second += weight * scipy.special.erf(within)
    return first * second


_RULE = (0.1127016654, 0.5, 0.8872983346), (5 / 18, 8 / 18, 5 / 18)
"""Places in (0, 1) and weights of the Gauss-Legendre rule of three points."""
