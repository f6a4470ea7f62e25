"""Distributions of durations: against closed forms, libraries and literal twins; and a run by hand."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats

from cosim.addons.durations import figure, measures
from cosim.addons.durations.dyads import sum_of_products
from cosim.addons.durations.families import FAMILIES
from cosim.addons.durations.fit import fit, fits, log_counted
from cosim.addons.durations.goodness import kolmogorov_smirnov, product_limit
from cosim.addons.durations.samples import Durations, definitions, of_run
from results.metrics import encounters
from results.metrics.survival import kaplan_meier
from tests.results.tiny import fleet

FREE = {
    "exponential": np.log([20.0]),
    "weibull": np.log([0.7, 25.0]),
    "log_normal": np.log([15.0, 1.1]),
    "generalised_pareto": np.array([0.3, np.log(15.0)]),
    "hyper_exponential": np.array([0.5, np.log(6.0), np.log(7.0)]),
}
SCIPY = {
    "exponential": stats.expon(scale=20),
    "weibull": stats.weibull_min(0.7, scale=25),
    "log_normal": stats.lognorm(1.1, scale=15),
    "generalised_pareto": stats.genpareto(0.3, scale=15),
}


def independent(low_s, high_s, entry_s=0.0, step_s=0.0):
    """Durations that share no actors."""
    n = len(low_s)
    return Durations(low_s, high_s, np.full(n, entry_s), np.arange(n), np.arange(n) + n, step_s)


def stepped(lasted_s, random, cut_s=math.inf, step_s=1.0):
    """What is seen in steps of durations that begin anywhere between two, cut off at random times."""
    n = np.floor(lasted_s / step_s + random.uniform(size=len(lasted_s)))
    cut = np.ceil(random.exponential(cut_s, len(n)) / step_s) if math.isfinite(cut_s) else np.full(len(n), np.inf)
    keep = n >= 1
    n, ended = np.minimum(n, cut)[keep], (n <= cut)[keep]
    high_s = np.where(ended, (n + 0.5) * step_s, np.inf)
    return independent((n - 0.5) * step_s, high_s, 0.5 * step_s, step_s)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_is_that_of_scipy_and_draws_from_itself(name):
    family, free = FAMILIES[name], FREE[name]
    x = np.array([0.0, 0.5, 3.0, 40.0, 1000.0, np.inf])
    survival = np.exp(family.log_sf(x, free))
    if name in SCIPY:
        np.testing.assert_allclose(survival, SCIPY[name].sf(x), rtol=1e-9, atol=1e-300)
    else:  # 0.6225 of mean 6 s, the rest of mean 6 * 8 = 48 s
        share = 1 / (1 + math.exp(-0.5))
        np.testing.assert_allclose(survival, share * np.exp(-x / 6) + (1 - share) * np.exp(-x / 48), rtol=1e-9)
    p = np.array([0.9, 0.5, 0.01])
    np.testing.assert_allclose(np.exp(family.log_sf(family.draw(free, p), free)), p, rtol=1e-6)


def test_exponential_in_closed_form():
    """Observed ends as points, 5 of 7: the mean is the total time over the ends, its error mean / sqrt(ends)."""
    lasted, tiny = np.array([3.0, 5, 8, 13, 21, 34, 55] * 8), 1e-3
    ended = np.array([True] * 5 + [False] * 2) & np.ones((8, 7), bool)
    sample = independent(lasted, np.where(ended.ravel(), lasted + tiny, np.inf))
    found = fit(sample, "exponential")
    assert found.parameters()["mean_s"][0] == pytest.approx(lasted.sum() / 40, rel=1e-4)
    # log-likelihood: -40 (log mean + 1) + 40 log(width of the intervals)
    assert found.log_likelihood == pytest.approx(
        -40 * (math.log(lasted.sum() / 40) + 1) + 40 * math.log(tiny), rel=1e-4
    )
    assert found.aic == pytest.approx(2 - 2 * found.log_likelihood)
    assert found.bic == pytest.approx(math.log(40) - 2 * found.log_likelihood)


def test_left_truncation_in_closed_form():
    """Exponential times forget their age: what entered at its own time has lasted from then on."""
    random = np.random.default_rng(3)
    entry = random.uniform(0, 30, 4000)
    lasted = entry + random.exponential(20.0, 4000)
    found = fit(independent(lasted, lasted + 1e-6, entry), "exponential")
    assert found.parameters()["mean_s"][0] == pytest.approx((lasted - entry).mean(), rel=1e-3)


@pytest.mark.parametrize("name", FAMILIES)
def test_a_number_of_steps_has_its_exact_probability(name):
    """With G the integral of S, n steps have (2 G(n) - G(n-1) - G(n+1)), and contacts are seen in G(1) of all cases."""
    family, free = FAMILIES[name], FREE[name]

    def integral(x):
        return integrate.quad(lambda t: math.exp(family.log_sf(np.array([t]), free)[0]), 0, x, epsabs=1e-13)[0]

    for n in (1, 2, 9, 10, 11, 30):
        low, high = np.exp(log_counted(family, free, np.array([n - 0.5, n + 0.5]), 1.0))
        exact = 2 * integral(n) - integral(n - 1) - integral(n + 1)
        assert low - high == pytest.approx(exact, abs=5e-8 + 4e-6 * (n < 3))
    assert np.exp(log_counted(family, free, np.array([0.5]), 1.0))[0] == pytest.approx(integral(1), rel=1e-5)
    timed = log_counted(family, free, np.array([0.0, 3.0]), 0.0)
    np.testing.assert_array_equal(timed, family.log_sf(np.array([0.0, 3.0]), free))


def test_steps_as_long_as_the_durations_do_not_bias():
    """Durations of 6 s on average in steps of 2 s: taking steps for durations would give another mean."""
    random = np.random.default_rng(0)
    sample = stepped(random.exponential(6.0, 60_000), random, step_s=2.0)
    value, low, high = fit(sample, "exponential").parameters()["mean_s"]
    assert low < 6.0 < high and high / low < 1.03
    seen = (sample.low_s + 1.0).mean()
    assert abs(seen - 6.0) > 5 * (high - value)


@pytest.mark.parametrize("name", FAMILIES)
def test_own_parameters_are_recovered(name):
    """Within 4 standard errors under censoring and truncation; within 5 % is a verification."""
    random = np.random.default_rng(7)
    lasted = FAMILIES[name].draw(FREE[name], random.uniform(size=6000))
    found = fit(stepped(lasted, random, cut_s=80.0), name)
    error = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.free - FREE[name]) < 4 * error).all() and (error < 0.15).all()


def test_families_are_told_apart():
    random = np.random.default_rng(5)
    for name in ("weibull", "log_normal", "hyper_exponential"):
        found = fits(stepped(FAMILIES[name].draw(FREE[name], random.uniform(size=4000)), random, cut_s=100.0))
        assert found[0].name == name and found[0].aic <= found[1].aic


def test_two_equal_means_have_no_interval():
    random = np.random.default_rng(1)
    found = fit(stepped(np.full(400, 20.0) + random.uniform(-1, 1, 400), random), "hyper_exponential")
    assert np.isnan(found.covariance).all() and np.isnan(found.parameters()["short_share"][1])


def test_an_interval_without_an_end_reaches_the_bound_of_its_parameter():
    """45 durations of a Weibull distribution say next to nothing of two means."""
    random = np.random.default_rng(3)
    n, ended = np.ceil(random.weibull(0.7, 45) * 15), random.random(45) < 0.7
    sample = independent(n - 0.5, np.where(ended, n + 0.5, np.inf), 0.5, 1.0)
    found = fit(sample, "hyper_exponential").parameters()
    assert found["short_share"][1:] == (0.0, 1.0) and found["short_mean_s"][1] == 0 and found["ratio_of_means"][1] == 1


@pytest.mark.parametrize("n", [0, 19])
def test_too_few_are_told(n):
    sample = independent(np.arange(n) + 1.0, np.arange(n) + 2.0)
    with pytest.raises(ValueError, match=f"^{n} observed ends are too few"):
        fit(sample, "exponential")


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(1, 8), st.booleans()), min_size=1, max_size=30))
def test_product_limit_is_kaplan_meier(rows):
    """Without entries it is SciPy's, where what is cut off leaves before the ends of the same step."""
    n, ended = np.array([r[0] for r in rows], float), np.array([r[1] for r in rows])
    ours = product_limit(independent(n - 0.5, np.where(ended, n + 0.5, np.inf), 0.5))
    theirs = kaplan_meier(np.where(ended, n, n - 0.5), ended)
    for step, survival in zip(theirs.duration_s, theirs.survival, strict=True):
        assert ours.survival[ours.duration_s <= step + 0.5 * (step == round(step))].iloc[-1] == pytest.approx(
            survival, abs=1e-12
        )


