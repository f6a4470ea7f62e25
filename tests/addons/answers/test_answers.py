"""Sentences that say what a study answers."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t

from cosim.addons.answers import answers
from tests.results.test_study_pages import KEYS, ages, study_of, value_of


def test_a_difference_is_said_only_if_its_interval_excludes_none(tmp_path):
    """Differences 1, 1.1, 0.9: 1 +- 4.303 x 0.1 / sqrt(3) = 0.752 to 1.248. And 3, -1, 1: 1 +- 4.97."""
    sure = study_of(tmp_path / "a", KEYS, value=ages((3.0, 3.0, 3.0), (4.0, 4.1, 3.9)))
    said = answers.sentences(sure)[1]
    assert "older by 1 s (95 % interval of the difference 0.752 to 1.25 s)" in said and "cannot" not in said
    unsure = study_of(tmp_path / "b", KEYS, value=ages((3.0, 3.0, 3.0), (6.0, 2.0, 4.0)))
    said = answers.sentences(unsure)[1]
    assert "which 3 replicates cannot tell apart (95 % interval of the difference -3.97 to 5.97 s)" in said
    assert "older" not in said and "fresher" not in said


def test_no_difference_leaves_the_range_of_its_metric(tmp_path):
    """AUCs 0.1 and 0.9, then 0.9 and 0.1: the mean difference is 0, s = 0.8 x sqrt(2), and t(0.975, 1) = 12.706.

    Without bounds, the interval would be -10.2 to 10.2. As a share of the way from -1 to 1 it is 1/2, and its logit
    reaches 12.706 x 0.8 / (2 x 1/4) = 20.3 to either side.
    """
    third = answers.sentences(study_of(tmp_path, KEYS, 2, ages((10.0, 90.0), (90.0, 10.0))))[2]
    assert "which 2 replicates cannot tell apart (95 % interval of the difference -1 to 1)" in third


def test_keys_that_change_nothing_do_not_count_as_replicates(tmp_path):
    """12.00, 12.01, 12.02 in the first city: 4.303 x 0.01 / sqrt(3) = 0.025; pooled over 16 points it were 0.002."""
    study = study_of(tmp_path, value=lambda metric, keys, r: value_of(metric, keys, 100 * r))
    first = answers.sentences(study)[0]
    row = study.summary[study.summary.metric == "encounters.duration.km_median_s"].iloc[0]
    assert row.n == 3 and f"95 % interval {row.low:.3g} to {row.high:.3g} s" in first
    assert "in street and 16 s" in first and "at penetration 0.3 instead of 0.1 it is 17 s" in first
    assert "window" not in first


def test_where_alone_a_metric_has_a_value_is_said(tmp_path):
    """An AUC needs attackers, and the median was reached at one penetration alone."""

    def value(metric, keys, replicate):
        is_missing = metric.startswith("encounters") and keys["fleet.penetration_p"] == 0.6
        return np.nan if is_missing else 0.5 + keys["fleet.penetration_p"] / 10 + 0.01 * replicate

    swept = {**KEYS, "attacks.0.share_p": (0.0, 0.1)}
    first, second, third, fourth = answers.sentences(study_of(tmp_path, swept, value=value))
    assert fourth.startswith("No trust in honest vehicles: no run has such a value")
    assert first.endswith("; it has a value at penetration 0.1 alone.") and "alone" not in second
    assert third.endswith("; it has a value at share of attackers 0.1 alone.")
    low = study_of(tmp_path / "low", swept, value=lambda *of: value(*of) - 0.3)
    assert answers.sentences(low)[2].endswith("below 0.5, malicious vehicles are trusted more than honest ones.")


def test_each_sentence_speaks_of_one_group():
    """With unreliable vehicles beside malicious ones, too: trust is that of the honest, an AUC has its own role."""
    names = [f"trust.final.median:{role}" for role in ("honest", "malicious", "unreliable")]
    assert [name for name in names if answers._speaks_of(answers._UNDER_ATTACK, name)] == names[:1]
    auc = answers._QUANTITIES[2]
    assert answers._subject(auc, "malicious").endswith("than a malicious one in a share of comparisons (AUC) of")
    assert "than an unreliable one" in answers._subject(auc, "unreliable")


def test_one_replicate_has_no_interval_and_what_is_missing_is_said(tmp_path):
    one = study_of(tmp_path / "a", KEYS, 1, ages((3.0,), (4.0,)))
    assert "which one replicate cannot compare" in answers.sentences(one)[1]
    none = study_of(tmp_path / "b", KEYS, value=lambda metric, *_: np.nan if metric.startswith("enc") else 0.5)
    first, second, third = answers.sentences(none)
    assert first.startswith("No median duration of encounters") and "topic encounters" in first
    assert second.endswith("0.5 s (the same in all 3 replicates).") and "0.5" in third
    equal = study_of(tmp_path / "d", KEYS, value=ages((3.0, 3.0, 3.0), (4.0, 4.0, 4.0)))
    assert "older by 1 s in each of the 3 replicates, which leaves no spread" in answers.sentences(equal)[1]
    other = study_of(tmp_path / "c", KEYS, 2, ages((3.0, np.nan), (np.nan, 4.0)))
    assert "which no replicate has both of" in answers.sentences(other)[1]


@settings(max_examples=15)
@given(st.lists(st.tuples(*[st.floats(0.5, 50)] * 2), min_size=2, max_size=6))
def test_sentences_are_true_of_the_numbers(tmp_path_factory, pairs):
    """The interval of the paired difference again, with SciPy's t alone, and the word that goes with it."""
    first, last = (tuple(x[i] for x in pairs) for i in (0, 1))
    study = study_of(tmp_path_factory.mktemp("s"), KEYS, len(pairs), ages(first, last))
    said = answers.sentences(study)[0]
    difference = np.subtract(last, first)
    half = t.ppf(0.975, len(pairs) - 1) * difference.std(ddof=1) / len(pairs) ** 0.5
    low, high = difference.mean() - half, difference.mean() + half
    if abs(low) < 1e-9 or abs(high) < 1e-9 or high - low < 1e-6:
        return  # rounding decides
    if np.ptp(np.stack([first, last]), axis=None) == 0:
        assert "instead" not in said
    elif (np.array(first) == np.array(last)).all():
        assert "apart" not in said or "cannot" in said
    elif low > 0:
        assert "longer by" in said and "cannot" not in said
    elif high < 0:
        assert "shorter by" in said and "cannot" not in said
    else:
        assert "cannot tell apart" in said and "longer" not in said and "shorter" not in said
