"""Compiled functions by which vehicles look up trust scores."""

from typing import NamedTuple

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
    """Row of each subject in `known` (ascending), if broadcast `number` is the last that the vehicle received.

    Otherwise, or if the subject is not known, the row is -1.
    """
    at = np.full(len(subject), -1)
    for i in range(len(subject)):
        if vehicle[i] < len(last) and last[vehicle[i]] == number:
            row = np.searchsorted(known, subject[i])
            if row < len(known) and known[row] == subject[i]:
                at[i] = row
    return at


class LookupColumns(NamedTuple):
    """Columns of `cosim.v2x.trust_hosts.Lookups` that `fill` writes."""

    trust: ndarray
    source: ndarray
    state: ndarray
    age_s: ndarray
    newest_evaluation_age_s: ndarray
    oldest_evaluation_age_s: ndarray
    n_evaluations: ndarray
    n_evaluators: ndarray


class ScoreColumns(NamedTuple):
    """Columns of `trust.tables.TrustScores`."""

    trust: ndarray
    is_judged: ndarray
    newest_step: ndarray
    oldest_step: ndarray
    n_evaluations: ndarray
    n_evaluators: ndarray


class LookupRules(NamedTuple):
    """Rules that turn scores into looked-up values."""

    source: int  # as `TrustSource`
    value_age_s: float  # time since the scores were computed
    time_s: float
    dt_s: float
    window_s: float  # an evaluation that is older is stale
    unevaluated_is_used: bool  # whether the score of a subject without evaluations is used; if not, the default is


@compiled
def fill(found, scores, at, rules):
    """Write the look-ups for which `at` is a row of the scores. Others are not changed."""
    for i in range(len(at)):
        row = at[i]
        if row < 0:
            continue
        if scores.is_judged[row] or rules.unevaluated_is_used:
            found.trust[i], found.source[i] = scores.trust[row], rules.source
        newest_age_s = rules.time_s - scores.newest_step[row] * rules.dt_s
        found.age_s[i] = rules.value_age_s
        found.newest_evaluation_age_s[i] = newest_age_s
        found.oldest_evaluation_age_s[i] = rules.time_s - scores.oldest_step[row] * rules.dt_s
        found.n_evaluations[i], found.n_evaluators[i] = scores.n_evaluations[row], scores.n_evaluators[row]
        if not scores.is_judged[row]:
            found.state[i] = _UNJUDGED
        else:
            found.state[i] = _JUDGED if newest_age_s < rules.window_s else _STALE


@compiled
def totals(n_variants, n_states, state, is_default, is_known, age_s, newest_age_s, oldest_age_s):
    """Counts of look-ups and sums of ages, by variant and state. Look-ups are in the order of variants.

    Returns
    -------
    Number of look-ups, number with a value, sum of the ages of these values, and sums of the ages of the newest and
    oldest evaluations.
    """
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
