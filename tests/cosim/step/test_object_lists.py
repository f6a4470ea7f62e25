"""Object lists: against sets built by hand, vehicle by vehicle."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.step.comparing import received_lists
from cosim.step.known import Uses
from tests.seeds import seeds
from trust.tables import ObjectLists


@settings(max_examples=40)
@given(seed=seeds, n=st.integers(0, 9))
def test_received_lists(seed, n):
    rng = np.random.default_rng(seed)
    vehicle = np.repeat(np.arange(n), rng.integers(1, 4, n))  # one to three identities each
    own = np.searchsorted(vehicle, np.arange(n))
    ptr = np.concatenate([[0], np.cumsum(rng.integers(0, 5, len(vehicle)))])
    transmitted = rng.random(ptr[-1]) < 0.7
    pairs = [(v, m) for v in range(n) for m in range(len(vehicle)) if vehicle[m] != v and rng.random() < 0.5]
    receiver, message = np.array(pairs, np.int64).reshape(-1, 2).T
    further = np.setdiff1d(np.arange(len(vehicle)), own)
    known = Uses(np.concatenate([receiver, vehicle[further]]), np.concatenate([message, further]))
    lists = received_lists(known, ptr, transmitted, own)
    assert (lists.owner == own).all()
    for v in range(n):
        others = [m for m in range(len(vehicle)) if m != own[v] and (vehicle[m] == v or (v, m) in pairs)]
        wanted = [*range(ptr[own[v]], ptr[own[v] + 1])]
        wanted += [d for m in others for d in range(ptr[m], ptr[m + 1]) if transmitted[d]]
        assert lists.member[lists.ptr[v] : lists.ptr[v + 1]].tolist() == wanted


def test_subset():
    lists = ObjectLists(np.array([0, 0, 3, 5]), np.array([7, 8, 9, 7, 8]), np.array([0, 1, 2]))
    kept = lists.subset(np.array([False, True, True, False, True]))
    assert kept.ptr.tolist() == [0, 0, 2, 3] and kept.member.tolist() == [8, 9, 8]
    none = ObjectLists(np.zeros(3, np.int64), np.zeros(0, np.int64), np.arange(2)).subset(np.zeros(0, bool))
    assert none.ptr.tolist() == [0, 0, 0] and not len(none.member)
