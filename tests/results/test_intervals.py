"""Intervals: by hand, against literal formulas, and how often they cover what is true."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from results.metrics import intervals
from results.metrics.survival import kaplan_meier, median_band, median_estimate


def test_share_of_all_units_is_not_certain():
    """7 of 7: Wilson's lower end is n / (n + z^2) = 7 / (7 + 3.8415) = 0.6457; 0 of 7 mirrors it."""
    every = intervals.share(np.full(7, 12.0), np.full(7, 12.0))
    assert every.value == 1 and every.low == pytest.approx(0.6457, abs=1e-4) and every.high == 1
    none = intervals.share(np.zeros(7), np.full(7, 12.0))
    assert (none.low, none.high) == pytest.approx((0, 1 - 0.6457), abs=1e-4)


def test_share_of_units_that_count_once_is_wilsons():
    found = intervals.share(np.r_[np.ones(3), np.zeros(17)], np.ones(20))
    wilson = stats.binomtest(3, 20).proportion_ci(method="wilson")
    assert found == (0.15, wilson.low, wilson.high, 20)


def test_units_without_a_count_and_too_few():
    assert intervals.ratio(np.array([1.0, 5.0]), np.array([2.0, 0.0]))[::3] == (0.5, 1)
    few = np.array([0.5, 0.6, 0.8, 0.9])  # all four lie on one side of the truth for one sample of eight
    assert np.isnan(intervals.ratio(few, np.ones(4)).low) and intervals.ratio(np.append(few, 0.7), np.ones(5)).low > 0
    never = intervals.ratio(np.zeros(9), np.arange(1.0, 10.0))  # that nothing occurred is no proof that nothing can
    assert never.value == 0 and np.isnan(never.high) and never.n_units == 9
    unit, same = np.arange(9), np.full(9, 0.5)  # nobody is known: 0.5 was said to be between 0.5 and 0.5
    for found in (intervals.auc(same, unit, same, unit), intervals.mean_of_pairs(same, unit, unit + 9)):
        assert found.value == 0.5 and np.isnan(found.low) and found.n_units >= 9
    assert np.isnan(intervals.ratio(np.zeros(0), np.zeros(0)).value)


def test_median_by_hand():
    """Of ten values, P(at most 1 below the median) = 11 / 1024 = 1.1 %, at most 2: 5.5 %: ranks 2 and 9."""
    found = intervals.median(np.arange(10.0, 110.0, 10.0), np.arange(10))
    assert found == (55.0, 20.0, 90.0, 10)
    assert np.isnan(intervals.median(np.arange(5.0), np.arange(5)).low)  # P(none below) = 3 %: no interval has 95 %


def test_mean_of_pairs_that_share_nothing_is_the_usual_one():
    values = np.random.default_rng(1).normal(5, 2, 200)
    found = intervals.mean_of_pairs(values, np.arange(0, 400, 2), np.arange(1, 400, 2))
    half = values.std() / len(values) ** 0.5
    assert found.value == values.mean()
    assert found.high - found.value == pytest.approx(stats.t.ppf(0.975, 399) * half)


def test_mean_of_few_pairs_is_not_exact():
    """With twelve units, the sum over pairs that share a unit is often below 0. The interval still covers."""
    rng, covered = np.random.default_rng(7), 0
    one, other = np.triu_indices(12, 1)
    for _ in range(200):
        kept = rng.random(len(one)) < 0.4
        found = intervals.mean_of_pairs(rng.exponential(5.0, kept.sum()), one[kept], other[kept], (0.0, np.inf))
        assert found.high - found.low > 0.5
        covered += found.low <= 5.0 <= found.high
    assert 0.9 <= covered / 200 <= 1.0


def test_mean_of_pairs_against_a_double_loop():
    rng = np.random.default_rng(2)
    a, b = rng.integers(0, 12, 60), rng.integers(12, 20, 60)
    a[:5], b[:5] = b[:5].copy(), a[:5].copy()
    values = rng.normal(0, 1, 60) + 0.7 * a + 0.3 * b
    residual = values - values.mean()
    sum_ = sum(residual[i] * residual[j] for i in range(60) for j in range(60) if {a[i], b[i]} & {a[j], b[j]})
    found = intervals.mean_of_pairs(values, a, b)
    half = stats.t.ppf(0.975, len(np.unique(np.r_[a, b])) - 1) * sum_**0.5 / 60
    assert (found.low, found.high) == pytest.approx((values.mean() - half, values.mean() + half))


