"""Sentences that say what a study answers."""

import numpy as np
import pandas as pd
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import t

from cosim.addons.answers import answers
from tests.results.test_study_pages import KEYS, ages, study_of, value_of


def said_of(*study):
    """The sentences of a study as text."""
    return [str(answer) for answer in answers.sentences(study_of(*study))]


def test_a_difference_is_said_only_if_its_interval_excludes_none(tmp_path):
    """Differences 1, 1.1, 0.9: 1 +- 4.303 x 0.1 / sqrt(3) = 0.752 to 1.248. And 3, -1, 1: 1 +- 4.97."""
    said = said_of(tmp_path / "a", KEYS, 3, ages((3.0, 3.0, 3.0), (4.0, 4.1, 3.9)))[1]
    assert "older at 0.6 than at 0.1 (difference 1 s [0.752, 1.25])" in said and "cannot" not in said
    said = said_of(tmp_path / "b", KEYS, 3, ages((3.0, 3.0, 3.0), (6.0, 2.0, 4.0)))[1]
    assert "3 replicates cannot tell 0.6 from 0.1 (difference 1 s [-3.97, 5.97])" in said
    assert "older" not in said and "fresher" not in said


def test_a_difference_that_matters_to_nobody_has_no_direction(tmp_path):
    """Differences 0.009, 0.010, 0.011 of 3 s: 0.01 +- 0.0025, all of it below 0.03 s, which is 1 %."""
    said = said_of(tmp_path, KEYS, 3, ages((3.0, 3.1, 2.9), (3.009, 3.11, 2.911)))[1]
    assert "0.6 is the same as 0.1 within 1 % (difference 0.01 s [0.00752, 0.0125])" in said and "older" not in said


def test_models_that_read_no_window_are_named(tmp_path):
    """The window counts with one model alone, and an age above the window gets a reason."""

    def value(metric, keys, replicate):
        return 7.0 + 0.1 * keys["trust.freshness_s"] * (keys["trust.model"] == "mate") + 0.01 * replicate

    swept = {"trust.freshness_s": (5.0, 20.0), "trust.model": ("beta", "mate")}
    _, age, *_, held = answers.sentences(study_of(tmp_path, swept, value=value))
    assert age.note.startswith("the window changes nothing with beta; ages exceed a short window because")
    assert held.subject.endswith("held at window 5 s, model beta")
    off = {"trust.freshness_s": ("5", "off")}  # numbers beside a word are stored as words
    study = study_of(tmp_path / "off", off, value=lambda metric, keys, replicate: 7.0 + replicate)
    assert "ages exceed a short window" in answers.sentences(study)[1].note


def test_keys_that_change_with_a_named_one_are_not_said_to_be_held(tmp_path):
    """As in a [[zip]] of ranges and penetrations: the sentences speak of the range alone."""
    study = study_of(tmp_path, {"radio.range_m": (100.0, 200.0)}, value=lambda metric, keys, replicate: 7.0 + replicate)
    study.points["fleet.penetration_p"] = study.points["radio.range_m"] / 500
    study.keys = (*study.keys, "fleet.penetration_p")
    said = str(answers.sentences(study)[-1])
    assert "fleet.penetration_p changes with radio.range_m: 0.2 at 100, 0.4 at 200" in said


def test_each_word_is_compared_with_the_first(tmp_path):
    """Numbers have an order, and the last is compared alone; 3, 3.5 and 4 with noise that all points share."""

    def value(metric, keys, replicate):
        place = ("beta", "mate", "minhas").index(keys["trust.model"])
        return 3.0 + 0.5 * place + 0.1 * replicate + 0.001 * place * replicate

    age = said_of(tmp_path, {"trust.model": ("beta", "mate", "minhas")}, 3, value)[1]
    assert "older with mate than with beta (difference 0.501 s [" in age
    assert "older with minhas than with beta (difference 1 s [" in age


def test_words_that_are_not_said_are_counted(tmp_path):
    """Of five words, the first and the last are said; of three in one replicate, that it compares none, once."""

    def value(metric, keys, replicate):
        return 3.0 + len(keys["trust.model"])

    many = said_of(tmp_path / "many", {"trust.model": ("a", "bb", "ccc", "dddd", "eeeee")}, 1, value)[1]
    assert "with model a and 8 s (one replicate) with eeeee, 3 others in the table below: one replicate" in many
    few = said_of(tmp_path / "few", {"trust.model": ("a", "bb", "ccc")}, 1, value)[1]
    assert few.count("one replicate cannot compare them") == 1 and "others" not in few


def test_an_age_is_held_against_its_own_window(tmp_path):
    """8 s at a window of 60 s need no reason, though a window of 5 s is swept, too, with ages of 2.5 s."""
    swept = {"trust.freshness_s": (5.0, 60.0)}
    study = study_of(tmp_path, swept, value=lambda metric, keys, r: 2 + 0.1 * keys["trust.freshness_s"] + 0.1 * r)
    assert "ages exceed" not in answers.sentences(study)[1].note


