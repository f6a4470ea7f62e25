"""How fresh trust is: what stands behind a value, and how old it is, when it is looked up.

Definitions and sources are in `results/FRESHNESS.md`.
"""

from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd

from results.codes import LookupState, labels
from results.metrics.encounters import DEFINITION
from results.metrics.intervals import Estimate, ratio, share, without_interval
from results.run import Run

STATES = labels(LookupState)
"""Of a lookup, in this order."""
KNOWN = ("judged", "stale")
"""States in which a value rests on an evaluation."""

AGES: Mapping[str, str] = {
    "value": "age_s",
    "newest evaluation": "newest_evaluation_age_s",
    "oldest evaluation": "oldest_evaluation_age_s",
}
"""What ages, and the column of `trust_lookups` that says how old it is."""

_EDGES_S = np.concatenate([[0.0, 1e-6], np.geomspace(0.05, 1e5, 600)])
"""Bins of age for quantiles of tables larger than memory: 2.4 % wide."""
_PEAK_BLOCKS = 20

_NO_EVALUATION = "holds no lookup of a trust value that rests on an evaluation: trust never reached a vehicle."
_NO_LOOKUPS = (
    "holds no trust lookups: no message was received. Raise radio.range_m or fleet.penetration_p, and run again."
)


def evidence(run: Run) -> pd.DataFrame:
    """Age of the evaluations behind the server's values when it computes them, by role.

    Returns
    -------
    role, n (values), unjudged_share (without any evaluation by another vehicle that could see), and medians of
    newest_s, oldest_s, n_evaluations and n_evaluators over the values that have some.
    """
    columns = ["n_evaluations", "n_evaluators", "newest_evaluation_age_s", "oldest_evaluation_age_s"]
    frame = run.variant_table("trust", ["subject", "state", *columns])
    frame = frame.assign(role=frame.subject.map(run.subjects.role))
    groups = frame.groupby("role", observed=True)
    some = frame[frame.state == "judged"].groupby("role", observed=True)[columns].median()
    return (
        groups.size().to_frame("n")
        .assign(unjudged_share=groups.state.agg(lambda state: float((state != "judged").mean())))
        .join(some.rename(columns={columns[2]: "newest_s", columns[3]: "oldest_s"}))
        .reset_index()
    )  # fmt: skip


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
    counts = _per_receiver(run, ["state"], lambda part: part.state.cat.codes.to_numpy(), len(STATES))
    rows = []
    for role, of_role in _with_all(run, counts):
        lookups = of_role.sum(axis=1)
        for state, n in zip(STATES, of_role.T, strict=True):
            rows.append({"role": role, "state": state, "n": int(n.sum())} | _columns(share(n, lookups), "share"))
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
    roles, n_bins = ("all", *run.role_labels), len(_EDGES_S) - 1
    rows = []
    for what, column in AGES.items():
        sums, counts = _Totals(len(run.role_labels)), _Totals(len(run.role_labels))
        histograms = np.zeros((len(run.role_labels), n_bins), np.int64)
        role_of = _RoleCodes(run)
        for part in _lookups(run, ["receiver", "subject", column]):
            age_s = part[column].to_numpy(np.float64)
            there = ~np.isnan(age_s)
            code_of, receiver = role_of(part.subject.to_numpy()[there]), part.receiver.to_numpy()[there]
            sums.add(receiver, code_of, age_s[there])
            counts.add(receiver, code_of)
            for code in np.unique(code_of):
                histograms[code] += _histogram(age_s[there][code_of == code])
        for code, role in enumerate(roles):
            chosen = slice(None) if code == 0 else slice(code - 1, code)
            n, histogram = counts.table[:, chosen].sum(axis=1), histograms[chosen].sum(axis=0)
            if n.sum():
                mean = ratio(sums.table[:, chosen].sum(axis=1), n)
                rows.append({
                    "what": what, "role": role, "n": int(n.sum()), **_columns(mean, "mean_s"),
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
    stride = -(-run.n_blocks("trust_lookups") // _PEAK_BLOCKS)
    rows = []
    for what in ("value", "newest evaluation"):
        sums, counts = _Totals(1), _Totals(1)
        for block, part in enumerate(_lookups(run, ["receiver", "subject", AGES[what]], by_block=True)):
            if block % stride == 0:
                age_s = part[AGES[what]].to_numpy(np.float64)
                at = _before_renewal(part, age_s)
                nobody = np.zeros(len(at), np.int64)
                sums.add(part.receiver.to_numpy()[at], nobody, age_s[at])
                counts.add(part.receiver.to_numpy()[at], nobody)
        n = counts.table[:, 0]
        if n.sum():
            rows.append({"what": what, "n": int(n.sum())} | _columns(ratio(sums.table[:, 0], n), "mean_s"))
    return pd.DataFrame(rows, columns=["what", "n", "mean_s", "low", "high", "n_units"])


def within(run: Run, fresh_s: float = 10.0) -> pd.DataFrame:
    """Share of all lookups with an evaluation at most `fresh_s` old behind the value, whatever the window.

    Returns
    -------
    role ("all" first), n (lookups), share, low, high, n_units (vehicles that look up).
    """
    counts = _per_receiver(
        run, ["newest_evaluation_age_s"], lambda part: (part.newest_evaluation_age_s <= fresh_s).to_numpy(int), 2
    )
    return pd.DataFrame([
        {"role": role, "n": int(n.sum())} | _columns(share(n[:, 1], n.sum(axis=1)), "share")
        for role, n in _with_all(run, counts)
    ])  # fmt: skip


def behind(run: Run) -> pd.DataFrame:
    """How much stands behind values with evaluations: what (evaluations, evaluators), n, mean, low, high, n_units."""
    rows = []
    for what, column in (("evaluations", "n_evaluations"), ("evaluators", "n_evaluators")):
        sums, counts = _Totals(1), _Totals(1)
        for part in _lookups(run, ["receiver", "newest_evaluation_age_s", column]):
            part = part[part.newest_evaluation_age_s.notna() & part[column].notna()]
            all_one = np.zeros(len(part), np.int64)
            sums.add(part.receiver.to_numpy(), all_one, part[column].to_numpy(np.float64))
            counts.add(part.receiver.to_numpy(), all_one)
        if counts.table.sum():
            mean = ratio(sums.table[:, 0], counts.table[:, 0])
            rows.append({"what": what, "n": int(counts.table.sum())} | _columns(mean, "mean"))
    return pd.DataFrame(rows, columns=["what", "n", "mean", "low", "high", "n_units"])


def distribution(run: Run, what: str = "newest evaluation") -> pd.DataFrame:
    """Cumulative distribution of an age at lookup (a key of `AGES`), where there is one: age_s, share."""
    histogram = np.zeros(len(_EDGES_S) - 1)
    for part in _lookups(run, [AGES[what]]):
        histogram += _histogram(part[AGES[what]].dropna().to_numpy(np.float64))
    if not histogram.any():
        raise ValueError(f"{run.path} {_NO_EVALUATION}")
    last = np.flatnonzero(histogram)[-1] + 1
    share = np.cumsum(histogram)[:last] / histogram.sum()
    return pd.DataFrame({"age_s": _EDGES_S[: last + 1], "share": np.r_[0, share]})


def over_time(run: Run, every_s: float = 10.0) -> pd.DataFrame:
    """Shares of the states by time: time_s, judged, unjudged, stale, default."""
    parts = []
    for part in _lookups(run, ["step", "state"]):
        slot = np.floor(part.step * run.dt_s / every_s) * every_s
        parts.append(pd.crosstab(slot.rename("time_s"), part.state.astype(str)).reindex(columns=STATES, fill_value=0))
    total = pd.concat(parts).groupby("time_s").sum()
    total.columns.name = None
    return total.div(total.sum(axis=1), axis=0).reset_index()


def without_trust(run: Run) -> pd.DataFrame:
    """Encounters of equipped vehicles that end before one knew a value, resting on an evaluation, for the other.

    Returns
    -------
    the columns of `encounters.DEFINITION`, n (both directions of every encounter), n_without, share, low, high (by
    the vehicle that would know), n_units, and wait_median_s: time from the start to the first such value, of those
    that had none at the start.
    """
    frame = run.variant_table("encounters", [*DEFINITION, "a", "b", "trusted_after_ab_s", "trusted_after_ba_s"])
    frame = frame[frame.a.isin(run.roles.index) & frame.b.isin(run.roles.index)]
    rows: list[dict[str, Any]] = []
    for kind, found in frame.groupby([*DEFINITION], observed=True):
        after_s = np.r_[found.trusted_after_ab_s, found.trusted_after_ba_s]
        who = np.r_[found.a, found.b].astype(np.int64)
        waited_s = after_s[after_s > 0]
        without = np.isnan(after_s)
        rows.append({
            **dict(zip(DEFINITION, kind, strict=True)), "n": len(after_s),
            "n_without": int(without.sum()), **_columns(share(np.bincount(who, without), np.bincount(who)), "share"),
            "wait_median_s": float(np.median(waited_s)) if len(waited_s) else np.nan,
        })  # fmt: skip
    columns = [*DEFINITION, "n", "n_without", "share", "low", "high", "n_units"]
    return pd.DataFrame(rows, columns=[*columns, "wait_median_s"])


def _totals(run: Run) -> pd.DataFrame:
    """Sums of the table `lookup_totals`, by state in the order of `STATES`."""
    frame = run.variant_table("lookup_totals")
    if frame.empty:
        raise ValueError(f"{run.path} {_NO_LOOKUPS}")
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


class _Totals:
    """Sums by vehicle and group, whatever the largest number of a vehicle."""

    def __init__(self, n_groups: int) -> None:
        self.table = np.zeros((0, n_groups))

    def add(self, vehicle: np.ndarray, group: np.ndarray, values: np.ndarray | None = None) -> None:
        n_groups = self.table.shape[1]
        more = int(vehicle.max(initial=-1)) + 1 - len(self.table)
        if more > 0:
            self.table = np.concatenate([self.table, np.zeros((more, n_groups))])
        key = vehicle.astype(np.int64) * n_groups + group
        self.table += np.bincount(key, values, self.table.size).reshape(self.table.shape)


def _per_receiver(run: Run, columns: list[str], code_of, n_codes: int) -> np.ndarray:
    """Lookups by receiver, role of the subject, and a code of each lookup."""
    role_of, n_roles, totals = _RoleCodes(run), len(run.role_labels), _Totals(len(run.role_labels) * n_codes)
    for part in _lookups(run, ["receiver", "subject", *columns]):
        totals.add(part.receiver.to_numpy(), role_of(part.subject.to_numpy()) * n_codes + code_of(part))
    return totals.table.reshape(-1, n_roles, n_codes)


def _with_all(run: Run, counts: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Counts by receiver and code: of all subjects, then of each role that occurs."""
    yield "all", counts.sum(axis=1)
    for code, role in enumerate(run.role_labels):
        if counts[:, code].any():
            yield role, counts[:, code]


def _columns(estimate: Estimate, value: str) -> dict[str, float]:
    return {value: estimate.value, "low": estimate.low, "high": estimate.high, "n_units": estimate.n_units}


_IN_MEMORY = 2_000_000
"""Rows of `trust_lookups` up to which they are read once for all metrics."""
_ASKED = ["step", "receiver", "subject", "state", *AGES.values(), "n_evaluations", "n_evaluators"]


def _lookups(run: Run, columns: list[str], by_block: bool = False) -> Iterator[pd.DataFrame]:
    """Lookups of the run's variant: together where they fit into memory, else block by block."""
    parts: Iterable[pd.DataFrame]
    if run.n_rows("trust_lookups") // len(run.variants) > _IN_MEMORY:
        parts = run.variant_parts("trust_lookups", columns)
    else:
        frame, ends = run.once("freshness.lookups", lambda: _in_memory(run))
        frame = frame[columns]
        parts = (frame.iloc[i:j] for i, j in pairwise(ends)) if by_block else [frame]
    empty = True
    for part in parts:
        empty &= part.empty
        yield part
    if empty:
        raise ValueError(f"{run.path} {_NO_LOOKUPS}")


def _in_memory(run: Run) -> tuple[pd.DataFrame, list[int]]:
    """All lookups of the variant, and where blocks begin and end."""
    parts = list(run.variant_parts("trust_lookups", _ASKED))
    frame = pd.concat(parts, ignore_index=True) if parts else run.variant_table("trust_lookups", _ASKED)
    return frame, [0, *np.cumsum([len(part) for part in parts]).tolist()]


class _RoleCodes:
    """Code of the role by pseudonym, whatever the largest number of a pseudonym."""

    def __init__(self, run: Run) -> None:
        role = run.subjects.role.sort_index()
        self.pseudonym, self.code = role.index.to_numpy(), role.cat.codes.to_numpy(np.int64)

    def __call__(self, pseudonym: np.ndarray) -> np.ndarray:
        return self.code[np.searchsorted(self.pseudonym, pseudonym)]


def _before_renewal(part: pd.DataFrame, age_s: np.ndarray) -> np.ndarray:
    """Rows just before a receiver's value of a subject is renewed."""
    key = (part.receiver.to_numpy(np.int64) << 32) | part.subject.to_numpy()
    order = np.argsort(key, kind="stable")  # rows are in order of time within a pair
    return order[:-1][(np.diff(key[order]) == 0) & (np.diff(age_s[order]) < 0)]


def _histogram(age_s: np.ndarray) -> np.ndarray:
    at = np.searchsorted(_EDGES_S, np.clip(age_s, 0, _EDGES_S[-2]), "right") - 1
    return np.bincount(at, minlength=len(_EDGES_S) - 1)


def _quantile(histogram: np.ndarray, share: float) -> float:
    """Of a histogram over `_EDGES_S`, linear within a bin."""
    if not histogram.any():
        return float("nan")
    return float(np.interp(share * histogram.sum(), np.r_[0, np.cumsum(histogram)], _EDGES_S))
