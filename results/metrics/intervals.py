"""Intervals of ratios and means over units that are independent of each other: vehicles, not messages."""

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray
from scipy import stats

LEVEL = 0.95
FEW = 10
"""Fewer units than this are too few for a figure: a result then says so."""
_DRAWS = 1000
_FEWEST = 3
_AT_ONCE = 50
"""Draws that are multiplied at once: a divisor of all; of 5,000 units they fit into a cache."""
_FEW_AS_USED, _MOST_AS_USED = 200, 2000
"""Units up to which draws of many, and of a few, such numbers of units are kept as they are used."""


class Estimate(NamedTuple):
    """A share or mean with its interval."""

    value: float
    low: float
    """NaN, as `high`, where there are fewer than three units."""
    high: float
    n_units: int
    """Units with something to count."""


def without_interval(value: float) -> Estimate:
    """A value of which no more is known."""
    return Estimate(value, float("nan"), float("nan"), 0)


UNKNOWN = without_interval(float("nan"))


def ratio(top: Float[ndarray, "u"], bottom: Float[ndarray, "u"], level: float = LEVEL) -> Estimate:
    """Sum over sum, with a percentile interval of the cluster bootstrap [1]_: whole units are drawn again.

    Parameters
    ----------
    top, bottom
        Per unit; a unit whose bottom is 0 does not count. With bottom the number of values and top their sum, the
        ratio is the mean over all values, of units with many as of units with few.

    Notes
    -----
    1,000 draws of a fixed seed: the same table gives the same interval. Percentile intervals are too narrow for few
    units; below `FEW` the value is to be read as an example.

    References
    ----------
    .. [1] Field, Welsh, "Bootstrapping clustered data", J. R. Statist. Soc. B 69(3), 2007.
    """
    some = bottom > 0
    top, bottom = np.asarray(top, float)[some], np.asarray(bottom, float)[some]
    n = len(bottom)
    if not n:
        return UNKNOWN
    value = float(top.sum() / bottom.sum())
    if n < _FEWEST:
        return Estimate(value, float("nan"), float("nan"), n)
    tops, bottoms = (np.concatenate(sums) for sums in zip(*((d @ top, d @ bottom) for d in _drawn(n)), strict=True))
    low, high = _quantiles(tops / bottoms, ((1 - level) / 2, (1 + level) / 2))
    return Estimate(value, low, high, n)


def _quantiles(values: Float[ndarray, "n"], shares: tuple[float, float]) -> list[float]:
    """As `np.quantile`, to the bit, in a fifth of its time; NaN where there is one."""
    places = [share * (len(values) - 1) for share in shares]
    below = [int(place) for place in places]
    ordered = np.partition(values, [*below, *(k + 1 for k in below), len(values) - 1])
    if np.isnan(ordered[-1]):  # it stands last
        return [float("nan")] * len(places)
    found = []
    for k, place in zip(below, places, strict=True):
        low, high, t = float(ordered[k]), float(ordered[k + 1]), place - k
        found.append(high - (high - low) * (1 - t) if t >= 0.5 else low + (high - low) * t)
    return found


def _drawn(n: int) -> Iterator[Float[ndarray, "some n"]]:
    """How often each of `n` units is drawn, in every draw; some draws at a time where they are many numbers."""
    if n <= _MOST_AS_USED:
        yield _few(n) if n <= _FEW_AS_USED else _some(n)
        return
    counts = _counts(n)
    for first in range(0, _DRAWS, _AT_ONCE):
        yield counts[first : first + _AT_ONCE].astype(float)


@lru_cache(maxsize=64)
def _few(n: int) -> Float[ndarray, "draws n"]:
    return _counts(n).astype(float)


@lru_cache(maxsize=4)
def _some(n: int) -> Float[ndarray, "draws n"]:
    return _counts(n).astype(float)


@lru_cache(maxsize=16)
def _counts(n: int) -> UInt8[ndarray, "draws n"]:
    """Kept, because to draw takes longer than to use: metrics of a run ask again and again for the number of its
    vehicles. That a unit is drawn 256 times does not occur."""
    random, share = np.random.default_rng(0), np.full(n, 1 / n)
    blocks = range(0, _DRAWS, _AT_ONCE)
    return np.concatenate([random.multinomial(n, share, size=_AT_ONCE).astype(np.uint8) for _ in blocks])


def share(top: Float[ndarray, "u"], bottom: Float[ndarray, "u"], level: float = LEVEL) -> Estimate:
    """As `ratio`, of counts; where none or all of what was counted has the property, or every unit counted once and
    no more, after Wilson [1]_, with units as trials: a bootstrap of equal values has no width.

    References
    ----------
    .. [1] Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22(158), 1927.
    """
    top, bottom = np.asarray(top, float), np.asarray(bottom, float)
    some = bottom > 0
    n, value = int(some.sum()), float(top.sum() / bottom.sum()) if some.any() else float("nan")
    if n and (value in (0, 1) or (bottom[some] == 1).all()):
        return Estimate(value, *_wilson(round(value * n), n, level), n)
    return ratio(top, bottom, level)


@lru_cache(maxsize=1024)
def _wilson(k: int, n: int, level: float) -> tuple[float, float]:
    found = stats.binomtest(k, n).proportion_ci(level, method="wilson")
    return float(found.low), float(found.high)


