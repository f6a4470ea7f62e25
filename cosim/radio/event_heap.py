"""A binary heap of events, ordered by time and then by code, in two preallocated arrays."""

from cosim.base.kernel import kernel


@kernel
def push(times, codes, n, t, code):
    """Insert an event into the heap of `n` events; returns the new size."""
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
