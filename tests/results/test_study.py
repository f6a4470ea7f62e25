"""Summaries of studies: bounds, missing replicates."""

import pandas as pd
import pytest

from results.study import StudyResults, held_at, short_names, with_short_names


@pytest.fixture
def study(tmp_path):
    """One point of four replicates: an AUC near 1, and a median that two reached."""
    points = pd.DataFrame([
        {"point": str(r), "run": "all", "variant": "base", "replicate": r, "trust.host": "central"} for r in range(4)
    ])  # fmt: skip
    rows = [(str(r), "misbehaviour.auc", "malicious", x, "1") for r, x in enumerate((0.99, 0.98, 0.7, 1.0))]
    rows += [(str(r), "misbehaviour.time_to_detection.median_s", "malicious", x, "s") for r, x in ((0, 2.0), (1, 13.0))]
    (tmp_path / "jobs" / "all").mkdir(parents=True)
    table = pd.DataFrame(rows, columns=["point", "metric", "group", "value", "unit"]).assign(label="")
    table.to_parquet(tmp_path / "jobs" / "all" / "measures.parquet")
    return StudyResults(tmp_path, {"name": "s", "question": "", "keys": ["trust.host"], "baseline": {}}, points)


def test_intervals_stay_within_bounds_and_missing_replicates_are_said(study):
    """Student's t alone would give an AUC of up to 1.15 and a time from -62 s on."""
    found = study.summary.set_index("metric")
    auc, time = found.loc["misbehaviour.auc"], found.loc["misbehaviour.time_to_detection.median_s"]
    assert 0 < auc.low < auc["mean"] < auc.high < 1 and auc.note == ""
    assert 0 < time.low < time["mean"] < time.high
    assert time.note == "2 of 4 replicates have a value"


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
