"""Non-maximum suppression against the usual loop, and average precision by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.addons.perception.late_fusion import kept
from cosim.addons.perception.matched import precision_and_recall
from cosim.addons.perception.overlap import iou_bev


def by_loop(frame, box, score, overlap):
    """Boxes by descending score; each suppresses those that it overlaps."""
    keep = np.ones(len(score), bool)
    order = sorted(range(len(score)), key=lambda k: (-score[k], k))
    for a, i in enumerate(order):
        if keep[i]:
            for j in order[a + 1 :]:
                if frame[i] == frame[j] and iou_bev(box[[i]], box[[j]])[0] > overlap:
                    keep[j] = False
    return keep


def crowd(seed: int, n: int):
    rng = np.random.default_rng(seed)
    box = np.column_stack([
        rng.uniform(-8, 8, (n, 2)), np.full(n, 0.8), np.full(n, 4.4), np.full(n, 1.8), np.full(n, 1.5),
        rng.uniform(-3, 3, n),
    ])  # fmt: skip
    return rng.integers(0, 3, n), box, rng.integers(0, 6, n) / 6  # with scores that are the same


@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(0, 40), st.sampled_from([0.0, 0.15, 0.5]))
def test_suppression_is_that_of_the_loop(seed, n, overlap):
    frame, box, score = crowd(seed, n)
    assert kept(frame, box, score, overlap).tolist() == by_loop(frame, box, score, overlap).tolist()


def car(x: float, y: float = 0.0) -> list[float]:
    return [x, y, 0.75, 4.0, 2.0, 1.5, 0.0]


def test_average_precision_by_hand():
    # Objects: A, B in frame 0, C in frame 1. Boxes by score: 0.9 on A (right), 0.8 beside all (wrong), 0.7 on A again
    # (wrong: A is taken), 0.6 on C (right); B is missed. Shifted by 1 m of 4 m: IoU 3 / 5.
    truth = np.array([0, 0, 1]), np.array([car(0), car(20), car(0)])
    found = np.array([0, 0, 0, 1]), np.array([car(0), car(40), car(0.1), car(1)]), np.array([0.9, 0.8, 0.7, 0.6])
    # recall 1/3 at precision 1, then 2/3 at precision 2/4; the area is 1/3 + 1/3 * 1/2
    assert precision_and_recall(truth, found, 0.5) == pytest.approx((0.5, 2 / 3))
    assert precision_and_recall(truth, found, 0.61) == pytest.approx((1 / 3, 1 / 3))
    empty = np.zeros(0, int), np.zeros((0, 7))
    assert np.isnan(precision_and_recall(empty, found, 0.5)).all()
    assert precision_and_recall(truth, (*empty, np.zeros(0)), 0.5) == (0.0, 0.0)


def test_volumes_and_footprints_differ():
    truth = np.array([0]), np.array([car(0)])
    higher = np.array([[0, 0, 1.5, 4.0, 2.0, 1.5, 0.0]])  # half of the height in common: IoU 1 / 3
    found = np.array([0]), higher, np.array([1.0])
    assert precision_and_recall(truth, found, 0.5, "bev")[0] == 1
    assert precision_and_recall(truth, found, 0.5, "3d")[0] == 0
