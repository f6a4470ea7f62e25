"""How many threads a piece of work is worth."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba

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
