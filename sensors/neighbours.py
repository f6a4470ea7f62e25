"""Boxes and buildings near given points."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy
import shapely
from jaxtyping import Float, Int
from numpy import ndarray

from sensors.boxes import Boxes
from sensors.scene import Scene


class Neighbours(NamedTuple):
    """Rows of the neighbours of M points, by point."""

    ptr: Int[ndarray, "m+1"]
    row: Int[ndarray, "k"]
    """Those of point o are row[ptr[o]:ptr[o + 1]], ascending."""

    def part(self, first: int, end: int) -> Neighbours:
        """Those of the points from `first` to before `end`."""
        ptr = self.ptr[first : end + 1]
        row = self.row[ptr[0] : ptr[-1]]
        return Neighbours(ptr - ptr[0], row)


def neighbours(points_m: Float[ndarray, "m d"], boxes: Boxes, range_m: float) -> Neighbours:
    """Boxes whose footprint may come within a horizontal range of each point.

    Parameters
    ----------
    points_m
        Points in the frame of the boxes; only x and y count.
    boxes
        Boxes to choose from.
    range_m
        Horizontal range.

    Returns
    -------
    Rows of the boxes, by point. All boxes within range are there. So are some that are not, because all boxes are taken
    to be as large as the largest.
    """
    limit_m = range_m + float(boxes.circumradius_m.max(initial=0.0))
    return neighbours_in(scipy.spatial.cKDTree(boxes.xyz_m[:, :2]), points_m, limit_m)


def neighbours_in(tree: scipy.spatial.cKDTree, points_m: Float[ndarray, "m d"], limit_m: float) -> Neighbours:
    """Points of a tree within a horizontal distance of each point.

    Parameters
    ----------
    tree
        Points to choose from, x and y.
    points_m
        Points in the frame of the tree; only x and y count.
    limit_m
        Horizontal distance.

    Returns
    -------
    Rows of the points of the tree, by point.
    """
    if tree.n == 0 or len(points_m) == 0:
        ptr = np.zeros(len(points_m) + 1, np.int64)
        return Neighbours(ptr, np.zeros(0, np.int64))
    points = scipy.spatial.cKDTree(points_m[:, :2])
    pair = points.sparse_distance_matrix(tree, limit_m, output_type="ndarray")
    key = pair["i"].astype(np.int64) * tree.n + pair["j"]
    key.sort()
    first_key = np.arange(len(points_m) + 1) * tree.n
    return Neighbours(np.searchsorted(key, first_key), key % tree.n)


def buildings_near(points_m: Float[ndarray, "m d"], scene: Scene, range_m: float) -> Neighbours:
    """Buildings whose bounds touch the square of this half width around each point.

    Parameters
    ----------
    points_m
        Points in the world frame [m]; only x and y count.
    scene
        Buildings.
    range_m
        Half the width of the square [m].

    Returns
    -------
    Rows of the buildings, by point; in any order.
    """
    low, high = points_m - range_m, points_m + range_m
    square = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    point, building = _tree(scene).query(square)
    return Neighbours(np.searchsorted(point, np.arange(len(points_m) + 1)), building)


@lru_cache(maxsize=4)
def _tree(scene: Scene) -> shapely.STRtree:
    return shapely.STRtree(scene.footprints)
