"""What a study answers: pivoted tables, pooled curves, figures for any number of keys."""

import itertools
import re
from itertools import cycle

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import t

from results import study_report, study_table
from results.figures import study as study_figure
from results.figures import study_curves as curve_figure
from results.metrics.registry import CORE, METRICS
from results.metrics.survival import kaplan_meier
from results.study import StudyResults, apart, is_grid, short_keys, that_matter
from results.study_curves import COLUMNS, counts, pooled, survival
from tests.results.tiny import fleet

CITIES = ("/nets/alpha/street.sumocfg", "/nets/beta/town.sumocfg")
SWEPT = {
    "traffic.scenario": CITIES, "fleet.penetration_p": (0.1, 0.3), "trust.freshness_s": (5.0, 20.0),
    "attacks.0.share_p": (0.0, 0.1), "trust.model": ("beta", "mate"),
}  # fmt: skip


def value_of(metric, keys, replicate):
    """Encounters depend on city and penetration, ages on penetration and window, the AUC on all but the city."""
    noise = 0.01 * replicate
    if metric.startswith("encounters"):
        return 10 + 20 * keys["fleet.penetration_p"] + 3 * (keys.get("traffic.scenario") == CITIES[1]) + noise
    if metric.startswith("freshness"):
        return 2 + keys["fleet.penetration_p"] + 0.1 * keys.get("trust.freshness_s", 0) + noise
    return 0.6 + 0.01 * keys.get("trust.freshness_s", 0) + 0.05 * (keys.get("trust.model") == "mate") + noise


MEASURED = (
    ("encounters.duration.km_median_s", "equipped, 100 m"), ("freshness.newest_evaluation_age.mean_s", "all"),
    ("misbehaviour.at_lookup.auc", "malicious"),
)  # fmt: skip
"""Three core metrics, each with one group."""


def study_of(folder, swept=SWEPT, replicates=3, value=value_of, baseline=None, measured=MEASURED):
    """A study with some metrics of these values. An AUC needs attackers."""
    at = [dict(zip(swept, values, strict=True)) for values in itertools.product(*swept.values())]
    points = pd.DataFrame([
        {"point": f"{i}-{r}", "run": "all", "variant": "base", "replicate": r, "state": "finished", **keys}
        for i, keys in enumerate(at) for r in range(replicates)
    ])  # fmt: skip
    rows = []
    for point in points.to_dict("records"):
        for metric, group in measured:
            if metric.endswith("auc") and point.get("attacks.0.share_p", 1) == 0:
                continue
            found = value(metric, point, point["replicate"])
            if found == found:
                about = METRICS[metric]
                rows.append((point["point"], metric, group, float(found), about.unit, about.label))
    (folder / "jobs" / "all").mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(rows, columns=["point", "metric", "group", "value", "unit", "label"])
    table.to_parquet(folder / "jobs" / "all" / "measures.parquet")
    head = {"name": "s", "question": "How long?", "keys": list(swept), "baseline": baseline or {}}
    return StudyResults(folder, head, points)


def with_curves(study, of, what="encounters"):
    """The same study, with the samples `of(keys, replicate)` of encounters, or of ages."""
    group = "equipped, 100 m" if what == "encounters" else ""
    rows = [
        {"point": p["point"], "what": what, "group": group, "value_s": s, "n": n, "n_open": c}
        for p in study.points.to_dict("records") for s, n, c in of(p, p["replicate"])
    ]  # fmt: skip
    pd.DataFrame(rows).to_parquet(study.path / "jobs" / "all" / "curves.parquet")
    return study


def test_core_metrics_exist_and_are_eight():
    assert len(CORE) == len(set(CORE)) == 8 and all(name.partition(":")[0] in METRICS for name in CORE)


