"""What a table and a column of a run are."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal

import pyarrow as pa

Level = Literal["summary", "standard", "full"]
Layout = Literal["dictionary", "bytes", "differences", "plain"]
"""How Parquet lays out the values of a column: as numbers of a dictionary, split into their bytes, as differences from
one value to the next, or as they are."""
Of = Literal["", "vehicles", "pseudonyms", "steps"]
LEVELS: tuple[Level, ...] = ("summary", "standard", "full")


@dataclass(frozen=True, slots=True)
class Column:
    """One column. What is absent is null (only where `null`), never a sentinel number."""

    type: Literal["int32", "int16", "uint8", "float32", "float64", "bool", "string", "category"]
    _: KW_ONLY
    meaning: str
    unit: str = ""
    """Unit, empty for identifiers, counts and flags."""
    key: bool = False
    null: bool = False
    truth: bool = False
    """Known to the simulation only: no vehicle and no server ever reads it."""
    categories: tuple[str, ...] = ()
    """Labels of a category, in the order of their integer codes."""
    labels_of_run: Literal["", "variants", "roles"] = ""
    """Key of the manifest with the labels of this run, where a run may have others than `categories`."""
    bits: int | None = None
    """Binary places kept: stored values are multiples of 2**-bits, which makes files small."""
    layout: Layout | None = None
    """How Parquet lays out the values; None for the layout that `Table.layouts` chooses."""
    usual: Literal["", "step", "zero", "null"] = ""
    """What rows have if the recorder is not given the column: the row's `step`, 0 or null. If empty, it has to be."""
    of: Of = ""
    """What a whole number names: a row of `vehicles` by its number, a row of `pseudonyms`, or a step of the run.
    Reading checks it, because the number may be used as an index. All whole numbers are 0 or more."""
    via: Literal["", "source", "pose"] = ""
    """Not stored if given: `open_run` reads the column from the detection that `<via>` and `<via>_index` name."""

    @property
    def arrow_type(self) -> pa.DataType:
        if self.type == "category":
            return pa.dictionary(pa.int8(), pa.string())
        return pa.bool_() if self.type == "bool" else getattr(pa, self.type)()

    def labels(self, of_run: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
        """Labels of a category in a run; `of_run` is its manifest, or the labels given to its recorder."""
        return tuple(of_run.get(self.labels_of_run, self.categories)) if self.labels_of_run else self.categories

    @property
    def label(self) -> str:
        """Unit in brackets, as an axis shows it."""
        return f"[{self.unit}]" if self.unit else ""


@dataclass(frozen=True, slots=True)
class Table:
    """One table: rows are unique by key and sorted by it within a step."""

    level: Level
    """Lowest record level that keeps the table."""
    meaning: str
    columns: Mapping[str, Column]

    @property
    def key(self) -> tuple[str, ...]:
        return tuple(name for name, column in self.columns.items() if column.key)

    @property
    def stored(self) -> dict[str, Column]:
        """Columns on disk. The others are read from the table `detections`."""
        return {name: column for name, column in self.columns.items() if not column.via}

    def virtual(self, columns: Sequence[str], where: object) -> list[str]:
        """Columns not on disk that are wanted, or that a choice of rows or a question asks for by name."""
        asked = {*columns, *re.findall(r"\w+", str(where))}  # a word too many costs time only
        return [name for name, column in self.columns.items() if column.via and name in asked]

    def layouts(self) -> dict[str, Layout]:
        """How Parquet lays out each column on disk.

        Unless a column says otherwise, the first identity of the key is laid out as differences, because the rows of a
        step are sorted by it. Other whole numbers are split into bytes, and all else has a dictionary. With the best
        layout of each column and file, found by trial, all tables would be 0.3 % smaller in Luxembourg and 0.9 % in
        Bologna.
        """
        whole = [name for name in self.key if self.columns[name].type == "int32"]
        first = next((name for name in whole if name != "step"), None)
        found: dict[str, Layout] = {}
        for name, column in self.stored.items():
            usual: Layout = "bytes" if column.type in WHOLE else "dictionary"
            found[name] = column.layout or ("differences" if name == first else usual)
        return found


WHOLE = ("int32", "int16", "uint8")
"""Types of whole numbers."""
