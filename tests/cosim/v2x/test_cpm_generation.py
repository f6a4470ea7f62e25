"""Generation rules: what is included again, and what is not."""

import numpy as np
import pytest

from cosim.v2x.cpm_generation import InclusionMemory, select_objects
from cosim.v2x.messages import SELF, SENSED, Detections
from sensors.boxes import Boxes

CAR, PEDESTRIAN = 0, 1


def list_of(*rows):
    """Detections from (observer, label, x, yaw in degrees); the first of each observer is its report of itself."""
    observer, label, x, yaw = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    k = np.arange(n) - np.searchsorted(observer, observer)
    return Detections.perceived(
        observer, k, label.astype(np.uint8), Boxes(np.column_stack([x, np.zeros(n), np.zeros(n)]).astype(float),
        np.ones((n, 3)), np.radians(yaw.astype(float))), np.ones(n), np.zeros(n, np.int32),
        np.where(k == 0, SELF, SENSED).astype(np.uint8),
    )  # fmt: skip


def story(*frames):
    """Who is included in each (time, detections)."""
    memory, out = InclusionMemory(), []
    for time_s, seen in frames:
        chosen, memory = select_objects(memory, seen, seen.observer, time_s)
        out.append(chosen.tolist())
    return out


def test_what_stands_is_sent_once_a_second():
    parked = list_of((0, CAR, 0, 0), (0, CAR, 30, 0))
    assert story(*((t / 10, parked) for t in range(12))) == [[t in (0, 10)] * 2 for t in range(12)]


def test_moved_turned_and_new():
    def at(x, yaw=0.0):
        return list_of((0, CAR, 0, 0), (0, CAR, x, yaw))

    # 3.9 m is not enough, 4.2 m since the last inclusion is; then 3 degrees are not, and 5 are.
    frames = [(0.0, at(30)), (0.1, at(33.9)), (0.2, at(34.2)), (0.3, at(34.2, 3)), (0.4, at(34.2, 5))]
    assert [car for _, car in story(*frames)] == [True, False, True, False, True]
    # Across 180 degrees too.
    assert [car for _, car in story((0.0, at(30, 179)), (0.1, at(30, -179)))] == [True, False]
    late = list_of((0, CAR, 0, 0), (0, CAR, 30, 0), (0, CAR, 60, 0))
    assert story((0.0, at(30)), (0.1, late))[1] == [False, False, True]


def test_people_go_together_after_half_a_second():
    crowd = list_of((0, CAR, 0, 0), (0, PEDESTRIAN, 10, 0), (0, PEDESTRIAN, 20, 0))
    more = list_of((0, CAR, 0, 0), (0, PEDESTRIAN, 10, 0), (0, PEDESTRIAN, 20, 0), (0, PEDESTRIAN, 30, 0))
    first, again, new, wait, over = story((0, crowd), (0.4, crowd), (0.5, more), (0.9, more), (1.0, more))
    assert first == [True] * 3 and again == [False] * 3
    assert new == [False, True, True, True]  # half a second is over
    assert wait == [False] * 4 and over == [True] * 4
    assert story((0, crowd), (0.1, more))[1] == [False, True, True, True]  # one is new, so all


def test_every_vehicle_has_a_memory_of_its_own():
    two = list_of((0, CAR, 0, 0), (0, CAR, 30, 0), (1, CAR, 60, 0), (1, CAR, 30, 0))
    one = list_of((0, CAR, 0, 0), (0, CAR, 30, 0))
    assert story((0, one), (0.1, two))[1] == [False, False, True, True]


@pytest.mark.parametrize("interval_s", [1.0, 2.0])
def test_at_one_hertz_all_is_sent(interval_s):
    g = np.random.default_rng(1)
    rows = [(o, int(g.integers(0, 4)), float(g.uniform(0, 60)), 0.0) for o in range(20) for _ in range(8)]
    assert all(all(chosen) for chosen in story(*((t * interval_s, list_of(*rows)) for t in range(4))))


def test_what_an_attack_hides_is_not_included():
    seen = list_of((0, CAR, 0, 0), (0, CAR, 30, 0))
    seen.transmitted[1] = False
    chosen, memory = select_objects(InclusionMemory(), seen, seen.observer, 0.0)
    assert chosen.tolist() == [True, False] and len(memory.of) == 1
    nothing = seen.take(np.zeros(0, int))
    chosen, memory = select_objects(memory, nothing, nothing.observer, 5.0)
    assert len(chosen) == 0 and len(memory.of) == 0  # and what is too old is forgotten


def test_order_does_not_matter():
    g = np.random.default_rng(3)
    rows = sorted((int(g.integers(0, 9)), int(g.integers(0, 4)), float(g.uniform(0, 90)), 0.0) for _ in range(60))
    seen = list_of(*rows)
    ids = np.arange(9)
    _, memory = select_objects(InclusionMemory(), seen, ids[seen.observer], 0.0)
    moved = list_of(*((o, label, x + g.uniform(0, 6), yaw) for o, label, x, yaw in rows))
    chosen, _ = select_objects(memory, moved, ids[moved.observer], 0.3)
    order = g.permutation(60)
    again, _ = select_objects(memory, moved.take(order), ids[moved.observer[order]], 0.3)
    assert 0 < chosen.sum() < 60
    assert again.tolist() == chosen[order].tolist()
