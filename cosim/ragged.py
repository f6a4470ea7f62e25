"""Compressed rows: ranges of integers, offsets of groups, and stable orders by counting."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from sensors.kernel import compiled


def ptr_of(sorted_rows: Int[ndarray, "m"], n: int) -> Int[ndarray, "n+1"]:
    """Where the rows of each of `n` owners begin in an array sorted by owner."""
    return np.searchsorted(sorted_rows, np.arange(n + 1)).astype(np.int64)


def expand(starts: Int[ndarray, "m"], stops: Int[ndarray, "m"]) -> tuple[ndarray, ndarray]:
    """All integers of the ranges [start, stop), range after range, and the range of each."""
    counts = stops - starts
    which = np.repeat(np.arange(len(starts)), counts)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[which] + offset, which


def ranges(start: Int[ndarray, "r"], count: Int[ndarray, "r"]) -> Int[ndarray, "m"]:
    """All integers of the ranges [start, start + count), range after range."""
    before = np.cumsum(count) - count
    return np.arange(int(count.sum())) + np.repeat(start - before, count)


def offsets(count: Int[ndarray, "r"]) -> Int[ndarray, "r+1"]:
    """Where the rows of each of these counts begin, and where all end."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)])


def distinct(value: Int[ndarray, "m"]) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:
    """Distinct numbers, ascending, and how often each occurs.

    The same as `np.unique` with `return_counts`, for values of which long runs are in order: a stable sort merges them
    in 1 ms for 400,000 pairs of vehicles, where `np.unique` takes 20 ms, and without counts, by a hash table, 250 ms.
    """
    ordered = np.sort(value, kind="stable")
    first = np.flatnonzero(np.concatenate([np.ones(min(1, len(ordered)), bool), ordered[1:] != ordered[:-1]]))
    return ordered[first], np.diff(np.append(first, len(ordered)))


def stable_order(value: Int[ndarray, "m"]) -> Int[ndarray, "m"]:
    """Stable order of whole numbers, by counting where they span a range not much larger than their number."""
    low, high = (int(value.min()), int(value.max())) if len(value) else (0, 0)
    if high - low > 8 * len(value):
        return np.argsort(value, kind="stable")
    return counting_order(np.asarray(value, np.int64) - low, high - low + 1)


def order_by_two(first: Int[ndarray, "m"], second: Int[ndarray, "m"], n: int) -> Int[ndarray, "m"]:
    """Order of rows by the first, then by the second column; both hold numbers from 0 to n - 1."""
    order = counting_order(np.asarray(second, np.int64), n)
    return order[counting_order(np.asarray(first, np.int64)[order], n)]


@compiled
def counting_order(value, n):
    """Stable order of rows by numbers from 0 to n - 1."""
    at = np.zeros(n + 1, np.int64)
    for v in value:
        at[v + 1] += 1
    for i in range(n):
        at[i + 1] += at[i]
    order = np.empty(len(value), np.int64)
    for row in range(len(value)):
        order[at[value[row]]] = row
        at[value[row]] += 1
    return order
