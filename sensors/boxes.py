"""Upright rotated boxes of actors, detections and messages, and the overlap of two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import prange
from numpy import ndarray

from sensors.kernel import compiled, kernel, parallel


@dataclass(frozen=True, slots=True)
class Boxes:
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
                row = int(np.argmin(np.isfinite(value).reshape(len(value), -1).all(axis=1)))
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
        return Boxes._of_checked(self.xyz_m[rows], self.lwh_m[rows], self.yaw_rad[rows])

    @staticmethod
    def concat(parts: Sequence[Boxes]) -> Boxes:
        """All boxes of all parts, in order."""
        return Boxes._of_checked(
            np.concatenate([p.xyz_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.lwh_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.yaw_rad for p in parts] or [np.empty(0)]),
        )

    @staticmethod
    def _of_checked(xyz_m: Float[ndarray, "n 3"], lwh_m: Float[ndarray, "n 3"], yaw_rad: Float[ndarray, "n"]) -> Boxes:
        """Boxes from arrays that were checked before."""
        made = object.__new__(Boxes)
        for name, value in (("xyz_m", xyz_m), ("lwh_m", lwh_m), ("yaw_rad", yaw_rad)):
            object.__setattr__(made, name, np.ascontiguousarray(value))
        return made


def iou_3d(a: Boxes, b: Boxes) -> Float[ndarray, "n"]:
    """Intersection over union of each box of `a` with the box of `b` in the same row.

    Returns
    -------
    One value in [0, 1] per row; touching boxes give 0.

    Raises
    ------
    ValueError
        If `a` and `b` have different numbers of boxes.

    Notes
    -----
    Exact: convex polygon clipping of the two footprints times the overlap of the heights, over the union
    of the volumes (what the TruPercept paper defines).   Deviations: none from the paper; the authors' code
    swaps width and height and counts 1 cm pixels.
    """
    if len(a) != len(b):
        raise ValueError(
            f"iou_3d was given {len(a)} and {len(b)} boxes. It compares row by row, so both numbers must be equal."
        )
    return _iou(a.xyz_m, a.lwh_m, a.yaw_rad, b.xyz_m, b.lwh_m, b.yaw_rad)


def overlapping_pairs(
    boxes: Boxes, label: UInt8[ndarray, "n"], owner: Int[ndarray, "n"]
) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"], Float[ndarray, "m"]]:
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
    n, radius_m = len(boxes), boxes.circumradius_m
    largest_m = np.zeros(int(label.max(initial=0)) + 1)
    np.maximum.at(largest_m, label, radius_m)
    reach_m = radius_m + largest_m[label] + _SLACK_M
    cell_m = max(_CELL_M, float(reach_m.max(initial=0.0)) / 4)
    order, start, cell = _by_cell(boxes.xyz_m, cell_m, 1 << n.bit_length())
    given = (
        boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, radius_m, label, np.asarray(owner, np.int64), reach_m, cell_m,
        order, start, cell,
    )  # fmt: skip
    count = np.zeros(n + 1, np.int64)
    _near(*given, count, np.zeros(0, np.int32), np.zeros(0))
    ptr = np.cumsum(count)
    j, iou = np.empty(ptr[-1], np.int32), np.empty(ptr[-1])
    _near(*given, ptr, j, iou)
    found = np.flatnonzero(iou > 0.0)
    return np.repeat(np.arange(n, dtype=np.int32), count[1:])[found], j[found], iou[found]


_CELL_M = 6.0
"""Least width of the cells in which overlapping boxes are searched: little more than a car is long."""
_SLACK_M = 1e-6
_CHUNK = 256
"""Boxes whose neighbours one thread searches at once."""


@kernel
def _bucket(x, y, n_buckets):
    """Where a cell's boxes are listed; several cells may share a bucket."""
    return (x * 73_856_093 ^ y * 19_349_663) & (n_buckets - 1)


@compiled
def _by_cell(xyz, cell_m, n_buckets):
    """Rows by bucket, ascending, where each bucket begins, and the cell of every row."""
    cell = np.empty((len(xyz), 2), np.int64)
    start = np.zeros(n_buckets + 1, np.int64)
    for k in range(len(xyz)):
        cell[k, 0], cell[k, 1] = np.floor(xyz[k, 0] / cell_m), np.floor(xyz[k, 1] / cell_m)
        start[_bucket(cell[k, 0], cell[k, 1], n_buckets) + 1] += 1
    for b in range(n_buckets):
        start[b + 1] += start[b]
    put, order = start[:-1].copy(), np.empty(len(xyz), np.int32)
    for k in range(len(xyz)):
        b = _bucket(cell[k, 0], cell[k, 1], n_buckets)
        order[put[b]] = k
        put[b] += 1
    return order, start, cell


