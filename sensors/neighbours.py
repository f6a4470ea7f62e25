"""Boxes near given points."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from sensors.boxes import Boxes


def neighbours(
    points_m: Float[ndarray, "m d"], boxes: Boxes, range_m: float
) -> tuple[Int[ndarray, "m+1"], Int[ndarray, "k"]]:
    """Boxes whose footprint may come within a horizontal range of each point.

    Returns
    -------
    ptr, row: the neighbours of point o are the box rows row[ptr[o]:ptr[o + 1]], ascending.
    """
    n = len(boxes)
    if n == 0 or len(points_m) == 0:
        return np.zeros(len(points_m) + 1, np.int64), np.zeros(0, np.int64)
    limit = range_m + float(boxes.circumradius_m.max())
    pair = cKDTree(points_m[:, :2]).sparse_distance_matrix(cKDTree(boxes.xyz_m[:, :2]), limit, output_type="ndarray")
    key = np.sort(pair["i"].astype(np.int64) * n + pair["j"])
    return np.searchsorted(key, np.arange(len(points_m) + 1) * n), key % n