def mean_of_pairs(
    values: Float[ndarray, "p"], a: Int[ndarray, "p"], b: Int[ndarray, "p"], level: float = LEVEL
) -> Estimate:
    """Mean over pairs of units, where pairs that share a unit are not independent [1]_.

    Parameters
    ----------
    a, b
        Numbers of the two units of each pair.

    Notes
    -----
    Variance of the mean: sum over pairs of pairs that share a unit of the product of their residuals, over n^2; with
    Student's t of as many degrees of freedom as there are units, less one.

    References
    ----------
    .. [1] Aronow, Samii, Assenova, "Cluster-robust variance estimation for dyadic data", Political Analysis 23, 2015.
    """
    units, at = np.unique(np.concatenate([a, b]), return_inverse=True)
    n, value = len(units), float(np.mean(values)) if len(values) else float("nan")
    if n < _FEWEST:
        return Estimate(value, float("nan"), float("nan"), n)
    residual = np.asarray(values, float) - value
    of_unit = np.bincount(at, np.tile(residual, 2))
    one, other = at[: len(a)], at[len(a) :]
    _, pair = np.unique(np.minimum(one, other) * n + np.maximum(one, other), return_inverse=True)
    of_pair = np.bincount(pair, residual)  # the same two may meet again; they share both units
    variance = max(0.0, float((of_unit**2).sum() - (of_pair**2).sum())) / len(values) ** 2
    half = float(stats.t.ppf((1 + level) / 2, n - 1)) * variance**0.5
    return Estimate(value, value - half, value + half, n)


def median(values: Float[ndarray, "u"], level: float = LEVEL) -> Estimate:
    """Median of independent values, with the interval between two of them that holds for any distribution [1]_.

    References
    ----------
    .. [1] Conover, "Practical Nonparametric Statistics", 3rd ed., 1999, section 3.2.
    """
    ordered = np.sort(values)
    n = len(ordered)
    if not n:
        return UNKNOWN
    below = _rank(n, level)
    if below < 0:
        return Estimate(float(np.median(ordered)), float("nan"), float("nan"), n)
    return Estimate(float(np.median(ordered)), float(ordered[below]), float(ordered[n - 1 - below]), n)


@lru_cache(maxsize=1024)
def _rank(n: int, level: float) -> int:
    """Of the lower end of the interval of a median: its tail is no larger than allowed; -1 where there is none."""
    rank = int(stats.binom.ppf((1 - level) / 2, n, 0.5))
    return rank - 1 if stats.binom.cdf(rank, n, 0.5) > (1 - level) / 2 else rank


def auc(
    high: Float[ndarray, "h"], high_unit: Int[ndarray, "h"], low: Float[ndarray, "l"], low_unit: Int[ndarray, "l"],
    level: float = LEVEL,
) -> Estimate:  # fmt: skip
    """Probability that a value of the first kind is above one of the second, ties counting half, both clustered by
    unit [1]_; n_units is the smaller number of units.

    Notes
    -----
    With V the placement of each value among all of the other kind, the variance is the sum over both kinds of
    I / (I - 1) * sum over its I units of (sum of V of the unit - m * AUC)^2 / N^2, where m values are in the unit and
    N of the kind. The interval is normal in the logit of the AUC.

    References
    ----------
    .. [1] Obuchowski, "Nonparametric analysis of clustered ROC curve data", Biometrics 53(2), 1997.
    """
    codes = [_codes(unit) for unit in (high_unit, low_unit)]
    n_units = min(n for _, n in codes)
    if not n_units:
        return UNKNOWN
    above = _placement(high, low)
    value = float(above.mean())
    if n_units < _FEWEST or value in (0, 1):
        return Estimate(value, float("nan"), float("nan"), n_units)
    variance = 0.0
    for placed, (at, _) in zip((above, 1 - _placement(low, high)), codes, strict=True):
        total = np.bincount(at, placed - value)
        variance += len(total) / (len(total) - 1) * float((total**2).sum()) / len(placed) ** 2
    half = float(stats.norm.ppf((1 + level) / 2)) * variance**0.5 / (value * (1 - value))
    centre = np.log(value / (1 - value))
    low_end, high_end = 1 / (1 + np.exp(-(centre + np.array([-half, half]))))
    return Estimate(value, float(low_end), float(high_end), n_units)


def _placement(values: Float[ndarray, "n"], others: Float[ndarray, "m"]) -> Float[ndarray, "n"]:
    """Share of the others that is below each value, ties counting half."""
    others = np.sort(others)
    return (np.searchsorted(others, values, "left") + np.searchsorted(others, values, "right")) / 2 / len(others)


def of_units(values: Float[ndarray, "n"] | Bool[ndarray, "n"], unit: Int[ndarray, "n"]) -> Estimate:
    """Mean of values that come from units: `ratio` of sums and counts by unit, or `share` where they are yes or no."""
    at, _ = _codes(unit)
    return (share if values.dtype == bool else ratio)(np.bincount(at, values), np.bincount(at))


def _codes(unit: Int[ndarray, "n"]) -> tuple[Int[ndarray, "n"], int]:
    """Numbers from 0 on of the units, in their order, and how many there are."""
    if len(unit) and 0 <= int(unit.min()) and int(unit.max()) < 4 * len(unit):  # no need to sort
        there = np.bincount(unit) > 0
        code = np.cumsum(there) - 1
        return code[unit], int(code[-1]) + 1
    units, at = np.unique(unit, return_inverse=True)
    return at, len(units)


def columns(estimate: Estimate, name: str) -> dict[str, float]:
    """An estimate as columns of a row: `name`, `name_low`, `name_high` and `name_units`."""
    return {
        name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high,
        f"{name}_units": estimate.n_units,
    }  # fmt: skip