def test_keys_that_change_a_metric(tmp_path):
    """And of keys that change together, the first."""
    study = study_of(tmp_path)
    of = {metric: frame for metric, frame in study.measures.groupby("metric")}
    assert that_matter(of["encounters.duration.km_median_s"], study.keys) == ["traffic.scenario", "fleet.penetration_p"]
    assert that_matter(of["freshness.newest_evaluation_age.mean_s"], study.keys) == [
        "fleet.penetration_p", "trust.freshness_s",
    ]  # fmt: skip
    assert that_matter(of["misbehaviour.at_lookup.auc"], study.keys) == ["trust.freshness_s", "trust.model"]
    zipped = pd.DataFrame({"a": [1, 1, 2, 2], "b": [5, 5, 6, 6], "c": [1, 2, 1, 2], "d": 0})
    assert apart(zipped, "abcd") == ["a", "c"]
    assert that_matter(zipped.assign(replicate=0, value=[1, 1, 2, 2]), "abcd") == ["a"]


def test_changes_one_by_one_are_no_grid():
    grid = pd.DataFrame({"a": [1, 1, 2, 2], "b": [1, 2, 1, 2], "c": [3, 3, 3, 3]})
    assert is_grid(grid, "abc")
    assert not is_grid(grid.iloc[:3], "abc")


def test_five_keys_are_reported(tmp_path):
    """Every figure is drawn, with short names of cities; the table has a row per combination that matters."""
    study = study_of(tmp_path, baseline={"trust.freshness_s": 5.0})
    text = study_report.page(study)
    assert "of 20 differences that are none, about one excludes 0 by chance" in text
    assert 'class="missing"' not in text and "/nets/" not in re.sub(r"base64,[^\"]*", "", text)
    found = study_table.pivot(study, study.summary, study_table.core(study))
    assert list(found.columns) == ["", "group", "fleet.penetration_p", "trust.freshness_s", "attacks.0.share_p",
                                   "trust.model", "street", "town"]  # fmt: skip
    assert found["attacks.0.share_p"].tolist() == 6 * [""] + 4 * ["0.1"], "without attackers there is no AUC"
    assert len(found) == 2 + 4 + 4
    # encounters at 10 % in the first city: 10 + 2 + mean of 0, .01, .02 = 12.01; s = .01; 4.303 x .01 / sqrt(3) = .0248
    half = t.ppf(0.975, 2) * 0.01 / 3**0.5
    assert found.street[0] == "12 (12 to 12)" and half == pytest.approx(0.0248, abs=1e-4)
    for key, text in (("trust.freshness_s", "5.00"), ("trust.freshness_s", "5"), ("traffic.scenario", "town")):
        assert len(study_table.pivot(study, study.summary, study_table.core(study), where={key: text}))
    with pytest.raises(ValueError, match=r"^no point has trust.freshness_s = 7\. There are 5, 20.$"):
        study_table.pivot(study, study.summary, study_table.core(study), where={"trust.freshness_s": "7"})
    with pytest.raises(ValueError, match="range_m is not swept"):
        study_table.pivot(study, study.summary, study_table.core(study), over="radio.range_m")


def test_a_table_says_of_whom_its_values_are_where_it_has_one_group_alone(tmp_path):
    """Differences of trust in honest vehicles had no word "honest": malicious ones have none to a baseline without."""
    swept = {key: SWEPT[key] for key in ("fleet.penetration_p", "trust.model")}
    study = study_of(tmp_path, swept)
    named = [f"{metric}:{group}" for metric, group in MEASURED]
    of_one = study_table.pivot(study, study.summary, named[2:])
    assert of_one.group.unique().tolist() == ["malicious"]
    assert "group" not in study_table.pivot(study, study.summary, named[1:2]), "all"
    nothing = study_table.pivot(study, study.summary, [])
    assert nothing.empty
    assert not study_table.cautions(study, study.summary.iloc[:0].assign(note=np.nan), [])


