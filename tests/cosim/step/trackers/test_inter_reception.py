"""Packet inter-reception times: by hand, and against a naive twin that follows one pair after another."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.step.trackers.inter_reception import InterReceptionTracker, pairs_within_range

PAIRS = [(a, b) for a in range(3) for b in range(3) if a != b]
KINDS = np.int32, np.int32, np.int64
"""As a run has them: with other types, the kernel would be compiled once more."""


frames = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 6), st.integers(1, 3)), max_size=60)
heard = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=20)


@given(st.lists(st.integers(0, 6), min_size=6, max_size=6), frames, heard)
def test_pairs_within_range_against_sets(station, frames, heard):
    """Four vehicles and three other stations; the second hop of a frame reaches beyond the range of its author."""
    actor, author = np.array([2, 3, 7, 2**20], np.int32), np.array([0, 3, 1, 0, 2, 2])
    message, receiver, hop = (np.array([frame[k] for frame in frames], KINDS[k]) for k in range(3))
    columns = (np.array([one[k] for one in heard], np.int32) for k in range(2))
    given, n_sent = (message, receiver, hop, author, *columns, actor), np.array([1, 6, 0, 2])
    pair, got, n_in_range = pairs_within_range(np.array(station), *given, n_sent)
    near = sorted({(station[m], r) for m, r, h in frames if h == 1 and station[m] < 4 and r < 4})
    received = {(author[m], r) for m, r in heard}
    assert pair.tolist() == [int(actor[i]) << 32 | int(actor[j]) for i, j in near]
    assert got.tolist() == [one in received for one in near]
    assert n_in_range.tolist() == [sum(n_sent[i] for i, j in near if j == k) for k in range(len(actor))]


def follow(rounds, every, swap=lambda tracker: tracker, silent=None):
    """Rows (step, pir_steps, n_received, n_censored); each round maps the pairs in range to whether they received."""
    tracker, rows = InterReceptionTracker(), []
    for i, in_range in enumerate(rounds):
        pairs = sorted(in_range)
        received = np.array([in_range[pair] for pair in pairs], bool)
        pair = np.array([(a << 32) + b for a, b in pairs], np.int64)
        now_silent = np.array(sorted(silent[i]) if silent else [], np.int32)
        tracker, found = tracker.next(i * every, pair, received, now_silent)
        columns = (found[name].tolist() for name in ("pir_steps", "n_received", "n_censored"))
        rows += [(i * every, *row) for row in zip(*columns, strict=True)]
        tracker = swap(tracker)
    return rows


def naive(rounds, every, silent=None):
    """One pair after another: split its rounds where it is out of range, and walk through every stretch."""
    counts: dict[tuple[int, int], list[int]] = {}
    for pair in PAIRS:
        last, before = None, -1
        for i, in_range in enumerate([*rounds, None]):
            if silent is not None and in_range is not None and pair[0] in silent[i]:
                continue
            if in_range is not None and pair in in_range:
                if in_range[pair]:
                    if last is not None:
                        counts.setdefault((i * every, (i - last) * every), [0, 0])[0] += 1
                    last = i
            else:
                if in_range is not None and last is not None:  # at the end of recording nothing is counted
                    counts.setdefault((i * every, (before - last) * every), [0, 0])[1] += 1
                last = None
            before = i
    return [(*key, *count) for key, count in sorted(counts.items())]


rounds_of_pairs = st.lists(st.dictionaries(st.sampled_from(PAIRS), st.booleans()), max_size=12)


@given(rounds_of_pairs, st.integers(1, 3))
def test_twin(rounds, every):
    assert follow(rounds, every) == naive(rounds, every)


@given(
    st.lists(st.tuples(st.sets(st.integers(0, 2)), st.dictionaries(st.sampled_from(PAIRS), st.booleans())), max_size=12)
)
def test_twin_with_senders_that_have_no_message(rounds):
    """Their pairs stay as they are. A sender that is neither silent nor in a pair has left, or is out of range."""
    silent = [who for who, _ in rounds]
    rounds = [{pair: got for pair, got in pairs.items() if pair[0] not in who} for who, pairs in rounds]
    assert follow(rounds, 1, silent=silent) == naive(rounds, 1, silent)


@pytest.mark.parametrize("swap", [copy.deepcopy, lambda tracker: pickle.loads(pickle.dumps(tracker))])
def test_a_copy_goes_on_alike(swap):
    rng = np.random.default_rng(0)
    rounds = [{pair: bool(rng.random() < 0.6) for pair in PAIRS if rng.random() < 0.8} for _ in range(30)]
    assert follow(rounds, 1, swap) == follow(rounds, 1) == naive(rounds, 1)


def test_by_hand():
    """Received in rounds 0, 1 and 4, in range until 5: intervals of 1 and 3 steps, and 1 step cut off."""
    rounds = [{(0, 1): i in (0, 1, 4)} for i in range(6)] + [{}]
    assert follow(rounds, 1) == [(1, 1, 1, 0), (4, 3, 1, 0), (6, 1, 0, 1)]
