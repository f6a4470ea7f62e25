"""Ranges of items cover all of them, each once, for any number of threads."""

import os
import signal
import time
from threading import Event, get_ident

import numpy as np
import pytest

from cosim.base.threads import beside, in_parts, in_ranges, n_threads, use_threads


@pytest.fixture(params=[1, 2])
def threads(request):
    before = n_threads()
    if request.param > before:
        pytest.skip("this machine has one core")
    use_threads(request.param)
    yield request.param
    use_threads(before)


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


@pytest.mark.parametrize("most", [1, 2])
def test_what_parts_return_is_in_their_order(threads, most):
    """Each of several threads lets its work use one."""

    def work(begin, end):
        time.sleep(0.001 * (9 - end))
        return begin, end, n_threads()

    per_thread = 1 if min(threads, most) > 1 else threads
    assert in_parts(work, [0, 3, 3, 9], most) == [(0, 3, per_thread), (3, 3, per_thread), (3, 9, per_thread)]
    assert n_threads() == threads


def test_work_beside_this_thread(threads):
    """It goes on while this thread divides work of its own, and what goes wrong there is raised where it is asked for.

    With one thread, nothing is done before somebody asks.
    """
    go_on, begun = Event(), []

    def work():
        begun.append(get_ident())
        go_on.wait(10)
        return n_threads()

    def fail():
        raise ValueError("no")

    first, second = beside(work), beside(fail)
    assert in_parts(lambda begin, end: end, [0, 1, 2]) == [1, 2]
    assert not (begun and threads == 1)
    go_on.set()
    assert first() == threads
    assert (begun == [get_ident()]) == (threads == 1)
    with pytest.raises(ValueError, match="no"):
        second()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # that a process with threads forks
def test_a_forked_process_has_helpers_of_its_own(threads):
    def work(begin, end):
        time.sleep(0.001)
        return begin

    assert in_parts(work, [0, 1, 2]) == [0, 1]
    if not (child := os.fork()):
        signal.alarm(10)
        os._exit(in_parts(work, [0, 1, 2]) != [0, 1])
    assert os.waitpid(child, 0)[1] == 0
