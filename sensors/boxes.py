"""Upright rotated boxes of actors, detections and messages, and the overlap of two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from cosim.base.kernel import compiled, kernel
from cosim.base.ragged import row_numbers
from cosim.base.rows import Rows
from cosim.base.threads import in_ranges

Pairs = tuple[Int[ndarray, "k"], Int[ndarray, "k"], Float[ndarray, "k"]]
"""Rows of two boxes, and their IoU or how well they agree, in (0, 1]; sorted by the two rows."""


@dataclass(frozen=True, slots=True)
class Boxes(Rows):
    """N upright boxes in one right-handed frame with z up (the world's, or a sensor's)."""

    xyz_m: Float[ndarray, "n 3"]
    """Centre [m]."""
    lwh_m: Float[ndarray, "n 3"]
    """Length along the heading, width, height [m]; all positive."""
    yaw_rad: Float[ndarray, "n"]
    """Heading, counter-clockwise from +x [rad]."""

    def __post_init__(self) -> None:
        for name, width in (("xyz_m", 3), ("lwh_m", 3), ("yaw_rad", None)):
            value = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            shape = (len(self.xyz_m),) if width is None else (len(self.xyz_m), width)
            if value.shape != shape:
                raise ValueError(f"boxes.{name} has shape {value.shape}; {shape} was expected: one row per box.")
            if not np.isfinite(value).all():
                is_finite = np.isfinite(value).reshape(len(value), -1)
                row = int(np.argmin(is_finite.all(axis=1)))
                raise ValueError(f"boxes.{name}[{row}] = {value[row]} is not finite: a box needs a pose and a size.")
            object.__setattr__(self, name, value)
        if len(self) and self.lwh_m.min() <= 0.0:
            row = int(np.argmin(self.lwh_m.min(axis=1)))
            raise ValueError(
                f"boxes.lwh_m[{row}] = {self.lwh_m[row]} m: length, width and height must be positive. "
                "Give the actor's vehicle type its real size."
            )

    def __len__(self) -> int:
        return len(self.xyz_m)

    @property
    def circumradius_m(self) -> Float[ndarray, "n"]:
        """Radius of the circle around each footprint [m]."""
        return 0.5 * np.hypot(self.lwh_m[:, 0], self.lwh_m[:, 1])

    def take(self, rows: Int[ndarray, "m"] | slice) -> Boxes:
        """The boxes of these rows, in this order."""
        if isinstance(rows, slice):
            return Boxes._of_checked(self.xyz_m[rows], self.lwh_m[rows], self.yaw_rad[rows])
        rows = row_numbers(rows)
        xyz_m, lwh_m = (column.take(rows, axis=0) for column in (self.xyz_m, self.lwh_m))
        return Boxes._of_checked(xyz_m, lwh_m, self.yaw_rad[rows])

    @staticmethod
    def concat(parts: Sequence[Boxes]) -> Boxes:
        """All boxes of all parts, in order; no boxes if there are no parts."""
        return Boxes._of_checked(
            np.concatenate([p.xyz_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.lwh_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.yaw_rad for p in parts] or [np.empty(0)]),
        )

    @staticmethod
    def _of_checked(xyz_m: ndarray, lwh_m: ndarray, yaw_rad: ndarray) -> Boxes:
        """Boxes from arrays that were checked before."""
        made = object.__new__(Boxes)
        for name, value in (("xyz_m", xyz_m), ("lwh_m", lwh_m), ("yaw_rad", yaw_rad)):
            object.__setattr__(made, name, np.ascontiguousarray(value))
        return made


def extrapolated(
    boxes: Boxes,
    velocity_mps: Float[ndarray, "n 2"],
    dt_s: float | Float[ndarray, "n"],
) -> Boxes:
    """The boxes moved by velocity times time, without a turn.

    Parameters
    ----------
    boxes
        Boxes in one frame.
    velocity_mps
        Velocity along x and y in the same frame. A row with a NaN is absent, and its box does not move.
    dt_s
        Time to move by, for all boxes or one per box. Negative values move boxes back.

    Returns
    -------
    Boxes in the same rows, with the same sizes, headings and heights.

    Raises
    ------
    ValueError
        If there is not one velocity per box, or a box would move to a place that is not finite.
    """
    velocity_mps = np.asarray(velocity_mps, np.float64)
    if velocity_mps.shape != (len(boxes), 2):
        raise ValueError(f"velocity_mps has shape {velocity_mps.shape}; ({len(boxes)}, 2) was expected: one per box.")
    absent = np.isnan(velocity_mps).any(axis=1)
    known_mps = np.where(absent[:, None], 0.0, velocity_mps)
    time_s = np.broadcast_to(dt_s, len(boxes))
    xyz_m = boxes.xyz_m.copy()
    xyz_m[:, :2] += known_mps * time_s[:, None]
    return Boxes(xyz_m, boxes.lwh_m, boxes.yaw_rad)


def iou_3d(a: Boxes, b: Boxes) -> Float[ndarray, "n"]:
    """Intersection over union of each box of `a` with the box of `b` in the same row.

    Parameters
    ----------
    a, b
        Boxes in one frame.

    Returns
    -------
    One value in [0, 1] per row; touching boxes give 0.

    Raises
    ------
    ValueError
        If `a` and `b` have different numbers of boxes.

    Notes
    -----
    Exact: convex polygon clipping of the two footprints times the overlap of the heights, over the union of the volumes
    (what the TruPercept paper defines).   Deviations: none from the paper; the authors' code swaps width and height and
    counts 1 cm pixels.
    """
    if len(a) != len(b):
        raise ValueError(
            f"iou_3d was given {len(a)} and {len(b)} boxes. It compares row by row, so both numbers must be equal."
        )
    out = np.empty(len(a))
    of_a = a.xyz_m, a.lwh_m, a.yaw_rad
    of_b = b.xyz_m, b.lwh_m, b.yaw_rad

    def compare(begin: int, end: int) -> None:
        _iou(begin * _CHUNK, end * _CHUNK, *of_a, *of_b, out)

    in_ranges(compare, (len(a) + _CHUNK - 1) // _CHUNK)
    return out


def overlapping_pairs(boxes: Boxes, label: UInt8[ndarray, "n"], owner: Int[ndarray, "n"]) -> Pairs:
    """All overlapping pairs i < j of the same label and different owners, with their IoU.

    Parameters
    ----------
    boxes
        Boxes in one frame.
    label, owner
        Class of each box, and the vehicle that reports it.

    Returns
    -------
    i, j (int32) and their IoU (> 0), sorted by (i, j).
    """
    radius_m, xy_m = boxes.circumradius_m, boxes.xyz_m[:, :2]
    found = [np.zeros((0, 2), np.int64)]
    for kind in np.unique(label):
        of_class = np.flatnonzero(label == kind)
        reach_m = 2.0 * float(radius_m[of_class].max()) + _SLACK_M
        tree = scipy.spatial.cKDTree(xy_m[of_class])
        near = tree.query_pairs(reach_m, output_type="ndarray")
        found.append(of_class[near])
    i, j = np.concatenate(found).T  # i < j, since `of_class` ascends
    apart_m = xy_m[j] - xy_m[i]
    reach_m = radius_m[i] + radius_m[j] + _SLACK_M
    is_near = (apart_m * apart_m).sum(axis=1) < reach_m * reach_m
    rows = np.flatnonzero((owner[i] != owner[j]) & is_near)
    key = i[rows] * len(boxes) + j[rows]
    rows = rows[np.argsort(key)]
    return _overlapping(boxes, i[rows], boxes, j[rows])


def _overlapping(
    a: Boxes,
    i: Int[ndarray, "m"],
    b: Boxes,
    j: Int[ndarray, "m"],
) -> Pairs:
    """The pairs of rows of `a` and `b` (int32) whose boxes overlap, and their IoU."""
    iou = iou_3d(a.take(i), b.take(j))
    overlap = np.flatnonzero(iou > 0.0)
    i, j = (row[overlap].astype(np.int32) for row in (i, j))
    return i, j, iou[overlap]


def pairs_between(a: Boxes, a_label: UInt8[ndarray, "n"], b: Boxes, b_label: UInt8[ndarray, "m"]) -> Pairs:
    """All overlapping pairs of a box of `a` and a box of `b` of the same label, with their IoU.

    Parameters
    ----------
    a, b
        Boxes in one frame.
    a_label, b_label
        Class of each box.

    Returns
    -------
    Rows of `a` and of `b` (int32) and their IoU (> 0), sorted by the two rows.
    """
    found = [np.zeros((0, 2), np.int64)]
    for kind in np.intersect1d(a_label, b_label):
        one = np.flatnonzero(a_label == kind)
        other = np.flatnonzero(b_label == kind)
        radius_m = a.circumradius_m[one].max() + b.circumradius_m[other].max()
        one_tree = scipy.spatial.cKDTree(a.xyz_m[one, :2])
        other_tree = scipy.spatial.cKDTree(b.xyz_m[other, :2])
        reach_m = float(radius_m) + _SLACK_M
        near = one_tree.sparse_distance_matrix(other_tree, reach_m, output_type="ndarray")
        pairs = one[near["i"]], other[near["j"]]
        found.append(np.column_stack(pairs))
    i, j = np.concatenate(found).T
    order = np.lexsort((j, i))
    return _overlapping(a, i[order], b, j[order])


_SLACK_M = 1e-6
_CHUNK = 4096
"""Pairs of which one thread computes the overlap at once."""


@compiled
def _iou(begin, end, a_xyz, a_lwh, a_yaw, b_xyz, b_lwh, b_yaw, out):
    """Write the IoU of the boxes of the two sets in the rows from `begin` to `end`. The last ones may be missing."""
    room = np.empty((4, 16))
    for k in range(np.uint64(begin), np.uint64(min(end, len(out)))):
        out[k] = iou_of(a_xyz, a_lwh, a_yaw, k, b_xyz, b_lwh, b_yaw, k, room)


@kernel
def iou_of(a_xyz, a_lwh, a_yaw, i, b_xyz, b_lwh, b_yaw, j, room):
    """IoU of box i of the first set with box j of the second; `room` is for two polygons."""
    poly_x, poly_y = room[0], room[1]
    kept_x, kept_y = room[2], room[3]
    ax, ay = a_xyz[i, 0], a_xyz[i, 1]
    bx, by = b_xyz[j, 0], b_xyz[j, 1]
    az, bz = a_xyz[i, 2], b_xyz[j, 2]
    al, aw = a_lwh[i, 0], a_lwh[i, 1]
    bl, bw = b_lwh[j, 0], b_lwh[j, 1]
    ah, bh = a_lwh[i, 2], b_lwh[j, 2]
    top = min(az + 0.5 * ah, bz + 0.5 * bh)
    bottom = max(az - 0.5 * ah, bz - 0.5 * bh)
    radius = 0.5 * (np.hypot(al, aw) + np.hypot(bl, bw))
    dx, dy = bx - ax, by - ay
    if top <= bottom or dx * dx + dy * dy >= radius * radius:
        return 0.0
    # The clipping box is chosen by geometry, not by row, so that swapping the two changes no bit.
    first = (ax, ay, al, aw, a_yaw[i])
    second = (bx, by, bl, bw, b_yaw[j])
    if second < first:
        first, second = second, first
    x1, y1, length1, width1, yaw1 = first
    x2, y2, length2, width2, yaw2 = second
    # The corners of the second box in the frame of the first.
    cos, sin = np.cos(yaw1), np.sin(yaw1)
    dx, dy = x2 - x1, y2 - y1
    x = cos * dx + sin * dy
    y = -sin * dx + cos * dy
    cos = np.cos(yaw2 - yaw1)
    sin = np.sin(yaw2 - yaw1)
    half_l, half_w = 0.5 * length2, 0.5 * width2
    for corner in range(4):
        u = half_l if corner == 0 or corner == 3 else -half_l
        v = half_w if corner < 2 else -half_w
        poly_x[corner] = x + cos * u - sin * v
        poly_y[corner] = y + sin * u + cos * v
    # Each side of the first box cuts off what is beyond it (Sutherland and Hodgman).
    count = 4
    for side in range(4):
        sign = 1.0 if side < 2 else -1.0
        limit = 0.5 * (length1 if side % 2 == 0 else width1)
        kept = 0
        for c in range(count):
            m = c + 1 if c + 1 < count else 0
            x, y = poly_x[c], poly_y[c]
            x_after, y_after = poly_x[m], poly_y[m]
            p = limit - sign * (x if side % 2 == 0 else y)
            q = limit - sign * (x_after if side % 2 == 0 else y_after)
            if p >= 0.0:
                kept_x[kept], kept_y[kept] = x, y
                kept += 1
            if (p >= 0.0) != (q >= 0.0):
                s = p / (p - q)
                kept_x[kept] = x + s * (x_after - x)
                kept_y[kept] = y + s * (y_after - y)
                kept += 1
        poly_x, kept_x = kept_x, poly_x
        poly_y, kept_y = kept_y, poly_y
        count = kept
    area = 0.0
    for c in range(count):
        m = c + 1 if c + 1 < count else 0
        area += poly_x[c] * poly_y[m] - poly_x[m] * poly_y[c]
    common = 0.5 * area * (top - bottom)
    if common > 0.0:
        volume = al * aw * ah + bl * bw * bh
        return min(1.0, common / (volume - common))
    return 0.0
