"""Questions to the tables of a run in SQL, answered by DuckDB in memory: one thread, no network, no extensions."""

import re
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from cosim.base.durable import Damaged
from results.tables import TABLES, schema

_CONFIG: dict[str, Any] = {
    "threads": 1,  # adds up in the same order every time
    "memory_limit": "500MB",  # beyond it, joins go to files
    "temp_directory": str(Path(tempfile.gettempdir(), "cosim-sql")),
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
    "python_enable_replacements": False,
}

Steps = tuple[int, int]
"""The first and the last one."""

_SUBJECTS = """
SELECT p.*, v.role, v.attack_start_step FROM pseudonyms p JOIN vehicles v USING (vehicle) WHERE v.role IS NOT NULL
"""
"""`Run.subjects` in SQL."""


class Database:
    """Tables of a run."""

    def __init__(
        self,
        tables: Sequence[str],
        files: Callable[[str, Steps | None], list[Path]],
        require: Callable[..., None],
        folders: Sequence[Path],
    ) -> None:
        """Names of the tables, where the files of a table and of steps are, what says that a table is missing, and all
        folders."""
        self._tables, self._files, self._require = tables, files, require
        self._connection = duckdb.connect(config=_CONFIG)
        self._lock = threading.Lock()  # a connection answers one thread at a time, and views are replaced
        allowed = _listed([*map(str, folders), *map(_itself, folders)])
        self._connection.execute(f"SET allowed_directories = {allowed}")
        self._connection.execute("SET enable_external_access = false; SET lock_configuration = true")

    def answer(self, query: str, values: Mapping[str, Any], steps: Steps | None = None) -> pd.DataFrame:
        """As `Run.sql`, with these values of all names; as `Run.sql_of_steps` if there are steps."""
        with self._lock:
            return self._answer(query, values, steps)

    def _answer(self, query: str, values: Mapping[str, Any], steps: Steps | None) -> pd.DataFrame:
        words = set(re.findall(r"\w+", query.lower()))  # SQL does not tell FROM Trust from FROM trust
        asked = [name for name in TABLES if name in words]
        try:
            if [one.type for one in self._connection.extract_statements(query)] != [duckdb.StatementType.SELECT]:
                raise ValueError(f"{' '.join(query.split())!r} is no single SELECT: tables can only be read.")
            for name in (*asked, *(("vehicles", "pseudonyms") if "subjects" in words else ())):
                if name in self._tables:
                    self._show(name, query, steps)
            if "subjects" in words:
                self._connection.execute(f"CREATE OR REPLACE TEMP VIEW subjects AS {_SUBJECTS}")
            wanted = re.findall(r"\$(\w+)", query)
            named = {name: _plain(value) for name, value in values.items() if name in wanted}
            return self._connection.execute(query, named or None).df()
        except duckdb.CatalogException as error:
            self._require(*asked)
            said = _line(error).partition(" Did you mean")[0]
            raise ValueError(f"{said} The tables are {', '.join(self._tables)}.") from None
        except duckdb.Error as error:
            raise _refusal(error) from None

    def columns_of_detections(self, rows: pa.Table, names: Sequence[str], files: Sequence[Path]) -> pa.Table:
        """Columns of `fused` that are not on disk, for some of its rows.

        Parameters
        ----------
        rows
            What these rows say of the detections that they name, in the columns of `LINKS`.
        names
            Names of the columns.
        files
            Part files of the detections of the steps in question.
        """
        made = f"({_stored('detections', files)})"
        query = f"""
            SELECT {", ".join(map(_virtual, names))} FROM (SELECT *, row_number() OVER () AS number FROM rows) t
            {_SOURCES.replace("detections", made)} ORDER BY number
        """
        try:
            with self._lock:
                self._connection.register("rows", rows)
                return self._connection.sql(query).to_arrow_table()
        except duckdb.Error as error:
            raise _refusal(error) from None

    def _show(self, name: str, query: str, steps: Steps | None) -> None:
        """Make a table visible by its name, with the columns that are not on disk if the query may ask for them."""
        files = self._files(name, steps)
        if not files:
            self._connection.register(f"no_{name}", schema(name, whole=True).empty_table())
            self._connection.execute(f"CREATE OR REPLACE TEMP VIEW {name} AS SELECT * FROM no_{name}")
            return
        table, stored = TABLES[name], _stored(name, files)
        is_all = re.search(r"(?<!\()\*", query) is not None  # a star, but not that of count(*)
        if virtual := table.virtual(list(table.columns) if is_all else (), query.lower()):
            self._show("detections", "", None)
            stored = f"SELECT t.*, {', '.join(map(_virtual, virtual))} FROM ({stored}) t {_SOURCES}"
        self._connection.execute(f"CREATE OR REPLACE TEMP VIEW {name} AS {stored}")


def _plain(value: Any) -> Any:
    """A value as DuckDB takes it, which knows no numbers of NumPy."""
    return value.item() if isinstance(value, np.generic) else value


_DAMAGE = "holds an infinite number: the table is damaged. Run again."


def _stored(name: str, files: Sequence[Path]) -> str:
    """The rows of a table on disk. A number that is infinite ends the query: no run writes one."""
    columns = TABLES[name].columns
    there = pq.read_schema(files[0]).names
    reals = [one for one in there if columns[one].type.startswith("float")]
    checked = [_checked(name, one) for one in reals]
    every = f"* REPLACE ({', '.join(checked)})" if checked else "*"
    paths = _listed(map(_itself, files))
    return f"SELECT {every} FROM read_parquet({paths})"


def _checked(table: str, column: str) -> str:
    return f"if(isinf({column}), error('{table}.{column} {_DAMAGE}'), {column}) AS {column}"


def _refusal(error: duckdb.Error) -> ValueError:
    """What is wrong with a query, or with the table that it asks, in one line."""
    said = _line(error)
    return Damaged(said.partition(": ")[2]) if said.endswith(_DAMAGE) else ValueError(said)


def _itself(path: Path) -> str:
    """A pattern that matches this path alone: in DuckDB, `*`, `?` and `[` stand for other names."""
    return re.sub(r"[*?[]", r"[\g<0>]", str(path.resolve()))


def _listed(paths: Iterable[str]) -> str:
    """Paths as a list of strings in SQL."""
    return "[" + ", ".join("'" + path.replace("'", "''") + "'" for path in paths) + "]"


def _line(error: duckdb.Error) -> str:
    """What is wrong with a query, in one line."""
    return " ".join(str(error).partition("\n\n")[0].split())


LINKS = tuple(name for name in TABLES["fused"].stored if name.startswith(("source", "pose", "moved_")))
"""Columns of `fused` that name detections, and say how far their boxes were moved."""
_SOURCES = """
JOIN detections source ON source.step = t.source_step AND source.observer = t.source
    AND source.detection_index = t.source_index
JOIN detections pose ON pose.step = if(t.pose IS NULL, t.source_step, t.pose_step)
    AND pose.observer = coalesce(t.pose, t.source) AND pose.detection_index = coalesce(t.pose_index, t.source_index)
"""


def _virtual(label: str) -> str:
    """A column of the detection that a row names, moved as the row says."""
    columns = TABLES["fused"].columns
    value = f"{columns[label].via}.{label}"
    if f"moved_{label}" in columns:
        value = f"({value} + t.moved_{label})"
    if label == "yaw_rad":
        value = f"({value} - (2 * pi())::FLOAT * (({value} > pi())::INT - ({value} <= -pi())::INT))"
    return f'{value} AS "{label}"'
