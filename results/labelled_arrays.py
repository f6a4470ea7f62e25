"""A table of a run as an xarray dataset: one array per column, over the columns of the table's key.

Notes
-----
The step becomes the coordinate `time` in seconds of the run; the other columns of the key keep their names and values,
with the variant as the last dimension. What the table does not have is missing: NaN in numbers, -1 in labels and flags.
Whole numbers become double precision, which holds them exactly. Labels are small integers, with `flag_values` and
`flag_meanings` as the CF conventions have them; so are flags that are true or false. Every array has `units` ("1" where
a number has none) and `long_name`. The dataset says of which run it is, with schema version and seed.
`dataset.to_zarr("trust.zarr", zarr_format=2)` writes it: format 3 has no specification of texts yet.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy import ndarray

from results.columns import Column
from results.extras import needed
from results.run import Run
from results.tables import TABLES

if TYPE_CHECKING:
    import xarray

MOST_CELLS = 200_000_000
"""Largest array that is made: tables have rows only where there is something, arrays have all combinations."""


def of_table(run: Run, name: str, columns: Sequence[str] | None = None) -> "xarray.Dataset":
    """A table as labelled arrays.

    Parameters
    ----------
    name
        Name of the table. The first column of its key is the step.
    columns
        Columns beside those of the key; all by default, except texts.

    Raises
    ------
    ValueError
        In one line: xarray is not installed, the run does not have the table or a column, the table is not over time,
        or its arrays would be too large.
    """
    with needed("xarray", "makes labelled arrays", "formats"):
        import xarray

    run.require(name)
    table = TABLES[name]
    if table.key[0] != "step":
        raise ValueError(
            f"Table {name} has one row for each {', '.join(table.key)}, not one for each step. Use run.{name}."
        )
    wanted = [c for c, column in table.columns.items() if column.type != "string" and c not in table.key]
    wanted = wanted if columns is None else [c for c in columns if c not in table.key]
    rows = run.table(name, [*table.key, *wanted])
    # a key that only some runs have is a dimension only where there is more than one value
    keys = [c for c in table.key if not table.columns[c].absent or rows[c].nunique() > 1]
    coordinate, place = zip(*(_coordinate(rows[c]) for c in keys), strict=True)
    shape = tuple(len(values) for values in coordinate)
    if (n := int(np.prod(shape, dtype=np.float64))) > MOST_CELLS:
        sizes = " x ".join(f"{size} {c}" for c, size in zip(keys, shape, strict=True))
        raise ValueError(
            f"Table {name} would be arrays of {sizes}, {n / 1e6:,.0f} million values each; {MOST_CELLS / 1e6:,.0f} "
            f"million is the most. Use run.table({name!r}, columns, where)."
        )
    dims = ("time", *keys[1:])
    coords: dict[str, Any] = {
        "time": ("time", coordinate[0] * run.dt_s, {"units": "s", "long_name": "Time in the run"})
    }
    for key, values in zip(keys[1:], coordinate[1:], strict=True):
        coords[key] = (key, values, {"long_name": table.columns[key].meaning})
    arrays = {}
    for c in wanted:
        column = table.columns[c]
        values, absent = _numbers(rows[c], column)
        whole = np.full(shape, absent, values.dtype)
        whole[place] = values
        arrays[c] = (dims, whole, _attributes(run, column))
    about = {
        "title": f"{table.meaning} Run {run.name}.", "run": run.name, "table": name, "Conventions": "CF-1.11",
        "schema_version": run.manifest["schema_version"], "seed": run.manifest.get("seed", ""),
    }  # fmt: skip
    made = xarray.Dataset(arrays, coords, about)
    return made.transpose("time", ..., "variant") if "variant" in dims else made


def _coordinate(values: pd.Series) -> tuple[ndarray, ndarray]:
    """The different values of a column of the key in ascending order, and where those of the rows are among them."""
    if isinstance(values.dtype, pd.CategoricalDtype):
        used = [label for label in values.cat.categories if (values == label).any()]
        return np.array(used, np.dtypes.StringDType()), pd.Categorical(values, used).codes.astype(np.int64)
    return np.unique(values.to_numpy(), return_inverse=True)


def _numbers(values: pd.Series, column: Column) -> tuple[ndarray, float]:
    """Values as numbers, and the number that stands for what is missing."""
    if isinstance(values.dtype, pd.CategoricalDtype):
        return values.cat.codes.to_numpy(np.int8), -1
    if column.type == "bool":
        return values.astype("Int8").fillna(-1).to_numpy(np.int8), -1
    dtype = np.float32 if column.type == "float32" else np.float64
    return values.to_numpy(dtype, na_value=np.nan), np.nan


def _attributes(run: Run, column: Column) -> dict[str, Any]:
    about: dict[str, Any] = {"long_name": column.meaning}
    if column.type in ("category", "bool"):
        labels = column.labels(run.manifest) or ("false", "true")
        words = " ".join(label.replace(" ", "_") for label in labels)
        return about | {
            "flag_values": np.arange(len(labels), dtype=np.int8),
            "flag_meanings": words,
            "missing_value": np.int8(-1),
        }
    return about | {"units": column.unit or "1"}