def test_product_limit_with_late_entries():
    """Four durations; d enters at 4 s, when a has ended: 3/4 of them do not enter in the first factor.

    Ends at 3, 5, 5 and 7: at risk 3 (a, b, c), then b, c, d, then d.
    """
    end, entry = np.array([3.0, 5, 5, 7]), np.array([0.0, 0, 0, 4])
    curve = product_limit(independent(end - 1, end, np.minimum(entry, end - 1)))
    assert curve.n_at_risk.tolist() == [4, 3, 3, 1]
    np.testing.assert_allclose(curve.survival, [1, 2 / 3, 2 / 9, 0])


def test_the_distance_to_a_fit():
    random = np.random.default_rng(2)
    sample = stepped(random.weibull(2.5, 400) * 30, random, cut_s=100.0)
    right, wrong = fit(sample, "weibull"), fit(sample, "exponential")
    good, bad = kolmogorov_smirnov(sample, right, 19), kolmogorov_smirnov(sample, wrong, 19)
    assert good.value < 0.06 < 0.15 < bad.value
    assert good.p_value > 0.1 and bad.p_value == pytest.approx(0.05)  # 1 of 20
    curve = product_limit(sample)
    curve = curve[curve.n_at_risk >= 20]
    literal = max(abs(s - math.exp(-(x - 0.5) / wrong.parameters()["mean_s"][0]))
                  for x, s in zip(curve.duration_s, curve.survival, strict=True))  # fmt: skip
    assert bad.value == pytest.approx(literal, abs=1e-9)