def test_auc_of_single_values_has_delongs_variance():
    """DeLong, DeLong, Clarke-Pearson 1988: variances of the placements over their numbers. t(0.975, 24) = 2.064."""
    rng = np.random.default_rng(3)
    high, low = rng.normal(1, 1, 40), rng.normal(0, 1, 25)
    wins = (high[:, None] > low).astype(float)
    variance = wins.mean(1).var(ddof=1) / 40 + wins.mean(0).var(ddof=1) / 25
    found = intervals.auc(high, np.arange(40), low, np.arange(25))
    logit = np.log(found.value / (1 - found.value))
    half = 2.063899 * variance**0.5 / (found.value * (1 - found.value))
    assert found.value == wins.mean()
    assert np.log(found.high / (1 - found.high)) == pytest.approx(logit + half)
    assert found.n_units == 25


def test_median_of_units_with_several_values_covers():
    """Values of a unit are alike (correlation 0.8): of 200 samples, 95 % of the intervals contain the median, 0.

    Those of independent values contain it in 66 %.
    """
    random, hits, hits_of_independent = np.random.default_rng(1), 0, 0
    unit = np.repeat(np.arange(40), 5)
    for _ in range(200):
        values = random.normal(size=40)[unit] + 0.5 * random.normal(size=200)
        found = intervals.median(values, unit)
        hits += found.low <= 0 <= found.high
        alone = intervals.median(values, np.arange(200))
        hits_of_independent += alone.low <= 0 <= alone.high
    assert found.n_units == 40 and 0.92 <= hits / 200 <= 0.98 and hits_of_independent / 200 < 0.75
    few = intervals.median(np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]))
    assert few.value == 2 and np.isnan(few.low) and few.n_units == 2


def test_median_of_units_with_values_that_are_often_the_same_covers():
    """45 % of the units have the largest value, 0.5; the others are uniform from 0.1 to 0.4: half are below 0.373.

    The share of values up to a median of 0.5 is always 1, which gave intervals without width: 76 % held the truth.
    """
    random, hits, unit = np.random.default_rng(1), 0, np.repeat(np.arange(40), 2)
    for _ in range(200):
        values = np.where(random.random(40) < 0.45, 0.5, random.uniform(0.1, 0.4, 40))[unit]
        found = intervals.median(values, unit)
        hits += found.low <= 0.1 + 0.3 * 0.5 / 0.55 <= found.high
    assert 0.92 <= hits / 200 <= 0.98


def test_median_of_durations_has_the_band_of_the_curve():
    lasted_s, over = np.array([3.0, 5, 8, 13, 21, 34, 55, 89]), np.array([1, 1, 1, 0, 1, 1, 0, 1], bool)
    curve = kaplan_meier(lasted_s, over)
    low, high = median_band(curve)
    assert (curve.low[curve.duration_s < low] > 0.5).all() and (curve.high[curve.survival > 0] > 0.5).all()
    assert low in lasted_s and low < 21 and np.isinf(high)
    empty = pd.DataFrame({"duration_s": [0.0], "survival": [1.0], "low": [1.0], "high": [1.0]})
    assert np.isnan(median_band(empty)[0])


def test_median_of_few_durations_is_covered_or_has_no_interval():
    """Of one to six exponential durations, all seen to end, the interval reached to the longest: it held the truth in
    0, 51, 73, 87, 93 and 97 %."""
    random, hits = np.random.default_rng(2), dict.fromkeys((5, 6), 0)
    for n in (1, 2, 3, 4, *hits):
        for _ in range(200):
            found = median_estimate(kaplan_meier(random.exponential(size=n), np.ones(n, bool)), n)
            assert np.isnan(found.low) == np.isnan(found.high) == (n < 5)
            hits[n] = hits.get(n, 0) + (found.low <= np.log(2) <= found.high)
    assert hits[5] > 0.94 * 200 and hits[6] > 0.95 * 200


def test_durations_that_repeat_each_other_narrow_no_band():
    """Three pseudonyms of each vehicle with the same times say as much as one. That of single ones is Greenwood's."""
    random = np.random.default_rng(5)
    lasted_s, over = random.integers(1, 30, 40).astype(float), random.random(40) < 0.7
    one, unit = kaplan_meier(lasted_s, over), np.arange(40)
    pd.testing.assert_frame_equal(kaplan_meier(lasted_s, over, unit), one)
    pd.testing.assert_frame_equal(kaplan_meier(np.tile(lasted_s, 3), np.tile(over, 3), np.tile(unit, 3)), one)


