"""Freshness of trust: the evidence behind a value when it is looked up, and its age.

Definitions and sources are in `results/FRESHNESS.md`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from cosim.base.codes import LookupState, labels
from results.metrics import lookups
from results.metrics.encounters import DEFINITION, definitions, named
from results.metrics.intervals import plain_columns, ratio, share, without_interval
from results.metrics.lookups import AGES, FRESH_S, no_lookups
from results.run import WINDOW_S, Run

STATES = ("evaluated", "unevaluated", "stale", "no value")
"""States of a value that is looked up, in the order of `LookupState`. Tables call the last one `no_value`."""
KNOWN = ("evaluated", "stale")
"""States in which a value rests on an evaluation."""

_NO_EVALUATION = (
    "lookup of a trust value that rests on an evaluation",
    "nobody could judge what another vehicle reports, or no value of it came back. Raise fleet.penetration_p, or run "
    "longer.",
)


def evidence(run: Run) -> pd.DataFrame:
    """Age of the evaluations behind the server's values when it computes them, by role.

    Returns
    -------
    role, n (values), unevaluated_share (without any evaluation by another vehicle that could see), and medians of
    newest_s, oldest_s, n_evaluations and n_evaluators over the values that have some.
    """
    return run.sql("""
        SELECT role, count(*) AS n, 1 - avg(evaluated::INT) AS unevaluated_share,
            median(newest_evaluation_age_s::DOUBLE) FILTER (evaluated) AS newest_s,
            median(oldest_evaluation_age_s::DOUBLE) FILTER (evaluated) AS oldest_s,
            median(n_evaluations) FILTER (evaluated) AS n_evaluations,
            median(n_evaluators) FILTER (evaluated) AS n_evaluators
        FROM (SELECT *, state = 'evaluated' AS evaluated FROM trust WHERE variant = $variant)
        JOIN subjects ON pseudonym = subject GROUP BY role ORDER BY role
    """)


def states(run: Run) -> pd.DataFrame:
    """What stands behind the values that are looked up: shares of all lookups, and by role of the subject.

    Returns
    -------
    role ("all" first), state, n, share, low, high (95 %, clustered by the vehicle that looks up), n_units. From totals,
    where single lookups were not kept: of all alone, and without intervals.
    """
    if "trust_lookups" not in run.tables:
        total = _totals(run).n
        return pd.DataFrame(
            [
                {"role": "all", "state": state, "n": int(n)} | plain_columns(without_interval(n / total.sum()), "share")
                for state, n in total.items()
            ]
        )
    counts, rows = lookups.sums(run).states, []
    for role, of_role in _with_all(run, counts):
        n_lookups = of_role.sum(axis=1)
        for state, n in zip(STATES, of_role.T, strict=True):
            estimate = plain_columns(share(n, n_lookups), "share")
            rows.append({"role": role, "state": state, "n": int(n.sum())} | estimate)
    return pd.DataFrame(rows)


def ages(run: Run) -> pd.DataFrame:
    """Age, where trust is looked up, of the value and of the newest and oldest evaluation behind it.

    Returns
    -------
    what (a key of `AGES`), role ("all" first), n, mean_s, low, high (95 % interval of the mean, clustered by the
    vehicle that looks up), n_units, median_s, p90_s. From totals, where single lookups were not kept: mean_s of all
    alone, and without intervals.
    """
    if "trust_lookups" not in run.tables:
        return _ages_of_totals(run)
    found, rows = lookups.sums(run), []
    for number, what in enumerate(AGES):
        for code, role in enumerate(("all", *run.role_labels)):
            chosen = slice(None) if code == 0 else slice(code - 1, code)
            n = found.aged[:, chosen, number].sum(axis=1)
            if not n.any():
                continue
            total_s = found.age_sum_s[:, chosen, number].sum(axis=1)
            counts = found.age_counts[chosen, number].sum(axis=0)
            median_s, p90_s = quantiles(lookups.ages_s(run), counts, (0.5, 0.9))
            rows.append(
                {
                    "what": what,
                    "role": role,
                    "n": int(n.sum()),
                    **plain_columns(ratio(total_s, n), "mean_s"),
                    "median_s": median_s,
                    "p90_s": p90_s,
                }
            )
    if not rows:
        raise run.lacks(*_NO_EVALUATION)
    return pd.DataFrame(rows)


def capped_ages(run: Run) -> pd.DataFrame:
    """Age of the newest evaluation over all lookups, those without one included, and at most the window.

    A lookup without an evaluation within the window `trust.freshness_s` counts as the window, as its evidence is at
    least as old or there is none. If that is "off", the recorded time takes the place of the window. A
    quantile that equals the window says only that the age is at least that.

    Returns
    -------
    role ("all" first), n (lookups), mean_s, median_s, p90_s.
    """
    found, freshness_s = lookups.sums(run), run.config["trust"].get("freshness_s", "off")
    window_s = int(run.manifest["steps"]) * run.dt_s if freshness_s == "off" else float(freshness_s)
    age_s = np.append(np.minimum(lookups.ages_s(run), window_s), window_s)
    of_roles = found.age_counts[:, list(AGES).index("newest evaluation")]
    n_known = np.concatenate([of_roles.sum(axis=0, keepdims=True), of_roles])
    rows = []
    for known, (role, of_role) in zip(n_known, _with_every(run, found.states), strict=True):
        if n := int(of_role.sum()):
            counts = np.append(known, n - known.sum())
            median_s, p90_s = quantiles(age_s, counts, (0.5, 0.9))
            mean_s = float(counts @ age_s) / n
            rows.append({"role": role, "n": n, "mean_s": mean_s, "median_s": median_s, "p90_s": p90_s})
    return pd.DataFrame(rows)


def peaks(run: Run) -> pd.DataFrame:
    """Peak age at use: the age at the last lookup before a receiver finds that its knowledge of a subject is renewed.

    Take each two successive lookups of a subject by a receiver, both with the age in question. The second finds a
    renewal if what it finds was generated later than what the first found. The time of generation is the time of the
    lookup less the age, in whole steps. Own values are computed when they are looked up, and have no peak.

    Returns
    -------
    what (value, newest evaluation), n (renewals), mean_s, low, high, n_units (receivers).
    """
    found = lookups.sums(run)
    return _of_renewed(found.peak_sum_s, found.renewed, "mean_s")


def age_over_time(run: Run) -> pd.DataFrame:
    """Age over time: what a receiver knows of a subject ages between lookups, until a lookup finds it renewed.

    Take each two successive lookups within reach (`lookups.REACH_S`) of which the first found an age. Between them, the
    age grows by one second per second; it falls at a renewal. Its time average is its integral over the time [1]_, and
    its peaks are the values just before it falls [2]_. A renewal counts from the lookup that finds it. Both figures are
    therefore upper bounds; they are too large by at most the time between two lookups. Own values are computed when
    they are looked up, and have no age over time.

    Returns
    -------
    what (value, newest evaluation), observed_s (pair-seconds), mean_s, low, high, n_units (receivers), n_peaks, peak_s,
    and peak_s_low, peak_s_high, peak_s_units.

    References
    ----------
    .. [1] Kaul, Yates, Gruteser, "Real-time status: how often should one update?", IEEE INFOCOM, 2012.
    .. [2] Costa, Codreanu, Ephremides, "Age of information with packet management", IEEE ISIT, 2014.
    """
    found = lookups.sums(run)
    mean = _of_renewed(found.area_s2, found.observed_s, "mean_s").rename(columns={"n": "observed_s"})
    peak = _of_renewed(found.sawtooth_peak_sum_s, found.sawtooth_peaks, "peak_s").rename(
        columns={"n": "n_peaks", "low": "peak_s_low", "high": "peak_s_high", "n_units": "peak_s_units"}
    )
    return mean.merge(peak, on="what", how="left")


def _of_renewed(total: np.ndarray, n: np.ndarray, name: str) -> pd.DataFrame:
    """Sums over numbers by what is renewed: what, n, and the ratio under this name with its interval."""
    rows = [
        {"what": what, "n": float(of.sum())} | plain_columns(ratio(sums, of), name)
        for what, sums, of in zip(lookups.RENEWED, total.T, n.T, strict=True)
        if of.sum()
    ]
    return pd.DataFrame(rows, columns=["what", "n", name, "low", "high", "n_units"])


def within(run: Run, fresh_s: float = FRESH_S) -> pd.DataFrame:
    """Share of all lookups with an evaluation at most `fresh_s` old behind the value, whatever the window.

    Returns
    -------
    role ("all" first), n (lookups), share, low, high, n_units (vehicles that look up).
    """
    found = lookups.sums(run, fresh_s)
    counts = np.stack([found.fresh, found.states.sum(axis=2)], axis=2)
    rows = []
    for role, of_role in _with_all(run, counts):
        fresh, n = of_role.T
        rows.append({"role": role, "n": int(n.sum())} | plain_columns(share(fresh, n), "share"))
    return pd.DataFrame(rows)


def behind(run: Run) -> pd.DataFrame:
    """How much stands behind values with evaluations: what (evaluations, evaluators), n, mean, low, high, n_units."""
    found, rows = lookups.sums(run), []
    for column, n, total in zip(lookups.BEHIND, found.behind.T, found.behind_sum.T, strict=True):
        if n.sum():
            mean = plain_columns(ratio(total, n), "mean")
            rows.append({"what": column.removeprefix("n_"), "n": int(n.sum())} | mean)
    return pd.DataFrame(rows, columns=["what", "n", "mean", "low", "high", "n_units"])


def distribution(run: Run, what: str = "newest evaluation") -> pd.DataFrame:
    """Cumulative distribution of an age at lookup (a key of `AGES`): age_s, share at most as old."""
    if what not in AGES:
        raise ValueError(f"what = {what!r}: there is no such age. There are {', '.join(AGES)}.")
    of_roles = lookups.sums(run).age_counts[:, list(AGES).index(what)]
    counts = of_roles.sum(axis=0)
    there = counts > 0
    if not there.any():
        raise run.lacks(*_NO_EVALUATION)
    age_s = lookups.ages_s(run)[there]
    share = np.cumsum(counts[there]) / counts.sum()
    age_s = np.append(age_s[0], age_s)
    return pd.DataFrame({"age_s": age_s, "share": np.append(0, share)})


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Shares of the states by time: time_s, and a column for each of `STATES`."""
    lookups.sums(run)  # says so where there are none
    kinds = zip(labels(LookupState), STATES, strict=True)
    shares = ", ".join(f"count_if(state = '{label}') / count(*) AS \"{name}\"" for label, name in kinds)
    return run.sql(
        f"""
        SELECT {WINDOW_S} AS time_s, {shares}
        FROM trust_lookups WHERE variant = $variant GROUP BY time_s ORDER BY time_s
    """,
        every_s=every_s,
    )


