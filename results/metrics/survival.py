"""How long something lasts that was not always seen to end (Kaplan and Meier 1958)."""

import warnings

import numpy as np
import pandas as pd
from numpy import ndarray
from scipy.stats import CensoredData, ecdf, norm

from results.metrics.intervals import FEWEST_DRAWN, LEVEL, ClusteredEstimate, without_interval


def kaplan_meier(lasted_s: ndarray, over: ndarray, unit: ndarray | None = None) -> pd.DataFrame:
    """Share that lasts longer than a duration.

    Parameters
    ----------
    lasted_s
        Duration of each, as far as it was seen [n].
    over
        Whether it was seen to end [n].
    unit
        Number of the unit of each [n]: those of one unit depend on each other. Left out, all are independent.

    Returns
    -------
    duration_s, survival, and low, high: its 95 % confidence band (Greenwood, log-log); first row 0 s.

    Notes
    -----
    With units, the variance of the logarithm of the survival is the sum over units of the squared sum of what each of
    them adds to it, linearized [1]_. If each unit has one, that is Greenwood's.

    References
    ----------
    .. [1] Williams, "Product-limit survival functions with correlated survival times", Lifetime Data Analysis 1(2),
       1995.
    """
    if not len(lasted_s):
        return pd.DataFrame({"duration_s": [0.0], "survival": [1.0], "low": [1.0], "high": [1.0]})
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the band is undefined where all or none are left
        curve = ecdf(CensoredData(uncensored=lasted_s[over], right=lasted_s[~over])).sf
        p = np.asarray(curve.probabilities)
        low = high = p
        if over.any() and unit is not None:
            error = _error_of_log(lasted_s, over, unit, curve.quantiles)
            wide = norm.ppf((1 + LEVEL) / 2) * error / np.log(p)
            low = p ** np.exp(-wide)
            high = p ** np.exp(wide)
        elif over.any():
            band = curve.confidence_interval(method="log-log")
            low = np.asarray(band.low.probabilities)
            high = np.asarray(band.high.probabilities)
    return pd.DataFrame(
        {
            "duration_s": np.r_[0, np.asarray(curve.quantiles)],
            "survival": np.r_[1, p],
            "low": np.r_[1, np.where(np.isnan(low), p, low)],
            "high": np.r_[1, np.where(np.isnan(high), p, high)],
        }
    )


def _error_of_log(lasted_s: ndarray, over: ndarray, unit: ndarray, times_s: ndarray) -> ndarray:
    """Standard error of the logarithm of the survival at each of the different durations [t]."""
    last = np.searchsorted(times_s, lasted_s)
    n_ended = np.bincount(last[over], minlength=len(times_s))
    at_risk = np.cumsum(np.bincount(last)[::-1])[::-1]
    left = at_risk - n_ended
    expected = np.cumsum(n_ended / (at_risk * left))
    _, row = np.unique(unit, return_inverse=True)
    of_unit = np.zeros((row.max() + 1, len(times_s)))
    for one, ended, k in zip(row, over, last, strict=True):
        share = ended / left[k]
        of_unit[one, :k] -= expected[:k]
        of_unit[one, k:] += share - expected[k]
    return np.sqrt((of_unit**2).sum(axis=0))


def median(curve: pd.DataFrame) -> float:
    """Median duration [s]: the first at which the curve is at one half or below. NaN if it stays above one half."""
    return _falls_to_half(curve, "survival", float("nan"))


def median_band(curve: pd.DataFrame) -> tuple[float, float]:
    """95 % interval of the median [s], by Brookmeyer and Crowley (1982).

    Returns
    -------
    First durations at which the lower and the upper end of the band are at one half or below. Both are NaN if the lower
    end stays above one half; the upper is infinite if only the upper end does. Where nothing is left, the band has no
    width, because nothing is known of it, and does not count.
    """
    curve = curve[curve.survival > 0]
    low = _falls_to_half(curve, "low", float("nan"))
    return low, float("nan") if np.isnan(low) else _falls_to_half(curve, "high", float("inf"))


def median_estimate(curve: pd.DataFrame, n_units: int) -> ClusteredEstimate:
    """Median duration with its interval, which fewer than five units do not have: the shortest of n durations is longer
    than the median with probability 2^-n, and the longest is shorter as often."""
    value = median(curve)
    if n_units < FEWEST_DRAWN:
        return without_interval(value, n_units)
    return ClusteredEstimate(value, *median_band(curve), n_units)


def _falls_to_half(curve: pd.DataFrame, column: str, never: float) -> float:
    """First duration at which a column is one half or less [s]; `never` where it stays above."""
    half = 0.5 + 1e-12  # a product of ratios that is one half but for rounding
    at = np.flatnonzero(curve[column].to_numpy() <= half)
    return float(curve.duration_s.to_numpy()[at[0]]) if len(at) else never


def restricted_mean(curve: pd.DataFrame) -> float:
    """Mean duration up to the longest one seen: the area under the survival curve [s]."""
    survival = curve.survival.to_numpy()[:-1]
    return float((survival * np.diff(curve.duration_s)).sum())
