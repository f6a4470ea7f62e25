"""Boxes near given points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from sensors.boxes import Boxes


class Neighbours(NamedTuple):
    """Rows of the neighbours of M points, by point."""

    ptr: Int[ndarray, "m+1"]
    row: Int[ndarray, "k"]
    """Those of point o are row[ptr[o]:ptr[o + 1]], ascending."""

    def part(self, first: int, end: int) -> Neighbours:
        """Those of the points from `first` to before `end`."""
        ptr = self.ptr[first : end + 1]
        return Neighbours(ptr - ptr[0], self.row[ptr[0] : ptr[-1]])


def neighbours(points_m: Float[ndarray, "m d"], boxes: Boxes, range_m: float) -> Neighbours:
    """Boxes whose footprint may come within a horizontal range of each point."""
    n = len(boxes)
    if n == 0 or len(points_m) == 0:
        return Neighbours(np.zeros(len(points_m) + 1, np.int64), np.zeros(0, np.int64))
    limit = range_m + float(boxes.circumradius_m.max())
    pair = cKDTree(points_m[:, :2]).sparse_distance_matrix(cKDTree(boxes.xyz_m[:, :2]), limit, output_type="ndarray")
    key = np.sort(pair["i"].astype(np.int64) * n + pair["j"])
    return Neighbours(np.searchsorted(key, np.arange(len(points_m) + 1) * n), key % n)
