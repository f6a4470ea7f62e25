"""Rows of numbers among others."""

import numpy as np
import pytest

from cosim.base.ragged import rows_of


@pytest.mark.parametrize("far", [5, 10**15])  # by a table, by search
def test_rows_of_numbers(far):
    numbers = np.array([-3, 2, far])
    row, is_there = rows_of(np.array([far, -4, 2, 0, far + 1, -3]), numbers)
    assert is_there.tolist() == [True, False, True, False, False, True]
    assert row[is_there].tolist() == [2, 1, 0]
    assert ((row >= 0) & (row < 3)).all()


def test_nothing_is_among_no_numbers():
    row, is_there = rows_of(np.arange(3), np.zeros(0, np.int64))
    assert len(row) == 3 and not is_there.any()
