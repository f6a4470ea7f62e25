"""Summaries of studies: bounds, missing replicates."""

import pandas as pd
import pytest

from results.study import Study


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
    return Study(tmp_path, {"name": "s", "question": "", "keys": ["trust.host"], "baseline": {}}, points)


def test_intervals_stay_within_bounds_and_missing_replicates_are_said(study):
    """Student's t alone would give an AUC of up to 1.15 and a time from -62 s on."""
    found = study.summary.set_index("metric")
    auc, time = found.loc["misbehaviour.auc"], found.loc["misbehaviour.time_to_detection.median_s"]
    assert 0 < auc.low < auc["mean"] < auc.high < 1 and auc.note == ""
    assert 0 < time.low < time["mean"] < time.high
    assert time.note == "2 of 4 replicates have a value"
