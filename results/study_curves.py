"""Distributions that a study compares: durations of encounters, and ages of trust when it is looked up.

Every run of a study keeps how often each duration and age occurs (`counts`), so that replicates can be pooled after
their tables are gone.
"""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray

from results.metrics import encounters, lookups
from results.run import Run

ENCOUNTERS, AGES = "encounters", "ages"
COLUMNS = {"what": "object", "group": "object", "value_s": "float64", "n": "int64", "n_open": "int64"}
"""Columns of `counts`, and their kinds."""


def counts(run: Run) -> pd.DataFrame:
    """How often each duration of an encounter and each age at lookup occurs in a run, seen as its variant.

    Returns
    -------
    what: `encounters` or `ages`. group: the definition of an encounter; empty for ages. value_s. n: encounters that
    ended after this time, or lookups whose newest evaluation is so old. n_open: encounters that were followed for so
    long; with an infinite value, lookups without any evaluation. Encounters whose start was not observed are left out.
    A run without encounters, or without lookups, has no rows of them.
    """
    parts = []
    for part in (_encounters, _ages):
        try:
            parts.append(part(run))
        except ValueError:  # it has none, or keeps none
            continue
    if not parts:
        return pd.DataFrame(columns=[*COLUMNS]).astype(COLUMNS)
    return pd.concat(parts, ignore_index=True)[[*COLUMNS]].astype(COLUMNS)


def _encounters(run: Run) -> pd.DataFrame:
    frame = encounters.durations(run)
    names = encounters.named(frame, encounters.definitions(run))
    seen = frame.assign(group=names)[encounters.followed(frame).to_numpy()]
    ended = seen.over.to_numpy(bool)
    found = pd.DataFrame({"group": seen.group.to_numpy(), "value_s": seen.lasted_s.to_numpy()})
    found = found.assign(n=ended.astype(np.int64), n_open=(~ended).astype(np.int64))
    return found.groupby(["group", "value_s"], as_index=False).sum().assign(what=ENCOUNTERS)


def _ages(run: Run) -> pd.DataFrame:
    found = lookups.sums(run)
    n = found.age_counts[:, list(lookups.AGES).index("newest evaluation")].sum(axis=0)
    there = n > 0
    without = int(found.states.sum()) - int(n.sum())
    known = pd.DataFrame({"value_s": lookups.ages_s(run)[there], "n": n[there], "n_open": 0})
    none = pd.DataFrame({"value_s": [np.inf], "n": [0], "n_open": [without]})
    return pd.concat([known, none], ignore_index=True).assign(what=AGES, group="")


def survival(frame: pd.DataFrame, at_s: Float[ndarray, "k"]) -> Float[ndarray, "k"]:
    """Share that lasts longer than each of these times (Kaplan and Meier 1958), of one sample's `counts`.

    NaN after the last observation, unless it is the end of the last one: none lasts longer then.
    """
    ordered = frame.groupby("value_s")[["n", "n_open"]].sum().sort_index()
    value_s = ordered.index.to_numpy(float)
    n = ordered.n.to_numpy(float)
    n_open = ordered.n_open.to_numpy(float)
    at_risk = np.cumsum((n + n_open)[::-1])[::-1]
    share = np.append(1.0, np.cumprod(1 - n / np.maximum(at_risk, 1.0)))
    found: ndarray = share[np.searchsorted(value_s, at_s, "right")]
    last_s = value_s[-1] if len(value_s) else -np.inf
    is_known = (at_s <= last_s) | (found == 0)
    return np.where(is_known, found, np.nan)


def pooled(frame: pd.DataFrame, until_s: float = 0.0) -> pd.DataFrame:
    """Survival of all replicates together, and how far the replicates spread.

    Parameters
    ----------
    frame
        `counts` of one combination of keys, with a column replicate.
    until_s
        Time that the curve reaches at least, as far as something is known there.

    Returns
    -------
    value_s, survival of the pooled sample, and low, high: the smallest and the largest survival of a replicate alone.
    First row 0 s.

    Notes
    -----
    The curve of a typical (median) replicate is within the band at a given time with probability 1 - 2^(1 - n), for n
    replicates that are independent: 0.75 for three, 0.94 for five.
    """
    finite = frame.value_s[np.isfinite(frame.value_s)]
    at_s = np.unique(np.append([0.0, until_s], finite[finite > 0]))
    each = np.array([survival(one, at_s) for _, one in frame.groupby("replicate")])
    whole = survival(frame, at_s)
    known = ~np.isnan(each)
    is_known = known.any(axis=0)
    least = np.where(known, each, np.inf).min(axis=0)
    most = np.where(known, each, -np.inf).max(axis=0)
    low = np.where(is_known, least, np.nan)
    high = np.where(is_known, most, np.nan)
    return pd.DataFrame({"value_s": at_s, "survival": whole, "low": low, "high": high})


def samples(curves: pd.DataFrame, keys: Sequence[str]) -> pd.DataFrame:
    """Rows with a column `value`: a number that is the same for points with the same sample."""
    of_row = pd.util.hash_pandas_object(curves[["value_s", "n", "n_open"]], index=False)
    of_point = of_row.groupby(curves.point, sort=False).sum()
    known = curves.drop_duplicates("point")[["point", "replicate", *keys]]
    return known.assign(value=known.point.map(of_point).to_numpy())