def test_products_of_scores_that_share_an_actor():
    """Twin by two loops."""
    random = np.random.default_rng(4)
    scores, a, b = random.normal(size=(40, 2)), random.integers(0, 9, 40), random.integers(9, 15, 40)
    literal = sum(np.outer(scores[i], scores[j]) for i in range(40) for j in range(40) if {a[i], b[i]} & {a[j], b[j]})
    values, vectors = np.linalg.eigh(literal)
    literal = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
    np.testing.assert_allclose(sum_of_products(scores, a, b), literal, atol=1e-9)


def encounter(a, b, start, end, **more):
    return {"a": a, "b": b, "start_step": start, "end_step": end, "radius_m": 100, "pairs": "all",
            "hysteresis_s": 3, "los": "buildings", "duration_s": end - start, "state_ab": None, **more}  # fmt: skip


def test_durations_and_inter_contact_times_of_a_run(tiny):
    """1 leaves after step 39. Pair 0-1 meets twice, 20 steps apart, and not again in the 10 steps that 1 stays."""
    vehicles = [v | {"last_step": 39 if v["vehicle"] == 1 else 59} for v in fleet("honest", "honest", "honest")]
    rows = [
        encounter(0, 1, 0, 5, censored_left=True),
        encounter(0, 1, 25, 30, gap_s=20),
        encounter(0, 2, 50, 58, censored_right=True),
        encounter(1, 2, 36, 40, departed=True),
    ]
    run = tiny(60, vehicles=vehicles, encounters=rows)
    (definition,) = (row for _, row in definitions(run).iterrows())
    lasted = of_run(run, "duration", definition)
    assert sorted(zip(lasted.low_s, lasted.high_s, strict=True)) == [(3.5, 4.5), (4.5, 5.5), (7.5, np.inf)]
    assert set(lasted.entry_s) == {0.5}
    assert of_run(run, "duration", definition, "censors").ended.sum() == 1
    between = of_run(run, "inter_contact", definition)
    assert sorted(zip(between.low_s, between.high_s, strict=True)) == [(9.5, np.inf), (19.5, 20.5)]
    assert set(between.entry_s) == {2.5}  # breaks of one and two steps are bridged


