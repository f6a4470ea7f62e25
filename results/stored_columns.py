"""Columns of a table as they are stored: cast and rounded. Values that this would change further are refused."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from results.columns import Column
from results.tables import TABLES

VALID = "__valid"
"""Suffix of the mask that goes with a column that may be null."""


@dataclass(frozen=True, slots=True)
class StoredColumn:
    """How the values of one column are stored."""

    name: str
    dtype: np.dtype
    null: bool
    categories: tuple[str, ...]
    bottom: int
    """Smallest and largest value of whole numbers and codes."""
    top: int
    scale: float | None
    """Stored values are multiples of 1 / scale, where it is given."""
    usual: str = ""
    """As `Column.usual`."""

    @staticmethod
    def of(table: str, name: str, column: Column, of_run: Mapping[str, tuple[str, ...]]) -> "StoredColumn":
        """Of a column of the dictionary; `of_run` holds the labels of this run."""
        categories = column.labels(of_run)
        plain = {"category": "int8", "string": "O"}.get(column.type, column.type)
        dtype = np.dtype(plain)
        bottom, top = 0, 0
        if column.type == "category":
            top = len(categories) - 1
        elif dtype.kind in "iu":
            limits = np.iinfo(dtype)
            bottom, top = int(limits.min), int(limits.max)
        scale = None if column.bits is None else 2.0**column.bits
        return StoredColumn(f"{table}.{name}", dtype, column.null, categories, bottom, top, scale, column.usual)

    def store(self, values: ndarray, valid: ndarray | None) -> ndarray:
        """Values in the type in which the column is stored, rounded to its steps.

        Parameters
        ----------
        values
            Values, with codes in place of labels.
        valid
            Mask of the rows that are not null; None if no row is null.

        Returns
        -------
        The stored values; 0 in null rows, except in columns of text.

        Raises
        ------
        ValueError
            If valid values are of the wrong kind, outside the limits of the type or of the labels, or not finite.
        """
        kind, given = self.dtype.kind, values.dtype.kind
        if kind == "O":
            return values.astype(object)
        if valid is not None and not valid.all():
            values = np.where(valid, values, np.zeros((), values.dtype))
        if kind in "iu":
            if given not in "iu":
                raise ValueError(f"{self.name} has dtype {values.dtype}; whole numbers are wanted.")
            if (self.categories or values.dtype != self.dtype) and values.size:
                low, high = int(values.min()), int(values.max())
                if low < self.bottom or high > self.top:
                    permitted = f"{self.bottom} to {self.top}"
                    raise ValueError(f"{self.name} holds {low} to {high}, outside {permitted}.")
        elif kind == "b":
            if given != "b":
                raise ValueError(f"{self.name} has dtype {values.dtype}; true or false is wanted.")
        elif given not in "fiu" or not np.isfinite(values).all():
            raise ValueError(f"{self.name} holds something that is not a finite number.")
        if self.scale is not None:
            scaled = np.asarray(values, np.float64) * self.scale
            values = np.round(scaled) * (1 / self.scale)
        return values.astype(self.dtype)

    def usual_values(self, n: int, step: int) -> ndarray | None:
        """What the rows of a step have if the column is not given; None if they are all null."""
        if self.usual == "null":
            return None
        if self.usual == "zero":
            return np.zeros(n, self.dtype)
        return np.full(n, step, np.int32)

    def codes(self, values: ndarray, valid: ndarray | None) -> ndarray:
        """Codes of labels.

        Parameters
        ----------
        values
            Labels.
        valid
            Mask of the rows that are not null; None if no row is null.

        Returns
        -------
        Code of each label; -1 in null rows whose content is no label.

        Raises
        ------
        ValueError
            If a row that is not null holds no label of the column.
        """
        codes = np.full(len(values), -1, np.int8)
        for code, label in enumerate(self.categories):
            codes[values == label] = code
        known = codes >= 0 if valid is None else (codes >= 0) | ~valid
        if not known.all():
            strange, labels = values[~known][0], ", ".join(self.categories)
            raise ValueError(f"{self.name} = '{strange}' is none of {labels}.")
        return codes


def stored_columns(
    table: str,
    of_run: Mapping[str, tuple[str, ...]],
) -> dict[str, StoredColumn]:
    """All columns of a table that are on disk, by name."""
    stored = TABLES[table].stored
    return {name: StoredColumn.of(table, name, stored[name], of_run) for name in stored}


def given_rows(
    table: str,
    step: int,
    columns: Mapping[str, ndarray | None],
    known: Mapping[str, StoredColumn],
) -> dict[str, ndarray]:
    """Copies of a caller's columns, complete, not yet in the types in which they are stored.

    Parameters
    ----------
    step
        Value of the column `step` where that is left out.
    columns
        As `Recorder.append` takes them. Columns with a usual value can be left out.
    known
        As `stored_columns` returns them.

    Returns
    -------
    All columns, of one length. Columns that may be null come with a mask; labels of categories are codes.

    Raises
    ------
    ValueError
        For unknown or missing columns, other lengths, nulls where none may be, and labels that a column does not have.
    """
    unknown = [name for name in columns if name not in known and name.removesuffix(VALID) not in known]
    wanted = [name for name, column in known.items() if not column.usual]
    missing = [name for name in wanted if name != "step" and name not in columns]
    if unknown or missing:
        wrong = []
        if unknown:
            wrong.append(f"unknown {', '.join(sorted(unknown))}")
        if missing:
            wrong.append(f"missing {', '.join(sorted(missing))}")
        raise ValueError(f"Table {table}: {'; '.join(wrong)}. The columns are {', '.join(known)}.")
    n = next((len(values) for values in columns.values() if values is not None), 0)
    rows: dict[str, ndarray] = {}
    for name, column in known.items():
        given = columns[name] if name in columns else column.usual_values(n, step)
        values = np.zeros(n, column.dtype) if given is None else np.array(given)
        valid = np.zeros(n, bool) if given is None else columns.get(name + VALID)
        shape_of_valid = (n,) if valid is None else np.shape(valid)
        if values.shape != (n,) or shape_of_valid != (n,):
            raise ValueError(f"{table}.{name} has shape {values.shape}, other columns have {n} rows.")
        if column.null:
            valid = np.ones(n, bool) if valid is None else np.array(valid, bool)
            rows[name + VALID] = valid
        elif valid is not None and not np.all(valid):
            raise ValueError(f"{table}.{name} cannot be null.")
        is_label = column.categories and values.dtype.kind in "OUT"
        rows[name] = column.codes(values, valid) if is_label else values
    return rows


def stored_rows(
    rows: Mapping[str, ndarray],
    known: Mapping[str, StoredColumn],
) -> dict[str, ndarray]:
    """Rows of `given_rows` in the types in which they are stored.

    Raises
    ------
    ValueError
        For values that cannot be stored.
    """
    stored = dict(rows)
    for name, column in known.items():
        stored[name] = column.store(rows[name], rows.get(name + VALID))
    return stored
