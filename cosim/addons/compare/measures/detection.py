"""Detections of single vehicles against ground truth: precision, recall, errors, by level, range and overlap."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from cosim.addons.compare.facts import Measured
from cosim.addons.compare.measures.frames import Frames, range_of, rows
from results.metrics.kitti import LOOSE, STRICT, LabelledObjects, average_precision
from results.metrics.overlap import iou_3d
from results.run import Run

_APART = 1e4
"""Distance between frames in a search tree, larger than any range [m]."""


def precision_by_level(
    runs: Sequence[Run], *, label: str, loose: bool, levels: Sequence[str], points: int = 11
) -> Measured:
    """Average precision by KITTI's levels, over 11 or 40 recall points [%]."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        answer = average_precision(frames.truth, frames.found, label, min_overlap=(LOOSE if loose else STRICT)[label])
        found.append([answer[level].ap11 if points == 11 else answer[level].ap40 for level in levels])
    return Measured.of_replicates(found)


def precision_by_range(
    runs: Sequence[Run], *, label: str, edges_m: Sequence[float], min_points: int, overlap: float
) -> Measured:
    """Average precision over 40 recall points within ranges, of objects with enough returns [%].

    Parameters
    ----------
    edges_m
        Borders of the ranges.
    """
    found = []
    for run in runs:
        frames = Frames.of(run)
        counts = frames.n_points >= min_points
        found.append([frames.precision(counts, label, overlap, edges) for edges in pairwise(edges_m)])
    return Measured.of_replicates(found)


def recall_by_overlap(
    runs: Sequence[Run], *, overlaps: Sequence[float], min_score: float, labels: Sequence[str], range_m: float
) -> Measured:
    """Share of the objects with a return within range that some box overlaps by more than each of some shares."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        counts = np.isin(frames.truth.label, labels) & (frames.n_points > 0) & (frames.range_m <= range_m)
        best = _best_overlap(rows(frames.truth, counts), rows(frames.found, frames.found.score >= min_score))
        found.append([float((best > share).mean()) for share in overlaps])
    return Measured.of_replicates(found)


def recall_when_near(
    runs: Sequence[Run], *, label: str, range_m: float, min_points: int, overlap: float, min_score: float
) -> Measured:
    """Share of near objects with many returns that a box overlaps."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        near = (frames.truth.label == label) & (frames.range_m <= range_m) & (frames.n_points >= min_points)
        best = _best_overlap(rows(frames.truth, near), rows(frames.found, frames.found.score >= min_score))
        found.append([float((best > overlap).mean())])
    return Measured.of_replicates(found)


def share_with_returns(runs: Sequence[Run], *, labels: Sequence[str], min_points: int, range_m: float) -> Measured:
    """Share of the objects of each class with a return within range that have at least some number of returns."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        seen = (frames.n_points > 0) & (frames.range_m <= range_m)
        enough = frames.n_points >= min_points
        found.append([float(enough[seen & (frames.truth.label == label)].mean()) for label in labels])
    return Measured.of_replicates(found)


def boxes_per_frame(runs: Sequence[Run], *, min_score: float, range_m: float) -> Measured:
    """Mean number of boxes that a vehicle reports ahead of it per sweep."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        n = int(((frames.found.score >= min_score) & (range_of(frames.found) <= range_m)).sum())
        found.append([n / max(len(frames.poses), 1)])
    return Measured.of_replicates(found)


def position_error_of_boxes(
    runs: Sequence[Run], *, label: str, range_m: float, match_m: float, min_score: float
) -> Measured:
    """Mean horizontal distance between objects and the boxes nearest to them, if it is at most `match_m` [m]."""
    found = []
    for run in runs:
        frames = Frames.of(run)
        truth = rows(frames.truth, (frames.truth.label == label) & (frames.range_m <= range_m))
        boxes = rows(frames.found, (frames.found.label == label) & (frames.found.score >= min_score))
        away = _nearest(truth, boxes, match_m)
        found.append([float(away[away <= match_m].mean())])
    return Measured.of_replicates(found)


def _pairs(truth: LabelledObjects, found: LabelledObjects, reach_m: float) -> tuple[ndarray, ndarray, ndarray]:
    """Rows of both in the same frame whose centres are within reach, and their distance."""
    if not len(truth) or not len(found):
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    a, b = (cKDTree(np.column_stack([one.frame * _APART, one.box[:, :2]])) for one in (truth, found))
    near = a.sparse_distance_matrix(b, reach_m, output_type="ndarray")
    return near["i"], near["j"], near["v"]


def _best_overlap(truth: LabelledObjects, found: LabelledObjects) -> Float[ndarray, "t"]:
    """Largest overlap of each object with a box."""
    i, j, _ = _pairs(truth, found, 15.0)
    best = np.zeros(len(truth))
    np.maximum.at(best, i, iou_3d(truth.box[i], found.box[j]))
    return best


def _nearest(truth: LabelledObjects, found: LabelledObjects, reach_m: float) -> Float[ndarray, "t"]:
    """Distance of each object to the nearest box; infinite beyond reach."""
    i, _, distance = _pairs(truth, found, reach_m)
    away = np.full(len(truth), np.inf)
    np.minimum.at(away, i, distance)
    return away
