"""Packet inter-reception times: by hand, and against a naive twin that follows one pair after another."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.step.trackers.inter_reception import InterReceptionTracker, unique_pairs

PAIRS = [(a, b) for a in range(3) for b in range(3) if a != b]


@settings(deadline=None)  # the first call compiles
@given(n=st.integers(1, 9), pairs=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=60))
def test_pairs_once_and_sorted(n, pairs):
    """As a set of tuples, sorted by Python."""
    pairs = [(a % n, b % n) for a, b in pairs]
    one, other = (np.array([pair[side] for pair in pairs], np.int64) for side in (0, 1))
    a, b = unique_pairs(one, other, n)
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == sorted(set(pairs))


def follow(rounds, every, swap=lambda tracker: tracker):
    """Rows (step, pir_steps, n_received, n_censored); each round maps the pairs in range to whether they received."""
    tracker, rows = InterReceptionTracker(), []
    for i, in_range in enumerate(rounds):
        pairs = np.array(sorted(in_range), np.int64).reshape(-1, 2)
        received = np.array([in_range[tuple(pair)] for pair in pairs.tolist()], bool)
        tracker, found = tracker.next(i * every, pairs[:, 0], pairs[:, 1], received)
        columns = (found[name].tolist() for name in ("pir_steps", "n_received", "n_censored"))
        rows += [(i * every, *row) for row in zip(*columns, strict=True)]
        tracker = swap(tracker)
    return rows


def naive(rounds, every):
    """One pair after another: split its rounds where it is out of range, and walk through every stretch."""
    counts: dict[tuple[int, int], list[int]] = {}
    for pair in PAIRS:
        last = None
        for i, in_range in enumerate([*rounds, None]):
            if in_range is not None and pair in in_range:
                if in_range[pair]:
                    if last is not None:
                        counts.setdefault((i * every, (i - last) * every), [0, 0])[0] += 1
                    last = i
            else:
                if in_range is not None and last is not None:  # at the end of recording nothing is counted
                    counts.setdefault((i * every, (i - 1 - last) * every), [0, 0])[1] += 1
                last = None
    return [(*key, *count) for key, count in sorted(counts.items())]


rounds_of_pairs = st.lists(st.dictionaries(st.sampled_from(PAIRS), st.booleans()), max_size=12)


@settings(deadline=None)  # the first call compiles
@given(rounds_of_pairs, st.integers(1, 3))
def test_twin(rounds, every):
    assert follow(rounds, every) == naive(rounds, every)


@pytest.mark.parametrize("swap", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_copy_goes_on_alike(swap):
    rng = np.random.default_rng(0)
    rounds = [{pair: bool(rng.random() < 0.6) for pair in PAIRS if rng.random() < 0.8} for _ in range(30)]
    assert follow(rounds, 1, swap) == follow(rounds, 1) == naive(rounds, 1)


def test_by_hand():
    """Received in rounds 0, 1 and 4, in range until 5: intervals of 1 and 3 steps, and 1 step cut off."""
    rounds = [{(0, 1): i in (0, 1, 4)} for i in range(6)] + [{}]
    assert follow(rounds, 1) == [(1, 1, 1, 0), (4, 3, 1, 0), (6, 1, 0, 1)]
