"""Every table and column of a run, as `schema.toml` declares them. Parquet schemas and documentation follow from it."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from cosim.base import codes
from results.columns import LEVELS, Column, Level, Table

SCHEMA_VERSION = 10
"""Raised whenever a table or column changes its name, type, unit or meaning."""

_FILE = Path(__file__).with_name("schema.toml")


def _read(text: str) -> dict[str, Table]:
    """Tables of a text in TOML.

    The keys of a column are the fields of `Column`. `labels` stands for the categories: their texts, or the name of an
    enumeration of `cosim.base.codes`. `like = "table.column"` takes over the keys of an earlier column.
    """
    document: dict[str, Any] = tomllib.loads(text)
    tables: dict[str, Table] = {}
    for name, section in document.items():
        columns = section["columns"]
        for label, keys in columns.items():
            if "like" in keys:
                table, _, other = keys.pop("like").partition(".")
                columns[label] = document[table]["columns"][other] | keys
        made = {label: _column(**keys) for label, keys in columns.items()}
        tables[name] = Table(section["level"], section["meaning"], made)
    return tables


def _column(labels: str | Sequence[str] = (), **keys: Any) -> Column:
    found = codes.labels(getattr(codes, labels)) if isinstance(labels, str) else tuple(labels)
    return Column(categories=found, **keys)


TABLES: Mapping[str, Table] = _read(_FILE.read_text(encoding="utf-8"))


def kept(level: Level) -> tuple[str, ...]:
    """Names of the tables that a run of this record level contains."""
    levels = LEVELS[: LEVELS.index(level) + 1]
    return tuple(name for name, table in TABLES.items() if table.level in levels)


def schema(name: str, whole: bool = False) -> pa.Schema:
    """Arrow schema of a table, with unit and meaning as field metadata.

    Parameters
    ----------
    name
        Name of the table.
    whole
        False gives the columns that are stored on disk, True gives all columns.
    """
    table = TABLES[name]
    fields = [
        pa.field(
            label,
            column.arrow_type,
            nullable=column.null,
            metadata={"unit": column.unit, "meaning": column.meaning, "key": str(column.key).lower()},
        )
        for label, column in (table.columns if whole else table.stored).items()
    ]
    return pa.schema(fields, {"table": name, "schema_version": str(SCHEMA_VERSION), "meaning": table.meaning})


def axis_label(table: str, column: str, text: str | None = None) -> str:
    """Axis label with the column's unit: `axis_label("trust", "newest_age_s", "Age")` is `Age [s]`."""
    found = TABLES[table].columns[column]
    name = text or column.replace("_", " ")
    return f"{name} [{found.unit}]" if found.unit not in ("", "1") else name
