"""Rows of tables that are held as one array per column."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, Self

import numpy as np
from numpy import ndarray

from cosim.base.ragged import row_numbers


class Rows:
    """Base of dataclasses whose fields are columns of one length.

    A column is an array, rows of another kind, or None if it is absent. Other values belong to all rows.
    """

    __slots__ = ()

    def take(self, rows: ndarray) -> Self:
        """The chosen rows, in this order; `rows` is a mask or row numbers."""
        rows = row_numbers(rows)
        columns = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]  # of dataclasses
        taken = {
            name: column.take(rows, axis=0) if isinstance(column, ndarray) else column.take(rows)
            for name, column in columns.items()
            if isinstance(column, ndarray | Rows)
        }
        return replace(self, **taken)  # type: ignore[type-var]  # of dataclasses

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """All rows of one or more parts, part after part. What belongs to all rows is that of the first part."""
        columns: dict[str, Any] = {}
        for f in fields(cls):  # type: ignore[arg-type]  # of dataclasses
            each: list[Any] = [getattr(part, f.name) for part in parts]
            if isinstance(each[0], ndarray):
                columns[f.name] = np.concatenate(each)
            elif isinstance(each[0], Rows):
                columns[f.name] = type(each[0]).concat(each)
        return replace(parts[0], **columns)  # type: ignore[type-var]  # of dataclasses
