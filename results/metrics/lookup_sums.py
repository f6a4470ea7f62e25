"""Lookups of trust added up row by row, trust variants side by side: kernels of `results.metrics.lookups`."""

import numpy as np
from numba import njit

_FIRST_SIZE = 1 << 12


@njit(cache=True, nogil=True)
def add(
    variant, receiver, who, state, ages_s, n_evaluations, n_evaluators, role_of, fresh_s, edges_s, bin_of, bins_per_s,
    states, fresh, aged, age_sum_s, histogram, behind, behind_sum,
):  # fmt: skip
    """Add rows to the fields of `lookups.Sums`; `who` is the row of the subject in `role_of`."""
    n_bins = len(edges_s) - 1
    for i in range(len(variant)):
        v, r, role = variant[i], receiver[i], role_of[who[i]]
        states[v, r, role, state[i]] += 1
        if ages_s[1][i] <= fresh_s:
            fresh[v, r, role] += 1
        for what in range(3):
            age_s = np.float64(ages_s[what][i])
            if np.isnan(age_s):
                continue
            aged[v, r, role, what] += 1
            age_sum_s[v, r, role, what] += age_s
            scaled = age_s * bins_per_s
            number = int(scaled) if 0 <= scaled < len(bin_of) else -1
            if number == scaled:
                at = bin_of[number]
            else:
                at, above = 0, n_bins
                while above - at > 1:
                    middle = (at + above) // 2
                    if edges_s[middle] <= age_s:
                        at = middle
                    else:
                        above = middle
            histogram[v, role, what, at] += 1
        if not np.isnan(ages_s[1][i]):
            behind[v, r, 0] += 1
            behind_sum[v, r, 0] += n_evaluations[i]
            if not np.isnan(n_evaluators[i]):
                behind[v, r, 1] += 1
                behind_sum[v, r, 1] += n_evaluators[i]


@njit(cache=True, nogil=True)
def new_lows(variant, who, step, trust, n_evaluations, since, lowest):
    """Where trust that rests on an evaluation is lower than ever from step `since` on, by subject; `lowest` by variant
    and subject goes down with it."""
    is_lower = np.zeros(len(variant), np.bool_)
    for i in range(len(variant)):
        v, s = variant[i], who[i]
        if n_evaluations[i] > 0 and step[i] >= since[s] and trust[i] < lowest[v, s]:
            lowest[v, s] = trust[i]
            is_lower[i] = True
    return is_lower


@njit(cache=True, nogil=True)
def none_before(n_variants):
    """What `add_peaks` knows of lookups before the first."""
    table, pairs, last_s = _empty(_FIRST_SIZE, n_variants)
    return table, pairs, last_s, 0


@njit(cache=True, nogil=True)
def add_peaks(variant, receiver, who, ages_s, n_variants, before, renewed, peak_sum_s):
    """Add the ages before each renewal: what a receiver looks up of a subject is younger than at its lookup before.
    Returns what the rows that follow need to know as `before`."""
    table, pairs, last_s, n = before
    for i in range(len(variant)):
        v, r = variant[i], receiver[i]
        pair = (np.int64(r) << 32) | who[i]
        at = _slot(table, pairs, pair)
        if table[at] < 0:
            if n == len(pairs):
                table, pairs, last_s = _larger(pairs, last_s, n_variants)
                at = _slot(table, pairs, pair)
            table[at] = n
            pairs[n] = pair
            n += 1
        k = table[at] * n_variants + v
        for what in range(2):
            age_s = ages_s[what][i]
            if age_s < last_s[k, what]:
                renewed[v, r, what] += 1
                peak_sum_s[v, r, what] += last_s[k, what]
            last_s[k, what] = age_s
    return table, pairs, last_s, n


@njit(cache=True, nogil=True)
def _slot(table, pairs, pair):
    """Where a hash table holds the number of a pair, or would."""
    mask = len(table) - 1
    at = np.int64((np.uint64(pair) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask
    while table[at] >= 0 and pairs[table[at]] != pair:
        at = (at + 1) & mask
    return at


@njit(cache=True, nogil=True)
def _empty(size, n_variants):
    """A hash table for half as many pairs, the pairs by number, and the two ages last looked up by pair and variant."""
    table, pairs = np.empty(size, np.int64), np.empty(size // 2, np.int64)
    last_s = np.empty((size // 2 * n_variants, 2), np.float32)
    for k in range(size):  # loops compile in a tenth of the time of np.full
        table[k] = -1
    for k in range(len(last_s)):
        last_s[k, 0] = last_s[k, 1] = np.nan
    return table, pairs, last_s


@njit(cache=True, nogil=True)
def _larger(pairs, last_s, n_variants):
    """The same with twice the room."""
    table, more, wider_s = _empty(4 * len(pairs), n_variants)
    for number in range(len(pairs)):
        more[number] = pairs[number]
        table[_slot(table, more, pairs[number])] = number
    for k in range(len(last_s)):
        wider_s[k, 0], wider_s[k, 1] = last_s[k, 0], last_s[k, 1]
    return table, more, wider_s
