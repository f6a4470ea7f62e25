"""Matching by hand, by law, and against the slow transcription."""

import numpy as np
import pytest
from hypothesis import given, settings

from tests.trust.worlds import worlds
from tests.verification import paper
from trust.matching import match
from trust.params import TrustParams
from trust.tables import ObjectLists, SentDetections


def row_of(senders, pairs, one_per_vehicle=False, tau=0.1):
    """Seeds of one object list over detections given by sender, the ego's first; IoUs by pair of rows."""
    n = len(senders)
    k = np.array([senders[:i].count(s) for i, s in enumerate(senders)])
    table = SentDetections(np.array(senders), k, np.zeros(n, np.uint8), np.ones(n), np.zeros(n, bool))
    i, j = (np.array([p[c] for p in pairs], np.int64) for c in (0, 1))
    params = TrustParams(tau=tau, one_per_vehicle=one_per_vehicle)
    lists = ObjectLists(np.array([0, n]), np.arange(n), np.array([0]))
    return match(lists, table, (i, j, np.array(list(pairs.values()))), params).seed.tolist()


def test_threshold_is_strict():
    assert row_of([0, 1], {(0, 1): 0.1}) == [0, 1]
    assert row_of([0, 1], {(0, 1): np.nextafter(0.1, 1)}) == [0, 0]
    assert row_of([0, 1], {(0, 1): np.nan}) == [0, 1]


def test_first_maximum():
    # vehicle 1's detection overlaps both of the ego's alike: the first takes it; a larger IoU wins
    assert row_of([0, 0, 1], {(0, 2): 0.5, (1, 2): 0.5}) == [0, 1, 0]
    assert row_of([0, 0, 1], {(0, 2): 0.5, (1, 2): 0.6}) == [0, 1, 1]


def test_first_vehicle_before_better_vehicle():
    # 2 overlaps the ego's (0.2) and vehicle 1's (0.9): the ego comes first
    assert row_of([0, 1, 2], {(0, 2): 0.2, (1, 2): 0.9}) == [0, 1, 0]


def test_members_are_no_seeds():
    # 1 joins the ego's group; 2 overlaps only 1, which is no seed: a group of its own
    assert row_of([0, 1, 2], {(0, 1): 0.5, (1, 2): 0.5}) == [0, 0, 2]


def test_one_per_vehicle():
    several = {(0, 1): 0.3, (0, 2): 0.5, (0, 3): 0.5}
    assert row_of([0, 1, 1, 1], several) == [0, 0, 0, 0]
    # the largest IoU, the first of equals; the others open groups
    assert row_of([0, 1, 1, 1], several, one_per_vehicle=True) == [0, 1, 0, 3]
    # a loser may still join the next vehicle
    three = {(0, 2): 0.3, (0, 3): 0.5, (1, 2): 0.4}
    assert row_of([0, 1, 2, 2], three, one_per_vehicle=True) == [0, 1, 1, 0]


@pytest.mark.parametrize("one_per_vehicle", [False, True])
@given(world=worlds())
@settings(max_examples=200)
def test_twin(world, one_per_vehicle):
    params = TrustParams(one_per_vehicle=one_per_vehicle)
    groups = match(world.lists, world.table, world.pairs, params)
    names, truth, iou = world.names(), world.dictionary(), world.iou()
    for view in range(world.n_vehicles):
        expected = paper.match(world.names_in(view), truth, iou, params.tau, one_per_vehicle)
        positions = range(world.lists.ptr[view], world.lists.ptr[view + 1])
        ours = {}
        for p in positions:
            ours.setdefault(int(groups.seed[p]), []).append(names[world.lists.member[p]])
        assert sorted(ours.values()) == sorted(expected)
        owner = world.lists.owner[view]
        assert all(groups.ego_detected[p] == (names[world.lists.member[groups.seed[p]]][0] == owner) for p in positions)