def test_nothing_is_known_between_encounters_of_one_who_leaves_and_returns(tiny):
    """1 is away in steps 10 and 11 of a trace, and 2 from step 30 to 34. Who is away cannot meet anybody."""
    rows = [
        encounter(0, 1, 2, 10, departed=True),
        encounter(0, 1, 12, 20, gap_s=2),
        encounter(0, 1, 40, 50, gap_s=20),
        encounter(0, 2, 20, 30, departed=True),
    ]
    run = tiny(60, vehicles=fleet("honest", "honest", "honest"), encounters=rows)
    (definition,) = (row for _, row in definitions(run).iterrows())
    between = of_run(run, "inter_contact", definition)
    assert sorted(zip(between.low_s, between.high_s, strict=True)) == [(9.5, np.inf), (19.5, 20.5)]


@pytest.mark.parametrize("hysteresis_s", [0, 4])
def test_the_curve_of_a_run_is_that_of_its_metrics(tiny, hysteresis_s):
    """Contacts of all lengths, cut off by the end of the run, in a break or not."""
    random, fewest = np.random.default_rng(7), max(1, hysteresis_s)
    start = random.integers(1, 39, 300)
    end = np.minimum(start + random.geometric(0.08, 300), 40)
    rows = [
        encounter(0, i + 1, int(s), int(e), hysteresis_s=hysteresis_s, censored_right=bool(e > 40 - fewest))
        for i, (s, e) in enumerate(zip(start, end, strict=True))
    ]  # fmt: skip
    run = tiny(40, encounters=rows)
    (definition,) = (row for _, row in definitions(run).iterrows())
    ours, theirs = product_limit(of_run(run, "duration", definition)), encounters.survival(run)
    at = np.searchsorted(ours.duration_s, theirs.duration_s + 0.5, "right") - 1
    assert ours.survival.to_numpy()[at] == pytest.approx(theirs.survival.to_numpy(), abs=1e-12)


def test_figures_beside_published_ones(tiny):
    """Exponential durations of 20 s in steps of 1 s: so is the tail beyond the median. Pedestrians are no links."""
    random = np.random.default_rng(4)
    lasted = np.ceil(random.exponential(20.0, 400)).astype(int)
    rows = [encounter(0, 1, start := 100 * k, start + n) for k, n in enumerate(lasted)]
    rows.append(encounter(0, 1, 7, 900, radius_m=200, pedestrians=True))
    run = tiny(40_000, vehicles=fleet("honest", "honest"), encounters=rows)
    assert measures.median_duration(run) == encounters.summary(run).km_median_s.tolist()[:1]
    assert abs(measures.tail_shape(run, what="duration")[0]) < 0.25
    ranks = [measures.family_rank(run, what="duration", family=name)[0] for name in FAMILIES]
    assert sorted(ranks) == [1.0, 2.0, 3.0, 4.0, 5.0][: len(FAMILIES)]
    with pytest.raises(ValueError, match="no encounters with line of sight"):
        measures.tail_shape(run, what="duration", has_los=True)


def test_few_encounters_have_no_picture_of_tails(run, tiny):
    few = tiny(60, vehicles=fleet("honest", "honest"), encounters=[encounter(0, 1, 3, 9)])
    assert [text.get_text() for axes in figure.draw([few]).axes for text in axes.texts] == ["too few"] * 4
    with pytest.raises(ValueError, match="has no encounters with these options"):
        figure.draw([run], radius_m=7.0)


@pytest.mark.verify
def test_a_picture_of_tails(run):
    """`tests/results/test_figures.py` draws it, too."""
    drawn = figure.draw([run], radius_m=100.0)
    labels = {text.get_text() for text in drawn.legends[0].get_texts()}
    assert len(drawn.axes) == 4 and "Kaplan-Meier, 95 %" in labels and len(labels) == 6


def test_a_search_that_tries_a_ratio_beyond_all_numbers_goes_on():
    """Half of the durations end with the mean of one second; those of the other half last for ever."""
    free = np.array([0.0, 0.0, 1e4])
    survival = np.exp(FAMILIES["hyper_exponential"].log_sf(np.array([0.0, 1.0, 50.0]), free))
    np.testing.assert_allclose(survival, [1, 0.5 + 0.5 / np.e, 0.5], rtol=1e-9)
