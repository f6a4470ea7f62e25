"""How fresh trust is: the evidence behind a value, and the value when it is looked up."""

from typing import Any

import numpy as np
import pandas as pd

from results.codes import TrustSource, labels
from results.run import Run

STATES = ("fresh", "stale", "default")
"""Of a value that is looked up, in this order."""

_SOURCES = labels(TrustSource)

_EDGES_S = np.concatenate([[0.0], np.geomspace(0.05, 1e5, 600)])
"""Bins of age for quantiles of tables larger than memory: 2.4 % wide."""


_PEAK_BLOCKS = 20


_DEFAULT_ONLY = "holds no lookup of a trust value but the default: trust never reached a vehicle."
_NO_LOOKUPS = (
    "holds no trust lookups: no message was received. Raise radio.range_m or fleet.penetration_p, and run again."
)


def evidence(run: Run) -> pd.DataFrame:
    """Age of the evaluations behind the server's values, by role.

    Returns
    -------
    role, n (values), none_share (without any evaluation), and medians of newest_age_s, oldest_age_s,
    n_evaluations over the values that have some.
    """
    frame = run.variant_table("trust", ["subject", "n_evaluations", "newest_age_s", "oldest_age_s"])
    frame = frame.assign(role=frame.subject.map(run.subjects.role))
    some = frame[frame.n_evaluations > 0].groupby("role", observed=True)
    groups = frame.groupby("role", observed=True)
    return (
        groups.size().to_frame("n")
        .assign(none_share=groups.n_evaluations.agg(lambda n: float((n == 0).mean())))
        .join(some[["newest_age_s", "oldest_age_s", "n_evaluations"]].median())
        .reset_index()
    )  # fmt: skip