def test_a_point_at_the_edge_of_a_panel_is_not_cut(tmp_path):
    """Without attackers there is no AUC: the ticks of the share then ended the panel in the middle of the markers."""
    swept = {key: SWEPT[key] for key in ("attacks.0.share_p", "trust.model")}
    study = study_of(tmp_path, swept, measured=MEASURED[2:])
    figure = study_figure.draw(study, "", ["misbehaviour.at_lookup.auc:malicious"])
    (axes,) = figure.axes
    left, right = axes.get_xlim()
    last = max(axes.containers[-1].lines[0].get_xdata())
    assert left < 0.0
    assert right > 1.01 * last > 0.1


def test_a_key_that_changes_nothing_stands_for_runs_that_are_missing(tmp_path):
    """Without attackers the runs at 0.3 failed. Those with attackers have the same encounters: 16.01, not nothing."""

    def value(metric, keys, replicate):
        has_failed = keys["fleet.penetration_p"] == 0.3 and keys["attacks.0.share_p"] == 0
        return np.nan if has_failed else value_of(metric, keys, replicate)

    swept = {key: SWEPT[key] for key in ("fleet.penetration_p", "attacks.0.share_p")}
    study = study_of(tmp_path, swept, value=value)
    name = "encounters.duration.km_median_s:equipped, 100 m"
    (row,) = study_table.pivot(study, study.summary, [name]).to_dict("records")
    assert (row["0.1"], row["0.3"]) == ("12 (12 to 12)", "16 (16 to 16)")
    (axes,) = study_figure.draw(study, "", [name], over="fleet.penetration_p", lean=True).axes
    assert axes.containers[0].lines[0].get_ydata().tolist() == pytest.approx([12.01, 16.01])
    lasted_s = {(0.1, 0.0): [12.0], (0.1, 0.1): [12.0], (0.3, 0.0): [], (0.3, 0.1): [16.0]}
    with_curves(study, lambda keys, replicate: [(one_s, 9, 0) for one_s in lasted_s[tuple(keys[key] for key in swept)]])
    assert len(curve_figure.draw(study, "encounters").axes[0].lines) == 2


@pytest.mark.verify
def test_select_boxes_name_what_the_axes_do_not_show(tmp_path, monkeypatch):
    """Numbers come first on the axes, and each city has its own figures. The AUC exists at one share of attackers."""
    monkeypatch.setattr(study_report, "image_url", lambda figure: "data:,")  # figures are seen in the other tests

    def value(metric, keys, replicate):
        return sum(0.01 * list(SWEPT[key]).index(keys[key]) * 2**i for i, key in enumerate(SWEPT)) + 0.1 * replicate

    study = study_of(tmp_path, value=value)
    text = study_report.page(study)
    boxes = re.findall(r"<label hidden>(\S.*?) <select>(.*?)</select>", text)
    assert [name for name, _ in boxes] == ["city", "model"] * 2 + ["city"]
    assert all(options.count("<option") == 2 for _, options in boxes)
    assert text.count("data-at='0 1'><p class='soft'>city = street, model = mate") == 2
    files = study_report.save_figures(study, tmp_path / "figures")
    assert len(files) == 4 + 4 + 2 and all(path.read_bytes().startswith(b"%PDF") for path in files)
    assert "misbehaviour.at_lookup.auc-scenario=town.pdf" in {path.name for path in files}


def test_a_point_that_waits_has_no_run(tmp_path):
    study = study_of(tmp_path, {"fleet.penetration_p": (0.1, 0.2)})
    n = len(study.points)
    more = study.points.iloc[:1].assign(point="next", run="", state="waiting")
    study.points = pd.concat([study.points, more], ignore_index=True)
    assert f"{n + 1} points ({n} finished, 1 waiting) of 1 run;" in study_report.page(study)


def test_a_study_of_its_baseline_alone_has_no_differences(tmp_path):
    study = study_of(tmp_path, {"fleet.penetration_p": (0.1,)}, baseline={"fleet.penetration_p": 0.1})
    page = study_report.page(study)
    assert study.differences.empty and "Paired differences" not in page and "3 points (3 finished) of 1 run;" in page


