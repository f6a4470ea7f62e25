"""Average precision by the rules of the KITTI object benchmark, all frames and thresholds at once.

The rules are those of the benchmark's own program (Geiger et al. 2012, with the fourth level "all" of Hurl
et al.): ground truths are matched in file order; recall thresholds come from a first pass in which each takes
the free detection with the highest score; precision at each threshold from a second one in which each takes
the free detection with the largest overlap. Deviations: none.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from cosim.addons.perception.overlap import in_blocks, iou_3d, iou_bev, near_pairs
from cosim.base.ragged import differs_from_last, place_in_group
from cosim.base.rows import Rows

LEVELS = ("easy", "moderate", "hard", "all")
MIN_HEIGHT_PX = (40, 25, 25, 0)
MAX_OCCLUSION = (0, 1, 2, 3)
MAX_TRUNCATION = (0.15, 0.30, 0.50, 1.0)

STRICT = {"car": 0.7, "pedestrian": 0.5, "cyclist": 0.5, "truck": 0.7}
"""Smallest overlap of a hit, by class (KITTI's; trucks, which KITTI does not rank, as cars)."""

LOOSE = {"car": 0.5, "pedestrian": 0.25, "cyclist": 0.25, "truck": 0.5}

_NEIGHBOUR = {"car": "van", "pedestrian": "person_sitting"}
"""Neither right nor wrong to report in place of the class."""

_N_SAMPLES = 41

FEWEST = 41
"""Ground truths below which average precision says little: every recall threshold wants a hit of its own."""

Overlap = Literal["3d", "bev"]


@dataclass(frozen=True, slots=True)
class LabelledObjects(Rows):
    """Labelled boxes of many frames, in file order within a frame."""

    frame: Int[ndarray, "n"]
    label: ndarray
    """Class names in lower case [n]."""
    box: Float[ndarray, "n 7"]
    """Centre x, y, z (up), length, width, height, yaw."""
    height_px: Float[ndarray, "n"]
    """Height in the observer's image."""
    occlusion: Int[ndarray, "n"]
    """Level: 0 visible, 1 partly, 2 largely hidden, 3 unknown. Not used of detections."""
    truncation: Float[ndarray, "n"]
    """Share outside of the image. Not used of detections."""
    score: Float[ndarray, "n"]
    """Not used of ground truth."""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True)
class Precision:
    """What the program says of one class at one level."""

    ap11: float
    """Mean of the interpolated precision at recall 0, 0.1, ..., 1 (the benchmark until 2019)."""
    ap40: float
    """Mean of the interpolated precision at recall 1/40, 2/40, ..., 1 (since 2019)."""
    precision: Float[ndarray, "41"]
    """Interpolated precision at recall 0, 1/40, ..., 1; 0 where the recall is not reached."""
    n_truth: int
    """Ground truths that count."""


def average_precision(
    truth: LabelledObjects,
    found: LabelledObjects,
    label: str,
    overlap: Overlap = "3d",
    min_overlap: float | None = None,
) -> dict[str, Precision]:
    """Average precision of one class, by level.

    Parameters
    ----------
    min_overlap
        A hit overlaps by more than this; left out, that of the benchmark for the class.
    """
    limit = STRICT[label] if min_overlap is None else min_overlap
    i, j, share = _candidates(truth, found, overlap)
    hit = share > limit
    hits = i[hit], j[hit], share[hit]
    levels = {}
    for rank, level in enumerate(LEVELS):
        levels[level] = _level(truth, found, label, rank, *hits)
    return levels


