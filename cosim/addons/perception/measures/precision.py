"""Detections of single vehicles against ground truth: precision, recall, errors, by level, range and overlap."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.perception.kitti import LOOSE, STRICT, LabelledObjects, average_precision
from cosim.addons.perception.measures.frames import Frames, range_of
from cosim.addons.perception.overlap import iou_3d
from results.run import Run

_IGNORED = 4
"""Level of occlusion above those that any level of difficulty counts."""
_APART = 1e4
"""Distance between frames in a search tree, larger than any range [m]."""


def precision_by_level(
    run: Run, *, label: str, loose: bool, levels: Sequence[str], points: int = 11, least_points: int = 0
) -> list[float]:
    """Average precision by KITTI's levels, over 11 or 40 recall points [%].

    Parameters
    ----------
    least_points
        Objects with fewer returns count neither as there nor, where a box is on them, as wrong.
    """
    frames = Frames.of(run)
    level = np.where(frames.n_points >= least_points, frames.truth.occlusion, _IGNORED)
    truth = replace(frames.truth, occlusion=level) if least_points else frames.truth
    overlaps = LOOSE if loose else STRICT
    answer = average_precision(truth, frames.found, label, min_overlap=overlaps[label])
    precisions = [answer[level] for level in levels]
    return [one.ap11 if points == 11 else one.ap40 for one in precisions]


def precision_by_range(
    run: Run, *, label: str, edges_m: Sequence[float], min_points: int, overlap: float
) -> list[float]:
    """Average precision over 40 recall points between distances, of objects with enough returns [%].

    Parameters
    ----------
    edges_m
        Borders of the ranges.
    """
    frames = Frames.of(run)
    counts = frames.n_points >= min_points
    return [frames.precision(counts, label, overlap, edges) for edges in pairwise(edges_m)]


def recall_by_overlap(
    run: Run,
    *,
    overlaps: Sequence[float],
    labels: Sequence[str],
    range_m: float,
    min_score: float = 0.0,
    min_points: int = 1,
) -> list[float]:
    """Share of the objects within range with some returns that some box overlaps by more than each of some shares."""
    frames = Frames.of(run)
    truth, boxes = frames.truth, frames.found
    is_seen = (frames.n_points >= min_points) & (frames.range_m <= range_m)
    counts = np.isin(truth.label, labels) & is_seen
    best = _best_overlap(truth.take(counts), boxes.take(boxes.score >= min_score))
    return [float((best > share).mean()) for share in overlaps]


def share_with_returns(run: Run, *, labels: Sequence[str], min_points: int, range_m: float) -> list[float]:
    """Share of the objects of each class with a return within range that have at least some number of returns."""
    frames = Frames.of(run)
    seen = (frames.n_points > 0) & (frames.range_m <= range_m)
    has_many = frames.n_points >= min_points
    label = frames.truth.label
    return [float(has_many[seen & (label == one)].mean()) for one in labels]


def boxes_per_frame(run: Run, *, min_score: float, range_m: float) -> list[float]:
    """Mean number of boxes that a vehicle reports ahead of it per sweep."""
    frames = Frames.of(run)
    boxes = frames.found
    counts = (boxes.score >= min_score) & (range_of(boxes) <= range_m)
    return [int(counts.sum()) / max(len(frames.poses), 1)]


def position_error_of_boxes(run: Run, *, label: str, range_m: float, match_m: float, min_score: float) -> list[float]:
    """Mean horizontal distance between objects and the boxes nearest to them, if it is at most `match_m` [m]."""
    frames = Frames.of(run)
    truth = frames.truth.take((frames.truth.label == label) & (frames.range_m <= range_m))
    boxes = frames.found
    boxes = boxes.take((boxes.label == label) & (boxes.score >= min_score))
    away = _nearest(truth, boxes, match_m)
    return [float(away[away <= match_m].mean())]


def _pairs(truth: LabelledObjects, found: LabelledObjects, reach_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """Rows of both in the same frame whose centres are within reach, and their distance."""
    if not len(truth) or not len(found):
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    a, b = (_centres(of) for of in (truth, found))
    near = a.sparse_distance_matrix(b, reach_m, output_type="ndarray")
    return near["i"], near["j"], near["v"]


def _centres(of: LabelledObjects) -> cKDTree:
    """Centres of boxes on the plane, those of frames apart."""
    return cKDTree(np.column_stack([of.frame * _APART, of.box[:, :2]]))


def _best_overlap(truth: LabelledObjects, found: LabelledObjects) -> Float[ndarray, "t"]:
    """Largest overlap of each object with a box."""
    i, j, _ = _pairs(truth, found, 15.0)
    share = iou_3d(truth.box[i], found.box[j])
    best = np.zeros(len(truth))
    np.maximum.at(best, i, share)
    return best


def _nearest(truth: LabelledObjects, found: LabelledObjects, reach_m: float) -> Float[ndarray, "t"]:
    """Distance of each object to the nearest box; infinite beyond reach."""
    i, _, distance = _pairs(truth, found, reach_m)
    away = np.full(len(truth), np.inf)
    np.minimum.at(away, i, distance)
    return away
