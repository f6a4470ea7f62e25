"""Poses of sensors, and boxes in their frames, pair by pair: computed where a kernel needs them, not kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.base.kernel import inlined
from cosim.base.plane import turned_by, wrapped
from sensors.boxes import Boxes


class ViewPairs(NamedTuple):
    """Sensor o[k] looks at box b[k]; all poses in the world frame."""

    o: ndarray
    """int64 [n]."""
    b: ndarray
    """int64 [n]."""
    origin_m: ndarray
    """float64 [m, 3]: of the sensors."""
    cos: ndarray
    sin: ndarray
    """Of their headings."""
    heading_rad: ndarray
    xyz_m: ndarray
    """float64 [boxes, 3]."""
    lwh_m: ndarray
    yaw_rad: ndarray
    velocity_mps: ndarray
    """float64 [boxes, 2]: east and north. A sensor that turns sees each box where it is when the sensor looks there."""
    s_per_rad: float
    """Time in which the sensors turn by one radian; 0 if a sweep takes no time or the velocities do not count."""

    def runs(self) -> Int[ndarray, "r+1"]:
        """Where the pairs of each sensor begin, if the pairs of a sensor follow each other.

        Returns
        -------
        First pair of each run of equal `o`, and the number of pairs at the end.
        """
        if not len(self.o):
            return np.zeros(1, np.int64)
        changes = self.o[1:] != self.o[:-1]
        return np.flatnonzero(np.concatenate([[True], changes, [True]]))


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of M sensors in the world frame; each is level and looks along its vehicle's heading."""

    origin_m: Float[ndarray, "m 3"]
    yaw_rad: Float[ndarray, "m"]

    def displaced(self, error: Float[ndarray, "m 3"]) -> Poses:
        """Other poses: how far they are east [m] and north [m], and by how much they are turned [rad]."""
        origin_m, yaw_rad = self.origin_m.copy(), self.yaw_rad
        origin_m[:, :2] += error[:, :2]
        if error[:, 2].any():
            yaw_rad = wrapped(yaw_rad + error[:, 2])
        return Poses(origin_m, yaw_rad)

    def pairs(
        self,
        o: Int[ndarray, "n"],
        boxes: Boxes,
        b: Int[ndarray, "n"] | None = None,
        motion: tuple[Float[ndarray, "boxes 2"], float] | None = None,
    ) -> ViewPairs:
        """Pairs of a sensor and a box.

        Parameters
        ----------
        o
            Sensor of each pair.
        boxes
            Boxes in the world frame.
        b
            Row of `boxes` of each pair; by default all rows in order.
        motion
            Velocity of each box, east and north, and the time in which the sensors turn by one radian. By default,
            boxes are where they are.
        """
        velocity_mps, s_per_rad = (np.zeros((0, 2)), 0.0) if motion is None else motion
        return ViewPairs(
            o=np.asarray(o, np.int64),
            b=np.arange(len(boxes)) if b is None else np.asarray(b, np.int64),
            origin_m=self.origin_m,
            cos=np.cos(self.yaw_rad),
            sin=np.sin(self.yaw_rad),
            heading_rad=self.yaw_rad,
            xyz_m=boxes.xyz_m,
            lwh_m=boxes.lwh_m,
            yaw_rad=boxes.yaw_rad,
            velocity_mps=velocity_mps,
            s_per_rad=s_per_rad,
        )

    def to_sensor(self, o: Int[ndarray, "n"], boxes: Boxes) -> Boxes:
        """Box k of the world frame in the frame of sensor o[k]: x forward, y left, z up.

        Headings are not wrapped to one turn.
        """
        every, pairs = slice(None), self.pairs(o, boxes)
        x, y, z, length, width, height, yaw = in_sensor_frame.py_func(pairs, every)
        xyz_m = np.column_stack([x, y, z])
        lwh_m = np.column_stack([length, width, height])
        return Boxes(xyz_m, lwh_m, yaw)

    def to_world(self, o: int, xyz: Float[ndarray, "k 3"]) -> Float[ndarray, "k 3"]:
        """Points [m] in the frame of sensor `o`, in the world frame."""
        turned_xy = turned_by(self.yaw_rad[o], xyz)
        return np.column_stack([turned_xy, xyz[:, 2]]) + self.origin_m[o]


@inlined
def in_sensor_frame(pairs, k):
    """Centre (x, y, z), length, width, height and heading of the box of pair k in the frame of its sensor,
    when the sensor looks there."""
    s, w = pairs.o[k], pairs.b[k]
    dx = pairs.xyz_m[w, 0] - pairs.origin_m[s, 0]
    dy = pairs.xyz_m[w, 1] - pairs.origin_m[s, 1]
    cos, sin = pairs.cos[s], pairs.sin[s]
    x = cos * dx + sin * dy
    y = cos * dy - sin * dx
    if pairs.s_per_rad != 0.0:
        after_s = pairs.s_per_rad * np.arctan2(y, x)
        east = pairs.velocity_mps[w, 0] * after_s
        north = pairs.velocity_mps[w, 1] * after_s
        x += cos * east + sin * north
        y += cos * north - sin * east
    z = pairs.xyz_m[w, 2] - pairs.origin_m[s, 2]
    yaw = pairs.yaw_rad[w] - pairs.heading_rad[s]
    lwh_m = pairs.lwh_m
    return x, y, z, lwh_m[w, 0], lwh_m[w, 1], lwh_m[w, 2], yaw
