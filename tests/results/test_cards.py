"""Descriptions of runs and studies, and the schema of the manifest."""

import json
from pathlib import Path

import pytest

from results import cards, durable
from results.manifest import STATUSES, read_manifest
from results.tables import SCHEMA_VERSION, TABLES
from tests.results import tiny

SCHEMA = json.loads((Path(__file__).parents[2] / "results" / "manifest.schema.json").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cards") / "run"
    folder.mkdir()
    trust = [{"step": 2, "variant": "base", "subject": 0, "trust": 0.25}]
    return tiny.make(folder, 6, {"seed": 7}, vehicles=tiny.fleet("honest", "malicious"), trust=trust)


def test_every_file_is_named_with_its_checksum(run, tmp_path):
    card, crate = cards.write(run, tmp_path, ["A. Author"], "https://spdx.org/licenses/CC-BY-4.0")
    found = {e["@id"]: e for e in json.loads(crate.read_text())["@graph"]}
    root = found["./"]
    files = [part["@id"] for part in root["hasPart"]]
    on_disk = {p.relative_to(run.path).as_posix() for p in run.path.rglob("*.parquet")}
    assert set(files) == on_disk | {"manifest.json"}
    assert all(found[name]["sha256"] == durable.sha256(run.path / name) for name in files)
    assert found[root["author"][0]["@id"]]["name"] == "A. Author"
    assert root["license"]["@id"] in found
    said = json.loads(card.read_text())
    trust = next(r for r in said["recordSet"] if r["name"] == "trust")
    columns = {f["source"]["extract"]["column"]: f for f in trust["field"]}
    assert columns.keys() == TABLES["trust"].stored.keys()
    assert columns["newest_evaluation_age_s"]["description"].endswith("[s]")
    assert columns["trust"]["dataType"] == "sc:Float" and columns["subject"]["dataType"] == "sc:Integer"


def test_mistakes(run, tmp_path):
    with pytest.raises(ValueError, match="--licence CC-BY: the address of a licence is wanted"):
        cards.write(run, tmp_path / "out", licence="CC-BY")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written"):
        cards.write(run, tmp_path / "file" / "out")


def valid(manifest):
    pytest.importorskip("jsonschema").validate(manifest, SCHEMA)


def test_the_schema_of_the_manifest(run):
    jsonschema = pytest.importorskip("jsonschema")
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    manifest = read_manifest(run.path)
    valid(manifest)
    assert SCHEMA["properties"]["schema_version"]["const"] == SCHEMA_VERSION, "raise both together"
    assert SCHEMA["$id"].endswith(f":{SCHEMA_VERSION}")
    assert tuple(SCHEMA["properties"]["status"]["enum"]) == STATUSES
    for key, wrong in (("dt_s", 0), ("steps", 1.5), ("status", "done"), ("variants", "base"), ("sha256", "x")):
        with pytest.raises(jsonschema.ValidationError):
            valid(manifest | {key: wrong})


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_card_by_mlcroissant(run):
    """Its validation has no error, and the records are those of the table."""
    mlcroissant = pytest.importorskip("mlcroissant")
    card, _ = cards.write(run, run.path)
    found = mlcroissant.Dataset(jsonld=card)
    assert not found.metadata.ctx.issues.errors
    rows = list(found.records("trust"))
    assert [row["trust/trust"] for row in rows] == run.trust.trust.tolist()


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_crate_by_rocrate(run):
    rocrate = pytest.importorskip("rocrate.rocrate")
    cards.write(run, run.path)
    found = rocrate.ROCrate(run.path)
    assert found.name == f"cosim run {run.path.name}" and found.datePublished
    files = {e.id for e in found.get_entities() if e.type == "File"}
    assert files == {part.id for part in found.root_dataset["hasPart"]} and "manifest.json" in files
    (action,) = [e for e in found.get_entities() if e.type == "CreateAction"]
    assert action["instrument"]["name"] == "cosim"