def test_words_have_the_order_of_the_study_and_the_legend_a_free_place(tmp_path):
    models = ("mate", "beta", "announcement")

    def value(metric, keys, replicate):
        return 0.1 * models.index(keys["trust.model"]) + keys["fleet.penetration_p"] + 0.01 * replicate

    swept = {"fleet.penetration_p": (0.1, 0.3), "trust.model": models}
    study = study_of(tmp_path, swept, value=value)
    drawn = study_figure.draw(study, "", ["misbehaviour.at_lookup.auc"])
    assert [text.get_text() for text in drawn.legends[0].get_texts()][:3] == [f"model = {name}" for name in models]

    def of(keys, replicate):
        return [(10.0 * (1 + models.index(keys["trust.model"])), 10, 0), (40.0 * keys["fleet.penetration_p"], 5, 0)]

    drawn = curve_figure.draw(with_curves(study, of), "encounters")
    *panels, last = drawn.axes
    assert [axes.get_title("left") for axes in panels] == [f"model = {name}" for name in models]
    assert not drawn.legends and last.get_legend() is not None


KEYS = {"fleet.penetration_p": (0.1, 0.6)}


def ages(first, last):
    """Ages of the replicates at two penetrations; an AUC is a hundredth of them."""

    def value(metric, keys, replicate):
        age = (first if keys["fleet.penetration_p"] == 0.1 else last)[replicate]
        return age / 100 if metric.endswith("auc") else age

    return value


def test_pooled_survival_by_hand():
    """Replicate 0: 1, 2, 3+; replicate 1: 2, 2, 4 (+: end not seen).

    Pooled S(1) = 5/6; S(2) = 5/6 x 2/5 = 1/3; S(3) = 1/3; S(4) = 0. Alone: 2/3, 1/3, 1/3; and 1, 1/3, 1/3, 0.
    """
    rows = [(0, 1.0, 1, 0), (0, 2.0, 1, 0), (0, 3.0, 0, 1), (1, 2.0, 2, 0), (1, 4.0, 1, 0)]
    found = pooled(pd.DataFrame(rows, columns=["replicate", "value_s", "n", "n_open"]))
    assert found.value_s.tolist() == [0, 1, 2, 3, 4]
    assert found.survival.tolist() == pytest.approx([1, 5 / 6, 1 / 3, 1 / 3, 0])
    assert found.low.tolist() == pytest.approx([1, 2 / 3, 1 / 3, 1 / 3, 0])
    assert found.high.tolist() == pytest.approx([1, 1, 1 / 3, 1 / 3, 0])


def test_a_replicate_whose_encounters_have_all_ended_stays_in_the_band():
    """Replicate 0: 1, 2; replicate 1: 2, 3, 4. At 3 s, 1/5 of all are left, and 0 and 1/3 of each."""
    rows = [(0, 1.0, 1, 0), (0, 2.0, 1, 0), (1, 2.0, 1, 0), (1, 3.0, 1, 0), (1, 4.0, 1, 0)]
    found = pooled(pd.DataFrame(rows, columns=["replicate", "value_s", "n", "n_open"])).set_index("value_s").loc[3]
    assert found.tolist() == pytest.approx([1 / 5, 0, 1 / 3])


@given(st.lists(st.tuples(st.integers(1, 9), st.booleans()), min_size=1, max_size=30))
def test_survival_of_counts_is_that_of_single_durations(sample):
    lasted_s, over = np.array([x for x, _ in sample], float), np.array([x for _, x in sample])
    curve = kaplan_meier(lasted_s, over)
    frame = pd.DataFrame({"value_s": lasted_s, "n": over.astype(int), "n_open": (~over).astype(int)})
    frame = frame.groupby("value_s", as_index=False).sum()
    found = survival(frame, curve.duration_s.to_numpy())
    assert found == pytest.approx(curve.survival.to_numpy())


