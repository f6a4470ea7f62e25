"""How long vehicles meet: counts, durations, and survival with censoring in mind."""

import warnings
from typing import Literal

import numpy as np
import pandas as pd
from scipy.stats import CensoredData, ecdf

from results.archive import Run

Departure = Literal["ends", "censors"]
"""Whether an actor that leaves the simulation ends its encounters, or only our sight of them."""

_COLUMNS = (
    "pairs", "radius_m", "duration_s", "censored_left", "censored_right", "departed", "gap_s",
)  # fmt: skip


def durations(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """One row per encounter: pairs, radius_m, duration_s, gap_s, `start_seen` and `end_seen`."""
    frame = run.table("encounters", _COLUMNS)
    if frame.empty:
        raise ValueError(
            f"{run.path} holds no encounters: nobody came within the radius of anybody. "
            "Raise encounters.radius_m, fleet.penetration_p or traffic.duration_s and run again."
        )
    end_seen = ~frame.censored_right
    if departure == "censors":
        end_seen &= ~frame.departed
    return frame.assign(start_seen=~frame.censored_left, end_seen=end_seen)[
        ["pairs", "radius_m", "duration_s", "gap_s", "start_seen", "end_seen"]
    ]


def survival(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """Share of encounters that last longer than a duration (Kaplan and Meier 1958), by pairs and radius.

    Returns
    -------
    pairs, radius_m, duration_s, survival, and low, high: its 95 % confidence band (Greenwood, log-log).

    Notes
    -----
    Encounters whose end was not seen count for as long as they were seen. Those whose start was not seen are
    left out: they are a sample biased to long ones, of unknown age (`summary` says how many).
    """
    groups = durations(run, departure).groupby(["pairs", "radius_m"], observed=True)
    return pd.concat([_kaplan_meier(frame).assign(pairs=p, radius_m=r) for (p, r), frame in groups], ignore_index=True)[
        ["pairs", "radius_m", "duration_s", "survival", "low", "high"]
    ]


def summary(run: Run, departure: Departure = "ends") -> pd.DataFrame:
    """Counts and durations, by pairs and radius.

    Returns
    -------
    n; n_start_unseen, n_end_unseen (censored left and right); mean_s, median_s of the durations as recorded;
    km_median_s (null where more than half were not seen to end) and km_mean_s, restricted to the longest
    duration seen, `horizon_s`; again_share: share that meet again, gap_median_s: after this time.
    """
    rows = []
    for (pairs, radius_m), frame in durations(run, departure).groupby(["pairs", "radius_m"], observed=True):
        curve = _kaplan_meier(frame)
        below = curve.duration_s[curve.survival <= 0.5]
        again = frame.gap_s.dropna()
        rows.append({
            "pairs": pairs, "radius_m": radius_m, "n": len(frame),
            "n_start_unseen": int((~frame.start_seen).sum()), "n_end_unseen": int((~frame.end_seen).sum()),
            "mean_s": float(frame.duration_s.mean()), "median_s": float(frame.duration_s.median()),
            "km_mean_s": restricted_mean(curve), "km_median_s": float(below.iloc[0]) if len(below) else np.nan,
            "horizon_s": float(curve.duration_s.iloc[-1]), "again_share": len(again) / len(frame),
            "gap_median_s": float(again.median()) if len(again) else np.nan,
        })  # fmt: skip
    return pd.DataFrame(rows)


def restricted_mean(curve: pd.DataFrame) -> float:
    """Mean duration up to the longest one seen: the area under the survival curve [s]."""
    return float((curve.survival.to_numpy()[:-1] * np.diff(curve.duration_s)).sum())


def _kaplan_meier(frame: pd.DataFrame) -> pd.DataFrame:
    seen = frame[frame.start_seen]
    if seen.empty:
        return pd.DataFrame({"duration_s": [0.0], "survival": [1.0], "low": [1.0], "high": [1.0]})
    lasted = seen.duration_s.to_numpy(np.float64)
    over = seen.end_seen.to_numpy(bool)
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the band is undefined where all or nobody is left
        curve = ecdf(CensoredData(uncensored=lasted[over], right=lasted[~over])).sf
        band = curve.confidence_interval(method="log-log") if over.any() else None
    x, p = np.asarray(curve.quantiles), np.asarray(curve.probabilities)
    low, high = (p, p) if band is None else (np.asarray(band.low.probabilities), np.asarray(band.high.probabilities))
    return pd.DataFrame(
        {"duration_s": np.r_[0, x], "survival": np.r_[1, p],
         "low": np.r_[1, np.where(np.isnan(low), p, low)], "high": np.r_[1, np.where(np.isnan(high), p, high)]}
    )  # fmt: skip
