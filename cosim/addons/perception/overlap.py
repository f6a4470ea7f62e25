"""Overlap of upright boxes, row by row: exact, by clipping one footprint against the other.

A box is x, y, z of its centre, length, width, height and yaw, as in the tables; `[n, 7]`. The two boxes of a row are in
one frame.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.base.plane import crossed, turned_by

_BLOCK = 200_000
"""Pairs whose polygons are in memory together: a few hundred bytes each."""


def corners(box: Float[ndarray, "n 7"]) -> Float[ndarray, "n 4 2"]:
    """Corners of the footprint of each box.

    Returns
    -------
    x and y of the corners, counter-clockwise: front left, rear left, rear right, front right.
    """
    ahead = np.array([0.5, -0.5, -0.5, 0.5])
    left = np.array([0.5, 0.5, -0.5, -0.5])
    corner_m = np.column_stack([ahead, left]) * box[:, None, 3:5]
    return turned_by(box[:, None, 6], corner_m) + box[:, None, :2]


def footprint_overlap(
    a: Float[ndarray, "n 7"],
    b: Float[ndarray, "n 7"],
) -> Float[ndarray, "n"]:
    """Area common to the footprints of the two boxes in each row, by Sutherland and Hodgman (1974).

    Returns
    -------
    Area [m2]; one polygon is clipped by the edges of the other, one after another.
    """
    shift = np.zeros((len(a), 7))
    shift[:, :2] = a[:, :2]  # near the origin, for precision
    polygon, clip = corners(a - shift), corners(b - shift)
    for edge in range(4):
        start = clip[:, edge]
        along = clip[:, (edge + 1) % 4] - start
        following = np.roll(polygon, -1, axis=1)
        side = crossed(along[:, None], polygon - start[:, None])
        side_following = np.roll(side, -1, axis=1)
        crosses = (side >= 0) != (side_following >= 0)
        part = np.where(crosses, side / np.where(crosses, side - side_following, 1), 0)
        crossing = polygon + part[..., None] * (following - polygon)
        n, v, _ = polygon.shape
        points = np.stack([polygon, crossing], axis=2).reshape(n, 2 * v, 2)
        kept = np.stack([side >= 0, crosses], axis=2).reshape(n, 2 * v)
        first = np.argsort(~kept, axis=1, kind="stable")[:, : v + 1]
        polygon = np.take_along_axis(points, first[..., None], axis=1)
        filled = np.take_along_axis(kept, first, axis=1)  # what is not filled repeats the first vertex
        polygon = np.where(filled[..., None], polygon, polygon[:, :1])
        polygon = np.where(filled[:, :1, None], polygon, 0)
    twice_m2 = crossed(polygon, np.roll(polygon, -1, axis=1)).sum(axis=1)
    return np.abs(twice_m2) / 2


def iou_bev(
    a: Float[ndarray, "n 7"],
    b: Float[ndarray, "n 7"],
) -> Float[ndarray, "n"]:
    """Intersection over union of the footprints of the two boxes in each row, in [0, 1]."""
    common = footprint_overlap(a, b)
    area_a = a[:, 3] * a[:, 4]
    area_b = b[:, 3] * b[:, 4]
    return common / (area_a + area_b - common)


def iou_3d(
    a: Float[ndarray, "n 7"],
    b: Float[ndarray, "n 7"],
) -> Float[ndarray, "n"]:
    """Intersection over union of the volumes of the two boxes in each row, in [0, 1]."""
    z_a, z_b = a[:, 2], b[:, 2]
    half_a = a[:, 5] / 2
    half_b = b[:, 5] / 2
    top = np.minimum(z_a + half_a, z_b + half_b)
    bottom = np.maximum(z_a - half_a, z_b - half_b)
    common = footprint_overlap(a, b) * np.maximum(top - bottom, 0)
    volume_a = a[:, 3:6].prod(axis=1)
    volume_b = b[:, 3:6].prod(axis=1)
    return common / (volume_a + volume_b - common)


def in_blocks(
    overlap: Callable[[ndarray, ndarray], ndarray],
    a: Float[ndarray, "n 7"],
    b: Float[ndarray, "n 7"],
) -> Float[ndarray, "n"]:
    """An overlap of many pairs, in memory that does not grow with them."""
    found = [np.zeros(0)]
    for begin in range(0, len(a), _BLOCK):
        block = slice(begin, begin + _BLOCK)
        found.append(overlap(a[block], b[block]))
    return np.concatenate(found)


def near_pairs(
    a_frame: Int[ndarray, "n"],
    a: Float[ndarray, "n 7"],
    b_frame: Int[ndarray, "m"],
    b: Float[ndarray, "m 7"],
) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Rows of two sets of boxes of the same frame whose footprints may overlap."""
    if not len(a) or not len(b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    longest_a_m = np.hypot(a[:, 3], a[:, 4]).max()
    longest_b_m = np.hypot(b[:, 3], b[:, 4]).max()
    reach_m = (longest_a_m + longest_b_m) / 2
    return within(a_frame, a[:, :2], b_frame, b[:, :2], reach_m)


def within(
    a_frame: Int[ndarray, "n"],
    a_m: Float[ndarray, "n 2"],
    b_frame: Int[ndarray, "m"],
    b_m: Float[ndarray, "m 2"],
    reach_m: float,
) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Rows of two sets of points of the same frame that are at most so far apart, in any order."""
    frames = np.unique(np.concatenate([a_frame, b_frame]))
    apart_m = 2.0 * reach_m + 1.0

    def tree(frame: Int[ndarray, "k"], points_m: Float[ndarray, "k 2"]) -> cKDTree:
        return cKDTree(np.column_stack([points_m, np.searchsorted(frames, frame) * apart_m]))

    a, b = tree(a_frame, a_m), tree(b_frame, b_m)
    pairs = a.sparse_distance_matrix(b, reach_m, output_type="ndarray")
    return pairs["i"], pairs["j"]
