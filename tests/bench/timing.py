"""The least time of several runs."""

from collections.abc import Callable
from time import process_time


def least_s(work: Callable[[], object], runs: int, clock: Callable[[], float] = process_time) -> float:
    """Shortest of several times [s], after one run that compiles and allocates memory."""
    work()
    seconds = []
    for _ in range(runs):
        start = clock()
        work()
        seconds.append(clock() - start)
    return min(seconds)
