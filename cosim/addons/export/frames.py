"""Frames of other tools: the sensor's, KITTI's camera, the compass.

A box is x, y, z of its centre, length, width, height and yaw, as in the tables; `[n, 7]`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from cosim.base.plane import turned_by, wrapped

IMAGE_PX = (1920, 1080)
"""Of the camera that KITTI's labels are meant for."""

FOCAL_PX = 960.0
"""Its focal length: 90 degrees on 1,920 pixels."""

NEAREST_M = 0.1
"""What is nearer to the camera's plane is cut off before it is projected."""

_EDGES = np.array(
    [
        (0, 1),
        (0, 2),
        (0, 4),
        (1, 3),
        (1, 5),
        (2, 3),
        (2, 6),
        (3, 7),
        (4, 5),
        (4, 6),
        (5, 7),
        (6, 7),
    ]
)
"""Edges of a box whose corner i is at the upper end of the axes in the bits of i."""


def in_sensor(
    box: Float[ndarray, "n 7"],
    pose: Float[ndarray, "4"],
) -> Float[ndarray, "n 7"]:
    """Boxes in the frame of a level sensor.

    Parameters
    ----------
    box
        Boxes, world frame.
    pose
        x, y, z and yaw of the sensor, world frame.

    Returns
    -------
    Boxes in the sensor frame: x forward, y left, z up; yaw in (-pi, pi].
    """
    away = box[:, :3] - pose[:3]
    out = box.astype(float)
    out[:, :2] = turned_by(-pose[3], away)
    out[:, 2] = away[:, 2]
    out[:, 6] = wrapped(box[:, 6] - pose[3])
    return out


def normals_of(triangles: Float[ndarray, "t 3 3"]) -> Float[ndarray, "t 3"]:
    """Unit vectors across triangles; 0 of a triangle without an area."""
    a, b, c = triangles.swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


class InCamera(NamedTuple):
    """Boxes as KITTI's label files state them; camera frame: x right, y down, z forward, at the sensor's place."""

    bottom_m: Float[ndarray, "n 3"]
    """Middle of the underside."""
    rotation_y: Float[ndarray, "n"]
    """About the y axis; 0 where the box points to the right, -pi/2 where it points away."""
    alpha: Float[ndarray, "n"]
    """`rotation_y` as seen along the ray to the box."""
    image_px: Float[ndarray, "n 4"]
    """Left, top, right and bottom of its rectangle inside the image."""
    truncated: Float[ndarray, "n"]
    """Share of the whole rectangle that lies outside the image."""
    is_in_image: Bool[ndarray, "n"]


def in_camera(box: Float[ndarray, "n 7"]) -> InCamera:
    """Boxes as KITTI's camera sees them.

    Parameters
    ----------
    box
        Boxes in the sensor frame, as `in_sensor` returns them.
    """
    forward, left = box[:, 0], box[:, 1]
    underside = box[:, 2] - 0.5 * box[:, 5]
    bottom = np.column_stack([-left, -underside, forward])
    rotation = wrapped(-box[:, 6] - 0.5 * np.pi)
    whole = _rectangle(box)
    size = np.array([*IMAGE_PX, *IMAGE_PX], float)
    inside = np.clip(whole, 0.0, size - 1)
    area, full = _area(inside), _area(whole)
    ahead = np.isfinite(whole).all(axis=1)
    has_area = full > 0
    outside = 1 - area / np.where(has_area, full, 1.0)
    return InCamera(
        bottom_m=bottom,
        rotation_y=rotation,
        alpha=wrapped(rotation - np.arctan2(-left, forward)),
        image_px=inside,
        truncated=np.where(ahead & has_area, outside, 1.0),
        is_in_image=ahead & (area > 0),
    )


def _area(rectangle: Float[ndarray, "n 4"]) -> Float[ndarray, "n"]:
    sides = rectangle[:, 2:] - rectangle[:, :2]
    return np.prod(np.maximum(sides, 0.0), axis=1)


def _rectangle(box: Float[ndarray, "n 7"]) -> Float[ndarray, "n 4"]:
    """Rectangle of each box in an endless image [px]; nan where nothing of it is ahead."""
    bits = np.arange(8)[:, None] >> np.arange(3) & 1
    signs = bits * 2 - 1
    local = 0.5 * signs * box[:, None, 3:6]
    local[..., :2] = turned_by(box[:, None, 6], local)
    corner = local + box[:, None, :3]
    begin, end = _EDGES.T
    a, b = corner[:, begin], corner[:, end]
    depth_a, depth_b = a[..., 0], b[..., 0]
    crosses = (depth_a < NEAREST_M) != (depth_b < NEAREST_M)
    to_plane_m = np.where(crosses, NEAREST_M - depth_a, 0.0)
    part = to_plane_m / np.where(crosses, depth_b - depth_a, 1.0)
    cut = a + part[..., None] * (b - a)
    points = np.concatenate([corner, cut], axis=1)
    seen = np.concatenate([corner[..., 0] >= NEAREST_M, crosses], axis=1)
    depth = np.where(seen, np.maximum(points[..., 0], NEAREST_M), 1.0)
    middle = np.array(IMAGE_PX) / 2
    pixel = middle - FOCAL_PX * points[..., 1:] / depth[..., None]
    low = np.where(seen[..., None], pixel, np.inf).min(axis=1)
    high = np.where(seen[..., None], pixel, -np.inf).max(axis=1)
    out = np.column_stack([low, high])
    out[~seen.any(axis=1)] = np.nan
    return out


def compass_deg(yaw_rad: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """Headings as a compass gives them.

    Parameters
    ----------
    yaw_rad
        Headings counter-clockwise from east (+x).

    Returns
    -------
    Headings clockwise from north, in [0, 360).
    """
    degrees = np.mod(90.0 - np.degrees(np.asarray(yaw_rad, float)), 360.0)
    return np.where(degrees >= 360.0, 0.0, degrees)
