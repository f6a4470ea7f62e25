"""Parquet parts of one block of steps, encoded by a thread of their own while the simulation goes on."""

import io
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy import ndarray

from results import durable
from results.inventory import Part
from results.stored_columns import VALID, StoredColumn, stored
from results.tables import TABLES, schema

Rows = dict[str, ndarray]
"""Columns of a table, masks included."""

_STEPS = ("step", "first_step", "last_step", "from_step", "to_step", "start_step", "end_step")
"""Columns that count steps."""

_STORED_ROWS = 8_000
"""Rows that are cast, rounded and checked at once: of most tables a step has few, and each column a fixed cost."""

_GROUP_ROWS = 120_000
"""Rows from which a row group is encoded and written: memory is that of the rows that wait."""

_TRIED_ROWS, _SAMPLE_ROWS = 20_000, 100_000
"""Rows from which layouts are tried, and of which the first row group is tried with."""

_LEVEL = 3
"""Of the compression: level 6 takes 4 % less space, and 35 ms more of processor time per step of 4,600 vehicles."""

_MOST_WAITING = 2
"""Row groups of one table that wait for the encoder."""


class Encoder:
    """Threads that sort, compress and write, so that rows do not stay in memory and the other core has work; at the end
    of a block, when the simulation waits, both cores."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=2, thread_name_prefix="encoder")

    def part(
        self, partial: Path, table: str, columns: Mapping[str, StoredColumn], rows: Sequence[Rows] = (),
        like: "PartEncoder | None" = None,
    ) -> "PartEncoder":  # fmt: skip
        """A part of a table, with these rows; a file of this name until it is whole.

        `like` is an earlier part of the table that has been written: layouts tried there are not tried again.
        """
        return PartEncoder(partial, table, columns, self._pool, rows, {} if like is None else like.tried)


class PartEncoder:
    """Rows of one table and block, on their way into one file sorted by key."""

    def __init__(
        self, partial: Path, table: str, columns: Mapping[str, StoredColumn], pool: ThreadPoolExecutor,
        rows: Sequence[Rows], tried: Mapping[str, str],
    ) -> None:  # fmt: skip
        self.tried = tried
        """Layout of each column, where there were rows enough to try them."""
        self._partial, self._table, self._columns, self._pool = partial, table, columns, pool
        self._given: list[Rows] = []
        self._rows: list[Rows] = []
        self._n_given = self._n_new = self._n = 0
        self._waiting: list[Future[None]] = []
        self._file: durable.Growing | None = None
        self._writer: pq.ParquetWriter | None = None
        self._first_step, self._last_step = np.iinfo(np.int64).max, 0
        for some in rows:
            self.append(some)

    def __len__(self) -> int:
        return self._n

    def append(self, rows: Rows) -> None:
        """Add rows as `complete` returns them; ValueError for values, of earlier calls too, that cannot be stored."""
        n = len(next(iter(rows.values())))
        if n < _STORED_ROWS:
            rows = {name: values.copy() for name, values in rows.items()}  # the caller may go on to change its own
        self._given.append(rows)
        self._n_given += n
        self._n_new += n
        self._n += n
        if self._n_given >= _STORED_ROWS:
            self._store()

    def _store(self) -> None:
        self._rows.append(stored(self._given, self._columns))
        self._given, self._n_given = [], 0

    def end_step(self) -> None:
        """No rows of earlier steps follow: what there is may be encoded where steps come first in the key."""
        if self._n_new >= _GROUP_ROWS and TABLES[self._table].key[0] == "step":
            self._submit()

    def end_block(self) -> None:
        """No rows follow."""
        if self._n_new:
            self._submit()

    def finish(self, file: str) -> Part:
        """Sync it and give it its name; ValueError for two rows with one key."""
        for group in self._waiting:
            group.result()
        assert self._writer is not None and self._file is not None, "a part has rows"
        self._writer.close()
        digest = self._file.finish(self._partial.with_name(file))
        return Part(self._table, file, self._n, self._file.n_bytes, digest, self._first_step, self._last_step)

    def _submit(self) -> None:
        if self._n_given:
            self._store()
        rows, self._rows, self._n_new = self._rows, [], 0
        while len(self._waiting) >= _MOST_WAITING:
            self._waiting.pop(0).result()
        before = self._waiting[-1] if self._waiting else None
        self._waiting.append(self._pool.submit(self._encode, rows, before))

    def _encode(self, rows: list[Rows], before: Future[None] | None) -> None:
        """One row group, sorted by key, after the one before."""
        table, stored = self._table, TABLES[self._table].stored
        columns = {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
        order, tied = _order(columns, TABLES[table].key)
        if order is not None:
            columns = {name: values[order] for name, values in columns.items()}
        if len(tied):
            named = ", ".join(f"{name} = {columns[name][tied[0]]}" for name in TABLES[table].key)
            raise ValueError(f"Table {table} has two rows with {named}.")
        arrays = []
        for name, column in stored.items():
            mask = ~columns[name + VALID] if column.null else None
            if column.categories:
                codes = pa.array(columns[name], pa.int8(), mask=mask)
                arrays.append(pa.DictionaryArray.from_arrays(codes, list(self._columns[name].categories)))
            else:
                arrays.append(pa.array(columns[name], column.arrow_type, mask=mask))
        if before is not None:
            before.result()
        steps = [columns[name] for name in _STEPS if name in columns]
        self._first_step = min(self._first_step, *(int(s.min()) for s in steps))
        self._last_step = max(self._last_step, *(int(s.max()) for s in steps))
        group = pa.Table.from_arrays(arrays, schema=schema(table))
        if self._writer is None:
            if not self.tried and len(group) >= _TRIED_ROWS:
                self.tried = _best_layouts(group)
            self._file = durable.Growing(self._partial)
            # rows are sorted by the column with statistics; those of others tell no row groups apart and take a quarter
            # of the time
            self._writer = pq.ParquetWriter(
                self._file, group.schema, compression="zstd", compression_level=_LEVEL,
                write_statistics=[TABLES[table].key[0]], **_encodings(group, self.tried),
            )  # fmt: skip
        self._writer.write_table(group, row_group_size=len(group))


def _encodings(group: pa.Table, tried: Mapping[str, str]) -> dict[str, Any]:
    """How Parquet shall lay out each column, as `_LAYOUTS`; whatever compresses best.

    Where that has not been tried, floats are split into bytes, others go by a dictionary.
    """
    best = {f.name: "bytes" if pa.types.is_floating(f.type) else "dictionary" for f in group.schema} | dict(tried)
    encoding = {name: _LAYOUTS[layout] for name, layout in best.items()}
    return {
        "use_dictionary": [name for name, layout in best.items() if layout == "dictionary"],
        "column_encoding": {name: one for name, one in encoding.items() if one is not None},
    }


_LAYOUTS = {"dictionary": None, "bytes": "BYTE_STREAM_SPLIT", "plain": None, "differences": "DELTA_BINARY_PACKED"}
"""Layouts of a column: by a dictionary, byte by byte, as it is, by differences from one to the next; the encoding that
Parquet has to be told."""


def _best_layouts(group: pa.Table) -> dict[str, str]:
    """The layout of every column of numbers that compresses best."""
    best = {}
    for field in group.schema:
        whole = pa.types.is_integer(field.type)
        if pa.types.is_floating(field.type) or whole:
            sample = group.select([field.name]).slice(0, _SAMPLE_ROWS)
            layouts = [layout for layout in _LAYOUTS if whole or layout != "differences"]
            best[field.name] = min(layouts, key=lambda layout: _encoded_bytes(sample, {field.name: layout}))
    return best


def _encoded_bytes(sample: pa.Table, layouts: Mapping[str, str]) -> int:
    sink = io.BytesIO()
    pq.write_table(sample, sink, compression="zstd", compression_level=_LEVEL, **_encodings(sample, layouts))
    return sink.tell()


def _order(columns: Rows, key: tuple[str, ...]) -> tuple[ndarray | None, ndarray]:
    """Order of rows by key, None where they stand in it; and which of the rows in order have the key of the next."""
    number = _key_numbers(columns, key)
    if number is None:
        order = np.lexsort([columns[name] for name in key[::-1]])
        ordered = (columns[name][order] for name in key)
        return order, np.flatnonzero(np.all([values[1:] == values[:-1] for values in ordered], axis=0))
    if (number[1:] >= number[:-1]).all():
        return None, np.flatnonzero(number[1:] == number[:-1])
    order = np.argsort(number, kind="stable")  # much faster than by several columns, where they are nearly sorted
    return order, np.flatnonzero(np.diff(number[order]) == 0)


def _key_numbers(columns: Rows, key: tuple[str, ...]) -> ndarray | None:
    """Keys as whole numbers of the same order; None where they are not whole or take more than 63 bits."""
    number, room = np.zeros(len(columns[key[0]]), np.int64), 1
    for name in key:
        values = columns[name]
        if values.dtype.kind not in "iu":
            return None
        low, high = int(values.min()), int(values.max())
        room *= high - low + 1
        if room >= 1 << 63:
            return None
        if high > low:
            number *= high - low + 1
            number += values
            number -= low
    return number
