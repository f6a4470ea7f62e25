import json
import os
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from cosim.benchmark import card, record
from cosim.benchmark.evidence import MANIFEST, SHIPPED, TABLES, Place, load
from tests.cosim.benchmark.worlds import RULES, stream, tiny_set


def same(one, other):
    return all(
        np.array_equal(getattr(one, name)[column], getattr(other, name)[column])
        for name in TABLES for column in TABLES[name].columns
    )  # fmt: skip


def test_a_case_comes_back_from_what_differs():
    """Law: base and difference together are the case."""
    for world in range(3):
        for case, name in enumerate(RULES.cases):
            assert same(tiny_set().stream(world, case), stream(name, world))
    rows = tiny_set().tables["evaluations"]
    n = [int((rows["case"] == case).sum()) for case in range(len(RULES.cases))]
    assert n[2] == 0 and 0 < n[1] < n[0] / 5, "only differences are stored, and speed makes none"
    assert not same(stream("ghost_insertion", 0), stream("collusion", 0))


def test_a_set_is_written_and_read(tmp_path):
    tiny_set().write(tmp_path)
    found = load(tmp_path)
    assert found.checksum == tiny_set().checksum and found.rules == RULES and found.worlds == tiny_set().worlds
    assert same(found.stream(2, 1), stream("ghost_insertion", 2))


@pytest.mark.parametrize("name", TABLES)
def test_an_altered_set_is_refused_in_one_line(tmp_path, name):
    tiny_set().write(tmp_path)
    table = pq.read_table(tmp_path / f"{name}.parquet")
    column = list(TABLES[name].columns)[-1]
    values = table[column].to_numpy().copy()
    values[len(values) // 2] ^= 1
    altered = table.set_column(table.schema.get_field_index(column), column, [values])
    pq.write_table(altered, tmp_path / f"{name}.parquet")
    with pytest.raises(ValueError, match="was altered") as error:
        load(tmp_path)
    assert "\n" not in str(error.value)


def test_what_is_no_set_is_refused_in_one_line(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        load(tmp_path)
    tiny_set().write(tmp_path)
    head = json.loads((tmp_path / MANIFEST).read_text())
    for broken in ("{", "[]", json.dumps({**head, "worlds": 3}), json.dumps({**head, "rules": {}})):
        (tmp_path / MANIFEST).write_text(broken)
        with pytest.raises(ValueError, match="no evidence set, or it is damaged"):
            load(tmp_path)
    (tmp_path / MANIFEST).write_text(json.dumps({**head, "rules": {**head["rules"], "n_steps": 10**9}}))
    with pytest.raises(ValueError, match="a world of 1000000000 steps"):
        load(tmp_path)
    (tmp_path / MANIFEST).unlink()
    os.mkfifo(tmp_path / MANIFEST)
    with pytest.raises(ValueError, match="no regular file"):
        load(tmp_path)
    (tmp_path / MANIFEST).unlink()
    (tmp_path / MANIFEST).write_text(json.dumps({**head, "version": "9"}))
    with pytest.raises(ValueError, match="was altered"):
        load(tmp_path)
    (tmp_path / MANIFEST).write_text(json.dumps(head))
    (tmp_path / "reports.parquet").write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="no evidence set, or it is damaged"):
        load(tmp_path)


def test_the_shipped_set_is_whole_small_and_described():
    found = load()
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 8e6
    assert len({place.city for place in found.worlds}) == 3 and len(found.rules.cases) == 13
    described = json.loads((SHIPPED / "croissant.json").read_text())
    assert described["citeAs"].startswith("cosim trust benchmark") and found.checksum in described["url"]
    assert {one["name"] for one in described["recordSet"]} == set(TABLES)


@pytest.mark.verify
def test_a_set_is_recorded_the_same_again(tmp_path):
    rules = replace(record.RULES, n_steps=12, start_step=4, cases=("none", "sybil", "offset"))
    place = Place("koenigs-wusterhausen", 0.1, 5)
    one, other = (record.make(lambda *_: None, (place,), rules, "0") for _ in range(2))
    assert one.checksum == other.checksum
    one.write(tmp_path)
    assert load(tmp_path).checksum == one.checksum and len(one.stream(0, 0).evaluations["step"]) > 100


@pytest.mark.verify
@pytest.mark.filterwarnings("ignore")
def test_the_card_is_read_by_the_reader_of_mlcommons(tmp_path):
    mlcroissant = pytest.importorskip("mlcroissant")
    tiny_set().write(tmp_path)
    described = mlcroissant.Dataset(jsonld=str(card.write(tiny_set(), tmp_path)))
    rows = list(described.records("pseudonyms"))
    assert len(rows) == len(tiny_set().tables["pseudonyms"]["pseudonym"])
