"""Which detections of different observers may be of one object, by the accuracy that is stated of each.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley, 2001,
   chapter 3: the gate of a measurement by its squared Mahalanobis distance.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from scipy.spatial import cKDTree

from sensors.boxes import Boxes, iou_3d

Pairs = tuple[Int[ndarray, "k"], Int[ndarray, "k"], Float[ndarray, "k"]]
"""Rows of two boxes, and how well they agree, in (0, 1]; sorted by the two rows."""

LEAST_VARIANCE_M2, MOST_VARIANCE_M2 = 0.02**2, 2.0**2
"""Stated variances count as at least and at most this along any axis. Nobody escapes a comparison by stating that a
detection may be anywhere; 2 m is what a car that was last seen half a second ago may be off."""
_GROUPS = ((0, 3), (1, 2))
"""Detectors confuse cars with trucks, and pedestrians with cyclists."""


class Gate(NamedTuple):
    """When two detections may be of one object."""

    miss_p: float
    """Probability that two detections of one object are farther apart than the gate, if their accuracies are true."""
    least_iou: float
    """Boxes that overlap by more than this may be of one object, too."""

    @property
    def reach(self) -> float:
        """Radius of the gate in standard deviations: P(d^2 > x) = exp(-x / 2) in two dimensions."""
        return float(np.sqrt(-2.0 * np.log(self.miss_p)))


def bounded(variance_m2: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Variances (xx, xy, yy) with eigenvalues within `LEAST_VARIANCE_M2` and `MOST_VARIANCE_M2`.

    What is no variance (not finite, not positive) becomes the largest one.
    """
    xx, xy, yy = variance_m2.T
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    spread = np.hypot(half, xy)
    with np.errstate(invalid="ignore"):
        low, high = mean - spread, mean + spread
        is_variance = np.isfinite(high) & (low >= -1e-9 * np.abs(high))
    low, high = (np.clip(np.where(is_variance, x, np.inf), LEAST_VARIANCE_M2, MOST_VARIANCE_M2) for x in (low, high))
    safe = np.where(is_variance & (spread > 0), spread, 1.0)
    turn_x = np.where(is_variance & (spread > 0), half / safe, 1.0)
    turn_y = np.where(is_variance & (spread > 0), xy / safe, 0.0)
    mean, spread = 0.5 * (high + low), 0.5 * (high - low)
    return np.column_stack([mean + spread * turn_x, spread * turn_y, mean - spread * turn_x])


