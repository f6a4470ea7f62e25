"""From arrays to rows."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.recording import _once


@settings(deadline=None)  # the first call compiles
@given(n=st.integers(1, 9), pairs=st.lists(st.tuples(st.integers(0, 8), st.integers(0, 8)), max_size=60))
def test_pairs_once_and_sorted(n, pairs):
    """What a set of tuples says, sorted by Python."""
    pairs = [(a % n, b % n) for a, b in pairs]
    one, other = (np.array([pair[side] for pair in pairs], np.int64) for side in (0, 1))
    a, b = _once(one, other, n)
    assert list(zip(a.tolist(), b.tolist(), strict=True)) == sorted(set(pairs))
