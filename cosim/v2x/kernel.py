"""Compiled functions of the radio's inner loops, and the heap of events.

They run without Numba's reference counts (`_nrt=False`; so they must not allocate): handing arrays from function
to function would else cost more, per pair of radios, than all that happens between them.
"""

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "_nrt": False}

kernel = njit(**_OPTIONS)
"""Decorator: compiled, cached, allocates nothing."""
inlined = njit(**_OPTIONS, inline="always")
"""Decorator: the same, and part of whoever calls it."""


@kernel
def push(times, codes, n, t, code):
    """Put an event into the binary heap of `n`, ordered by (time, code); returns the new size."""
    i = n
    while i > 0:
        up = (i - 1) >> 1
        if times[up] < t or (times[up] == t and codes[up] < code):
            break
        times[i], codes[i] = times[up], codes[up]
        i = up
    times[i], codes[i] = t, code
    return n + 1


@kernel
def pop(times, codes, n):
    """Remove the first event of the heap, `times[0], codes[0]`; returns the new size."""
    n -= 1
    t, code = times[n], codes[n]
    i = 0
    while True:
        down = 2 * i + 1
        if down >= n:
            break
        if down + 1 < n and (
            times[down + 1] < times[down] or (times[down + 1] == times[down] and codes[down + 1] < codes[down])
        ):
            down += 1
        if t < times[down] or (t == times[down] and code < codes[down]):
            break
        times[i], codes[i] = times[down], codes[down]
        i = down
    times[i], codes[i] = t, code
    return n