def test_no_difference_leaves_the_range_of_its_metric(tmp_path):
    """AUCs 0.1 and 0.9, then 0.9 and 0.1: the mean difference is 0, s = 0.8 x sqrt(2), and t(0.975, 1) = 12.706.

    Without bounds, the interval would be -10.2 to 10.2. As a share of the way from -1 to 1 it is 1/2, and its logit
    reaches 12.706 x 0.8 / (2 x 1/4) = 20.3 to either side.
    """
    third = said_of(tmp_path, KEYS, 2, ages((10.0, 90.0), (90.0, 10.0)))[3]
    assert "2 replicates cannot tell 0.6 from 0.1 (difference 0 [-1, 1])" in third


def test_each_city_has_sentences_and_keys_that_change_nothing_no_part(tmp_path):
    """12.00, 12.01, 12.02 in the first city: 4.303 x 0.01 / sqrt(3) = 0.025; pooled over 16 points it were 0.002."""
    study = study_of(tmp_path, value=lambda metric, keys, r: value_of(metric, keys, 100 * r))
    found = answers.sentences(study)
    assert [one.city for one in found] == ["street"] * 5 + ["town"] * 5 + [""]
    assert str(found[-1]).startswith("Keys that a line does not name are held at penetration 0.1, window 5 s")
    assert "the window changes" not in found[2].note
    row = study.summary[study.summary.metric == "encounters.duration.km_median_s"].iloc[0]
    assert row.n == 3 and f"{row['mean']:.3g} s [{row.low:.3g}, {row.high:.3g}] at penetration 0.1" in str(found[0])
    assert len(found[0].parts) == 1 and "17 s" in str(found[0]) and "20 s" in str(found[5])


def test_all_values_of_a_key_are_said_if_they_are_few(tmp_path):
    few, many = (
        answers.sentences(study_of(tmp_path / str(n), {"fleet.penetration_p": tuple(k / 10 for k in range(n))}))[0]
        for n in (4, 5)
    )
    assert "at penetration 0, " in str(few) and " at 0.1, " in str(few) and " at 0.2 and " in str(few)
    assert " at 0.1" not in str(many) and "at penetration 0 and " in str(many) and " at 0.4: " in str(many)


def test_a_maximum_between_the_ends_is_said(tmp_path):
    """Of five windows, the ends have one age of 3 s: that of 9 s between them was not said."""

    def value(metric, keys, replicate):
        return (9.0 if keys["trust.freshness_s"] == 20 else 3.0) + replicate

    said = said_of(tmp_path, {"trust.freshness_s": (5.0, 10.0, 20.0, 50.0, 100.0)}, 3, value)[1]
    assert " at window 5 s, 10 s [7.8, 12.8] at 20 s and 4 s [2.15, 7.44] at 100 s: " in said


def test_where_alone_a_metric_has_a_value_is_said(tmp_path):
    """An AUC needs attackers, and the median was reached at one penetration alone."""

    def value(metric, keys, replicate):
        is_missing = metric.startswith("encounters") and keys["fleet.penetration_p"] == 0.6
        return np.nan if is_missing else 0.5 + keys["fleet.penetration_p"] / 10 + 0.01 * replicate

    swept = {**KEYS, "attacks.0.share_p": (0.0, 0.1)}
    first, second, too_late, third, last = answers.sentences(study_of(tmp_path, swept, value=value))
    assert str(too_late).startswith("No share of encounters without trust")
    assert str(last).startswith("No trust in honest vehicles: no run has such a value")
    assert first.note == "there is a value at penetration 0.1 alone" and not second.note
    assert third.note == "there is a value at share of attackers 0.1 alone"
    low = study_of(tmp_path / "low", swept, value=lambda *of: value(*of) - 0.3)
    assert answers.sentences(low)[3].note.endswith("below 0.5, malicious vehicles are trusted more than honest ones")


def test_means_of_fewer_replicates_are_told(tmp_path):
    """At 0.6 the longest of three medians, 30 s, was not reached: 11 s is the mean of 10 and 12."""

    def value(metric, keys, replicate):
        if not metric.startswith("encounters") or keys["fleet.penetration_p"] == 0.1:
            return 8.0 + replicate
        return (10.0, 12.0, np.nan)[replicate]

    encounter, age, *_ = said_of(tmp_path, KEYS, 3, value)
    assert "11 s" in encounter and "(some means are of 2 of 3 replicates, and too short if" in encounter
    assert "replicates, and" not in age and "some means" not in age


def test_each_sentence_speaks_of_one_group():
    """With unreliable vehicles beside malicious ones, too: trust is that of the honest, an AUC has its own role."""
    names = [f"trust.final.median:{role}" for role in ("honest", "malicious", "unreliable")]
    assert [name for name in names if answers._speaks_of(answers._UNDER_ATTACK, name)] == names[:1]
    auc = answers._QUANTITIES[3]
    assert answers._subject(auc, "malicious").endswith("than a malicious one in a share of comparisons (AUC) of")
    assert "than an unreliable one" in answers._subject(auc, "unreliable")