def without_trust(run: Run) -> pd.DataFrame:
    """Encounters of equipped vehicles that end before one had a value for the other that rests on an evaluation.

    Returns
    -------
    The columns of `encounters.DEFINITION`; n (both directions of every encounter), n_without, share, low, high (by the
    vehicle that would have the value), n_units, share_note if many of n_without are not over; and wait_median_s: time
    from the start to the first such value, of those that had none at the start; definition: its name. ValueError if no
    vehicle senses: nobody looks for trust then.
    """
    if not run.config.get("sensing", True):
        raise run.lacks("encounters in which trust is looked up", "")
    frame = run.variant_table("encounters", ["trusted_after_ab_s", "trusted_after_ba_s"])
    goes_on = run.table("encounters", ["censored_right"]).censored_right.to_numpy()
    after_ab_s, after_ba_s = frame.trusted_after_ab_s.to_numpy(), frame.trusted_after_ba_s.to_numpy()
    rows: list[dict[str, Any]] = []
    for kind, at, who in run.once_for_all("freshness.encounters", lambda: _of_equipped(run)):
        after_s = np.r_[after_ab_s[at], after_ba_s[at]]
        waited_s = after_s[after_s > 0]
        without = np.isnan(after_s)
        not_over = without & np.r_[goes_on[at], goes_on[at]]
        rows.append(
            {
                **dict(zip(DEFINITION, kind, strict=True)),
                "n": len(after_s),
                "n_without": int(without.sum()),
                **plain_columns(share(np.bincount(who, without), np.bincount(who)), "share"),
                "share_note": _not_over(int(not_over.sum()), int(without.sum())),
                "wait_median_s": float(np.median(waited_s)) if len(waited_s) else np.nan,
            }
        )
    columns = [*DEFINITION, "n", "n_without", "share", "low", "high", "n_units", "share_note"]
    found = pd.DataFrame(rows, columns=[*columns, "wait_median_s"])
    return found.assign(definition=named(found, definitions(run)))


