"""Stages that are kept: their versions are raised when their content changes, and the cache keeps to its limit."""

import hashlib
import json
import os
from pathlib import Path

import pandas as pd
import pytest

from cosim.studies.plan import TRAFFIC_VERSION
from cosim.studies.stages import Cache
from tests.drive import python

GOLDEN = Path(__file__).parents[2] / "golden" / "traffic_stage.json"

DRIVE = """
import sys
from pathlib import Path
from cosim.config.config import load
from cosim.runs.run import record_traffic
record_traffic(load(None, ["traffic.duration_s=20", "traffic.warmup_s=60"]), Path(sys.argv[1]), lambda *_: None)
"""


def values_hash(folder):
    """Of the values of a table alone: names of tables and columns have a version of their own."""
    found = hashlib.sha256()
    for part in sorted(folder.glob("part-*.parquet")):
        found.update(pd.util.hash_pandas_object(pd.read_parquet(part), index=False).to_numpy().tobytes())
    return found.hexdigest()[:32]


def test_version_of_the_traffic_stage(tmp_path, update_golden):
    """Where this fails, the same `[traffic]` gives other traffic: raise TRAFFIC_VERSION, renew the golden tables."""
    python(DRIVE, str(tmp_path / "traffic"))
    tables = ("actors", "vehicles")
    now = {"version": TRAFFIC_VERSION} | {name: values_hash(tmp_path / "traffic" / name) for name in tables}
    if update_golden:
        GOLDEN.write_text(json.dumps(now, indent=1) + "\n")
    assert json.loads(GOLDEN.read_text()) == now


def entry(folder, name, size, used_s):
    path = folder / "traffic" / name
    path.mkdir(parents=True)
    (path / "data").write_bytes(b"x" * size)
    (path / "stage.json").write_text(json.dumps({"files": {}, "seconds": 1.0}))
    os.utime(path / "stage.json", (used_s, used_s))


def test_what_was_used_longest_ago_goes_first(tmp_path):
    for number, name in enumerate(("old", "middle", "new")):
        entry(tmp_path, name, 1_000_000, 1_000_000 + number)
    cache = Cache(tmp_path)
    assert [e.name for e in cache.entries()] == ["new", "middle", "old"]
    assert [e.name for e in cache.shrink(2.1e-3, set())] == ["old"]
    assert [e.name for e in cache.shrink(1.1e-3, {"middle"})] == []
    assert [e.name for e in cache.shrink(0.0, set())] == ["new", "middle"] and not cache.entries()


@pytest.mark.parametrize("text", ["[]", '{"files": {}, "seconds": [1]}', "\ufffd", "[" * 5000])
def test_an_entry_that_is_damaged_is_listed_and_deleted(tmp_path, text):
    entry(tmp_path, "odd", 1000, 1_000_000)
    (tmp_path / "traffic" / "odd" / "stage.json").write_text(text)
    assert [e.seconds for e in Cache(tmp_path).entries()] == [0.0]
    assert len(Cache(tmp_path).shrink(0.0, set())) == 1 and not Cache(tmp_path).entries()


def test_an_entry_that_is_being_made_is_none(tmp_path):
    unfinished = tmp_path / "traffic" / "name.partial"
    unfinished.mkdir(parents=True)
    (unfinished / "stage.json").write_text("{}")
    assert not Cache(tmp_path).entries()
    assert not Cache(tmp_path).shrink(0.0, set()) and unfinished.is_dir()
