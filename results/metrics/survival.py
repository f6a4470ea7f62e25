"""How long something lasts that was not always seen to end (Kaplan and Meier 1958)."""

import warnings

import numpy as np
import pandas as pd
from numpy import ndarray
from scipy.stats import CensoredData, ecdf


def kaplan_meier(lasted_s: ndarray, over: ndarray) -> pd.DataFrame:
    """Share that lasts longer than a duration.

    Parameters
    ----------
    lasted_s
        Duration of each, as far as it was seen [n].
    over
        Whether it was seen to end [n].

    Returns
    -------
    duration_s, survival, and low, high: its 95 % confidence band (Greenwood, log-log); first row 0 s.
    """
    if not len(lasted_s):
        return pd.DataFrame({"duration_s": [0.0], "survival": [1.0], "low": [1.0], "high": [1.0]})
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the band is undefined where all or none are left
        curve = ecdf(CensoredData(uncensored=lasted_s[over], right=lasted_s[~over])).sf
        band = curve.confidence_interval(method="log-log") if over.any() else None
    x, p = np.asarray(curve.quantiles), np.asarray(curve.probabilities)
    low, high = (p, p) if band is None else (np.asarray(band.low.probabilities), np.asarray(band.high.probabilities))
    return pd.DataFrame(
        {"duration_s": np.r_[0, x], "survival": np.r_[1, p],
         "low": np.r_[1, np.where(np.isnan(low), p, low)], "high": np.r_[1, np.where(np.isnan(high), p, high)]}
    )  # fmt: skip


def median(curve: pd.DataFrame) -> float:
    """Duration that half of them outlast [s]; NaN where more than half were not seen to end."""
    below = curve.duration_s[curve.survival <= 0.5]
    return float(below.iloc[0]) if len(below) else float("nan")


def median_band(curve: pd.DataFrame) -> tuple[float, float]:
    """95 % interval of the median: durations at which the band of the curve falls to one half (Brookmeyer and Crowley
    1982) [s]; the upper end is infinite where the band stays above."""
    low, high = (curve.duration_s[curve[name] <= 0.5] for name in ("low", "high"))
    if not len(low):
        return float("nan"), float("nan")
    return float(low.iloc[0]), float(high.iloc[0]) if len(high) else float("inf")


def restricted_mean(curve: pd.DataFrame) -> float:
    """Mean duration up to the longest one seen: the area under the survival curve [s]."""
    return float((curve.survival.to_numpy()[:-1] * np.diff(curve.duration_s)).sum())
