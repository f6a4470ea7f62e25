"""How well a distribution agrees with durations that are censored and truncated."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray
from scipy import stats

from cosim.addons.durations.fit import Fit, fit
from cosim.addons.durations.samples import Durations
from results.metrics.intervals import LEVEL

FEWEST_AT_RISK = 20
"""A Kaplan-Meier curve is drawn and compared as long as so many are left."""
_SEEN = 1e-9
"""Seconds by which the edges of intervals may differ by rounding."""


def product_limit(sample: Durations) -> pd.DataFrame:
    """Share that lasts longer than a duration (Kaplan and Meier 1958), among those longer than the first entry.

    Parameters
    ----------
    sample
        Durations; what ends in an interval counts at its upper end.

    Returns
    -------
    duration_s, survival, low and high (of the 95 % band: Greenwood, log-log), n_at_risk, n_ended; the first row is the
    first entry.

    Notes
    -----
    A duration is at risk from its entry on, so those that enter later are not counted before (left truncation). One
    that is cut off after n steps is not at risk of ending after n steps, because the next step was not observed.
    """
    first = float(sample.entry_s.min()) if len(sample) else 0.0
    ended = sample.ended
    times, n_ended = np.unique(np.round(sample.high_s[ended], 9), return_counts=True)
    # At risk at the end of a step: entered before, and neither ended nor cut off in an earlier step.
    last = np.round(np.where(ended, sample.high_s, sample.low_s), 9)
    entered = np.searchsorted(np.sort(sample.entry_s), times - _SEEN)
    gone = np.searchsorted(np.sort(last), times - _SEEN)
    at_risk = entered - gone
    kept = at_risk > 0
    n_ended, at_risk, times = n_ended[kept], at_risk[kept], times[kept]
    survival = np.cumprod(1 - n_ended / at_risk)
    with np.errstate(divide="ignore", invalid="ignore"):
        greenwood = np.cumsum(n_ended / (at_risk * np.maximum(at_risk - n_ended, 0.0)))
        quantile = stats.norm.ppf((1 + LEVEL) / 2)
        wide = quantile * np.sqrt(greenwood) / np.log(survival)
        low = survival ** np.exp(-wide)
        high = survival ** np.exp(wide)
    is_known = np.isfinite(low) & np.isfinite(high)
    return pd.DataFrame(
        {
            "duration_s": np.r_[first, times],
            "survival": np.r_[1.0, survival],
            "low": np.r_[1.0, np.where(is_known, low, survival)],
            "high": np.r_[1.0, np.where(is_known, high, survival)],
            "n_at_risk": np.r_[len(sample), at_risk],
            "n_ended": np.r_[0, n_ended],
        }
    )


class FitDistance(NamedTuple):
    """Kolmogorov-Smirnov distance between a fitted distribution and the data."""

    value: float
    p_value: float
    """Share of samples of the fitted distribution that are as far from their own fit; NaN if none were drawn."""


def kolmogorov_smirnov(sample: Durations, found: Fit, n_draws: int) -> FitDistance:
    """Largest distance between the Kaplan-Meier curve and the fitted survival function.

    Parameters
    ----------
    sample
        The durations.
    found
        A fit to them.
    n_draws
        Samples that are drawn from the fit, cut into the same steps, censored like the data, and fitted again
        (parametric bootstrap). 0 draws none.

    Notes
    -----
    Both are conditional on being longer than the first entry. They are compared at the edges of the steps, where all
    that the data say is known, as long as `FEWEST_AT_RISK` are left: the last steps of a curve are noise. With
    censoring and fitted parameters the tables of the Kolmogorov-Smirnov test do not hold; the bootstrap repeats what
    was done. Draws are independent, so in a run, where encounters share vehicles, the p-value is too small.
    """
    value = _distance(sample, found)
    if not n_draws:
        return FitDistance(value, float("nan"))
    random = np.random.default_rng(0)
    beyond = 0
    for _ in range(n_draws):
        drawn = _like(sample, found, random)
        beyond += _distance(drawn, fit(drawn, found.name)) >= value
    return FitDistance(value, (beyond + 1) / (n_draws + 1))


def _distance(sample: Durations, found: Fit) -> float:
    curve = product_limit(sample)
    curve = curve[curve.n_at_risk >= min(FEWEST_AT_RISK, len(sample))]
    fitted = found.survival(curve.duration_s.to_numpy(), float(sample.entry_s.min()))
    return float(np.abs(curve.survival.to_numpy() - fitted).max())


def _like(sample: Durations, found: Fit, random: np.random.Generator) -> Durations:
    """A sample of the fitted distribution with the same entries, steps and censoring."""
    n = len(sample)
    ended = sample.ended
    step_s = float(np.median((sample.high_s - sample.low_s)[ended]))
    edge = np.full(n, -np.inf)
    while (early := edge < sample.entry_s - _SEEN).any():  # a step may begin too late to see a duration
        entry_s = sample.entry_s[early]
        begin_s = np.maximum(entry_s - sample.step_s / 2, 0.0)
        first = np.exp(found.family.log_sf(begin_s, found.free))
        counted_s = found.family.draw(found.free, first * random.uniform(size=len(entry_s)))
        counted_s = counted_s + sample.step_s * random.uniform(-0.5, 0.5, len(entry_s))
        edge[early] = entry_s + np.floor((counted_s - entry_s) / step_s) * step_s
    # When each would be cut off: where it was, or, if it ended before, by the curve of the times of cutting.
    cutting = Durations(
        low_s=sample.low_s,
        high_s=np.where(ended, np.inf, sample.low_s + step_s),
        entry_s=np.minimum(sample.entry_s, sample.low_s),
        a=sample.a,
        b=sample.b,
    )
    curve = product_limit(cutting)
    at = np.searchsorted(-curve.survival.to_numpy(), -random.uniform(size=n))
    times = np.r_[curve.duration_s.to_numpy() - step_s, np.inf]
    cut_s = np.maximum(times[at], sample.entry_s)
    is_cut = cut_s < edge + step_s / 2
    low = np.where(is_cut, cut_s, edge)
    return replace(sample, low_s=low, high_s=np.where(is_cut, np.inf, edge + step_s))


def tail_curve(
    sample: Durations,
    found: Fit,
) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """200 durations from the first entry to the last observed end, evenly spaced in the logarithm; fitted survival."""
    first = float(sample.entry_s.min())
    last = float(sample.high_s[sample.ended].max())
    x_s = np.geomspace(max(first, 1e-3), last, 200)
    return x_s, found.survival(x_s, first)
