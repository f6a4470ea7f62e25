"""The schema of the manifest."""

import json
from pathlib import Path

import pytest

from results.manifest import STATUSES, read_manifest
from results.tables import SCHEMA_VERSION
from tests.results import tiny

SCHEMA = json.loads((Path(__file__).parents[2] / "results" / "manifest.schema.json").read_text())


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("manifest") / "run"
    folder.mkdir()
    return tiny.make(folder, 6, {"seed": 7})


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
