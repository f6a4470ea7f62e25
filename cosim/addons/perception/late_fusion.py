"""Late fusion as cooperative data sets are evaluated: all boxes in one frame, then non-maximum suppression.

Of boxes that overlap, the one with the highest score is kept. This is the method `late` of OpenCOOD and V2V4Real.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.perception.matched import by_score
from cosim.addons.perception.overlap import in_blocks, iou_bev, near_pairs

NMS_OVERLAP = 0.15
"""Boxes that overlap by more than this from above are of one object: `nms_thresh` of OpenCOOD's configurations."""


def kept(
    frame: Int[ndarray, "n"],
    box: Float[ndarray, "n 7"],
    score: Float[ndarray, "n"],
    overlap: float = NMS_OVERLAP,
) -> Bool[ndarray, "n"]:
    """Boxes that non-maximum suppression keeps.

    Parameters
    ----------
    frame
        Frame of each box, in any order. Boxes of different frames do not suppress each other.
    box
        Centre x, y, z (up), length, width, height, yaw.
    score
        Of two boxes with the same score, the earlier one wins.
    overlap
        Intersection over union from above beyond which the lower score is suppressed.

    Notes
    -----
    In rounds: a box that no undecided box of higher score overlaps is kept, and suppresses those that it overlaps. The
    result is that of the usual loop over boxes by descending score.   Deviations: none.
    """
    i, j = _overlapping(frame, box, overlap)
    rank = by_score(score)
    first = rank[i] < rank[j]
    better = np.where(first, i, j)
    worse = np.where(first, j, i)
    undecided = np.ones(len(score), bool)
    chosen = np.zeros(len(score), bool)
    while undecided.any():
        open_pairs = undecided[better] & undecided[worse]
        better, worse = better[open_pairs], worse[open_pairs]
        beaten = np.zeros(len(score), bool)
        beaten[worse] = True
        winners = undecided & ~beaten
        chosen |= winners
        undecided &= beaten
        undecided[worse[winners[better]]] = False
    return chosen


def _overlapping(
    frame: Int[ndarray, "n"], box: Float[ndarray, "n 7"], overlap: float
) -> tuple[Int[ndarray, "p"], Int[ndarray, "p"]]:
    """Pairs of boxes of one frame that overlap by more than a share."""
    i, j = near_pairs(frame, box, frame, box)
    once = i < j
    i, j = i[once], j[once]
    near = in_blocks(iou_bev, box[i], box[j]) > overlap
    return i[near], j[near]
