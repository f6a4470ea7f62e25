"""Lookups of trust added up row by row, trust variants side by side: kernels of `results.metrics.lookups`."""

import numpy as np

from cosim.base.kernel import compiled


@compiled
def add(
    variant,
    receiver,
    who,
    state,
    ages_s,
    age_number,
    n_evaluations,
    n_evaluators,
    role_of,
    fresh_s,
    states,
    fresh,
    aged,
    age_sum_s,
    age_counts,
    behind,
    behind_sum,
):
    """Add rows to the fields of `lookups.Sums`; `who` is the row of the subject in `role_of`, `age_number` the number
    of each of the three ages (-1: none)."""
    for i in range(len(variant)):
        v, r, role = variant[i], receiver[i], role_of[who[i]]
        states[v, r, role, state[i]] += 1
        if ages_s[1, i] <= fresh_s:
            fresh[v, r, role] += 1
        for what in range(3):
            if age_number[what, i] >= 0:
                aged[v, r, role, what] += 1
                age_sum_s[v, r, role, what] += ages_s[what, i]
                age_counts[v, role, what, age_number[what, i]] += 1
        if age_number[1, i] >= 0:
            behind[v, r, 0] += 1
            behind_sum[v, r, 0] += n_evaluations[i]
            if not np.isnan(n_evaluators[i]):
                behind[v, r, 1] += 1
                behind_sum[v, r, 1] += n_evaluators[i]


@compiled
def add_successive(
    variant,
    receiver,
    step,
    pair,
    ages_s,
    dt_s,
    reach_s,
    last_step,
    last_s,
    renewed,
    peak_sum_s,
    observed_s,
    area_s2,
    sawtooth_peaks,
    sawtooth_peak_sum_s,
):
    """Compare each lookup with the one before of the same receiver and subject, whose number is `pair`.

    What is known is renewed where it was generated later than what was known at the lookup before: where the age has
    grown by less than the time that has passed. Generation times are whole steps, so half a step tells them apart.
    """
    for i in range(len(variant)):
        v, r, p = variant[i], receiver[i], pair[i]
        passed_s = (step[i] - last_step[v, p]) * dt_s
        is_first, is_near = last_step[v, p] < 0, passed_s <= reach_s[r] + 1e-9
        last_step[v, p] = step[i]
        for what in range(2):
            before_s, age_s = np.float64(last_s[v, p, what]), np.float64(ages_s[what, i])
            last_s[v, p, what] = age_s
            if is_first or np.isnan(before_s):
                continue
            is_new = age_s < before_s + passed_s - dt_s / 2
            if is_new:
                renewed[v, r, what] += 1
                peak_sum_s[v, r, what] += before_s
            if is_near:
                observed_s[v, r, what] += passed_s
                area_s2[v, r, what] += (before_s + passed_s / 2) * passed_s
                if is_new:
                    sawtooth_peaks[v, r, what] += 1
                    sawtooth_peak_sum_s[v, r, what] += before_s + passed_s


@compiled
def add_watched(
    variant,
    step,
    who,
    pair,
    trust,
    n_evaluations,
    since,
    threshold,
    least,
    n_watched,
    n_evaluated,
    n_low,
    first_step,
    low_step,
    seen_step,
):
    """Of subjects while they are watched: count lookups, those with an evaluated value, and those that are below the
    threshold and rest on at least `least` evaluations; and write down when each receiver first looked its subject
    up, first found such a value (-1: never), and last looked it up."""
    for i in range(len(variant)):
        if step[i] < since[who[i]]:
            continue
        v, p = variant[i], pair[i]
        n_watched[v, who[i]] += 1
        if first_step[v, p] < 0:
            first_step[v, p] = step[i]
        seen_step[v, p] = step[i]
        if n_evaluations[i] > 0:
            n_evaluated[v, who[i]] += 1
            if n_evaluations[i] >= least and np.float64(trust[i]) < threshold:
                n_low[v, who[i]] += 1
                if low_step[v, p] < 0:
                    low_step[v, p] = step[i]
