"""Who takes the rows of a run's tables, and what the modules that make them have in common."""

from collections.abc import Container, Mapping
from typing import Protocol

from jaxtyping import Bool
from numpy import ndarray

Columns = Mapping[str, ndarray | None]
"""Columns of a table, ready for the recorder."""


class TakesRows(Protocol):
    """Takes rows of tables: a `results.recorder.Recorder`, or a class that keeps them in memory."""

    @property
    def tables(self) -> Container[str]:
        """Names of the tables whose rows are kept."""

    def append(self, table: str, step: int, columns: Columns) -> None:
        """Add rows of one step, as `Recorder.append`."""


def without(left_out: Bool[ndarray, "n"], rows: Columns) -> Columns:
    """The rows that are not left out. Most tables are about vehicles and leave out roadside units."""
    if not left_out.any():
        return rows
    kept = ~left_out
    return {name: None if column is None else column[kept] for name, column in rows.items()}