@parallel
def _near(xyz, lwh, yaw, radius, label, owner, reach, cell_m, order, start, cell, ptr, out_j, out_iou):
    """Later boxes of one label and other owners whose circles overlap each box: counts them if `out_j` is empty, else
    lists them from `ptr` on, ascending, with their IoU."""
    n, n_buckets = len(xyz), len(start) - 1
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        room = np.empty((4, 16))
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            x, y = xyz[i, 0], xyz[i, 1]
            low_x, high_x = np.floor((x - reach[i]) / cell_m), np.floor((x + reach[i]) / cell_m)
            low_y, high_y = np.floor((y - reach[i]) / cell_m), np.floor((y + reach[i]) / cell_m)
            m = 0
            for cx in range(np.int64(low_x), np.int64(high_x) + 1):
                for cy in range(np.int64(low_y), np.int64(high_y) + 1):
                    b = _bucket(cx, cy, n_buckets)
                    for k in range(start[b], start[b + 1]):
                        j = order[k]
                        if j <= i or label[j] != label[i] or owner[j] == owner[i]:
                            continue
                        dx, dy, apart = xyz[j, 0] - x, xyz[j, 1] - y, radius[i] + radius[j] + _SLACK_M
                        if cell[j, 0] != cx or cell[j, 1] != cy or dx * dx + dy * dy >= apart * apart:
                            continue
                        if len(out_j) > 0:
                            at = ptr[i] + m
                            while at > ptr[i] and out_j[at - 1] > j:
                                out_j[at] = out_j[at - 1]
                                at -= 1
                            out_j[at] = j
                        m += 1
            if len(out_j) == 0:
                ptr[i + 1] = m
            else:
                for at in range(ptr[i], ptr[i + 1]):
                    out_iou[at] = _iou_of(xyz, lwh, yaw, i, xyz, lwh, yaw, np.int64(out_j[at]), room)


@compiled
def _iou(a_xyz, a_lwh, a_yaw, b_xyz, b_lwh, b_yaw):
    """IoU of the boxes of the two sets, row by row."""
    out = np.empty(len(a_xyz))
    room = np.empty((4, 16))
    for n in range(len(a_xyz)):
        out[n] = _iou_of(a_xyz, a_lwh, a_yaw, n, b_xyz, b_lwh, b_yaw, n, room)
    return out


@kernel
def _iou_of(a_xyz, a_lwh, a_yaw, i, b_xyz, b_lwh, b_yaw, j, room):
    """IoU of box i of the first set with box j of the second, `room` is for two polygons."""
    poly_x, poly_y, next_x, next_y = room[0], room[1], room[2], room[3]
    top = min(a_xyz[i, 2] + 0.5 * a_lwh[i, 2], b_xyz[j, 2] + 0.5 * b_lwh[j, 2])
    bottom = max(a_xyz[i, 2] - 0.5 * a_lwh[i, 2], b_xyz[j, 2] - 0.5 * b_lwh[j, 2])
    radius = 0.5 * (np.hypot(a_lwh[i, 0], a_lwh[i, 1]) + np.hypot(b_lwh[j, 0], b_lwh[j, 1]))
    dx, dy = b_xyz[j, 0] - a_xyz[i, 0], b_xyz[j, 1] - a_xyz[i, 1]
    if top <= bottom or dx * dx + dy * dy >= radius * radius:
        return 0.0
    # The clipping box is chosen by geometry, not by row, so that swapping the two changes no bit.
    first = (a_xyz[i, 0], a_xyz[i, 1], a_lwh[i, 0], a_lwh[i, 1], a_yaw[i])
    second = (b_xyz[j, 0], b_xyz[j, 1], b_lwh[j, 0], b_lwh[j, 1], b_yaw[j])
    if second < first:
        first, second = second, first
    cos, sin = np.cos(first[4]), np.sin(first[4])
    dx, dy = second[0] - first[0], second[1] - first[1]
    x, y = cos * dx + sin * dy, -sin * dx + cos * dy
    cos, sin = np.cos(second[4] - first[4]), np.sin(second[4] - first[4])
    half_l, half_w = 0.5 * second[2], 0.5 * second[3]
    for corner in range(4):
        u = half_l if corner == 0 or corner == 3 else -half_l
        v = half_w if corner < 2 else -half_w
        poly_x[corner] = x + cos * u - sin * v
        poly_y[corner] = y + sin * u + cos * v
    count = 4
    for side in range(4):
        sign = 1.0 if side < 2 else -1.0
        limit = 0.5 * (first[2] if side % 2 == 0 else first[3])
        kept = 0
        for k in range(count):
            m = k + 1 if k + 1 < count else 0
            p = limit - sign * (poly_x[k] if side % 2 == 0 else poly_y[k])
            q = limit - sign * (poly_x[m] if side % 2 == 0 else poly_y[m])
            if p >= 0.0:
                next_x[kept], next_y[kept] = poly_x[k], poly_y[k]
                kept += 1
            if (p >= 0.0) != (q >= 0.0):
                s = p / (p - q)
                next_x[kept] = poly_x[k] + s * (poly_x[m] - poly_x[k])
                next_y[kept] = poly_y[k] + s * (poly_y[m] - poly_y[k])
                kept += 1
        poly_x, next_x = next_x, poly_x
        poly_y, next_y = next_y, poly_y
        count = kept
    area = 0.0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        area += poly_x[k] * poly_y[m] - poly_x[m] * poly_y[k]
    common = 0.5 * area * (top - bottom)
    if common > 0.0:
        volume = a_lwh[i, 0] * a_lwh[i, 1] * a_lwh[i, 2] + b_lwh[j, 0] * b_lwh[j, 1] * b_lwh[j, 2]
        return min(1.0, common / (volume - common))
    return 0.0
