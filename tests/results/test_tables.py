"""What every schema must have."""

from enum import IntEnum

import pyarrow as pa
import pytest

from cosim.base import codes
from results import tables
from results.columns import LEVELS
from results.metrics.registry import METRICS, TOPICS


@pytest.mark.parametrize("name", tables.TABLES)
def test_every_table_is_complete(name):
    table = tables.TABLES[name]
    assert table.key and table.meaning.endswith(".")
    for label, column in table.columns.items():
        assert column.meaning.strip(), label
        assert not (column.key and column.null), f"{label}: a key is never null"
        assert bool(column.categories) == (column.type == "category"), label
        assert column.bits is None or column.type == "float32", label
        for suffix, unit in (("_m", "m"), ("_s", "s"), ("_rad", "rad"), ("_mps", "m/s")):
            if label.endswith(suffix):
                assert column.unit == unit, f"{label} is in {column.unit!r}"


@pytest.mark.parametrize("name", tables.TABLES)
def test_schema_carries_unit_and_meaning(name):
    schema = tables.schema(name)
    assert schema.metadata[b"table"].decode() == name
    for field in schema:
        column = tables.TABLES[name].columns[field.name]
        assert field.metadata[b"unit"].decode() == column.unit
        assert field.metadata[b"meaning"].decode() == column.meaning
        assert field.nullable == column.null
        if field.name.endswith("step"):
            assert field.type == pa.int32()


def test_levels_contain_one_another():
    summary, standard, full = (set(tables.kept(level)) for level in LEVELS)
    assert summary < standard < full == set(tables.TABLES)


def test_axis_label():
    assert tables.axis_label("trust_lookups", "age_s", "Age") == "Age [s]"
    assert tables.axis_label("trust", "trust") == "trust"


@pytest.mark.parametrize(
    "code", [code for code in vars(codes).values() if isinstance(code, type) and code is not IntEnum]
)
def test_codes_count_from_zero(code):
    assert [code[label.upper()] for label in codes.labels(code)] == list(range(len(code)))


def test_metrics_are_described():
    for name, metric in METRICS.items():
        assert name.split(".")[0] in TOPICS and metric.label and metric.definition.endswith("."), name
        if name.endswith("_s"):
            assert metric.unit == "s", name
        if name.endswith(".share"):
            assert metric.unit == "1", name