def _not_over(n: int, n_without: int) -> str:
    """A note if more than a tenth of the directions without trust are of encounters that outlast the run."""
    return f"{n} of {n_without} are not over" if n > 0.1 * n_without else ""


def _of_equipped(run: Run) -> list[tuple[tuple, np.ndarray, np.ndarray]]:
    """By definition: rows of the encounters of equipped vehicles, and who would know, all `a` before all `b`."""
    frame = run.table("encounters", [*DEFINITION, "a", "b"])
    equipped = run.roles.index
    frame = frame[frame.a.isin(equipped) & frame.b.isin(equipped)]
    groups = frame.groupby([*DEFINITION], observed=True)
    found = []
    for kind, one in groups:
        who = np.r_[one.a, one.b].astype(np.int64)
        found.append((kind, one.index.to_numpy(), who))
    return found


def _totals(run: Run) -> pd.DataFrame:
    """Sums of the table `lookup_totals`: state, n, n_valued and sums of ages."""
    found = run.sql("""
        SELECT replace(state, '_', ' ') AS state, sum(n)::BIGINT AS n, sum(n_valued)::BIGINT AS n_valued,
            sum(age_sum_s::DOUBLE) AS age_s, sum(newest_evaluation_age_sum_s::DOUBLE) AS newest_evaluation_age_s,
            if(bool_or(oldest_evaluation_age_sum_s IS NULL), NULL, sum(oldest_evaluation_age_sum_s::DOUBLE))
                AS oldest_evaluation_age_s
        FROM lookup_totals WHERE variant = $variant GROUP BY state
    """)
    if found.empty:
        raise no_lookups(run)
    return found.set_index("state").reindex(STATES, fill_value=0)


