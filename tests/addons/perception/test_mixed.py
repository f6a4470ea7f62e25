"""Mixtures of two worlds against counts and an average precision by hand."""

import numpy as np
import pytest

from cosim.addons.perception.matched import precision_and_recall
from cosim.addons.perception.measures.mixed import frames_at_speed, in_turn


def boxes(n: int, at: float = 0.0) -> np.ndarray:
    return np.tile([at, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], (n, 1))


def test_shares_give_the_mean_speed_and_use_one_world_whole():
    slow, fast = np.full(90, 4.0), np.full(90, 20.0)
    chosen = frames_at_speed(slow, fast, 8.0)  # a quarter of the frames is fast
    assert [len(one) for one in chosen] == [90, 30]
    np.testing.assert_array_equal(chosen[1], np.arange(0, 90, 3))
    speeds = np.concatenate([slow[chosen[0]], fast[chosen[1]]])
    assert speeds.mean() == pytest.approx(8.0)
    assert [len(one) for one in frames_at_speed(slow, fast[:12], 8.0)] == [36, 12]


@pytest.mark.parametrize("mean_mps", [4.0, 25.0])
def test_a_mean_speed_that_no_shares_give_is_a_mistake(mean_mps):
    with pytest.raises(ValueError, match="No shares of worlds with 4"):
        frames_at_speed(np.full(3, 4.0), np.full(3, 20.0), mean_mps)


def test_frames_take_turns_and_keep_their_objects_and_boxes():
    """Four frames of a world where all is found, two of one where a box misses each object. All ranked by frame."""
    frames = np.arange(6)
    all_found = (np.array([0, 2, 4, 5]), (frames, boxes(6)), (frames, boxes(6), -frames.astype(float)))
    none_found = (np.array([1, 3]), (frames, boxes(6)), (frames, boxes(6, at=9.0), -frames.astype(float)))
    truth, (frame, box, _) = in_turn([all_found, none_found])
    order = np.argsort(frame)
    np.testing.assert_array_equal(frame[order], np.arange(6))
    np.testing.assert_array_equal(box[order, 0], [0, 9, 0, 0, 9, 0])
    area, recall = precision_and_recall(truth, (frame[order], box[order], -np.arange(6.0)), 0.5)
    assert recall == pytest.approx(4 / 6)
    assert area == pytest.approx((1 + 3 / 4 + 3 / 4 + 4 / 6) / 6)  # right, wrong, right, right, wrong, right
