"""GeoParquet 1.1: the tables with positions, each a Parquet file with a column of points, for GIS programs.

Notes
-----
`actors.parquet`, `detections.parquet`, `fused.parquet`, each as far as the run has the table, and `trust.parquet`:
trust in every pseudonym at the true position of its vehicle. The columns are those of the tables; `time_s` is the time
in the run, and `geometry` is a point (well-known binary). Where the network has a projection, points are longitude and
latitude on WGS84 (the default of GeoParquet, OGC:CRS84); otherwise they are x and y of the world frame [m], and the
coordinate reference system is null. Heights stay in `z_m`. Units and meanings are in the metadata of the fields. All
actors, detections and fused objects of the chosen steps are written.   Deviations: none.
"""

import io
import json
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float
from numpy import ndarray

from results.export.moments import Clouds, File, Plan, Selection, Unit
from results.tables import TABLES as DICTIONARY
from results.tables import schema

TABLES = ("actors", "vehicles")

WITH_POSITIONS = tuple(name for name, table in DICTIONARY.items() if {"x_m", "y_m"} <= table.columns.keys())
"""Tables whose rows have a position."""

ROW_BYTES = 60
"""Of a row, roughly."""

Points = Callable[[Float[ndarray, "n 2"]], Float[ndarray, "n 2"]]
"""Coordinates in the file of places in the world frame."""


class GeoParquet:
    """GeoParquet."""

    TABLES = TABLES
    ALL_VEHICLES = True

    def plan(self, selection: Selection) -> Plan:
        """A file for each table with positions, and one for trust."""
        run = selection.run
        names = [name for name in WITH_POSITIONS if name in run.tables]
        units = [Unit(name, partial(_file, selection, name)) for name in names]
        if "trust" in run.tables:
            units.append(Unit("trust", partial(_file, selection, "trust")))
        return Plan(tuple(units), text_bytes=float(ROW_BYTES * sum(run.n_rows(name) for name in names)))


def _file(selection: Selection, name: str, clouds: Clouds) -> Iterator[File]:
    yield File(f"{name}.parquet", partial(_content, selection, name))


def _content(selection: Selection, name: str) -> bytes:
    points, crs = _points(selection)
    fields = list(schema(name, whole=True))
    if name == "trust":
        fields += [schema("actors").field(column) for column in ("x_m", "y_m")]
    time = pa.field("time_s", pa.float64(), metadata={"unit": "s", "meaning": "Time in the run."})
    shape = pa.schema([*fields, time, pa.field("geometry", pa.binary())])
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    made = io.BytesIO()
    with pq.ParquetWriter(made, shape, compression="zstd") as writer:
        for steps in selection.spans():
            rows = _rows(selection, name, steps)
            xy = points(rows[["x_m", "y_m"]].to_numpy(np.float64))
            if len(xy):
                low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
            rows = rows.assign(time_s=rows.step.to_numpy(np.float64) * selection.run.dt_s, geometry=wkb_points(xy))
            writer.write_table(pa.Table.from_pandas(rows[shape.names], shape, preserve_index=False))
        geometry: dict[str, Any] = {"encoding": "WKB", "geometry_types": ["Point"]} | crs
        if np.isfinite(low).all():
            geometry["bbox"] = [*low.tolist(), *high.tolist()]
        about = {"version": "1.1.0", "primary_column": "geometry", "columns": {"geometry": geometry}}
        writer.add_key_value_metadata({"geo": json.dumps(about)})
    return made.getvalue()


def _rows(selection: Selection, name: str, steps: Any) -> pd.DataFrame:
    """Rows of a table in these steps; those of trust have the position of the subject's vehicle."""
    run, where = selection.run, pc.field("step").isin(steps.tolist())
    rows = run.table(name, where=where)
    if name != "trust":
        return rows
    there = run.table("actors", ["step", "actor", "x_m", "y_m"], where).rename(columns={"actor": "vehicle"})
    rows = rows.assign(vehicle=rows.subject.map(run.subjects.vehicle))
    return rows.merge(there, on=["step", "vehicle"])  # who has left the road has no position


def _points(selection: Selection) -> tuple[Points, dict[str, Any]]:
    """How positions are written, and what the file says of their coordinate reference system."""
    try:
        projection = selection.projection()
    except ValueError:
        return lambda xy_m: xy_m, {"crs": None}

    def on_earth(xy_m: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        place = projection.of_world(xy_m)
        return np.column_stack([place.longitude_deg, place.latitude_deg])

    return on_earth, {}


def wkb_points(xy: Float[ndarray, "n 2"]) -> list[bytes]:
    """Points as well-known binary: byte order, the type 1 of a point, x and y."""
    packed = np.zeros(len(xy), [("order", "u1"), ("type", "<u4"), ("x", "<f8"), ("y", "<f8")])
    packed["order"], packed["type"] = 1, 1
    packed["x"], packed["y"] = xy[:, 0], xy[:, 1]
    raw, size = packed.tobytes(), packed.itemsize
    return [raw[i : i + size] for i in range(0, len(raw), size)]
