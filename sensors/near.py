"""Who is near whom."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree

from sensors.boxes import Boxes


def near(
    places_m: Float[ndarray, "m d"], boxes: Boxes, within_m: float
) -> tuple[Int[ndarray, "m+1"], Int[ndarray, "k"]]:
    """Boxes whose footprint may come within a horizontal distance of each place.

    Returns
    -------
    ptr, row: place o sees box rows row[ptr[o]:ptr[o + 1]], ascending.
    """
    n = len(boxes)
    if n == 0 or len(places_m) == 0:
        return np.zeros(len(places_m) + 1, np.int64), np.zeros(0, np.int64)
    reach = within_m + float(boxes.reach_m.max())
    pair = cKDTree(places_m[:, :2]).sparse_distance_matrix(cKDTree(boxes.xyz_m[:, :2]), reach, output_type="ndarray")
    key = np.sort(pair["i"].astype(np.int64) * n + pair["j"])
    return np.searchsorted(key, np.arange(len(places_m) + 1) * n), key % n
