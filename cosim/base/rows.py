"""Rows of tables that are held as one array per column."""

from collections.abc import Sequence
from dataclasses import field
from typing import Any, Self

import numpy as np
from numpy import ndarray

from cosim.base.ragged import row_numbers


class Rows:
    """Base of dataclasses whose fields are columns of one length.

    A column is an array, rows of another kind, or None if it is absent. Other values belong to all rows. Rows of
    checked columns are not checked again.
    """

    __slots__ = ()
    __dataclass_fields__: dict[str, Any]

    def take(self, rows: ndarray | slice) -> Self:
        """The chosen rows, in this order; `rows` is a mask, row numbers, or a slice, of which nothing is copied."""
        chosen = rows if isinstance(rows, slice) else row_numbers(rows)
        taken = object.__new__(type(self))
        for name in self.__dataclass_fields__:
            column = getattr(self, name)
            if isinstance(column, ndarray):
                column = column[chosen] if isinstance(chosen, slice) else column.take(chosen, axis=0)
            elif isinstance(column, Rows):
                column = column.take(chosen)
            object.__setattr__(taken, name, column)
        return taken

    @classmethod
    def concat(cls, parts: Sequence[Self]) -> Self:
        """All rows of one or more parts, part after part. What belongs to all rows is that of the first part."""
        joined = object.__new__(type(parts[0]))
        for name in cls.__dataclass_fields__:
            each: list[Any] = [getattr(part, name) for part in parts]
            column = each[0]
            if isinstance(column, ndarray):
                column = np.concatenate(each)
            elif isinstance(column, Rows):
                column = type(column).concat(each)
            object.__setattr__(joined, name, column)
        return joined


def no_rows(dtype: Any = np.float64, *width: int) -> Any:
    """A field of a dataclass whose default is a column without rows, of this width."""
    return field(default_factory=lambda: np.zeros((0, *width), dtype))