def certainty(variance_m2: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
    """How much of the region in which each detection may be is inside the bounds, in (0, 1].

    It is the ratio of the areas of two ellipses: of the bounded variance, and of the variance itself.
    """
    xx, xy, yy = variance_m2.T
    b_xx, b_xy, b_yy = bounded(variance_m2).T
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.sqrt((b_xx * b_yy - b_xy * b_xy) / (xx * yy - xy * xy))
    return np.where(np.isfinite(share), np.minimum(share, 1.0), 1.0)


def pairs_within(
    boxes: Boxes, label: UInt8[ndarray, "n"], variance_m2: Float[ndarray, "n 3"], owner: Int[ndarray, "n"], gate: Gate
) -> Pairs:
    """All pairs i < j of different owners that may be of one object.

    Parameters
    ----------
    boxes, label
        Detections in one frame.
    variance_m2
        Variance of each position (xx, xy, yy), as `bounded` returns it.
    owner
        The vehicle that reports each.
    gate
        When two detections may be of one object.

    Notes
    -----
    The agreement of a pair is the probability that two detections of one object are at least as far apart, exp(-d^2/2)
    with the squared Mahalanobis distance d^2 of their centres under the sum of both variances [1]_. If the boxes
    overlap by more than `least_iou`, it is at least their IoU. Where one box is longer or wider, half the difference is
    not counted as distance: a truck of which a vehicle sees the rear as a car is where that car is.
    """
    i, j = _near(boxes, label, variance_m2, boxes, label, variance_m2, gate, is_same=True)
    kept = owner[i] != owner[j]
    i, j = np.minimum(i, j)[kept], np.maximum(i, j)[kept]
    return _agreeing(boxes, variance_m2, boxes, variance_m2, i, j, gate)


def pairs_across(
    a: Boxes, a_label: UInt8[ndarray, "n"], a_variance_m2: Float[ndarray, "n 3"], b: Boxes,
    b_label: UInt8[ndarray, "m"], b_variance_m2: Float[ndarray, "m 3"], gate: Gate,
) -> Pairs:  # fmt: skip
    """All pairs of a detection of `a` and one of `b` that may be of one object; as `pairs_within`."""
    i, j = _near(a, a_label, a_variance_m2, b, b_label, b_variance_m2, gate, is_same=False)
    return _agreeing(a, a_variance_m2, b, b_variance_m2, i, j, gate)


def _near(
    a: Boxes, a_label: ndarray, a_variance_m2: ndarray, b: Boxes, b_label: ndarray, b_variance_m2: ndarray, gate: Gate,
    is_same: bool,
) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:  # fmt: skip
    """Pairs of classes that go together, no farther apart than their boxes or gates reach."""
    found = [np.zeros((0, 2), np.int64)]
    for group in _GROUPS:
        for one, other in combinations_with_replacement(group, 2):
            orders = [(one, other)] if one == other or is_same else [(one, other), (other, one)]
            for of_a, of_b in orders:
                rows, columns = np.flatnonzero(a_label == of_a), np.flatnonzero(b_label == of_b)
                if not len(rows) or not len(columns):
                    continue
                by_size = a.circumradius_m[rows].max() + b.circumradius_m[columns].max()
                most = _largest(a_variance_m2[rows]) + _largest(b_variance_m2[columns])
                reach_m = max(float(by_size), gate.reach * float(np.sqrt(most)))
                tree = cKDTree(a.xyz_m[rows, :2])
                if is_same and of_a == of_b:
                    found.append(rows[tree.query_pairs(reach_m, output_type="ndarray")])
                    continue
                near = tree.sparse_distance_matrix(cKDTree(b.xyz_m[columns, :2]), reach_m, output_type="ndarray")
                found.append(np.column_stack([rows[near["i"]], columns[near["j"]]]))
    i, j = np.concatenate(found).T
    return i, j


def _largest(variance_m2: Float[ndarray, "n 3"]) -> float:
    """Largest variance along any axis."""
    xx, xy, yy = variance_m2.T
    return float((0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)).max())


def _agreeing(
    a: Boxes, a_variance_m2: ndarray, b: Boxes, b_variance_m2: ndarray, i: Int[ndarray, "k"], j: Int[ndarray, "k"],
    gate: Gate,
) -> Pairs:  # fmt: skip
    """Those of the pairs that pass the gate, and how well they agree."""
    x, y = (a.xyz_m[i, :2] - b.xyz_m[j, :2]).T
    apart_m2 = x * x + y * y
    x, y = _beyond_size(a, b, i, j, x, y)
    xx, xy, yy = (a_variance_m2[i] + b_variance_m2[j]).T
    square = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
    agreement = np.exp(-0.5 * square)
    agreement[agreement <= gate.miss_p] = 0.0
    reach_m = a.circumradius_m[i] + b.circumradius_m[j]
    may_overlap = np.flatnonzero(apart_m2 < reach_m * reach_m)
    iou = iou_3d(a.take(i[may_overlap]), b.take(j[may_overlap]))
    iou[iou <= gate.least_iou] = 0.0
    agreement[may_overlap] = np.maximum(agreement[may_overlap], iou)
    kept = np.flatnonzero(agreement > 0.0)
    kept = kept[np.lexsort((j[kept], i[kept]))]
    return i[kept].astype(np.int32), j[kept].astype(np.int32), agreement[kept]


def _beyond_size(
    a: Boxes, b: Boxes, i: Int[ndarray, "k"], j: Int[ndarray, "k"], x: Float[ndarray, "k"], y: Float[ndarray, "k"]
) -> tuple[Float[ndarray, "k"], Float[ndarray, "k"]]:
    """Distances of centres, without what different sizes of the boxes explain, along the axes of the longer box."""
    slack_m = 0.5 * np.abs(a.lwh_m[i, :2] - b.lwh_m[j, :2])
    yaw = np.where(a.lwh_m[i, 0] >= b.lwh_m[j, 0], a.yaw_rad[i], b.yaw_rad[j])
    cos, sin = np.cos(yaw), np.sin(yaw)
    along, across = cos * x + sin * y, cos * y - sin * x
    along = np.sign(along) * np.maximum(np.abs(along) - slack_m[:, 0], 0.0)
    across = np.sign(across) * np.maximum(np.abs(across) - slack_m[:, 1], 0.0)
    return cos * along - sin * across, sin * along + cos * across
