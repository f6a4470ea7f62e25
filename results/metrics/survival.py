"""How long something lasts that was not always seen to end (Kaplan and Meier 1958)."""

import numpy as np
import pandas as pd
from numpy import ndarray
from scipy.special import ndtri

_Z = float(ndtri(0.975))


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
    x, at, size = np.unique(lasted_s, return_inverse=True, return_counts=True)
    n, ended = len(lasted_s) - (np.cumsum(size) - size), np.bincount(at[over], minlength=len(x))
    p = 1 - np.cumsum(size) / len(lasted_s) if over.all() else np.cumprod((n - ended) / n)
    with np.errstate(divide="ignore", invalid="ignore"):  # the band is undefined where all or none are left
        error = np.sqrt(np.cumsum(ended / (n * (n - ended)))) / -np.log(p)
        low, high = (p ** np.exp(side * error) for side in (_Z, -_Z))
    return pd.DataFrame(
        {"duration_s": np.r_[0, x], "survival": np.r_[1, p],
         "low": np.r_[1, np.where(np.isnan(low), p, low)], "high": np.r_[1, np.where(np.isnan(high), p, high)]}
    )  # fmt: skip


def median(curve: pd.DataFrame) -> float:
    """Duration that half of them outlast [s]; NaN where more than half were not seen to end."""
    return _falls_to_half(curve, "survival", float("nan"))


def median_band(curve: pd.DataFrame) -> tuple[float, float]:
    """95 % interval of the median: durations at which the band of the curve falls to one half (Brookmeyer and Crowley
    1982) [s]; the upper end is infinite where the band stays above."""
    low = _falls_to_half(curve, "low", float("nan"))
    return low, float("nan") if np.isnan(low) else _falls_to_half(curve, "high", float("inf"))


def _falls_to_half(curve: pd.DataFrame, column: str, never: float) -> float:
    """First duration at which a column is one half or less [s]; `never` where it stays above."""
    at = np.flatnonzero(curve[column].to_numpy() <= 0.5)
    return float(curve.duration_s.to_numpy()[at[0]]) if len(at) else never


def restricted_mean(curve: pd.DataFrame) -> float:
    """Mean duration up to the longest one seen: the area under the survival curve [s]."""
    return float((curve.survival.to_numpy()[:-1] * np.diff(curve.duration_s)).sum())
