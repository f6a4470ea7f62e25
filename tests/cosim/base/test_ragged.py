"""Rows of numbers, looked up in a table or searched for, and rows without gaps."""

import numpy as np
import pytest

from cosim.base.ragged import as_slice, place_in_group, rows_of

ASCENDING = [[7], [3, 4, 9], [-5, 0, 2**40], list(range(-3, 40, 2)), [0, 5, 5, 6]]


@pytest.mark.parametrize("kind", [np.int64, np.int32, np.uint64])
@pytest.mark.parametrize("numbers", ASCENDING)
@pytest.mark.parametrize("n", [0, 1, 400])
def test_rows_are_those_of_a_dictionary(numbers, n, kind):
    """Few numbers are searched for; many, among numbers that lie close together, are looked up in a table."""
    held = np.array(numbers).astype(kind) if kind is not np.int32 or max(numbers) < 2**31 else np.array([1, 2], kind)
    held = np.sort(held)
    asked = np.random.default_rng(1).integers(-9, 60, n).astype(kind)
    row, is_there = rows_of(asked, held)
    row_of = {number: held.tolist().index(number) for number in held.tolist()}
    assert is_there.tolist() == [number in row_of for number in asked.tolist()]
    assert row[is_there].tolist() == [row_of[number] for number in asked[is_there].tolist()]
    assert np.all((row >= 0) & (row < len(held)))


def test_nothing_is_among_no_numbers():
    row, is_there = rows_of(np.array([4, 5]), np.zeros(0, np.int64))
    assert len(row) == 2 and not is_there.any()


@pytest.mark.parametrize(("rows", "found"), [([2, 3, 4], slice(2, 5)), ([7], slice(7, 8)), ([2, 4], None), ([], None)])
def test_rows_without_gaps_are_a_slice(rows, found):
    rows = np.array(rows, np.int64)
    assert as_slice(rows) == found if found else as_slice(rows) is rows


def test_places_in_groups_begin_at_zero():
    assert place_in_group(np.array([2, 2, 2, 5, 7, 7])).tolist() == [0, 1, 2, 0, 0, 1]
    assert not len(place_in_group(np.zeros(0, int)))
