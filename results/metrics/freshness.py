"""How fresh trust is: what stands behind a value, and how old it is, when it is looked up.

Definitions and sources are in `results/FRESHNESS.md`.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from results.codes import LookupState, labels
from results.metrics import lookups, trust
from results.metrics.encounters import DEFINITION
from results.metrics.intervals import Estimate, ratio, share, without_interval
from results.metrics.lookups import AGES, EDGES_S, FRESH_S, NO_LOOKUPS, blocks, role_codes
from results.run import Run

STATES = labels(LookupState)
"""Of a lookup, in this order."""
KNOWN = ("judged", "stale")
"""States in which a value rests on an evaluation."""

_NO_EVALUATION = "holds no lookup of a trust value that rests on an evaluation: trust never reached a vehicle."


def evidence(run: Run) -> pd.DataFrame:
    """Age of the evaluations behind the server's values when it computes them, by role.

    Returns
    -------
    role, n (values), unjudged_share (without any evaluation by another vehicle that could see), and medians of
    newest_s, oldest_s, n_evaluations and n_evaluators over the values that have some.
    """
    columns = ["n_evaluations", "n_evaluators", "newest_evaluation_age_s", "oldest_evaluation_age_s"]
    known = trust.server_values(run)
    code, judged = role_codes(run, known["subject"]), known["state"] == LookupState.JUDGED
    values = {name: known[name].astype(np.float64) for name in columns}
    rows = []
    for role in np.unique(code):
        mine = code == role
        some = mine & judged
        medians = {name: np.median(value[some]) if some.any() else np.nan for name, value in values.items()}
        unjudged = float(1 - judged[mine].mean())
        rows.append({"role": run.role_labels[role], "n": int(mine.sum()), "unjudged_share": unjudged} | medians)
    found = pd.DataFrame(rows, columns=["role", "n", "unjudged_share", *columns])
    return found.rename(columns={columns[2]: "newest_s", columns[3]: "oldest_s"})


def states(run: Run) -> pd.DataFrame:
    """What stands behind the values that are looked up: shares of all lookups, and by role of the subject.

    Returns
    -------
    role ("all" first), state, n, share, low, high (95 %, clustered by the vehicle that looks up), n_units. From totals,
    where single lookups were not kept: of all alone, and without intervals.
    """
    if "trust_lookups" not in run.tables:
        total = _totals(run).n
        return pd.DataFrame([
            {"role": "all", "state": state, "n": int(n)} | _columns(without_interval(n / total.sum()), "share")
            for state, n in total.items()
        ])  # fmt: skip
    counts, rows = lookups.sums(run).states, []
    for role, of_role in _with_all(run, counts):
        n_lookups = of_role.sum(axis=1)
        for state, n in zip(STATES, of_role.T, strict=True):
            rows.append({"role": role, "state": state, "n": int(n.sum())} | _columns(share(n, n_lookups), "share"))
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
            n, total_s = (table[:, chosen, number].sum(axis=1) for table in (found.aged, found.age_sum_s))
            if n.sum():
                histogram = found.histogram[chosen, number].sum(axis=0)
                rows.append({
                    "what": what, "role": role, "n": int(n.sum()), **_columns(ratio(total_s, n), "mean_s"),
                    "median_s": _quantile(histogram, 0.5), "p90_s": _quantile(histogram, 0.9),
                })  # fmt: skip
    if not rows:
        raise ValueError(f"{run.path} {_NO_EVALUATION}")
    return pd.DataFrame(rows)


def peaks(run: Run) -> pd.DataFrame:
    """Peak age: at the last lookup before a receiver's value of a subject, or the evidence behind it, is renewed.

    Returns
    -------
    what (value, newest evaluation), n (renewals), mean_s, low, high, n_units (receivers); of 20 blocks spread over
    the run at most. What was not renewed has no peak.
    """
    found, rows = lookups.sums(run), []
    for what, n, total_s in zip(lookups.RENEWED, found.renewed.T, found.peak_sum_s.T, strict=True):
        if n.sum():
            rows.append({"what": what, "n": int(n.sum())} | _columns(ratio(total_s, n), "mean_s"))
    return pd.DataFrame(rows, columns=["what", "n", "mean_s", "low", "high", "n_units"])


def within(run: Run, fresh_s: float = FRESH_S) -> pd.DataFrame:
    """Share of all lookups with an evaluation at most `fresh_s` old behind the value, whatever the window.

    Returns
    -------
    role ("all" first), n (lookups), share, low, high, n_units (vehicles that look up).
    """
    found = lookups.sums(run, fresh_s)
    counts = np.stack([found.fresh, found.states.sum(axis=2)], axis=2)
    return pd.DataFrame(
        [{"role": role, "n": int(n[:, 1].sum())} | _columns(share(*n.T), "share") for role, n in _with_all(run, counts)]
    )


def behind(run: Run) -> pd.DataFrame:
    """How much stands behind values with evaluations: what (evaluations, evaluators), n, mean, low, high, n_units."""
    found, rows = lookups.sums(run), []
    for column, n, total in zip(lookups.BEHIND, found.behind.T, found.behind_sum.T, strict=True):
        if n.sum():
            rows.append({"what": column.removeprefix("n_"), "n": int(n.sum())} | _columns(ratio(total, n), "mean"))
    return pd.DataFrame(rows, columns=["what", "n", "mean", "low", "high", "n_units"])


def distribution(run: Run, what: str = "newest evaluation") -> pd.DataFrame:
    """Cumulative distribution of an age at lookup (a key of `AGES`), where there is one: age_s, share."""
    histogram = lookups.sums(run).histogram[:, list(AGES).index(what)].sum(axis=0)
    if not histogram.any():
        raise ValueError(f"{run.path} {_NO_EVALUATION}")
    last = np.flatnonzero(histogram)[-1] + 1
    share = np.cumsum(histogram)[:last] / histogram.sum()
    return pd.DataFrame({"age_s": EDGES_S[: last + 1], "share": np.r_[0, share]})


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Shares of the states by time: time_s, judged, unjudged, stale, default."""
    parts = []
    for part in blocks(run, ["step", "state"]):
        slot, at = np.unique(np.floor(part["step"] * run.dt_s / every_s), return_inverse=True)
        n = np.bincount(at * len(STATES) + part["state"], minlength=len(slot) * len(STATES))
        parts.append(pd.DataFrame(n.reshape(-1, len(STATES)), pd.Index(slot * every_s, name="time_s"), STATES))
    total = pd.concat(parts).groupby("time_s").sum()
    return total.div(total.sum(axis=1), axis=0).reset_index()


