"""Studies whose measuring changes after runs have finished, and metrics of a user's own in them."""

import shutil

import numpy as np
import pandas as pd
import pytest

from cosim.studies import sweep as sweeping
from results.own_metrics import check_own
from results.study import open_study
from tests import drive

STUDY = """
[study]
name = "short"
[base]
sensing = false
traffic.warmup_s = 60
traffic.duration_s = 8
traffic.step_s = 1.0
compute.threads = 1
[grid]
fleet.penetration_p = [0.4, 0.6]
[keep]
topics = ["encounters"]
[measure]
own = "own.py:metrics"
"""

OWN = """
import numpy as np
import pandas as pd


def metrics(run):
    return pd.DataFrame({"metric": ["mine.x"], "group": "", "value": 1.0, "unit": "s", "label": "x"})
"""


def sweep(folder, study=STUDY, own=OWN):
    (folder / "short.toml").write_text(study)
    (folder / "own.py").write_text(own)
    done = drive.cosim("sweep", "short.toml", "--out", "out", cwd=folder, COSIM_CACHE=str(folder / "cache"))
    return done, {file: file.stat().st_mtime_ns for file in folder.glob("out/runs/*/manifest.json")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with the study and its two finished runs, for copies."""
    folder = tmp_path_factory.mktemp("finished")
    done, _ = sweep(folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def folder(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "study")


def means(folder):
    summary = open_study(folder / "out").summary
    return summary[summary.metric == "mine.x"]["mean"].tolist()


@pytest.mark.verify
def test_finished_runs_follow_a_changed_measuring(folder):
    """Code of the user's own, then a topic: the same runs are measured again. Without tables they are made again."""
    _, first = sweep(folder)
    assert means(folder) == [1, 1]
    done, again = sweep(folder, own=OWN.replace("1.0", "60.0"))
    assert "note: 2 finished runs were measured before the code of measure.own changed." in done.stderr
    assert again == first and means(folder) == [60, 60]
    more = STUDY.replace('["encounters"]', '["encounters", "traffic"]\ntables = ["encounters"]')
    done, again = sweep(folder, more)
    assert "measured before keep.topics, the code of measure.own changed." in done.stderr
    measured = set(open_study(folder / "out").measures.metric)
    assert any(name.startswith("traffic.") for name in measured) and means(folder) == [1, 1]
    done, last = sweep(folder, more.replace("[measure]", "[measure]\nfresh_s = 3"))
    assert "measured before measure.fresh_s changed." in done.stderr
    assert set(open_study(folder / "out").measures.metric) == measured
    assert last.keys() == again.keys() and all(last[file] > again[file] for file in last)


@pytest.mark.verify
def test_runs_of_other_code_are_noted_where_further_ones_join_them(folder, monkeypatch):
    study, out = folder / "short.toml", folder / "out"
    assert not sweeping.measuring_notes(sweeping.prepare(study, out))
    monkeypatch.setattr(sweeping, "code_digest", lambda: "an update")
    assert not sweeping.measuring_notes(sweeping.prepare(study, out)), "nothing joins them"
    study.write_text(STUDY.replace("[0.4, 0.6]", "[0.4, 0.6, 0.8]"))
    (note,) = sweeping.measuring_notes(sweeping.prepare(study, out))
    assert note.startswith("note: 2 finished runs were made by other code of cosim.")
    monkeypatch.undo()
    study.write_text(STUDY.replace("sensing = false", 'sensing = false\nrecord.level = "full"'))
    (note,) = sweeping.measuring_notes(sweeping.prepare(study, out))
    assert note.startswith('note: finished runs were recorded with record.level = "')
    study.write_text(STUDY.replace("[0.4, 0.6]", "[0.6, 0.8]"))
    (note,) = sweeping.measuring_notes(sweeping.prepare(study, out))
    assert note.startswith("note: 1 finished runs are of no point of the study any more:")


@pytest.mark.verify
def test_runs_that_were_measured_otherwise_are_not_averaged(folder):
    """A folder of an earlier version, which measured the second run with other code."""
    job = next(folder.glob("out/jobs/*/job.json"))
    job.write_text(job.read_text().replace('"fresh_s": 10.0', '"fresh_s": 3.0'))
    with pytest.raises(ValueError, match=r"out: measure.fresh_s changed after some runs were measured"):
        open_study(folder / "out").measures  # noqa: B018


@pytest.mark.verify
def test_metrics_that_were_changed_are_measured_again(folder):
    """Cut off, as by a download that ended early: `cosim sweep` had nothing to make."""
    _, first = sweep(folder)
    path = next(folder.glob("out/jobs/*/measures.parquet"))
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    done, again = sweep(folder)
    assert "note: 1 finished runs were measured before measures.parquet changed." in done.stderr
    assert again == first and path.read_bytes() == whole


def table(*rows, value=1.0):
    return pd.DataFrame(rows, columns=["metric", "group"]).assign(value=value, unit="s", label="")


def test_rows_of_own_metrics_are_not_taken_for_replicates_nor_for_metrics_of_cosim():
    right = table(("mine.x", "cars"), ("mine.x", "buses"), ("mine.y", ""))
    assert check_own(right.assign(replicate=7), "own")[[*right]].equals(right), "no further columns"
    with pytest.raises(ValueError, match=r"^own: 2 rows of mine.x in one run would count as replicates\. "):
        check_own(table(("mine.x", ""), ("mine.x", "")), "own")
    with pytest.raises(ValueError, match=r'^own: 2 rows of mine.x and group "cars" in one run '):
        check_own(table(("mine.x", "cars"), ("mine.x", "cars")), "own")
    with pytest.raises(ValueError, match=r"^own: encounters.n is a metric that cosim has\. Give yours another name\.$"):
        check_own(table(("encounters.n", "equipped, 100 m")), "own")


def test_own_metrics_that_are_no_table_of_numbers_and_texts_are_refused_before_they_are_stored():
    """A text or a missing group was stored, and then called damage of the study's folder; a None was a traceback."""
    for returned in (None, [("mine.x", 1.0)], table(("mine.x", "")).drop(columns="group")):
        with pytest.raises(
            ValueError, match=r"^own: it must return a DataFrame with the columns metric, value, group,"
        ):
            check_own(returned, "own")
    for value in ("3.0", None, True, np.inf, 10**400, 1e300):
        with pytest.raises(ValueError, match=r"^own: value = .* is no number of at most 1e\+100 in size\. Return NaN"):
            check_own(table(("mine.x", ""), value=value), "own")
    with pytest.raises(ValueError, match=r"^own: a value of metric, group, unit, label is no text\."):
        check_own(table(("mine.x", np.nan)), "own")
    assert check_own(table(("mine.x", ""), value=np.nan), "own").value.isna().all()
    assert check_own(table(), "own").empty
