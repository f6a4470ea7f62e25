"""Compressed rows: ranges of integers, offsets of groups, and stable orders by counting."""

import numpy as np
from jaxtyping import Bool, Int
from numpy import ndarray

from cosim.base.kernel import compiled


def ptr_of(sorted_rows: Int[ndarray, "m"], n: int) -> Int[ndarray, "n+1"]:
    """Where the rows of each of `n` owners begin in an array sorted by owner.

    Parameters
    ----------
    sorted_rows
        Owner of each row, from 0 to n - 1, ascending.

    Returns
    -------
    `ptr`: the rows of owner i are ptr[i]:ptr[i + 1]. The range of an owner without rows is empty.
    """
    return np.searchsorted(sorted_rows, np.arange(n + 1)).astype(np.int64)


def expand(
    starts: Int[ndarray, "m"],
    stops: Int[ndarray, "m"],
) -> tuple[ndarray, ndarray]:
    """All integers of the ranges [start, stop), range after range, and the number of the range of each integer.

    No stop may be below its start.
    """
    counts = stops - starts
    which = owner_of_rows(counts)
    return ranges(starts, counts), which


def ranges(
    start: Int[ndarray, "r"],
    count: Int[ndarray, "r"],
) -> Int[ndarray, "m"]:
    """All integers of the ranges [start, start + count), range after range. Counts may be 0."""
    before = np.cumsum(count) - count
    return np.arange(int(count.sum())) + np.repeat(start - before, count)


def offsets(count: Int[ndarray, "r"]) -> Int[ndarray, "r+1"]:
    """Where each group begins if groups of these counts lie one after another, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)])


def place_in_group(group: Int[ndarray, "m"]) -> Int[ndarray, "m"]:
    """How many rows of the same group come before each row. Groups are ascending."""
    first = np.flatnonzero(differs_from_last(group))
    size = np.diff(np.append(first, len(group)))
    return np.arange(len(group)) - np.repeat(first, size)


def owner_of_rows(count: Int[ndarray, "r"]) -> Int[ndarray, "m"]:
    """Owner of each row if owner i has `count[i]` rows, one owner after another."""
    return np.repeat(np.arange(len(count)), count)


def rows_of(
    number: Int[ndarray, "k"],
    numbers: Int[ndarray, "n"],
) -> tuple[Int[ndarray, "k"], Bool[ndarray, "k"]]:
    """Row of each number among ascending ones, and whether it is there. Where it is not, the row means nothing.

    Of equal numbers it is the first row. The function looks in a table of all numbers from the first to the last if
    these are at most eight times as many as those to look up. Otherwise it searches. For 100,000 in 5,000 the table
    takes an eighth of the time.
    """
    if not len(numbers):
        return np.zeros(len(number), np.int64), np.zeros(len(number), bool)
    first = int(numbers[0])
    span = int(numbers[-1]) - first + 1
    is_signed = number.dtype.kind == numbers.dtype.kind == "i"
    if span > 8 * len(number) or not is_signed:
        row = np.minimum(np.searchsorted(numbers, number), len(numbers) - 1)
        return row, numbers[row] == number
    table = np.full(span + 2, -1)  # the first and the last place are those of all numbers beyond
    place = np.subtract(numbers, first - 1, dtype=np.int64)
    asked = np.subtract(number, first - 1, dtype=np.int64)
    table[place[::-1]] = np.arange(len(numbers))[::-1]  # of equal ones the first is written last
    row = table.take(asked, mode="clip")
    is_there = row >= 0
    return np.maximum(row, 0, out=row), is_there


def as_slice(rows: Int[ndarray, "m"]) -> Int[ndarray, "m"] | slice:
    """Ascending row numbers as a slice if no number is left out, so that columns need not be copied."""
    if not len(rows):
        return rows
    first, stop = int(rows[0]), int(rows[-1]) + 1
    return slice(first, stop) if stop - first == len(rows) else rows


def row_numbers(
    rows: Int[ndarray, "m"] | Bool[ndarray, "n"],
) -> Int[ndarray, "m"]:
    """Numbers of the rows that a mask marks. Row numbers stay as they are.

    `ndarray.take` needs an eighth of the time of an index in brackets, but reads a mask as the numbers 0 and 1.
    """
    rows = np.asarray(rows)
    return np.flatnonzero(rows) if rows.dtype == np.bool_ else rows


def distinct(
    value: Int[ndarray, "m"],
) -> tuple[Int[ndarray, "k"], Int[ndarray, "k"]]:
    """Distinct numbers, ascending, and how often each occurs.

    The result is that of `np.unique` with `return_counts`. This function is faster if long runs of the values are in
    order already, because a stable sort merges such runs. For 400,000 pairs of vehicles it takes 1 ms. `np.unique`
    takes 20 ms, and 250 ms without counts, because it then uses a hash table.
    """
    ordered = np.sort(value, kind="stable")
    first = np.flatnonzero(differs_from_last(ordered))
    return ordered[first], np.diff(np.append(first, len(ordered)))


def differs_from_last(value: Int[ndarray, "m"]) -> Bool[ndarray, "m"]:
    """Whether each number differs from the one before it. The first one counts as different."""
    differs = np.ones(len(value), bool)
    differs[1:] = value[1:] != value[:-1]
    return differs


def stable_order(value: Int[ndarray, "m"]) -> Int[ndarray, "m"]:
    """Rows in ascending order of their numbers. Rows with equal numbers keep their order.

    The function counts if the range of the numbers is at most eight times as long as the array. Otherwise it sorts.
    """
    if not len(value):
        return np.zeros(0, np.int64)
    low, high = int(value.min()), int(value.max())
    if high - low > 8 * len(value):
        return np.argsort(value, kind="stable")
    return counting_order(np.asarray(value, np.int64) - low, high - low + 1)


def order_by_two(
    first: Int[ndarray, "m"],
    second: Int[ndarray, "m"],
    n: int,
) -> Int[ndarray, "m"]:
    """Rows sorted by the first, then by the second column. Rows that are equal in both keep their order.

    Parameters
    ----------
    first, second
        Numbers from 0 to n - 1.
    """
    first, second = (np.asarray(column, np.int64) for column in (first, second))
    order = counting_order(second, n)
    return order[counting_order(first[order], n)]


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


@compiled
def partners(a, b, value, n):
    """Partners of each of n things that are in pairs: compressed rows, each with the partner and the pair's value."""
    ptr = np.zeros(n + 1, np.int64)
    for pair in range(len(a)):
        ptr[a[pair] + 1] += 1
        ptr[b[pair] + 1] += 1
    for i in range(n):
        ptr[i + 1] += ptr[i]
    at = ptr.copy()
    other = np.empty(2 * len(a), np.int32)
    of_pair = np.empty(2 * len(a), value.dtype)
    for pair in range(len(a)):
        one, two = a[pair], b[pair]
        for i, j in ((one, two), (two, one)):
            row = at[i]
            other[row], of_pair[row] = j, value[pair]
            at[i] += 1
    return ptr, other, of_pair