@pytest.mark.parametrize(("statistic", "n"), [("mean", 10), ("auc", 5)])
def test_coverage_of_few_units(statistic, n):
    """Of 600 worlds of ten units, or five attackers, 95 % intervals contain the truth in 92 % or more.

    Those of plain percentiles do so in 89 %, and those of the normal distribution in 88 %.
    """
    rng, covered = np.random.default_rng(6), 0
    unit, many = np.repeat(np.arange(n), 8), np.repeat(np.arange(40), 8)
    for _ in range(600):
        values = rng.normal(0, 1, n)[unit] + rng.normal(0, 0.5, 8 * n)
        if statistic == "mean":
            truth, found = 0.0, intervals.of_units(values, unit)
        else:
            honest = 1.5 + rng.normal(0, 1, 40)[many] + rng.normal(0, 0.5, 320)
            truth, found = stats.norm.cdf(1.5 / np.sqrt(2 * 1.25)), intervals.auc(honest, many, values, unit)
        covered += found.low <= truth <= found.high
    assert 0.92 <= covered / 600 <= 0.98


@pytest.mark.parametrize("statistic", ["mean", "auc", "pairs"])
def test_coverage_with_values_that_repeat_each_other(statistic):
    """400 worlds of 30 units whose ten values are nearly the same: 95 % intervals cover in 90 to 99 of 100 worlds.

    Taken as independent, intervals of the mean would be a third as wide and cover in about half of them.
    """
    rng, covered = np.random.default_rng(4), 0
    for _ in range(400):
        unit = np.repeat(np.arange(30), 10)
        level = rng.normal(0, 1, 30)
        values = level[unit] + rng.normal(0, 0.3, 300)
        if statistic == "mean":
            truth, found = 0.0, intervals.of_units(values, unit)
        elif statistic == "auc":
            other = rng.normal(0, 1, 30)[unit] + rng.normal(0, 0.3, 300)
            truth = stats.norm.cdf(1 / np.sqrt(2 * 1.09))
            found = intervals.auc(values + 1, unit, other, unit)
        else:
            a, b = rng.integers(0, 30, 150), rng.integers(0, 30, 150)
            keep = a != b
            truth, found = 0.0, intervals.mean_of_pairs((level[a] + level[b])[keep], a[keep], b[keep])
        covered += found.low <= truth <= found.high
    assert 0.90 <= covered / 400 <= 0.99


def test_intervals_respect_bounds():
    """Four shares of mean 0.85 and a standard error of 0.1: Student's t would give [0.53, 1.17].

    By hand in the logit: 0.1 x 3.182 / (0.85 x 0.15) = 2.496; logit(0.85) = 1.735; expit(-0.761) = 0.318.
    A time of mean 7.3 s and half-width 7.6 s: 7.3 e^(+-7.6 / 7.3) s = 2.58 to 20.68 s.
    """
    share = intervals.around(0.85, 0.1, 3, (0.0, 1.0))
    assert (share.low, share.high) == pytest.approx((0.3184, 0.9857), abs=1e-4)
    time = intervals.around(7.3, 7.6 / stats.t.ppf(0.975, 3), 3, (0.0, np.inf))
    assert (time.low, time.high) == pytest.approx((2.577, 20.68), abs=1e-2)
    free = intervals.around(-2.0, 1.0, np.inf)
    assert (free.low, free.high) == pytest.approx((-3.96, -0.04), abs=1e-2)
    assert np.isnan(intervals.around(1.0, 0.0, 3, (0.0, 1.0)).low)  # at the bound: not known


@pytest.mark.parametrize("n", [4, 10])
def test_bounded_intervals_cover(n):
    """Of 1,000 studies of n replicates of a share with mean 0.85, at least 90 % of the intervals cover it, and all stay
    within 0 and 1."""
    rng, covered = np.random.default_rng(n), 0
    for _ in range(1000):
        values = rng.beta(8.5, 1.5, n)
        found = intervals.around(values.mean(), values.std(ddof=1) / n**0.5, n - 1, (0.0, 1.0))
        covered += found.low <= 0.85 <= found.high
        assert 0 <= found.low <= found.high <= 1
    assert covered > 900


def test_values_that_occur_often_are_as_if_repeated():
    rng = np.random.default_rng(6)
    high, low = rng.integers(0, 9, 30) / 8, rng.integers(0, 7, 20) / 8
    unit = [np.arange(30) // 3, np.arange(20) // 2]
    times = rng.integers(1, 5, 30), rng.integers(1, 5, 20)
    found = intervals.auc(high, unit[0], low, unit[1], times)
    apart = [np.repeat(x, t) for x, t in ((high, times[0]), (unit[0], times[0]), (low, times[1]), (unit[1], times[1]))]
    assert found == pytest.approx(intervals.auc(*apart))
