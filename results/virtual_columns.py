"""Columns of `fused` that are not on disk: those of the detections that a row names."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy import ndarray

from cosim.base.durable import Damaged
from results.columns import Table
from results.tables import TABLES

Read = Callable[[Path, Sequence[str], pc.Expression | None], pa.Table]
"""Reads columns and rows of one part file."""

_NAME = ("step", "observer", "detection_index")
_LINKS = ("step", "source", "source_index", "source_step", "pose", "pose_index", "pose_step")
_MOVED = "moved_"


def names(table: Table, columns: Sequence[str], where: pc.Expression | None) -> list[str]:
    """Columns not on disk that are wanted, or that the choice of rows asks for."""
    asked = set(re.findall(r"\w+", str(where)))  # a word too many costs time only
    return [name for name, column in table.columns.items() if column.via and (name in columns or name in asked)]


def read(read: Read, path: Path, columns: Sequence[str], where: pc.Expression | None) -> pa.Table:
    """Columns and rows of a part file, those not on disk included."""
    table = TABLES[path.parent.name]
    virtual = names(table, columns, where)
    if not virtual:
        return read(path, columns, where)
    late = where if names(table, (), where) else None
    stored = [
        name
        for name in table.stored
        if name in columns
        or late is not None
        or name in _LINKS
        or (name.startswith(_MOVED) and name.removeprefix(_MOVED) in virtual)
    ]
    rows = read(path, stored, None if late is not None else where)
    named = _detections(read, path, [*_NAME, *virtual], rows)
    at = _named(rows, named, path)
    for name in virtual:
        values = named.column(name).take(at[table.columns[name].via])
        if _MOVED + name in rows.column_names:
            values = pc.add(values, rows.column(_MOVED + name))
            if name == "yaw_rad":
                values = _wrapped(values)
        rows = rows.append_column(named.schema.field(name), values)
    return (rows if late is None else rows.filter(late)).select(list(columns))


def _wrapped(angle: pa.ChunkedArray) -> pa.Array:
    """The angles in (-pi, pi]."""
    value = angle.to_numpy().copy()
    value[value > np.pi] -= np.float32(2 * np.pi)
    value[value <= -np.pi] += np.float32(2 * np.pi)
    return pa.array(value)


def _detections(read: Read, path: Path, columns: Sequence[str], rows: pa.Table) -> pa.Table:
    """The detections of the block, and those of blocks before it as far as the rows name earlier detections."""
    beside = path.parent.parent / "detections" / path.name
    found = [read(beside, columns, None)]
    steps = [rows.column(name).to_numpy() for name in ("source_step", "pose_step")]
    first, number = int(min(step.min(initial=2**31 - 1) for step in steps)), int(beside.stem.rpartition("-")[2])
    while number and len(found[0]) and first < pc.min(found[0].column("step")).as_py():
        number -= 1
        found.insert(0, read(beside.with_name(f"part-{number:05d}.parquet"), columns, pc.field("step") >= first))
    return pa.concat_tables(found)


def _named(rows: pa.Table, named: pa.Table, path: Path) -> dict[str, ndarray]:
    """Rows of `named` that the rows name, as the source of the box and of its pose."""
    held = _key(*(named.column(name).to_numpy() for name in _NAME))
    source = _find(held, _key(*(rows.column(n).to_numpy() for n in ("source_step", "source", "source_index"))), path)
    pose = source.copy()
    moved = rows.column("pose").is_valid().to_numpy()
    there = (rows.column(name).filter(pa.array(moved)).to_numpy() for name in ("pose_step", "pose", "pose_index"))
    pose[moved] = _find(held, _key(*there), path)
    return {"source": source, "pose": pose}


def _key(step: ndarray, observer: ndarray, detection_index: ndarray) -> ndarray:
    """One sortable number: 2^16 steps, 2^31 pseudonyms and 2^16 detections fit; a part holds no more steps."""
    return ((step.astype(np.int64) & 0xFFFF) << 47) | (observer.astype(np.int64) << 16) | detection_index


def _find(held: ndarray, wanted: ndarray, path: Path) -> ndarray:
    order = np.argsort(held, kind="stable")
    at = np.minimum(np.searchsorted(held[order], wanted), len(held) - 1)
    if len(wanted) and (not len(held) or (held[order][at] != wanted).any()):
        raise Damaged(f"{path} is damaged: it names detections that do not exist. Run `cosim verify` on its run.")
    return order[at]
