"""How many threads a piece of work is worth, and compiled work in several threads."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from time import perf_counter

import numba

_RANGES_PER_THREAD = 4  # some have more work than others
_TRIED_OF = 256  # so few items are tried that doing them in one thread costs nothing
_WORTH_S = 1e-3  # threads that begin and end cost a third of it, and more where processors are busy
_ROWS_PER_THREAD = 50_000  # about a millisecond; below it threads wait for each other longer than they work


@contextmanager
def threads_for(n_rows: float) -> Iterator[int]:
    """Numba's threads within the block: one for little work, at most those it was given."""
    before = numba.get_num_threads()
    n = max(1, min(before, int(n_rows / _ROWS_PER_THREAD)))
    numba.set_num_threads(n)
    try:
        yield n
    finally:
        numba.set_num_threads(before)


def in_ranges(work: Callable[[int, int], object], n: int) -> None:
    """Call `work(begin, end)` for ranges that cover n items, in as many threads as Numba may use here.

    Its items must be independent, and a compiled function without Python's lock must do the work. This takes a quarter
    of the time to compile that `prange` takes. This thread tries a few items first. If they took next to no time, it
    does the others, too.
    """
    n_threads = min(numba.get_num_threads(), n)
    if n_threads < 2:
        work(0, n)
        return
    n_tried = max(1, n // _TRIED_OF)
    begin = perf_counter()
    work(0, n_tried)
    if (perf_counter() - begin) * (n / n_tried - 1) < _WORTH_S:
        work(n_tried, n)
        return
    n_ranges = _RANGES_PER_THREAD * n_threads
    n_left = n - n_tried
    bounds = [n_tried + n_left * k // n_ranges for k in range(n_ranges + 1)]
    with ThreadPoolExecutor(n_threads) as threads:
        for _ in threads.map(work, bounds[:-1], bounds[1:]):
            pass
