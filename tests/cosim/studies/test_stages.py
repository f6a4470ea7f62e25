"""Stages that are kept: the cache keeps to its limit, and other code has a stage of its own."""

import json
import os

import pytest

from cosim.config.config import load
from cosim.studies import points
from cosim.studies.stages import Cache


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


def test_traffic_that_other_code_recorded_is_not_replayed(monkeypatch):
    config = load(None, [])
    before = points.traffic_identity(config)
    assert points.traffic_identity(config) == before
    monkeypatch.setattr(points, "code_digest", lambda: "that of an update")
    assert points.traffic_identity(config) != before