def _level(
    truth: LabelledObjects,
    found: LabelledObjects,
    label: str,
    level: int,
    i: ndarray,
    j: ndarray,
    share: ndarray,
) -> Precision:
    """Both passes. A ground truth or detection counts, is ignored (neither right nor wrong), or is out."""
    hard = (
        (truth.occlusion > MAX_OCCLUSION[level])
        | (truth.truncation > MAX_TRUNCATION[level])
        | (truth.height_px <= MIN_HEIGHT_PX[level])
    )
    same = truth.label == label
    counts = same & ~hard
    ignored = (truth.label == _NEIGHBOUR.get(label, "")) | (same & hard)
    found_small = np.trunc(found.height_px) < MIN_HEIGHT_PX[level]  # whatever its class
    found_counts = ~found_small & (found.label == label)

    kept = (counts | ignored)[i] & (found_small | found_counts)[j]
    i, j, share = i[kept], j[kept], share[kept]
    n_truth = int(counts.sum())

    everything = np.ones((1, len(found)), bool)
    by_score = np.lexsort((j, -found.score[j], i))
    taker, _ = _match(truth.frame, i[by_score], j[by_score], everything)
    taken = by_score[taker[0]]
    of, by = i[taken], j[taken]
    is_right = counts[of] & found_counts[by]
    thresholds = _thresholds(found.score[by[is_right]], n_truth)

    above = found.score[None, :] >= thresholds[:, None]
    is_small = found_small[j]
    by_overlap = np.lexsort((j, np.where(is_small, 0, -share), is_small, i))
    of, by = i[by_overlap], j[by_overlap]
    taker, used = _match(truth.frame, of, by, above)
    n_right = (taker & counts[of] & found_counts[by]).sum(axis=1)
    n_wrong = (above & ~used & found_counts).sum(axis=1)

    precision = np.zeros(_N_SAMPLES)
    precision[: len(thresholds)] = n_right / np.maximum(n_right + n_wrong, 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    ap11 = 100 * precision[::4].mean()
    ap40 = 100 * precision[1:].mean()
    return Precision(ap11, ap40, precision, n_truth)


def _match(
    frame: Int[ndarray, "n"],
    i: Int[ndarray, "p"],
    j: Int[ndarray, "p"],
    allowed: Bool[ndarray, "t m"],
) -> tuple[Bool[ndarray, "t p"], Bool[ndarray, "t m"]]:
    """Each ground truth in turn takes its first free candidate; pairs are sorted by (i, preference).

    The turn-th ground truths of all frames are served at once, since frames share no detections.
    Returns which pairs are taken and which detections are used, for each row of `allowed`.
    """
    taken = np.zeros((len(allowed), len(i)), bool)
    used = np.zeros_like(allowed)
    is_first = differs_from_last(i)
    first = np.flatnonzero(is_first)
    group = np.cumsum(is_first) - 1  # ground truths that have candidates
    turn = place_in_group(frame[i[first]])[group]
    order = np.argsort(turn, kind="stable")
    for pairs in np.split(order, np.flatnonzero(np.diff(turn[order])) + 1):
        candidate = j[pairs]
        free = allowed[:, candidate] & ~used[:, candidate]
        begins = np.flatnonzero(differs_from_last(group[pairs]))
        begin = begins[np.searchsorted(begins, np.arange(len(pairs)), "right") - 1]  # of the own ground truth
        n_free = np.cumsum(free, axis=1, dtype=np.int32)
        n_before = (n_free - free)[:, begin]
        takes = free & (n_free - n_before == 1)  # the first free candidate of each ground truth
        taken[:, pairs] = takes
        used[:, candidate] |= takes
    return taken, used


def _thresholds(scores: Float[ndarray, "n"], n_truth: int) -> Float[ndarray, "t"]:
    """Scores at which recall comes nearest to 0, 1/40, ..., 1."""
    kept, recall = [], 0.0
    ordered = np.sort(scores)[::-1].tolist()
    for rank, score in enumerate(ordered, 1):
        last = rank == len(ordered)
        left, right = rank / n_truth, (rank if last else rank + 1) / n_truth
        if not last and right - recall < recall - left:
            continue
        kept.append(score)
        recall += 1 / (_N_SAMPLES - 1)
    return np.array(kept, float)


def _candidates(truth: LabelledObjects, found: LabelledObjects, overlap: Overlap) -> tuple[ndarray, ndarray, ndarray]:
    """Pairs of the same frame that may overlap, and their intersection over union."""
    for of in truth, found:
        assert (np.diff(of.frame) >= 0).all(), "frames are not sorted"
    real = np.flatnonzero(truth.box[:, 3] > 0)  # DontCare areas have no box
    frame, box = truth.frame[real], truth.box[real]
    i, j = near_pairs(frame, box, found.frame, found.box)
    i = real[i]
    share_of = iou_3d if overlap == "3d" else iou_bev
    return i, j, in_blocks(share_of, truth.box[i], found.box[j])
