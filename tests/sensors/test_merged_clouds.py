"""Merged views by hand, and their laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sensors.merged_clouds import Views, merged


def views(*rows):
    """Rows of observer, actor, returns, unoccluded returns, range, displacement east and north."""
    observer, actor, n, whole, range_m, east, north = np.array(rows, float).T
    whole_numbers = (column.astype(np.int64) for column in (observer, actor, n, whole))
    return Views(*whole_numbers, range_m, np.column_stack([east, north]))


def test_two_views_by_hand():
    """The ego has 30 of 100 returns, the partner 70 of 70 and sees the object 1 m too far north. The object heads
    north: 0.7 m along, and twice the standard deviation sqrt(0.7 - 0.49) longer. Nothing of it is hidden."""
    found = merged(views((0, 1, 30, 100, 10, 0, 0), (0, 1, 70, 70, 20, 0, 1)), np.array([0.0, np.pi / 2]))
    assert found.seen.observer.tolist() == [0] and found.seen.actor.tolist() == [1]
    assert (found.seen.n_returns[0], found.seen.occlusion[0], found.n_sweeps[0]) == (100, 0, 2)
    assert found.seen.range_m[0] == pytest.approx(17)
    assert found.off_m[0] == pytest.approx([0, 0.7])
    assert found.larger_m[0] == pytest.approx([2 * np.sqrt(0.21), 0], abs=1e-9)


_VIEW = st.tuples(
    st.integers(0, 3), st.integers(0, 3), st.integers(1, 50), st.integers(50, 5000), st.floats(0.1, 200),
    st.floats(-9, 9), st.floats(-9, 9),
)  # fmt: skip


@given(st.lists(_VIEW, min_size=1, max_size=20, unique_by=lambda v: v[:2]))
def test_one_view_alone_stays_as_it_is(rows):
    given_views = views(*rows)
    found, order = merged(given_views, np.ones(4)), np.lexsort([given_views.actor, given_views.observer])
    for name in ("observer", "actor", "n_returns", "n_unoccluded", "range_m"):
        np.testing.assert_array_equal(getattr(found.seen, name), getattr(given_views, name)[order])
    np.testing.assert_array_equal(found.off_m, given_views.off_m[order])
    assert not found.larger_m.any() and (found.n_sweeps == 1).all()


@given(st.lists(_VIEW, min_size=1, max_size=20), _VIEW)
def test_a_further_view_adds_returns_and_hides_nothing(rows, more):
    before, after = (merged(views(*r), np.ones(4)) for r in (rows, [*rows, more]))
    pair = {(o, a): k for k, (o, a) in enumerate(zip(after.seen.observer, after.seen.actor, strict=True))}
    for k, key in enumerate(zip(before.seen.observer, before.seen.actor, strict=True)):
        now = pair[key]
        assert after.seen.n_returns[now] - before.seen.n_returns[k] == (more[2] if key == more[:2] else 0)
        assert after.seen.occlusion[now] <= before.seen.occlusion[k] + 0.5 / before.seen.n_returns[k]


def test_nothing_to_merge():
    nothing = views((0, 0, 1, 1, 1, 0, 0)).take(np.zeros(1, bool))
    assert len(merged(nothing, np.ones(1)).seen.observer) == 0