def test_lookups_without_evaluation_are_older_than_any_age():
    """Two lookups of 1 s, one of 3 s, one without: S(1) = 1/2, S(3) = 1/4, and so on for ever."""
    frame = pd.DataFrame({"value_s": [1.0, 3.0, np.inf], "n": [2, 1, 0], "n_open": [0, 0, 1]})
    assert survival(frame, np.array([0.0, 1.0, 2.0, 3.0, 99.0])).tolist() == [1, 0.5, 0.5, 0.25, 0.25]


def test_a_run_without_encounters_and_lookups_has_no_curves(tiny, tmp_path):
    """What is kept of it is an empty table with its kinds, and is read again beside others."""
    found = counts(tiny(5, vehicles=fleet("honest")))
    assert found.empty and {str(name): str(kind) for name, kind in found.dtypes.items()} == COLUMNS
    study = with_curves(study_of(tmp_path / "s", KEYS), lambda keys, r: [(3.0, 1, 0)])
    study.points.loc[study.points.replicate == 0, "run"] = "none"
    (study.path / "jobs" / "none").mkdir()
    found.assign(point="0-0").to_parquet(study.path / "jobs" / "none" / "curves.parquet")
    assert len(study.curves) == 6


def test_curves_of_a_study(tmp_path):
    """Encounters do not depend on the window: the figure shows penetrations, with each replicate counted once."""
    swept = {"trust.freshness_s": (5.0, 20.0), "fleet.penetration_p": (0.1, 0.3)}
    study = with_curves(study_of(tmp_path, swept), lambda keys, r: [(10 * keys["fleet.penetration_p"] + r, 4, 1)])
    assert curve_figure.keys_of(study, "encounters") == ["fleet.penetration_p"]
    (axes,) = curve_figure.draw(study, "encounters").axes
    # 10 %: 1, 2, 3 s with 4 ended and 1 open each: 15 at risk, then 10, then 5
    assert axes.get_lines()[0].get_ydata().tolist() == pytest.approx([1, 11 / 15, 11 / 15 * 0.6, 11 / 15 * 0.6 * 0.2])
    held = curve_figure.draw(study, "encounters", where={"fleet.penetration_p": 0.1, "group": "equipped, 100 m"})
    assert "at equipped, 100 m, penetration = 0.1" in {text.get_text() for text in held.legends[0].get_texts()}
    with pytest.raises(ValueError, match=r"^no point has group = all, 5 m\. There are equipped, 100 m\.$"):
        curve_figure.draw(study, "encounters", where={"group": "all, 5 m"})
    with pytest.raises(ValueError, match="has kept no age"):
        curve_figure.draw(study, "ages")
    with pytest.raises(ValueError, match="range_m is not swept"):
        curve_figure.draw(study, "encounters", by="radio.range_m")


def test_the_axis_of_ages_ends_where_the_curves_are_level(tmp_path):
    """Of 200 evaluations at 10 %, 197 are at most 2 s old, 2 are 5 s and 1 is 60 s: after 5 s, 0.5 % is left to fall.

    At 30 % it is so after 8 s, which ends the axis. Another 200 lookups find nothing.
    """

    def of(keys, replicate):
        late_s = 5.0 if keys["fleet.penetration_p"] == 0.1 else 8.0
        return [(2.0, 197, 0), (late_s, 2, 0), (60.0, 1, 0), (np.inf, 0, 200)]

    (axes,) = curve_figure.draw(with_curves(study_of(tmp_path, KEYS), of, "ages"), "ages").axes
    assert axes.get_xlim() == pytest.approx((0, 8 * 1.02))


def test_axes_follow_the_means_and_arrows_mark_what_leaves_them(tmp_path):
    """Two replicates at 10 % give an interval of +-12.7 errors: it leaves the panel, and the others stay legible."""
    study = study_of(tmp_path, KEYS, 2, ages((1.0, 9.0), (5.0, 5.1)))
    (axes,) = study_figure.draw(study, "", ["encounters.duration.km_median_s:equipped, 100 m"]).axes
    high = study.summary.high[study.summary.metric == "encounters.duration.km_median_s"].max()
    assert axes.get_ylim()[1] < 10 < high
    arrows = [line for line in axes.get_lines() if line.get_marker() == "^" and line.get_linestyle() == "None"]
    assert [line.get_ydata()[0] for line in arrows] == [axes.get_ylim()[1]]


