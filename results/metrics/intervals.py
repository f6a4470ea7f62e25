"""Intervals of ratios and means over units that are independent of each other: vehicles, not messages."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy import special, stats

LEVEL = 0.95
FEW = 10
"""Fewer units than this are too few for a figure: a result then says so."""
_DRAWS = 1000
_FEWEST = 3
FEWEST_DRAWN = 5
"""No sum of drawn units is beyond that of the smallest, or of the largest, alone. Both lie on one side of the truth for
25 % of samples of three units, 13 % of four, and 6 % of five."""

Bounds = tuple[float, float]
"""Smallest and largest value that a quantity can have."""
FREE: Bounds = (-math.inf, math.inf)


class ClusteredEstimate(NamedTuple):
    """A share or mean with its interval."""

    value: float
    low: float
    """NaN, as `high`, where there are too few units, or no spread to judge by."""
    high: float
    n_units: int
    """Units with something to count."""


def without_interval(value: float, n_units: int = 0) -> ClusteredEstimate:
    """A value of which no more is known."""
    return ClusteredEstimate(value, float("nan"), float("nan"), n_units)


UNKNOWN = without_interval(float("nan"))


def ratio(top: Float[ndarray, "u"], bottom: Float[ndarray, "u"], level: float = LEVEL) -> ClusteredEstimate:
    """Sum over sum, with a percentile interval of the cluster bootstrap [1]_ [2]_: whole units are drawn again.

    Parameters
    ----------
    top, bottom
        Per unit. A unit whose bottom is 0 does not count. If bottom is a unit's number of values and top their sum, the
        ratio is the mean of all values: a unit with many values weighs more than a unit with few.
    level
        Probability of the interval.

    Returns
    -------
    The ratio, NaN if no unit counts. The interval is NaN if fewer than five units count, or if their ratios are all the
    same, as those of events that never occurred.

    Notes
    -----
    1,000 draws of a fixed seed: the same table gives the same interval. Plain percentiles are too narrow for few units,
    so theirs are those of the normal distribution at sqrt(n / (n - 1)) t, for n units and Student's t [2]_. Below `FEW`
    the value is to be read as an example nevertheless.

    References
    ----------
    .. [1] Field, Welsh, "Bootstrapping clustered data", J. R. Statist. Soc. B 69(3), 2007.
    .. [2] Hesterberg, "What teachers should know about the bootstrap", The American Statistician 69(4), 2015: the
       expanded percentile interval.
    """
    some = bottom > 0
    top = np.asarray(top, float)[some]
    bottom = np.asarray(bottom, float)[some]
    n = len(bottom)
    if not n:
        return UNKNOWN
    value = float(top.sum() / bottom.sum())
    if n < FEWEST_DRAWN or np.ptp(top / bottom) == 0:
        return without_interval(value, n)
    drawn = _draws(n)
    ratios = (drawn @ top) / (drawn @ bottom)
    quantile = special.stdtrit(n - 1, (1 + level) / 2)
    above = float(special.ndtr(math.sqrt(n / (n - 1)) * quantile))
    low, high = np.quantile(ratios, [1 - above, above])
    return ClusteredEstimate(value, float(low), float(high), n)


@lru_cache(maxsize=32)
def _draws(n: int) -> UInt8[ndarray, "draws n"]:
    """How often each of `n` units is drawn, in every draw; that one is drawn 256 times does not occur.

    Kept, because metrics of a run ask again and again for the number of its vehicles, and `scipy.stats.bootstrap`,
    which draws anew each time, takes twenty times as long. Counting drawn units takes a quarter of the time of
    `Generator.multinomial`, which has the same distribution.
    """
    random = np.random.default_rng(0)
    counts = (np.bincount(random.integers(n, size=n), minlength=n) for _ in range(_DRAWS))
    return np.stack([count.astype(np.uint8) for count in counts])


def around(
    value: float, error: float, degrees: float, bounds: Bounds = FREE, level: float = LEVEL
) -> ClusteredEstimate:
    """Interval of a mean with a standard error that respects the bounds of the quantity.

    Parameters
    ----------
    value, error
        The mean and its standard error.
    degrees
        Degrees of freedom of Student's t; infinite for the normal distribution.
    bounds
        Bounds of the quantity. With two finite bounds, the interval is Student's in the logit of the value's place
        between them. With a lower bound alone, it is Student's in the logarithm of the distance from it. In both cases
        the error is converted by the delta method [1]_ [2]_. Without bounds, the interval is Student's in the value
        itself.
    level
        Probability of the interval.

    Returns
    -------
    An estimate without a number of units. It has no interval if the value is at a bound, where the logit is infinite.

    References
    ----------
    .. [1] Korn, Graubard, "Confidence intervals for proportions with small expected number of positive counts",
       Survey Methodology 24(2), 1998: the logit interval with Student's t.
    .. [2] Agresti, "Categorical Data Analysis", 3rd ed., 2013, section 16.1 (delta method).
    """
    low, high = bounds
    half = float(stats.t.ppf((1 + level) / 2, degrees)) * error
    if value != value or half != half or not low < value < high:
        return without_interval(value)
    if math.isinf(low) and math.isinf(high):
        return ClusteredEstimate(value, value - half, value + half, 0)
    if math.isinf(high):
        above = value - low
        factor = math.exp(half / above)
        return ClusteredEstimate(value, low + above / factor, low + above * factor, 0)
    width = high - low
    place = (value - low) / width
    wide = half / width / (place * (1 - place))
    logits = special.logit(place) + np.array([-wide, wide])
    lower, upper = special.expit(logits).tolist()
    return ClusteredEstimate(value, low + width * lower, low + width * upper, 0)


def share(top: Float[ndarray, "u"], bottom: Float[ndarray, "u"], level: float = LEVEL) -> ClusteredEstimate:
    """Share of what was counted that has a property, with an interval.

    Parameters
    ----------
    top, bottom
        Per unit: how many have the property, and how many were counted.
    level
        Probability of the interval.

    Returns
    -------
    The share, NaN if nothing was counted.

    Notes
    -----
    The interval is that of `ratio`, except in two cases: if all or none have the property (a bootstrap of equal values
    has no width), or if every unit counted exactly once. Then it is Wilson's [1]_, with units as trials.

    References
    ----------
    .. [1] Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22(158), 1927.
    """
    top, bottom = np.asarray(top, float), np.asarray(bottom, float)
    some = bottom > 0
    n = int(some.sum())
    if not n:
        return UNKNOWN
    value = float(top.sum() / bottom.sum())
    if value in (0, 1) or (bottom[some] == 1).all():
        return ClusteredEstimate(value, *_wilson(round(value * n), n, level), n)
    return ratio(top, bottom, level)


@lru_cache(maxsize=1024)
def _wilson(k: int, n: int, level: float) -> tuple[float, float]:
    found = stats.binomtest(k, n).proportion_ci(level, method="wilson")
    return float(found.low), float(found.high)


def mean_of_pairs(
    values: Float[ndarray, "p"],
    a: Int[ndarray, "p"],
    b: Int[ndarray, "p"],
    bounds: Bounds = FREE,
) -> ClusteredEstimate:
    """Mean over pairs of units, where pairs that share a unit are not independent [1]_.

    Parameters
    ----------
    values
        Value of each pair. The same pair may occur several times.
    a, b
        Numbers of the two units of each pair.
    bounds
        As for `around`.

    Returns
    -------
    The mean, NaN without pairs. The interval is NaN if there are fewer than three units, or if all values are the same.

    Notes
    -----
    The variance of the mean is the sum of the products of the residuals of any two pairs that share a unit, over n^2.
    With few units, this can be next to nothing or even negative: it is at least that of independent pairs. The
    interval is that of `around`, with one degree of freedom less than there are units.

    References
    ----------
    .. [1] Aronow, Samii, Assenova, "Cluster-robust variance estimation for dyadic data", Political Analysis 23, 2015.
    """
    units, at = np.unique(np.concatenate([a, b]), return_inverse=True)
    n = len(units)
    value = float(np.mean(values)) if len(values) else float("nan")
    if n < _FEWEST or np.ptp(values) == 0:
        return without_interval(value, n)
    residual = np.asarray(values, float) - value
    of_unit = np.bincount(at, np.tile(residual, 2))
    one, other = at[: len(a)], at[len(a) :]
    same_two = np.minimum(one, other) * n + np.maximum(one, other)
    _, pair = np.unique(same_two, return_inverse=True)
    of_pair = np.bincount(pair, residual)  # the same two may meet again; they share both units
    dyadic = float((of_unit**2).sum() - (of_pair**2).sum())
    variance = max(dyadic, float((residual**2).sum())) / len(values) ** 2
    return around(value, variance**0.5, n - 1, bounds)._replace(n_units=n)


def median(values: Float[ndarray, "n"], unit: Int[ndarray, "n"], level: float = LEVEL) -> ClusteredEstimate:
    """Median, with an interval between two of the values that holds for any distribution.

    Parameters
    ----------
    values
        One or more values of each unit.
    unit
        Number of the unit of each value.
    level
        Probability of the interval.

    Returns
    -------
    The median, NaN without values. The interval is NaN if there are too few units for it.

    Notes
    -----
    If every unit has one value, ranks are binomial [1]_. If not, the interval holds each value x for which one half is
    in the interval (`share`) of the share of values up to x, which is taken to be as wide as it is at the median [2]_.
    Many values may equal the median. So the lower end follows from the share below it, the upper from that up to it.

    References
    ----------
    .. [1] Conover, "Practical Nonparametric Statistics", 3rd ed., 1999, section 3.2.
    .. [2] Woodruff, "Confidence intervals for medians and other position measures", JASA 47(260), 1952.
    """
    at, n = _codes(unit)
    if not n:
        return UNKNOWN
    value = float(np.median(values))
    if n == len(values):
        found = stats.quantile_test(values, p=0.5).confidence_interval(level)
        return ClusteredEstimate(value, float(found.low), float(found.high), n)
    n_of_unit = np.bincount(at)
    below = share(np.bincount(at, values < value), n_of_unit, level)
    up_to = share(np.bincount(at, values <= value), n_of_unit, level)
    lower = 0.5 + below.value - below.high
    upper = 0.5 + up_to.value - up_to.low
    if n < FEWEST_DRAWN or np.isnan(lower + upper):
        return without_interval(value, n)
    low, high = np.quantile(values, np.clip([lower, upper], 0.0, 1.0))
    return ClusteredEstimate(value, float(low), float(high), n)


def auc(
    high: Float[ndarray, "h"],
    high_unit: Int[ndarray, "h"],
    low: Float[ndarray, "l"],
    low_unit: Int[ndarray, "l"],
    times: tuple[ndarray, ndarray] | None = None,
    level: float = LEVEL,
) -> ClusteredEstimate:
    """Probability that a value of the first kind is above one of the second, clustered by unit [1]_; ties count half.

    Parameters
    ----------
    high, low
        Values of the first and of the second kind.
    high_unit, low_unit
        Number of the unit of each value.
    times
        How often each value of either kind occurs; by default once.
    level
        Probability of the interval.

    Returns
    -------
    The probability, NaN if a kind has no values; n_units is the smaller of the two numbers of units. The interval is
    NaN if this is below three, or if all values are the same.

    Notes
    -----
    The placement V of a value is the share of values of the other kind that are below it (first kind) or above it
    (second kind), ties counting half. A unit with m values has the residual (sum of its V) - m * AUC. The variance is
    the sum over both kinds of I / (I - 1) * (sum of the squared residuals of its I units) / N^2, where N is the number
    of values of the kind. The interval is that of `around`, in the logit, with one degree of freedom less than the
    smaller number of units. A normal one of five attackers would contain the truth in 84 to 89 %.

    References
    ----------
    .. [1] Obuchowski, "Nonparametric analysis of clustered ROC curve data", Biometrics 53(2), 1997.
    """
    high_unit, n_high_units = _codes(high_unit)
    low_unit, n_low_units = _codes(low_unit)
    n_units = min(n_high_units, n_low_units)
    if not n_units:
        return UNKNOWN
    once = np.ones(len(high)), np.ones(len(low))
    n_high, n_low = times or once
    above = _placement(high, low, n_low)
    below = 1 - _placement(low, high, n_high)
    value = float(np.average(above, weights=n_high))
    if n_units < _FEWEST or np.ptp(np.append(high, low)) == 0:
        return without_interval(value, n_units)
    of_values = variance(above - value, high_unit, n_high)
    of_values += variance(below - value, low_unit, n_low)
    return around(value, of_values**0.5, n_units - 1, (0.0, 1.0), level)._replace(n_units=n_units)


def variance(
    residual: Float[ndarray, "n"],
    unit: Int[ndarray, "n"],
    n: ndarray | None = None,
) -> float:
    """Variance of the mean of values that come from two units or more: what one kind of them adds to that of `auc`.

    Parameters
    ----------
    residual
        Value less the mean.
    unit
        Number of the unit of each value.
    n
        How often each value occurs; by default once.
    """
    at, n_units = _codes(unit)
    n = np.ones(len(residual)) if n is None else n
    total = np.bincount(at, n * residual)
    correction = n_units / (n_units - 1)
    return correction * float((total**2).sum()) / float(n.sum()) ** 2


def _placement(
    values: Float[ndarray, "n"],
    others: Float[ndarray, "m"],
    n: ndarray,
) -> Float[ndarray, "n"]:
    """Share of the others, each of which occurs so often, that is below each value, ties counting half."""
    order = np.argsort(others)
    others = others[order]
    up_to = np.r_[0, np.cumsum(n[order])]
    below = up_to[np.searchsorted(others, values, "left")]
    at_most = up_to[np.searchsorted(others, values, "right")]
    return (below + at_most) / (2 * up_to[-1])


def of_units(
    values: Float[ndarray, "n"] | Bool[ndarray, "n"],
    unit: Int[ndarray, "n"],
) -> ClusteredEstimate:
    """Mean of values that come from units, as `ratio`; if the values are true or false, as `share`.

    Parameters
    ----------
    values
        One or more values of each unit.
    unit
        Number of the unit of each value.
    """
    at, _ = _codes(unit)
    estimate = share if values.dtype == bool else ratio
    return estimate(np.bincount(at, values), np.bincount(at))


def _codes(unit: Int[ndarray, "n"]) -> tuple[Int[ndarray, "n"], int]:
    """Numbers from 0 on of the units, in their order, and how many there are."""
    low, high = unit.min(initial=0), unit.max(initial=0)
    if low >= 0 and high < 4 * len(unit):  # no need to sort
        there = np.bincount(unit) > 0
        code = np.cumsum(there) - 1
        return code[unit], int(code[-1]) + 1
    units, at = np.unique(unit, return_inverse=True)
    return at, len(units)


def plain_columns(estimate: ClusteredEstimate, name: str) -> dict[str, float]:
    """An estimate as columns of a row that has only one: `name`, `low`, `high` and `n_units`."""
    return {name: estimate.value, "low": estimate.low, "high": estimate.high, "n_units": estimate.n_units}


def columns(estimate: ClusteredEstimate, name: str) -> dict[str, float]:
    """An estimate as columns of a row: `name`, `name_low`, `name_high` and `name_units`."""
    return {
        name: estimate.value,
        f"{name}_low": estimate.low,
        f"{name}_high": estimate.high,
        f"{name}_units": estimate.n_units,
    }


def by_group(
    frame: pd.DataFrame,
    by: Sequence[str],
    estimate: Callable[[ndarray, ndarray], ClusteredEstimate] = share,
    name: str = "share",
) -> pd.DataFrame:
    """An estimate for each group of units: the columns `by`, n (sum of bottom), and those of `plain_columns`.

    Parameters
    ----------
    frame
        A row per unit: the columns `by`, and what the estimate sums up, top and bottom.
    """
    rows = []
    for key, one in frame.groupby(list(by), sort=False):
        found = estimate(one.top.to_numpy(float), one.bottom.to_numpy(float))
        row = dict(zip(by, key, strict=True)) | {"n": int(one.bottom.sum())}
        rows.append(row | plain_columns(found, name))
    return pd.DataFrame(rows, columns=[*by, "n", name, "low", "high", "n_units"])
