"""How many threads compiled work may use, and work divided among them."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from time import perf_counter
from typing import Any, TypeVar

import numba
import numpy as np

_Result = TypeVar("_Result")

CORES: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
"""Most threads: one per core that this process may use, or what the variable NUMBA_NUM_THREADS says."""
_RANGES_PER_THREAD = 4  # some have more work than others
_TRIED_OF = 256  # so few items are tried that doing them in one thread costs nothing
_WORTH_S = 1e-3  # for less, it does not pay to wake threads and to wait for them
_of_this_thread = threading.local()


def n_threads() -> int:
    """How many threads the work of this thread may use."""
    found: int = getattr(_of_this_thread, "n", CORES)
    return found


def use_threads(n: int) -> None:
    """Let the work of this thread use n threads. This does not concern other threads."""
    _of_this_thread.n = n


def in_ranges(work: Callable[[int, int], object], n: int) -> None:
    """Call `work(begin, end)` for ranges that cover n items, in as many threads as this one may use.

    Its items must be independent, and a compiled function without Python's lock must do the work. Numba's own loops in
    parallel take four times as long to compile. This thread tries a few items first. If they took next to no time, it
    does the others, too.
    """
    if min(n_threads(), n) < 2:
        work(0, n)
        return
    n_tried = max(1, n // _TRIED_OF)
    begin = perf_counter()
    work(0, n_tried)
    if (perf_counter() - begin) * (n / n_tried - 1) < _WORTH_S:
        work(n_tried, n)
        return
    n_ranges = _RANGES_PER_THREAD * n_threads()
    bounds = n_tried + (n - n_tried) * np.arange(n_ranges + 1) // n_ranges
    in_parts(work, bounds.tolist())


def in_parts(
    work: Callable[[int, int], _Result],
    bounds: Sequence[int],
    most: int = CORES,
) -> list[_Result]:
    """What `work(begin, end)` returns for all neighbouring bounds, in their order.

    Parameters
    ----------
    work
        It must neither depend on other parts nor change what they read. In several threads, each uses one.
    bounds
        Where the parts begin, and where the last one ends.
    most
        Most threads, if this one may use more.
    """
    begins, ends = bounds[:-1], bounds[1:]
    before = n_threads()
    n = min(before, most, len(begins))
    if n < 2:
        return list(map(work, begins, ends))
    found: list[Any] = [None] * len(begins)
    left = iter(range(len(begins)))

    def take_turns() -> None:
        use_threads(1)
        for part in left:  # each part is given to one thread
            found[part] = work(begins[part], ends[part])

    others = [_helpers().submit(take_turns) for _ in range(n - 1)]
    try:
        take_turns()
    finally:
        use_threads(before)
        wait(others)
    for other in others:
        other.result()  # raises what went wrong there
    return found


def beside(work: Callable[[], _Result]) -> Callable[[], _Result]:
    """Let another thread work beside this one. The function that is returned waits for what the work returns.

    Until then, nothing may change what the work reads. With one thread, it is done when its result is asked for.
    """
    n = n_threads()
    if n < 2:
        return work

    def in_its_thread() -> _Result:
        use_threads(n)
        return work()

    return _helpers().submit(in_its_thread).result


def _helpers() -> ThreadPoolExecutor:
    """The threads that help this one. They wait for its next work, because to begin a thread takes 50 µs."""
    if not hasattr(_of_this_thread, "helpers"):
        _of_this_thread.helpers = ThreadPoolExecutor(2 * CORES)  # some may work beside this thread
    found: ThreadPoolExecutor = _of_this_thread.helpers
    return found


def _without_helpers() -> None:
    """Forget the helpers: a forked process has none of the threads of its parent."""
    _of_this_thread.__dict__.pop("helpers", None)


os.register_at_fork(after_in_child=_without_helpers)
