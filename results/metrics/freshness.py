"""How fresh trust is: the evidence behind a value, and the value when it is used."""

from typing import Any

import numpy as np
import pandas as pd

from results.archive import Run

_EDGES_S = np.concatenate([[0.0], np.geomspace(0.05, 1e5, 600)])
"""Bins of age for quantiles of tables larger than memory: 2.4 % wide."""


def evidence(run: Run) -> pd.DataFrame:
    """Age of the evaluations behind the server's values, by behaviour.

    Returns
    -------
    behaviour, n (values), none_share (without any evaluation), and medians of newest_age_s, oldest_age_s,
    n_evaluations over the values that have some.
    """
    frame = run.table("trust", ["vehicle", "n_evaluations", "newest_age_s", "oldest_age_s"])
    frame = frame.assign(behaviour=frame.vehicle.map(run.roles))
    some = frame[frame.n_evaluations > 0].groupby("behaviour", observed=True)
    groups = frame.groupby("behaviour", observed=True)
    return (
        groups.size().to_frame("n")
        .assign(none_share=groups.n_evaluations.agg(lambda n: float((n == 0).mean())))
        .join(some[["newest_age_s", "oldest_age_s", "n_evaluations"]].median())
        .reset_index()
    )  # fmt: skip


def at_use(run: Run) -> pd.DataFrame:
    """Age of trust where it is used, by source.

    Returns
    -------
    source, n, share, mean_s, median_s, p95_s; peak_s: mean age just before a receiver's value of a vehicle is
    renewed (peak age of information), null where none was.
    """
    rows: dict[str, list[Any]] = {}
    for part in run.parts("uses"):
        for source, frame in part.groupby("source", observed=True):
            age_s = frame.age_s.dropna().to_numpy()
            peak = _peaks(frame)
            row = rows.setdefault(source, [0, 0.0, 0, 0.0, np.zeros(len(_EDGES_S) - 1)])
            row[0] += len(frame)
            row[1] += float(age_s.sum(dtype=np.float64))
            row[2] += len(peak)
            row[3] += float(peak.sum(dtype=np.float64))
            row[4] += np.histogram(np.minimum(age_s, _EDGES_S[-1]), _EDGES_S)[0]
    if not rows:
        raise ValueError(f"{run.path} holds no uses of trust: nobody heard anybody. Widen radio.reach_m and run again.")
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
    """Cumulative distribution of the age of trust at use, defaults left out: age_s, share."""
    histogram = np.zeros(len(_EDGES_S) - 1)
    for part in run.parts("uses", ["age_s"]):
        histogram += np.histogram(np.minimum(part.age_s.dropna(), _EDGES_S[-1]), _EDGES_S)[0]
    if not histogram.any():
        raise ValueError(f"{run.path} holds no use of a trust value but the default: trust never reached anybody.")
    last = np.flatnonzero(histogram)[-1] + 1
    share = np.cumsum(histogram)[:last] / histogram.sum()
    return pd.DataFrame({"age_s": _EDGES_S[: last + 1], "share": np.r_[0, share]})


def shares(run: Run, fresh_s: float = 10.0) -> pd.DataFrame:
    """Share of uses whose value is fresh (at most this old), stale, or the default: state, n, share."""
    counts = np.zeros(3, np.int64)
    for part in run.parts("uses", ["source", "age_s"]):
        default = (part.source == "default").to_numpy()
        fresh = ~default & (part.age_s.to_numpy() <= fresh_s)
        counts += [fresh.sum(), (~fresh & ~default).sum(), default.sum()]
    return pd.DataFrame({"state": ["fresh", "stale", "default"], "n": counts, "share": counts / max(counts.sum(), 1)})


def over_time(run: Run, every_s: float = 10.0, fresh_s: float = 10.0) -> pd.DataFrame:
    """Shares by time: time_s, fresh, stale, default."""
    parts = []
    for part in run.parts("uses", ["step", "source", "age_s"]):
        default = part.source == "default"
        fresh = ~default & (part.age_s <= fresh_s)
        slot = np.floor(part.step * run.dt_s / every_s) * every_s
        counts = pd.DataFrame({"time_s": slot, "fresh": fresh, "stale": ~fresh & ~default, "default": default})
        parts.append(counts.groupby("time_s").sum())
    if not parts:
        raise ValueError(f"{run.path} holds no uses of trust: nobody heard anybody. Widen radio.reach_m and run again.")
    total = pd.concat(parts).groupby("time_s").sum()
    return total.div(total.sum(axis=1), axis=0).reset_index()


def without_trust(run: Run) -> pd.DataFrame:
    """Encounters that end before one had a value of its own or of the server's for the other.

    Returns
    -------
    radius_m, n (directions of encounters between equipped vehicles), n_without, share.
    """
    meetings = run.table(
        "encounters", ["pairs", "radius_m", "a", "b", "start_step", "end_step", "source_ab", "source_ba"]
    )
    equipped = run.roles.index
    meetings = meetings[meetings.a.isin(equipped) & meetings.b.isin(equipped) & (meetings.pairs != "sight")]
    rows = []
    for radius_m, frame in meetings.groupby("radius_m"):
        one, other = (np.r_[frame[x], frame[y]].astype(np.int64) for x, y in (("a", "b"), ("b", "a")))
        start, end = (np.tile(frame[name].to_numpy(np.int64), 2) for name in ("start_step", "end_step"))
        had = np.r_[frame.source_ab.isin(["server", "own"]), frame.source_ba.isin(["server", "own"])]
        pairs, index = np.unique((one << 32) | other, return_inverse=True)
        order = np.lexsort([start, index])
        begins, end, had = ((index << 32) | start)[order], end[order], had[order]
        for part in run.parts("uses", ["step", "receiver", "subject", "source"]):
            use = part[part.source != "default"][["step", "receiver", "subject"]].to_numpy(np.int64)
            key = (use[:, 1] << 32) | use[:, 2]
            at = np.minimum(np.searchsorted(pairs, key), len(pairs) - 1)
            during = np.searchsorted(begins, (at << 32) | use[:, 0], "right") - 1
            inside = (pairs[at] == key) & (during >= 0) & (begins[during] >> 32 == at) & (use[:, 0] < end[during])
            had[during[inside]] = True
        n_without = int((~had).sum())
        rows.append({"radius_m": radius_m, "n": len(had), "n_without": n_without, "share": n_without / len(had)})
    return pd.DataFrame(rows, columns=["radius_m", "n", "n_without", "share"])


def _peaks(frame: pd.DataFrame) -> np.ndarray:
    """Ages just before a renewal, within one block of steps."""
    ordered = frame.dropna(subset="age_s").sort_values(["receiver", "subject", "step"], kind="stable")
    age_s = ordered.age_s.to_numpy()
    pair = ordered[["receiver", "subject"]].to_numpy()
    renewed = (pair[1:] == pair[:-1]).all(axis=1) & (age_s[1:] < age_s[:-1])
    return age_s[:-1][renewed]


def _quantile(histogram: np.ndarray, share: float) -> float:
    """Of a histogram over `_EDGES_S`, linear within a bin."""
    if not histogram.any():
        return float("nan")
    return float(np.interp(share * histogram.sum(), np.r_[0, np.cumsum(histogram)], _EDGES_S))
