"""A binary heap of events, ordered by time and then by code, in two preallocated arrays."""

from cosim.base.kernel import inlined, kernel


@inlined
def comes_before(t, code, other_t, other_code):
    """Whether an event comes before another one: it is earlier, or of a lower code at the same time."""
    return t < other_t or (t == other_t and code < other_code)


@kernel
def push(times, codes, n, t, code):
    """Insert an event into the heap of `n` events; returns the new size."""
    i = n
    while i > 0:
        up = (i - 1) >> 1
        if comes_before(times[up], codes[up], t, code):
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
        other = down + 1
        if other < n and comes_before(times[other], codes[other], times[down], codes[down]):
            down = other
        if comes_before(t, code, times[down], codes[down]):
            break
        times[i], codes[i] = times[down], codes[down]
        i = down
    times[i], codes[i] = t, code
    return n