def test_a_line_shows_one_group_of_a_metric(tmp_path):
    """Groups were joined in one line, with several marks at each value of the key and without a word."""
    age, trust, met = "freshness.newest_evaluation_age.mean_s", "trust.final.median", "encounters.per_vehicle_h"
    groups = {age: ("malicious", "all", "honest"), trust: ("honest", "malicious"), met: ("a, 1 m, 0 s", "a, 1 m, 5 s")}
    measured = [(metric, group) for metric, some in groups.items() for group in some]
    study = study_of(tmp_path, KEYS, measured=measured, value=lambda metric, keys, replicate: 0.1)
    for name, group in ((age, "all [s]"), (f"{trust}:honest", "honest"), (f"{met}:{groups[met][0]}", "0 s [1/h]")):
        (axes,) = study_figure.draw(study, "", [name]).axes
        assert axes.get_ylabel().endswith(group)
        assert axes.get_lines()[0].get_xdata().size == 2
    for name in (trust, met):
        said = rf"^{name} has several groups: {'; '.join(groups[name])}\. Choose one as {name}:GROUP\.$"
        with pytest.raises(ValueError, match=said):
            study_figure.draw(study, "", [name])
    with pytest.raises(ValueError, match=r"^trust stands for several metrics: name one of trust\."):
        study_figure.draw(study, "", ["trust"])


ATTACKS = {"attacks.0.share_p": (0.0, 0.1), "attacks.1.share_p": (0.0, 0.1)}


def test_keys_with_the_same_last_word_are_told_apart(tmp_path):
    keys = ("attacks.0.share_p", "attacks.1.share_p", "trust.model", "radio.model", "radio.period_s", "trust.period_s")
    said = [study_figure.label_of(key, keys) for key in keys]
    assert said[:3] == ["share of attackers (attacks.0)", "share of attackers (attacks.1)", "model (trust)"]
    assert said[4] == "period (radio) [s]" and study_figure.label_of(keys[2]) == "model"
    assert short_keys(["attacks.0.share_p", "attacks.1.share_p", "trust.tau"]) == {
        "attacks.0.share_p": "attacks.0.share_p", "attacks.1.share_p": "attacks.1.share_p", "trust.tau": "tau",
    }  # fmt: skip
    of_others = ("driver.share_p", "sensing_groups.0.share_p", "parked.per_100_m")
    assert [*map(study_figure.label_of, of_others)] == ["share of such drivers", "share of the group", "per 100 m"]

    def value(metric, keys, replicate):
        return 2 + keys["attacks.0.share_p"] + 2 * keys["attacks.1.share_p"] + 0.01 * replicate

    study = study_of(tmp_path, ATTACKS, value=value)
    figure = study_figure.draw(study, "freshness", ["freshness.newest_evaluation_age.mean_s"])
    names = [figure.axes[0].get_xlabel(), *(text.get_text() for text in figure.legends[0].get_texts())]
    assert names == [
        "share of attackers (attacks.0)", "share of attackers (attacks.1) = 0", "share of attackers (attacks.1) = 0.1",
    ]  # fmt: skip


