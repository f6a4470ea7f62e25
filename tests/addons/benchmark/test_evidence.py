import json
import os
import re
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.addons.benchmark import record
from cosim.addons.benchmark.evidence import MANIFEST, SHIPPED, TABLES, EvidencePlace, load
from tests.addons.benchmark.worlds import RULES, stream, tiny_set
from tests.refusals import refused_in_one_line
from tests.verification.benchmark_page import shipped


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
    with refused_in_one_line("was altered"):
        load(tmp_path)


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
    with pytest.raises(ValueError, match=r"n_steps = .1000000000. should be a number from 1 to 4096"):
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


def altered(tmp_path, table="", column="", value=0, row=5, rules=None, **head):
    """A tiny set with one wrong value, and a checksum that fits, as anybody can make it."""
    of = tiny_set()
    tables = {name: {c: values.copy() for c, values in rows.items()} for name, rows in of.tables.items()}
    if table:
        tables[table][column][row] = value
    replace(of, tables=tables, rules=replace(of.rules, **(rules or {})), **head).write(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "case",
    [
        "pseudonyms.pseudonym = 20000",
        "pseudonyms.pseudonym = -1",
        "pseudonyms.vehicle = 0",
        "pseudonyms.vehicle = 77",
        "pseudonyms.attacks = 2",
        "detections.step = 14",
        "detections.step = -5",
        "detections.detection_index = -7",
        "detections.detection_index = 0",
        "detections.score = 127",
        "detections.score = -1",
        "detections.observer = 9",
        "detections.world = 3",
        "detections.case = 5",
        "detections.gone = 1",
        "detections.gone = 3",
        "evaluations.evaluation = -128",
        "evaluations.evaluation = 127",
        "evaluations.visibility = -128",
        "evaluations.visibility = 101",
        "evaluations.evaluator = 12",
        "evaluations.detection_index = 9",
        "reports.arrival_step = -2",
        "lookups.broadcast_step = 9",
        "lookups.sender = 9",
        "lookups.receiver = 9",
    ],
)
def test_what_cannot_be_true_is_refused_in_one_line(tmp_path, case):
    table, column, value = re.split(r"\.| = ", case)
    with pytest.raises(ValueError, match=f"cannot be true: {table} has a row with ") as error:
        load(altered(tmp_path, table, column, int(value)))
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def test_equal_keys_are_refused(tmp_path):
    """Every evaluation about the same detection would count several times."""
    with pytest.raises(ValueError, match=r"evaluations has a row .*: it should come after the row before it"):
        load(altered(tmp_path, "evaluations", "detection_index", 0, row=slice(None)))


def test_reports_arrive_after_they_are_sent(tmp_path):
    with pytest.raises(ValueError, match=r"reports has a row .*: it arrives before it is sent"):
        load(altered(tmp_path, "reports", "arrival_step", 2, row=7 * 5))


@pytest.mark.parametrize(
    "rules",
    [
        {"dt_s": 0}, {"dt_s": "1"}, {"dt_s": float("nan")}, {"n_steps": 80.5}, {"n_steps": True}, {"eta": 7},
        {"start_step": -1}, {"start_step": 14}, {"freshness_s": "off"}, {"server_period_s": float("inf")},
        {"cases": ()}, {"cases": (0, 1, 2)}, {"cases": ("none", "speed", "speed")}, {"cases": ("speed", "none")},
        {"cases": ("none", "")}, {"cases": ("none",)},
    ],
)  # fmt: skip
def test_rules_that_cannot_be_are_refused_in_one_line(tmp_path, rules):
    with refused_in_one_line(next(iter(rules)) if "start_step" not in rules else "start"):
        load(altered(tmp_path, rules=rules))


def test_places_that_cannot_be_are_refused_in_one_line(tmp_path):
    for number, place in enumerate(
        (EvidencePlace(7, 0.3, 1), EvidencePlace("here", 3.0, 1), EvidencePlace("here", 0.3, "x"))
    ):
        with pytest.raises(ValueError, match="world 0 should be a city, a penetration from 0 to 1 and a seed"):
            load(altered(tmp_path / str(number), worlds=(place, *tiny_set().worlds[1:])))


def test_a_column_that_nobody_asked_for_is_not_read(tmp_path):
    """A text of 5 MB in each of 560 rows, as a dictionary of one: 2.8 GB in memory, if anybody read it."""
    tiny_set().write(tmp_path)
    table = pq.read_table(tmp_path / "detections.parquet")
    blown = pa.DictionaryArray.from_arrays(pa.array(np.zeros(len(table), np.int32)), pa.array(["x" * 5_000_000]))
    pq.write_table(table.append_column("more", blown), tmp_path / "detections.parquet", compression="zstd")
    assert load(tmp_path).checksum == tiny_set().checksum
    text = table.set_column(table.schema.get_field_index("score"), "score", [table["score"].cast(pa.string())])
    pq.write_table(text, tmp_path / "detections.parquet")
    with pytest.raises(ValueError, match=r"detections\.score has the type string"):
        load(tmp_path)


def test_the_shipped_set_is_whole_and_small():
    found = shipped()
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 8e6
    assert len({place.city for place in found.worlds}) == 3 and len(found.rules.cases) == 14


@pytest.mark.verify
def test_a_set_is_recorded_the_same_again(tmp_path):
    rules = replace(record.RULES, n_steps=40, start_step=15, cases=("none", "sybil", "offset"))
    place = EvidencePlace("koenigs-wusterhausen", 0.1, 5)
    one, other = (record.make(lambda *_: None, (place,), rules, "0") for _ in range(2))
    assert one.checksum == other.checksum
    one.write(tmp_path)
    assert load(tmp_path).checksum == one.checksum and len(one.stream(0, 0).evaluations["step"]) > 100
