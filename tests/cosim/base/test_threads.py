"""Ranges of items cover all of them, each once, for any number of threads."""

import time

import numba
import numpy as np
import pytest

from cosim.base.threads import in_ranges


@pytest.fixture(params=[1, 2])
def threads(request):
    before = numba.get_num_threads()
    if request.param > before:
        pytest.skip("this machine has one core")
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


@pytest.mark.parametrize("pause_s", [0, 0.001])
@pytest.mark.parametrize("n", [0, 1, 2, 3, 7, 8, 100])
def test_each_item_once(threads, n, pause_s):
    """Little work is done in one thread."""
    seen = np.zeros(n, int)

    def work(begin, end):
        time.sleep(pause_s)
        seen[begin:end] += 1

    in_ranges(work, n)
    assert (seen == 1).all()


def test_an_error_of_a_thread_is_raised(threads):
    def work(begin, end):
        time.sleep(0.001)
        if end == 10:
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        in_ranges(work, 10)