def test_what_has_no_counterpart_at_the_baseline_is_said(tmp_path):
    """Encounters within 50 m and within 100 m are groups of their own. Means that are all equal have no interval."""

    def value(metric, keys, replicate):
        return 5.0 if keys["encounters.0.radius_m"] == 50.0 else float("nan")

    swept = {"encounters.0.radius_m": (50.0, 100.0), "traffic.scale": (0.5, 1.0)}
    baseline = {"encounters.0.radius_m": 50.0}
    study = study_of(tmp_path, swept, value=value, baseline=baseline, measured=MEASURED[:1])
    path = tmp_path / "jobs" / "all" / "measures.parquet"
    near = pd.read_parquet(path)
    far = near.assign(point=near.point.replace({"0-": "2-", "1-": "3-"}, regex=True), group="equipped, 200 m")
    pd.concat([near, far]).to_parquet(path)
    name = MEASURED[0][0]
    (line,) = study_table.unpaired(study, [name])
    assert line.startswith("no difference at encounters.0.radius_m = 100: ") and line in study_report.page(study)
    assert study_table.unpaired(study, [name], {"encounters.0.radius_m": "50"}) == []
    assert study_table.cell(study.summary.iloc[0]) == "5 (each the same)"
    held = study_figure.draw(study, "encounters", where={"encounters.0.radius_m": 50.0})
    assert "50" in held.legends[0].get_texts()[0].get_text()


def test_the_definition_of_encounters_is_named_if_it_alone_has_a_value(tmp_path):
    """The median of one radius, and the number of another one, too."""
    measured = (MEASURED[0], ("encounters.n", "equipped, 200 m"))
    study = study_of(tmp_path, {"traffic.scale": (0.5, 1.0)}, measured=measured, value=lambda _, keys, r: 5.0 + r)
    figure = study_figure.draw(study, "encounters")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["at equipped, 100 m"]


def test_where_alone_a_metric_has_a_value_is_said_in_table_and_figure(tmp_path):
    """In no run with few vehicles had half of the encounters ended. The empty cell said that it does not matter."""

    def value(metric, keys, replicate):
        return np.nan if keys["fleet.penetration_p"] == 0.1 else 5.0 + replicate

    swept = {"trust.freshness_s": (2.0, 10.0), "fleet.penetration_p": (0.1, 0.3)}
    study = study_of(tmp_path, swept, value=value, measured=MEASURED[:1])
    extra = study_of(tmp_path / "other", swept, measured=MEASURED[1:2])
    study.measures = pd.concat([study.measures, extra.measures], ignore_index=True)
    table = study_table.pivot(study, study.summary, study_table.core(study))
    assert table["fleet.penetration_p"].tolist() == ["0.3", "0.1", "0.3"]
    figure = study_figure.draw(study, "encounters")
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["at penetration = 0.3 alone"]


def test_points_without_a_value_of_a_metric_are_points(tmp_path):
    """It was said that there are no points without attackers, or that the study had not measured the metric."""
    trust, auc = "trust.final.median", "misbehaviour.at_lookup.auc:malicious"
    measured = [(trust, "honest"), (trust, "malicious"), tuple(auc.split(":"))]

    def value(metric, keys, replicate):
        is_there = keys["attacks.0.share_p"] or next(groups) == "honest"
        return 0.5 + 0.1 * keys["fleet.penetration_p"] if is_there else np.nan

    swept, groups = {"fleet.penetration_p": (0.1, 0.3), "attacks.0.share_p": (0.0, 0.1)}, cycle(("honest", "malicious"))
    study = study_of(tmp_path, swept, value=value, baseline={"fleet.penetration_p": 0.1}, measured=measured)
    nobody = {"attacks.0.share_p": "0"}
    assert study_table.unpaired(study, [auc], nobody) == []
    (axes,) = study_figure.draw(study, "trust", where=nobody).axes
    assert axes.get_ylabel().replace("\n", " ") == "final trust, median, honest"
    with pytest.raises(ValueError, match=r"has no value of these metrics at attacks.0.share_p = 0\. It has some at 0"):
        study_figure.draw(study, "misbehaviour", where=nobody)
    with pytest.raises(ValueError, match=f"has no value of {auc} where others have one"):
        study_figure.draw(study, "", [f"{trust}:honest", auc], where=nobody)
    with pytest.raises(ValueError, match=r"no point has attacks.0.share_p = 0.7. There are 0, 0.1.$"):
        study_figure.draw(study, "trust", where={"attacks.0.share_p": "0.7"})


