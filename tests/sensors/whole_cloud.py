"""Slow twins of `sensors.box_points` and `sensors.evidence_kernels`: every point of an unorganised cloud is tested."""

from __future__ import annotations

import numpy as np
from numba import njit

from sensors.box_points import in_box
from sensors.evidence_kernels import frustum, in_frustum, is_testable


@njit(cache=True)
def points_in_boxes_xyz(points, xyz, lwh, yaw):
    """Points strictly inside each box, by looking at all of them."""
    out = np.zeros(len(xyz), np.int32)
    for k in range(len(xyz)):
        cos, sin = np.cos(yaw[k]), np.sin(yaw[k])
        for i in range(len(points)):
            out[k] += in_box(
                points[i, 0], points[i, 1], points[i, 2], xyz[k, 0], xyz[k, 1], xyz[k, 2], cos, sin,
                0.5 * lwh[k, 0], 0.5 * lwh[k, 1], 0.5 * lwh[k, 2],
            )  # fmt: skip
    return out


@njit(cache=True)
def free_space_xyz(points, planes, distance, margin_m):
    """Points of the cloud in the pyramid through each box, and how many of them are nearer than the box."""
    seen, closer = np.zeros(len(planes), np.int32), np.zeros(len(planes), np.int32)
    for k in range(len(planes)):
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if in_frustum(x, y, z, planes[k]):
                seen[k] += 1
                closer[k] += np.sqrt(x * x + y * y + z * z) < distance[k] + margin_m
    return seen, closer


@njit(cache=True)
def applies_to(xyz, lwh, range_m, height_m, fov_rad, slope, road_z):
    """Whether the free-space test applies to each box (sensor frame)."""
    found = np.zeros(len(xyz), np.bool_)
    for k in range(len(xyz)):
        found[k] = is_testable(xyz[k, 0], xyz[k, 1], xyz[k, 2], lwh[k, 2], range_m, height_m, fov_rad, slope, road_z)
    return found


@njit(cache=True)
def frusta(xyz, lwh):
    """Planes of the pyramid through each box (sensor frame), and the distance of its bottom centre."""
    planes, distance, corner = np.empty((len(xyz), 4, 3)), np.empty(len(xyz)), np.empty((4, 3))
    for k in range(len(xyz)):
        x, y, z, length, width, height = xyz[k, 0], xyz[k, 1], xyz[k, 2], lwh[k, 0], lwh[k, 1], lwh[k, 2]
        distance[k] = frustum(x, y, z, length, width, height, corner, planes[k])[0]
    return planes, distance
