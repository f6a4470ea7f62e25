"""Study folders whose files say something else than a sweep writes: one line each, that names the file."""

import json
import os

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.base.durable import PARTIAL, Damaged
from cosim.cli.studies import measure
from cosim.studies import worker
from cosim.studies.folder import StudyFolder, status_of
from cosim.studies.sweep import status
from results.study import missing_in, open_study, runs_of
from results.study_measuring import SUMS, write_measured
from tests.results import tiny

HEAD = {"name": "s", "question": "", "keys": ["trust.host"], "baseline": {}}
POINT = {"point": "a", "run": "a", "variant": "base", "replicate": 0, "state": "finished", "trust.host": "local"}
CURVE = {"point": "a", "what": "ages", "group": "all", "value_s": 1.0, "n": 4, "n_open": 0}
ROW = {"point": "a", "metric": "radio.pdr.all", "group": "", "value": 1.0, "unit": "1", "label": "x"}


@pytest.mark.parametrize("text", ["", "[]", "1", "{}", '{"members": 3}', '{"members": {"a": 1}}', "[" * 5000])
def test_a_job(tmp_path, text):
    folder = StudyFolder(tmp_path)
    folder.job("a").mkdir(parents=True)
    (folder.job("a") / "job.json").write_text(text)
    with pytest.raises(Damaged, match=r"jobs/a/job.json is damaged \([^\n]*\). Sweep the study in another --out.$"):
        folder.answers()


@pytest.mark.parametrize("text", ["", "3", "[3]", '[{"outcome": "ok"}]', '[{"no": 1}]', "null"])
def test_attempts_and_a_manifest(tmp_path, text):
    folder = StudyFolder(tmp_path)
    folder.job("a").mkdir(parents=True)
    (folder.job("a") / "attempts.json").write_text(text)
    with pytest.raises(Damaged, match=r"attempts.json is damaged"):
        folder.attempts("a")
    (tmp_path / "manifest.json").write_text(text)
    assert status_of(tmp_path) == ""


def test_a_point_has_the_state_of_the_run_that_was_planned_last(tmp_path):
    """After an own metric had been added, its failure was hidden by an earlier run without it, of a name before."""
    folder = StudyFolder(tmp_path)
    for when, id in enumerate(("a", "b")):
        folder.job(id).mkdir(parents=True)
        job = folder.job(id) / "job.json"
        job.write_text('{"members": {"p": "base"}}')
        os.utime(job, ns=(when, when))
    assert folder.answers() == {"p": ("b", "base")}


def study(folder, head=HEAD, point=POINT, row=ROW):
    """A study of one point."""
    (folder / "jobs" / "a").mkdir(parents=True)
    table = pa.Table.from_pandas(pd.DataFrame([point]), preserve_index=False)
    pq.write_table(table.replace_schema_metadata({"study": json.dumps(head)}), folder / "index.parquet")
    pd.DataFrame([row]).to_parquet(folder / "jobs" / "a" / "measures.parquet", index=False)
    return open_study(folder)


def test_a_study_without_mistakes(tmp_path):
    assert study(tmp_path / "s").summary["mean"].tolist() == [1.0]


@pytest.mark.parametrize(
    "changed",
    [
        {"head": 3}, {"head": HEAD | {"name": 3}}, {"head": HEAD | {"keys": "trust.host"}},
        {"head": HEAD | {"keys": [3]}},
        {"head": HEAD | {"baseline": {"lidar.profile": 1}}}, {"point": POINT | {"run": "../../etc"}},
        {"point": POINT | {"run": 3}}, {"point": POINT | {"replicate": "x"}}, {"point": {"point": "a"}},
    ],
)  # fmt: skip
def test_an_index(tmp_path, changed):
    with pytest.raises(ValueError, match=r"index.parquet is damaged \([^\n]*\). `cosim status"):
        study(tmp_path / "s", **changed)


