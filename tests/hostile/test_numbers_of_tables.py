"""Tables with other numbers, of which all checksums were made anew: one line, and no kernel beyond its arrays.

`make bounds` runs these tests with kernels that check every index.
HOSTILE_N=200 python -m pytest -m verify -s tests/hostile/test_numbers_of_tables.py
"""

import random
import shutil

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cosim.base import durable
from results.archive import open_run
from results.columns import WHOLE
from results.measure import measure
from results.tables import TABLES
from tests.hostile import SEED, N, shared
from tests.slow import slow

NUMBERS = (-1, -5, 9, 255, 40_000, 2**31 - 1, -(2**31))
REALS = (-1.0, 2.0, 1e9, float("nan"), float("inf"))


def set_values(folder, table, column, value):
    """Another value in every other row of a column, and all checksums made anew; whether there was any row."""
    changed = {}
    for path in sorted((folder / table).glob("*.parquet")):
        rows = pq.read_table(path, partitioning=None)
        if column not in rows.schema.names:
            continue  # not every run has it
        field = rows.schema.field(column)
        values = rows.column(column).to_pylist()
        if not values:
            continue  # a table without rows has a file
        values[1 % len(values) :: 2] = [value] * len(values[1 % len(values) :: 2])
        at = rows.schema.get_field_index(column)
        pq.write_table(rows.set_column(at, field, pa.array(values, field.type)), path)
        changed[path.name] = {"sha256": durable.sha256(path), "n_bytes": path.stat().st_size}

    def change(lines):
        for part in (part for line in lines for part in (*line["parts"], *line["open"])):
            if part["table"] == table and part["file"] in changed:
                part |= changed[part["file"]]

    shared.reseal_inventory(folder, change)
    return bool(changed)


def mutations():
    """Every column with every value that its type can hold."""
    for table, about in TABLES.items():
        for name, column in about.stored.items():
            low, high = {"int16": (-(2**15), 2**15 - 1), "uint8": (0, 255)}.get(column.type, (-(2**31), 2**31 - 1))
            if column.type in WHOLE:
                yield from ((table, name, value) for value in NUMBERS if low <= value <= high)
            elif column.type.startswith("float"):
                yield from ((table, name, value) for value in REALS)


@pytest.fixture
def run(street_runs):
    return street_runs[0]


def said(folder):
    """What measuring a folder says where it refuses; the values that could be measured count as said."""
    try:
        found = open_run(folder)
        measure(found)
        return " ".join(found.damage)
    except ValueError as error:
        assert "\n" not in str(error)
        return str(error)


def carry_out(run, tmp_path, chosen):
    for table, column, value in chosen:
        folder = tmp_path / "run"
        shutil.copytree(run, folder)
        if set_values(folder, table, column, value):
            try:
                said(folder)
            except Exception as error:
                raise AssertionError(f"{table}.{column} = {value}") from error
        shutil.rmtree(folder)


@pytest.mark.verify
def test_numbers(run, tmp_path):
    every = [one for one in mutations() if (run / one[0]).is_dir()]
    carry_out(run, tmp_path, random.Random(SEED).sample(every, min(10 * N, len(every))))


@pytest.mark.parametrize(
    "table, column, value, words",
    [
        ("pseudonyms", "vehicle", -5, "has vehicle = -5"),
        ("trust_lookups", "subject", 4000, "has subject = 4000, which is no number of the table pseudonyms"),
        ("trust_lookups", "step", 10**6, "is damaged: trust_lookups/part-0000"),
        ("trust_lookups", "n_evaluations", -1, "has n_evaluations = -1, which is out of bounds"),
        slow("pseudonyms", "vehicle", 255, "has vehicle = 255, which is no number of the table vehicles"),
        slow("trust_lookups", "receiver", 2**31 - 1, "has receiver = 2147483647"),
        slow("vehicles", "vehicle", 2**31 - 1, "has vehicle = 2147483647"),
    ],
)
def test_a_number_that_names_nothing_is_said(run, tmp_path, table, column, value, words):
    shutil.copytree(run, tmp_path / "run")
    assert set_values(tmp_path / "run", table, column, value)
    assert words in said(tmp_path / "run")
