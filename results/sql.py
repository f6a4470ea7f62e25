"""Questions to the tables of a run in SQL, answered by DuckDB in memory: one thread, no network, no extensions."""

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pandas as pd
import pyarrow.parquet as pq

from results import virtual_columns
from results.columns import Column
from results.tables import TABLES, schema

if TYPE_CHECKING:
    from results.run import Run

_MEMORY = "1GB"
"""Beyond it, joins go to files in the temporary folder of the system."""

_SUBJECTS = """
SELECT p.*, v.role, v.attack_start_step FROM pseudonyms p JOIN vehicles v USING (vehicle) WHERE v.role IS NOT NULL
"""
"""The same as `Run.subjects`."""


def answer(run: "Run", query: str, values: dict[str, Any]) -> pd.DataFrame:
    """As `Run.sql`."""
    connection = run.once_for_all("sql", lambda: _connection(run))
    known = {"dt_s": run.dt_s, "steps": run.manifest["steps"], "variant": run.variant} | values
    words = set(re.findall(r"\w+", query))
    asked = [name for name in TABLES if name in words]
    try:
        if [one.type for one in connection.extract_statements(query)] != [duckdb.StatementType.SELECT]:
            raise ValueError(f"{' '.join(query.split())!r} is no single SELECT: tables can be read alone.")
        for name in (*asked, *(("vehicles", "pseudonyms") if "subjects" in words else ())):
            if name in run.tables:
                _show(connection, run, name, query)
        if "subjects" in words:
            connection.execute(f"CREATE OR REPLACE TEMP VIEW subjects AS {_SUBJECTS}")
        named = {name: value for name, value in known.items() if f"${name}" in query}
        return connection.execute(query, named or None).df()
    except duckdb.CatalogException as error:
        run.require(*asked)
        said = _line(error).partition(" Did you mean")[0]
        raise ValueError(f"{said} The tables are {', '.join(run.tables)}.") from None
    except duckdb.Error as error:
        raise ValueError(_line(error)) from None


def _line(error: duckdb.Error) -> str:
    """What is wrong with a query, in one line."""
    return " ".join(str(error).partition("\n\n")[0].split())


def _connection(run: "Run") -> duckdb.DuckDBPyConnection:
    """DuckDB that sees no files but those of the run; one thread adds up in the same order every time."""
    config = {
        "threads": 1,
        "memory_limit": _MEMORY,
        "temp_directory": str(Path(tempfile.gettempdir(), "cosim-sql")),
        "autoinstall_known_extensions": False,
        "autoload_known_extensions": False,
        "python_enable_replacements": False,
    }
    connection = duckdb.connect(config=config)
    connection.execute(f"SET allowed_directories = {run.folders()}")
    connection.execute("SET enable_external_access = false; SET lock_configuration = true")
    return connection


def _show(connection: duckdb.DuckDBPyConnection, run: "Run", name: str, query: str) -> None:
    """Make a table visible by its name, with the columns that are not on disk if the query may ask for them."""
    paths = [str(path.resolve()) for path in run.files(name)]
    if not paths:
        connection.register(name, schema(name, whole=True).empty_table())
        return
    table, there = TABLES[name], pq.read_schema(paths[0]).names
    columns = [f'"{label}"' if label in there else _absent(column, label) for label, column in table.stored.items()]
    stored = f"SELECT {', '.join(columns)} FROM read_parquet({paths})"
    virtual = virtual_columns.names(table, list(table.columns) if "*" in query else (), query)
    if virtual:
        _show(connection, run, "detections", "")
        more = [_virtual(label, table.columns[label].via) for label in virtual]
        stored = f"SELECT t.*, {', '.join(more)} FROM ({stored}) t {_SOURCES}"
    connection.execute(f"CREATE OR REPLACE TEMP VIEW {name} AS {stored}")


_SOURCES = """
JOIN detections source ON source.step = t.source_step AND source.observer = t.source
    AND source.detection_index = t.source_index
JOIN detections pose ON pose.step = if(t.pose IS NULL, t.source_step, t.pose_step)
    AND pose.observer = coalesce(t.pose, t.source) AND pose.detection_index = coalesce(t.pose_index, t.source_index)
"""


def _virtual(label: str, via: str) -> str:
    """A column of the detection that a row names, moved as the row says."""
    value = f"{via}.{label}"
    if f"moved_{label}" in TABLES["fused"].columns:
        value = f"({value} + t.moved_{label})"
    if label == "yaw_rad":
        value = f"({value} - (2 * pi())::FLOAT * (({value} > pi())::INT - ({value} <= -pi())::INT))"
    return f'{value} AS "{label}"'


def _absent(column: Column, label: str) -> str:
    """What rows have in a column that the run lacks."""
    zero = f"'{column.categories[0]}'" if column.categories else "0::FLOAT"
    return f'{ {"step": "step", "zero": zero, "null": "NULL"}[column.absent] } AS "{label}"'