def test_one_replicate_has_no_interval_and_what_is_missing_is_said(tmp_path):
    assert "one replicate cannot compare them" in said_of(tmp_path / "a", KEYS, 1, ages((3.0,), (4.0,)))[1]
    none = said_of(tmp_path / "b", KEYS, 3, lambda metric, *_: np.nan if metric.startswith("enc") else 0.5)
    first, second, _, third = none
    assert first.startswith("No median duration of encounters") and "topic encounters" in first
    assert second.endswith("0.5 s (the same in all 3 replicates).") and "0.5" in third
    equal = said_of(tmp_path / "d", KEYS, 3, ages((3.0, 3.0, 3.0), (4.0, 4.0, 4.0)))
    assert "older by 1 s in each of the 3 replicates, which leaves no spread" in equal[1]
    other = said_of(tmp_path / "c", KEYS, 2, ages((3.0, np.nan), (np.nan, 4.0)))
    assert "no replicate has both 0.1 and 0.6" in other[1]


@settings(max_examples=15)
@given(st.lists(st.tuples(*[st.floats(0.5, 50)] * 2), min_size=2, max_size=6))
def test_sentences_are_true_of_the_numbers(tmp_path_factory, pairs):
    """The interval of the paired difference again, with SciPy's t alone, and the word that goes with it."""
    first, last = (tuple(x[i] for x in pairs) for i in (0, 1))
    said = said_of(tmp_path_factory.mktemp("s"), KEYS, len(pairs), ages(first, last))[0]
    difference = np.subtract(last, first)
    half = t.ppf(0.975, len(pairs) - 1) * difference.std(ddof=1) / len(pairs) ** 0.5
    low, high = difference.mean() - half, difference.mean() + half
    if abs(low) < 1e-9 or abs(high) < 1e-9 or high - low < 1e-6:
        return  # rounding decides
    if np.ptp(np.stack([first, last]), axis=None) == 0:
        assert "difference" not in said
    elif (np.array(first) == np.array(last)).all():
        assert "difference" not in said
    elif low > 0:
        assert "longer at" in said and "cannot" not in said
    elif high < 0:
        assert "shorter at" in said and "cannot" not in said
    else:
        assert "cannot tell" in said and "longer" not in said and "shorter" not in said


def test_a_baseline_among_words_is_the_reference_and_off_has_no_unit(tmp_path):
    """The column of "off", 10 and 2 is text."""
    swept = {"trust.freshness_s": ("off", "10", "2"), "fleet.penetration_p": (0.1, 0.3)}

    def value(metric, keys, replicate):
        return 3.0 + len(keys["trust.freshness_s"]) + keys["fleet.penetration_p"] + 0.1 * replicate

    study = study_of(tmp_path, swept, value=value, baseline={"trust.freshness_s": 10})
    *_, held = answers.sentences(study)
    assert "window 10 s" in str(held)
    said = str(answers.sentences(study)[1])
    assert " with window 10 s, " in said and " with off and " in said and "off s" not in said
    assert "older by 1 s with off as against 10 s in each of the 3 replicates" in said
    assert "fresher by 1 s with 2 s as against 10 s in each of the 3 replicates" in said
    assert set(study.differences["trust.freshness_s"]) == {"off", "2"}


def test_the_share_of_fresh_evaluations_is_that_of_all_lookups(tmp_path):
    """Not from the smallest of a role to the largest of another one."""
    share = "freshness.evaluation_within.share"
    measured = (("freshness.newest_evaluation_age.mean_s", "all"), (share, "all"), (share, "malicious"))
    study = study_of(tmp_path, KEYS, measured=measured, value=lambda metric, keys, r: 0.5)
    path = tmp_path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    found.assign(value=found.value.where(found.group == "all", 0.1)).to_parquet(path)
    assert "a fresh one, 50 % on average" in answers.sentences(study)[1].note
    assert "capped_age and by" in answers.sentences(study)[1].note
    windows = {"trust.freshness_s": (2.0, 10.0)}
    of_windows = study_of(tmp_path / "windows", windows, measured=measured, value=lambda metric, keys, r: 0.5)
    assert "capped_age at equal windows and by" in answers.sentences(of_windows)[1].note


def test_a_share_of_encounters_is_of_equipped_vehicles_and_says_which_are_not_over(tmp_path):
    """Its definition may count all actors, pedestrians too. The note of one run stands for the others."""
    share = "freshness.encounters_without_trust.share"
    measured = (("encounters.duration.km_median_s", "all, 60 m"), (share, "all, 60 m"))
    study = study_of(tmp_path, KEYS, measured=measured, value=lambda metric, keys, r: 0.5 + r)
    said = answers.sentences(study)
    assert str(said[0]).startswith("The median encounter (all, 60 m) lasts")
    assert (
        str(said[2]).startswith("The share of encounters of equipped vehicles (all, 60 m) that are")
        and not said[2].note
    )
    path = tmp_path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    found.assign(note=np.where(found.index == 3, "2 of 9 are not over", "")).to_parquet(path)
    del study.measures
    assert answers.sentences(study)[2].note == "encounters that go on at the end of a run count as over then"
