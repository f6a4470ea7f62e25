"""Average precision as cooperative data sets count it: all boxes ranked together, area under the whole curve.

A box is right if it overlaps an object that no box of higher score has taken by at least a share. This is the rule of
OpenCOOD with `global_sort_detections`, with the overlap from above, and of Pascal VOC since 2010.
"""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from cosim.addons.perception.kitti import Overlap
from cosim.addons.perception.overlap import in_blocks, iou_3d, iou_bev, near_pairs

Truth = tuple[Int[ndarray, "t"], Float[ndarray, "t 7"]]
"""Frame and box of each object."""
Found = tuple[
    Int[ndarray, "n"],
    Float[ndarray, "n 7"],
    Float[ndarray, "n"],
]
"""Frame, box and score of each detection."""


def precision_and_recall(truth: Truth, found: Found, overlap: float, kind: Overlap = "bev") -> tuple[float, float]:
    """Average precision, and recall over all boxes, in [0, 1]; NaN if there are no objects.

    Parameters
    ----------
    overlap
        A box is right from this intersection over union on.
    kind
        Overlap of footprints, as OpenCOOD takes it, or of volumes.

    Notes
    -----
    Boxes are taken by descending score, those of the same score in their order. Each takes the free object that it
    overlaps most.   Deviations: none.
    """
    frame, box = truth
    of, boxes, score = found
    if not len(frame):
        return float("nan"), float("nan")
    i, j, share = _overlapping(frame, box, of, boxes, kind)
    near = share >= overlap
    i, j, share = i[near], j[near], share[near]
    rank = by_score(score)
    order = np.lexsort([i, -share, rank[j]])
    taken = np.zeros(len(frame), bool)
    right = np.zeros(len(score), bool)
    for k in order.tolist():  # a pair per overlap, not per box
        if not taken[i[k]] and not right[j[k]]:
            taken[i[k]] = right[j[k]] = True
    hit = np.zeros(len(score), bool)
    hit[rank] = right
    n_right = np.cumsum(hit)
    recall = n_right / len(frame)
    precision = n_right / np.arange(1, len(score) + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    step = np.diff(recall, prepend=0.0)
    return float((step * precision).sum()), float(right.sum() / len(frame))


def by_score(score: Float[ndarray, "n"]) -> Int[ndarray, "n"]:
    """Place of each box by descending score; of equal ones, the earlier box comes first."""
    rank = np.empty(len(score), np.int64)
    rank[np.argsort(-score, kind="stable")] = np.arange(len(score))
    return rank


def _overlapping(
    frame: ndarray, box: Float[ndarray, "t 7"], of: ndarray, boxes: Float[ndarray, "n 7"], kind: Overlap
) -> tuple[ndarray, ndarray, Float[ndarray, "p"]]:
    """Pairs of an object and a detection of the same frame that may overlap, and by how much."""
    i, j = near_pairs(frame, box, of, boxes)
    share_of = iou_3d if kind == "3d" else iou_bev
    return i, j, in_blocks(share_of, box[i], boxes[j])
