"""Reading trust scores row by row: what vehicles look up of them, many times in a step."""

import numpy as np
from jaxtyping import Int
from numpy import ndarray

from results.codes import LookupState
from sensors.kernel import compiled

_JUDGED, _UNJUDGED, _STALE = (int(s) for s in (LookupState.JUDGED, LookupState.UNJUDGED, LookupState.STALE))


@compiled
def rows_heard(
    last: Int[ndarray, "capacity"], vehicle: Int[ndarray, "n"], number: int, subject: Int[ndarray, "n"],
    known: Int[ndarray, "k"],
) -> Int[ndarray, "n"]:  # fmt: skip
    """Row of `known`, ascending, that holds each subject, where broadcast `number` is the last that its vehicle heard;
    -1 elsewhere."""
    at = np.full(len(subject), -1)
    for i in range(len(subject)):
        if vehicle[i] < len(last) and last[vehicle[i]] == number:
            row = np.searchsorted(known, subject[i])
            if row < len(known) and known[row] == subject[i]:
                at[i] = row
    return at


@compiled
def fill(
    trust, source, state, age_s, newest_age_s, oldest_age_s, n_evaluations, n_evaluators, at, code, value_age_s, time_s,
    dt_s, window_s, unjudged_is_used, scores_trust, is_judged, newest_step, oldest_step, scores_n, scores_n_evaluators,
):  # fmt: skip
    """Columns of `cosim.v2x.trust_hosts.Lookups` where `at` names a row of the scores; others stay as they are."""
    for i in range(len(at)):
        row = at[i]
        if row < 0:
            continue
        if is_judged[row] or unjudged_is_used:
            trust[i], source[i] = scores_trust[row], code
        age_s[i] = value_age_s
        newest_age_s[i] = time_s - newest_step[row] * dt_s
        oldest_age_s[i] = time_s - oldest_step[row] * dt_s
        n_evaluations[i], n_evaluators[i] = scores_n[row], scores_n_evaluators[row]
        state[i] = _UNJUDGED if not is_judged[row] else _JUDGED if newest_age_s[i] < window_s else _STALE


@compiled
def totals(n_variants, n_states, state, is_default, is_known, age_s, newest_age_s, oldest_age_s):
    """Of lookups of one variant after another, by variant and state: how many, how many with a value, and sums of the
    ages of these values and of the evaluations that are known."""
    n, n_valued = np.zeros(n_variants * n_states, np.int64), np.zeros(n_variants * n_states, np.int64)
    sums = np.zeros((3, n_variants * n_states))
    per_variant = len(state) // n_variants
    for i in range(len(state)):
        group = i // per_variant * n_states + state[i]
        n[group] += 1
        if not is_default[i]:
            n_valued[group] += 1
            sums[0, group] += age_s[i]
        if is_known[i]:
            sums[1, group] += newest_age_s[i]
            sums[2, group] += oldest_age_s[i]
    return n, n_valued, sums[0], sums[1], sums[2]
