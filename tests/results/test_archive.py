"""Opening runs: typed tables, and one clear line for what cannot be opened."""

import shutil

import numpy as np
import pandas as pd
import pyarrow.compute as pc
import pytest

from cosim.base.durable import Damaged
from results.archive import open_run
from results.manifest import read_manifest, write_manifest
from results.measure import measure
from results.run import Run
from results.tables import TABLES
from tests.hostile.shared import reseal_inventory
from tests.results.synthetic import write

EMPTY = (
    "encounter_trust", "reactions", "dropped_detections", "evidence", "fused_evidence", "early_fused", "clouds",
    "transmitted_evaluations", "stated_accuracies",
    "transmitted_scores", "attack_outcomes", "lookup_totals", "position_errors", "tracks", "cpm_content",
)  # fmt: skip
"""Tables without rows in a run with one trust variant, no driver and no tracking."""


@pytest.fixture
def broken(tmp_path):
    """A short run to spoil."""
    return write(tmp_path / "broken", steps=20, level="standard")


def test_tables_are_typed(run):
    for name in TABLES:
        frame = run.table(name)
        assert list(frame.columns) == list(TABLES[name].columns)
        assert len(frame) or name in EMPTY, name
        for label, column in TABLES[name].columns.items():
            dtype = frame[label].dtype
            if column.categories:
                assert tuple(dtype.categories) == column.categories
            elif column.type in ("int16", "int32", "bool") and column.null:
                assert isinstance(dtype, (pd.Int16Dtype, pd.Int32Dtype, pd.BooleanDtype))
            elif column.type != "string":
                assert dtype == column.type, (name, label)


def test_columns_rows_and_parts_on_demand(run):
    assert list(run.table("fused", ["score", "step"]).columns) == ["score", "step"]
    late = run.table("trust", where=pc.field("step") >= 200)
    assert late.step.min() >= 200 and len(late) == (run.trust.step >= 200).sum()
    assert sum(len(part) for part in run.parts("trust_lookups", ["age_s"])) == len(run.trust_lookups)
    assert np.shares_memory(run.trust.step.to_numpy(), run.trust.step.to_numpy())  # loaded once


def test_another_working_directory_is_no_damage(broken, monkeypatch):
    """Tables are read when they are used; a program that changed its directory was told that its run is damaged."""
    monkeypatch.chdir(broken)
    run = open_run(".")
    monkeypatch.chdir(broken.parent)
    assert len(run.as_variant("base").trust) == run.sql("SELECT count(*) AS n FROM trust").n.item()
    assert run.name == "broken" and run.status == "finished"


def test_roles(run):
    assert run.roles.value_counts().to_dict() == {"honest": 23, "malicious": 4, "unreliable": 3}
    said = repr(run).replace(str(run.path), "")
    assert "60" not in said and "240 steps" in said


def complaint(path, **options):
    with pytest.raises(ValueError) as caught:
        open_run(path, **options)
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_not_a_run(tmp_path, broken):
    assert "is not a folder" in complaint(tmp_path / "nowhere")
    assert "holds no manifest.json" in complaint(tmp_path)
    (broken / "manifest.json").write_text("{")
    assert "manifest.json is damaged" in complaint(broken)


def test_unfinished_and_foreign_runs(broken):
    manifest = read_manifest(broken)
    write_manifest(broken, manifest | {"status": "running"})
    assert "cosim resume" in complaint(broken) and '"killed"' in complaint(broken)
    run = open_run(broken, unfinished=True)
    assert len(run.actors) and ", killed: 20 steps" in repr(run)


@pytest.mark.parametrize(
    ("source", "reader"),
    [
        ({"version": "0.2.0", "commit": "0123abcd"}, "Read it with cosim 0.2.0, commit 0123abcd, or run again."),
        ({"version": "0.2.0\n", "commit": 3}, "Read it with the cosim that wrote it, or run again."),
        ([], "Read it with the cosim that wrote it, or run again."),
    ],
)
def test_a_run_of_another_schema_names_its_reader(broken, source, reader):
    write_manifest(broken, read_manifest(broken) | {"schema_version": 7, "source": source})
    found = complaint(broken)
    assert "schema version 7" in found and found.endswith(reader)