def _ages_of_totals(run: Run) -> pd.DataFrame:
    total = _totals(run)
    n_known = total.n[list(KNOWN)].sum()
    n = dict(zip(AGES, (total.n_valued.sum(), n_known, n_known), strict=True))
    rows = [
        {"what": what, "role": "all", "n": n[what], "median_s": np.nan, "p90_s": np.nan}
        | plain_columns(without_interval(total[column].sum(skipna=False) / n[what]), "mean_s")
        for what, column in AGES.items()
        if n[what]
    ]
    if not rows:
        raise run.lacks(*_NO_EVALUATION)
    return pd.DataFrame(rows)


def _with_all(run: Run, counts: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Counts by receiver and code: of all subjects, then of each role that occurs."""
    for role, of_role in _with_every(run, counts):
        if role == "all" or of_role.any():
            yield role, of_role


def _with_every(run: Run, counts: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Counts by receiver and code: of all subjects, then of each role, whether it occurs or not."""
    yield "all", counts.sum(axis=1)
    for code, role in enumerate(run.role_labels):
        yield role, counts[:, code]


def quantiles(values: np.ndarray, counts: np.ndarray, shares: tuple[float, ...]) -> list[float]:
    """Quantiles of values that occur several times, equal to those of `np.quantile` in every bit.

    Parameters
    ----------
    values
        Values, ascending.
    counts
        How often each value occurs; at least one occurs.
    shares
        Probabilities of the quantiles, in [0, 1].

    Returns
    -------
    The quantile for each of `shares`.
    """
    before, n = np.cumsum(counts), int(counts.sum())
    found = []
    for one in shares:
        place = one * (n - 1)
        k = int(place)
        low = values[np.searchsorted(before, k, "right")]
        high = values[np.searchsorted(before, min(k + 1, n - 1), "right")]
        t = place - k
        value = high - (high - low) * (1 - t) if t >= 0.5 else low + (high - low) * t
        found.append(float(value))
    return found