def without_trust(run: Run) -> pd.DataFrame:
    """Encounters of equipped vehicles that end before one knew a value, resting on an evaluation, for the other.

    Returns
    -------
    the columns of `encounters.DEFINITION`, n (both directions of every encounter), n_without, share, low, high (by
    the vehicle that would know), n_units, and wait_median_s: time from the start to the first such value, of those
    that had none at the start.
    """
    after_ab_s, after_ba_s = run.variant_array("encounters", ["trusted_after_ab_s", "trusted_after_ba_s"]).values()
    rows: list[dict[str, Any]] = []
    for kind, at, who in run.once_for_all("freshness.encounters", lambda: _of_equipped(run)):
        after_s = np.r_[after_ab_s[at], after_ba_s[at]]
        waited_s = after_s[after_s > 0]
        without = np.isnan(after_s)
        rows.append({
            **dict(zip(DEFINITION, kind, strict=True)), "n": len(after_s),
            "n_without": int(without.sum()), **_columns(share(np.bincount(who, without), np.bincount(who)), "share"),
            "wait_median_s": float(np.median(waited_s)) if len(waited_s) else np.nan,
        })  # fmt: skip
    columns = [*DEFINITION, "n", "n_without", "share", "low", "high", "n_units"]
    return pd.DataFrame(rows, columns=[*columns, "wait_median_s"])


def _of_equipped(run: Run) -> list[tuple[tuple, np.ndarray, np.ndarray]]:
    """By definition: rows of the encounters of equipped vehicles, and who would know, all `a` before all `b`."""
    frame = run.table("encounters", [*DEFINITION, "a", "b"])
    frame = frame[frame.a.isin(run.roles.index) & frame.b.isin(run.roles.index)]
    groups = frame.groupby([*DEFINITION], observed=True)
    return [(kind, one.index.to_numpy(), np.r_[one.a, one.b].astype(np.int64)) for kind, one in groups]


def _totals(run: Run) -> pd.DataFrame:
    """Sums of the table `lookup_totals`, by state in the order of `STATES`."""
    frame = run.variant_table("lookup_totals")
    if frame.empty:
        raise ValueError(f"{run.path} {NO_LOOKUPS}")
    return frame.groupby(frame.state.astype(str)).sum(numeric_only=True).reindex(STATES, fill_value=0)


def _ages_of_totals(run: Run) -> pd.DataFrame:
    total = _totals(run)
    n_known = int(total.n[list(KNOWN)].sum())
    counts = {"value": int(total.n_valued.sum()), "newest evaluation": n_known, "oldest evaluation": n_known}
    rows = [
        {"what": what, "role": "all", "n": n, "median_s": np.nan, "p90_s": np.nan}
        | _columns(without_interval(float(total[column.replace("_s", "_sum_s")].sum()) / n), "mean_s")
        for (what, column), n in zip(AGES.items(), counts.values(), strict=True)
        if n
    ]
    if not rows:
        raise ValueError(f"{run.path} {_NO_EVALUATION}")
    return pd.DataFrame(rows)


def _with_all(run: Run, counts: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Counts by receiver and code: of all subjects, then of each role that occurs."""
    yield "all", counts.sum(axis=1)
    for code, role in enumerate(run.role_labels):
        if counts[:, code].any():
            yield role, counts[:, code]


def _columns(estimate: Estimate, value: str) -> dict[str, float]:
    return {value: estimate.value, "low": estimate.low, "high": estimate.high, "n_units": estimate.n_units}


def _quantile(histogram: np.ndarray, share: float) -> float:
    """Of a histogram over `EDGES_S`, linear within a bin."""
    if not histogram.any():
        return float("nan")
    return float(np.interp(share * histogram.sum(), np.r_[0, np.cumsum(histogram)], EDGES_S))
