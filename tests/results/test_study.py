"""Summaries of studies: bounds, missing replicates."""

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from results import study_notes, study_table
from results.archive import open_run
from results.measure import MeasuredRow, _note
from results.metrics.registry import METRICS
from results.study import held_at, short_names, with_short_names
from tests.results.test_study_pages import study_of


@pytest.fixture
def study(tmp_path):
    """One point of four replicates: an AUC near 1, and a median that two reached."""
    values = {
        "misbehaviour.auc": (0.99, 0.98, 0.7, 1.0),
        "misbehaviour.time_to_detection.median_s": (2.0, 13.0, math.nan, math.nan),
    }
    measured = [(metric, "malicious") for metric in values]
    return study_of(
        tmp_path, {"trust.host": ("central",)}, 4, lambda metric, keys, r: values[metric][r], measured=measured
    )


def test_another_working_directory_and_what_opens_a_study(tmp_path, monkeypatch):
    """A study opened by a relative path had 'no finished run yet' after the directory changed."""
    monkeypatch.chdir(tmp_path)
    Path("study").mkdir()
    study = study_of(Path("study"), {"trust.host": ("central",)}, 2, lambda *_: 0.5)
    monkeypatch.chdir("/")
    assert len(study.at({"trust.host": "central"}).measures) == len(study.measures) > 0
    (tmp_path / "index.parquet").touch()
    with pytest.raises(ValueError, match="is a study, not a run"):
        open_run(tmp_path)


def test_intervals_stay_within_bounds_and_missing_replicates_are_said(study):
    """Student's t alone would give an AUC of up to 1.15 and a time from -62 s on."""
    found = study.summary.set_index("metric")
    auc, time = found.loc["misbehaviour.auc"], found.loc["misbehaviour.time_to_detection.median_s"]
    assert 0 < auc.low < auc["mean"] < auc.high < 1 and auc.note == ""
    assert 0 < time.low < time["mean"] < time.high
    assert time.note == "2 of 4 replicates have a value"


def test_means_of_few_subjects_are_said(study):
    """An AUC of one or two attackers in three of four runs, and a time of one attacker in both runs that have one."""
    path = study.path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    n_units = [1, 1, 2, 1, 12, 2]
    rows = map(MeasuredRow, found.metric, found.group, found.value, found.value, found.value, n_units)
    notes = list(map(_note, rows))
    found.assign(note=notes).to_parquet(path)
    auc, time = study.summary.note
    assert auc == "few vehicles: 1 to 2 in most runs"
    assert time == "2 of 4 replicates have a value; few vehicles: 1 per run"
    assert [study_table.cell(row).endswith("n = 2") for row in study.summary.to_dict("records")] == [False, True]
    (line,) = study_table.cautions(study, study.summary, ["misbehaviour.auc"])
    assert line == "few vehicles (1 to 2 in a run), read as examples: misbehaviour.auc:malicious"


def test_a_role_that_has_not_attacked_is_said(study):
    """In two of the four runs no malicious vehicle has attacked."""
    path = study.path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    is_auc = found.metric == "misbehaviour.auc"
    found["note"] = np.where(is_auc & (is_auc.cumsum() <= 2), "has not attacked", "")
    found.to_parquet(path)
    assert study.summary.note[0] == "has not attacked in 2 of 4 runs"
    (line,) = study_table.cautions(study, study.summary, ["misbehaviour.auc"])
    said = "in some runs vehicles have not attacked, and behave as honest ones"
    assert line == f"{said}: misbehaviour.auc:malicious"


def test_labels_are_words_and_those_of_today(study):
    """A run that an earlier version measured is not apart from its replicates, whose metric has another label now."""
    names = [name for name, metric in METRICS.items() if "_" in metric.label]
    assert not names
    path = study.path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    found.assign(label=["earlier words", *found.label[1:]]).to_parquet(path)
    assert study.summary.n.tolist() == [4, 2]


def test_a_metric_of_ones_own_that_is_not_defined_has_no_mean(study):
    """A function may return NaN, for all replicates or for some."""
    path = study.path / "jobs" / "all" / "measures.parquet"
    found = pd.read_parquet(path)
    of_auc = found.metric == "misbehaviour.auc"
    found.assign(value=found.value.where(~of_auc)).to_parquet(path)
    assert study.summary.metric.tolist() == ["misbehaviour.time_to_detection.median_s"]


def test_points_with_few_subjects_are_said_in_short():
    """Town at both penetrations, the city at 10 % alone, whatever the window."""
    at = [(city, p, w) for city in ("city", "town") for p in ("10 %", "30 %") for w in "ab"]
    frame = pd.DataFrame(at, columns=["city", "p", "window"]).assign(metric="auc")
    frame["note"] = ["few vehicles: 3 per run"] * 2 + [""] * 2 + ["few vehicles: 2 to 4 in most runs"] * 4
    (line,) = study_notes.lines(frame, ["city", "p", "window"])
    places = "city, 10 %; town, 10 %; town, 30 %"
    assert line == f"few vehicles (2 to 4 in a run), read as examples: auc, at {places}"


CITIES = [
    "helsinki",
    "/home/me/nets/alpha/street.sumocfg",
    "/home/me/nets/beta/street.sumocfg",
    "/home/me/g.net.xml",
]


def test_files_have_the_shortest_names_that_tell_them_apart():
    assert short_names(CITIES[:2]) == {CITIES[0]: "helsinki", CITIES[1]: "street"}
    assert list(short_names(CITIES).values()) == [
        "helsinki", "alpha/street.sumocfg", "beta/street.sumocfg", "me/g.net.xml",
    ]  # fmt: skip
    assert list(short_names(["/a/mine.py:One", "/a/mine.py:Two", "beta"]).values()) == [
        "mine.py:One", "mine.py:Two", "beta",
    ]  # fmt: skip
    assert short_names([5.0, 0.25, True]) == {5.0: "5", 0.25: "0.25", True: "True"}
    runs = ["/home/me/bologna/run.sumocfg", "/home/me/town", "helsinki"]  # a common word says nothing
    assert list(short_names(runs).values()) == ["bologna", "town", "helsinki"]
    both = ["/home/me/street.csv", "street"]
    assert list(short_names(both).values()) == ["street.csv", "street"]


def test_points_are_chosen_by_numbers_words_and_short_names():
    """The column of a key with numbers and words is text, as `index.parquet` holds it."""
    frame = pd.DataFrame({
        "freshness": [5.0, 20.0, 20.0], "mixed": ["off", "20", "5.5"], "scenario": CITIES[:3],
        "on": [True, False, True],
    })  # fmt: skip
    for key, text, rows in (
        ("freshness", "20", [1, 2]), ("freshness", "20.0", [1, 2]), ("freshness", "2e1", [1, 2]),
        ("mixed", "20.0", [1]),
        ("mixed", "off", [0]), ("mixed", "5.5", [2]), ("scenario", "helsinki", [0]), ("scenario", CITIES[2], [2]),
        ("scenario", "beta/street.sumocfg", [2]), ("on", "true", [0, 2]), ("on", "False", [1]),
    ):  # fmt: skip
        assert held_at(frame, key, text).index.tolist() == rows, (key, text)
    with pytest.raises(ValueError, match=r"^no point has freshness = 21. There are 5, 20.$"):
        held_at(frame, "freshness", "21")
    with pytest.raises(ValueError, match=r"There are helsinki, alpha/street.sumocfg, beta/street.sumocfg.$"):
        held_at(frame, "scenario", "gamma")
    assert with_short_names(frame, ["freshness", "scenario"]).scenario[2] == "beta/street.sumocfg"