def test_a_study_in_which_nothing_can_be_written(tmp_path, capsys):
    """The folder of somebody else, or a full disk: here, folders have the names of files that are being written."""
    study(tmp_path)
    (tmp_path / "study.toml").write_text('[grid]\ntrust.host = ["local"]\n')
    for name in ("measures.parquet", f"index.parquet.{os.getpid()}"):
        (tmp_path / (name + PARTIAL)).mkdir()
    index = (tmp_path / "index.parquet").read_bytes()
    measure(tmp_path, ["radio.pdr.all"], as_json=False, csv=tmp_path / "means.csv")
    assert "measures.parquet cannot be written: Is a directory." in capsys.readouterr().err
    assert "radio.pdr.all" in (tmp_path / "means.csv").read_text()
    _, states, _ = status(StudyFolder(tmp_path))
    assert states == {"finished": 0, "failed": 0, "unfinished": 0, "waiting": 1}
    assert (tmp_path / "index.parquet").read_bytes() == index


@pytest.mark.parametrize("row", [{"point": "a"}, ROW | {"value": "x"}, ROW | {"metric": 3}, ROW | {"unit": None}])
def test_measures(tmp_path, row):
    with pytest.raises(Damaged, match=r"measures.parquet is damaged \([^\n]*\). Sweep the study in another --out.$"):
        _ = study(tmp_path / "s", row=row).measures


def test_metrics_that_were_changed_after_the_run_was_measured(tmp_path):
    """Each row twice counted as two replicates, at n = 2, and `cosim verify` called a cut file whole."""
    folder, job = study(tmp_path).path, tmp_path / "jobs" / "a"
    (folder / "runs" / "a").mkdir(parents=True)
    (folder / "runs" / "a" / "manifest.json").touch()
    table, curves = pd.DataFrame([ROW]), pd.DataFrame([CURVE])
    write_measured(job, {"curves.parquet": curves, "measures.parquet": table})
    whole = (job / "measures.parquet").read_bytes()
    found = open_study(folder)
    assert missing_in(folder) == []
    assert found.summary.n.tolist() == [1] and found.curves.n.tolist() == [4]
    pd.concat([table, table]).to_parquet(job / "measures.parquet", index=False)
    (job / "curves.parquet").unlink()
    for name in ("measures", "curves"):
        with pytest.raises(Damaged, match=r"a: curves.parquet, measures.parquet changed after .* measures it again.$"):
            getattr(open_study(folder), name)
    (job / "measures.parquet").write_bytes(whole[:-9])
    said = "changed after the run was measured"
    assert missing_in(folder) == [f"jobs/a/curves.parquet {said}", f"jobs/a/measures.parquet {said}"]
    (job / SUMS).write_text("[")
    assert missing_in(folder) == [f"jobs/a/{SUMS} {said}"]


def test_a_run_that_finished_in_a_sweep_that_was_killed(tmp_path):
    """The index was that of the sweep's beginning: the report showed values of "1 waiting" point, and `verify` did not
    see what was missing of it."""
    folder = study(tmp_path, point=POINT | {"state": "waiting"}).path
    run = folder / "runs" / "a"
    run.mkdir(parents=True)
    assert open_study(folder).points.state.tolist() == ["waiting"]
    (run / "manifest.json").touch()
    assert open_study(folder).points.state.tolist() == ["finished"]


def test_a_kill_between_measuring_and_dropping_tables(tmp_path, monkeypatch):
    """The run counted as measured, nobody came back to it, and it kept all its tables."""

    def kill(*_):
        raise KeyboardInterrupt

    folder, job = StudyFolder(tmp_path), tmp_path / "jobs" / "a"
    job.mkdir(parents=True)
    folder.run("a").mkdir(parents=True)
    tiny.make(folder.run("a"), 2, vehicles=tiny.fleet("honest"))
    asked = {"id": "a", "members": {"p": "base"}, "topics": ["traffic"], "measure": {}, "tables": ["vehicles"]}
    (job / "job.json").write_text(json.dumps(asked))
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(worker, "_drop", kill)
        worker.make(job)
    assert not folder.is_finished("a")
    worker.make(job)
    assert folder.is_finished("a") and not (folder.run("a") / "actors").exists()


def test_what_is_missing_of_finished_points(tmp_path):
    """A study of which a copy lacked a run was called whole, and a folder without a manifest ended `cosim verify`."""
    folder = study(tmp_path).path
    run = folder / "runs" / "a"
    run.mkdir(parents=True)
    assert runs_of(folder) == [] and missing_in(folder) == ["runs/a/manifest.json is missing"]
    (run / "manifest.json").touch()
    assert runs_of(folder) == [run] and missing_in(folder) == []
    (folder / "jobs" / "a" / "measures.parquet").unlink()
    assert missing_in(folder) == ["jobs/a/measures.parquet is missing"]