def test_an_edited_manifest_is_found(broken):
    text = (broken / "manifest.json").read_text()
    (broken / "manifest.json").write_text(text.replace('"steps": 20', '"steps": 10'))
    assert "its checksum differs" in complaint(broken)


def test_missing_tables_and_columns(broken):
    run = open_run(broken)
    with pytest.raises(ValueError, match=r'no table receptions: it is kept at record.level = "full"'):
        run.table("receptions")
    with pytest.raises(ValueError, match="There is no table 'delivery'"):
        run.table("delivery")
    with pytest.raises(ValueError, match="Table trust has no column trst"):
        run.table("trust", ["trst"])
    with pytest.raises(ValueError, match=r"columns = 'trust' should be a list of names, such as \['trust'\]"):
        run.table("trust", "trust")
    with pytest.raises(ValueError, match=r"columns = \['step', 'step'\] of table trust should name each column once"):
        run.table("trust", ["step", "step"])
    with pytest.raises(ValueError, match=r"columns = 3 should be a list of names, such as \['step'\]"):
        run.table("trust", 3)
    with pytest.raises(AttributeError):
        run.delivery.head()


def test_what_a_user_changes_in_a_frame_changes_no_metric(broken):
    """Frames were those that metrics read from."""
    run = open_run(broken)
    before = run.measure(topics=["traffic", "trust"])
    subjects, vehicles, values = run.subjects, run.vehicles, run.measure.trust.server_values()
    subjects["role"], vehicles["equipped"], values["trust"] = "malicious", False, 0.0
    run.config["trust"]["suspect_below"] = 0.9
    pd.testing.assert_frame_equal(run.measure(topics=["traffic", "trust"]), before)
    assert run.vehicles.equipped.any()


def test_a_run_lists_its_tables_for_completion(run):
    assert {"trust", "encounters", "measure"} <= set(dir(run))


def test_names_of_columns_may_come_from_a_generator(run):
    """It was read twice, and the table came without a row."""
    names = ["trust", "step"]
    pd.testing.assert_frame_equal(run.table("trust", (name for name in names)), run.trust[names])


@pytest.mark.parametrize("where", [pc.field("trst") > 0.5, pc.field("trust") > "high", "trust > 0.5"])
def test_a_condition_that_cannot_be_met_is_no_damage(run, where):
    with pytest.raises(ValueError, match="where is no condition on rows of table trust") as caught:
        run.table("trust", ["trust"], where)
    assert not isinstance(caught.value, Damaged) and not run.damage


@pytest.mark.parametrize("harm", ["truncated", "overwritten"])
def test_damaged_file_is_named(broken, harm):
    path = broken / "trust" / "part-00000.parquet"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] if harm == "truncated" else b"PAR1" + bytes(len(data) - 8) + b"PAR1")
    with pytest.raises(ValueError, match=r"trust/part-00000\.parquet (has|is not what was written)"):
        open_run(broken).trust.head()


def test_measure_says_what_it_cannot(broken):
    shutil.rmtree(broken / "observability")
    for part in (broken / "encounters").iterdir():
        part.unlink()
    numbers = measure(open_run(broken)).set_index("metric")
    assert "observability/part-00000.parquet is missing" in numbers.group["detection.not_measured"]
    assert "encounters/part-00000.parquet is missing" in numbers.group["encounters.not_measured"]
    assert "radio.not_measured" not in numbers.index


def test_a_table_that_an_earlier_cosim_did_not_have(broken):
    """Its folder, its files in the inventory and its line in the manifest are not there, and all else is read."""

    def forget(lines):
        for line in lines:
            line["parts"] = [part for part in line["parts"] if part["table"] != "tracks"]

    reseal_inventory(broken, forget)
    manifest = read_manifest(broken)
    manifest["config"]["record"] = {"level": "standard"}
    manifest["inventory"]["tables"].pop("tracks", None)
    shutil.rmtree(broken / "tracks", ignore_errors=True)
    before = Run(broken, manifest)
    with pytest.raises(ValueError, match="holds no table tracks: an earlier cosim wrote the run"):
        before.table("tracks")
    assert "tracks" not in before.tables and len(before.detections)