def test_ages_that_end_at_the_window_are_to_be_compared_at_equal_windows(tmp_path):
    """The table showed them side by side, with differences, and the definition says that they cannot be compared."""
    age = [("freshness.capped_age.mean_s", "all")]
    for key, n_lines in (("trust.freshness_s", 1), ("fleet.penetration_p", 0)):
        study = study_of(tmp_path / key, {key: (0.5, 1.0)}, value=lambda *_: 0.5, measured=age)
        assert len(study_table.cautions(study, study.summary, ["freshness.capped_age.mean_s"])) == n_lines


def test_keys_that_change_together_are_all_named(tmp_path):
    swept = {"trust.model": ("beta", "mate"), "trust.tau": (1.0, 2.0)}
    study = study_of(tmp_path, swept, value=lambda metric, keys, r: keys["trust.tau"] + 0.1 * r)
    study.points = study.points[(study.points["trust.model"] == "beta") == (study.points["trust.tau"] == 1)]
    assert study_table.together(study) == ["trust.tau changes with trust.model: 1 at beta, 2 at mate"]
    assert "trust.tau changes with trust.model: 1 at beta, 2 at mate" in study_report.page(study)


def test_the_key_of_the_colours_leaves_the_axis_to_another(tmp_path):
    """Alone, it was on the axis."""
    swept = {"fleet.penetration_p": (0.1, 0.3), "trust.freshness_s": (2.0, 10.0)}
    study = study_of(tmp_path, swept, measured=MEASURED[1:2])
    figure = study_figure.draw(study, "freshness", by="fleet.penetration_p")
    assert figure.axes[0].get_xlabel() == "window [s]"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["penetration = 0.1", "penetration = 0.3"]
    one = study_of(tmp_path / "one", {"fleet.penetration_p": (0.1, 0.3)}, measured=MEASURED[1:2])
    assert study_figure.draw(one, "freshness", by="fleet.penetration_p").axes[0].get_xlabel() == "penetration"


def test_keys_that_change_together_have_one_axis(tmp_path):
    """The radius had a colour for each place of the range on the axis, so that no line joined two points."""
    swept = {"radio.range_m": (50.0, 100.0), "encounters.0.radius_m": (50.0, 100.0), "trust.freshness_s": (2.0, 10.0)}

    def value(metric, keys, replicate):
        return keys["radio.range_m"] + keys["trust.freshness_s"] + replicate

    study = study_of(tmp_path, swept, value=value, measured=MEASURED[1:2])
    study.points = study.points[study.points["radio.range_m"] == study.points["encounters.0.radius_m"]]
    with_curves(study, lambda keys, r: [(value("", keys, r), 4, 1)], "ages")
    for over, x in ((None, "range [m]"), ("encounters.0.radius_m", "radius [m]")):
        (axes,) = study_figure.draw(study, "freshness", over=over).axes
        assert axes.get_xlabel() == x and [len(line.lines[0].get_xdata()) for line in axes.containers] == [2, 2]
        assert len(curve_figure.draw(study, "ages", by=over).axes) == 2


def test_curves_of_keys_without_each_combination(tmp_path):
    """As in a [[zip]]: of the second scale there is one penetration. Axis labels of panels leave the legend free."""
    swept = {"fleet.penetration_p": (0.1, 0.3), "traffic.scale": (0.5, 1.0)}
    study = study_of(tmp_path, swept)
    lone = (study.points["fleet.penetration_p"] == 0.3) & (study.points["traffic.scale"] == 1)
    study.points = study.points[~lone]
    with_curves(study, lambda keys, r: [(10 * keys["fleet.penetration_p"] + keys["traffic.scale"] + r, 4, 1)])
    figure = curve_figure.draw(study, "encounters")
    assert [len(axes.get_lines()) for axes in figure.axes] == [2, 1] and figure.get_supxlabel() == ""
    assert all(axes.get_xlabel().replace("\n", " ") == "Duration [s]" for axes in figure.axes)