def at_lookup(run: Run) -> pd.DataFrame:
    """Age of trust where it is looked up, by source.

    Returns
    -------
    source, n, share, mean_s, median_s, p95_s; peak_s: mean age just before a receiver's value of a subject is
    renewed (peak age of information), null where none was; from 20 blocks spread over the run at most.
    """
    rows: dict[str, list[Any]] = {}
    stride = -(-run.n_blocks("trust_lookups") // _PEAK_BLOCKS)
    for block, part in enumerate(
        run.variant_parts("trust_lookups", ["step", "receiver", "subject", "source", "age_s"])
    ):
        code, age_s = _ages(part)
        peak = _peaks(part) if block % stride == 0 else np.zeros(0, int)
        for source in np.unique(code):
            chosen = code == source
            aged_s = age_s[chosen & ~np.isnan(age_s)]
            peak_s = age_s[peak[chosen[peak]]]
            row = rows.setdefault(_SOURCES[source], [0, 0.0, 0, 0.0, np.zeros(len(_EDGES_S) - 1)])
            row[0] += int(chosen.sum())
            row[1] += float(aged_s.sum(dtype=np.float64))
            row[2] += len(peak_s)
            row[3] += float(peak_s.sum(dtype=np.float64))
            row[4] += _histogram(aged_s)
    if not rows:
        raise ValueError(f"{run.path} {_NO_LOOKUPS}")
    total = sum(row[0] for row in rows.values())
    return pd.DataFrame([
        {
            "source": source, "n": n, "share": n / total,
            "mean_s": sum_s / histogram.sum() if histogram.any() else np.nan,
            "median_s": _quantile(histogram, 0.5), "p95_s": _quantile(histogram, 0.95),
            "peak_s": peak_sum / n_peaks if n_peaks else np.nan,
        }
        for source, (n, sum_s, n_peaks, peak_sum, histogram) in sorted(rows.items())
    ])  # fmt: skip


def distribution(run: Run) -> pd.DataFrame:
    """Cumulative distribution of the age of trust at lookup, defaults left out: age_s, share."""
    histogram = np.zeros(len(_EDGES_S) - 1)
    for part in run.variant_parts("trust_lookups", ["age_s"]):
        histogram += _histogram(part.age_s.dropna().to_numpy())
    if not histogram.any():
        raise ValueError(f"{run.path} {_DEFAULT_ONLY}")
    last = np.flatnonzero(histogram)[-1] + 1
    share = np.cumsum(histogram)[:last] / histogram.sum()
    return pd.DataFrame({"age_s": _EDGES_S[: last + 1], "share": np.r_[0, share]})


def shares(run: Run, fresh_s: float = 10.0) -> pd.DataFrame:
    """Share of lookups whose value is fresh (at most this old), stale, or the default: state, n, share."""
    counts = shares_by_role(run, fresh_s).groupby("state", sort=False).n.sum()
    return pd.DataFrame({"state": counts.index, "n": counts.to_numpy(), "share": (counts / counts.sum()).to_numpy()})


def shares_by_role(run: Run, fresh_s: float = 10.0) -> pd.DataFrame:
    """The same by role of the subject: role, state, n, share (of the lookups of that role)."""
    role_of, roles = _role_codes(run), run.role_labels
    counts = np.zeros((len(roles), len(STATES)), np.int64)
    for part in run.variant_parts("trust_lookups", ["subject", "source", "age_s"]):
        code, age_s = _ages(part)
        state = np.where(code == TrustSource.DEFAULT, 2, np.where(age_s <= fresh_s, 0, 1))
        both = role_of[part.subject.to_numpy()] * len(STATES) + state
        counts += np.bincount(both, minlength=counts.size).reshape(counts.shape)
    if not counts.any():
        raise ValueError(f"{run.path} {_NO_LOOKUPS}")
    return pd.DataFrame([
        {"role": role, "state": state, "n": n, "share": n / row.sum()}
        for role, row in zip(roles, counts, strict=True) if row.any()
        for state, n in zip(STATES, row.tolist(), strict=True)
    ])  # fmt: skip


def evidence_at_lookup(run: Run) -> pd.DataFrame:
    """Age, where trust is looked up, of the evaluations behind it, by role of the subject.

    Returns
    -------
    role, n (lookups of a value other than the default), none_share (no evaluation behind it), newest_s, oldest_s:
    mean age of the newest and the oldest evaluation (the oldest only where the server computed the value).

    Notes
    -----
    A server's value ages on its way: its evidence is as old as it was when the value was computed, and the age of
    the value on top. Which computation a value came from follows from its age; this goes wrong where the rounds of
    a step take longer than the server's period.
    """
    role_of, roles, server = _role_codes(run), run.role_labels, ServerEvidence(run)
    sums = np.zeros((5, len(roles)))  # lookups, with newest, its sum, with oldest, its sum
    for part in run.variant_parts("trust_lookups", ["step", "subject", "source", "age_s"]):
        part = part[part.age_s.notna()]
        newest_s, oldest_s = server.ages(part)
        whom = role_of[part.subject.to_numpy()]
        for row, age_s in ((1, newest_s), (3, oldest_s)):
            there = ~np.isnan(age_s)
            sums[row] += np.bincount(whom[there], minlength=len(roles))
            sums[row + 1] += np.bincount(whom[there], age_s[there], len(roles))
        sums[0] += np.bincount(whom, minlength=len(roles))
    if not sums[0].any():
        raise ValueError(f"{run.path} {_DEFAULT_ONLY}")
    n, n_newest, newest, n_oldest, oldest = sums
    with np.errstate(invalid="ignore"):
        frame = pd.DataFrame({
            "role": roles, "n": n.astype(np.int64), "none_share": 1 - n_newest / n,
            "newest_s": newest / n_newest, "oldest_s": oldest / n_oldest,
        })  # fmt: skip
    return frame[frame.n > 0].reset_index(drop=True)


_ROUNDING_S = 1 / 512
"""Larger than what is lost when ages are stored."""


class ServerEvidence:
    """Age of the evidence behind the server's values, by computation and subject."""

    def __init__(self, run: Run) -> None:
        self.dt_s = run.dt_s
        frame = run.variant_table("trust", ["step", "subject", "newest_age_s", "oldest_age_s"])
        self.steps = frame.step.unique()
        number = np.searchsorted(self.steps, frame.step)
        self.key = (number.astype(np.int64) << 32) | frame.subject.to_numpy()
        self.age_s = frame[["newest_age_s", "oldest_age_s"]].to_numpy(np.float64)

    def ages(self, lookups: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
        """Of the newest and the oldest evaluation behind each looked-up value; NaN where there is none."""
        age_s = lookups.age_s.to_numpy(np.float64)
        own = (lookups.source == "own").to_numpy()
        newest_s, oldest_s = np.where(own, age_s, np.nan), np.full(len(lookups), np.nan)
        if len(self.key):
            made = lookups.step.to_numpy() - age_s / self.dt_s  # a step begins earlier than trust is looked up in it
            number = np.searchsorted(self.steps, made - _ROUNDING_S / self.dt_s)
            key = (number << 32) | lookups.subject.to_numpy()
            at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
            found = ~own & (self.key[at] == key)
            newest_s[found], oldest_s[found] = (age_s[found, None] + self.age_s[at[found]]).T
        return newest_s, oldest_s


def over_time(run: Run, every_s: float = 10.0, fresh_s: float = 10.0) -> pd.DataFrame:
    """Shares by time: time_s, fresh, stale, default."""
    parts = []
    for part in run.variant_parts("trust_lookups", ["step", "source", "age_s"]):
        code, age_s = _ages(part)
        default, fresh = code == TrustSource.DEFAULT, age_s <= fresh_s
        slot = np.floor(part.step * run.dt_s / every_s) * every_s
        counts = pd.DataFrame({"time_s": slot, "fresh": fresh, "stale": ~fresh & ~default, "default": default})
        parts.append(counts.groupby("time_s").sum())
    if not parts:
        raise ValueError(f"{run.path} {_NO_LOOKUPS}")
    total = pd.concat(parts).groupby("time_s").sum()
    return total.div(total.sum(axis=1), axis=0).reset_index()


def without_trust(run: Run) -> pd.DataFrame:
    """Encounters of equipped vehicles that end before one had a value, other than the default, for the other.

    Returns
    -------
    pairs, radius_m, hysteresis_s, n (both directions of every encounter), n_without, share, and wait_median_s: time
    from the start to the first value, of those that had none at the start.
    """
    frame = run.variant_table(
        "encounters", ["pairs", "radius_m", "hysteresis_s", "a", "b", "trusted_after_ab_s", "trusted_after_ba_s"]
    )
    frame = frame[frame.a.isin(run.roles.index) & frame.b.isin(run.roles.index)]
    rows = []
    for (pairs, radius_m, hysteresis_s), found in frame.groupby(["pairs", "radius_m", "hysteresis_s"], observed=True):
        after_s = np.r_[found.trusted_after_ab_s, found.trusted_after_ba_s]
        waited_s = after_s[after_s > 0]
        without = np.isnan(after_s)
        rows.append({
            "pairs": pairs, "radius_m": radius_m, "hysteresis_s": hysteresis_s, "n": len(after_s),
            "n_without": int(without.sum()), "share": float(without.mean()),
            "wait_median_s": float(np.median(waited_s)) if len(waited_s) else np.nan,
        })  # fmt: skip
    columns = ["pairs", "radius_m", "hysteresis_s", "n", "n_without", "share", "wait_median_s"]
    return pd.DataFrame(rows, columns=columns)


def _role_codes(run: Run) -> np.ndarray:
    """Code of the role by pseudonym."""
    role = run.subjects.role
    codes = np.zeros(int(role.index.max()) + 1 if len(role) else 0, np.int64)
    codes[role.index] = role.cat.codes
    return codes


def _ages(part: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Source codes, and ages in seconds (NaN for the default)."""
    return part.source.cat.codes.to_numpy(), part.age_s.to_numpy()


def _peaks(part: pd.DataFrame) -> np.ndarray:
    """Rows just before a receiver's value of a subject is renewed."""
    key, age_s = (part.receiver.to_numpy(np.int64) << 32) | part.subject.to_numpy(), part.age_s.to_numpy()
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
