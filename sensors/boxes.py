"""Upright rotated boxes of actors, detections and messages, and the overlap of two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numba import njit
from numpy import ndarray
from scipy.spatial import cKDTree


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
        return Boxes(self.xyz_m[rows], self.lwh_m[rows], self.yaw_rad[rows])

    @staticmethod
    def concat(parts: Sequence[Boxes]) -> Boxes:
        """All boxes of all parts, in order."""
        return Boxes(
            np.concatenate([p.xyz_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.lwh_m for p in parts] or [np.empty((0, 3))]),
            np.concatenate([p.yaw_rad for p in parts] or [np.empty(0)]),
        )


def iou_3d(a: Boxes, b: Boxes) -> Float[ndarray, "n"]:
    """Intersection over union of each box of `a` with the box of `b` in the same row.

    Returns
    -------
    In [0, 1]; touching boxes give 0.

    Notes
    -----
    Exact: convex polygon clipping of the two footprints times the overlap of the heights, over the union
    of the volumes (what the TruPercept paper defines).   Deviations: none from the paper; the authors' code
    swaps width and height and counts 1 cm pixels.
    """
    if len(a) != len(b):
        raise ValueError(f"iou_3d was given {len(a)} and {len(b)} boxes: it compares row by row.")
    rows = np.arange(len(a))
    return _iou(a.xyz_m, a.lwh_m, a.yaw_rad, b.xyz_m, b.lwh_m, b.yaw_rad, rows, rows)


def overlapping_pairs(
    boxes: Boxes, label: UInt8[ndarray, "n"], owner: Int[ndarray, "n"]
) -> tuple[Int[ndarray, "m"], Int[ndarray, "m"], Float[ndarray, "m"]]:
    """All pairs i < j of one label and different owners that overlap, and by how much.

    Returns
    -------
    i, j (int32) and their IoU (> 0), sorted by (i, j).
    """
    found_i, found_j, found_iou = [], [], []
    radius = boxes.circumradius_m
    for one in np.unique(label):
        rows = np.flatnonzero(label == one)
        tree = cKDTree(boxes.xyz_m[rows, :2])
        pair = tree.query_pairs(2.0 * radius[rows].max(), output_type="ndarray")
        i, j = rows[pair[:, 0]], rows[pair[:, 1]]
        keep = owner[i] != owner[j]
        i, j = i[keep], j[keep]
        iou = _iou(boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, boxes.xyz_m, boxes.lwh_m, boxes.yaw_rad, i, j)
        keep = iou > 0.0
        found_i.append(i[keep])
        found_j.append(j[keep])
        found_iou.append(iou[keep])
    if not found_i:
        return np.empty(0, np.int32), np.empty(0, np.int32), np.empty(0)
    i, j, iou = np.concatenate(found_i), np.concatenate(found_j), np.concatenate(found_iou)
    order = np.argsort(i * np.int64(len(boxes)) + j)
    return i[order].astype(np.int32), j[order].astype(np.int32), iou[order]


@njit(cache=True)
def _iou(a_xyz, a_lwh, a_yaw, b_xyz, b_lwh, b_yaw, a_row, b_row):
    """IoU of box a_row[n] of the first set with box b_row[n] of the second."""
    out = np.zeros(len(a_row))
    poly_x, poly_y = np.empty(16), np.empty(16)
    next_x, next_y = np.empty(16), np.empty(16)
    for n in range(len(a_row)):
        i, j = a_row[n], b_row[n]
        top = min(a_xyz[i, 2] + 0.5 * a_lwh[i, 2], b_xyz[j, 2] + 0.5 * b_lwh[j, 2])
        bottom = max(a_xyz[i, 2] - 0.5 * a_lwh[i, 2], b_xyz[j, 2] - 0.5 * b_lwh[j, 2])
        radius = 0.5 * (np.hypot(a_lwh[i, 0], a_lwh[i, 1]) + np.hypot(b_lwh[j, 0], b_lwh[j, 1]))
        dx, dy = b_xyz[j, 0] - a_xyz[i, 0], b_xyz[j, 1] - a_xyz[i, 1]
        if top <= bottom or dx * dx + dy * dy >= radius * radius:
            continue
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
            out[n] = min(1.0, common / (volume - common))
    return out
